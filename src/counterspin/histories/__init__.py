"""Results of an instrument over time: whether they agree, and whether it drifts.

- `history`: a coefficient of each instrument through all its results
- `files`: which files are results, whose they are and when
- `consistency`: whether repeated measurements agree, and whether what they measure drifts
- `result`: what was found, its JSON
- `page`: a history as a person reads it, with its control chart
"""
