"""From guesses and answers to a campaign's description."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from counterspin.campaign.checking import Problems
from counterspin.campaign.description import resolve_campaign
from counterspin.campaign.kinds import COMPASS
from counterspin.campaign.memory.records import record_name
from counterspin.campaign.quantity import parse
from counterspin.campaign.toml_file import DESCRIPTION_NAME
from counterspin.errors import CampaignError, CounterspinError
from counterspin.exports.guessing import FileGuess, SignalGuess, agreed, guess_file
from counterspin.exports.looking import look
from counterspin.frozen import frozen
from counterspin.output import make_folder, write_text
from counterspin.toml_text import write_document
from counterspin.units import unit_factor

#: Directions of horizontal axes, rad from east towards north.
#: Axis -> usual name of an accelerometer.
_NAMES: Final = {"east": "Qx", "west": "Qx", "north": "Qy", "south": "Qy", "up": "Qz", "down": "Qz"}
#: An encoder's zero is a compass direction if it points there within, rad.
_POINTING_ANGLE: Final = math.radians(0.5)
#: A rate is a round number if it is one within this part.
_ROUND_RATE_PART: Final = 2e-4
_SENSES: Final = ("counterclockwise", "clockwise")


@frozen
class ExportQuestion:
    """What files do not say."""

    key: str  #: By which it is answered.
    text: str  #: The question.
    example: str  #: An answer.
    choices: tuple[str, ...] = ()  #: The answers there are; empty: any.


@frozen
class Draft:
    """What files show."""

    guesses: tuple[FileGuess, ...]  #: Of each file.
    common: FileGuess  #: What they have in common.
    statements: tuple[str, ...]  #: What was guessed, in whole sentences.
    questions: tuple[ExportQuestion, ...]  #: What has to be asked.


def draft(files: Sequence[Path], *, progress: Callable[[int, int], None] | None = None) -> Draft:
    """Look at a recorder's files, one for each run.

    progress: Called with (files looked at, files in all).
    """
    if not files:
        raise CampaignError("init", ["name the files of the runs"])
    guessed = []
    for file in files:
        guessed.append(guess_file(look(file)))
        if progress is not None:
            progress(len(guessed), len(files))
    guesses = tuple(guessed)
    common = agreed(guesses)
    sense = _sense(common)
    return Draft(
        guesses,
        common,
        tuple(_statements(guesses, common, sense)),
        tuple(_questions(common, sense)),
    )


def described(draft: Draft, answers: Mapping[str, str], folder: Path) -> dict[str, Any]:
    """Return the description that guesses and answers make."""
    problems = [
        f'{q.key}: {q.text} Say it with `answer`, such as "{q.key}={q.example}".'
        for q in draft.questions
        if q.key not in answers
    ]
    known = {question.key: question for question in draft.questions}
    for key, answer in answers.items():
        if key not in known:
            problems.append(f"{key}: is not asked; asked: {', '.join(known) or 'nothing'}")
        elif known[key].choices and answer not in known[key].choices:
            problems.append(f"{key}: {answer!r} is none of {', '.join(known[key].choices)}")
    if problems:
        raise CampaignError("init", problems)
    common, sense = draft.common, _sense(draft.common) or answers.get("sense", _SENSES[0])
    document: dict[str, Any] = {
        "schema": 1,
        "campaign": {"title": folder.absolute().name},
        "site": {"gravity": answers["gravity"], "latitude": answers["latitude"]},
        "centrifuge": {"radius": answers["radius"]},
        "records": _records(common, answers, sense),
        "accelerometers": _accelerometers(common, answers),
    }
    names: list[Any] = []
    runs = []
    for guess in draft.guesses:
        file = guess.look.path.absolute()
        name = Path(record_name(file.stem, "", names)).name
        names.append(name)
        inside = file.is_relative_to(folder.absolute())
        record = file.relative_to(folder.absolute()).as_posix() if inside else str(file)
        runs.append({"name": name, "rate": _rate(guess, answers, sense), "record": record})
    return document | {"runs": runs}


def write_description(draft: Draft, answers: Mapping[str, str], folder: Path) -> Path:
    """Write the description into the campaign's folder, with what was guessed as comments."""
    target = folder / DESCRIPTION_NAME
    if target.exists():
        raise CounterspinError(f"{target} exists; edit it, or choose another folder")
    document = described(draft, answers, folder)
    problems = Problems(document)
    if resolve_campaign(document, target, problems) is None:
        raise CampaignError("init", problems.lines)
    names = ", ".join(guess.look.path.name for guess in draft.guesses)
    head = [f"A campaign made from {names}.", "Guessed, to be checked:"]
    head += [f"- {statement}" for statement in draft.statements]
    comments = {
        "site": '± standard uncertainty (k = 1), as in "9.8066 ± 1e-5 m/s^2"',
        "accelerometers": 'Known beforehand: bias = "0.005 ± 2e-6 g", scale_factor likewise',
        "records": "Every key is explained in docs/campaign.md",
    }
    text = "".join(f"# {line}\n" for line in head) + write_document(document, comments)
    make_folder(folder)
    write_text(target, text)
    return target


# What is asked, and what is said


def _questions(common: FileGuess, sense: str | None) -> Iterator[ExportQuestion]:
    yield ExportQuestion("gravity", "What is gravity there?", "9.8066 ± 1e-5 m/s^2")
    yield ExportQuestion("latitude", "At which latitude?", "45.75 deg")
    size = next((s for s in common.signals if s.observable == "displacement" and s.unit), None)
    seen = ""
    if size is not None and size.unit is not None and size.amplitude > 0.0:
        about = size.amplitude * unit_factor(size.unit, "m")
        seen = f" The displacement swings by {about:.4g} m."
    yield ExportQuestion(
        "radius", f"How far is the platform from the spindle's axis?{seen}", "2.5 ± 1e-5 m"
    )
    if common.time is None:
        text = "No column has the time. How many rows are there a second?"
        yield ExportQuestion("sampling_rate", text, "50 Hz")
    elif common.time.unit is None:
        name = common.time.column
        yield ExportQuestion("time unit", f"In which unit is the time, column '{name}'?", "s")
    angle = common.angle
    if angle is not None and angle.unit is None:
        text = f"In which unit is the angle, column '{angle.column}'?"
        yield ExportQuestion("angle unit", text, "deg")
    if angle is not None and angle.unit == "count" and angle.per_revolution is None:
        text = f"How many counts of column '{angle.column}' make a revolution?"
        yield ExportQuestion("per_revolution", text, "65536")
    if sense is None:
        text = "In which sense does the angle grow, seen from above?"
        if angle is None or angle.pulses:
            text = "In which sense does the centrifuge turn, seen from above?"
        yield ExportQuestion("sense", text, _SENSES[0], _SENSES)
    if common.rate is None:
        yield ExportQuestion("rate", "At which rate does the centrifuge turn?", "0.25 rev/s")
    if not common.signals:
        names = ", ".join(f"'{column.name}'" for column in common.look.columns)
        yield ExportQuestion("signal", f"Which column has the signal ({names})?", "east_m")
    for signal in common.signals or (_unknown(),):
        yield from _signal_questions(signal)


def _unknown() -> SignalGuess:
    return SignalGuess("signal", None, None, None, 0.0, None)


def _signal_questions(signal: SignalGuess) -> Iterator[ExportQuestion]:
    name = signal.column
    if signal.observable is None:
        text = f"What does column '{name}' have?"
        choices = ("displacement", "velocity", "specific_force")
        yield ExportQuestion(f"{name} is", text, choices[0], choices)
    if signal.unit is None:
        yield ExportQuestion(f"{name} unit", f"In which unit is column '{name}'?", "m")
    if signal.axis is None:
        text = f"Along which axis is column '{name}'?"
        yield ExportQuestion(f"{name} axis", text, "east", tuple(_NAMES))


def _statements(
    guesses: Sequence[FileGuess], common: FileGuess, sense: str | None
) -> Iterator[str]:
    for guess in guesses:
        said = []
        if guess.look.found:
            said.append(guess.look.found)
        if guess.rate is not None:
            turns = guess.rate / (2.0 * math.pi)
            said.append(f"{turns:.6g} rev/s" if guess.time else f"{1 / turns:.6g} rows a turn")
        rows = max(len(column.values) for column in guess.look.columns)
        yield f"{guess.look.path.name}: {', '.join([f'{rows} rows', *said])}"
    time, angle = common.time, common.angle
    if time is not None:
        unit = "time stamps" if time.unit == "iso" else f"in {time.unit or 'an unknown unit'}"
        yield f"time: column '{time.column}', {unit}"
    if angle is None:
        yield "angle: none found; the nominal rates are taken"
    elif angle.pulses:
        yield f"angle: column '{angle.column}' has the times of a pulse, one a revolution"
    else:
        counts = f", {angle.per_revolution:.10g} a revolution" if angle.per_revolution else ""
        by = "by the file" if angle.known else "by its name or its numbers"
        unit = angle.unit or "an unknown unit"
        yield f"angle: column '{angle.column}', in {unit}{counts} ({by})"
    if sense is not None and angle is not None:
        yield f"sense: {sense}, as the waves along two axes follow each other"
    for signal in common.signals:
        what = (signal.observable or "a signal").replace("_", " ")
        axis = f"along {signal.axis}" if signal.axis else "of an unknown axis"
        unit = f" in {signal.unit}" if signal.unit else ""
        yield f"column '{signal.column}': {what}{unit}, {axis}"
    if common.signals:
        yield "pendulous axes: down, or north of an upright axis; the files do not say"
    if common.unused:
        yield f"not used: {', '.join(common.unused[:20])}"


# What follows


def _sense(common: FileGuess) -> str | None:
    """Return the sense in which the angle grows, by the waves along two horizontal axes."""
    phases: dict[str, dict[str, float]] = {}
    for signal in common.signals:
        if signal.phase is not None and signal.axis is not None and signal.observable:
            phases.setdefault(signal.observable, {})[signal.axis] = signal.phase
    for phase in phases.values():
        if "east" in phase and "north" in phase:
            ahead = math.remainder(phase["east"] - phase["north"], 2.0 * math.pi)
            if abs(abs(ahead) - math.pi / 2.0) < 0.3:
                return _SENSES[0] if ahead > 0.0 else _SENSES[1]
    return None


def _records(common: FileGuess, answers: Mapping[str, str], sense: str) -> dict[str, Any]:
    records: dict[str, Any] = {}
    if common.time is None:
        records["time"] = {"sampling_rate": answers["sampling_rate"]}
    else:
        unit = common.time.unit or answers["time unit"]
        records["time"] = {"column": common.time.column, "unit": unit}
    angle = common.angle
    if angle is None:
        return records
    table: dict[str, Any] = {"column": angle.column, "unit": angle.unit or answers["angle unit"]}
    if angle.pulses:
        table["pulses"] = True
        table["unit"] = angle.unit or records["time"].get("unit", "s")
    elif angle.unit == "count":
        stated = angle.per_revolution or float(answers["per_revolution"])
        table["per_revolution"] = int(stated) if stated == int(stated) else stated
    if sense == _SENSES[1] and not angle.pulses:
        table["sense"] = sense
    zero = _zero(common, answers, sense)
    if zero is not None and zero != "east":
        table["zero"] = zero
    return records | {"angle": table}


def _zero(common: FileGuess, answers: Mapping[str, str], sense: str) -> str | None:
    """Return where the arm points at the encoder's zero, by the wave along a horizontal axis."""
    turned = 1.0 if sense == _SENSES[0] else -1.0
    forward = turned if common.rising else -turned
    for signal in common.signals:
        axis = signal.axis or answers.get(f"{signal.column} axis")
        if signal.phase is None or axis not in COMPASS:
            continue
        what = signal.observable or answers.get(f"{signal.column} is", "displacement")
        derivatives = ("displacement", "velocity", "specific_force").index(what)
        ahead = signal.phase - turned * forward * derivatives * math.pi / 2.0
        zero = turned * ahead + COMPASS[axis]
        for name, direction in COMPASS.items():
            if abs(math.remainder(zero - direction, 2.0 * math.pi)) < _POINTING_ANGLE:
                return name
        return f"{math.degrees(math.remainder(zero, 2.0 * math.pi)):.4f} deg"
    return None


def _accelerometers(common: FileGuess, answers: Mapping[str, str]) -> dict[str, Any]:
    tables: dict[str, Any] = {}
    for signal in common.signals or (_unknown(),):
        key = signal.column
        column = answers.get("signal", key)
        axis = signal.axis or answers[f"{key} axis"]
        what = signal.observable or answers[f"{key} is"]
        name, number = _NAMES[axis], 2
        while name in tables:
            name, number = f"{_NAMES[axis]}{number}", number + 1
        tables[name] = {
            "input_axis": axis,
            "pendulous_axis": "north" if axis in ("up", "down") else "down",
            what: {"column": column, "unit": signal.unit or answers[f"{key} unit"]},
        }
    return tables


def _rate(guess: FileGuess, answers: Mapping[str, str], sense: str) -> str:
    """Return the rate of a run, a round number where it is nearly one."""
    if guess.rate is None:
        return answers["rate"]
    along = sense == _SENSES[0]
    counts = guess.angle is not None and not guess.angle.pulses
    sign = 1.0 if along == (guess.rising or not counts) else -1.0
    size = guess.rate
    if guess.time is None:
        size *= parse(answers["sampling_rate"], "Hz").value
    for unit, factor in (("rev/s", 2.0 * math.pi), ("deg/s", math.pi / 180.0), ("rad/s", 1.0)):
        value = size / factor
        near = float(np.format_float_positional(value, precision=3, fractional=False))
        if abs(near / value - 1.0) < _ROUND_RATE_PART:
            return f"{sign * near:g} {unit}"
    return f"{sign * size:.8g} rad/s"
