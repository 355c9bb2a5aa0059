"""The commands, one module each: what the command line and the Python interface both call.

- `simulate`: records of a campaign whose coefficients are known
- `calibrate`: the main job, from a campaign folder to a `Result`
"""
