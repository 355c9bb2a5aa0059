"""Tables of readings of a tumble or on an arm: column roles and outputs."""

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
from counterspin.ingest.column_roles import NO_COLUMN, UNUSED_ROLE
from counterspin.ingest.column_values import is_nominal
from counterspin.ingest.contents import FileColumn, FileContents
from counterspin.ingest.questions import AnsweredDraft, FileQuestion, relative_path
from counterspin.records.unit_notation import unit_in_name
from counterspin.units import is_convertible

#: Roles of columns of numbers in every table, and roles of text columns.
ROLES: Final = ("reading", "uncertainty", "temperature", "time", UNUSED_ROLE)
WORD_ROLES: Final = ("name", UNUSED_ROLE)
_UNCERTAINTY_NAME: Final = re.compile(
    r"(?i)((u|unc|sigma|std|stddev|stdev|sd)([^a-z]|$)|.*(uncertain|unsicher|standardabw))"
)
_TEMPERATURE_NAME: Final = re.compile(r"(?i).*(temp|degc|°c)")
_TIME_NAME: Final = re.compile(r"(?i)(t|time|zeit|uhrzeit|stamp|date|datum)([^a-z]|stamp|$)")
_LABEL_NAME: Final = re.compile(
    r"(?i)(name|position|pos|label|stellung|run|point|punkt|messung|(no|nr)([^a-z]|$))"
)
_ROW_NUMBER_NAME: Final = re.compile(r"(?i)(lfd\W*)?(no|nr|number|nummer|#|index|row|zeile)\W*")
#: Largest length of a column that is not checked for row numbers.
_MIN_COUNTED_ROWS: Final = 2
#: Common units of a reading.
_OUTPUT_UNITS: Final = (
    *("mA", "uA", "nA", "A", "V", "mV", "uV", "count", "pulse", "count/s", "pulse/s"),
    *("g", "mg", "ug"),
)


#: Reading at zero force, g, above which it is the zero of the output rather than a bias.
_LARGE_BIAS: Final = 0.3


#: Key and answers of the question about several columns of readings.
COLUMNS_KEY: Final = "columns of readings"
ACCELEROMETERS: Final = "accelerometers"
REPEATS: Final = "repeats"
#: Names of columns of repeats at one setting.
_REPEAT_NAME: Final = re.compile(
    r"(?i)(.*[^a-z])?(reading|repeat|rep|run|pass|trial|sample|cycle|messung|wdh|lauf|ablesung)"
)


@frozen
class OutputEstimate:
    """Estimates of sensitivity and zero of an output, in its unit; NaN: unknown."""

    per_g: float  #: Change of the reading per g along the input axis.
    zero: float  #: Reading at zero specific force.


@frozen
class ReadingsDraft(AnsweredDraft):
    """Draft from a table of readings, with answers."""

    contents: FileContents  #: Contents of the table.
    roles: Mapping[str, str]  #: Column -> role.

    @property
    def files(self) -> list[Path]:
        """The file of the table."""
        return [self.contents.path]

    def make_common_document(
        self,
        folder: Path,
        level_axes: Mapping[str, str],
        columns: Mapping[str, str],
        centrifuge: Mapping[str, Any] | None = None,
    ) -> dict[str, Any]:
        """Make the part of the description that is common to all tables of readings.

        folder: Folder of the campaign.
        level_axes: Axes of the accelerometers in the level attitude.
        columns: Key of a reading -> column, except the outputs.
        centrifuge: Section [centrifuge], if there is one.
        """
        answers, folder = self.complete(), folder.resolve()
        groups = [
            [column.name for column in group]
            for group in group_outputs(self.contents, self.roles, answers)
        ]
        if not groups:
            column_names = ", ".join(column.name for column in self.contents.columns)
            text = (
                f"no column of readings was found (columns: {column_names}); give the answer "
                '"COLUMN is=reading"'
            )
            raise CampaignError("init", [text], code="missing-column")
        has_letters = len(groups) <= len(ascii_uppercase)
        names = [ascii_uppercase[n] if has_letters else f"A{n + 1}" for n in range(len(groups))]
        reading_columns = (group if len(group) > 1 else group[0] for group in groups)
        role_columns: dict[str, Any] = {"reading": dict(zip(names, reading_columns, strict=True))}
        uncertainty_columns = self._columns_with_role("uncertainty")
        if len(uncertainty_columns) == len(groups):
            role_columns["u"] = dict(zip(names, uncertainty_columns, strict=True))
        elif len(uncertainty_columns) == 1:
            role_columns["u"] = dict.fromkeys(names, uncertainty_columns[0])
        role_columns |= {
            role: names_of_role[0]
            for role in ("name", "temperature", "time")
            if (names_of_role := self._columns_with_role(role))
        }
        accelerometers = {}
        for name, (column, *_) in zip(names, groups, strict=True):
            output = {"unit": answers[f"{column} unit"]}
            for key in ("sensitivity", "zero"):
                if (answer_key := f"{column} {key}") in answers:
                    output[key] = answers[answer_key]
            accelerometers[name] = {**level_axes, "output": output}
        return {
            "schema": 1,
            "campaign": {"title": folder.name},
            "site": {"gravity": answers["gravity"], "latitude": answers["latitude"]},
            **({"centrifuge": centrifuge} if centrifuge else {}),
            "accelerometers": accelerometers,
            "readings": {
                "file": relative_path(self.contents.path, folder),
                **self.contents.dialect_keys,
                **({"decimal": ","} if self.contents.decimal == "," else {}),
                "columns": {**columns, **role_columns},
            },
        }

    def _columns_with_role(self, role: str) -> list[str]:
        return [name for name, role_of_column in self.roles.items() if role_of_column == role]


# Guesses


def guess_common_role(column: FileColumn) -> str:
    """Guess the role of a column of numbers in any table, by its name and unit."""
    if column.unit in ("degC", "K") or (
        _TEMPERATURE_NAME.match(column.name) and not column.is_timestamp
    ):
        return "temperature"
    if column.is_timestamp or _TIME_NAME.match(column.name) or is_convertible(column.unit, "s"):
        return "time"
    if _ROW_NUMBER_NAME.fullmatch(column.name) or _is_row_counter(column):
        return UNUSED_ROLE
    if _UNCERTAINTY_NAME.match(column.name):
        return "uncertainty"
    values = column.values[np.isfinite(column.values)]
    is_long = len(values) > _MIN_COUNTED_ROWS
    is_nominal_column = is_nominal(values) and not (column.unit or unit_in_name(column.name))
    # Zero residuals, unused channels and nominal orientations are not measurements.
    return UNUSED_ROLE if is_long and (is_nominal_column or np.ptp(values) == 0.0) else "reading"


def _is_row_counter(column: FileColumn) -> bool:
    """Return whether a column contains row numbers: 1, 2, 3."""
    offsets = column.values - np.arange(len(column.values))
    return (
        not column.unit
        and len(offsets) > _MIN_COUNTED_ROWS
        and set(offsets.tolist()) in ({0.0}, {1.0})
    )


def assign_roles(
    contents: FileContents,
    answers: Mapping[str, str],
    guess_role: Callable[[FileColumn], str],
    unique_roles: Mapping[str, str | None],
) -> dict[str, str]:
    """Return column -> role, including text columns.

    guess_role: Function that guesses the role of a column of numbers.
    unique_roles: Role of at most one column -> likely column, or None.
    """
    name_column = next((name for name in contents.text_columns if _LABEL_NAME.match(name)), None)
    roles = {name: "name" if name == name_column else UNUSED_ROLE for name in contents.text_columns}
    roles |= {column.name: guess_role(column) for column in contents.columns}
    if "reading" not in roles.values():
        # Without readings there is no uncertainty: U is a voltage.
        roles = {name: "reading" if role == "uncertainty" else role for name, role in roles.items()}
    roles |= {name: answers[f"{name} is"] for name in roles if f"{name} is" in answers}
    for unique_role, likely_column in unique_roles.items():
        selected_column = next(
            (name for name in roles if answers.get(f"{name} is") == unique_role), likely_column
        )
        column_name = answers.get(unique_role, selected_column)
        roles = {name: UNUSED_ROLE if role == unique_role else role for name, role in roles.items()}
        if column_name in roles:
            roles[column_name] = unique_role
    return roles


def columns_of_role(
    contents: FileContents, roles: Mapping[str, str], role: str
) -> list[FileColumn]:
    """Return the columns of numbers with a role."""
    return [column for column in contents.columns if roles[column.name] == role]


def group_outputs(
    contents: FileContents, roles: Mapping[str, str], answers: Mapping[str, str]
) -> list[list[FileColumn]]:
    """Return the columns of readings of each accelerometer; several columns are repeats."""
    columns = columns_of_role(contents, roles, "reading")
    if columns and (answers.get(COLUMNS_KEY) or guess_columns_kind(columns)) != ACCELEROMETERS:
        return [columns]
    return [[column] for column in columns]


def guess_columns_kind(columns: Sequence[FileColumn]) -> str:
    """Guess from their names whether columns of readings are accelerometers or repeats."""
    are_repeats = len(columns) > 1 and all(_REPEAT_NAME.match(column.name) for column in columns)
    return REPEATS if are_repeats else ACCELEROMETERS


# Questions and statements


def make_columns_question(columns: Sequence[FileColumn]) -> Iterator[FileQuestion]:
    """Yield the question whether columns of readings are accelerometers or repeats."""
    if len(columns) > 1:
        text = (
            "Do these columns belong to different accelerometers, or are they repeated "
            "readings of one accelerometer?"
        )
        guess = guess_columns_kind(columns)
        yield FileQuestion(COLUMNS_KEY, text, REPEATS, (ACCELEROMETERS, REPEATS), guess)


def make_role_question(
    unique_role: str,
    text: str,
    names: Sequence[str],
    roles: Mapping[str, str],
    *,
    is_required: bool,
) -> FileQuestion:
    """Return the question about the column of a unique role."""
    column_name = next((name for name, role in roles.items() if role == unique_role), None)
    if is_required:
        return FileQuestion(unique_role, text, names[0], tuple(names), column_name)
    return FileQuestion(unique_role, text, NO_COLUMN, (*names, NO_COLUMN), column_name or NO_COLUMN)


def make_column_questions(
    contents: FileContents,
    roles: Mapping[str, str],
    unique_roles: Sequence[str],
    word_roles: Sequence[str] = WORD_ROLES,
) -> Iterator[FileQuestion]:
    """Yield the questions about the roles of the other columns.

    unique_roles: Roles of at most one column, for columns of numbers.
    word_roles: Roles for text columns.
    """
    for name, role in roles.items():
        if role in unique_roles:
            continue
        is_text = name in contents.text_columns
        choices = tuple(word_roles) if is_text else (*unique_roles, *ROLES)
        text = f"What does column '{name}' contain?"
        example = WORD_ROLES[0] if is_text else ROLES[0]
        yield FileQuestion(f"{name} is", text, example, choices, role)


def make_output_questions(
    column: FileColumn, answers: Mapping[str, str], estimate: OutputEstimate
) -> Iterator[FileQuestion]:
    """Yield the questions about unit, sensitivity and zero of a column of readings."""
    name = column.name
    text = f"What is the unit of the readings in column '{name}'?"
    unit = output_unit(column, answers)
    yield FileQuestion(f"{name} unit", text, "mA", _OUTPUT_UNITS, output_unit(column))
    if unit is None or is_convertible(unit, "m/s^2"):
        return
    text = f"What is the nominal sensitivity of column '{name}'?"
    if math.isfinite(estimate.per_g):
        text += f" The data suggest about {estimate.per_g:.4g} {unit}/g."
    yield FileQuestion(f"{name} sensitivity", text, f"1.25 {unit}/g", quantity=f"{unit}/g")
    if abs(estimate.zero) > _LARGE_BIAS * abs(estimate.per_g):
        text = f"What is the nominal reading of column '{name}' at zero specific force?"
        suggestion = f"{estimate.zero:.4g} {unit}"
        yield FileQuestion(f"{name} zero", text, suggestion, guess=suggestion, quantity=unit)


def output_unit(
    column: FileColumn, answers: Mapping[str, str] = MappingProxyType({})
) -> str | None:
    """Return the unit of a column of readings, by answer, file or name; or None."""
    units = (unit for unit in (column.unit, unit_in_name(column.name)) if unit in _OUTPUT_UNITS)
    return answers.get(f"{column.name} unit") or next(units, None)


def make_role_statements(contents: FileContents, roles: Mapping[str, str]) -> Iterator[str]:
    """Yield a statement of the role of each column."""
    for name, role in roles.items():
        yield f"column '{name}': {role}" + (" (text)" if name in contents.text_columns else "")
