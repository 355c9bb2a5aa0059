"""Questions about a recorder's files, and conclusions from answers and signals.

On a double turntable every signal oscillates with an amplitude that depends on the radius.
Therefore the radius shows the unit of a signal, and the phase difference between two signals shows
the sense of rotation, or the axis of the second signal.
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

from counterspin.campaign.field_types import (
    COMPASS_ANGLES,
    check_gravity,
    check_latitude,
    check_positive,
)
from counterspin.campaign.quantity import BARE_NUMBER, normalize_latitude, parse_quantity
from counterspin.campaign.settings import OBSERVABLES
from counterspin.errors import (
    CampaignError,
    InputError,
    InvalidAnswersError,
    MissingAnswersError,
    Problem,
    error_code,
)
from counterspin.frozen import frozen
from counterspin.ingest.column_roles import (
    NO_COLUMN,
    TEMPERATURE_ROLE,
    UNUSED_ROLE,
    FileGuess,
    SignalGuess,
    explain_missing_time,
)
from counterspin.ingest.column_values import temperature_scale
from counterspin.ingest.contents import ALL_SHEETS, FileContents
from counterspin.readings.cells import SENSE_WORDS
from counterspin.records.unit_notation import parse_file_unit
from counterspin.units import STANDARD_GRAVITY, unit_factor

#: Key -> check of the range of its answer.
_RANGE_CHECKS: Final = {
    "gravity": check_gravity,
    "latitude": check_latitude,
    "radius": check_positive,
}
SENSES: Final = ("counterclockwise", "clockwise")
AXES: Final = ("east", "west", "north", "south", "up", "down")
#: Prefix, in place of a question's key, of problems with the files themselves.
FILES_KEY: Final = "files"
#: Placeholder for the unit of any signal.
ANY_SIGNAL: Final = "any"
#: SI unit -> common units of the same dimension.
COMMON_UNITS: Final = {
    "s": ("s", "ms", "us", "min", "d"),
    "m": ("m", "mm", "cm", "um", "km"),
    "m/s": ("m/s", "mm/s", "cm/s", "km/h"),
    "m/s^2": ("m/s^2", "g", "mg", "ug"),
}
COMMON_UNITS[ANY_SIGNAL] = (
    COMMON_UNITS["m"][:2] + COMMON_UNITS["m/s"][:2] + COMMON_UNITS["m/s^2"][:3]
)
#: Synonym, in lower case -> choice.
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
        UNUSED_ROLE: "ignore, nothing",
    }.items()
    for word in words.split(", ")
}
_DECIMAL_COMMA: Final = re.compile(r"(?<![\d.])(\d+),(\d+)(?![\d,])")


@frozen
class FileQuestion:
    """A question about missing information, or about a guess that an answer may replace."""

    key: str  #: Key of the answer.
    text: str  #: Text of the question.
    example: str  #: Example of an answer.
    #: Possible answers; for a unit, the common ones; empty: any answer.
    choices: tuple[str, ...] = ()
    guess: str | None = None  #: Value without an answer; None: an answer is required.
    quantity: str = ""  #: Unit of the requested quantity; empty: not a quantity.
    unit: str = ""  #: Unit to which the requested unit must convert; empty: not a unit.

    def parse_answer(self, answer: str) -> str:
        """Convert an answer to the form of a description; ValueError if it is invalid."""
        normalized_text = _DECIMAL_COMMA.sub(r"\1.\2", answer.strip())
        if self.choices and not self.unit:
            return self._match_choice(answer.strip())
        if self.quantity:
            # A number without a unit is in the unit of the example, which is shown to the user.
            *_, example_unit = self.example.split()
            is_bare = BARE_NUMBER.fullmatch(normalized_text) and self.key != "rate"
            text = f"{normalized_text} {example_unit}" if is_bare else normalized_text
            text = str(normalize_latitude(text)) if self.key == "latitude" else text
            quantity = parse_quantity(text, self.quantity)
            if self.key in _RANGE_CHECKS:
                _RANGE_CHECKS[self.key](quantity)
            return text
        if self.unit:
            unit = parse_file_unit(normalized_text) or normalized_text
            target_units = OBSERVABLES.values() if self.unit == ANY_SIGNAL else (self.unit,)
            errors = [
                error
                for target_unit in target_units
                if (error := _find_unit_error(unit, target_unit))
            ]
            if len(errors) == len(tuple(target_units)):
                raise ValueError(errors[0])
            return unit
        if (
            not BARE_NUMBER.fullmatch(normalized_text)
            or not 0.0 < float(normalized_text) < math.inf
        ):
            raise InputError(
                f"{answer!r} is not a positive number; enter, for example, {self.example}",
                "not-numeric",
            )
        return normalized_text

    def _match_choice(self, answer: str) -> str:
        choice_by_word = {choice.lower(): choice for choice in self.choices}
        word = answer.lower()
        word = word if word in choice_by_word else _SYNONYMS.get(word, word).lower()
        if word in choice_by_word:
            return choice_by_word[word]
        matches = get_close_matches(word, choice_by_word, n=1)
        hint = f"; did you mean {choice_by_word[matches[0]]!r}?" if matches else ""
        raise InputError(
            f"{answer!r} is not one of {', '.join(self.choices)}{hint}", "unknown-choice"
        )


@frozen
class AnsweredDraft:
    """Guesses from files, with questions and answers."""

    statements: tuple[str, ...]  #: Guesses, in complete sentences.
    questions: tuple[FileQuestion, ...]  #: All questions.
    answers: Mapping[str, str]  #: Key -> valid answer, in the form of a description.
    problems: tuple[str, ...]  #: Errors of the other answers.

    @property
    def open_questions(self) -> list[FileQuestion]:
        """The questions that require an answer."""
        return [
            question
            for question in self.questions
            if question.key not in self.answers and question.guess is None
        ]

    @property
    def answers_and_guesses(self) -> dict[str, str]:
        """Key of a question -> answer, or else guess."""
        guesses = {
            question.key: question.guess
            for question in self.questions
            if question.guess is not None
        }
        return guesses | dict(self.answers)

    def complete(self) -> dict[str, str]:
        """Return answers and guesses by key; CampaignError if an answer is missing or invalid."""
        # Files that must be exported again are reported first.
        if file_problems := [line for line in self.problems if line.startswith(f"{FILES_KEY}: ")]:
            raise CampaignError("init", file_problems, code="wrong-file-type")
        missing_answers = [
            f"{question.key}: {question.text} No answer was given."
            for question in self.open_questions
            if not any(line.startswith(f"{question.key}: ") for line in self.problems)
        ]
        if self.problems:
            raise InvalidAnswersError("init", [*missing_answers, *self.problems])
        if missing_answers:
            raise MissingAnswersError("init", missing_answers)
        return self.answers_and_guesses


def relative_path(file: Path, folder: Path) -> str:
    """Return the path of a file relative to a folder; absolute without a common parent."""
    file = file.resolve()
    if file.anchor != folder.anchor or file.parts[1:2] != folder.parts[1:2]:
        return str(file)
    return Path(os.path.relpath(file, folder)).as_posix()


def _find_unit_error(unit: str, target_unit: str) -> str:
    try:
        unit_factor(unit, target_unit, gravity=STANDARD_GRAVITY)
    except ValueError as error:
        return str(error)
    return ""


def make_turntable_questions(
    common_guess: FileGuess, sense: str | None, answered_keys: Collection[str] = ()
) -> Iterator[FileQuestion]:
    """Yield the questions about records of a double turntable.

    answered_keys: Keys that have been answered.
    """
    names = tuple(column.name for column in common_guess.contents.columns)
    yield from make_site_questions(common_guess.contents, ALL_SHEETS)
    text = (
        "What is the distance from the spindle axis to the platform (the "
        f"radius)?{_describe_amplitude(common_guess)}"
    )
    yield FileQuestion("radius", text, "2.5 ± 1e-5 m", quantity="m")
    yield from make_time_questions(common_guess, names)
    yield from _make_angle_questions(common_guess, names, sense)
    if common_guess.rate is None:
        text = "What is the rate of the centrifuge?"
        yield FileQuestion("rate", text, "0.25 rev/s", quantity="rad/s")
    if not common_guess.signals or "signal" in answered_keys:
        yield FileQuestion("signal", "Which column contains the signal?", names[-1], names)
    yield from _make_signal_questions(common_guess)


def make_site_questions(contents: FileContents, *extra_answers: str) -> Iterator[FileQuestion]:
    """Yield the questions about the sheet of a workbook, and about the site.

    extra_answers: Choices in addition to the names of the sheets.
    """
    if contents.sheets:
        text = "Which sheet contains the table?"
        if extra_answers:
            text = (
                f"Which sheet contains the table of a run (enter '{ALL_SHEETS}' to use every "
                "sheet)?"
            )
        yield FileQuestion("sheet", text, contents.sheets[0], (*contents.sheets, *extra_answers))
    yield FileQuestion(
        "gravity", "What is the local gravity?", "9.8066 ± 1e-5 m/s^2", quantity="m/s^2"
    )
    yield FileQuestion("latitude", "What is the latitude?", "45.75 deg", quantity="rad")


def _describe_amplitude(common_guess: FileGuess) -> str:
    for signal in common_guess.signals:
        if signal.observable == "displacement" and signal.unit and signal.amplitude > 0.0:
            amplitude = signal.amplitude * unit_factor(signal.unit, "m")
            return f" The displacement has an amplitude of {amplitude:.4g} m."
    return ""


def make_time_questions(common_guess: FileGuess, names: tuple[str, ...]) -> Iterator[FileQuestion]:
    """Yield the questions about the time of each row."""
    time = common_guess.time
    text = "Which column contains the time?"
    yield FileQuestion(
        "time", text, names[0], (*names, NO_COLUMN), time.column if time else NO_COLUMN
    )
    if time is not None and time.unit != "iso":
        text = f"What is the unit of the time column '{time.column}'?"
        yield FileQuestion("time unit", text, "s", COMMON_UNITS["s"], time.unit, unit="s")
    if time is None:
        reason = explain_missing_time(common_guess.contents)
        if common_guess.shared_times is not None and common_guess.uncounted_reason:
            name = common_guess.shared_times.name
            reason = f"Column '{name}' is not used as the time: {common_guess.uncounted_reason}"
        text = f"{reason}. What is the sampling rate?"
        guess = f"{common_guess.sampling_rate:.12g} Hz" if common_guess.sampling_rate else None
        yield FileQuestion("sampling_rate", text, "50 Hz", guess=guess, quantity="Hz")


def _make_angle_questions(
    common_guess: FileGuess, names: tuple[str, ...], sense: str | None
) -> Iterator[FileQuestion]:
    angle = common_guess.angle
    text = "Which column contains the spindle angle?"
    yield FileQuestion(
        "angle", text, names[0], (*names, NO_COLUMN), angle.column if angle else NO_COLUMN
    )
    if angle is not None and not angle.pulses:
        text = f"What is the unit of the angle column '{angle.column}'?"
        # Counts are not a unit of angle, but the column may contain counts.
        choices = ("deg", "rad", "rev", "mrad", "arcmin", "arcsec", "count")
        yield FileQuestion("angle unit", text, "deg", choices, guess=angle.unit)
    if angle is not None and angle.unit == "count":
        suggestion = f" The periodic signals suggest {angle.period:.6g}." if angle.period else ""
        text = f"How many counts of column '{angle.column}' are there per revolution?{suggestion}"
        counts_text = f"{angle.per_revolution:.12g}" if angle.per_revolution else None
        yield FileQuestion("per_revolution", text, "65536", guess=counts_text)
    text = "In which sense does the angle increase, as seen from above?"
    if angle is None or angle.pulses:
        text = "In which sense does the centrifuge rotate, as seen from above?"
    # With both horizontal axes, the signals show the sense.
    text += "".join(f" Not read: {reason}" for reason in common_guess.contents.unread_reasons)
    yield FileQuestion("sense", text, SENSES[0], SENSES, guess=sense)


def _make_signal_questions(common_guess: FileGuess) -> Iterator[FileQuestion]:
    signals = {signal.column: signal for signal in common_guess.signals}
    other_columns = {guess.column for guess in (common_guess.time, common_guess.angle) if guess}
    for column in common_guess.contents.columns:
        name = column.name
        if name in other_columns or column.is_timestamp:
            continue
        signal = signals.get(name)
        guess = signal.observable if signal else UNUSED_ROLE
        if common_guess.temperature is not None and common_guess.temperature[0] == name:
            guess = TEMPERATURE_ROLE
        text = f"What does column '{name}' contain?"
        scale = temperature_scale(column)
        choices = (*OBSERVABLES, *([] if scale is None else [TEMPERATURE_ROLE]), UNUSED_ROLE)
        yield FileQuestion(f"{name} is", text, choices[0], choices, guess)
        if signal is None:
            continue
        text = f"What is the unit of column '{name}'?"
        si_unit = OBSERVABLES.get(signal.observable or "", ANY_SIGNAL)
        units = COMMON_UNITS[si_unit]
        yield FileQuestion(f"{name} unit", text, units[0], units, signal.unit, unit=si_unit)
        text = f"Along which axis was column '{name}' measured?"
        yield FileQuestion(f"{name} axis", text, AXES[0], AXES, guess=signal.axis)


def validate_answers(
    answers: Mapping[str, str] | None,
    make_questions: Callable[[Mapping[str, str]], Sequence[FileQuestion]],
) -> tuple[dict[str, str], tuple[str, ...]]:
    """Return the valid answers in the form of a description, and the errors of the others.

    make_questions: Function of the known answers that returns all questions, because answers
        such as the unit of the angle lead to further guesses.
    """
    known_answers: dict[str, str] = {}
    while True:
        valid_answers, problems = parse_answers(make_questions(known_answers), answers or {})
        if set(valid_answers) <= set(known_answers):
            return valid_answers, tuple(problems)
        known_answers |= valid_answers


def parse_answers(
    questions: Sequence[FileQuestion], answers: Mapping[str, str]
) -> tuple[dict[str, str], list[str]]:
    """Return the valid answers in the form of a description, and the errors of the others."""
    question_by_key = {question.key: question for question in questions}
    valid_answers: dict[str, str] = {}
    problems: list[str] = []
    for key, answer in answers.items():
        if key not in question_by_key:
            required_keys = [question.key for question in questions if question.guess is None]
            text = f"{key}: not one of the questions: {', '.join(required_keys) or 'none'}"
            problems.append(Problem(text, "unknown-key"))
            continue
        try:
            valid_answers[key] = question_by_key[key].parse_answer(answer)
        except ValueError as error:
            problems.append(Problem(f"{key}: {error}", error_code(error)))
    return valid_answers, problems


# Conclusions from several signals

#: Axis -> opposite axis, and phase between them, rad.
_OPPOSITE_AXES: Final = {"west": ("east", math.pi), "south": ("north", math.pi)}
#: Relative tolerance of a signal's amplitude, for the error of its scale factor.
_AMPLITUDE_TOLERANCE: Final = 0.1
#: Tolerance of the phase difference between signals along two axes, rad.
_PHASE_TOLERANCE: Final = 0.3


def find_sense(common_guess: FileGuess) -> str | None:
    """Return the sense in which the angle increases, from two horizontal signals; or None."""
    phases_by_observable: dict[str, dict[str, float]] = {}
    for signal in common_guess.signals:
        if signal.phase is not None and signal.axis is not None and signal.observable:
            axis, axis_phase = _OPPOSITE_AXES.get(signal.axis, (signal.axis, 0.0))
            phases_by_observable.setdefault(signal.observable, {})[axis] = signal.phase + axis_phase
    for phases in phases_by_observable.values():
        if "east" in phases and "north" in phases:
            phase_lead = math.remainder(phases["east"] - phases["north"], 2.0 * math.pi)
            if abs(abs(phase_lead) - math.pi / 2.0) < _PHASE_TOLERANCE:
                return SENSES[0] if phase_lead > 0.0 else SENSES[1]
    return None


def complete_guess(common_guess: FileGuess, answers: Mapping[str, str]) -> FileGuess:
    """Return a guess with units inferred from the radius and axes inferred from the sense.

    answers: Key of a question -> answer.
    """
    signals = common_guess.signals
    if (
        "radius" in answers
        and common_guess.rate is not None
        and (common_guess.time or common_guess.sampling_rate)
    ):
        radius = parse_quantity(answers["radius"], "m").value
        signals = tuple(_infer_unit(signal, radius, common_guess.rate) for signal in signals)
    if "sense" in answers:
        sense_sign = 1.0 if answers["sense"] == SENSES[0] else -1.0
        signals = tuple(_infer_axis(signal, signals, sense_sign) for signal in signals)
    return replace(common_guess, signals=signals)


def _infer_unit(signal: SignalGuess, radius: float, rate: float) -> SignalGuess:
    """Return a signal with the unit that fits its amplitude at a radius, m, and a rate, rad/s."""
    if signal.unit is not None or signal.observable is None:
        return signal
    derivative_order = list(OBSERVABLES).index(signal.observable)
    si_unit = OBSERVABLES[signal.observable]
    expected_amplitude = radius * rate**derivative_order
    for unit in COMMON_UNITS[si_unit]:
        amplitude = signal.amplitude * unit_factor(unit, si_unit, gravity=STANDARD_GRAVITY)
        if abs(amplitude / expected_amplitude - 1.0) < _AMPLITUDE_TOLERANCE:
            return replace(signal, unit=unit, is_unit_from_radius=True)
    return signal


def _infer_axis(
    signal: SignalGuess, signals: tuple[SignalGuess, ...], sense_sign: float
) -> SignalGuess:
    """Return a signal with the axis that its phase relative to another signal shows.

    sense_sign: 1 if the angle increases counterclockwise, -1 if clockwise.
    """
    if signal.axis is not None or signal.phase is None or signal.observable is None:
        return signal
    for reference in signals:
        if reference.axis not in COMPASS_ANGLES or reference.observable != signal.observable:
            continue
        if reference.phase is None:
            continue
        direction = COMPASS_ANGLES[reference.axis] + sense_sign * (reference.phase - signal.phase)
        for axis, axis_direction in COMPASS_ANGLES.items():
            angle_difference = abs(math.remainder(direction - axis_direction, 2.0 * math.pi))
            if axis != reference.axis and angle_difference < _PHASE_TOLERANCE:
                return replace(signal, axis=axis)
    return signal
