"""What a campaign needs to be simulated, and its simulated readings.

- `simulable`: whether a campaign can be simulated, and has room to be computed
- `reading_simulation`: simulated readings: their values, and files with them
"""
