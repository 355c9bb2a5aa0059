"""Results as a person reads them; nothing is computed here.

A result arrives complete from the rooms below, and a report is a pure function of it. The rules:

- A value is rounded to its uncertainty, and the uncertainty to two digits.
- Units stand with every number: accelerometer coefficients in g-units, with the site's gravity
  said once, and angles, drifts and rates in the units of the field (arcsec, deg/h, rad/s).
- Uncertainties are standard ones (k = 1) unless a coverage is named.
- What is missing is shown as missing, with its reason; a warning stands beside what it is about.

What stands in this room:

- `numbers`: the one place where a number becomes text
- `blocks`: what a report is made of, before anybody sets it
- `sections`, `findings`: a result as blocks, for the terminal
- `document`, `verdict`, `pictures`, `method`: the same in full, for paper and screen
- `typography`: powers of ten and micro signs as in print
- `publishing`: the full report as a file
- `html`, `zoomable`: blocks as a page that needs nothing else; `assets` are its parts
- `text`: blocks in the terminal
- `charts`, `chart_layout`: the pictures of a report as SVG
- `pdf`, `markdown`: blocks as a file on paper and as plain text with marks
- `figure`, `study_figures`, `planning_figure`: figures for files
- `demonstration`, `reproduction`, `planning`, `study`, `batch`, `application`: what the other
  commands found
- `progress`: a sign of life while work goes on
"""
