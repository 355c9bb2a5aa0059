"""What a campaign needs to be simulated, and its simulated readings.

- `simulable`: whether a campaign can be simulated, and has room to be computed
- `noise_at_rest`: noise that is left to a record at rest
- `reading_simulation`: simulated readings: their values, and files with them
"""
