"""Timing offsets beyond first order: 5 ms rotate the arm by 31 mrad, whose square is visible."""

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


SENSOR = 'natural_frequency = "400 ± 20 Hz"\ndamping = "0.7 ± 0.1"'


def _compute_angle(t, rate):
    return rate * t - RIPPLE * (np.cos(rate * t + PHASE) - math.cos(PHASE))


def _compute_output(t, rate):
    """Return the indication by an independent model of the circular motion and Eq. 7."""
    turning = rate + RIPPLE * rate * np.sin(rate * t + PHASE)
    growing = RIPPLE * rate**2 * np.cos(rate * t + PHASE)
    angle = _compute_angle(t, rate)
    force = -RADIUS * (turning**2 * np.cos(angle) + growing * np.sin(angle))
    # Coriolis of the Earth's rate: the velocity along north times its vertical part.
    force = force - 2.0 * EARTH * math.sin(LATITUDE) * RADIUS * turning * np.cos(angle)
    along = force / GRAVITY
    wrong = TRUTH["K_F"] + (TRUTH["K_I"] - 1.0) * along
    wrong = wrong + TRUTH["K_II"] * along**2 + TRUTH["K_III"] * along**3
    return force + GRAVITY * wrong


def _filter_output(rate, natural_frequency, damping):
    """Return the output of a second-order sensor as a function of time, by its harmonics."""
    grid = np.arange(256) * 2.0 * math.pi / (rate * 256)
    harmonics = np.fft.rfft(_compute_output(grid, rate))[:12] / 256
    order = np.arange(12)
    ratio = order * rate / (2.0 * math.pi * natural_frequency)
    harmonics = harmonics / (1.0 - ratio**2 + 2j * damping * ratio)
    harmonics[1:] *= 2.0
    return lambda t: (np.exp(1j * rate * np.outer(t, order)) @ harmonics).real


def _calibrate_delayed(folder, offset, stated, generator, sensor=None, response=SENSOR):
    """Calibrate records with a delayed angle, of a sensor (frequency in Hz, damping) if given."""
    runs = ""
    t = np.arange(1500) * 0.02
    for k, rate in enumerate((math.pi, 2.0 * math.pi)):
        angle = _compute_angle(t + offset, rate) + 1e-6 * generator.standard_normal(t.size)
        output = _compute_output(t, rate) if sensor is None else _filter_output(rate, *sensor)(t)
        force = output + NOISE * generator.standard_normal(t.size)
        rows = np.column_stack([t, angle, force])
        np.savetxt(
            folder / f"{k}.csv", rows, "%.12g", delimiter=",", header="t,angle,force", comments=""
        )
        runs += f'[[runs]]\nname = "r{k}"\nrate = "{rate!r} rad/s"\nrecord = "{k}.csv"\n'
    text = DESCRIPTION.replace("STATED", stated) + runs
    if sensor is not None:
        text = text.replace('pendulous_axis = "down"', f'pendulous_axis = "down"\n{response}')
    (folder / "campaign.toml").write_text(text, encoding="utf-8")
    return cs.calibrate(folder)


@pytest.mark.parametrize(
    ("offset", "stated"),
    [
        (5e-4, "0 ± 1 ms"),
        (5e-4, "0.5 ± 0.001 ms"),
        (5e-3, "0 ± 10 ms"),
        # The stated value is the start of the search.
        (5e-3, "3 ± 10 ms"),
    ],
)
def test_estimated_timing_offset_does_not_bias_coefficients(tmp_path, offset, stated):
    result = _calibrate_delayed(tmp_path, offset, stated, np.random.default_rng(21))
    assert result.state == "good"
    for symbol, true in TRUTH.items():
        c = result.coefficient(f"Q.{symbol}")
        assert abs(c.value - true) < 4.0 * c.u
    # With the first order alone, the error of K_III was 38 u.
    assert result.coefficient("Q.K_III").u < 3e-9
    (known,) = (line for line in result.rests_on if line.name == "records.timing_offset")
    assert known.value == pytest.approx(float(stated.split()[0]) * 1e-3, abs=1e-15)
    assert abs(known.found - offset) < 4.0 * known.u_found < 1e-7


def test_timing_offset_excluded_by_prior_is_named(tmp_path):
    result = _calibrate_delayed(tmp_path, 5e-3, "0 ± 0.5 ms", np.random.default_rng(22))
    assert result.state == "contradicted"
    assert ("wrong-input", "records.timing_offset") in {
        (f.code, f.subject) for f in result.findings
    }
    (text,) = (f.text for f in result.findings if f.subject == "records.timing_offset")
    assert "0.00500" in text


def test_error_of_stated_response_does_not_bias_coefficients(tmp_path):
    """True values are drawn from the priors; z has a mean of 0 within 4/sqrt(n)."""
    generator, z = np.random.default_rng(23), []
    for _ in range(2):
        sensor = 400.0 + 20.0 * generator.standard_normal(), 0.7 + 0.1 * generator.standard_normal()
        result = _calibrate_delayed(tmp_path, 0.0, "0 ± 1e-9 s", generator, sensor)
        assert result.state == "good"
        known = {line.name: line for line in result.rests_on}
        z.append([(c := result[f"Q.{s}"]).value / c.u - true / c.u for s, true in TRUTH.items()])
        for name, true in zip(("natural_frequency", "damping"), sensor, strict=True):
            line = known[f"Q.sensor.{name}"]
            z[-1].append((line.found - true) / line.u_found)
        assert known["Q.sensor.damping"].u_found < 0.03
    assert np.abs(np.mean(z, axis=0)).max() < 4.0 / math.sqrt(2.0)


def test_unstated_response_is_named_before_stretch(tmp_path):
    """The gain decreases by 1e-5 at 1 Hz, and the angle is delayed like the force."""
    delay = 1.5 / (math.pi * 592.0)
    result = _calibrate_delayed(
        tmp_path, -delay, "0 ± 1e-9 s", np.random.default_rng(24), (592.0, 1.5), response=""
    )
    assert (result.findings[0].code, result.findings[0].subject) == ("frequency-response", "Q")
