"""Records with timing noise: both methods agree, and u matches the scatter of the errors."""

import math
from pathlib import Path

import numpy as np
import polars as pl
import pytest

import counterspin as cs

G, RADIUS, LATITUDE = 9.8066, 2.5, math.radians(45.75)
EARTH = 7.292115e-5 * math.sin(LATITUDE)
TRUTH = {"K_F": 5e-3, "K_I": 1.002, "K_II": 2e-5, "K_III": 3e-6}
RATES = (math.pi / 2, math.pi, 2 * math.pi)
TIMING = 2e-4

HEAD = f"""schema = 1
[campaign]
title = "Scattered time stamps"
[site]
gravity = "{G} m/s^2"
latitude = "45.75 deg"
[centrifuge]
radius = "2.5 m"
[records]
time = {{ column = "t", unit = "s" }}
angle = {{ column = "a", unit = "rad" }}
[model]
terms = ["K_F", "K_I", "K_II", "K_III"]
assume = "all"
[accelerometers.Qx]
input_axis = "east"
pendulous_axis = "down"
"""


def record_columns(observable, rate, t):
    """Return recorded columns at constant rate by independent closed forms."""
    angle = 0.3 + rate * t
    cos = np.cos(angle)
    force = -(RADIUS * rate**2 + 2 * EARTH * RADIUS * rate) * cos / G
    if observable == "specific_force":
        powers = [np.ones_like(t), force, force**2, force**3]
        return angle, G * sum(k * p for k, p in zip(TRUTH.values(), powers, strict=True))
    a = RADIUS * rate**2 / G * (1 + 2 * EARTH / rate)
    turned = 2 * EARTH * RADIUS * cos / rate
    shown = [
        G * t**2 / 2,
        RADIUS * cos + turned,
        G * a**2 * (t**2 / 4 - np.cos(2 * angle) / (8 * rate**2)),
        G * a**3 * (0.75 * cos + np.cos(3 * angle) / 36) / rate**2,
    ]
    return angle, sum(k * p for k, p in zip(TRUTH.values(), shown, strict=True)) - turned


def write_campaign(folder: Path, observable, noise, seed, *, per_revolution=30, revolutions=40):
    rng = np.random.default_rng(seed)
    white, unit = {"displacement": (1e-3, "m"), "specific_force": (1e-4, "m/s^2")}[observable]
    text = HEAD + f'{observable} = {{ column = "x", unit = "{unit}" }}\n'
    if noise:
        text += f'[noise]\n{observable} = "{white} {unit}"\ntiming = "{TIMING} s"\n'
    for i, rate in enumerate(RATES):
        t = np.arange(revolutions * per_revolution) * (2 * math.pi / rate / per_revolution)
        angle, output = record_columns(observable, rate, t)
        pl.DataFrame(
            {
                "t": t + TIMING * rng.standard_normal(t.size),
                "a": angle + 1e-6 * rng.standard_normal(t.size),
                "x": output + white * rng.standard_normal(t.size),
            }
        ).write_csv(folder / f"r{i}.csv")
        text += f'[[runs]]\nname = "r{i}"\nrate = "{rate} rad/s"\nrecord = "r{i}.csv"\n'
    (folder / "campaign.toml").write_text(text, encoding="utf-8")
    return folder


def z_scores(result):
    return [
        (c.value - TRUTH[symbol]) / c.u
        for symbol, c in result.accelerometers["Qx"].coefficients.items()
        if c.estimated
    ]


@pytest.mark.parametrize("noise", [True, False], ids=["stated", "found"])
@pytest.mark.parametrize("dense", [False, True], ids=["points", "blocks"])
def test_force_is_evaluated_at_time_of_angle(noise, dense, tmp_path):
    """Blocks of seven samples: their scatter is that of the angles."""
    size = {"per_revolution": 500, "revolutions": 12} if dense else {}
    result = cs.calibrate(write_campaign(tmp_path, "specific_force", noise, 1, **size))
    assert result.state == "good"
    assert np.abs(z_scores(result)).max() < 4.0
    # Weighted by the slopes alone, K_II of the points has a u of 4e-6.
    assert result.coefficient("Qx.K_II").u < 2e-8


@pytest.mark.slow
@pytest.mark.parametrize("method", ["joint", "two-stage"])
@pytest.mark.parametrize("noise", [True, False], ids=["stated", "found"])
def test_both_methods_use_angle_for_displacement(method, noise, tmp_path):
    z = []
    for seed in range(3 if noise else 1):
        result = cs.calibrate(write_campaign(tmp_path, "displacement", noise, seed), method=method)
        assert "methods-disagree" not in {finding.code for finding in result.findings}
        z += z_scores(result)
        response = result.accelerometers["Qx"].noise.get("timing")
        if method == "joint" and not noise:
            assert response.value == pytest.approx(TIMING, rel=0.1)
    assert np.mean(np.square(z)) < 1.0 + 4.0 * math.sqrt(2.0 / len(z))
