"""Draft a campaign's description from a table of readings on the arm of a centrifuge.

A row is a reading at a rate and in a mounting. The arm rests at the rate 0. The direction of the
input axis in a mounting follows from the mounting's name, or else from the readings: an axis that
points inward feels the acceleration, one that points outward its negative.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array
from counterspin.campaign.model import TERMS_ON_A_MACHINE
from counterspin.campaign.quantity import parse_quantity
from counterspin.errors import CampaignError, UsageError
from counterspin.frozen import frozen
from counterspin.ingest.contents import FileColumn, FileContents
from counterspin.ingest.questions import (
    SENSES,
    FileQuestion,
    place_questions,
    validate_answers,
)
from counterspin.ingest.readings import (
    WORD_ROLES,
    OutputEstimate,
    ReadingsDraft,
    columns_of_role,
    output_questions,
    output_unit,
    outputs_of,
    part_question,
    role_questions,
    role_statements,
    roles_of,
    several_question,
    usual_role,
)
from counterspin.readings.cells import SENSE_WORDS, mounting_of
from counterspin.records.unit_notation import unit_in_name
from counterspin.units import STANDARD_GRAVITY, is_convertible, unit_factor

#: Directions in the frame of the arm; the horizontal ones as a turn about down passes them.
HORIZONTAL: Final = ("inward", "forward", "outward", "backward")
DIRECTIONS: Final = (*HORIZONTAL, "up", "down")
#: Names of columns of the rate, of the time of a revolution, of mountings and of radii.
_RATE: Final = re.compile(
    r"(?i)(.*[^a-z])?(rate|rpm|omega|w|n|speed|drehzahl|drehrate|drehfrequenz|u.?min|winkelgeschw)([^a-z]|$)"
)
_PERIOD: Final = re.compile(r"(?i).*(period|umlauf|t_?rev|rev_?time)")
_POSITION: Final = re.compile(
    r"(?i).*(pos|mount|orient|side|richtung|direction|lage|einbau|platz|stell|polar|vorzeich|aufspann)"
)
_RADIUS: Final = re.compile(r"(?i)(r|radi[ui]s?|arm|arm_?length|armlänge)([^a-z]|$)")
#: A name of measured values, in contrast to set values.
_MEASURED: Final = re.compile(r"(?i)(.*[^a-z])?(meas|actual|act|ist|gemessen|true)")
#: How the unit of a rate stands at the end of a name -> the unit.
_ENDINGS: Final = {
    r"rpm|u.?min|1.?min|rev.?min": "rpm",
    r"rad.?s": "rad/s",
    r"deg.?s|dps|°.?s": "deg/s",
    r"rev.?s|rps|hz": "rev/s",
}
#: What counts revolutions, as `[readings]` reads it.
_REVOLUTIONS: Final = {"1/min": "rpm", "min^-1": "rpm", "Hz": "rev/s"}
#: Usual units of a rate.
_RATE_UNITS: Final = ("rpm", "rev/s", "rad/s", "deg/s", "1/min", "Hz", "s", "ms", "g", "m/s^2")
#: What stands behind the word of a mounting, in "in 1" and "out, 20 g".
_SUFFIX: Final = re.compile(r"[\s_.,;:#-]*\d*([.,]\d+)?\s*g?$")
#: A mounting's readings follow the acceleration if their slope is this part of the largest slope.
_FOLLOWING_PART: Final = 0.5
#: A reading at rest shows the direction of the input axis within this force, g.
_NEAR: Final = 0.3
#: So many readings at rates show their noise: some, and so many more for each mounting.
_FEWEST: Final = 2
_PER_MOUNTING: Final = 4
#: The last digit of rates is reported if it changes the force by more than this part.
_LARGE_STEP: Final = 1e-4
#: Most rows of a table that is guessed to be one of readings on an arm.
_MOST_ROWS: Final = 500

#: Whether something holds, row by row.
Rows = npt.NDArray[np.bool_]


@frozen(eq=False)
class ArmTable:
    """The columns of a table of readings, with the answers about their units."""

    contents: FileContents
    roles: Mapping[str, str]
    rate: FileColumn | None  #: None: not known yet.
    unit: str | None  #: Of the rate; None: not known yet.
    position: str | None  #: The column of mountings; None: there is none.
    words: tuple[str, ...]  #: The mounting of each row, empty where none is named.

    @classmethod
    def of(cls, contents: FileContents, answers: Mapping[str, str]) -> ArmTable:
        """Return a table with the roles of its columns."""
        roles = arm_roles(contents, answers)
        rate = next(iter(columns_of_role(contents, roles, "rate")), None)
        unit = answers.get("rate unit") or (_rate_unit(rate) if rate else None)
        position = next((name for name, role in roles.items() if role == "position"), None)
        numbers = next((c.values for c in contents.columns if c.name == position), None)
        words: Sequence[str] = contents.words.get(position or "", ())
        if numbers is not None:
            words = ["" if math.isnan(value) else f"{value:.12g}" for value in numbers]
        rows = contents.rows
        words = [*map(mounting_of, words), *[""] * rows][:rows]
        # Remarks below a table have no numbers.
        empty = np.ones(rows, dtype=bool)
        for column in filter(None, [rate, *columns_of_role(contents, roles, "reading")]):
            empty[: len(column.values)] &= np.isnan(column.values)
        named = ("" if none else word for word, none in zip(words, empty, strict=True))
        return cls(contents, roles, rate, unit, position, tuple(named))

    @property
    def readings(self) -> list[FileColumn]:
        """The columns of readings."""
        return columns_of_role(self.contents, self.roles, "reading")

    def values(self, column: FileColumn | None) -> Array:
        """Return a column, NaN in rows without a value."""
        values = np.full(len(self.words), np.nan)
        if column is not None:
            values[: len(column.values)] = column.values
        return values

    @property
    def rests(self) -> Rows:
        """Flag the rows in which the arm rests."""
        return np.asarray(self.values(self.rate) == 0.0)

    @property
    def turning(self) -> tuple[str, ...]:
        """The mountings in which the arm turns."""
        rows = np.flatnonzero(np.nan_to_num(self.values(self.rate)))
        return tuple(dict.fromkeys(self.words[row] for row in rows))

    @property
    def mountings(self) -> tuple[str, ...]:
        """The names of the mountings, at rest too."""
        return tuple(word for word in dict.fromkeys(self.words) if word)

    def turns_in(self, word: str) -> Rows:
        """Flag the rows in which the arm turns in a mounting."""
        return np.array([named == word for named in self.words]) & np.logical_not(self.rests)

    def radii(self) -> dict[str, list[float]]:
        """Return the radii of each mounting from the column, m; empty without one."""
        columns = columns_of_role(self.contents, self.roles, "radius")
        if not columns:
            return {}
        units = (columns[0].unit, unit_in_name(columns[0].name))
        unit = next((unit for unit in units if is_convertible(unit, "m")), "m")
        values = self.values(columns[0]) * unit_factor(unit, "m")
        turns = np.nan_to_num(self.values(self.rate)) != 0.0
        found: dict[str, dict[float, None]] = {}
        for row in np.flatnonzero(turns & np.isfinite(values)).tolist():
            found.setdefault(self.words[row], {})[float(values[row])] = None
        return {word: list(radii) for word, radii in found.items()}

    def acceleration(self, radius: float) -> Array:
        """Return the centripetal acceleration at a radius, m/s^2, row by row; NaN: not known."""
        unit = _REVOLUTIONS.get(self.unit or "", self.unit or "rad/s")
        size = np.where(self.rests, 1.0, np.abs(self.values(self.rate)))
        if self.unit is None:
            size = size * np.nan
        if is_convertible(unit, "m/s^2"):
            felt = size * unit_factor(unit, "m/s^2", gravity=STANDARD_GRAVITY)
        elif is_convertible(unit, "s"):
            felt = radius * (2.0 * math.pi / (size * unit_factor(unit, "s"))) ** 2
        else:
            felt = radius * (size * unit_factor(unit, "rad/s")) ** 2
        return np.asarray(np.where(self.rests, 0.0, felt))

    def lines(self, column: FileColumn, radius: float) -> tuple[dict[str, float], float]:
        """Return the slope of readings by the acceleration, for each mounting, and their zero.

        Slopes are per g, the zero is the output without acceleration, both in the column's unit;
        empty and NaN where unknown.
        """
        felt, read = self.acceleration(radius) / STANDARD_GRAVITY, self.values(column)
        rows = np.nan_to_num(felt * read) != 0.0
        words = [word for word in self.turning if np.any(rows & self.turns_in(word))]
        if not words:
            return {}, math.nan
        forces = [np.where(self.turns_in(word), felt, 0.0)[rows] for word in words]
        design = np.column_stack([np.ones(rows.sum()), *forces])
        zero, *slopes = np.linalg.lstsq(design, read[rows], rcond=None)[0].tolist()
        return dict(zip(words, slopes, strict=True)), zero

    def rate_step(self) -> float:
        """Return the largest relative change of the force by the last written digit of a rate."""
        rates = self.values(self.rate)
        sizes = np.abs(rates[np.nan_to_num(rates) != 0.0])
        if not len(sizes) or self.unit is None:
            return 0.0
        ends = (Decimal(repr(size)).normalize().as_tuple().exponent for size in sizes.tolist())
        power = 1.0 if is_convertible(self.unit, "m/s^2") else 2.0
        return float(power * 10.0 ** min(map(int, ends)) / sizes.min())


@frozen
class ArmDraft(ReadingsDraft):
    """The contents of a table of readings on an arm, and a person's answers."""

    def document(self, folder: Path) -> dict[str, Any]:
        """Return the description made from guesses and answers; CampaignError if one is missing.

        folder: The campaign's.
        """
        values = self.complete()
        table = ArmTable.of(self.contents, self.answers)
        columns = {"rate": values["rate"]}
        if senses := self._of("sense"):
            columns["sense"] = senses[0]
        if table.position:
            columns["mounting"] = table.position
        level = {"input_axis": "up", "pendulous_axis": "east"}
        radius, model = _radius_and_model(table, values)
        document = self.described(folder, level, columns, {"radius": radius})
        readings = document["readings"]
        readings |= {"motion": "arm", "rate_unit": values["rate unit"]}
        if values.get("sense", SENSES[0]) != SENSES[0]:
            readings["sense"] = values["sense"]
        if "u" in values:
            readings["u"] = values["u"]
        pendulous = values["pendulous axis"]
        for key, answer in (("axes", "axis"), ("axes_at_rest", "axis at rest")):
            if answer in values:
                readings[key] = _axes(values[answer], pendulous)
        if table.mountings:
            readings["mountings"] = {
                word: _axes(values[f"{word} axis"], pendulous) for word in table.mountings
            }
        return document | ({"model": model} if model else {})


def _axes(axis: str, pendulous: str) -> dict[str, str]:
    """Return the axes of a mounting.

    pendulous: Direction of the pendulous axis with the input axis inward; it turns with an
        instrument that is mounted the other way round.
    """
    if axis not in HORIZONTAL:
        return {"input": axis, "pendulous": "outward"}
    if pendulous in HORIZONTAL:
        turned = HORIZONTAL.index(axis) + HORIZONTAL.index(pendulous)
        pendulous = HORIZONTAL[turned % len(HORIZONTAL)]
    return {"input": axis, "pendulous": pendulous}


def _radius_and_model(table: ArmTable, values: Mapping[str, str]) -> tuple[str, dict[str, Any]]:
    """Return the centrifuge's radius, and request estimates of the radii if there are several."""
    radii = {
        word: values[f"{word} radius"] for word in table.mountings if f"{word} radius" in values
    }
    for word, sizes in table.radii().items():
        if len(sizes) > 1:
            text = (
                f"the readings of a mounting have {len(sizes)} different "
                f"radii{f' ({word})' if word else ''}; add a column of mountings to the table, "
                "with a separate name for each radius"
            )
            raise CampaignError("init", [text], code="conflicting-values")
    stated = [values["radius"]] if "radius" in values else list(radii.values())
    model: dict[str, Any] = {}
    if len(table.turning) > 1 and all(parse_quantity(text, "m").u > 0.0 for text in stated):
        # The proof mass is somewhere else in each mounting.
        model["terms"] = [*TERMS_ON_A_MACHINE, "centrifuge.radius"]
    if radii:
        model["priors"] = {f"centrifuge.radius.{word}": text for word, text in radii.items()}
    return stated[0], model


def arm_draft(
    all_contents: Sequence[FileContents], answers: Mapping[str, str] | None = None
) -> ArmDraft:
    """Return a draft from a table of readings on an arm, and the open questions.

    answers: By the keys of questions; they take precedence over guesses.
    """
    if len(all_contents) != 1:
        raise UsageError(
            "init", ["readings on an arm must be in a single table; name a single file"]
        )
    (contents,) = all_contents

    def ask(taken: Mapping[str, str]) -> tuple[FileQuestion, ...]:
        return tuple(_questions(ArmTable.of(contents, taken), taken))

    taken, problems = validate_answers(answers, ask)
    table = ArmTable.of(contents, taken)
    return ArmDraft(tuple(_statements(table)), ask(taken), taken, problems, contents, table.roles)


def shows_arm(all_contents: Sequence[FileContents]) -> bool:
    """Return whether files are one table of outputs with rates."""
    if len(all_contents) != 1 or all_contents[0].rows > _MOST_ROWS:
        return False
    table = ArmTable.of(all_contents[0], {})
    return table.rate is not None and bool(table.readings)


# Roles of columns


def arm_roles(contents: FileContents, answers: Mapping[str, str]) -> dict[str, str]:
    """Return the role of each column."""
    rates = [column for column in contents.columns if _is_rate(column)]
    rates.sort(key=_preference)
    # The time of a revolution, whatever its name, becomes smaller in later rows.
    rates += [c for c in contents.columns if usual_role(c) == "time" and _falls(c)]
    words = [name for name, cells in contents.words.items() if any(map(direction_of, cells))]
    senses = [name for name, cells in contents.words.items() if _are_senses(cells)]
    # Names of mountings repeat, names of rows do not.
    named = [
        name
        for name, cells in contents.words.items()
        if len(set(cells)) < len(cells) and _POSITION.match(name) and name not in senses
    ]
    numbered = [column.name for column in contents.columns if _POSITION.match(column.name)]
    parts = {
        "rate": rates[0].name if rates else None,
        "position": next(iter([*words, *named, *numbered]), None),
    }
    roles = roles_of(contents, answers, _role, parts)
    free = [name for name in senses if roles[name] in WORD_ROLES and f"{name} is" not in answers]
    return roles | dict.fromkeys(free[:1], "sense")


def _preference(column: FileColumn) -> tuple[bool, bool, bool]:
    """Return the rank of a column among the candidates for the rate; the smallest is preferred."""
    period, measured = _PERIOD.match(column.name), _MEASURED.match(column.name)
    return bool(period), not measured, _rate_unit(column) is None


def _falls(column: FileColumn) -> bool:
    """Return whether numbers are smaller in a later row."""
    values = column.values[np.isfinite(column.values)]
    return not column.stamps and bool(np.any(np.diff(values) < 0.0))


def _are_senses(cells: Sequence[str]) -> bool:
    """Return whether cells state the sense of the arm's rotation, row by row."""
    written = {cell.lower() for cell in cells if cell}
    return bool(written) and written <= set(SENSE_WORDS)


def _role(column: FileColumn) -> str:
    if _is_rate(column):
        return "rate"
    usual = usual_role(column)
    if usual != "reading":
        return usual
    if is_convertible(column.unit, "m") or _RADIUS.match(column.name):
        return "radius"
    return "position" if _POSITION.match(column.name) else usual


def _is_rate(column: FileColumn) -> bool:
    """Return whether a column is a rate or the time of a revolution, by its unit or its name."""
    unit = _REVOLUTIONS.get(column.unit, column.unit)
    if _PERIOD.match(column.name):
        return not unit or is_convertible(unit, "s")
    return is_convertible(unit, "rad/s") or bool(not unit and _RATE.match(column.name))


def _rate_unit(column: FileColumn) -> str | None:
    """Return the unit of a rate, from the file or from the end of its name."""
    if column.unit:
        return column.unit
    name = column.name.lower()
    known = [u for end, u in _ENDINGS.items() if re.fullmatch(rf"(.*[^a-z])?({end})", name)]
    wanted = "s" if _PERIOD.match(column.name) else "rad/s"
    units = [_REVOLUTIONS.get(unit, unit) for unit in [*known, unit_in_name(column.name)]]
    either = (wanted,) if _is_rate(column) else ("rad/s", "s")
    return next(
        (unit for unit in units if any(is_convertible(unit, kind) for kind in either)), None
    )


# Directions of the input axis


def direction_of(word: str) -> str | None:
    """Return the direction that a word means; a number may follow it, and a word may precede it."""
    for text in (word, _SUFFIX.sub("", word)):
        if found := _direction(text):
            return found
    parts = (_direction(part) for part in re.split(r"[\W\d_]+", word) if len(part) > 1)
    known = set(filter(None, parts))
    return known.pop() if len(known) == 1 else None


def _direction(text: str) -> str | None:
    try:
        return FileQuestion("axis", "", "", DIRECTIONS).judged(text)
    except ValueError:
        return None


def _follows_acceleration(table: ArmTable, word: str) -> str | None:
    """Return whether a mounting's readings follow the acceleration or its negative."""
    if not table.readings:
        return None
    slopes, _ = table.lines(table.readings[0], 1.0)
    slope = slopes.get(word, math.nan)
    if not abs(slope) > _FOLLOWING_PART * max(map(abs, slopes.values()), default=math.nan):
        return None
    return "inward" if slope > 0.0 else "outward"


def _pointing(table: ArmTable, word: str) -> str | None:
    """Return the direction of the input axis in a mounting, from its name or else its readings."""
    meant = direction_of(word)
    # A tangential axis does not read the acceleration: "forward" is then the way of mounting.
    return meant if meant in ("inward", "outward") else _follows_acceleration(table, word) or meant


def _resting(table: ArmTable, sensed: OutputEstimate, word: str) -> str | None:
    """Return the direction of the input axis where only the readings at rest show it."""
    rows = table.rests & np.array([named == word for named in table.words])
    felt = (table.values(table.readings[0])[rows] - sensed.zero) / sensed.per_g
    for axis, wanted in (("up", 1.0), ("down", -1.0), ("forward", 0.0)):
        if np.all(np.abs(felt - wanted) < _NEAR):
            return axis
    return None


# Questions and statements


def _questions(table: ArmTable, answers: Mapping[str, str]) -> Iterator[FileQuestion]:
    contents, roles, readings = table.contents, table.roles, table.readings
    yield from place_questions(contents)
    yield from _radius_questions(table)
    numbers = [column.name for column in contents.columns]
    text = "Which column contains the rate, the period of revolution or the acceleration?"
    yield part_question("rate", text, numbers, roles, needed=True)
    if table.rate is not None:
        text = (
            f"What is the unit of column '{table.rate.name}' (a rate, a period or an acceleration)?"
        )
        units = tuple(dict.fromkeys([*_RATE_UNITS, *filter(None, [table.unit])]))
        yield FileQuestion("rate unit", text, "rpm", units, table.unit)
    if "sense" not in roles.values():
        text = "In which sense does the arm rotate at a positive rate, as seen from above?"
        yield FileQuestion("sense", text, SENSES[0], SENSES)
    text = "Which column contains the mounting of the accelerometer?"
    yield part_question("position", text, [*numbers, *contents.words], roles, needed=False)
    axes = {w: answers.get(f"{w} axis") or _pointing(table, w) for w in table.mountings}
    for word, axis in axes.items():
        text = f"In which direction does the input axis point in the mounting '{word}'?"
        if axis is None and readings and word not in table.turning:
            axis = _resting(table, _sensed(table, readings[0], axes, answers), word)  # noqa: PLW2901
        yield FileQuestion(f"{word} axis", text, "inward", DIRECTIONS, axis)
    if "" in table.turning:
        text = "In which direction does the input axis point while the arm rotates?"
        if table.mountings:
            text = "In which direction does the input axis point in rows without a mounting?"
        guess = _follows_acceleration(table, "")
        yield FileQuestion("axis", text, "inward", DIRECTIONS, guess)
        axes[""] = answers.get("axis", guess)
    sensed = {column.name: _sensed(table, column, axes, answers) for column in readings}
    if any(rests and not word for rests, word in zip(table.rests, table.words, strict=True)):
        text = "In which direction does the input axis point at rest in rows without a mounting?"
        guess = _resting(table, sensed[readings[0].name], "") if readings else None
        yield FileQuestion("axis at rest", text, "up", DIRECTIONS, guess)
    text = "In which direction does the pendulous axis point when the input axis points inward?"
    choices = ("up", "down", "forward", "backward")
    yield FileQuestion("pendulous axis", text, "up", choices, "up")
    parts = ["rate", "position", "radius"]
    yield from role_questions(contents, roles, parts, (*WORD_ROLES, "sense"))
    yield from several_question(readings)
    for column, *_ in outputs_of(contents, roles, answers):
        yield from output_questions(column, answers, sensed[column.name])
    if readings and "uncertainty" not in roles.values() and not _shows_noise(table):
        unit = output_unit(readings[0], answers) or "mA"
        text = (
            "What is the standard uncertainty of a reading? The noise cannot be estimated from "
            "so few readings."
        )
        yield FileQuestion("u", text, f"2e-6 {unit}", quantity=unit)


def _shows_noise(table: ArmTable) -> bool:
    """Return whether readings show their noise besides the unknowns, at rest and at rates."""
    at_rest = [word for rests, word in zip(table.rests, table.words, strict=True) if rests]
    turning = sum(int(table.turns_in(word).sum()) for word in table.turning)
    # Each of these brings a slope with it, which is unknown too.
    slopes = len({"time", "temperature"} & set(table.roles.values()))
    repeated = not at_rest or len(at_rest) > len(set(at_rest)) + slopes
    return repeated and turning >= _FEWEST + slopes + _PER_MOUNTING * len(table.turning)


def _radius_questions(table: ArmTable) -> Iterator[FileQuestion]:
    text = "What is the distance from the spindle axis to the proof mass"
    radii = table.radii()
    known = {radius for sizes in radii.values() for radius in sizes}
    example = "1.0 ± 1e-3 m"
    if len(known) < 2 or set(radii) != set(table.mountings) & set(table.turning):
        guess = f"{known.pop():.12g} m" if len(known) == 1 else None
        yield FileQuestion("radius", f"{text}?", example, guess=guess, quantity="m")
        return
    for word, sizes in radii.items():
        guess = f"{sizes[0]:.12g} m"
        question = f"{text} in the mounting '{word}'?"
        yield FileQuestion(f"{word} radius", question, example, guess=guess, quantity="m")


def _sensed(
    table: ArmTable,
    column: FileColumn,
    axes: Mapping[str, str | None],
    answers: Mapping[str, str],
) -> OutputEstimate:
    """Return an estimate of an output from rates and readings.

    axes: Mounting -> direction of the input axis, None: not known yet.
    """
    keys = ("radius", *(f"{word} radius" for word in axes))
    stated = [answers[key] for key in keys if key in answers]
    radii = [sizes[0] for sizes in table.radii().values()]
    radius = parse_quantity(stated[0], "m").value if stated else next(iter(radii), math.nan)
    slopes, zero = table.lines(column, radius)
    signs = {"inward": 1.0, "outward": -1.0}
    inward = [
        signs[axis] * slopes[word]
        for word, axis in axes.items()
        if axis in signs and word in slopes
    ]
    return OutputEstimate(float(np.mean(inward)) if inward else math.nan, zero)


def _statements(table: ArmTable) -> Iterator[str]:
    yield from role_statements(table.contents, table.roles)
    if table.rate is not None and (step := table.rate_step()) > _LARGE_STEP:
        yield (
            f"column '{table.rate.name}' has so few digits that a change in the last digit "
            f"changes the acceleration by {100.0 * step:.1g} %. Give more digits if available. "
            "A stated uncertainty of the readings must include this rounding error. Without a "
            "stated uncertainty, the noise that counterspin estimates includes it"
        )
    rests = int(table.rests.sum())
    if table.rate is not None:
        yield f"{rests or 'no'} reading{'' if rests == 1 else 's'} at rest (rate 0)"
        if is_convertible(table.unit or "", "m/s^2"):
            yield "accelerations refer to the stated radius; g is the local gravity of the site"
    for word in table.mountings:
        meant, seen, axis = (
            direction_of(word),
            _follows_acceleration(table, word),
            _pointing(table, word),
        )
        if axis == meant and seen not in (None, meant):
            yield (
                f"mounting '{word}': {meant} according to the name, but {seen} according to "
                "the readings if the sensitivity is positive"
            )
        elif axis:
            source = "according to the name" if axis == meant else "according to the readings"
            yield f"mounting '{word}': input axis {axis}, {source}"
    yield (
        "the pendulous axis turns with the input axis; if the input axis is vertical, the "
        "pendulous axis points outward"
    )
