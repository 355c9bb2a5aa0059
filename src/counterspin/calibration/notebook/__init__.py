"""What a researcher in a notebook asks of a result, beside its numbers.

- `labelled`: covariances and correlations by name
- `si_estimate`: a coefficient in SI units
- `latex`: symbols, numbers and units as LaTeX; `tables`: coefficients as a frame and as LaTeX
- `packages`: values for GTC and uncertainties, with their correlations
- `instrument`: the accelerometer that a result describes; `prediction`: what it indicates
- `residuals`: whole residuals as arrays and as pictures; `traces`: residuals thinned for pictures
- `thinning`: few points that show what many would
"""
