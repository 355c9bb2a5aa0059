"""Temperatures in records: the broken line through them, and columns that cannot be used."""

import numpy as np
import polars as pl
import pytest
from raising import raises

from counterspin.errors import RecordError
from counterspin.records.memory import make_memory_table
from counterspin.records.record import ColumnSpec, RecordColumns
from counterspin.records.temperature_profile import MAX_KNOTS, read_temperature_profile

CELSIUS = ColumnSpec("T", unit="degC", target_unit="K", kind="temperature")
TIME = ColumnSpec("t", unit="s", target_unit="s")
T = np.arange(0.0, 400.0, 0.05)


def fit_profile(values, *, time=T, spec=CELSIUS, **columns):
    table = make_memory_table("record", pl.DataFrame({"t": time, "T": values}))
    return read_temperature_profile(table, RecordColumns(TIME, None, {"T": spec}, **columns))


def test_ramp_is_exact():
    profile = fit_profile(20.0 + 0.01 * T)
    assert len(profile) == MAX_KNOTS
    expected = 293.15 + np.linspace(0.0, 0.01 * T[-1], MAX_KNOTS)
    np.testing.assert_allclose(profile, expected, rtol=0, atol=1e-9)


def test_slow_wave_is_followed_through_coarse_resolution():
    """A segment of 6.3 s has an error of h^2/12 |T''| = 7 mK, plus 63 mK/sqrt(36) of rounding."""
    true = 25.0 + 5.0 * np.sin(2.0 * np.pi * T / 300.0)
    result = np.where(np.arange(T.size) % 40 == 0, np.round(true * 16.0) / 16.0, np.nan)
    profile = np.array(fit_profile(result)) - 273.15
    at = np.linspace(0.0, T[-1], MAX_KNOTS)
    assert np.abs(profile - 25.0 - 5.0 * np.sin(2.0 * np.pi * at / 300.0)).max() < 0.07


def test_few_values_have_few_knots():
    values = np.full(T.size, np.nan)
    values[::1000] = 20.0 + T[::1000] / 100.0
    profile = fit_profile(values)
    assert len(profile) == 4
    np.testing.assert_allclose(profile, 293.15 + np.linspace(0.0, T[-1] / 100.0, 4), atol=1e-6)


def test_constant_temperature_is_single_value():
    assert fit_profile(np.full(T.size, 21.0)) == pytest.approx((294.15,))


def test_kelvin_profile_covers_time_range():
    kelvin = ColumnSpec("T", unit="K", target_unit="K", kind="temperature")
    profile = fit_profile(280.0 + 0.1 * T, spec=kelvin, time_range=(100.0, 200.0))
    assert (profile[0], profile[-1]) == pytest.approx((290.0, 300.0))


def test_unit_of_file_is_default(tmp_path):
    file = tmp_path / "r.csv"
    rows = "".join(f"{t},{20 + t}\n" for t in range(40))
    file.write_text(f"t (s),T (°C)\n{rows}", encoding="utf-8")
    time = ColumnSpec("t (s)", target_unit="s")
    spec = ColumnSpec("T (°C)", target_unit="K", kind="temperature")
    temperature_profile = read_temperature_profile(file, RecordColumns(time, None, {"T": spec}))
    assert (temperature_profile[0], temperature_profile[-1]) == pytest.approx((293.15, 332.15))
    file.write_text(f"t (s),T (V)\n{rows}", encoding="utf-8")
    spec = ColumnSpec("T (V)", target_unit="K", kind="temperature")
    with raises("wrong-unit", "'T (V)'", "'V'"):
        read_temperature_profile(file, RecordColumns(time, None, {"T": spec}))


def make_gap(first, last):
    return np.where((first < T) & (last > T), np.nan, 20.0 + 0.01 * T)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (np.full(T.size, np.nan), "column 'T' contains no number in the selected part"),
        (make_gap(100.0, 210.0), "no number from 100 s to 210 s, which is more than a quarter"),
        (make_gap(-1.0, 110.0), "no number from 0 s to 110 s"),
        (make_gap(200.0, 500.0), "no number from 200 s to 399.95 s"),
        (np.where(T[70] == T, np.inf, 20.0), "row 71: column 'T' contains inf K"),
        (
            np.where(T[9] == T, 20020.0, 20.0),
            r"row 10: column 'T' contains 20293.2 K \(20020 degC\)",
        ),
        (-200.0 + 0.01 * T, r"contains 73.15 K \(-200 degC\).*Check the unit"),
    ],
)
def test_invalid_temperature_column_raises(values, words):
    with pytest.raises(RecordError, match=words):
        fit_profile(values)


@pytest.mark.parametrize("infinity", [np.inf, -np.inf])
@pytest.mark.parametrize("row", [0, 1, T.size // 2, T.size - 1])
def test_infinite_time_raises_with_row(row, infinity):
    time = np.where(np.arange(T.size) == row, infinity, T)
    with pytest.raises(RecordError, match=f"row {row + 1}: the time is infinite"):
        fit_profile(20.0 + 0.01 * T, time=time)


def test_profile_is_linear_across_gap():
    profile = fit_profile(make_gap(100.0, 190.0))
    np.testing.assert_allclose(profile, 293.15 + np.linspace(0, 0.01 * T[-1], MAX_KNOTS), atol=1e-6)
