"""Pages of a calibration result, as blocks of a report.

- `document`: whole result for a terminal, a notebook and a report; table of several campaigns
- `card`: main estimate of one accelerometer
- `verdict`, `accelerometer`, `budget`, `triad`, `uncertainty`, `methods`, `pictures`: chapters
- `traces`: thinned residuals for plots
"""
