"""Draft a campaign's description from a table of readings on the arm of a centrifuge.

A row is a reading at a rate and in a mounting; the arm rests at the rate 0. The direction of the
input axis in a mounting follows from the mounting's name, or else from the readings: an inward axis
measures the acceleration, an outward axis its negative.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from counterspin.campaign.model import MACHINE_TERMS
from counterspin.campaign.quantity import parse_quantity
from counterspin.errors import CampaignError, UsageError
from counterspin.frozen import frozen
from counterspin.ingest.arm_table import DIRECTIONS, HORIZONTAL, ArmTable, parse_direction
from counterspin.ingest.contents import FileColumn, FileContents
from counterspin.ingest.questions import SENSES, FileQuestion, make_site_questions, validate_answers
from counterspin.ingest.readings import (
    WORD_ROLES,
    OutputEstimate,
    ReadingsDraft,
    group_outputs,
    make_column_questions,
    make_columns_question,
    make_output_questions,
    make_role_question,
    make_role_statements,
    output_unit,
)
from counterspin.units import is_convertible

#: Common units of a rate.
_RATE_UNITS: Final = ("rpm", "rev/s", "rad/s", "deg/s", "1/min", "Hz", "s", "ms", "g", "m/s^2")
#: Smallest slope of readings that follow the acceleration, relative to the largest slope.
_MIN_SLOPE_RATIO: Final = 0.5
#: Tolerance of a reading at rest that shows the direction of the input axis, g.
_FORCE_TOLERANCE: Final = 0.3
#: Smallest number of readings at rates to estimate the noise: in total, and per mounting.
_MIN_READINGS: Final = 2
_MIN_READINGS_PER_MOUNTING: Final = 4
#: Largest relative change of the force by the last digit of a rate that is not reported.
_MAX_RATE_STEP: Final = 1e-4
#: Largest number of rows of a table of readings on an arm.
_MAX_ROWS: Final = 500


@frozen
class ArmDraft(ReadingsDraft):
    """Draft from a table of readings on an arm, with answers."""

    def make_document(self, folder: Path) -> dict[str, Any]:
        """Make the description from guesses and answers; CampaignError if an answer is missing.

        folder: Folder of the campaign.
        """
        answers = self.complete()
        table = ArmTable.from_contents(self.contents, self.answers)
        columns = {"rate": answers["rate"]}
        if sense_columns := self._columns_with_role("sense"):
            columns["sense"] = sense_columns[0]
        if table.mounting_column:
            columns["mounting"] = table.mounting_column
        level_axes = {"input_axis": "up", "pendulous_axis": "east"}
        radius, model = _make_radius_and_model(table, answers)
        document = self.make_common_document(folder, level_axes, columns, {"radius": radius})
        readings = document["readings"]
        readings |= {"motion": "arm", "rate_unit": answers["rate unit"]}
        if answers.get("sense", SENSES[0]) != SENSES[0]:
            readings["sense"] = answers["sense"]
        if "u" in answers:
            readings["u"] = answers["u"]
        pendulous = answers["pendulous axis"]
        for key, answer_key in (("axes", "axis"), ("axes_at_rest", "axis at rest")):
            if answer_key in answers:
                readings[key] = _mounting_axes(answers[answer_key], pendulous)
        if table.mountings:
            readings["mountings"] = {
                mounting: _mounting_axes(answers[f"{mounting} axis"], pendulous)
                for mounting in table.mountings
            }
        return document | ({"model": model} if model else {})


def _mounting_axes(axis: str, pendulous: str) -> dict[str, str]:
    """Return the axes of a mounting.

    pendulous: Direction of the pendulous axis with the input axis inward; it rotates with the
        instrument.
    """
    if axis not in HORIZONTAL:
        return {"input": axis, "pendulous": "outward"}
    if pendulous in HORIZONTAL:
        quarter_turns = HORIZONTAL.index(axis) + HORIZONTAL.index(pendulous)
        pendulous = HORIZONTAL[quarter_turns % len(HORIZONTAL)]
    return {"input": axis, "pendulous": pendulous}


def _make_radius_and_model(
    table: ArmTable, answers: Mapping[str, str]
) -> tuple[str, dict[str, Any]]:
    """Return the radius of the centrifuge, and [model] with the radii if there are several."""
    radius_answers = {
        mounting: answers[f"{mounting} radius"]
        for mounting in table.mountings
        if f"{mounting} radius" in answers
    }
    for mounting, mounting_radii in table.radii().items():
        if len(mounting_radii) > 1:
            text = (
                f"the readings of a mounting have {len(mounting_radii)} different "
                f"radii{f' ({mounting})' if mounting else ''}; add a column of mountings to the "
                "table, with a separate name for each radius"
            )
            raise CampaignError("init", [text], code="conflicting-values")
    stated_radii = [answers["radius"]] if "radius" in answers else list(radius_answers.values())
    model: dict[str, Any] = {}
    if len(table.rotating_mountings) > 1 and all(
        parse_quantity(text, "m").u > 0.0 for text in stated_radii
    ):
        # The position of the proof mass differs between mountings.
        model["terms"] = [*MACHINE_TERMS, "centrifuge.radius"]
    if radius_answers:
        model["priors"] = {
            f"centrifuge.radius.{mounting}": text for mounting, text in radius_answers.items()
        }
    return stated_radii[0], model


def make_arm_draft(
    all_contents: Sequence[FileContents], answers: Mapping[str, str] | None = None
) -> ArmDraft:
    """Make a draft from a table of readings on an arm.

    answers: Key of a question -> answer; takes precedence over guesses.
    """
    if len(all_contents) != 1:
        raise UsageError(
            "init", ["readings on an arm must be in a single table; name a single file"]
        )
    (contents,) = all_contents

    def make_questions(valid_answers: Mapping[str, str]) -> tuple[FileQuestion, ...]:
        return tuple(
            _make_questions(ArmTable.from_contents(contents, valid_answers), valid_answers)
        )

    valid_answers, problems = validate_answers(answers, make_questions)
    table = ArmTable.from_contents(contents, valid_answers)
    return ArmDraft(
        tuple(_make_statements(table)),
        make_questions(valid_answers),
        valid_answers,
        problems,
        contents,
        table.roles,
    )


def looks_like_arm(all_contents: Sequence[FileContents]) -> bool:
    """Return whether the files are a single table of outputs with rates."""
    if len(all_contents) != 1 or all_contents[0].rows > _MAX_ROWS:
        return False
    table = ArmTable.from_contents(all_contents[0], {})
    return table.rate_column is not None and bool(table.readings)


# Directions of the input axis


def _direction_from_slope(table: ArmTable, mounting: str) -> str | None:
    """Return ``inward`` or ``outward`` by the slope of a mounting's readings; None if unclear."""
    if not table.readings:
        return None
    slopes, _ = table.fit_lines(table.readings[0], 1.0)
    slope = slopes.get(mounting, math.nan)
    if not abs(slope) > _MIN_SLOPE_RATIO * max(map(abs, slopes.values()), default=math.nan):
        return None
    return "inward" if slope > 0.0 else "outward"


def _mounting_direction(table: ArmTable, mounting: str) -> str | None:
    """Return the direction of the input axis in a mounting, from its name or else its readings."""
    named_direction = parse_direction(mounting)
    # A tangential axis does not measure the acceleration: "forward" then names the mounting.
    return (
        named_direction
        if named_direction in ("inward", "outward")
        else _direction_from_slope(table, mounting) or named_direction
    )


def _direction_at_rest(table: ArmTable, estimate: OutputEstimate, mounting: str) -> str | None:
    """Return the direction of the input axis from the readings at rest; None if unclear."""
    is_resting = table.is_resting & np.array(
        [row_mounting == mounting for row_mounting in table.row_mountings]
    )
    force = (table.values(table.readings[0])[is_resting] - estimate.zero) / estimate.per_g
    for axis, expected_force in (("up", 1.0), ("down", -1.0), ("forward", 0.0)):
        if np.all(np.abs(force - expected_force) < _FORCE_TOLERANCE):
            return axis
    return None


# Questions and statements


def _make_questions(table: ArmTable, answers: Mapping[str, str]) -> Iterator[FileQuestion]:
    contents, roles, readings = table.contents, table.roles, table.readings
    yield from make_site_questions(contents)
    yield from _make_radius_questions(table)
    numeric_names = [column.name for column in contents.columns]
    text = "Which column contains the rate, the period of revolution or the acceleration?"
    yield make_role_question("rate", text, numeric_names, roles, is_required=True)
    if table.rate_column is not None:
        name = table.rate_column.name
        text = f"What is the unit of column '{name}' (a rate, a period or an acceleration)?"
        units = tuple(dict.fromkeys([*_RATE_UNITS, *filter(None, [table.rate_unit])]))
        yield FileQuestion("rate unit", text, "rpm", units, table.rate_unit)
    if "sense" not in roles.values():
        text = "In which sense does the arm rotate at a positive rate, as seen from above?"
        yield FileQuestion("sense", text, SENSES[0], SENSES)
    text = "Which column contains the mounting of the accelerometer?"
    yield make_role_question(
        "position", text, [*numeric_names, *contents.text_cells], roles, is_required=False
    )
    axes = {
        mounting: answers.get(f"{mounting} axis") or _mounting_direction(table, mounting)
        for mounting in table.mountings
    }
    for mounting, axis in axes.items():
        text = f"In which direction does the input axis point in the mounting '{mounting}'?"
        guess = axis
        if axis is None and readings and mounting not in table.rotating_mountings:
            estimate = _estimate_output(table, readings[0], axes, answers)
            guess = _direction_at_rest(table, estimate, mounting)
        yield FileQuestion(f"{mounting} axis", text, "inward", DIRECTIONS, guess)
    if "" in table.rotating_mountings:
        text = "In which direction does the input axis point while the arm rotates?"
        if table.mountings:
            text = "In which direction does the input axis point in rows without a mounting?"
        guess = _direction_from_slope(table, "")
        yield FileQuestion("axis", text, "inward", DIRECTIONS, guess)
        axes[""] = answers.get("axis", guess)
    estimates = {column.name: _estimate_output(table, column, axes, answers) for column in readings}
    if any(
        is_resting and not row_mounting
        for is_resting, row_mounting in zip(table.is_resting, table.row_mountings, strict=True)
    ):
        text = "In which direction does the input axis point at rest in rows without a mounting?"
        guess = _direction_at_rest(table, estimates[readings[0].name], "") if readings else None
        yield FileQuestion("axis at rest", text, "up", DIRECTIONS, guess)
    text = "In which direction does the pendulous axis point when the input axis points inward?"
    choices = ("up", "down", "forward", "backward")
    yield FileQuestion("pendulous axis", text, "up", choices, "up")
    unique_roles = ["rate", "position", "radius"]
    yield from make_column_questions(contents, roles, unique_roles, (*WORD_ROLES, "sense"))
    yield from make_columns_question(readings)
    for column, *_ in group_outputs(contents, roles, answers):
        yield from make_output_questions(column, answers, estimates[column.name])
    if readings and "uncertainty" not in roles.values() and not _can_estimate_noise(table):
        unit = output_unit(readings[0], answers) or "mA"
        text = (
            "What is the standard uncertainty of a reading? The noise cannot be estimated from "
            "so few readings."
        )
        yield FileQuestion("u", text, f"2e-6 {unit}", quantity=unit)


def _can_estimate_noise(table: ArmTable) -> bool:
    """Return whether there are enough readings, at rest and at rates, to estimate the noise."""
    resting_mountings = [
        mounting
        for is_resting, mounting in zip(table.is_resting, table.row_mountings, strict=True)
        if is_resting
    ]
    n_rotating = sum(
        int(table.is_rotating_in(mounting).sum()) for mounting in table.rotating_mountings
    )
    # Each of these adds an unknown slope.
    n_slopes = len({"time", "temperature"} & set(table.roles.values()))
    has_repeats = (
        not resting_mountings or len(resting_mountings) > len(set(resting_mountings)) + n_slopes
    )
    return (
        has_repeats
        and n_rotating
        >= _MIN_READINGS + n_slopes + _MIN_READINGS_PER_MOUNTING * len(table.rotating_mountings)
    )


def _make_radius_questions(table: ArmTable) -> Iterator[FileQuestion]:
    text = "What is the distance from the spindle axis to the proof mass"
    radii = table.radii()
    distinct_radii = {radius for mounting_radii in radii.values() for radius in mounting_radii}
    example = "1.0 ± 1e-3 m"
    if len(distinct_radii) < 2 or set(radii) != set(table.mountings) & set(
        table.rotating_mountings
    ):
        guess = f"{distinct_radii.pop():.12g} m" if len(distinct_radii) == 1 else None
        yield FileQuestion("radius", f"{text}?", example, guess=guess, quantity="m")
        return
    for mounting, mounting_radii in radii.items():
        guess = f"{mounting_radii[0]:.12g} m"
        question = f"{text} in the mounting '{mounting}'?"
        yield FileQuestion(f"{mounting} radius", question, example, guess=guess, quantity="m")


def _estimate_output(
    table: ArmTable, column: FileColumn, axes: Mapping[str, str | None], answers: Mapping[str, str]
) -> OutputEstimate:
    """Estimate sensitivity and zero of an output from rates and readings.

    axes: Mounting -> direction of the input axis; None: unknown.
    """
    keys = ("radius", *(f"{mounting} radius" for mounting in axes))
    stated_radii = [answers[key] for key in keys if key in answers]
    column_radii = [mounting_radii[0] for mounting_radii in table.radii().values()]
    radius = (
        parse_quantity(stated_radii[0], "m").value
        if stated_radii
        else next(iter(column_radii), math.nan)
    )
    slopes, zero = table.fit_lines(column, radius)
    signs = {"inward": 1.0, "outward": -1.0}
    inward_slopes = [
        signs[axis] * slopes[mounting]
        for mounting, axis in axes.items()
        if axis in signs and mounting in slopes
    ]
    return OutputEstimate(float(np.mean(inward_slopes)) if inward_slopes else math.nan, zero)


def _make_statements(table: ArmTable) -> Iterator[str]:
    yield from make_role_statements(table.contents, table.roles)
    if table.rate_column is not None and (rate_step := table.rate_step()) > _MAX_RATE_STEP:
        yield (
            f"column '{table.rate_column.name}' has so few digits that a change in the last digit "
            f"changes the acceleration by {100.0 * rate_step:.1g} %. Give more digits if "
            "available. A stated uncertainty of the readings must include this rounding error. "
            "Without a stated uncertainty, the noise that counterspin estimates includes it"
        )
    n_resting = int(table.is_resting.sum())
    if table.rate_column is not None:
        yield f"{n_resting or 'no'} reading{'' if n_resting == 1 else 's'} at rest (rate 0)"
        if is_convertible(table.rate_unit or "", "m/s^2"):
            yield "accelerations apply at the stated radius; g is the local gravity at the site"
    for mounting in table.mountings:
        named_direction = parse_direction(mounting)
        slope_direction = _direction_from_slope(table, mounting)
        axis = _mounting_direction(table, mounting)
        if axis == named_direction and slope_direction not in (None, named_direction):
            yield (
                f"mounting '{mounting}': {named_direction} according to the name, but "
                f"{slope_direction} according to the readings if the sensitivity is positive"
            )
        elif axis:
            source = "name" if axis == named_direction else "readings"
            yield f"mounting '{mounting}': input axis {axis}, according to the {source}"
    yield (
        "the pendulous axis rotates with the input axis; if the input axis is vertical, the "
        "pendulous axis points outward"
    )
