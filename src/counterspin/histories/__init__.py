"""Results of an instrument over time: whether they agree, and whether it drifts.

- `history`: from result files to a coefficient's history
- `files`: which files are results, whose they are and when, and what is followed in each
- `consistency`: whether an instrument's results agree, drift and repeat, with what they have in
  common; control limits, and when it is due again
- `result`: the history and its JSON
- `page`: a history as a person reads it, with its control chart
"""
