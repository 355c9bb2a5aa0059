"""Tables of readings, of a tumble or on an arm: the role of each column, and its readings."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from string import ascii_uppercase
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from counterspin.errors import CampaignError
from counterspin.frozen import frozen
from counterspin.ingest.column_roles import NONE, UNUSED, is_nominal
from counterspin.ingest.contents import FileColumn, FileContents
from counterspin.ingest.questions import AnsweredDraft, FileQuestion, relative_name
from counterspin.records.unit_notation import unit_in_name
from counterspin.units import is_convertible

#: What a column of numbers may be in every table, and a column of words.
ROLES: Final = ("reading", "uncertainty", "temperature", "time", UNUSED)
WORD_ROLES: Final = ("name", UNUSED)
_UNCERTAINTY: Final = re.compile(
    r"(?i)((u|unc|sigma|std|stddev|stdev|sd)([^a-z]|$)|.*(uncertain|unsicher|standardabw))"
)
_TEMPERATURE: Final = re.compile(r"(?i).*(temp|degc|°c)")
_TIME: Final = re.compile(r"(?i)(t|time|zeit|uhrzeit|stamp|date|datum)([^a-z]|stamp|$)")
_NAME: Final = re.compile(
    r"(?i)(name|position|pos|label|stellung|run|point|punkt|messung|(no|nr)([^a-z]|$))"
)
_NUMBER: Final = re.compile(r"(?i)(lfd\W*)?(no|nr|number|nummer|#|index|row|zeile)\W*")
#: More numbers than so many that rise by one count rows.
_FEWEST_COUNTED: Final = 2
#: Usual units of a reading.
_OUTPUTS: Final = (
    *("mA", "uA", "nA", "A", "V", "mV", "uV", "count", "pulse", "count/s", "pulse/s"),
    *("g", "mg", "ug"),
)


#: What is read without any force, g, above which it is no bias, but the zero of the output.
_LARGE_BIAS: Final = 0.3


#: What several columns of readings are, and the key by which it is asked.
SEVERAL: Final = "columns of readings"
ACCELEROMETERS: Final = "accelerometers"
REPEATS: Final = "repeats"
#: Names of repeats at one setting.
_REPEAT: Final = re.compile(
    r"(?i)(.*[^a-z])?(reading|repeat|rep|run|pass|trial|sample|cycle|messung|wdh|lauf|ablesung)"
)


@frozen
class OutputEstimate:
    """Estimates of an output from its readings, in its unit; NaN: not known."""

    per_g: float  #: Reading of 1 g along the input axis, less the zero.
    zero: float  #: Reading where no force is felt.


@frozen
class ReadingsDraft(AnsweredDraft):
    """The contents of a table of readings, and a person's answers."""

    contents: FileContents  #: The table.
    roles: Mapping[str, str]  #: Column -> what it is.

    @property
    def files(self) -> list[Path]:
        """The table's file."""
        return [self.contents.path]

    @property
    def said(self) -> dict[str, str]:
        """Guesses, overruled by the available answers."""
        guessed = {q.key: q.guess for q in self.questions if q.guess is not None}
        return guessed | dict(self.answers)

    def described(
        self,
        folder: Path,
        axes: Mapping[str, str],
        columns: Mapping[str, str],
        machine: Mapping[str, Any] | None = None,
    ) -> dict[str, Any]:
        """Return the part of the description that all tables of readings share.

        folder: The campaign's.
        axes: The axes of the accelerometers in the level attitude.
        columns: Key of a reading -> column, except those of the outputs.
        machine: The centrifuge's table, if there is one.
        """
        said, place = self.complete(), folder.resolve()
        readings = [
            [column.name for column in columns_of_output]
            for columns_of_output in outputs_of(self.contents, self.roles, said)
        ]
        if not readings:
            known = ", ".join(column.name for column in self.contents.columns)
            text = (
                f"no column of readings was found (columns: {known}); give the answer "
                '"COLUMN is=reading"'
            )
            raise CampaignError("init", [text], code="missing-column")
        few = len(readings) <= len(ascii_uppercase)
        names = [ascii_uppercase[n] if few else f"A{n + 1}" for n in range(len(readings))]
        written = (
            columns_of_output if len(columns_of_output) > 1 else columns_of_output[0]
            for columns_of_output in readings
        )
        given: dict[str, Any] = {"reading": dict(zip(names, written, strict=True))}
        beside = self._of("uncertainty")
        if len(beside) == len(readings):
            given["u"] = dict(zip(names, beside, strict=True))
        elif len(beside) == 1:
            given["u"] = dict.fromkeys(names, beside[0])
        given |= {
            role: names_of_role[0]
            for role in ("name", "temperature", "time")
            if (names_of_role := self._of(role))
        }
        outputs = {}
        for name, (column, *_) in zip(names, readings, strict=True):
            output = {"unit": said[f"{column} unit"]}
            for key in ("sensitivity", "zero"):
                if (asked := f"{column} {key}") in said:
                    output[key] = said[asked]
            outputs[name] = {**axes, "output": output}
        return {
            "schema": 1,
            "campaign": {"title": place.name},
            "site": {"gravity": said["gravity"], "latitude": said["latitude"]},
            **({"centrifuge": machine} if machine else {}),
            "accelerometers": outputs,
            "readings": {
                "file": relative_name(self.contents.path, place),
                **self.contents.dialect_keys,
                **({"decimal": ","} if self.contents.decimal == "," else {}),
                "columns": {**columns, **given},
            },
        }

    def _of(self, role: str) -> list[str]:
        return [name for name, role_of_column in self.roles.items() if role_of_column == role]


# What is guessed


def usual_role(column: FileColumn) -> str:
    """Return the role of a column of numbers in any table, by its name and unit."""
    if column.unit in ("degC", "K") or (_TEMPERATURE.match(column.name) and not column.stamps):
        return "temperature"
    if column.stamps or _TIME.match(column.name) or is_convertible(column.unit, "s"):
        return "time"
    if _NUMBER.fullmatch(column.name) or _counts_rows(column):
        return UNUSED
    if _UNCERTAINTY.match(column.name):
        return "uncertainty"
    values = column.values[np.isfinite(column.values)]
    many = len(values) > _FEWEST_COUNTED
    nominal = is_nominal(values) and not (column.unit or unit_in_name(column.name))
    # Residuals of zero, channels that are not used, and nominal orientations are no measurements.
    return UNUSED if many and (nominal or np.ptp(values) == 0.0) else "reading"


def _counts_rows(column: FileColumn) -> bool:
    """Return whether a column has the numbers of rows or tests: 1, 2, 3."""
    steps = column.values - np.arange(len(column.values))
    return (
        not column.unit and len(steps) > _FEWEST_COUNTED and set(steps.tolist()) in ({0.0}, {1.0})
    )


def roles_of(
    contents: FileContents,
    answers: Mapping[str, str],
    guess: Callable[[FileColumn], str],
    parts: Mapping[str, str | None],
) -> dict[str, str]:
    """Return the role of each column, of words too.

    guess: The role of a column of numbers.
    parts: Role of a single column -> the likely column, None without one.
    """
    named = next((name for name in contents.others if _NAME.match(name)), None)
    roles = {name: "name" if name == named else UNUSED for name in contents.others}
    roles |= {column.name: guess(column) for column in contents.columns}
    if "reading" not in roles.values():
        # Of nothing there is no uncertainty: U is a voltage then.
        roles = {n: "reading" if role == "uncertainty" else role for n, role in roles.items()}
    roles |= {name: answers[f"{name} is"] for name in roles if f"{name} is" in answers}
    for part, seen in parts.items():
        said = next((name for name in roles if answers.get(f"{name} is") == part), seen)
        taken = answers.get(part, said)
        roles = {name: UNUSED if role == part else role for name, role in roles.items()}
        if taken in roles:
            roles[taken] = part
    return roles


def columns_of_role(
    contents: FileContents, roles: Mapping[str, str], role: str
) -> list[FileColumn]:
    """Return the columns of numbers of a role."""
    return [column for column in contents.columns if roles[column.name] == role]


def outputs_of(
    contents: FileContents, roles: Mapping[str, str], answers: Mapping[str, str]
) -> list[list[FileColumn]]:
    """Return the columns of readings of each accelerometer; several are repeats."""
    columns = columns_of_role(contents, roles, "reading")
    if columns and (answers.get(SEVERAL) or kind_of_columns(columns)) != ACCELEROMETERS:
        return [columns]
    return [[column] for column in columns]


def kind_of_columns(columns: Sequence[FileColumn]) -> str:
    """Return the role of several columns of readings, by their names."""
    repeated = len(columns) > 1 and all(_REPEAT.match(column.name) for column in columns)
    return REPEATS if repeated else ACCELEROMETERS


# Questions and statements


def several_question(columns: Sequence[FileColumn]) -> Iterator[FileQuestion]:
    """Yield the question about the role of several columns of readings."""
    if len(columns) > 1:
        text = (
            "Do these columns belong to different accelerometers, or are they repeated "
            "readings of one accelerometer?"
        )
        guess = kind_of_columns(columns)
        yield FileQuestion(SEVERAL, text, REPEATS, (ACCELEROMETERS, REPEATS), guess)


def part_question(
    part: str, text: str, names: Sequence[str], roles: Mapping[str, str], *, needed: bool
) -> FileQuestion:
    """Return the question about the column of a role that only one can have."""
    known = next((name for name, role in roles.items() if role == part), None)
    if needed:
        return FileQuestion(part, text, names[0], tuple(names), known)
    return FileQuestion(part, text, NONE, (*names, NONE), known or NONE)


def role_questions(
    contents: FileContents,
    roles: Mapping[str, str],
    parts: Sequence[str],
    word_roles: Sequence[str] = WORD_ROLES,
) -> Iterator[FileQuestion]:
    """Yield the questions about the roles of the other columns.

    parts: Roles of a single column, which a column of numbers may have.
    word_roles: Roles that a column of words may have.
    """
    for name, role in roles.items():
        if role in parts:
            continue
        words = name in contents.others
        choices = tuple(word_roles) if words else (*parts, *ROLES)
        text, example = f"What does column '{name}' contain?", WORD_ROLES[0] if words else ROLES[0]
        yield FileQuestion(f"{name} is", text, example, choices, role)


def output_questions(
    column: FileColumn, answers: Mapping[str, str], sensed: OutputEstimate
) -> Iterator[FileQuestion]:
    """Yield the questions about the units of columns of readings."""
    name = column.name
    text = f"What is the unit of the readings in column '{name}'?"
    unit = output_unit(column, answers)
    yield FileQuestion(f"{name} unit", text, "mA", _OUTPUTS, output_unit(column))
    if unit is None or is_convertible(unit, "m/s^2"):
        return
    text = f"What is the nominal sensitivity of column '{name}'?"
    if math.isfinite(sensed.per_g):
        text += f" The data suggest about {sensed.per_g:.4g} {unit}/g."
    yield FileQuestion(f"{name} sensitivity", text, f"1.25 {unit}/g", quantity=f"{unit}/g")
    if abs(sensed.zero) > _LARGE_BIAS * abs(sensed.per_g):
        text = f"What is the nominal reading of column '{name}' at zero specific force?"
        size = f"{sensed.zero:.4g} {unit}"
        yield FileQuestion(f"{name} zero", text, size, guess=size, quantity=unit)


def output_unit(
    column: FileColumn, answers: Mapping[str, str] = MappingProxyType({})
) -> str | None:
    """Return the unit of a column of readings: by an answer, the file, or the end of its name."""
    known = (unit for unit in (column.unit, unit_in_name(column.name)) if unit in _OUTPUTS)
    return answers.get(f"{column.name} unit") or next(known, None)


def role_statements(contents: FileContents, roles: Mapping[str, str]) -> Iterator[str]:
    """Yield a statement of the role of each column."""
    for name, role in roles.items():
        yield f"column '{name}': {role}" + (", in words" if name in contents.others else "")
