"""A calibration's result as a person reads it: blocks for any face.

- `document`: the whole of it, in a terminal, in a notebook, as a report; many campaigns in a table
- `verdict`, `accelerometer`, `triad`, `uncertainty`, `methods`, `pictures`: its chapters
- `traces`: thinned residuals for its pictures
"""
