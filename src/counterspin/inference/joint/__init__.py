"""Joint fit of the full records of all runs and accelerometers.

- `unknowns`: estimated and considered unknowns, and the interface for observations
- `series`: output of an accelerometer in a run, effects of uncertain inputs, whitening
- `design_blocks`: design matrix of each record, and compression of nuisance parameters
- `encoder`: rotation errors due to encoder noise
- `fit`: the weighted fit, and variants with estimated considered terms or additional columns
- `estimation`: stages of the estimation
- `rotation`: rotation of runs without a recorded angle
- `outlier_rejection`: rejection of outliers, and thinning of rows with correlated errors
- `estimated_noise`: noise estimated from the records, and the effect of its uncertainty
- `time_stamps`: errors of time stamps, from the residuals of angle and output
- `heteroscedasticity`: white noise that differs between runs, or depends on the slope of the
  signal
- `budget`: uncertainty contributions of a coefficient; `what_if`: uncertainty with other priors
- `summary`: budget lines, what-if values and jackknife of a result
- `agreement`: agreement of each run, and of slow residuals, with the other runs
- `alternatives`, `mistakes`: score tests of alternative hypotheses; likely mistakes and their odds
"""
