"""Estimation of coefficients and their uncertainties from displacement errors.

The package reads no files and no settings. Modules:

- `least_squares`: square-root information of records, and the QR solution with priors and
  considered terms
- `priors`: correlation matrix, whitening and conditional sources of correlated priors
- `identifiability`: parameters and combinations that the data determine
- `distributions`: normal, chi-square and Student's distribution of scalars;
  `mixture_distribution`: distribution of the sum of an estimated and a known part
- `diagnostics`: tests of residuals for lack of fit
- `conformity`: conformity with a specification, and the risk of a wrong decision; `global_risk`:
  this risk for items of a known process; `verdicts`: the statements of a result
- `noise`: noise models of records, whitening, estimation of noise variances
- `joint`: joint fit of the full records of all runs and accelerometers
- `variance_components`: variance between days, mountings and other groups of measurements
- `two_stage`: the paper's method, a parabola per run and then its curvature against the rate

Glossary
--------
u
    Standard uncertainty (k = 1). A covariance that cannot be computed is None, with the reason.
prior
    A value with its u that is known before the campaign and is combined with the data.
considered term
    A term that is not estimated; the u of its prior is propagated to every estimate that depends
    on it (Schmidt).
stated and estimated sigma
    The standard deviation of the noise is either stated or estimated from the residuals; every
    result says which.
near-collinear
    Columns that the data can hardly separate (IEEE Std 836: "bucking"). They are reported by name,
    with their correlation and the combination that is determined.
undetermined
    A coefficient whose u is not below its largest credible size, ``limit`` in the table of terms.
strobe
    A sample at an angle where the reference displacement along the input axis is zero.
b0, b1, b2
    Coefficients of the parabola fitted to the strobes of a run, in m, m/s and m/s^2.

Units are SI; coefficients are in the units of their row in the table of terms. The columns come
from `counterspin.physics.observation`.
"""
