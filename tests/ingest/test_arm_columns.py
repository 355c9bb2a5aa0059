"""What the columns of a table of readings on an arm show."""

import math

import numpy as np
import pytest

from counterspin.ingest.arm_table import ArmTable, assign_arm_roles, parse_direction
from counterspin.ingest.contents import FileColumn, FileContents


def contents_of(numbers, words=None, units=None):
    """Return a table with columns of numbers and of words."""
    columns = tuple(
        FileColumn(name, (units or {}).get(name, ""), np.array(values, dtype=float))
        for name, values in numbers.items()
    )
    return FileContents(None, columns, tuple(words or ()), "", text_cells=words or {})


def make_arm_table(numbers, words=None, units=None):
    contents = contents_of(numbers, words, units)
    return ArmTable.from_contents(contents, {})


@pytest.mark.parametrize(
    ("word", "direction"),
    [
        ("in", "inward"),
        ("In 2", "inward"),
        ("out, 20 g", "outward"),
        ("innen", "inward"),
        ("AUSSEN", "outward"),
        ("nach außen", "outward"),
        ("tangential", "forward"),
        ("IA up", "up"),
        ("radial innen, 3", "inward"),
        ("in or out", None),
        ("mount d", None),
        ("rückwärts", "backward"),
        ("oben", "up"),
        ("unten 1", "down"),
        ("north", None),
        ("A", None),
        ("index", None),
        ("", None),
    ],
)
def test_words_are_recognised_as_directions(word, direction):
    assert parse_direction(word) == direction


@pytest.mark.parametrize(
    ("name", "unit", "rate"),
    [
        ("rate_rpm", "", "rpm"),
        ("U/min", "", "rpm"),
        ("omega [rad/s]", "rad/s", "rad/s"),
        ("Drehzahl", "1/min", "1/min"),
        ("n", "", None),
        ("period_ms", "", "ms"),
        ("Umlaufzeit", "s", "s"),
        ("Drehrate in °/s", "", "deg/s"),
        ("rate_s", "", None),
        ("speed, Hz", "", "rev/s"),
        ("T_rev_s", "", "s"),
        ("Drehfrequenz", "Hz", "Hz"),
    ],
)
def test_rate_column_and_unit_are_found(name, unit, rate):
    arm_table = make_arm_table({"out_V": [1.0, 2.0], name: [30.0, 40.0]}, units={name: unit})
    assert arm_table.rate_column.name == name
    assert arm_table.rate_unit == rate


def test_acceleration_is_rate_only_by_answer():
    numbers = {"accel_g": [1.0, 2.0], "n_rpm": [30.0, 42.0], "out_V": [1.0, 2.0]}
    contents = contents_of(numbers)
    assert assign_arm_roles(contents, {}) == {
        "accel_g": "reading",
        "n_rpm": "rate",
        "out_V": "reading",
    }
    assert assign_arm_roles(contents, {"rate": "accel_g"})["accel_g"] == "rate"


def test_measured_rate_and_known_unit_are_preferred():
    numbers = {"N": [100.0, 99.0], "set_rpm": [30.0, 40.0], "rpm actual": [30.1, 40.2]}
    assert make_arm_table({**numbers, "out_V": [1.0, 2.0]}).rate_column.name == "rpm actual"
    del numbers["rpm actual"]
    assert make_arm_table({**numbers, "out_V": [1.0, 2.0]}).rate_column.name == "set_rpm"


def test_decreasing_time_is_period():
    arm_table = make_arm_table({"T_s": [0.0, 2.0, 1.5], "out_V": [1.0, 2.0, 3.0]})
    assert (arm_table.rate_column.name, arm_table.rate_unit) == ("T_s", "s")
    assert make_arm_table({"T_s": [0.0, 1.5, 2.0], "out_V": [1.0, 2.0, 3.0]}).rate_column is None
    clock = make_arm_table({"n_rpm": [0.0, 30.0], "t_s": [9.0, 2.0], "out_V": [1.0, 2.0]})
    assert clock.roles["t_s"] == "time"


def test_mounting_column_is_found_by_words_or_name():
    numbers = {"n_rpm": [30.0, 30.0, 42.0, 42.0], "out_V": [1.0, -1.0, 2.0, -2.0]}
    words = {"note": ["first", "second", "third", "last"], "where": ["in", "out", "in", "out"]}
    assert make_arm_table(numbers, words).mounting_column == "where"
    remark = {"where": ["in", "out", "in", "out", "by J. D."]}
    below = make_arm_table({name: [*own, math.nan] for name, own in numbers.items()}, remark)
    assert below.mountings == ("in", "out")
    words["where"] = ["A", "B", "A", "B"]
    assert make_arm_table(numbers, words).mounting_column is None
    assert make_arm_table(numbers, {"side": words["where"]}).mounting_column == "side"
    numbered = make_arm_table({**numbers, "mounting": [math.nan, 1.0, 2.0, 1.0]})
    assert numbered.row_mountings == ("", "1", "2", "1")


def test_sense_column_is_found_by_words():
    numbers = {"n_rpm": [0.0, 30.0, 42.0], "out_V": [1.0, 1.0, 2.0]}
    words = {"Direction": ["", "CW", "ccw"], "Position": ["up", "in", "in"]}
    contents = contents_of(numbers, words)
    assert assign_arm_roles(contents, {})["Direction"] == "sense"
    assert assign_arm_roles(contents, {})["Position"] == "position"
    assert assign_arm_roles(contents, {"Direction is": "unused"})["Direction"] == "unused"
    assert assign_arm_roles(contents, {"position": "Direction"})["Direction"] == "position"
    words["Direction"][0] = "left"
    assert "sense" not in assign_arm_roles(contents_of(numbers, words), {}).values()


@pytest.mark.parametrize(
    ("name", "values", "step"),
    [
        ("n_rpm", [0.0, 20.0, 40.0], 2.0 * 10.0 / 20.0),
        ("n_rpm", [0.0, 25.0, -40.0], 2.0 / 25.0),
        ("n_rpm", [25.0, 40.125], 2.0 * 1e-3 / 25.0),
        ("n", [1.0, 2.0], 0.0),
    ],
)
def test_rate_step_doubles_relative_resolution(name, values, step):
    arm_table = make_arm_table({name: values, "out_V": [1.0] * len(values)})
    assert arm_table.rate_step() == pytest.approx(step)


def test_rows_are_rotating_or_at_rest():
    numbers = {"n_rpm": [0.0, 30.0, math.nan, -42.0], "out_V": [1.0, 1.2, 0.8, 1.4]}
    arm_table = make_arm_table(numbers, {"side": ["up", "in", "out", "in"]})
    assert arm_table.is_resting.tolist() == [True, False, False, False]
    assert arm_table.rotating_mountings == ("in",)
    assert arm_table.mountings == ("up", "in", "out")
    assert arm_table.is_rotating_in("in").tolist() == [False, True, False, True]
    # A column that ends before the others has nothing in their last rows.
    short = make_arm_table({"n_rpm": [30.0], "out_V": [1.0, 2.0]})
    assert short.rotating_mountings == ("",)


def test_accelerations_and_slopes_match_circular_motion():
    w = np.array([3.0, 6.0])
    felt = 2.0 * w**2 / 9.80665
    numbers = {"omega_rad_s": [0.0, *w, *w], "out_V": [9.0, *(2.5 + 1.25 * felt), *(2.5 - felt)]}
    arm_table = make_arm_table(numbers, {"side": ["up", "in", "in", "out", "out"]})
    slopes, zero = arm_table.fit_lines(arm_table.contents.columns[1], 2.0)
    assert slopes == pytest.approx({"in": 1.25, "out": -1.0})
    assert zero == pytest.approx(2.5)
    assert arm_table.acceleration(2.0) == pytest.approx([0.0, 18.0, 72.0, 18.0, 72.0])
    unknown = make_arm_table({"n": [3.0], "out_V": [1.0]})
    assert math.isnan(unknown.acceleration(2.0)[0])
    assert unknown.fit_lines(unknown.contents.columns[1], 2.0)[0] == {}


def test_radii_are_from_rotating_rows():
    numbers = {"n_rpm": [0.0, 30.0, 30.0, 42.0], "R_mm": [5.0, 1000.0, 900.0, 1000.0]}
    arm_table = make_arm_table({**numbers, "out_V": [1.0] * 4}, {"side": ["up", "in", "out", "in"]})
    assert arm_table.radii() == {"in": [1.0], "out": [0.9]}
    assert make_arm_table({"n_rpm": [30.0], "out_V": [1.0]}).radii() == {}
