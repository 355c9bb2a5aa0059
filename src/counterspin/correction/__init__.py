"""Applying a result: indicated specific force, corrected.

- `apply`: in memory
- `warmth`: how warm it was, against the temperature of the calibration
- `related`: how errors of different accelerometers are related
- `apply_file`: a column of a file, corrected in a new file
- `page`: what was done, as a person reads it
"""
