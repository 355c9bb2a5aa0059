"""What a campaign needs to be simulated, and its simulated readings.

- `simulable`: whether a campaign can be simulated, and has room to be computed
- `noise_at_rest`: noise that is left to a record at rest
- `pose_record`: a record of a triad that is set down in one pose after the other
- `reading_simulation`: simulated readings: their values, and files with them
"""
