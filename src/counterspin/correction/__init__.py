"""Apply a result: correct an indicated specific force.

- `apply`: in memory
- `instrument`: the accelerometer that a result describes, and its indications
- `related`: further inputs of a correction: temperature differences, and correlations of errors
- `apply_file`: a column of a file, corrected in a new file
- `export`: the coefficients for other programs; `workbook`: Excel files
- `page`: the printed report of a correction
"""
