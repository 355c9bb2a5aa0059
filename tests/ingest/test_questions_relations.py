"""What signals show together, against circles whose unit, axes and sense are known."""

from itertools import permutations

import numpy as np
import polars as pl
import pytest

from counterspin.ingest.contents import read_files
from counterspin.ingest.description import make_turntable_draft

PLACE = {"gravity": "9.8066 m/s^2", "latitude": "45.75 deg"}
TIME = np.arange(400) * 0.05
RATE = np.pi
#: Compass direction -> the angle of a horizontal axis from east, counterclockwise, rad.
DIRECTIONS = {"east": 0.0, "north": np.pi / 2, "west": np.pi, "south": -np.pi / 2}


def draft_and_questions(path, **answers):
    """Return the draft and the keys of the open questions."""
    all_answers = PLACE | {key.replace("_", " "): answer for key, answer in answers.items()}
    turntable_draft = make_turntable_draft(read_files([path]), all_answers)
    return turntable_draft, [question.key for question in turntable_draft.open_questions]


def write_circle(path, first, second, *, sense=1.0, sizes=(2.5, 2.5), forward=1.0):
    """Write a run whose encoder shows `sense` times the true angle."""
    true = forward * RATE * TIME
    waves = [
        size * np.cos(true - DIRECTIONS[axis])
        for size, axis in zip(sizes, (first, second), strict=True)
    ]
    data = {"t_s": TIME, "angle_rad": sense * true, "a": waves[0], "b": waves[1]}
    pl.DataFrame(data).write_csv(path)
    return path


@pytest.mark.parametrize(("unit", "factor"), [("m", 1.0), ("mm", 1e3), ("cm", 1e2)])
def test_radius_determines_unit_of_displacement(tmp_path, unit, factor):
    path = write_circle(tmp_path / "run.csv", "east", "north", sizes=(2.5 * factor, 2.51 * factor))
    answers = {"a is": "displacement", "b is": "displacement"}
    and_questions, needed = draft_and_questions(path, **answers)
    assert {"a unit", "b unit"} <= set(needed)
    and_questions, needed = draft_and_questions(path, radius="2.5 m", **answers)
    assert {"a unit", "b unit"}.isdisjoint(needed)
    assert [signal.unit for signal in and_questions.common_guess.signals] == [unit, unit]
    assert (
        f"column 'a': displacement in {unit} (determined from the radius), axis not detected"
        in (and_questions.statements)
    )


@pytest.mark.parametrize(
    ("observable", "size", "unit"),
    [
        ("velocity", 2.5 * RATE, "m/s"),
        ("velocity", 2500.0 * RATE, "mm/s"),
        ("specific_force", 2.5 * RATE**2, "m/s^2"),
        ("specific_force", 2.5 * RATE**2 / 9.80665, "g"),
    ],
)
def test_radius_and_rate_determine_unit_of_velocity_or_force(tmp_path, observable, size, unit):
    path = write_circle(tmp_path / "run.csv", "east", "north", sizes=(size, size))
    and_questions, _ = draft_and_questions(
        path, radius="2.5 m", **{"a is": observable, "b is": observable}
    )
    assert [signal.unit for signal in and_questions.common_guess.signals] == [unit, unit]


def test_unit_of_implausible_amplitude_is_asked(tmp_path):
    path = write_circle(tmp_path / "run.csv", "east", "north", sizes=(3.1, 0.31))
    _, needed = draft_and_questions(
        path, radius="2.5 m", **{"a is": "displacement", "b is": "displacement"}
    )
    assert {"a unit", "b unit"} <= set(needed)


@pytest.mark.slow
@pytest.mark.parametrize(("first", "second"), list(permutations(DIRECTIONS, 2)))
@pytest.mark.parametrize("sense", [1.0, -1.0])
@pytest.mark.parametrize("forward", [1.0, -1.0])
def test_sense_and_one_axis_determine_other_axis(tmp_path, first, second, sense, forward):
    path = write_circle(tmp_path / "run.csv", first, second, sense=sense, forward=forward)
    answers = {"a is": "displacement", "b is": "displacement", "radius": "2.5 m"}
    word = {1.0: "counterclockwise", -1.0: "clockwise"}[sense]
    and_questions, needed = draft_and_questions(path, **answers, sense=word)
    assert needed == ["a axis", "b axis"]
    and_questions, needed = draft_and_questions(path, **answers, sense=word, **{"a axis": first})
    assert needed == []
    assert [signal.axis for signal in and_questions.common_guess.signals] == [first, second]


def test_sense_contradicting_waves_is_reported(tmp_path):
    path = write_circle(tmp_path / "run.csv", "east", "north")
    answers = {"a is": "displacement", "b is": "displacement", "radius": "2.5 m"}
    axes = {"a axis": "east", "b axis": "north"}
    and_questions, _ = draft_and_questions(path, **answers, **axes, sense="clockwise")
    (problem,) = and_questions.problems
    assert problem.startswith(
        "sense: the periodic signals of two axes show that the angle increases counterclock"
    )
    and_questions, _ = draft_and_questions(path, **answers, **axes, sense="counterclockwise")
    assert and_questions.problems == ()
