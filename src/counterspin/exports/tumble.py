"""From a table of readings of a multi-position tumble to a campaign's description.

Which column is the position and which are readings follows from names, units and numbers. How the
input axis points at the position 0 follows from the readings: at rest they are greatest where it
points up.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from string import ascii_uppercase
from typing import Any, Final

import numpy as np

from counterspin.arrays import Array
from counterspin.errors import CampaignError
from counterspin.exports.guessing import converts
from counterspin.exports.looking import FileColumn, Look
from counterspin.exports.questions import (
    AnsweredExport,
    ExportQuestion,
    place_questions,
    relative_name,
    settled,
)
from counterspin.exports.waves import wave
from counterspin.frozen import frozen
from counterspin.units import unit_factor

#: What a column of a table may be.
ROLES: Final = ("position", "reading", "uncertainty", "temperature", "time", "unused")
_POSITION: Final = re.compile(r"(?i).*(pos|angle|theta|phi|winkel|stell|attitude|deg(_|$))")
_UNCERTAINTY: Final = re.compile(r"(?i)(u|unc|sigma|std|sd|unsicher)([^a-z]|certainty|$)")
_TEMPERATURE: Final = re.compile(r"(?i).*(temp|degc|°c)")
_TIME: Final = re.compile(r"(?i)(t|time|zeit|uhrzeit|stamp|date|datum)([^a-z]|stamp|$)")
_NAME: Final = re.compile(r"(?i)(name|position|pos|no|nr|label|stellung)")
#: Usual units of a reading, and of a position.
_OUTPUTS: Final = ("mA", "uA", "nA", "A", "V", "mV", "uV", "count", "pulse", "g", "mg", "ug")
_ANGLES: Final = ("deg", "rad", "arcmin", "mrad")
#: Direction of the input axis at 0 -> the angle of the head at which it points up, deg, where the
#: head turns about north, right-handed.
_UP_AT: Final = {"up": 0.0, "west": 90.0, "down": 180.0, "east": -90.0}
#: The pendulous axis where the output axis lies along that of the head, towards the south.
_PENDULOUS: Final = {"up": "west", "west": "down", "down": "east", "east": "up"}
#: An axis is guessed if the wave points there within, deg.
_POINTING: Final = 20.0


@frozen
class TumbleDraft(AnsweredExport):
    """What a table of readings shows, and what a person has answered."""

    look: Look  #: The table.
    roles: Mapping[str, str]  #: Column -> what it is, of `ROLES`.

    @property
    def files(self) -> list[Path]:
        """The table's file."""
        return [self.look.path]

    def of(self, role: str) -> list[FileColumn]:
        """Return the columns of a role."""
        return [column for column in self.look.columns if self.roles[column.name] == role]

    @property
    def directions(self) -> list[float]:
        """Where the input axis points at each position, in deg from up by east; empty: not known.

        As it is seen from the south, where a head that turns about north turns clockwise.
        """
        said = {question.key: question.guess for question in self.questions} | dict(self.answers)
        axis, unit, here = (said.get(key) for key in ("axis at 0", "position unit", "position"))
        column = next((c for c in self.look.columns if c.name == here), None)
        if axis not in _UP_AT or unit not in _ANGLES or column is None:
            return []
        angles = column.values[np.isfinite(column.values)] * unit_factor(unit, "rad")
        turned = np.degrees(angles) - _UP_AT[axis]
        return [float(angle) for angle in turned % 360.0]

    def document(self, folder: Path) -> dict[str, Any]:
        """Return the description that guesses and answers make; CampaignError if one is missing.

        folder: The campaign's.
        """
        said = self.complete()
        readings = self.of("reading")
        if not readings:
            known = ", ".join(column.name for column in self.look.columns)
            text = f'no column holds readings (known: {known}); say which: "COLUMN is=reading"'
            raise CampaignError("init", [text])
        few = len(readings) <= len(ascii_uppercase)
        names = [ascii_uppercase[n] if few else f"A{n + 1}" for n in range(len(readings))]
        axis = said["axis at 0"]
        columns: dict[str, Any] = {"attitude": said["position"]}
        if label := _label(self.look):
            columns["name"] = label
        columns["reading"] = {n: c.name for n, c in zip(names, readings, strict=True)}
        beside = [column.name for column in self.of("uncertainty")]
        if len(beside) == len(readings):
            columns["u"] = dict(zip(names, beside, strict=True))
        for role in ("temperature", "time"):
            if own := self.of(role):
                columns[role] = own[0].name
        outputs = {}
        for name, column in zip(names, readings, strict=True):
            unit = said[f"{column.name} unit"]
            sensitivity = said.get(f"{column.name} sensitivity")
            outputs[name] = {
                "input_axis": axis,
                "pendulous_axis": _PENDULOUS[axis],
                "output": {"unit": unit} | ({"sensitivity": sensitivity} if sensitivity else {}),
            }
        place = folder.resolve()
        return {
            "schema": 1,
            "campaign": {"title": place.name},
            "site": {"gravity": said["gravity"], "latitude": said["latitude"]},
            "accelerometers": outputs,
            "readings": {
                "file": relative_name(self.look.path, place),
                **({"sheet": self.look.sheet} if self.look.sheet else {}),
                **({"decimal": ","} if self.look.decimal == "," else {}),
                "columns": columns,
                "about": "north",
                "attitude_unit": said["position unit"],
            },
        }


def tumble_draft(looks: Sequence[Look], answers: Mapping[str, str] | None = None) -> TumbleDraft:
    """Return what a table of readings shows, and what has to be asked.

    answers: By the keys of questions; they stand above what is guessed.
    """
    if len(looks) != 1:
        raise CampaignError("init", ["a tumble is one table of readings: name one file"])
    (look,) = looks

    def asked(taken: Mapping[str, str]) -> tuple[ExportQuestion, ...]:
        return tuple(_questions(look, _roles(look, taken), taken))

    taken, problems = settled(answers, asked)
    roles, questions = _roles(look, taken), asked(taken)
    statements = tuple(_statements(look, roles, questions))
    return TumbleDraft(statements, questions, taken, problems, look, roles)


# What is guessed


def _roles(look: Look, told: Mapping[str, str]) -> dict[str, str]:
    """Return what each column of numbers is."""
    roles = {c.name: told.get(f"{c.name} is") or _role(c) for c in look.columns}
    said = [c.name for c in look.columns if told.get(f"{c.name} is") == "position"]
    position = told.get("position") or next(iter(said), _position(look.columns, roles))
    return {
        name: "position" if name == position else ("unused" if role == "position" else role)
        for name, role in roles.items()
    }


def _role(column: FileColumn) -> str:
    if column.stamps or _TIME.match(column.name) or converts(column.unit, "s"):
        return "time"
    if _TEMPERATURE.match(column.name) or column.unit in ("degC", "K"):
        return "temperature"
    if _UNCERTAINTY.match(column.name):
        return "uncertainty"
    if _POSITION.match(column.name) or converts(column.unit, "rad"):
        return "position"
    return "reading"


def _position(columns: Sequence[FileColumn], roles: Mapping[str, str]) -> str | None:
    """Return the column of the positions: of those that may be it, one whose unit is an angle."""
    found = [column for column in columns if roles[column.name] == "position"]
    found.sort(key=lambda column: not converts(column.unit, "rad"))
    return found[0].name if found else None


def _label(look: Look) -> str | None:
    """Return the column of text that names the positions."""
    return next((name for name in look.others if _NAME.match(name)), None)


def _angle_unit(column: FileColumn) -> str:
    if converts(column.unit, "rad"):
        return column.unit
    return "deg" if np.nanmax(np.abs(column.values)) > 7.0 else "rad"


def _axis(angles: Array, values: Array) -> str | None:
    """Return how the input axis points at 0, for readings at angles in rad; None if unclear."""
    up_at = -math.degrees(wave(angles, values, degree=0)[1])
    for axis, angle in _UP_AT.items():
        if abs(math.remainder(up_at - angle, 360.0)) < _POINTING:
            return axis
    return None


# What is asked, and said


def _questions(
    look: Look, roles: Mapping[str, str], told: Mapping[str, str]
) -> Iterator[ExportQuestion]:
    yield from place_questions(look)
    names = tuple(column.name for column in look.columns)
    position = next((c for c in look.columns if roles[c.name] == "position"), None)
    text = "Which column is the angle of the dividing head?"
    yield ExportQuestion("position", text, names[0], names, position.name if position else None)
    angles = None
    if position is not None:
        unit = told.get("position unit") or _angle_unit(position)
        text = f"In which unit is the position, column '{position.name}'?"
        yield ExportQuestion("position unit", text, "deg", _ANGLES, unit, unit="rad")
        angles = position.values * unit_factor(unit, "rad")
    readings = [column for column in look.columns if roles[column.name] == "reading"]
    guess = None
    if angles is not None and readings:
        guess = _axis(angles, readings[0].values)
    text = "How does the input axis point at the position 0, for a head that turns about north?"
    yield ExportQuestion("axis at 0", text, "up", tuple(_UP_AT), guess)
    for column in look.columns:
        if roles[column.name] != "position":
            text = f"What is column '{column.name}'?"
            guess = roles[column.name]
            yield ExportQuestion(f"{column.name} is", text, "reading", ROLES, guess)
    for column in readings:
        yield from _output_questions(column, told, angles)


def _output_questions(
    column: FileColumn, told: Mapping[str, str], angles: Array | None
) -> Iterator[ExportQuestion]:
    name = column.name
    text = f"In which unit are the readings of column '{name}'?"
    known = column.unit if column.unit in _OUTPUTS else _ending(name)
    yield ExportQuestion(f"{name} unit", text, "mA", _OUTPUTS, known)
    unit = told.get(f"{name} unit") or known
    if unit is None or converts(unit, "m/s^2"):
        return
    size = math.nan if angles is None else wave(angles, column.values, degree=0)[0]
    swing = f" They swing by {size:.4g} {unit}." if math.isfinite(size) else ""
    text = f"What is the nominal sensitivity of column '{name}'?{swing}"
    yield ExportQuestion(f"{name} sensitivity", text, f"1.25 {unit}/g", quantity=f"{unit}/g")


def _ending(name: str) -> str | None:
    """Return the unit at the end of a name, ``reading_mA``."""
    ending = name.rpartition("_")[2] if "_" in name else ""
    return ending if ending in _OUTPUTS else None


def _statements(
    look: Look, roles: Mapping[str, str], questions: Sequence[ExportQuestion]
) -> Iterator[str]:
    rows = max(len(column.values) for column in look.columns)
    yield f"{look.path.name}: {', '.join([f'{rows} rows', *filter(None, [look.found])])}"
    for column in look.columns:
        unit = f" in {column.unit}" if column.unit else ""
        yield f"column '{column.name}': {roles[column.name]}{unit}"
    if label := _label(look):
        yield f"column '{label}': names of the positions"
    axis = next((q.guess for q in questions if q.key == "axis at 0"), None)
    if axis:
        yield f"input axis at the position 0: {axis}, as the readings follow the angle"
    yield "the head turns about north, right-handed, and the output axis lies along its axis"
