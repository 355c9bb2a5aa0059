"""Reports as a person reads them: blocks, and the faces that set them; nothing is decided here.

A report is blocks of words, cells and curves; each room makes its own (a calibration's, a plan's,
a study's), and every face here sets any of them. The rules:

- A value is rounded to its uncertainty, and the uncertainty to two digits.
- Units stand with every number: accelerometer coefficients in g-units, with the site's gravity
  said once, and angles, drifts and rates in the units of the field (arcsec, deg/h, rad/s).
- Uncertainties are standard ones (k = 1) unless a coverage is named.
- What is missing is shown as missing, with its reason; a warning stands beside what it is about.

What stands in this room:

- `numbers`: the one place where a number becomes text
- `blocks`: what a report is made of: plain blocks of words, cells and curves, in characters that
  may be shown
- `typography`: powers of ten and micro signs as in print
- `html`: blocks as a page that needs nothing else; its parts are in the folder "assets"
- `text`: a result in the terminal, and a sign of life there while work goes on
- `charts`: pictures as SVG in a page, in a file, or to be zoomed; `drawing`, `sphere`,
  `chart_layout`: how they are drawn
- `machine`, `machine_canvas`: drawings of the machine and its axes; what they are drawn on
- `pdf`, `markdown`: blocks as a file on paper and as plain text with marks
- `publication`: reports of results: as files, as a notebook shows them, and as a person asks for
  them
"""
