"""From a record of a sensor with three axes, set down in many poses, to a campaign's description.

Such a record shows itself: it rests many times, and at each rest three of its columns are together
as large as gravity, whichever way they share it. Angular rates beside them are nothing then.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from counterspin.arrays import Array
from counterspin.campaign.memory.records import record_name
from counterspin.campaign.quantity import parse
from counterspin.errors import CampaignError, RecordError
from counterspin.exports.guessing import (
    STANDARD_GRAVITY,
    FileGuess,
    converts,
    guess_file,
    is_even,
)
from counterspin.exports.looking import FileColumn, Look
from counterspin.exports.questions import (
    AnsweredExport,
    ExportQuestion,
    place_questions,
    relative_name,
    settled,
    time_questions,
)
from counterspin.frozen import frozen
from counterspin.physics.grades import GRADES
from counterspin.records.column_file import quoted
from counterspin.records.poses import SHORTEST_REST, Poses, find_poses
from counterspin.units import unit_factor

#: The triad's accelerometers, and their axes in its frame.
AXES: Final = {"X": ("east", "north"), "Y": ("north", "up"), "Z": ("up", "east")}
#: Usual units of a sensor's output.
_UNITS: Final = ("m/s^2", "g", "mg", "count", "V", "mV", "mA")
#: Time from one file to the next where rests are looked for in all, s: none goes on.
_BETWEEN_FILES: Final = 100.0
#: Rows a second that are taken to look for rests where nobody has said how many there are.
_USUAL_RATE: Final = 100.0
#: Rows, and columns one after the other, in which rests are looked for at most.
_MOST_ROWS: Final = 500_000
_MOST_TRIPLES: Final = 40
#: Fewest rests of a record that is guessed to be one of poses; where the middle of their sphere is
#: to be found as well.
_FEWEST_POSES: Final = 6
_FEWEST_ABOUT_MIDDLE: Final = 9
#: At rest the values are together as large as gravity within this part: biases are in it too.
_GRAVITY_PART: Final = 0.15
#: About the middle of their sphere they are as large within this one: axes are not equally good.
_SPHERE_PART: Final = 0.05
#: Steps of a time without a unit, from which it is in ms, and in us: sensors give 2 rows a second
#: to some thousands.
_STEPS_IN: Final = {"us": 500.0, "ms": 0.5, "s": 0.0}
#: Noise density from which a sensor is guessed to be of a worse grade, g/Hz^0.5.
_NOISY: Final = {"consumer": 5e-5, "tactical": 2e-6}


@frozen
class PosesDraft(AnsweredExport):
    """What a record of poses shows, and what a person has answered."""

    guesses: tuple[FileGuess, ...]  #: Of each file.
    triad: tuple[str, str, str] | None  #: The columns of the three axes; None: not known yet.

    @property
    def files(self) -> list[Path]:
        """The records."""
        return [guess.look.path for guess in self.guesses]

    @property
    def look(self) -> Look:
        """What is in the first file."""
        return self.guesses[0].look

    def document(self, folder: Path) -> dict[str, Any]:
        """Return the description that guesses and answers make; CampaignError if one is missing.

        folder: The campaign's.
        """
        said, place = self.complete(), folder.resolve()
        columns = [said[axis] for axis in AXES]
        if len(set(columns)) < len(columns):
            text = f"each axis has a column of its own, not {', '.join(columns)}"
            raise CampaignError("init", [text])
        time = self.guesses[0].time
        rows = {"sampling_rate": said.get("sampling_rate")}
        if time is not None:
            rows = {"column": time.column, "unit": time.unit or said["time unit"]}
        instruments = {}
        for column, (name, (input_axis, pendulous)) in zip(columns, AXES.items(), strict=True):
            table: dict[str, Any] = {"input_axis": input_axis, "pendulous_axis": pendulous}
            table["grade"] = said["grade"]
            if "sensitivity" in said:
                table["output"] = {"unit": said["unit"], "sensitivity": said["sensitivity"]}
            if f"{name} zero" in said:
                table["output"]["zero"] = said[f"{name} zero"]
            instruments[name] = table | {"specific_force": {"column": column, "unit": said["unit"]}}
        names: list[Any] = []
        runs = []
        for file in self.files:
            names.append(Path(record_name(file.stem, "", names)).name)
            runs.append(
                {
                    "name": names[-1],
                    "motion": "static",
                    "attitude": "unknown",
                    "record": relative_name(file, place),
                    "poses": {"rest": said["rest"]},
                }
            )
        return {
            "schema": 1,
            "campaign": {"title": place.name},
            "site": {"gravity": said["gravity"], "latitude": said["latitude"]},
            "records": {"time": rows},
            "accelerometers": instruments,
            "triad": {"accelerometers": list(AXES)},
            "runs": runs,
        }


def poses_draft(looks: Sequence[Look], answers: Mapping[str, str] | None = None) -> PosesDraft:
    """Return what records of poses show, and what has to be asked.

    answers: By the keys of questions; they stand above what is guessed.
    """
    if not looks:
        raise CampaignError("init", ["name the record of the poses"])
    guesses: tuple[FileGuess, ...] = ()
    questions: tuple[ExportQuestion, ...] = ()
    found: _Triad | None = None

    def asked(taken: Mapping[str, str]) -> tuple[ExportQuestion, ...]:
        nonlocal guesses, questions, found
        guesses = tuple(_guessed(look, taken) for look in looks)
        found = _triad(guesses, taken)
        questions = tuple(_questions(guesses[0], found, taken))
        return questions

    taken, problems = settled(answers, asked)
    statements = tuple(_statements(guesses, found, taken))
    return PosesDraft(
        statements, questions, taken, problems, guesses, found.columns if found else None
    )


def shows_poses(looks: Sequence[Look]) -> bool:
    """Return whether files seem to be records of a sensor that was set down in many poses."""
    found = _triad([_guessed(look, {}) for look in looks], {})
    return found is not None and found.unit is not None


# What is guessed


@frozen(eq=False)
class _Triad:
    """Three columns, and where they rest."""

    columns: tuple[str, str, str]
    unit: str | None  #: None: unknown.
    poses: Poses | None  #: None: none were found.
    #: What the columns read where nothing is felt, shape (3,): zero, or the middle of the sphere on
    #: which the poses lie.
    zero: Array = field(default_factory=lambda: np.zeros(3))

    @property
    def gravity(self) -> float:
        """What is felt at rest, in the median, in the columns' unit."""
        if self.poses is None:
            return math.nan
        return float(np.median(_norms(self.poses.mean - self.zero)))


def _guessed(look: Look, told: Mapping[str, str]) -> FileGuess:
    """Return which column is what, where nothing turns: what rises in even steps is the time."""
    guess = guess_file(look, told)
    first = look.columns[0]
    if guess.time is None and "time" not in told and is_even(first.values):
        guess = guess_file(look, {**told, "time": first.name})
    if guess.time is not None and guess.time.unit is None:
        column = next(one for one in look.columns if one.name == guess.time.column)
        step = float(np.nanmedian(np.diff(column.values)))
        unit = next(unit for unit, least in _STEPS_IN.items() if step > least)
        guess = guess_file(look, {**told, "time": column.name, "time unit": unit})
    return guess


def _triad(guesses: Sequence[FileGuess], told: Mapping[str, str]) -> _Triad | None:
    """Return the columns of a triad: those that are told, or three that rest like one in all files.

    Of several, such as a magnetometer's beside, the first whose size at rest is gravity's.
    """
    guess = guesses[0]
    columns, seconds = _together(guesses)
    named = [columns[told[axis]] for axis in AXES if told.get(axis) in columns]
    rest = parse(told["rest"], "s").value if "rest" in told else SHORTEST_REST
    if len(named) == len(AXES):
        return _looked_at(named, seconds, rest, told.get("unit"))
    time = guess.time.column if guess.time else None
    there = [one for one in columns.values() if one.name != time]
    there = [one for one in there if len(one.values) == len(seconds)]
    like: list[_Triad] = []
    for place in range(min(len(there) - 2, _MOST_TRIPLES)):
        three = there[place : place + 3]
        if len({one.unit for one in three}) == 1 and _may_be_force(three[0].unit):
            found = _looked_at(three, seconds, rest, told.get("unit"))
            if found.poses is not None and _turns(found.poses.mean - found.zero):
                if found.unit is not None:
                    return found
                like.append(found)
    return next(iter(like), None)


def _together(guesses: Sequence[FileGuess]) -> tuple[dict[str, FileColumn], Array]:
    """Return the columns that all files have, one file after the other, and the time in s."""
    files = [
        {column.name: column for column in guess.look.columns if not column.stamps}
        for guess in guesses
    ]
    lengths = [max(len(column.values) for column in own.values()) for own in files]
    times, start = [], 0.0
    for guess, length in zip(guesses, lengths, strict=True):
        own = _seconds(guess, length)
        times.append(own - np.nanmin(own) + start)
        start = float(np.nanmax(times[-1])) + _BETWEEN_FILES
    columns = {
        name: replace(column, values=np.concatenate([own[name].values for own in files]))
        for name, column in files[0].items()
        if [len(own[name].values) if name in own else 0 for own in files] == lengths
    }
    return columns, np.concatenate(times)


def _seconds(guess: FileGuess, rows: int) -> Array:
    if guess.time is None:
        return np.arange(rows) / (guess.sampling or _USUAL_RATE)
    column = next(one for one in guess.look.columns if one.name == guess.time.column)
    return column.values * guess.time.factor


def _may_be_force(unit: str) -> bool:
    return not unit or converts(unit, "m/s^2") or unit in _UNITS


def _looked_at(
    columns: Sequence[FileColumn], seconds: Array, rest: float, unit: str | None
) -> _Triad:
    """Return where three columns rest, and their unit: as told, by the file or by their size."""
    first, second, third = (column.name for column in columns)
    named = (first, second, third)
    values = np.column_stack([column.values[:_MOST_ROWS] for column in columns])
    try:
        poses = find_poses(seconds[:_MOST_ROWS], values, rest)
    except RecordError:
        return _Triad(named, unit or columns[0].unit or None, None)
    if unit is None and not (unit := columns[0].unit):
        felt = _norms(poses.mean)
        near = [
            one
            for one in _UNITS
            if converts(one, "m/s^2")
            and _is_gravity(felt * unit_factor(one, "m/s^2", gravity=STANDARD_GRAVITY))
        ]
        unit = next(iter(near), "")
    # Counts and volts may be any number where nothing is felt, a specific force is none there.
    zero = np.zeros(3) if converts(unit or "", "m/s^2") else _middle(poses.mean)
    unit = unit or ("count" if _whole(values) else "")
    return _Triad(named, unit or None, poses, zero)


def _whole(values: Array) -> bool:
    """Return whether all numbers are whole ones, as a converter counts."""
    there = values[np.isfinite(values)]
    return bool(np.all(there == np.round(there)) and np.ptp(there) > 1.0)


def _middle(means: Array) -> Array:
    """Return the middle of the sphere on which poses lie, shape (3,); zero where that serves.

    |m|^2 = 2 c m + r^2 - |c|^2 is linear in the middle c.
    """
    none = np.zeros(3)
    if len(means) < _FEWEST_ABOUT_MIDDLE or _turns(means):
        return none
    center = means.mean(axis=0)
    apart = means - center
    known = np.column_stack([2.0 * apart, np.ones(len(apart))])
    middle = np.linalg.lstsq(known, np.sum(apart**2, axis=1), rcond=None)[0][:3] + center
    return middle if _alike(_norms(means - middle), _SPHERE_PART) else none


def _alike(sizes: Array, part: float) -> bool:
    return bool(np.mean(np.abs(sizes / np.median(sizes) - 1.0) < part) > 0.8)


def _norms(means: Array) -> Array:
    return np.asarray(np.linalg.norm(means, axis=1))


def _is_gravity(felt: Array) -> bool:
    """Return whether most of what is felt at rest, m/s^2, is gravity, wrongly scaled a little."""
    return bool(np.mean(np.abs(felt / STANDARD_GRAVITY - 1.0) < _GRAVITY_PART) > 0.8)


def _turns(means: Array) -> bool:
    """Return whether poses, (n, 3), are many, alike in size and unlike in direction."""
    felt = _norms(means)
    spread = np.linalg.svd(means / felt[:, None], compute_uv=False)
    many = len(felt) >= _FEWEST_POSES
    # In at least three directions, none of them rare.
    return bool(many and _alike(felt, _GRAVITY_PART) and spread[-1] > 0.2 * spread[0])


def _grade(found: _Triad, seconds_a_row: float) -> str | None:
    """Return a grade by the noise at rest; None where nothing tells it."""
    if found.poses is None:
        return None
    scatter = float(np.median(found.poses.scatter)) / found.gravity
    density = scatter * math.sqrt(2.0 * seconds_a_row)
    return next((grade for grade, least in _NOISY.items() if density > least), GRADES[0])


# What is asked, and said


def _questions(
    guess: FileGuess, found: _Triad | None, told: Mapping[str, str]
) -> Iterator[ExportQuestion]:
    names = tuple(column.name for column in guess.look.columns)
    yield from place_questions(guess.look)
    yield from time_questions(guess, names)
    for place, axis in enumerate(AXES):
        text = f"Which column is the sensor's axis {axis}?"
        known = found.columns[place] if found else None
        yield ExportQuestion(axis, text, names[min(place, len(names) - 1)], names, known)
    text = "In which unit are the three axes?"
    if found and math.isfinite(found.gravity):
        text += f" At rest they are together {found.gravity:.4g}."
    unit = told.get("unit") or (found.unit if found else None)
    yield ExportQuestion("unit", text, _UNITS[0], _UNITS, unit)
    if unit is not None and not converts(unit, "m/s^2"):
        text = "What is the nominal sensitivity?"
        felt = found.gravity if found else math.nan
        size = f"{felt:.4g} {unit}/g" if math.isfinite(felt) else None
        yield ExportQuestion(
            "sensitivity", text, f"1000 {unit}/g", guess=size, quantity=f"{unit}/g"
        )
        for axis, zero in zip(AXES, found.zero if found else (), strict=False):
            if found and np.any(found.zero):
                text = f"What does axis {axis} read where it feels nothing, nominally?"
                size = f"{zero:.4g} {unit}"
                yield ExportQuestion(f"{axis} zero", text, size, guess=size, quantity=unit)
    text = "How long does a rest last at least that is a pose?"
    usual = f"{SHORTEST_REST:g} s"
    yield ExportQuestion("rest", text, usual, guess=usual, quantity="s")
    text = "Of which grade is the sensor? It says how large what nobody states may be."
    grade = _grade(found, _step(guess)) if found else None
    yield ExportQuestion("grade", text, "consumer", GRADES, grade)


def _step(guess: FileGuess) -> float:
    if guess.time is None:
        return 1.0 / (guess.sampling or _USUAL_RATE)
    column = next(one for one in guess.look.columns if one.name == guess.time.column)
    return float(np.nanmedian(np.diff(column.values))) * guess.time.factor


def _statements(
    guesses: Sequence[FileGuess], found: _Triad | None, told: Mapping[str, str]
) -> Iterator[str]:
    for guess in guesses:
        rows = max(len(column.values) for column in guess.look.columns)
        said = [f"{rows} rows", *filter(None, [guess.look.found])]
        yield f"{guess.look.path.name}: {', '.join(said)}"
    time, sampling = guesses[0].time, guesses[0].sampling
    if time is not None:
        yield f"time: column '{time.column}', in {time.unit or 'an unknown unit'}"
    elif sampling is not None:
        yield f"time: no column; {sampling:.8g} rows a second"
    if found is None:
        return
    unit = f" in {found.unit}" if found.unit else ""
    yield f"a sensor with three axes: columns {quoted(found.columns)}{unit}"
    poses = found.poses
    if poses is None:
        yield "no rest was found in it"
        return
    usual = " if it has 100 rows a second" if time is None and sampling is None else ""
    usual = ", its first part," + usual if len(poses.level) == _MOST_ROWS else usual
    where = guesses[0].look.path.name if len(guesses) == 1 else f"{len(guesses)} files"
    level = f"{poses.threshold:.3g} {found.unit or ''}".strip()
    yield (
        f"{len(poses.start)} poses in {where}{usual}: rests of at least "
        f"{told.get('rest', f'{SHORTEST_REST:g} s')} in which the axes together scatter by less "
        f"than {level}; their attitudes are unknown"
    )
    yield from poses.doubts
    yield from poses.left_out
    unused = [name for name in guesses[0].unused if name not in found.columns]
    others = [s.column for s in guesses[0].signals if s.column not in found.columns]
    if not_used := [*others, *unused]:
        yield f"not used: {', '.join(not_used[:20])}"
