"""The same job as a laboratory's own script does it, with NumPy and pandas.

    python benchmarks/peer.py FOLDER .csv

Reads each record whole, sums powers of the acceleration twice for the columns, fits each run by
`numpy.linalg.lstsq`, and solves the parabolas of three rates for K_F and K_II. It looks for no
gaps, repeats or outliers and carries no knowledge but the radius, the gravity and Earth's rate.
"""

from __future__ import annotations

import json
import sys

import numpy as np

R, G, EARTH_UP = 2.5, 9.8066, 7.292115e-5 * np.sin(np.radians(45.75))
folder, suffix = sys.argv[1:]


def read(path):
    if suffix == ".csv":
        import pandas as pd

        frame = pd.read_csv(path)
    else:
        # pandas reads Parquet only with a library that this project does not need.
        import polars as pl

        frame = pl.read_parquet(path)
    return [frame[name].to_numpy() for name in ("time_s", "angle_rad", "east_m")]


def twice(a, dt):
    once = np.cumsum(a) - 0.5 * (a + a[0])
    return dt**2 * (np.cumsum(once) - 0.5 * once)


force, parabola, sigma = [], [], []
for n in range(3):
    t, angle, east = read(f"{folder}/run{n}{suffix}")
    error = east - R * np.cos(angle)
    some = slice(None, None, max(1, len(t) // 10000))
    rate = np.polyfit(t[some], angle[some], 1)[0]
    # The angle's noise would be summed with the acceleration: the fitted rotation instead.
    a = -(R * rate**2 + 2 * EARTH_UP * R * rate) * np.cos(rate * t)
    dt = (t[-1] - t[0]) / (len(t) - 1)
    design = np.column_stack(
        [np.ones_like(t), t, 0.5 * G * t**2, twice(a, dt), twice(a**3, dt) / G**2]
    )
    found, rss, *_ = np.linalg.lstsq(design, error, rcond=None)
    force.append(np.mean(a**2) / G**2)
    parabola.append(found[2])
    # Of a parabola among offset and slope: sigma(b2) = sqrt(180/N) sigma/T^2, b2 = G p/2.
    sigma.append(2 / G * np.sqrt(180 / len(t)) * np.sqrt(rss[0] / len(t)) / (t[-1] - t[0]) ** 2)
weight = 1 / np.array(sigma)
matrix = np.column_stack([np.ones(3), force])
found = np.linalg.lstsq(matrix * weight[:, None], np.array(parabola) * weight, rcond=None)[0]
covariance = np.linalg.inv((matrix * weight[:, None] ** 2).T @ matrix)
print(json.dumps({"K_F": found[0], "K_II": found[1], "u": covariance[1, 1] ** 0.5}))
