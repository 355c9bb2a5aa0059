"""Residual traces of a fit, complete and thinned."""

import numpy as np
import polars as pl
import pytest
from campaigns import SMALL, replace_parts, write_description
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ndtri

from counterspin.calibration.calibrate import calibrate
from counterspin.calibration.pages.traces import (
    _round_digits,
    envelope,
    fold_over_revolution,
    normal_quantiles,
    smoothed_spectrum,
)
from counterspin.calibration.result import Result
from counterspin.inference.diagnostics import periodogram
from counterspin.simulation.simulate import simulate

#: Displaced samples -> displacement, m.
PLANTED = {100: 0.4, 371: -0.25}


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Return results of a clean campaign and of the same campaign with two displaced samples."""
    folder = tmp_path_factory.mktemp("traces")
    # The noise is a tenth of the stated noise.
    description = write_description(
        folder, replace_parts(SMALL, ('"0.01 m"\nangle', '"0.001 m"\nangle'))
    )
    simulate(description, folder / "made")
    clean = calibrate(folder / "made")
    record = folder / "made" / "slow.csv"
    table = pl.read_csv(record)
    east = table["east_m"].to_numpy().copy()
    for row, by in PLANTED.items():
        east[row] += by
    table.with_columns(pl.Series("east_m", east)).write_csv(record)
    times = {float(table["time_s"][row]): by for row, by in PLANTED.items()}
    return clean, calibrate(folder / "made"), times


def test_each_run_and_accelerometer_has_trace(results):
    clean, _, _ = results
    for accelerometer in clean.accelerometers.values():
        assert list(accelerometer.traces) == list(clean.runs)
        for name, trace in accelerometer.traces.items():
            used = clean.runs[name].samples
            assert len(trace.time) == len(trace.low) == len(trace.high) == min(used, 1500)
            assert not trace.left_out


def test_traces_match_residuals(results):
    clean, _, _ = results
    accelerometer = clean.accelerometers["Qx"]
    values = [v for trace in accelerometer.traces.values() for v in (*trace.low, *trace.high)]
    # Chunks of one sample: low and high are the residuals, to four digits.
    short = [t for n, t in accelerometer.traces.items() if clean.runs[n].samples <= 1500]
    assert short
    squares = np.concatenate([np.square(t.low) for t in short])
    n = squares.size
    # Residuals of a good fit have the noise's standard deviation, 1 mm, to 1/sqrt(2n).
    assert np.sqrt(squares.mean()) == pytest.approx(1e-3, rel=4 / np.sqrt(2 * n))
    assert max(map(abs, values)) < 6e-3
    for trace in accelerometer.traces.values():
        power = np.array(trace.spectrum.power)
        assert power.min() > 0.0
        # The stated noise is ten times too large, which the spectrum shows.
        assert np.median(power) < 0.05
        assert trace.quantiles.found == sorted(trace.quantiles.found)
        assert max(trace.quantiles.found) < 1.0
        folded = [mean for mean in trace.by_angle.mean if mean is not None]
        assert max(map(abs, folded)) < 2e-3


def test_outliers_are_rejected_and_marked_at_their_time(results):
    _clean, spoilt, times = results
    shown = dict(spoilt.accelerometers["Qx"].traces["slow"].left_out)
    for (time, residual), (expected, by) in zip(shown.items(), times.items(), strict=True):
        assert time == pytest.approx(expected, rel=1e-5)
        # Within the noise of the sample, 1 mm.
        assert residual == pytest.approx(by, abs=6e-3)
    # The remaining samples are unaffected.
    assert max(map(abs, spoilt.accelerometers["Qx"].traces["slow"].high)) < 6e-3
    assert not spoilt.accelerometers["Qy"].traces["slow"].left_out


def test_result_file_has_one_line_per_list(results, tmp_path):
    clean, _, _ = results
    path = tmp_path / "result.json"
    clean.write(path)
    assert Result.read(path) == clean
    lines = path.read_text().splitlines()
    assert sum(line.lstrip().startswith('"low": [') for line in lines) == 12  # two per trace
    assert len(lines) < 2500


def test_samples_synchronous_with_spindle_leave_no_gap(results):
    # 20 Hz at 1 rev/s: twenty angles; 15 bins have samples, and 30 bins would not.
    clean, _, _ = results
    sizes = {n: len(t.by_angle.mean) for n, t in clean.accelerometers["Qx"].traces.items()}
    assert sizes == {"slow": 60, "middle": 30, "fast": 15}
    for trace in clean.accelerometers["Qx"].traces.values():
        assert None not in trace.by_angle.mean


@pytest.mark.parametrize("digits", [4, 6])
def test_rounding_matches_python_format(digits):
    rng = np.random.default_rng(7)
    values = rng.standard_normal(4000) * 10.0 ** rng.integers(-20, 20, 4000)
    special = [
        0.0,
        -0.0,
        np.nan,
        9.99996,
        999.95,
        1e5,
        1e-5,
        0.000999995,
        -1e3,
        1e-15,
        1e15,
        1e-300,
    ]
    values = np.append(values, special)
    expected = [float(f"{value:.{digits}g}") for value in values]
    np.testing.assert_array_equal(_round_digits(values, digits), expected)


@given(st.integers(1, 300), st.integers(1, 50), st.integers(0, 2**32 - 1))
def test_chunks_cover_all_samples(n, count, seed):
    values = np.random.default_rng(seed).standard_normal(n)
    middle, low, high = envelope(np.arange(n) / 7.0, values, count)
    assert middle.size == min(n, count)
    assert (np.diff(middle) > 0).all()
    assert low.min() == values.min()
    assert high.max() == values.max()


def test_chunk_of_one_sample_equals_sample():
    middle, low, high = envelope(np.array([0.0, 1.0, 5.0]), np.array([3.0, -1.0, 2.0]), 10)
    np.testing.assert_array_equal(middle, [0.0, 1.0, 5.0])
    np.testing.assert_array_equal(low, [3.0, -1.0, 2.0])
    np.testing.assert_array_equal(high, low)


def test_mean_over_angle_bins():
    angle = np.array([0.1, 0.2, 2 * np.pi + 0.3, np.pi + 0.1, -0.1])
    low, mean, high = fold_over_revolution(angle, np.array([1.0, 2.0, 6.0, -4.0, 9.0]), 4)
    np.testing.assert_array_equal(low, [1.0, np.nan, -4.0, 9.0])
    np.testing.assert_array_equal(mean, [3.0, np.nan, -4.0, 9.0])
    np.testing.assert_array_equal(high, [6.0, np.nan, -4.0, 9.0])


def test_angle_rounded_to_full_revolution_is_in_valid_bin():
    low, _, _ = fold_over_revolution(np.array([-1e-20]), np.array([1.0]), 7)
    assert np.flatnonzero(np.isfinite(low)).size == 1


@pytest.mark.parametrize("n", [3, 4, 1000, 20001])
def test_spectrum_satisfies_parseval(n):
    """Parseval: the two-sided powers sum to the sum of squares minus the ends."""
    x = np.random.default_rng(n).standard_normal(n)
    frequency, power, each = smoothed_spectrum(
        periodogram(x), n * 0.5, 10**6
    )  # each line in a separate band
    assert (each == 1).all()
    lines = (n - 1) // 2
    np.testing.assert_allclose(frequency, np.arange(1, lines + 1) / (n * 0.5))
    ends = x.sum() ** 2 / n
    if n % 2 == 0:
        ends += (x * (-1.0) ** np.arange(n)).sum() ** 2 / n
    assert 2 * power.sum() + ends == pytest.approx(x @ x)


def test_spectral_line_is_in_correct_band():
    n, interval, cycles = 4096, 0.02, 200
    x = np.sin(2 * np.pi * cycles * np.arange(n) / n)
    frequency, power, each = smoothed_spectrum(periodogram(x), n * interval, 60)
    assert each.sum() == (n - 1) // 2
    peak = int(np.argmax(power))
    assert frequency[peak] == pytest.approx(cycles / (n * interval), rel=0.1)
    assert np.delete(power, peak).max() < 1e-20


def test_white_noise_has_unit_power():
    n = 100_000
    x = np.random.default_rng(1).standard_normal(n)
    _, power, _ = smoothed_spectrum(periodogram(x), float(n), 10)
    # The last band holds more than half of the n/2 lines, each with standard deviation 1.
    assert power[-1] == pytest.approx(1.0, abs=4.0 / np.sqrt(n / 4))


def test_quantiles_keep_tails_and_use_blom_scores():
    x = np.random.default_rng(2).standard_normal(5000)
    normal, quantiles = normal_quantiles(x, 50)
    assert quantiles[0] == x.min()
    assert quantiles[-1] == x.max()
    assert normal.size <= 50
    ranks = np.searchsorted(np.sort(x), quantiles) + 1
    np.testing.assert_allclose(normal, ndtri((ranks - 0.375) / 5000.25))
    # Few samples: all of them.
    normal, quantiles = normal_quantiles(np.array([2.0, -1.0, 0.5]), 50)
    np.testing.assert_array_equal(quantiles, [-1.0, 0.5, 2.0])
    np.testing.assert_allclose(normal, [-normal[2], 0.0, normal[2]], atol=1e-15)
