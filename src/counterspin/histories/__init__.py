"""History of an instrument: consistency of its results over time, and drift.

- `history`: history of a coefficient from result files
- `files`: result files, with their dates, serial numbers and tracked values
- `consistency`: agreement, drift and repeatability of results with shared inputs; control limits,
  and the due date of the next calibration
- `result`: the history and its JSON
- `page`: the report of a history, with its control chart
"""
