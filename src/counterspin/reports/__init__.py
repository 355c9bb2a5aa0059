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
- `blocks`: what a report is made of, before anybody sets it
- `characters`: nothing in a text that acts on what shows it
- `typography`: powers of ten and micro signs as in print
- `html`, `zoomable`: blocks as a page that needs nothing else; its parts are in the folder "assets"
- `text`: blocks in the terminal
- `charts`: pictures as SVG in a page, or in a file; `drawing`, `sphere`,
  `chart_layout`: how they are drawn
- `machine`: drawings of the machine and its axes
- `pdf`, `markdown`: blocks as a file on paper and as plain text with marks
- `publication`: blocks as a file of a kind, in one of these faces; `publishing`: of any result
- `shown`: results that show themselves in a notebook, and pictures on axes of Matplotlib
- `progress`: a sign of life while work goes on
"""
