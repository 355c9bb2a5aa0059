"""Results of an instrument over time: whether they agree, and whether it drifts.

- `history`: from result files to a coefficient's history
- `followed`: what is followed in each: a term, or a parameter of a triad
- `files`: which files are results, whose they are and when
- `consistency`: whether repeated measurements agree, and whether what they measure drifts
- `control`: limits from the results themselves; `due`: when the instrument is due again
- `repeats`: what they vary by from one turn-on, mounting and day to another
- `shared`: what results have in common, and the covariances that follow
- `result`: the history and its JSON
- `page`: a history as a person reads it, with its control chart
"""
