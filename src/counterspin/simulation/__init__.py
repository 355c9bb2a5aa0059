"""Simulated campaigns: records and readings of accelerometers whose coefficients are known.

What is true of them is said in ``campaign.toml`` (`counterspin.campaign.simulated_truth`); no
calibration reads it.

- `simulate`: `counterspin simulate`: the records, in memory or as files
- `simulable`: whether a campaign can be simulated, and the campaign with its inputs as they truly
  are
- `readings`: simulated readings: their values, and files with them
- `pose_record`: a record of a triad that is set down in one pose after the other
"""
