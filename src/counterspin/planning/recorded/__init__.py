"""Campaigns that are recorded: what they tell, and what further runs would add.

- `from_records`: lengths, sampling rates and noise as a forecast needs them
- `further_runs`: the cheapest runs in another attitude that reduce an uncertainty
- `pose_noise`: poses with the noise estimated in their fit
"""
