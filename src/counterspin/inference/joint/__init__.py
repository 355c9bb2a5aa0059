"""The joint fit: full records of all runs and accelerometers, solved together.

- `series`: one accelerometer's output in one run, with its columns and its whitening
- `unknowns`, `inputs`: what a joint fit estimates and considers; what uncertain inputs change
- `observation`: what records, readings and curvatures are to a fit
- `prepared`: the columns of each record, computed once
- `encoder`: what the encoder's noise leaves open of each run's rotation
- `fit`: one weighted fit of everything
- `estimation`: the joint estimate, stage by stage
- `outliers`, `cleaning`: samples that noise does not explain, left out round by round
- `correlated`: rows that are not independent, and are left out
- `found_noise`: noise found in the records, and what its own uncertainty leaves open
- `uneven_noise`: white noise that differs from run to run, or follows the slope of the signal
- `rotation`: how runs without angles turned
- `condensed`: what nobody asks for, in as few columns as the records can tell from nothing
- `budget`, `what_if`: where the uncertainty of a coefficient comes from, and what it would be if
  that were known better
- `kinds`: whether data of several kinds agree; `runs_left_out`: what becomes of an estimate
  without a run
- `relaxed`, `alternatives`, `mistakes`: what is assumed taken as unknown; what else would explain
  the records; mistakes that are likely, and which explanation is the likelier one
- `turned`: an accelerometer turned about its input axis
- `slow_parts`: whether noise that was found is alike in all runs
"""
