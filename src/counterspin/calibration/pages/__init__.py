"""A calibration's result as a person reads it: blocks of a report.

- `document`: the whole of it, in a terminal, in a notebook, as a report; many campaigns in a table
- `card`: the answer on one accelerometer at a glance
- `verdict`, `accelerometer`, `budget`, `triad`, `uncertainty`, `methods`, `pictures`: its chapters
- `traces`: thinned residuals for its pictures
"""
