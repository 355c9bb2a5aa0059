"""The joint fit: full records of all runs and accelerometers, solved together.

- `unknowns`: what a joint fit estimates and holds, and what an observation is to it
- `series`: one accelerometer's output in one run, what uncertain inputs change, its whitening
- `design_blocks`: the columns of each record, computed once; nuisance parameters compressed
- `encoder`: what the encoder's noise leaves open of each run's rotation
- `fit`: one weighted fit of everything; the same with what is held, or with further columns
- `estimation`: the joint estimate, stage by stage
- `rotation`: how runs without angles turned
- `outlier_rejection`: rejection of outliers, and thinning of rows with correlated errors
- `estimated_noise`: noise estimated from the records, and the effect of its uncertainty
- `time_stamps`: errors of time stamps, from what angle and output leave
- `heteroscedasticity`: white noise that differs from run to run, or follows the slope of the
  signal
- `budget`: the sources of the uncertainty of a coefficient; `what_if`: the uncertainty if one of
  them were known better
- `summary`: numbers of a joint fit that a result states
- `agreement`: whether each run, and slow residuals, agree with the other runs
- `alternatives`, `mistakes`: what else would explain the records; mistakes that are likely, and
  which explanation is the likelier one
"""
