"""What a researcher in a notebook asks of a result, beside its numbers.

- `forms`: numbers in SI units, as LaTeX, and as matrices whose rows have names
- `exports`: coefficients as a frame, as LaTeX, for GTC and uncertainties
- `instrument`: the accelerometer that a result describes, and what it indicates
- `residuals`: whole residuals as arrays and pictures, and thinned ones for a result's file
"""
