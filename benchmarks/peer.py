"""Calibrate as a typical laboratory script does, with NumPy and pandas; prints JSON.

    python benchmarks/peer.py FOLDER .csv

The script loads each record, integrates powers of the acceleration twice for the design matrix,
fits each run with `numpy.linalg.lstsq`, and solves the parabolas of the three rates for K_F and
K_II. It does not check for gaps, repeated rows or outliers. Its only inputs are the radius,
gravity and the Earth rate.
"""

from __future__ import annotations

import json
import sys

import numpy as np

R, G, EARTH_UP = 2.5, 9.8066, 7.292115e-5 * np.sin(np.radians(45.75))
folder, suffix = sys.argv[1:]


def read_columns(path):
    if suffix == ".csv":
        import pandas as pd

        frame = pd.read_csv(path)
    else:
        # pandas needs another library for Parquet, which this project does not use.
        import polars as pl

        frame = pl.read_parquet(path)
    return [frame[name].to_numpy() for name in ("time_s", "angle_rad", "east_m")]


def integrate_twice(a, dt):
    integral = np.cumsum(a) - 0.5 * (a + a[0])
    return dt**2 * (np.cumsum(integral) - 0.5 * integral)


mean_squares, parabolas, sigmas = [], [], []
for n in range(3):
    t, angle, east = read_columns(f"{folder}/run{n}{suffix}")
    error = east - R * np.cos(angle)
    thinned = slice(None, None, max(1, len(t) // 10000))
    rate = np.polyfit(t[thinned], angle[thinned], 1)[0]
    # Use the fitted rotation, because the noise of the angle would be integrated.
    a = -(R * rate**2 + 2 * EARTH_UP * R * rate) * np.cos(rate * t)
    dt = (t[-1] - t[0]) / (len(t) - 1)
    design = np.column_stack(
        [
            np.ones_like(t),
            t,
            0.5 * G * t**2,
            integrate_twice(a, dt),
            integrate_twice(a**3, dt) / G**2,
        ]
    )
    coefficients, rss, *_ = np.linalg.lstsq(design, error, rcond=None)
    mean_squares.append(np.mean(a**2) / G**2)
    parabolas.append(coefficients[2])
    # With offset and slope: sigma(b2) = sqrt(180/N) sigma/T^2, b2 = G p/2.
    sigmas.append(2 / G * np.sqrt(180 / len(t)) * np.sqrt(rss[0] / len(t)) / (t[-1] - t[0]) ** 2)
weights = 1 / np.array(sigmas)
design = np.column_stack([np.ones(3), mean_squares])
k_f, k_ii = np.linalg.lstsq(design * weights[:, None], np.array(parabolas) * weights, rcond=None)[0]
covariance = np.linalg.inv((design * weights[:, None] ** 2).T @ design)
print(json.dumps({"K_F": k_f, "K_II": k_ii, "u": covariance[1, 1] ** 0.5}))
