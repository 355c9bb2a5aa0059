"""From displacement errors to coefficients and what is known about them; no files, no settings.

What stands in this room:

- `blocks`: what a record says about the shared unknowns, in a few rows
- `least_squares`, `plain_fit`: blocks, priors and considered terms, solved by QR; one fit alone
- `identifiability`: what the data cannot tell apart, by name
- `diagnostics`: whether the model fits the records
- `noise`, `riccati`: models of a record's noise, and whitening with them
- `variance_components`, `restricted_likelihood`: the noise's size, estimated from the records
- `unseen_noise`: what noise that the records do not show may add to the uncertainty
- `strobes`: the samples of a record at one angle of each revolution (Eq. 15)
- `first_stage`, `two_stage`: the paper's method, a parabola a run and then its curvature
  against the rate
- `series`: one accelerometer's output in one run, with its columns and its whitening
- `model`, `inputs`: what a joint fit estimates and considers; what uncertain inputs change
- `encoder`: what the encoder's noise leaves open of each run's rotation
- `joint`: full records of all runs and accelerometers, solved together
- `estimation`: the joint estimate step by step
- `thinning`: residuals for pictures
- `outliers`, `rotation`: samples that noise does not explain; how runs without angles turned
- `setup`, `angle_functions`, `run_information`: what a run of a plan would tell, as a smooth
  function of its rate and length
- `design`: plans, what they may be and how good they are
- `relaxation`, `polishing`, `optimal`: the best plan, and what no plan can better
- `study_draws`, `study_tally`: what varies in a Monte-Carlo study; what its trials amount to
- `study_strobes`, `study_surrogate`: what errors add to a strobed run, by quadrature and as a
  polynomial
- `study_two_stage`, `study_joint`, `study_full`: trials by sufficient statistics, by whole records
- `study_validity`, `study_choice`, `study_engine`: where shortcuts hold, which is taken, batches
- `conformity`: whether a quantity meets a specification, and the risk of being wrong
- `consistency`: whether repeated measurements agree, and whether what they measure drifts
- `budget`, `left_out`: where the uncertainty of a coefficient comes from; what is not in it

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
