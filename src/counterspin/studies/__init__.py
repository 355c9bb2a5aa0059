"""Many simulated trials of a campaign and its analyses: bias, scatter, coverage.

- `study`: the whole way, from a study's file to its result
- `description`: what may stand in ``[study]``
- `world`: what is simulated; `draws`: what is true in each trial, and how noise is drawn
- `strobed_effects`: what errors add to a strobed run, by quadrature
- `two_stage_engine`, `joint_engine`: trials by sufficient statistics, and the Cramer-Rao bound
- `whole_trials`: trials simulated without any shortcut, sample by sample, and analysed as
  `calibrate` does; `recorded_poses`: poses of a record, read one by one in them
- `validity`, `choice`: what competes; where the fast engines hold, and which an analysis gets
- `work`: the trials of a study, batch by batch, on one core, on many, or on a cluster
- `tally`: what trials amount to
- `result`: what a study found, its JSON; `folder`: where it is kept, and what a resumption needs
- `page`: a study as a person reads it, with its figures
"""
