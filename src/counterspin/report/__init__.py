"""Results as a person reads them; nothing is computed here.

A result arrives complete from the rooms below, and a report is a pure function of it. The rules:

- A value is rounded to its uncertainty, and the uncertainty to two digits.
- Units stand with every number: accelerometer coefficients in g-units, with the site's gravity
  said once, and angles, drifts and rates in the units of the field (arcsec, deg/h, rad/s).
- Uncertainties are standard ones (k = 1) unless a coverage is named.
- What is missing is shown as missing, with its reason; a warning stands beside what it is about.
"""
