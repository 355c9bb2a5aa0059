"""Many simulated trials of a campaign and its analyses: bias, scatter, coverage.

- `study`: the whole way, from a study's file to its result
- `description`: what may stand in ``[study]``
- `world`: what is simulated; `draws`: what is true in each trial; `noise`: how noise is drawn
- `analyses`: what competes; `bound`: the least uncertainty that the records allow
- `strobed_effects`, `surrogate`: what errors add to a strobed run, by quadrature and as a
  polynomial
- `engine`, `tally`: what every engine gives, all analyses of a batch of trials; what trials
  amount to
- `two_stage_engine`, `joint_engine`: trials by sufficient statistics
- `full_engine`: trials without any shortcut; `trial_records`, `trial_readings`: what one of them
  records and reads
- `validity`, `choice`: where the fast engines hold; which engine an analysis gets
- `work`: the trials shared out, on one core, on many or on a cluster
- `result`: what a study found, its JSON; `folder`: where it is kept, and what a resumption needs
- `page`: a study as a person reads it, with its figures
"""
