"""Common sections of the campaigns in the benchmarks."""

from __future__ import annotations

HEAD = """schema = 1
[campaign]
title = "{title}"
[site]
gravity = "9.8066 m/s^2"
latitude = "45.75 deg"
[centrifuge]
radius = "2.5 m"
[records]
time = {{ column = "time_s", unit = "s" }}
angle = {{ column = "angle_rad", unit = "rad" }}
[model]
assume = "all"
terms = ["K_F", "K_I", "K_II", "K_III"]
"""
EAST = """
[accelerometers.Qx]
input_axis = "east"
pendulous_axis = "down"
bias = "0.00503 ± 2e-6 g"
scale_factor = "1.00197 ± 5e-6 g/g"
displacement = { column = "east_m", unit = "m" }
"""
NORTH = """
[accelerometers.Qy]
input_axis = "north"
pendulous_axis = "down"
bias = "0.003743 ± 2e-6 g"
scale_factor = "0.99882 ± 5e-6 g/g"
displacement = { column = "north_m", unit = "m" }
"""


def header(title: str, *accelerometers: str) -> str:
    """Return the TOML of site, centrifuge, columns, terms and accelerometers (`EAST`, `NORTH`)."""
    return HEAD.format(title=title) + "".join(accelerometers)
