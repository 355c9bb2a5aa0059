"""What a campaign needs to be simulated, and its simulated readings.

- `simulable`: whether a campaign can be simulated, and has room to be computed
- `noise_at_rest`: noise that is left to a record at rest
- `pose_record`: a record of a triad that is set down in one pose after the other
- `truth_of_inputs`: what [truth] says of radius, site, delay and clocks
- `true_inputs`: a campaign and its readings with these inputs as they truly are
- `reading_simulation`: simulated readings: their values, and files with them
"""
