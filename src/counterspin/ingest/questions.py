"""Ask a person about a recorder's files, and combine the answers with the signals.

On a double turntable every signal has a wave of the centrifuge's radius in the signal's direction.
Therefore the radius shows the unit of a signal, and the phase between two signals shows the sense
or the axis of the second.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from typing import Final

from counterspin.campaign.field_types import COMPASS_ANGLES
from counterspin.campaign.quantity import BARE_NUMBER, normalize_latitude, parse_quantity
from counterspin.campaign.settings import OBSERVABLES
from counterspin.errors import CampaignError, InputError, MissingAnswersError, Problem, error_code
from counterspin.frozen import frozen
from counterspin.ingest.column_roles import (
    NONE,
    TEMPERATURE,
    UNUSED,
    FileGuess,
    SignalGuess,
    temperature_scale,
    why_no_time,
)
from counterspin.ingest.contents import ALL_SHEETS, FileContents
from counterspin.readings.cells import SENSE_WORDS
from counterspin.records.unit_notation import parse_file_unit
from counterspin.units import STANDARD_GRAVITY, unit_factor

SENSES: Final = ("counterclockwise", "clockwise")
AXES: Final = ("east", "west", "north", "south", "up", "down")
#: In the place of a question's key: what is wrong with the files themselves.
UNFIT: Final = "files"
#: In the place of a unit: that of any signal.
ANY_SIGNAL: Final = "any"
#: SI unit -> the usual ones that convert to it.
USUAL_UNITS: Final = {
    "s": ("s", "ms", "us", "min", "d"),
    "m": ("m", "mm", "cm", "um", "km"),
    "m/s": ("m/s", "mm/s", "cm/s", "km/h"),
    "m/s^2": ("m/s^2", "g", "mg", "ug"),
}
USUAL_UNITS[ANY_SIGNAL] = USUAL_UNITS["m"][:2] + USUAL_UNITS["m/s"][:2] + USUAL_UNITS["m/s^2"][:3]
#: Other words for answers that are chosen from a list, in lower case.
_SYNONYMS: Final = dict[str, str](SENSE_WORDS) | {
    word: answer
    for answer, words in {
        "counterclockwise": "positive",
        "clockwise": "negative",
        "east": "e, o, ost",
        "west": "w",
        "north": "n, nord",
        "south": "s, süd, sued",
        "up": "u, oben",
        "down": "d, unten",
        "inward": "in, inwards, inside, inboard, innen, einwärts, nach innen",
        "outward": "out, outwards, outside, outboard, außen, aussen, auswärts, nach außen, "
        "nach aussen",
        "forward": "tangential, forwards, vorwärts, vorn",
        "backward": "backwards, rückwärts, hinten",
        "displacement": "position, path, weg",
        "velocity": "speed, geschwindigkeit",
        "specific_force": "specific force, force",
        UNUSED: "ignore, nothing",
    }.items()
    for word in words.split(", ")
}
_DECIMAL_COMMA: Final = re.compile(r"(?<![\d.])(\d+),(\d+)(?![\d,])")


@frozen
class FileQuestion:
    """A question about facts that files do not state, or about a guess that may be overruled."""

    key: str  #: By which it is answered.
    text: str  #: The question.
    example: str  #: An answer.
    #: The answers there are, of a unit the usual ones; empty: any.
    choices: tuple[str, ...] = ()
    guess: str | None = None  #: What is taken without an answer; None: an answer is needed.
    quantity: str = ""  #: The unit of a quantity that is asked for; empty: none is.
    unit: str = ""  #: What a unit that is asked for must convert to; empty: none is asked for.

    def judged(self, answer: str) -> str:
        """Return an answer in the words of a description; ValueError if it is not valid."""
        clean = _DECIMAL_COMMA.sub(r"\1.\2", answer.strip())
        if self.choices and not self.unit:
            return self._chosen(answer.strip())
        if self.quantity:
            # A bare number is in the unit of the example, which stands beside the question.
            *_, usual = self.example.split()
            bare = BARE_NUMBER.fullmatch(clean) and self.key != "rate"
            text = f"{clean} {usual}" if bare else clean
            text = str(normalize_latitude(text)) if self.key == "latitude" else text
            parse_quantity(text, self.quantity)
            return text
        if self.unit:
            unit = parse_file_unit(clean) or clean
            wanted = OBSERVABLES.values() if self.unit == ANY_SIGNAL else (self.unit,)
            errors = [error for si in wanted if (error := _unit_error(unit, si))]
            if len(errors) == len(tuple(wanted)):
                raise ValueError(errors[0])
            return unit
        if not BARE_NUMBER.fullmatch(clean) or not 0.0 < float(clean) < math.inf:
            raise InputError(
                f"{answer!r} is not a positive number; enter, for example, {self.example}",
                "not-numeric",
            )
        return clean

    def _chosen(self, answer: str) -> str:
        known = {choice.lower(): choice for choice in self.choices}
        word = answer.lower()
        word = word if word in known else _SYNONYMS.get(word, word).lower()
        if word in known:
            return known[word]
        close = get_close_matches(word, known, n=1)
        hint = f"; did you mean {known[close[0]]!r}?" if close else ""
        raise InputError(
            f"{answer!r} is not one of {', '.join(self.choices)}{hint}", "unknown-choice"
        )


@frozen
class AnsweredDraft:
    """Guesses from files, and a person's answers."""

    statements: tuple[str, ...]  #: What was guessed, in whole sentences.
    questions: tuple[FileQuestion, ...]  #: What may be answered.
    answers: Mapping[str, str]  #: What was answered, in the words of a description.
    problems: tuple[str, ...]  #: What is wrong with other answers.

    @property
    def open_questions(self) -> list[FileQuestion]:
        """The questions that must be answered before a description can be written."""
        return [
            question
            for question in self.questions
            if question.key not in self.answers and question.guess is None
        ]

    def complete(self) -> dict[str, str]:
        """Return guesses, overruled by answers; CampaignError if one is missing or wrong."""
        # Nothing is asked about files that have to be exported anew.
        if unfit := [line for line in self.problems if line.startswith(f"{UNFIT}: ")]:
            raise CampaignError("init", unfit, code="wrong-file-type")
        missing = [
            f"{q.key}: {q.text} No answer was given."
            for q in self.open_questions
            if not any(line.startswith(f"{q.key}: ") for line in self.problems)
        ]
        if missing or self.problems:
            raise MissingAnswersError("init", [*missing, *self.problems])
        guessed = {q.key: q.guess for q in self.questions if q.guess is not None}
        return guessed | dict(self.answers)


def relative_name(file: Path, folder: Path) -> str:
    """Return a file's path relative to a folder; absolute if they share no parent folder."""
    file = file.resolve()
    if file.anchor != folder.anchor or file.parts[1:2] != folder.parts[1:2]:
        return str(file)
    return Path(os.path.relpath(file, folder)).as_posix()


def _unit_error(unit: str, wanted: str) -> str:
    try:
        unit_factor(unit, wanted, gravity=STANDARD_GRAVITY)
    except ValueError as error:
        return str(error)
    return ""


def questions_of(
    common: FileGuess, sense: str | None, answered: Collection[str] = ()
) -> Iterator[FileQuestion]:
    """Yield the questions that may be answered: open ones, and guesses.

    answered: Keys that were answered before.
    """
    names = tuple(column.name for column in common.contents.columns)
    yield from place_questions(common.contents, ALL_SHEETS)
    text = (
        "What is the distance from the spindle axis to the platform (the "
        f"radius)?{_size_seen(common)}"
    )
    yield FileQuestion("radius", text, "2.5 ± 1e-5 m", quantity="m")
    yield from time_questions(common, names)
    yield from _angle_questions(common, names, sense)
    if common.rate is None:
        text = "What is the rate of the centrifuge?"
        yield FileQuestion("rate", text, "0.25 rev/s", quantity="rad/s")
    if not common.signals or "signal" in answered:
        yield FileQuestion("signal", "Which column contains the signal?", names[-1], names)
    yield from _signal_questions(common)


def place_questions(contents: FileContents, *more: str) -> Iterator[FileQuestion]:
    """Yield the questions of every table: its sheet, and the place of the test.

    more: Answers in addition to the names of the sheets.
    """
    if contents.sheets:
        text = "Which sheet contains the table?"
        if more:
            text = (
                f"Which sheet contains the table of a run (enter '{ALL_SHEETS}' to use every "
                "sheet)?"
            )
        yield FileQuestion("sheet", text, contents.sheets[0], (*contents.sheets, *more))
    yield FileQuestion(
        "gravity", "What is the local gravity?", "9.8066 ± 1e-5 m/s^2", quantity="m/s^2"
    )
    yield FileQuestion("latitude", "What is the latitude?", "45.75 deg", quantity="rad")


def _size_seen(common: FileGuess) -> str:
    for signal in common.signals:
        if signal.observable == "displacement" and signal.unit and signal.amplitude > 0.0:
            about = signal.amplitude * unit_factor(signal.unit, "m")
            return f" The displacement has an amplitude of {about:.4g} m."
    return ""


def time_questions(common: FileGuess, names: tuple[str, ...]) -> Iterator[FileQuestion]:
    """Yield the questions about the time of each row."""
    time = common.time
    text = "Which column contains the time?"
    yield FileQuestion("time", text, names[0], (*names, NONE), time.column if time else NONE)
    if time is not None and time.unit != "iso":
        text = f"What is the unit of the time column '{time.column}'?"
        yield FileQuestion("time unit", text, "s", USUAL_UNITS["s"], time.unit, unit="s")
    if time is None:
        reason = why_no_time(common.contents)
        if common.shared is not None and common.uncounted:
            reason = f"Column '{common.shared.name}' is not used as the time: {common.uncounted}"
        text = f"{reason}. What is the sampling rate?"
        guess = f"{common.sampling:.12g} Hz" if common.sampling else None
        yield FileQuestion("sampling_rate", text, "50 Hz", guess=guess, quantity="Hz")


def _angle_questions(
    common: FileGuess, names: tuple[str, ...], sense: str | None
) -> Iterator[FileQuestion]:
    angle = common.angle
    text = "Which column contains the spindle angle?"
    yield FileQuestion("angle", text, names[0], (*names, NONE), angle.column if angle else NONE)
    if angle is not None and not angle.pulses:
        text = f"What is the unit of the angle column '{angle.column}'?"
        # Counts are no unit of an angle, but a person may say that it is counted.
        choices = ("deg", "rad", "rev", "mrad", "arcmin", "arcsec", "count")
        yield FileQuestion("angle unit", text, "deg", choices, guess=angle.unit)
    if angle is not None and angle.unit == "count":
        seen = f" The periodic signals suggest {angle.turn:.6g}." if angle.turn else ""
        text = f"How many counts of column '{angle.column}' are there per revolution?{seen}"
        counts = f"{angle.per_revolution:.12g}" if angle.per_revolution else None
        yield FileQuestion("per_revolution", text, "65536", guess=counts)
    text = "In which sense does the angle increase, as seen from above?"
    if angle is None or angle.pulses:
        text = "In which sense does the centrifuge rotate, as seen from above?"
    yield FileQuestion("sense", text, SENSES[0], SENSES, guess=sense)


def _signal_questions(common: FileGuess) -> Iterator[FileQuestion]:
    signals = {signal.column: signal for signal in common.signals}
    others = {part.column for part in (common.time, common.angle) if part}
    for column in common.contents.columns:
        name = column.name
        if name in others or column.stamps:
            continue
        signal = signals.get(name)
        guess = signal.observable if signal else UNUSED
        if common.temperature is not None and common.temperature[0] == name:
            guess = TEMPERATURE
        text = f"What does column '{name}' contain?"
        scale = temperature_scale(column)
        choices = (*OBSERVABLES, *([] if scale is None else [TEMPERATURE]), UNUSED)
        yield FileQuestion(f"{name} is", text, choices[0], choices, guess)
        if signal is None:
            continue
        text = f"What is the unit of column '{name}'?"
        wanted = OBSERVABLES.get(signal.observable or "", ANY_SIGNAL)
        units = USUAL_UNITS[wanted]
        yield FileQuestion(f"{name} unit", text, units[0], units, signal.unit, unit=wanted)
        text = f"Along which axis was column '{name}' measured?"
        yield FileQuestion(f"{name} axis", text, AXES[0], AXES, guess=signal.axis)


def validate_answers(
    answers: Mapping[str, str] | None,
    asked: Callable[[Mapping[str, str]], Sequence[FileQuestion]],
) -> tuple[dict[str, str], tuple[str, ...]]:
    """Return the valid answers in the words of a description, and the errors of others.

    asked: Returns the questions once some answers are known: with its unit, an angle shows the
        sense and the rates.
    """
    taken: dict[str, str] = {}
    while True:
        counting, problems = judged_answers(asked(taken), answers or {})
        if set(counting) <= set(taken):
            return counting, tuple(problems)
        taken |= counting


def judged_answers(
    questions: Sequence[FileQuestion], answers: Mapping[str, str]
) -> tuple[dict[str, str], list[str]]:
    """Return answers in the words of a description, and the errors of the others."""
    known = {question.key: question for question in questions}
    taken: dict[str, str] = {}
    problems: list[str] = []
    for key, answer in answers.items():
        if key not in known:
            needed = [question.key for question in questions if question.guess is None]
            text = f"{key}: not one of the questions: {', '.join(needed) or 'none'}"
            problems.append(Problem(text, "unknown-key"))
            continue
        try:
            taken[key] = known[key].judged(answer)
        except ValueError as error:
            problems.append(Problem(f"{key}: {error}", error_code(error)))
    return taken, problems


# What signals show together: the sense, a unit by the radius, an axis by the other

#: Axis -> the one against which it points, and by how much it is turned, rad.
_OPPOSITE: Final = {"west": ("east", math.pi), "south": ("north", math.pi)}
#: Relative difference between a radius and what a signal shows of it: of its scale factor.
_SIZE_TOLERANCE: Final = 0.1
#: Difference between the phases of waves along two axes from a quarter turn, rad.
_PHASE_TOLERANCE: Final = 0.3


def waves_sense(common: FileGuess) -> str | None:
    """Return the sense in which the angle grows, from the waves along two horizontal axes."""
    phases: dict[str, dict[str, float]] = {}
    for signal in common.signals:
        if signal.phase is not None and signal.axis is not None and signal.observable:
            axis, turned = _OPPOSITE.get(signal.axis, (signal.axis, 0.0))
            phases.setdefault(signal.observable, {})[axis] = signal.phase + turned
    for phase in phases.values():
        if "east" in phase and "north" in phase:
            ahead = math.remainder(phase["east"] - phase["north"], 2.0 * math.pi)
            if abs(abs(ahead) - math.pi / 2.0) < _PHASE_TOLERANCE:
                return SENSES[0] if ahead > 0.0 else SENSES[1]
    return None


def complete_guess(common: FileGuess, answers: Mapping[str, str]) -> FileGuess:
    """Return a guess with units that follow from the radius and axes that follow from the sense.

    answers: A person's answers, by the keys of questions.
    """
    signals = common.signals
    if "radius" in answers and common.rate is not None and (common.time or common.sampling):
        radius = parse_quantity(answers["radius"], "m").value
        signals = tuple(_with_unit(signal, radius, common.rate) for signal in signals)
    if "sense" in answers:
        forward = 1.0 if answers["sense"] == SENSES[0] else -1.0
        signals = tuple(_with_axis(signal, signals, forward) for signal in signals)
    return replace(common, signals=signals)


def _with_unit(signal: SignalGuess, radius: float, rate: float) -> SignalGuess:
    """Return a signal with the unit that fits its wave at a radius, m, and a rate, rad/s."""
    if signal.unit is not None or signal.observable is None:
        return signal
    derivatives, si = list(OBSERVABLES).index(signal.observable), OBSERVABLES[signal.observable]
    wanted = radius * rate**derivatives
    for unit in USUAL_UNITS[si]:
        size = signal.amplitude * unit_factor(unit, si, gravity=STANDARD_GRAVITY)
        if abs(size / wanted - 1.0) < _SIZE_TOLERANCE:
            return replace(signal, unit=unit, by_radius=True)
    return signal


def _with_axis(
    signal: SignalGuess, signals: tuple[SignalGuess, ...], forward: float
) -> SignalGuess:
    """Return a signal with the axis that its phase shows relative to another of a known axis.

    forward: 1 where the angle grows counterclockwise, -1 where it grows clockwise.
    """
    if signal.axis is not None or signal.phase is None or signal.observable is None:
        return signal
    for reference in signals:
        if reference.axis not in COMPASS_ANGLES or reference.observable != signal.observable:
            continue
        if reference.phase is None:
            continue
        direction = COMPASS_ANGLES[reference.axis] + forward * (reference.phase - signal.phase)
        for axis, known in COMPASS_ANGLES.items():
            across = abs(math.remainder(direction - known, 2.0 * math.pi))
            if axis != reference.axis and across < _PHASE_TOLERANCE:
                return replace(signal, axis=axis)
    return signal
