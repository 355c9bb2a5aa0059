"""A timing offset to full order: 5 ms turn the arm by 31 mrad, whose square a record shows."""

import math

import numpy as np
import pytest

import counterspin as cs

GRAVITY, RADIUS, LATITUDE = 9.8066, 2.5, math.radians(45.75)
EARTH = 7.292115e-5  # rad/s
NOISE = 1e-4  # m/s^2
TRUTH = {"K_F": 0.005, "K_I": 1.002, "K_II": 2.7e-5, "K_III": 3e-6}
RIPPLE, PHASE = 1e-4, 0.7

DESCRIPTION = f"""schema = 1
site = {{ gravity = "{GRAVITY} m/s^2", latitude = "45.75 deg" }}
[centrifuge]
radius = "{RADIUS} m"
[records]
time = {{ column = "t", unit = "s" }}
angle = {{ column = "angle", unit = "rad" }}
timing_offset = "STATED"
[accelerometers.Q]
input_axis = "east"
pendulous_axis = "down"
specific_force = {{ column = "force", unit = "m/s^2" }}
[noise]
specific_force = "{NOISE} m/s^2"
[model]
assume = ["all"]
"""


def _angle(t, rate):
    return rate * t - RIPPLE * (np.cos(rate * t + PHASE) - math.cos(PHASE))


def _output(t, rate):
    """Return what the accelerometer indicates: the circular motion by itself, and Eq. 7."""
    turning = rate + RIPPLE * rate * np.sin(rate * t + PHASE)
    growing = RIPPLE * rate**2 * np.cos(rate * t + PHASE)
    angle = _angle(t, rate)
    force = -RADIUS * (turning**2 * np.cos(angle) + growing * np.sin(angle))
    # Coriolis of the Earth's rate: the velocity along north times its vertical part.
    force = force - 2.0 * EARTH * math.sin(LATITUDE) * RADIUS * turning * np.cos(angle)
    along = force / GRAVITY
    wrong = TRUTH["K_F"] + (TRUTH["K_I"] - 1.0) * along
    wrong = wrong + TRUTH["K_II"] * along**2 + TRUTH["K_III"] * along**3
    return force + GRAVITY * wrong


def _calibrated(folder, offset, stated, generator):
    runs = ""
    t = np.arange(1500) * 0.02
    for k, rate in enumerate((math.pi, 2.0 * math.pi)):
        angle = _angle(t + offset, rate) + 1e-6 * generator.standard_normal(t.size)
        force = _output(t, rate) + NOISE * generator.standard_normal(t.size)
        rows = np.column_stack([t, angle, force])
        np.savetxt(
            folder / f"{k}.csv", rows, "%.12g", delimiter=",", header="t,angle,force", comments=""
        )
        runs += f'[[runs]]\nname = "r{k}"\nrate = "{rate!r} rad/s"\nrecord = "{k}.csv"\n'
    text = DESCRIPTION.replace("STATED", stated) + runs
    (folder / "campaign.toml").write_text(text, encoding="utf-8")
    return cs.calibrate(folder)


@pytest.mark.parametrize(
    ("offset", "stated"),
    [
        (5e-4, "0 ± 1 ms"),
        (5e-4, "0.5 ± 0.001 ms"),
        (5e-3, "0 ± 10 ms"),
        # What is stated is where the search begins.
        (5e-3, "3 ± 10 ms"),
    ],
)
def test_an_offset_that_is_estimated_moves_no_coefficient(tmp_path, offset, stated):
    result = _calibrated(tmp_path, offset, stated, np.random.default_rng(21))
    assert result.state == "good"
    for symbol, true in TRUTH.items():
        c = result.coefficient(f"Q.{symbol}")
        assert abs(c.value - true) < 4.0 * c.u
    # Of first order alone, K_III was 38 of this u off.
    assert result.coefficient("Q.K_III").u < 3e-9
    (known,) = (line for line in result.rests_on if line.name == "records.timing_offset")
    assert known.value == pytest.approx(float(stated.split()[0]) * 1e-3, abs=1e-15)
    assert abs(known.found - offset) < 4.0 * known.u_found < 1e-7


def test_an_offset_that_the_prior_excludes_is_named(tmp_path):
    result = _calibrated(tmp_path, 5e-3, "0 ± 0.5 ms", np.random.default_rng(22))
    assert result.state == "contradicted"
    assert ("wrong-input", "records.timing_offset") in {
        (f.code, f.subject) for f in result.findings
    }
    (text,) = (f.text for f in result.findings if f.subject == "records.timing_offset")
    assert "0.00500" in text
