"""Records with too few samples in a revolution to resolve the fourth harmonic of the angle."""

import math

import numpy as np
import polars as pl
import pytest

import counterspin as cs

G, RADIUS = 9.78, 2.5
TRUTH = (4e-3, 1.001, 2e-5, 4e-6)
ARCSEC = math.radians(1.0 / 3600.0)

HEAD = f"""schema = 1
[campaign]
title = "Few samples"
[site]
gravity = "{G} m/s^2"
latitude = "0 deg"
[centrifuge]
radius = "{RADIUS} m"
[records]
time = {{ column = "t", unit = "s" }}
angle = {{ column = "a", unit = "rad" }}
[model]
terms = ["K_F", "K_I", "K_II", "K_III"]
assume = ["platform.*", "site.*", "K_IP", "K_IO", "K_PO", "K_PP", "K_OO", "K_OQ", "K_4", "K_5"]
[noise]
specific_force = "1e-4 m/s^2"
[accelerometers.Qx]
input_axis = "east"
pendulous_axis = "down"
specific_force = {{ column = "x", unit = "m/s^2" }}
"""


@pytest.mark.parametrize("sampling_rate", [7.0, 8.0, 9.3])
def test_unresolved_encoder_error_is_in_u(tmp_path, sampling_rate):
    """The fastest run has 1 rev/s; in the other runs the samples resolve the harmonic."""
    rng = np.random.default_rng(5)
    text = HEAD
    for i, rate in enumerate((math.pi / 2, math.pi, 2 * math.pi)):
        t = np.arange(0.0, 24 * math.pi / rate, 1.0 / sampling_rate)
        angle = 0.3 + rate * t
        force = -RADIUS * rate**2 / G * np.cos(angle)
        output = G * sum(k * force**power for power, k in enumerate(TRUTH))
        recorded = angle + ARCSEC * np.sin(4.0 * angle)
        frame = {
            "t": t,
            "a": recorded + 1e-9 * rng.standard_normal(t.size),
            "x": output + 1e-4 * rng.standard_normal(t.size),
        }
        pl.DataFrame(frame).write_csv(tmp_path / f"r{i}.csv")
        text += f'[[runs]]\nname = "r{i}"\nrate = "{rate} rad/s"\nrecord = "r{i}.csv"\n'
    (tmp_path / "campaign.toml").write_text(text, encoding="utf-8")
    result = cs.calibrate(tmp_path)
    assert result.state == "good"
    for symbol, true in zip(("K_II", "K_III"), TRUTH[2:], strict=True):
        coefficient = result.coefficient(f"Qx.{symbol}")
        assert abs(coefficient.value - true) < 3.5 * coefficient.u
