"""Simulated campaigns: records and readings of accelerometers with known coefficients.

The true values are in ``campaign.toml`` (`counterspin.campaign.simulated_truth`); calibrations
ignore them.

- `simulate`: `counterspin simulate`: the records, in memory or as files
- `simulable`: checks of campaigns before a simulation, and the campaign with its true inputs
- `readings`: simulated readings, and files that contain their values
- `pose_record`: records of a triad that rests in one pose after another
"""
