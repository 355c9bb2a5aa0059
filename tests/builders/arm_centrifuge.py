"""An arm centrifuge of 1 m as a standard of acceleration."""

DESCRIPTION = """
schema = 1
[site]
gravity = "9.80665 ± 1e-5 m/s^2"
latitude = "45.75 ± 0.001 deg"
[accelerometers.A]
input_axis = "up"
pendulous_axis = "west"
[centrifuge]
radius = "1 ± 1e-6 m"
stretch = "0 ± 5e-9 s^2/m"
[[runs]]
name = "in"
motion = "arm"
rate = "-9.9 ± 2e-6 rad/s"
mounting = "in"
axes = { input = "inward", pendulous = "up" }
reading = "10.0 ± 2e-6 g"
"""
#: Alignment and its growth; without them, their uncertainties are the default ones.
STATED = """
[model.priors]
"fixture.misalignment.in" = "0 ± 2 arcsec"
"centrifuge.droop" = "0 ± 1e-9 rad s^2"
"""
