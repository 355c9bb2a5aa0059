"""Reports: blocks and their renderers.

A report consists of blocks of text, tables and curves. Each package makes its own blocks, and every
renderer accepts all of them. Rules:

- A value is rounded to its uncertainty, and the uncertainty to two digits.
- Every number has a unit: accelerometer coefficients in g-units, with the site's gravity stated
  once, and angles, drifts and rates in the units of the field (arcsec, deg/h, rad/s).
- Uncertainties are standard ones (k = 1) unless a coverage is named.
- Missing values are shown as missing, with the reason; a warning is next to its subject.

Modules:

- `numbers`: formatting of numbers
- `blocks`: the blocks of a report, with escaped control characters
- `typography`: powers of ten and micro signs as in print
- `html`: blocks as a self-contained page; templates and styles are in the folder "assets"
- `text`: results and progress in the terminal
- `charts`: pictures as SVG for a page, as files, and as zoomable plots; `drawing`, `sphere`,
  `chart_layout`: drawing of pictures
- `pdf`, `markdown`: blocks as PDF and as Markdown
- `publication`: reports of results as files, in a notebook, and as text or bytes
"""
