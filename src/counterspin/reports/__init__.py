"""Reports as a person reads them: blocks, and their renderers; nothing is decided here.

A report is blocks of words, cells and curves; each room makes its own (a calibration's, a plan's, a
study's), and every renderer here sets any of them. The rules:

- A value is rounded to its uncertainty, and the uncertainty to two digits.
- Every number has a unit: accelerometer coefficients in g-units, with the site's gravity stated
  once, and angles, drifts and rates in the units of the field (arcsec, deg/h, rad/s).
- Uncertainties are standard ones (k = 1) unless a coverage is named.
- Missing values are shown as missing, with the reason; a warning is next to its subject.

The modules of this room:

- `numbers`: the one place where a number becomes text
- `blocks`: the parts of a report: plain blocks of words, cells and curves, in characters that may
  be shown
- `typography`: powers of ten and micro signs as in print
- `html`: blocks as a self-contained page; its parts are in the folder "assets"
- `text`: a result in the terminal, and the progress of work there
- `charts`: pictures as SVG in a page, in a file, or to be zoomed; `drawing`, `sphere`,
  `chart_layout`: their drawing
- `pdf`, `markdown`: blocks as a file on paper and as plain text with marks
- `publication`: reports of results: as files, in a notebook, and on request
"""
