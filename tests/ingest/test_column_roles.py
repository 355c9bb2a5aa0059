"""Which column of a file is what."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from raising import raises

from counterspin.ingest.column_roles import common_guess, guess_file, unit_in_name
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


def test_numbers_tell_what_names_do_not():
    """Columns a, b, c: a wrapped angle in degrees, a signal, the time by its unit."""
    guess = guess_file(seen(a=np.degrees(-RATE * TIME) % 360, b=signal(), c__s=TIME))
    assert (guess.time.column, guess.time.unit) == ("c", "s")
    assert (guess.angle.column, guess.angle.unit, guess.angle.known) == ("a", "deg", False)
    assert [s.column for s in guess.signals] == ["b"]
    assert guess.signals[0].observable is None
    assert not guess.rising
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
def test_the_signal_shows_what_a_revolution_of_the_encoder_is(turn, unit, counts, wrapped):
    angle = RATE * TIME / (2 * np.pi) * turn
    guess = guess_file(seen(t=TIME, enc=angle % turn if wrapped else angle, east_m=signal()))
    assert (guess.angle.unit, guess.angle.per_revolution) == (unit, counts)
    assert guess.rate == pytest.approx(RATE, rel=1e-3)


def test_a_name_that_the_numbers_contradict_is_not_believed():
    guess = guess_file(seen(t=TIME, angle_rad=np.degrees(RATE * TIME), east_m=signal()))
    assert guess.angle.unit == "deg"


def test_pulses_are_times_once_a_revolution():
    pulses = np.full(TIME.size, np.nan)
    pulses[:7] = np.arange(7) * 2 * np.pi / RATE
    guess = guess_file(seen(t=TIME, index=pulses, temperature=20 + 0 * TIME, east_m=signal()))
    assert (guess.angle.column, guess.angle.pulses, guess.angle.unit) == ("index", True, "s")
    assert guess.signals[0].phase == pytest.approx(0.0, abs=0.01)
    assert guess.unused == ()
    assert guess.temperature == ("temperature", "degC")


def test_the_column_of_the_temperature_can_be_chosen_or_left_out():
    contents = seen(t=TIME, temp_in=20 + 0 * TIME, temp_out=25 + 0 * TIME, east_m=signal())
    answers = {"temp_in is": "unused"}
    assert guess_file(contents, {}).temperature[0] == "temp_in"
    assert guess_file(contents, answers).temperature[0] == "temp_out"
    assert guess_file(contents, {"temp_out is": "temperature"}).temperature[0] == "temp_out"
    assert guess_file(contents, answers | {"temp_out is": "unused"}).temperature is None


def test_without_a_time_rows_are_counted():
    guess = guess_file(seen(angle=RATE * TIME, east_m=signal()))
    assert guess.time is None
    assert guess.rate == pytest.approx(RATE * 0.02)


def test_a_unit_behind_a_stroke_is_that_of_a_time():
    """As DIN 1313 heads a column, `t/s`."""
    guess = guess_file(seen(**{"t/s": TIME, "east_m": signal(), "angle_rad": RATE * TIME}))
    assert (guess.time.column, guess.time.unit) == ("t/s", "s")


def test_without_names_the_first_of_two_that_advance_is_the_time():
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
def test_the_unit_of_a_time_shows_in_how_fast_a_centrifuge_may_turn(rate, factor, unit):
    t = 10.0 * TIME
    guess = guess_file(seen(a=factor * t, b=rate * t, c=2.5 * np.cos(rate * t)))
    assert guess.time.unit == unit


def test_a_sampling_rate_beside_the_columns_shows_the_unit_of_the_time():
    look = replace(seen(t=1e3 * TIME, east_m=signal()), numbers={"rec.fs": 50.0})
    assert guess_file(look).time.unit == "ms"
    counted = replace(seen(angle=RATE * TIME, east_m=signal()), interval=0.02)
    assert guess_file(counted).sampling == 50.0
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
def test_a_unit_may_stand_at_the_end_of_a_name(name, unit):
    assert unit_in_name(name) == unit


def test_files_that_are_not_alike():
    one = guess_file(seen(t=TIME, angle=RATE * TIME, east_m=signal()))
    other = guess_file(seen("b.csv", t=TIME, angle=RATE * TIME, x=signal()))
    with raises("missing-column", "b.csv", "'east_m'", "a.csv"):
        common_guess([one, other])
