"""Campaigns in memory: made in Python, changed by name, written as a folder.

- `documents`: descriptions as mappings: what may stand in them, and patches of them
- `source`: where a campaign came from; `Source` of one that is in memory, in whole or in part
- `records`: records in memory, and the files that stand for them
- `making`: `make_campaign`, from a description and records
- `changes`: `Campaign.change`
- `joining`: `Campaign.join`
- `writing`: `Campaign.write`
"""
