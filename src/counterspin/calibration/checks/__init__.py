"""Checks of every result of records: they detect a misfit, and the diagnosis explains it.

- `residuals`: residuals against the noise, and remarks on the noise
- `priors`: priors and inputs that the data contradict
- `limits`: credible sizes of estimates
- `small_angles`: drifts and tilts within the first-order theory of the attitude
- `shifts`: shifts of coefficients compared with their uncertainties
"""
