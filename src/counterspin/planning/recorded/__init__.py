"""Campaigns that are recorded: what they tell, and what further runs would add.

- `from_records`: lengths, sampling rates and noise as a forecast needs them
- `further_runs`: the cheapest runs in another attitude that reduce an uncertainty
- `told_poses`: poses with the noise that their fit tells
"""
