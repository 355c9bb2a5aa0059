"""Many simulated trials of a campaign and its analyses: bias, scatter, coverage.

- `study`: the whole way, from a study's file to its result
- `description`: what may stand in ``[study]``
- `world`: what is simulated; `draws`: what is true in each trial, and how noise is drawn
- `choice`: what competes, and which engine each analysis gets: where shortcuts hold
- `shortcuts`: trials by sufficient statistics, and the Cramer-Rao bound; `strobed_effects`: what
  errors add to a strobed run, by quadrature and by polynomials
- `whole_trials`: trials simulated without any shortcut, sample by sample, and analysed as
  `calibrate` does
- `work`: what an engine is; the trials of a study, batch by batch, on one core, on many, or on a
  cluster
- `result`: what trials amount to, a study's result, its JSON
- `folder`: where it is kept, and what a resumption needs
- `page`: a study as a person reads it, with its figures
"""
