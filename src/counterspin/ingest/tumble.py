"""Draft a campaign's description from a table of readings of a multi-position tumble.

The columns of position and readings follow from names, units and numbers. The direction of the
input axis at the position 0 follows from the readings, which are largest when it points up.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from counterspin.arrays import Array
from counterspin.errors import UsageError
from counterspin.frozen import frozen
from counterspin.ingest.contents import FileColumn, FileContents, fit_wave
from counterspin.ingest.questions import FileQuestion, make_site_questions, validate_answers
from counterspin.ingest.readings import (
    OutputEstimate,
    ReadingsDraft,
    assign_roles,
    columns_of_role,
    group_outputs,
    guess_common_role,
    make_column_questions,
    make_columns_question,
    make_output_questions,
    make_role_question,
    make_role_statements,
)
from counterspin.units import is_convertible, unit_factor

_POSITION_NAME: Final = re.compile(r"(?i).*(pos|angle|theta|phi|winkel|stell|attitude|deg(_|$))")
#: Units of a position.
_ANGLE_UNITS: Final = ("deg", "rad", "arcmin", "mrad")
#: Direction of the input axis at 0 -> head angle at which it points up, deg, for a right-handed
#: rotation about north.
_UPWARD_ANGLES: Final = {"up": 0.0, "west": 90.0, "down": 180.0, "east": -90.0}
#: Input axis -> pendulous axis, with the output axis towards south, along the axis of the head.
_PENDULOUS_AXES: Final = {"up": "west", "west": "down", "down": "east", "east": "up"}
#: Tolerance of a guessed axis, deg.
_DIRECTION_TOLERANCE: Final = 20.0
#: Smallest and largest numbers of rows of a tumble.
_ROW_RANGE: Final = (4, 100)
#: Smallest fraction of the sum of squares that a sinusoid explains in the readings of a tumble.
_MIN_WAVE_FRACTION: Final = 0.99


@frozen
class TumbleDraft(ReadingsDraft):
    """Draft from a table of readings of a tumble, with answers."""

    @property
    def directions(self) -> list[float]:
        """Direction of the input axis at each position, deg from up towards east; empty: unknown.

        Seen from the south, a head that rotates about north rotates clockwise.
        """
        answers = self.answers_and_guesses
        axis, unit, position = (
            answers.get(key) for key in ("axis at 0", "position unit", "position")
        )
        column = next((column for column in self.contents.columns if column.name == position), None)
        if axis not in _UPWARD_ANGLES or unit not in _ANGLE_UNITS or column is None:
            return []
        angles = column.values[np.isfinite(column.values)] * unit_factor(unit, "rad")
        directions_deg = np.degrees(angles) - _UPWARD_ANGLES[axis]
        return [float(angle) for angle in directions_deg % 360.0]

    def make_document(self, folder: Path) -> dict[str, Any]:
        """Make the description from guesses and answers; CampaignError if an answer is missing.

        folder: Folder of the campaign.
        """
        answers = self.complete()
        axis = answers["axis at 0"]
        axes = {"input_axis": axis, "pendulous_axis": _PENDULOUS_AXES[axis]}
        document = self.make_common_document(folder, axes, {"attitude": answers["position"]})
        document["readings"] |= {"about": "north", "attitude_unit": answers["position unit"]}
        return document


def make_tumble_draft(
    all_contents: Sequence[FileContents], answers: Mapping[str, str] | None = None
) -> TumbleDraft:
    """Make a draft from a table of readings of a tumble.

    answers: Key of a question -> answer; takes precedence over guesses.
    """
    if len(all_contents) != 1:
        raise UsageError(
            "init", ["the readings of a tumble must be in a single table; give a single file"]
        )
    (contents,) = all_contents

    def make_questions(valid_answers: Mapping[str, str]) -> tuple[FileQuestion, ...]:
        return tuple(
            _make_questions(contents, _assign_roles(contents, valid_answers), valid_answers)
        )

    valid_answers, problems = validate_answers(answers, make_questions)
    roles, questions = _assign_roles(contents, valid_answers), make_questions(valid_answers)
    statements = tuple(_make_statements(contents, roles, questions))
    return TumbleDraft(statements, questions, valid_answers, problems, contents, roles)


def looks_like_tumble(all_contents: Sequence[FileContents]) -> bool:
    """Return whether the files are a single short table of readings that follow a head angle."""
    if len(all_contents) != 1:
        return False
    (contents,) = all_contents
    roles = _assign_roles(contents, {})
    position = next(iter(columns_of_role(contents, roles, "position")), None)
    readings = columns_of_role(contents, roles, "reading")
    if position is None or not readings or contents.interval is not None:
        return False
    if not _ROW_RANGE[0] <= len(position.values) <= _ROW_RANGE[1]:
        return False
    # A record of a spindle has evenly spaced times, or displacements.
    times = columns_of_role(contents, roles, "time")
    if any(map(_has_even_steps, times)) or any(
        is_convertible(column.unit, "m") for column in readings
    ):
        return False
    angles = position.values * unit_factor(_guess_angle_unit(position), "rad")
    return all(_follows_wave(angles, column.values) for column in readings)


def _has_even_steps(time: FileColumn) -> bool:
    steps = np.diff(time.values)
    return bool(steps.size and np.ptp(steps) <= 1e-2 * abs(float(np.mean(steps))))


def _follows_wave(angles: Array, values: Array) -> bool:
    """Return whether values are a constant plus a sinusoid of the angles, rad."""
    is_valid = np.isfinite(angles) & np.isfinite(values)
    design = np.column_stack([np.cos(angles), np.sin(angles), np.ones(angles.size)])[is_valid]
    y = values[is_valid]
    if y.size <= design.shape[1]:
        return False
    residuals = y - design @ np.linalg.lstsq(design, y, rcond=None)[0]
    sum_of_squares = float(np.sum((y - y.mean()) ** 2))
    return (
        sum_of_squares > 0.0
        and float(np.sum(residuals**2)) <= (1.0 - _MIN_WAVE_FRACTION) * sum_of_squares
    )


# Guesses


def _assign_roles(contents: FileContents, answers: Mapping[str, str]) -> dict[str, str]:
    """Return column -> role."""
    position_columns = [column for column in contents.columns if _guess_role(column) == "position"]
    position_columns.sort(key=lambda column: not is_convertible(column.unit, "rad"))
    return assign_roles(
        contents,
        answers,
        _guess_role,
        {"position": position_columns[0].name if position_columns else None},
    )


def _guess_role(column: FileColumn) -> str:
    common_role = guess_common_role(column)
    is_angle = _POSITION_NAME.match(column.name) or is_convertible(column.unit, "rad")
    return "position" if common_role == "reading" and is_angle else common_role


def _guess_angle_unit(column: FileColumn) -> str:
    if is_convertible(column.unit, "rad"):
        return column.unit
    return "deg" if np.nanmax(np.abs(column.values)) > 7.0 else "rad"


def _guess_axis(angles: Array, values: Array) -> str | None:
    """Return the direction of the input axis at 0 from readings at angles, rad; None if unclear."""
    upward_angle = -math.degrees(fit_wave(angles, values, degree=0)[1])
    for axis, angle in _UPWARD_ANGLES.items():
        if abs(math.remainder(upward_angle - angle, 360.0)) < _DIRECTION_TOLERANCE:
            return axis
    return None


# Questions and statements


def _make_questions(
    contents: FileContents, roles: Mapping[str, str], answers: Mapping[str, str]
) -> Iterator[FileQuestion]:
    yield from make_site_questions(contents)
    names = [column.name for column in contents.columns]
    text = "Which column contains the angle of the dividing head?"
    yield make_role_question("position", text, names, roles, is_required=True)
    angles = None
    position = next(iter(columns_of_role(contents, roles, "position")), None)
    if position is not None:
        unit = answers.get("position unit") or _guess_angle_unit(position)
        text = f"What is the unit of the position column '{position.name}'?"
        yield FileQuestion("position unit", text, "deg", _ANGLE_UNITS, unit, unit="rad")
        angles = position.values * unit_factor(unit, "rad")
    readings = columns_of_role(contents, roles, "reading")
    guess = None
    if angles is not None and readings:
        guess = _guess_axis(angles, readings[0].values)
    text = (
        "In which direction does the input axis point at position 0, if the head rotates about "
        "north?"
    )
    yield FileQuestion("axis at 0", text, "up", tuple(_UPWARD_ANGLES), guess)
    yield from make_column_questions(contents, roles, ["position"])
    yield from make_columns_question(readings)
    for column, *_ in group_outputs(contents, roles, answers):
        yield from make_output_questions(column, answers, _estimate_output(column, angles))


def _estimate_output(column: FileColumn, angles: Array | None) -> OutputEstimate:
    """Estimate sensitivity and zero of an output from readings at angles, rad (None: unknown)."""
    if angles is None:
        return OutputEstimate(math.nan, math.nan)
    amplitude, phase = fit_wave(angles, column.values, degree=0)
    return OutputEstimate(
        amplitude, float(np.nanmean(column.values - amplitude * np.cos(angles + phase)))
    )


def _make_statements(
    contents: FileContents, roles: Mapping[str, str], questions: Sequence[FileQuestion]
) -> Iterator[str]:
    yield from make_role_statements(contents, roles)
    axis = next((question.guess for question in questions if question.key == "axis at 0"), None)
    if axis:
        yield (
            f"input axis at position 0: {axis}, determined from the readings as a function of "
            "the angle"
        )
    yield (
        "the head rotates about north (right-handed), and the output axis is parallel to the "
        "axis of the head"
    )
