"""Correction: apply a result to an indicated specific force.

- `apply`: correction of arrays
- `instrument`: accelerometer that a result describes, and its indication
- `related`: temperature differences, and correlations between accelerometers
- `apply_file`: correction of a column of a file
- `export`: coefficients for other programs; `workbook`: Excel files
- `page`: printed report of a correction
"""
