"""Many simulated trials of a campaign and its analyses: bias, scatter, whether claims hold.

- `study`: the whole way, from a study's file to its result
- `description`: what may stand in ``[study]``
- `preparation`: from the description to what the engine needs
- `draws`, `tally`: what varies from trial to trial; what the trials amount to
- `strobes`, `surrogate`: what errors add to a strobed run, by quadrature and as a polynomial
- `two_stage`, `joint`, `full`: trials by sufficient statistics, by whole records
- `validity`, `choice`, `engine`: where shortcuts hold, which is taken, batches
- `work`: the trials shared out, on one core, on many or on a cluster
- `result`: what a study found, its JSON
- `page`: a study as a person reads it, with its figures
"""
