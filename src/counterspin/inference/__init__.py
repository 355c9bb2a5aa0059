"""From displacement errors to coefficients and what is known about them; no files, no settings.

What stands in this room:

- `least_squares`: what a record says about the shared unknowns in a few rows; those rows, priors
  and considered terms, solved by QR
- `priors`: correlation of priors, and independent rows and sources of correlated ones
- `identifiability`: what the data cannot tell apart, by name
- `distributions`: normal, chi-square and Student's, of single numbers; `mixture_distribution`:
  the distribution of a sum of an estimated and a known part
- `diagnostics`: whether the model fits the records
- `conformity`: whether a quantity meets a specification, and the risk of being wrong;
  `global_risk`: that risk for items of a known process;
  `verdicts`: what a result states of that
- `noise`: models of a record's noise, whitening, estimation of its size
- `joint`: full records of all runs and accelerometers, solved together
- `variance_components`: what repeated measurements vary by from day to day and so on
- `two_stage`: the paper's method, a parabola a run and then its curvature against the rate

Glossary
--------
u
    Standard uncertainty (k = 1). A covariance that cannot be had is None, with the reason.
prior
    A value with its u that is known before the campaign and is weighed with the data.
considered term
    A term that is not estimated; the u of its prior is carried to every estimate that it would
    move (Schmidt's sense).
stated and estimated sigma
    The noise's standard deviation is either given, and then taken at its word, or estimated from
    the residuals; every result says which.
near-collinear
    Columns that the data can hardly tell apart (IEEE Std 836: "bucking"): reported by name, with
    their correlation and the combination that is determined.
undetermined
    A coefficient whose u is not below its largest credible size, the table's ``limit``.
strobe
    A sample at an angle where the reference displacement along the input axis is zero.
b0, b1, b2
    Coefficients of the parabola fitted to the strobes of a run, in m, m/s and m/s^2.

Units are SI; coefficients are in the units of their row in the table of terms. The columns come
from `counterspin.physics.observation`.
"""
