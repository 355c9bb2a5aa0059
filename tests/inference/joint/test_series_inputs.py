"""What uncertain inputs do to a record, against records that were made with another value."""

import math
from dataclasses import replace

import numpy as np
import pytest
from joint_campaign import SITE, simulate_series

from counterspin.inference.joint.series import CLOCK, expected_output, input_column
from counterspin.physics.observation import LEVEL, ORDERS
from counterspin.physics.spindle import Ripple, Spindle

TRUTH = {"K_F": 5e-3, "K_I": 1.002, "K_II": 2.7e-5, "K_III": 3e-6}
KNOWN = {"K_F": 5e-3, "K_I": 2e-3, "K_II": 2.7e-5, "K_III": 3e-6}
FAST = 2e-5


def clock_column(series):
    """Return the clock column of an accelerometer with these errors."""
    table = dict(zip(KNOWN, series.columns(list(KNOWN), 1.0).T, strict=True))
    return input_column(series, CLOCK, 1.0, KNOWN, expected_output(series, KNOWN, table))


@pytest.mark.parametrize("observable", list(ORDERS))
def test_clock_column_matches_record_with_fast_clock(observable):
    """The record is sampled at true times and stamped by a clock that is 20 ppm fast."""
    ripple = Ripple(1, 1e-5 * math.pi, 0.5)
    true = Spindle(math.pi, 1e-6, (ripple,), 0.4)
    series = simulate_series(
        "run", math.pi, TRUTH, spindle=true, observable=observable, revolutions=40
    )
    # As read by that clock, the same angles are passed at lower rates.
    slower = Ripple(1, ripple.amplitude / (1 + FAST), 0.5)
    slow = Spindle(math.pi / (1 + FAST), 1e-6 / (1 + FAST), (slower,), 0.4)
    read = simulate_series(
        "run", math.pi, TRUTH, spindle=slow, observable=observable, revolutions=40
    )
    recorded = series.error + series.reference()
    time = series.time * (1 + FAST)
    read = replace(read, time=time, error=recorded)
    errors = np.array([*KNOWN.values()])
    perfect_clock = read.reference() + read.columns(list(KNOWN), 1.0) @ errors
    left = recorded - perfect_clock - FAST * clock_column(read)
    own = read.polynomials(max(read.order, 1)) if read.order else np.empty((time.size, 0))
    if read.order:
        left = left - own @ np.linalg.lstsq(own, left, rcond=None)[0]
    whole = FAST * np.abs(clock_column(read)).max()
    assert np.abs(left).max() < 1e-3 * whole


def test_clock_error_doubles_in_scale_factor_of_force():
    series = simulate_series("run", 2 * math.pi, {}, observable="specific_force", attitude=LEVEL)
    column = input_column(series, CLOCK, 1.0, {}, series.reference())
    scale = series.columns(["K_I"], 1.0)[:, 0]
    # But for the Earth's rate, which is what it is: 1e-5 of the spindle's.
    assert column == pytest.approx(2.0 * scale, abs=3e-5 * np.abs(scale).max())
    assert SITE.gravity == series.trajectory.site.gravity


@pytest.mark.parametrize("size", [7, 64])
def test_blocks_with_sign_change_have_mean_of_samples(size):
    """Compare with signs and magnitudes of single samples."""
    # No sample is at the zero of a_I itself.
    spindle, observable = Spindle(2.0, start_angle=0.35), "specific_force"
    samples = simulate_series(
        "run",
        2.0,
        {},
        observable=observable,
        revolutions=3,
        per_revolution=64 * size,
        spindle=spindle,
    )
    symbols = ["K_0_asym", "K_I_asym", "K_OQ", "K_I"]
    rows = samples.time.size // size * size
    time = samples.time[:rows].reshape(-1, size)
    exact = samples.columns(symbols, 1.0)[:rows].reshape(-1, size, len(symbols)).mean(axis=1)
    count = np.full(len(time), float(size))
    blocks = replace(samples, time=time.mean(axis=1), time_sd=time.std(axis=1), count=count)
    columns = blocks.columns(symbols, 1.0)
    assert np.any(np.abs(exact[:, 0]) < 0.49 * SITE.gravity)  # in mid-sign
    np.testing.assert_allclose(columns, exact, atol=1e-5 * np.abs(exact).max())
