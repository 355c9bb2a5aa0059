"""Find the columns of a sensor's three axes, and its poses.

At rest the norm of three columns is gravity in any attitude: poses lie on a sphere. Its centre is
zero, except for a converter's counts and for the volts of a single supply. A record has many rows
at each rest; each row of a table of poses is one.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import field, replace
from itertools import filterfalse, islice
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.campaign.quantity import parse_quantity
from counterspin.errors import RecordError
from counterspin.frozen import frozen
from counterspin.ingest.column_roles import FileGuess, guess_file, is_even, is_nominal
from counterspin.ingest.contents import FileColumn, FileContents
from counterspin.physics.grades import GRADES
from counterspin.triads.section import USUAL_AXES
from counterspin.triads.static_intervals import (
    MIN_CONTRAST,
    MIN_DURATION,
    StaticIntervals,
    find_poses,
)
from counterspin.units import STANDARD_GRAVITY, is_convertible, unit_factor

#: The triad's accelerometers, and their axes in its frame.
AXES: Final = dict(zip("XYZ", USUAL_AXES, strict=True))
#: Usual units of a sensor's output.
UNITS: Final = ("m/s^2", "g", "mg", "count", "V", "mV", "mA")
#: Time from one file to the next where rests are looked for in all, s: none goes on.
_BETWEEN_FILES: Final = 100.0
#: Rests that are looked for where nobody says how long they are, s, and how many times as many of
#: the shorter ones there have to be for them to be meant.
_RESTS: Final = (MIN_DURATION, 0.5)
_MANY_MORE: Final = 1.25
#: Rows a second that are taken to look for rests where nobody has said how many there are.
USUAL_RATE: Final = 100.0
#: Rows, and columns by threes, in which rests are looked for at most; rows of a table in which each
#: may be a pose, and how far these turn from one to the next, of gravity.
MOST_ROWS: Final = 500_000
_MOST_THREES: Final = 40
_MOST_POSES: Final = 1000
_LEAST_TURN: Final = 0.1
#: Fewest rests of a record that is guessed to be one of poses; where the middle of their sphere is
#: to be found as well.
_FEWEST_POSES: Final = 6
_FEWEST_ABOUT_MIDDLE: Final = 9
#: At rest the values are together as large as gravity within this part: biases are in it too.
_GRAVITY_PART: Final = 0.15
#: About the middle of their sphere they are as large within this one: axes are not equally good.
_SPHERE_PART: Final = 0.05
#: Norms that agree within this part are those of computed directions.
_EXACT_PART: Final = 1e-6
#: Less of gravity than this is felt at rest where a filter took it away.
_NOTHING_PART: Final = 0.1
#: Steps of a time without a unit, from which it is in ms, us and ns: sensors give 2 rows a second
#: to some thousands.
_STEPS_IN: Final = {"ns": 500_000.0, "us": 500.0, "ms": 0.5, "s": 0.0}
#: Noise density from which a sensor is guessed to be of a worse grade, g/Hz^0.5.
_NOISY: Final = {"consumer": 5e-5, "tactical": 2e-6}
#: Bits of a converter's numbers, and jumps from one end of them to the other that tell.
_WORD_BITS: Final = (12, 14, 16, 24)
_FEWEST_JUMPS: Final = 4
#: Parameters of a triad, and how many times the noise of a pose their angles are known to at worst:
#: with less, 1e-3 g is more than the angle of a usual sensor. Six faces make hundreds.
PARAMETERS: Final = 9
_LOOSEST: Final = 50.0
#: Part by which poses of such a sensor differ in size, of a table that says no noise.
_UNLIKE: Final = 1e-3


@frozen(eq=False)
class TriadColumns:
    """Three columns, and their readings at rest."""

    columns: tuple[str, str, str]
    unit: str | None  #: None: unknown.
    poses: (
        StaticIntervals | None
    )  #: Rests of records; None: none were found, or each row of a table is one.
    means: Array | None = None  #: Of each pose, in the columns' unit, (n, 3); None: there is none.
    #: What the columns read where nothing is felt, shape (3,): zero, or the middle of the sphere on
    #: which the poses lie.
    zero: Array = field(default_factory=lambda: np.zeros(3))
    rest: float = MIN_DURATION  #: The shortest rest that counted, s.
    #: Further columns of three axes at rest at the same times, such as a second sensor's.
    others: tuple[tuple[str, ...], ...] = ()

    @property
    def gravity(self) -> float:
        """The median norm of the readings at rest, in the columns' unit."""
        if self.means is None:
            return math.nan
        return float(np.median(_norms(self.means - self.zero)))

    @property
    def tells_angles(self) -> bool:
        """True if poses lie between the axes, and so determine the angles between the axes."""
        if self.means is None or len(self.means) <= PARAMETERS:
            return False
        x, y, z = ((self.means - _centre(self.means)) / self.gravity).T
        felt = np.column_stack([x, y, z, x * x, y * y, z * z, x * y, x * z, y * z])
        loose = np.linalg.pinv(felt)[-3:]
        return bool(np.linalg.norm(loose, axis=1).max() < _LOOSEST)

    @property
    def in_table(self) -> bool:
        """True if each row is a pose."""
        return self.means is not None and self.poses is None


def guessed_poses(contents: FileContents, answers: Mapping[str, str]) -> FileGuess:
    """Return the role of each column without rotation: the time is what rises in even steps."""
    guess = guess_file(contents, answers)
    first = next(filterfalse(_counts_rows, contents.columns), contents.columns[0])
    known = {"time", "sampling_rate"} & set(answers)
    if guess.time is None and not known and is_even(first.values) and not _counts_rows(first):
        guess = guess_file(contents, {**answers, "time": first.name})
    if guess.time is not None and guess.time.unit is None:
        column = next(column for column in contents.columns if column.name == guess.time.column)
        step = _usual_step(column.values)
        unit = next(unit for unit, least in _STEPS_IN.items() if step > least)
        guess = guess_file(contents, {**answers, "time": column.name, "time unit": unit})
    return guess


def _counts_rows(column: FileColumn) -> bool:
    """Return whether a column numbers the rows, from any start; it is not a time then."""
    return bool(not column.unit and np.all(np.diff(column.values) == 1.0))


def find_triad(guesses: Sequence[FileGuess], answers: Mapping[str, str]) -> TriadColumns | None:
    """Return the columns of a triad: the answered ones, or three that rest alike in all files.

    If there are several, such as those of a magnetometer, return the first with the norm of gravity
    at rest.
    """
    guess = guesses[0]
    columns, seconds = _concatenate_files(guesses)
    if "rest" in answers:
        return _found_triad(
            columns, seconds, guess, answers, parse_quantity(answers["rest"], "s").value
        )
    found, shorter = (_found_triad(columns, seconds, guess, answers, rest) for rest in _RESTS)
    return shorter if _tells_more(shorter, found) else found or shorter


def _tells_more(shorter: TriadColumns | None, longer: TriadColumns | None) -> bool:
    """Return whether short rests are poses of the sensor that longer ones leave out.

    A hovering hand is not a pose: it moves too much, or its norm is not gravity.
    """
    if shorter is None or shorter.means is None:
        return False
    if longer is None or longer.means is None:
        return True
    many = len(shorter.means) >= _MANY_MORE * len(longer.means)
    felt = shorter.means - shorter.zero
    clear = shorter.poses is not None and shorter.poses.contrast > MIN_CONTRAST
    return many and clear and shorter.columns == longer.columns and _turns(felt)


def _found_triad(
    columns: Mapping[str, FileColumn],
    seconds: Array,
    guess: FileGuess,
    answers: Mapping[str, str],
    rest: float,
) -> TriadColumns | None:
    """Return the columns of a triad with rests of a given length, s, as `find_triad`."""
    named = [columns[answers[axis]] for axis in AXES if answers.get(axis) in columns]
    if len(named) == len(AXES):
        return _looked_at(named, seconds, rest, answers.get("unit"))
    time = guess.time.column if guess.time else None
    candidates = [column for column in columns.values() if column.name != time]
    candidates = [
        column
        for column in candidates
        if len(column.values) == len(seconds) and not is_nominal(column.values)
    ]
    like: list[TriadColumns] = []
    for three in islice(threes(candidates), _MOST_THREES):
        if len({column.unit for column in three}) == 1 and _may_be_force(three[0].unit):
            found = _looked_at(three, seconds, rest, answers.get("unit"))
            if found.means is not None and _turns(found.means - found.zero) and _varies(found):
                like.append(found)
    known = [found for found in like if found.unit is not None] or like
    others = (found.columns for found in known[1:] if _felt_alike(found, known[0]))
    apart = (named for named in others if not set(named) & set(known[0].columns))
    return replace(known[0], others=tuple(apart)) if known else None


def _varies(found: TriadColumns) -> bool:
    """Return whether norms at rest differ: equal norms are directions, not measurements."""
    assert found.means is not None
    norms = _norms(found.means)
    return bool(np.ptp(norms) > _EXACT_PART * np.median(norms))


def without_gravity(guess: FileGuess) -> tuple[str, ...]:
    """Return the axes of a sensor that reads zero at rest, as if a filter removed gravity."""
    columns, seconds = _concatenate_files([guess])
    candidates = [column for column in columns.values() if len(column.values) == len(seconds)]
    for three in islice(threes(candidates), _MOST_THREES):
        if not all(is_convertible(column.unit, "m/s^2") for column in three):
            continue
        values = np.column_stack([column.values[:MOST_ROWS] for column in three])
        try:
            poses = find_poses(seconds[:MOST_ROWS], values)
        except RecordError:
            continue
        one_g = STANDARD_GRAVITY / unit_factor(three[0].unit, "m/s^2", gravity=STANDARD_GRAVITY)
        still = len(poses.start) > 1 and poses.contrast > MIN_CONTRAST
        if still and _norms(poses.mean).max() < _NOTHING_PART * one_g:
            return tuple(column.name for column in three)
    return ()


def _felt_alike(triad: TriadColumns, reference: TriadColumns) -> bool:
    """Return whether two triads felt the same force: a magnetometer's rests turn differently."""
    known = triad.unit == reference.unit and triad.means is not None and reference.means is not None
    return known and bool(abs(triad.gravity / reference.gravity - 1.0) < _GRAVITY_PART)


def _concatenate_files(guesses: Sequence[FileGuess]) -> tuple[dict[str, FileColumn], Array]:
    """Return the columns that all files have, one file after the other, and the time in s."""
    files = [
        {column.name: column for column in guess.contents.columns if not column.stamps}
        for guess in guesses
    ]
    lengths = [
        max(len(column.values) for column in columns_of_file.values()) for columns_of_file in files
    ]
    times, start = [], 0.0
    for guess, length in zip(guesses, lengths, strict=True):
        seconds = _seconds(guess, length)
        times.append(seconds - np.nanmin(seconds) + start)
        start = float(np.nanmax(times[-1])) + _BETWEEN_FILES
    columns = {
        name: replace(
            column,
            values=np.concatenate([columns_of_file[name].values for columns_of_file in files]),
        )
        for name, column in files[0].items()
        if [
            len(columns_of_file[name].values) if name in columns_of_file else 0
            for columns_of_file in files
        ]
        == lengths
    }
    return columns, np.concatenate(times)


def _seconds(guess: FileGuess, rows: int) -> Array:
    if guess.time is None:
        return np.arange(rows) / (guess.sampling or USUAL_RATE)
    column = next(column for column in guess.contents.columns if column.name == guess.time.column)
    return column.values * guess.time.factor


def _may_be_force(unit: str) -> bool:
    return not unit or is_convertible(unit, "m/s^2") or unit in UNITS


def _looked_at(
    columns: Sequence[FileColumn], seconds: Array, rest: float, unit: str | None
) -> TriadColumns:
    """Return where three columns rest, and their unit: by an answer, the file or their norm."""
    first, second, third = (column.name for column in columns)
    named = (first, second, third)
    values = np.column_stack([column.values[:MOST_ROWS] for column in columns])
    _refuse_unsigned(columns, values)
    poses, means = None, _rows_of(values)
    if means is None:
        try:
            poses = find_poses(seconds[:MOST_ROWS], values, rest)
        except RecordError:
            return TriadColumns(named, unit or columns[0].unit or None, None, rest=rest)
        means = poses.mean
    if unit is None and not (unit := columns[0].unit):
        felt = _norms(means)
        near = [
            candidate
            for candidate in UNITS
            if is_convertible(candidate, "m/s^2")
            and _is_gravity(felt * unit_factor(candidate, "m/s^2", gravity=STANDARD_GRAVITY))
        ]
        unit = next(iter(near), "")
    # Counts and volts may be any number where nothing is felt, a specific force is none there.
    zero = np.zeros(3) if is_convertible(unit or "", "m/s^2") else _middle(means)
    unit = unit or ("count" if _are_integers(values) else "")
    return TriadColumns(named, unit or None, poses, means, zero, rest)


def _refuse_unsigned(columns: Sequence[FileColumn], values: Array) -> None:
    """Refuse counts below zero that were written as unsigned numbers: -1 as 65535."""
    known = values[np.isfinite(values).all(axis=1)]
    if not len(known) or not _are_integers(known) or known.min() < 0.0:
        return
    for bits in _WORD_BITS:
        most = 2.0**bits
        jumps = (np.abs(np.diff(known, axis=0)) > 0.9 * most).sum(axis=0)
        if 0.9 * most < known.max() < most and (jumps >= _FEWEST_JUMPS).any():
            names = ", ".join(f"'{column.name}'" for column in columns)
            raise RecordError(
                f"the columns {names} jump between 0 and {most - 1:.0f}, because signed "
                f"{bits}-bit numbers (two's complement) were written as unsigned numbers. "
                f"Export signed numbers, or subtract {most:.0f} from each number that is "
                f"{most / 2:.0f} or more.",
                code="unsigned-numbers",
            )


def _rows_of(values: Array) -> Array | None:
    """Return the rows of a table in which each is a pose, shape (n, 3); None for a record."""
    rows = values[np.isfinite(values).all(axis=1)]
    if not _FEWEST_POSES <= len(rows) <= _MOST_POSES:
        return None
    apart = rows - _middle(rows)
    # From one row of a record to the next hardly anything turns.
    turned = np.median(_norms(np.diff(apart, axis=0))) / np.median(_norms(apart))
    return rows if turned > _LEAST_TURN and _turns(apart) else None


def _are_integers(values: Array) -> bool:
    """Return whether all numbers are integers, as a converter counts."""
    known = values[np.isfinite(values)]
    return bool(np.all(known == np.round(known)) and np.ptp(known) > 1.0)


def _middle(means: Array) -> Array:
    """Return the centre of the sphere of the poses, shape (3,); zero where zero suffices."""
    none = np.zeros(3)
    if len(means) < _FEWEST_ABOUT_MIDDLE or _turns(means):
        return none
    middle = _centre(means)
    return middle if _alike(_norms(means - middle), _SPHERE_PART) else none


def _centre(means: Array) -> Array:
    """Return the middle c of a sphere through poses m: |m|^2 = 2 c m + r^2 - |c|^2 is linear."""
    mean = means.mean(axis=0)
    apart = means - mean
    known = np.column_stack([2.0 * apart, np.ones(len(apart))])
    found = np.linalg.lstsq(known, np.sum(apart**2, axis=1), rcond=None)[0][:3]
    return np.asarray(found + mean, np.float64)


def _alike(sizes: Array, part: float) -> bool:
    return bool(np.mean(np.abs(sizes / np.median(sizes) - 1.0) < part) > 0.8)


def _norms(means: Array) -> Array:
    return np.asarray(np.linalg.norm(means, axis=1))


def _is_gravity(felt: Array) -> bool:
    """Return whether most readings at rest, m/s^2, are gravity with a small scale error."""
    return bool(np.mean(np.abs(felt / STANDARD_GRAVITY - 1.0) < _GRAVITY_PART) > 0.8)


def _turns(means: Array) -> bool:
    """Return whether poses, (n, 3), are many, with equal norms and different directions."""
    felt = _norms(means)
    if not felt.all():
        return False
    spread = np.linalg.svd(means / felt[:, None], compute_uv=False)
    many = len(felt) >= _FEWEST_POSES
    # In at least three directions, none of them rare.
    return bool(many and _alike(felt, _GRAVITY_PART) and spread[-1] > 0.2 * spread[0])


def grade_of(found: TriadColumns, guess: FileGuess) -> str | None:
    """Return a grade from the noise at rest; None if nothing shows it."""
    if found.means is None:
        return None
    if found.poses is None:
        # Sensitivities and axes that are so far from alike are no better sensor's.
        apart = _norms(found.means - found.zero) / found.gravity - 1.0
        return "consumer" if float(np.median(np.abs(apart))) > _UNLIKE else None
    scatter = float(np.median(found.poses.scatter)) / found.gravity
    density = scatter * math.sqrt(2.0 * _step(guess))
    return next((grade for grade, least in _NOISY.items() if density > least), GRADES[0])


def _step(guess: FileGuess) -> float:
    if guess.time is None:
        return 1.0 / (guess.sampling or USUAL_RATE)
    column = next(column for column in guess.contents.columns if column.name == guess.time.column)
    return _usual_step(column.values) * guess.time.factor


def _usual_step(time: Array) -> float:
    """Return the median step of a time that may be constant over some rows."""
    steps = np.diff(time)
    return float(np.median(steps[steps > 0.0]))


# Which columns may be the axes, by names and order

Three = tuple[FileColumn, FileColumn, FileColumn]

#: Names of what a filter made of a sensor's rows: gravity's direction, which fits any sphere.
_OF_FILTER: Final = re.compile(r"(?i).*grav")


def threes(columns: Sequence[FileColumn]) -> Iterator[Three]:
    """Yield columns that may be axes X, Y and Z of a sensor, the likeliest first.

    Names that differ in these letters alone belong together, in the order of the letters and at any
    place; other columns do if they are adjacent.
    """
    named = _axis_columns(columns)
    yield from sorted(named, key=lambda three: bool(_OF_FILTER.match(three[0].name)))
    taken = {column.name for three in named for column in three}
    others = [column for column in columns if column.name not in taken]
    yield from zip(others, others[1:], others[2:], strict=False)


def _axis_columns(columns: Sequence[FileColumn]) -> list[Three]:
    """Return columns whose names differ only in the letters x, y and z, in the file's order."""
    alike: dict[tuple[str, str, bool], dict[str, FileColumn]] = {}
    for column in columns:
        for letter in re.finditer("(?i)[xyz]", column.name):
            before, behind = column.name[: letter.start()], column.name[letter.end() :]
            family = alike.setdefault((before, behind, letter[0].isupper()), {})
            family[letter[0].lower()] = column
    return [
        (letters["x"], letters["y"], letters["z"])
        for letters in alike.values()
        if len(letters) == len("xyz")
    ]
