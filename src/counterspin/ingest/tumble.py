"""Draft a campaign's description from a table of readings of a multi-position tumble.

The columns of the position and of the readings follow from names, units and numbers. The direction
of the input axis at the position 0 follows from the readings: at rest they are greatest where it
points up.
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
from counterspin.ingest.contents import FileColumn, FileContents, wave
from counterspin.ingest.questions import FileQuestion, place_questions, validate_answers
from counterspin.ingest.readings import (
    OutputEstimate,
    ReadingsDraft,
    columns_of_role,
    output_questions,
    outputs_of,
    part_question,
    role_questions,
    role_statements,
    roles_of,
    several_question,
    usual_role,
)
from counterspin.units import is_convertible, unit_factor

_POSITION: Final = re.compile(r"(?i).*(pos|angle|theta|phi|winkel|stell|attitude|deg(_|$))")
#: Usual units of a position.
_ANGLES: Final = ("deg", "rad", "arcmin", "mrad")
#: Direction of the input axis at 0 -> the angle of the head at which it points up, deg, where the
#: head turns about north, right-handed.
_UP_AT: Final = {"up": 0.0, "west": 90.0, "down": 180.0, "east": -90.0}
#: The pendulous axis where the output axis lies along that of the head, towards the south.
_PENDULOUS: Final = {"up": "west", "west": "down", "down": "east", "east": "up"}
#: An axis is guessed if the wave points there within, deg.
_POINTING: Final = 20.0
#: Fewest and most rows of a table that is guessed to be a tumble's.
_ROWS: Final = (4, 100)
#: It is one if its readings are so nearly, in part of their square, the wave of a revolution.
_WAVE_PART: Final = 0.99


@frozen
class TumbleDraft(ReadingsDraft):
    """The contents of a tumble's table of readings, and a person's answers."""

    @property
    def directions(self) -> list[float]:
        """Directions of the input axis at each position, in deg from up by east; empty: not known.

        Seen from the south, where a head that turns about north turns clockwise.
        """
        said = self.said
        axis, unit, position = (said.get(key) for key in ("axis at 0", "position unit", "position"))
        column = next((c for c in self.contents.columns if c.name == position), None)
        if axis not in _UP_AT or unit not in _ANGLES or column is None:
            return []
        angles = column.values[np.isfinite(column.values)] * unit_factor(unit, "rad")
        turned = np.degrees(angles) - _UP_AT[axis]
        return [float(angle) for angle in turned % 360.0]

    def document(self, folder: Path) -> dict[str, Any]:
        """Return the description made from guesses and answers; CampaignError if one is missing.

        folder: The campaign's.
        """
        said = self.complete()
        axis = said["axis at 0"]
        axes = {"input_axis": axis, "pendulous_axis": _PENDULOUS[axis]}
        document = self.described(folder, axes, {"attitude": said["position"]})
        document["readings"] |= {"about": "north", "attitude_unit": said["position unit"]}
        return document


def tumble_draft(
    all_contents: Sequence[FileContents], answers: Mapping[str, str] | None = None
) -> TumbleDraft:
    """Return a draft from a table of readings, and the open questions.

    answers: By the keys of questions; they take precedence over guesses.
    """
    if len(all_contents) != 1:
        raise UsageError(
            "init", ["the readings of a tumble must be in a single table; give a single file"]
        )
    (contents,) = all_contents

    def asked(taken: Mapping[str, str]) -> tuple[FileQuestion, ...]:
        return tuple(_questions(contents, _roles(contents, taken), taken))

    taken, problems = validate_answers(answers, asked)
    roles, questions = _roles(contents, taken), asked(taken)
    statements = tuple(_statements(contents, roles, questions))
    return TumbleDraft(statements, questions, taken, problems, contents, roles)


def shows_tumble(all_contents: Sequence[FileContents]) -> bool:
    """Return whether files are one short table of readings that follow the positions of a head."""
    if len(all_contents) != 1:
        return False
    (contents,) = all_contents
    roles = _roles(contents, {})
    position = next(iter(columns_of_role(contents, roles, "position")), None)
    readings = columns_of_role(contents, roles, "reading")
    if position is None or not readings or contents.interval is not None:
        return False
    if not _ROWS[0] <= len(position.values) <= _ROWS[1]:
        return False
    # A record of a spindle has times that run evenly, or paths.
    times = columns_of_role(contents, roles, "time")
    if any(map(_is_even, times)) or any(is_convertible(column.unit, "m") for column in readings):
        return False
    angles = position.values * unit_factor(_angle_unit(position), "rad")
    return all(_follows(angles, column.values) for column in readings)


def _is_even(time: FileColumn) -> bool:
    steps = np.diff(time.values)
    return bool(steps.size and np.ptp(steps) <= 1e-2 * abs(float(np.mean(steps))))


def _follows(angles: Array, values: Array) -> bool:
    """Return whether values are a constant plus the wave of a revolution; angles in rad."""
    good = np.isfinite(angles) & np.isfinite(values)
    design = np.column_stack([np.cos(angles), np.sin(angles), np.ones(angles.size)])[good]
    y = values[good]
    if y.size <= design.shape[1]:
        return False
    rest = y - design @ np.linalg.lstsq(design, y, rcond=None)[0]
    total = float(np.sum((y - y.mean()) ** 2))
    return total > 0.0 and float(np.sum(rest**2)) <= (1.0 - _WAVE_PART) * total


# What is guessed


def _roles(contents: FileContents, answers: Mapping[str, str]) -> dict[str, str]:
    """Return the role of each column."""
    found = [column for column in contents.columns if _role(column) == "position"]
    found.sort(key=lambda column: not is_convertible(column.unit, "rad"))
    return roles_of(contents, answers, _role, {"position": found[0].name if found else None})


def _role(column: FileColumn) -> str:
    usual = usual_role(column)
    may_be = _POSITION.match(column.name) or is_convertible(column.unit, "rad")
    return "position" if usual == "reading" and may_be else usual


def _angle_unit(column: FileColumn) -> str:
    if is_convertible(column.unit, "rad"):
        return column.unit
    return "deg" if np.nanmax(np.abs(column.values)) > 7.0 else "rad"


def _axis(angles: Array, values: Array) -> str | None:
    """Return the input axis's direction at 0, for readings at angles in rad; None if unclear."""
    up_at = -math.degrees(wave(angles, values, degree=0)[1])
    for axis, angle in _UP_AT.items():
        if abs(math.remainder(up_at - angle, 360.0)) < _POINTING:
            return axis
    return None


# What is asked, and said


def _questions(
    contents: FileContents, roles: Mapping[str, str], answers: Mapping[str, str]
) -> Iterator[FileQuestion]:
    yield from place_questions(contents)
    names = [column.name for column in contents.columns]
    text = "Which column contains the angle of the dividing head?"
    yield part_question("position", text, names, roles, needed=True)
    angles = None
    position = next(iter(columns_of_role(contents, roles, "position")), None)
    if position is not None:
        unit = answers.get("position unit") or _angle_unit(position)
        text = f"What is the unit of the position column '{position.name}'?"
        yield FileQuestion("position unit", text, "deg", _ANGLES, unit, unit="rad")
        angles = position.values * unit_factor(unit, "rad")
    readings = columns_of_role(contents, roles, "reading")
    guess = None
    if angles is not None and readings:
        guess = _axis(angles, readings[0].values)
    text = (
        "In which direction does the input axis point at position 0, if the head rotates about "
        "north?"
    )
    yield FileQuestion("axis at 0", text, "up", tuple(_UP_AT), guess)
    yield from role_questions(contents, roles, ["position"])
    yield from several_question(readings)
    for column, *_ in outputs_of(contents, roles, answers):
        yield from output_questions(column, answers, _sensed(column, angles))


def _sensed(column: FileColumn, angles: Array | None) -> OutputEstimate:
    """Return an estimate of an output from its readings; angles in rad, None: not known yet."""
    if angles is None:
        return OutputEstimate(math.nan, math.nan)
    size, phase = wave(angles, column.values, degree=0)
    return OutputEstimate(size, float(np.nanmean(column.values - size * np.cos(angles + phase))))


def _statements(
    contents: FileContents, roles: Mapping[str, str], questions: Sequence[FileQuestion]
) -> Iterator[str]:
    yield from role_statements(contents, roles)
    axis = next((q.guess for q in questions if q.key == "axis at 0"), None)
    if axis:
        yield (
            f"input axis at position 0: {axis}, determined from the readings as a function of "
            "the angle"
        )
    yield (
        "the head rotates about north (right-handed), and the output axis is parallel to the "
        "axis of the head"
    )
