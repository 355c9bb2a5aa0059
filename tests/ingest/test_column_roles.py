"""Which column of a file is what."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from raising import raises

from counterspin.ingest.column_roles import guess_file, merge_guesses, unit_in_name
from counterspin.ingest.contents import FileColumn, FileContents

TIME = np.arange(1500) * 0.02
RATE = 1.5


def seen(name="a.csv", **columns):
    def column(key, values):
        head, _, unit = key.partition("__")
        return FileColumn(head, unit, np.asarray(values, dtype=float))

    return FileContents(Path(name), tuple(column(k, v) for k, v in columns.items()), (), "")


def signal(rate=RATE, size=2.5, phase=0.0):
    return size * np.cos(rate * TIME + phase) + 1e-3 * TIME**2


def test_roles_of_unnamed_columns_follow_from_values():
    """Columns a, b, c: a wrapped angle in degrees, a signal, the time by its unit."""
    guess = guess_file(seen(a=np.degrees(-RATE * TIME) % 360, b=signal(), c__s=TIME))
    assert (guess.time.column, guess.time.unit) == ("c", "s")
    assert (guess.angle.column, guess.angle.unit, guess.angle.has_file_unit) == ("a", "deg", False)
    assert [s.column for s in guess.signals] == ["b"]
    assert guess.signals[0].observable is None
    assert not guess.is_increasing
    assert guess.rate == pytest.approx(RATE, rel=1e-6)


@pytest.mark.parametrize(
    ("turn", "unit", "counts", "wrapped"),
    [
        (1.0, "rev", None, False),
        (2 * np.pi, "rad", None, True),
        (65536.0, "count", 65536.0, True),
        (36000.0, "count", 36000.0, False),
        (31415.0, "count", None, False),
    ],
)
def test_signal_determines_counts_per_revolution(turn, unit, counts, wrapped):
    angle = RATE * TIME / (2 * np.pi) * turn
    guess = guess_file(seen(t=TIME, enc=angle % turn if wrapped else angle, east_m=signal()))
    assert (guess.angle.unit, guess.angle.per_revolution) == (unit, counts)
    assert guess.rate == pytest.approx(RATE, rel=1e-3)


def test_unit_in_name_contradicting_values_is_ignored():
    guess = guess_file(seen(t=TIME, angle_rad=np.degrees(RATE * TIME), east_m=signal()))
    assert guess.angle.unit == "deg"


def test_pulses_are_times_per_revolution():
    pulses = np.full(TIME.size, np.nan)
    pulses[:7] = np.arange(7) * 2 * np.pi / RATE
    guess = guess_file(seen(t=TIME, index=pulses, temperature=20 + 0 * TIME, east_m=signal()))
    assert (guess.angle.column, guess.angle.pulses, guess.angle.unit) == ("index", True, "s")
    assert guess.signals[0].phase == pytest.approx(0.0, abs=0.01)
    assert guess.unused_columns == ()
    assert guess.temperature == ("temperature", "degC")


def test_temperature_column_can_be_chosen_or_omitted():
    contents = seen(t=TIME, temp_in=20 + 0 * TIME, temp_out=25 + 0 * TIME, east_m=signal())
    answers = {"temp_in is": "unused"}
    assert guess_file(contents, {}).temperature[0] == "temp_in"
    assert guess_file(contents, answers).temperature[0] == "temp_out"
    assert guess_file(contents, {"temp_out is": "temperature"}).temperature[0] == "temp_out"
    assert guess_file(contents, answers | {"temp_out is": "unused"}).temperature is None


def test_rows_are_counted_without_time():
    guess = guess_file(seen(angle=RATE * TIME, east_m=signal()))
    assert guess.time is None
    assert guess.rate == pytest.approx(RATE * 0.02)


def test_unit_after_slash_is_recognised():
    """DIN 1313 writes the header `t/s`."""
    guess = guess_file(seen(**{"t/s": TIME, "east_m": signal(), "angle_rad": RATE * TIME}))
    assert (guess.time.column, guess.time.unit) == ("t/s", "s")


def test_first_increasing_unnamed_column_is_time():
    guess = guess_file(seen(a=TIME, b=np.degrees(RATE * TIME) % 360, c=signal()))
    assert (guess.time.column, guess.time.unit, guess.angle.column) == ("a", "s", "b")


@pytest.mark.parametrize(
    ("rate", "factor", "unit"),
    [
        (1.5, 1.0, "s"),
        (1.5, 1e3, "ms"),
        (1.5, 1e6, "us"),
        (1.5, 1e9, "ns"),
        (0.05, 1.0, None),
        (1.5, 1e-3, None),
    ],
)
def test_unit_of_time_follows_from_plausible_rate(rate, factor, unit):
    t = 10.0 * TIME
    guess = guess_file(seen(a=factor * t, b=rate * t, c=2.5 * np.cos(rate * t)))
    assert guess.time.unit == unit


def test_sampling_rate_determines_unit_of_time():
    look = replace(seen(t=1e3 * TIME, east_m=signal()), numbers={"rec.fs": 50.0})
    assert guess_file(look).time.unit == "ms"
    counted = replace(seen(angle=RATE * TIME, east_m=signal()), interval=0.02)
    assert guess_file(counted).sampling_rate == 50.0
    assert guess_file(counted).rate == pytest.approx(RATE)


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("time_s", "s"),
        ("Reading mV", "mV"),
        ("Output, mA", "mA"),
        ("U/mV", "mV"),
        ("Speed 1/min", "1/min"),
        ("mV", "mV"),
        ("out_A", "A"),
        ("sensor A", ""),
        ("drop_ft", "ft"),
        ("volts in", ""),
        ("s", ""),
        ("Output", ""),
    ],
)
def test_unit_suffix_of_name_is_recognised(name, unit):
    assert unit_in_name(name) == unit


def test_files_with_different_columns_raise():
    file = guess_file(seen(t=TIME, angle=RATE * TIME, east_m=signal()))
    other = guess_file(seen("b.csv", t=TIME, angle=RATE * TIME, x=signal()))
    with raises("missing-column", "b.csv", "'east_m'", "a.csv"):
        merge_guesses([file, other])


def damage(kind, time, angle, east, north):
    """Return the rows after a fault of a recorder."""
    rows = np.arange(time.size)
    if kind == "lost rows":
        keep = rows % 53 != 7
    elif kind == "gap":
        keep = (time < 8.0) | (time > 11.3)
    elif kind == "repeated rows":
        rows = np.sort(np.concatenate([rows, rows[::37]]))
        return tuple(values[rows] for values in (time, angle, east, north))
    elif kind == "held values":
        held = rows - np.where(rows % 100 < 3, rows % 100, 0)
        return time, angle[held], east[held], north[held]
    else:
        return time, angle + 0.1 * (rows % 71 == 5), east, north
    return tuple(values[keep] for values in (time, angle, east, north))


@pytest.mark.parametrize("wrap", [None, 2 * np.pi])
@pytest.mark.parametrize("kind", ["lost rows", "gap", "repeated rows", "held values", "outliers"])
def test_angle_with_faulty_rows_keeps_unit_rate_and_phase(kind, wrap):
    time, angle, east, north = damage(kind, TIME, RATE * TIME, signal(), signal(phase=-np.pi / 2))
    angle = angle if wrap is None else angle % wrap
    guess = guess_file(seen(time_s=time, angle_rad=angle, east_m=east, north_m=north))
    assert guess.time.column == "time_s"
    assert guess.angle is not None
    assert guess.angle.unit == "rad"
    assert guess.rate == pytest.approx(RATE, rel=1e-3)
    assert [s.phase for s in guess.signals] == pytest.approx([0.0, -np.pi / 2], abs=0.03)


def test_lost_rows_without_gap_in_time_leave_unit_of_angle():
    """The rows are numbered without a gap, so the signals suggest 6.1 rad per revolution."""
    kept = np.delete(np.arange(TIME.size), slice(700, 750))
    count = kept.size
    guess = guess_file(
        seen(
            time_s=TIME[:count],
            angle_rad=(RATE * TIME)[kept],
            east_m=signal()[kept],
            north_m=signal(phase=-np.pi / 2)[kept],
        )
    )
    assert (guess.angle.unit, guess.angle.per_revolution) == ("rad", None)


def test_slight_slowdown_during_gap_is_not_a_wrap():
    time = np.delete(TIME, slice(400, 565))
    angle = RATE * time - 0.04 * (time > 8.0)
    assert guess_file(seen(time_s=time, angle=angle)).angle.period is None


@pytest.mark.parametrize("kind", ["dropout", "repeats"])
def test_faulty_signal_leaves_its_phase(kind):
    """The phase determines the zero of the encoder in the description."""
    rows = np.arange(TIME.size)
    east = signal() + 50.0
    if kind == "dropout":
        east[600:640] = 0.0
    else:
        east = east[rows // 3 * 3]
    guess = guess_file(seen(time_s=TIME, angle_rad=RATE * TIME, east_m=east))
    assert guess.signals[0].phase == pytest.approx(0.0, abs=2e-3)
