"""Draft a campaign's description from a table of readings on the arm of a centrifuge.

A row is a reading at a rate and in a mounting. The rate is given as such, as the time of a
revolution or as the acceleration; the arm rests at the rate 0. The direction of the input axis in a
mounting follows from the mounting's name, or else from the readings: an axis that points inward
feels the acceleration, one that points outward its negative.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from counterspin.campaign.model import TERMS_ON_A_MACHINE
from counterspin.campaign.quantity import parse
from counterspin.errors import CampaignError
from counterspin.frozen import frozen
from counterspin.ingest.arm_table import (
    ABOVE,
    DIRECTIONS,
    HORIZONTAL,
    MOUNTINGS,
    ArmTable,
    arm_roles,
    as_acceleration,
    below_each_other,
    direction_of,
    kind_of_arm_columns,
    mountings_beside,
)
from counterspin.ingest.column_roles import NONE, STANDARD_GRAVITY, converts
from counterspin.ingest.contents import FileColumn, FileContents
from counterspin.ingest.questions import (
    SENSES,
    FileQuestion,
    place_questions,
    settled,
)
from counterspin.ingest.readings import (
    SEVERAL,
    WORD_ROLES,
    OutputEstimate,
    ReadingsDraft,
    of_role,
    output_questions,
    output_unit,
    outputs_of,
    part_question,
    role_questions,
    several_question,
    table_statements,
)

#: Usual units of a rate.
_RATE_UNITS: Final = ("rpm", "rev/s", "rad/s", "deg/s", "1/min", "Hz", "s", "ms", "g", "m/s^2")
#: A mounting's readings follow the acceleration if by this part of the most that one does.
_FOLLOWING_PART: Final = 0.5
#: A reading at rest shows how the input axis points if it is so near to what it then feels, g.
_NEAR: Final = 0.3
#: So many readings at rates show their noise: some, and so many more for each mounting.
_FEWEST: Final = 2
_OF_A_MOUNTING: Final = 4
#: A last digit of rates is worth telling that changes the force by more than this part.
_LARGE_STEP: Final = 1e-4
#: Accelerations show an arm if there are so many, one of them beyond what gravity can be, g, and
#: readings are so correlated with them.
_FEWEST_LEVELS: Final = 4
_LEAST_LEVEL: Final = 1.5
_IN_ONE_LINE: Final = 0.999
#: Most rows of a table that is guessed to be one of readings on an arm.
_MOST_ROWS: Final = 500


@frozen
class ArmDraft(ReadingsDraft):
    """The contents of a table of readings on an arm, and a person's answers."""

    def document(self, folder: Path) -> dict[str, Any]:
        """Return the description made from guesses and answers; CampaignError if one is missing.

        folder: The campaign's.
        """
        said = self.complete()
        contents, roles = below_each_other(self.contents, self.roles, self.answers)
        table = ArmTable.of(contents, roles, self.answers)
        columns = {"rate": said["rate"]}
        if turning := self._of("sense"):
            columns["sense"] = turning[0]
        if table.position and table.position in self.roles:
            columns["mounting"] = table.position
        level = {"input_axis": "up", "pendulous_axis": "east"}
        radius, model = _radius_and_model(table, said)
        document = self.described(folder, level, columns, {"radius": radius})
        readings = document["readings"]
        readings |= {"motion": "arm", "rate_unit": said["rate unit"]}
        if said.get("empty mounting") == ABOVE:
            readings["merged"] = True
        if said.get("sense", SENSES[0]) != SENSES[0]:
            readings["sense"] = said["sense"]
        if "u" in said:
            readings["u"] = said["u"]
        for key, asked in (("axes", "axis"), ("axes_at_rest", "axis at rest")):
            if asked in said:
                readings[key] = _axes(said[asked], said["pendulous axis"])
        if table.mountings:
            pointing = {word: said[f"{word} axis"] for word in table.mountings}
            readings["mountings"] = {
                word: _axes(axis, said["pendulous axis"]) for word, axis in pointing.items()
            }
        if contents is not self.contents:
            del readings["columns"]["reading"]
            beside = of_role(self.contents, self.roles, "reading")
            spread = of_role(self.contents, self.roles, "uncertainty")
            for place, word in enumerate(mountings_beside(beside)):
                readings["mountings"][word]["reading"] = beside[place].name
                if len(spread) == len(beside):
                    readings["mountings"][word]["u"] = spread[place].name
        return document | ({"model": model} if model else {})


def _axes(axis: str, pendulous: str) -> dict[str, str]:
    """Return the axes of a mounting.

    pendulous: Direction of the pendulous axis with the input axis inward; it turns with an
        instrument that is mounted the other way round.
    """
    if axis not in HORIZONTAL:
        along = "outward"
    elif pendulous in HORIZONTAL:
        turned = HORIZONTAL.index(axis) + HORIZONTAL.index(pendulous)
        along = HORIZONTAL[turned % len(HORIZONTAL)]
    else:
        along = pendulous
    return {"input": axis, "pendulous": along}


def _radius_and_model(table: ArmTable, said: Mapping[str, str]) -> tuple[str, dict[str, Any]]:
    """Return the centrifuge's radius, and request estimates of the radii if there are several."""
    radii = {word: said[f"{word} radius"] for word in table.mountings if f"{word} radius" in said}
    for word, values in table.radii().items():
        if len(values) > 1:
            text = (
                f"readings of one mounting have {len(values)} radii{f' ({word})' if word else ''}; "
                "give each a name of its own in the table, in a column of mountings"
            )
            raise CampaignError("init", [text])
    stated = [said["radius"]] if "radius" in said else list(radii.values())
    model: dict[str, Any] = {}
    if len(table.turning) > 1 and all(parse(text, "m").u > 0.0 for text in stated):
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
        raise CampaignError("init", ["readings on an arm are one table: name one file"])
    (contents,) = all_contents

    def asked(taken: Mapping[str, str]) -> tuple[FileQuestion, ...]:
        return tuple(_questions(contents, arm_roles(contents, taken), taken))

    taken, problems = settled(answers, asked)
    roles = arm_roles(contents, taken)
    statements = tuple(_statements(contents, roles, taken))
    return ArmDraft(statements, asked(taken), taken, problems, contents, roles)


def shows_arm(all_contents: Sequence[FileContents]) -> bool:
    """Return whether files are one table of outputs with rates or with names of mountings."""
    if len(all_contents) != 1 or max(len(c.values) for c in all_contents[0].columns) > _MOST_ROWS:
        return False
    (contents,) = all_contents
    roles = arm_roles(contents, {})
    rate = next(iter(of_role(contents, roles, "rate")), None)
    if rate is None or not of_role(contents, roles, "reading"):
        return False
    position = next((name for name, role in roles.items() if role == "position"), None)
    table = ArmTable.of(contents, roles, {})
    beside = kind_of_arm_columns(table) == MOUNTINGS
    return (
        position in contents.words
        or beside
        or not as_acceleration(rate)
        or _follows_accelerations(table)
    )


def _follows_accelerations(table: ArmTable) -> bool:
    """Return whether readings of one table are linear in accelerations that exceed gravity."""
    if not set(table.roles.values()) <= {"rate", "reading", "uncertainty", "temperature", "radius"}:
        return False  # such as positions of a tumble, whose readings are accelerations
    (first, *_), felt = of_role(table.contents, table.roles, "reading"), table.acceleration(1.0)
    read = table.values(first)
    there = np.isfinite(felt * read)
    if there.sum() < _FEWEST_LEVELS or felt[there].max() < _LEAST_LEVEL * STANDARD_GRAVITY:
        return False
    return abs(float(np.corrcoef(felt[there], read[there])[0, 1])) > _IN_ONE_LINE


# What is guessed


def _followed(table: ArmTable, word: str) -> str | None:
    """Return whether a mounting's readings follow the acceleration or its negative."""
    readings = of_role(table.contents, table.roles, "reading")
    if not readings:
        return None
    slopes, _ = table.lines(readings[0], 1.0)
    own = slopes.get(word, math.nan)
    if not abs(own) > _FOLLOWING_PART * max(map(abs, slopes.values()), default=math.nan):
        return None
    return "inward" if own > 0.0 else "outward"


def _pointing(table: ArmTable, word: str) -> str | None:
    """Return the direction of the input axis in a mounting, from its name or else its readings."""
    meant = direction_of(word)
    # What lies across does not read the acceleration: "forward" is then the way of mounting.
    return meant if meant in ("inward", "outward") else _followed(table, word) or meant


def _resting(table: ArmTable, sensed: OutputEstimate, word: str) -> str | None:
    """Return the direction of the input axis where only the readings at rest show it."""
    readings = of_role(table.contents, table.roles, "reading")
    rows = table.rests & np.array([own == word for own in table.words])
    felt = (table.values(readings[0])[rows] - sensed.zero) / sensed.per_g
    for axis, wanted in (("up", 1.0), ("down", -1.0), ("forward", 0.0)):
        if np.all(np.abs(felt - wanted) < _NEAR):
            return axis
    return None


# What is asked, and said


def _questions(
    contents: FileContents, roles: Mapping[str, str], answers: Mapping[str, str]
) -> Iterator[FileQuestion]:
    table = ArmTable.of(*below_each_other(contents, roles, answers), answers)
    yield from place_questions(contents)
    yield from _radius_questions(table)
    numbers = [column.name for column in contents.columns]
    text = "Which column has the rate, the time of a revolution or the acceleration?"
    yield part_question("rate", text, numbers, roles, needed=True)
    if table.rate is not None:
        text = f"In which unit is column '{table.rate.name}', a rate, a time or an acceleration?"
        units = tuple(dict.fromkeys([*_RATE_UNITS, *filter(None, [table.unit])]))
        yield FileQuestion("rate unit", text, "rpm", units, table.unit)
    if "sense" not in roles.values():
        text = "In which sense does the arm turn at a positive rate, seen from above?"
        yield FileQuestion("sense", text, SENSES[0], SENSES)
    text = "Which column says how the accelerometer is mounted?"
    yield part_question("position", text, [*numbers, *contents.words], roles, needed=False)
    if table.gaps:
        text = "Which mounting is meant where the table names none?"
        yield FileQuestion("empty mounting", text, ABOVE, (ABOVE, NONE), table.gaps)
    axes = {w: answers.get(f"{w} axis") or _pointing(table, w) for w in table.mountings}
    readings = of_role(table.contents, table.roles, "reading")
    for word, axis in axes.items():
        text = f"How does the input axis point in the mounting '{word}'?"
        rests = axis is None and readings and word not in table.turning
        seen = _resting(table, _sensed(table, readings[0], axes, answers), word) if rests else axis
        yield FileQuestion(f"{word} axis", text, "inward", DIRECTIONS, seen)
    if "" in table.turning:
        text = "How does the input axis point while the arm turns?"
        if table.mountings:
            text = "How does the input axis point where the table names no mounting?"
        axes[""] = _followed(table, "")
        yield FileQuestion("axis", text, "inward", DIRECTIONS, axes[""])
        axes[""] = answers.get("axis", axes[""])
    sensed = {column.name: _sensed(table, column, axes, answers) for column in readings}
    if any(rests and not word for rests, word in zip(table.rests, table.words, strict=True)):
        text = "How does the input axis point at rest, where the table names no mounting?"
        guess = _resting(table, sensed[readings[0].name], "") if readings else None
        yield FileQuestion("axis at rest", text, "up", DIRECTIONS, guess)
    text = "Where does the pendulous axis point when the input axis points inward?"
    choices = ("up", "down", "forward", "backward")
    yield FileQuestion("pendulous axis", text, "up", choices, "up")
    parts = ["rate", "position", "radius"]
    yield from role_questions(contents, roles, parts, (*WORD_ROLES, "sense"))
    beside = ArmTable.of(contents, roles, answers)
    kind, more = kind_of_arm_columns(beside), () if beside.position else (MOUNTINGS,)
    yield from several_question(of_role(contents, roles, "reading"), kind, *more)
    for column, *_ in outputs_of(table.contents, table.roles, {SEVERAL: kind, **answers}):
        yield from output_questions(column, answers, sensed[column.name])
    if readings and "uncertainty" not in roles.values() and not _shows_noise(table):
        unit = output_unit(readings[0], answers) or "mA"
        text = (
            "What is the standard uncertainty of a reading? They are too few to show their noise."
        )
        yield FileQuestion("u", text, f"2e-6 {unit}", quantity=unit)


def _shows_noise(table: ArmTable) -> bool:
    """Return whether readings show their noise besides the unknowns, at rest and at rates."""
    at_rest = [word for rests, word in zip(table.rests, table.words, strict=True) if rests]
    turning = sum(int(table.turns_in(word).sum()) for word in table.turning)
    # Each of these brings a slope with it, which is unknown too.
    slopes = len({"time", "temperature"} & set(table.roles.values()))
    repeated = not at_rest or len(at_rest) > len(set(at_rest)) + slopes
    return repeated and turning >= _FEWEST + slopes + _OF_A_MOUNTING * len(table.turning)


def _radius_questions(table: ArmTable) -> Iterator[FileQuestion]:
    text = "How far is the proof mass from the spindle's axis"
    radii = table.radii()
    known = {radius for own in radii.values() for radius in own}
    example = "1.0 ± 1e-3 m"
    if len(known) < 2 or set(radii) != set(table.mountings) & set(table.turning):
        guess = f"{known.pop():.12g} m" if len(known) == 1 else None
        yield FileQuestion("radius", f"{text}?", example, guess=guess, quantity="m")
        return
    for word, own in radii.items():
        guess = f"{own[0]:.12g} m"
        asked = f"{text} in the mounting '{word}'?"
        yield FileQuestion(f"{word} radius", asked, example, guess=guess, quantity="m")


def _sensed(
    table: ArmTable, column: FileColumn, axes: Mapping[str, str | None], answers: Mapping[str, str]
) -> OutputEstimate:
    """Return an estimate of an output from rates and readings.

    axes: Mounting -> direction of the input axis, None: not known yet.
    """
    stated = [
        answers[key] for key in ("radius", *(f"{word} radius" for word in axes)) if key in answers
    ]
    radii = [own[0] for own in table.radii().values()]
    radius = parse(stated[0], "m").value if stated else next(iter(radii), math.nan)
    slopes, zero = table.lines(column, radius)
    signs = {"inward": 1.0, "outward": -1.0}
    inward = [
        signs[axis] * slopes[word]
        for word, axis in axes.items()
        if axis in signs and word in slopes
    ]
    return OutputEstimate(float(np.mean(inward)) if inward else math.nan, zero)


def _statements(
    contents: FileContents, roles: Mapping[str, str], answers: Mapping[str, str]
) -> Iterator[str]:
    table = ArmTable.of(*below_each_other(contents, roles, answers), answers)
    yield from table_statements(contents, roles)
    if table.rate is not None and (step := table.rate_step()) > _LARGE_STEP:
        yield (
            f"column '{table.rate.name}' has so few digits that the last one changes the force by "
            f"{100.0 * step:.1g} %; give more digits if there are any. A stated uncertainty of the "
            "readings must include this rounding; without one, the residuals show it"
        )
    rests = int(table.rests.sum())
    if table.rate is not None:
        yield f"{rests or 'no'} reading{'' if rests == 1 else 's'} at rest, where the rate is 0"
        if converts(table.unit or "", "m/s^2"):
            yield "accelerations are those at the radius; g is the gravity of the site"
    for word in table.mountings:
        meant, seen, axis = direction_of(word), _followed(table, word), _pointing(table, word)
        if axis == meant and seen not in (None, meant):
            yield f"mounting '{word}': {meant} by its name, {seen} if the sensitivity is positive"
        elif axis:
            by = "by its name" if axis == meant else "as it reads"
            yield f"mounting '{word}': input axis {axis}, {by}"
    yield "the pendulous axis turns with the input axis; with a vertical one it points outward"
