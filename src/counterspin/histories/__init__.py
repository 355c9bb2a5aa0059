"""History of an instrument: consistency of its results over time, and drift.

- `history`: from result files to a coefficient's history
- `files`: the result files, their instruments and dates, and the tracked value of each
- `consistency`: agreement, drift and repeatability of an instrument's results, with their shared
  inputs; control limits, and the date when the next calibration is due
- `result`: the history and its JSON
- `page`: the printed report of a history, with its control chart
"""
