"""Find the columns of a sensor's three axes, and its poses.

At rest the norm of the three columns is gravity in any attitude, so that poses lie on a sphere. Its
centre is zero, except for counts of a converter and voltages with a single supply. A record has
many rows per pose, a table one row.
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
from counterspin.ingest.column_roles import FileGuess, guess_file
from counterspin.ingest.column_values import has_even_steps, is_nominal
from counterspin.ingest.contents import FileColumn, FileContents
from counterspin.physics.grades import GRADES
from counterspin.triads.section import DEFAULT_AXES
from counterspin.triads.static_intervals import (
    MIN_CONTRAST,
    MIN_DURATION,
    StaticIntervals,
    find_poses,
)
from counterspin.units import STANDARD_GRAVITY, is_convertible, unit_factor

#: Accelerometer of the triad -> its axes in the triad's frame.
AXES: Final = dict(zip("XYZ", DEFAULT_AXES, strict=True))
#: Common units of a sensor's output.
UNITS: Final = ("m/s^2", "g", "mg", "count", "V", "mV", "mA")
#: Time gap between concatenated files, s, across which no rest continues.
_FILE_GAP: Final = 100.0
#: Shortest rests to search by default, s, and smallest ratio of pose numbers at which the shorter
#: rests are used.
_MIN_RESTS: Final = (MIN_DURATION, 0.5)
_MIN_POSE_RATIO: Final = 1.25
#: Sampling rate to search for rests if it is unknown, Hz.
DEFAULT_SAMPLING_RATE: Final = 100.0
#: Largest numbers of rows and of column triples to search for rests; largest number of rows of a
#: table of poses, and smallest change between its rows, relative to gravity.
MAX_ROWS: Final = 500_000
_MAX_TRIPLES: Final = 40
_MAX_POSES: Final = 1000
_MIN_TURN: Final = 0.1
#: Smallest number of poses of a sensor; if the centre of their sphere is fitted as well.
_MIN_POSES: Final = 6
_MIN_POSES_FOR_CENTRE: Final = 9
#: Relative tolerance of the norm at rest, including biases.
_GRAVITY_TOLERANCE: Final = 0.15
#: Relative tolerance of the norm about the fitted centre, including scale errors of the axes.
_SPHERE_TOLERANCE: Final = 0.05
#: Relative tolerance of norms of computed directions.
_EXACT_TOLERANCE: Final = 1e-6
#: Largest norm at rest, relative to gravity, after a filter that removes gravity.
_MAX_FILTERED_GRAVITY: Final = 0.1
#: Unit of time -> smallest time step in this unit, for sampling rates of 2 Hz to some kHz.
_MIN_STEP_BY_UNIT: Final = {"ns": 500_000.0, "us": 500.0, "ms": 0.5, "s": 0.0}
#: Grade -> smallest noise density of a sensor of this grade, g/Hz^0.5.
_MIN_NOISE_BY_GRADE: Final = {"consumer": 5e-5, "tactical": 2e-6}
#: Word sizes of converters, bits; smallest number of jumps that shows unsigned numbers.
_WORD_BITS: Final = (12, 14, 16, 24)
_MIN_JUMPS: Final = 4
#: Number of parameters of a triad; largest uncertainty of its angles relative to the noise of a
#: pose, at which they are estimated. Poses at the six faces give hundreds.
N_PARAMETERS: Final = 9
_MAX_ANGLE_FACTOR: Final = 50.0
#: Smallest median error of the norm of a consumer sensor, for tables without noise.
_MIN_NORM_ERROR: Final = 1e-3


@frozen(eq=False)
class TriadColumns:
    """Three columns of a sensor, and their readings at rest."""

    columns: tuple[str, str, str]
    unit: str | None  #: Unit of the columns; None: unknown.
    #: Rests of records; None: not found, or each row of a table is a pose.
    poses: StaticIntervals | None
    means: Array | None = None  #: Mean of each pose, (n, 3); None: no poses.
    #: Readings at zero specific force, shape (3,): zero, or the centre of the sphere of poses.
    zero: Array = field(default_factory=lambda: np.zeros(3))
    rest: float = MIN_DURATION  #: Shortest rest that is used as a pose, s.
    #: Further triples of columns at rest at the same times, such as those of a second sensor.
    further_columns: tuple[tuple[str, ...], ...] = ()

    @property
    def gravity(self) -> float:
        """The median norm of the readings at rest, in the columns' unit."""
        if self.means is None:
            return math.nan
        return float(np.median(_row_norms(self.means - self.zero)))

    @property
    def determines_angles(self) -> bool:
        """True if the poses determine the angles between the axes."""
        if self.means is None or len(self.means) <= N_PARAMETERS:
            return False
        x, y, z = ((self.means - _fit_sphere_centre(self.means)) / self.gravity).T
        design = np.column_stack([x, y, z, x * x, y * y, z * z, x * y, x * z, y * z])
        angle_rows = np.linalg.pinv(design)[-3:]
        return bool(np.linalg.norm(angle_rows, axis=1).max() < _MAX_ANGLE_FACTOR)

    @property
    def is_table(self) -> bool:
        """True if each row of a table is a pose."""
        return self.means is not None and self.poses is None


def guess_pose_file(contents: FileContents, answers: Mapping[str, str]) -> FileGuess:
    """Guess the role of each column without rotation, where the time has even steps."""
    guess = guess_file(contents, answers)
    first_column = next(filterfalse(_is_row_counter, contents.columns), contents.columns[0])
    answered_keys = {"time", "sampling_rate"} & set(answers)
    if (
        guess.time is None
        and not answered_keys
        and has_even_steps(first_column.values)
        and not _is_row_counter(first_column)
    ):
        guess = guess_file(contents, {**answers, "time": first_column.name})
    if guess.time is not None and guess.time.unit is None:
        column = next(column for column in contents.columns if column.name == guess.time.column)
        median_step = _median_step(column.values)
        unit = next(unit for unit, minimum in _MIN_STEP_BY_UNIT.items() if median_step > minimum)
        guess = guess_file(contents, {**answers, "time": column.name, "time unit": unit})
    return guess


def _is_row_counter(column: FileColumn) -> bool:
    """Return whether a column contains row numbers, from any start, and not times."""
    return bool(not column.unit and np.all(np.diff(column.values) == 1.0))


def find_triad(guesses: Sequence[FileGuess], answers: Mapping[str, str]) -> TriadColumns | None:
    """Find the columns of a triad: by answers, or three with common rests in all files; or None.

    If there are several, such as those of a magnetometer, return the first with the norm of gravity
    at rest.
    """
    guess = guesses[0]
    columns, seconds = _concatenate_files(guesses)
    if "rest" in answers:
        min_rest = parse_quantity(answers["rest"], "s").value
        return _search_triad(columns, seconds, guess, answers, min_rest)
    longer, shorter = (_search_triad(columns, seconds, guess, answers, rest) for rest in _MIN_RESTS)
    return shorter if _has_more_poses(shorter, longer) else longer or shorter


def _has_more_poses(shorter: TriadColumns | None, longer: TriadColumns | None) -> bool:
    """Return whether short rests contain more poses of the sensor than long ones.

    A hand-held sensor is not a pose: it moves too much, or its norm is not gravity.
    """
    if shorter is None or shorter.means is None:
        return False
    if longer is None or longer.means is None:
        return True
    is_many_more = len(shorter.means) >= _MIN_POSE_RATIO * len(longer.means)
    vectors = shorter.means - shorter.zero
    has_contrast = shorter.poses is not None and shorter.poses.contrast > MIN_CONTRAST
    return (
        is_many_more
        and has_contrast
        and shorter.columns == longer.columns
        and _cover_directions(vectors)
    )


def _search_triad(
    columns: Mapping[str, FileColumn],
    seconds: Array,
    guess: FileGuess,
    answers: Mapping[str, str],
    min_rest: float,
) -> TriadColumns | None:
    """Search the columns of a triad with rests of a minimum duration, s; see `find_triad`."""
    answered_columns = [columns[answers[axis]] for axis in AXES if answers.get(axis) in columns]
    if len(answered_columns) == len(AXES):
        return _analyse_columns(answered_columns, seconds, min_rest, answers.get("unit"))
    time_name = guess.time.column if guess.time else None
    candidates = [column for column in columns.values() if column.name != time_name]
    candidates = [
        column
        for column in candidates
        if len(column.values) == len(seconds) and not is_nominal(column.values)
    ]
    triads: list[TriadColumns] = []
    for triple in islice(candidate_triples(candidates), _MAX_TRIPLES):
        if len({column.unit for column in triple}) == 1 and _can_be_force(triple[0].unit):
            triad = _analyse_columns(triple, seconds, min_rest, answers.get("unit"))
            if (
                triad.means is not None
                and _cover_directions(triad.means - triad.zero)
                and _has_varying_norms(triad)
            ):
                triads.append(triad)
    triads = [triad for triad in triads if triad.unit is not None] or triads
    other_columns = (triad.columns for triad in triads[1:] if _has_same_gravity(triad, triads[0]))
    further_columns = (names for names in other_columns if not set(names) & set(triads[0].columns))
    return replace(triads[0], further_columns=tuple(further_columns)) if triads else None


def _has_varying_norms(triad: TriadColumns) -> bool:
    """Return whether norms at rest differ: equal norms are those of computed directions."""
    assert triad.means is not None
    norms = _row_norms(triad.means)
    return bool(np.ptp(norms) > _EXACT_TOLERANCE * np.median(norms))


def find_filtered_axes(guess: FileGuess) -> tuple[str, ...]:
    """Find the axes of a sensor that reads zero at rest, because a filter removed gravity."""
    columns, seconds = _concatenate_files([guess])
    candidates = [column for column in columns.values() if len(column.values) == len(seconds)]
    for triple in islice(candidate_triples(candidates), _MAX_TRIPLES):
        if not all(is_convertible(column.unit, "m/s^2") for column in triple):
            continue
        values = np.column_stack([column.values[:MAX_ROWS] for column in triple])
        try:
            poses = find_poses(seconds[:MAX_ROWS], values)
        except RecordError:
            continue
        one_g = STANDARD_GRAVITY / unit_factor(triple[0].unit, "m/s^2", gravity=STANDARD_GRAVITY)
        has_rests = len(poses.start) > 1 and poses.contrast > MIN_CONTRAST
        if has_rests and _row_norms(poses.mean).max() < _MAX_FILTERED_GRAVITY * one_g:
            return tuple(column.name for column in triple)
    return ()


def _has_same_gravity(triad: TriadColumns, reference: TriadColumns) -> bool:
    """Return whether two triads have the same norm at rest, unlike a magnetometer."""
    is_comparable = (
        triad.unit == reference.unit and triad.means is not None and reference.means is not None
    )
    return is_comparable and bool(abs(triad.gravity / reference.gravity - 1.0) < _GRAVITY_TOLERANCE)


def _concatenate_files(guesses: Sequence[FileGuess]) -> tuple[dict[str, FileColumn], Array]:
    """Concatenate the columns that all files have, and their times, s."""
    files = [
        {column.name: column for column in guess.contents.columns if not column.is_timestamp}
        for guess in guesses
    ]
    lengths = [
        max(len(column.values) for column in columns_of_file.values()) for columns_of_file in files
    ]
    times, start_time = [], 0.0
    for guess, length in zip(guesses, lengths, strict=True):
        seconds = _find_times(guess, length)
        times.append(seconds - np.nanmin(seconds) + start_time)
        start_time = float(np.nanmax(times[-1])) + _FILE_GAP
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


def _find_times(guess: FileGuess, n_rows: int) -> Array:
    if guess.time is None:
        return np.arange(n_rows) / (guess.sampling_rate or DEFAULT_SAMPLING_RATE)
    column = next(column for column in guess.contents.columns if column.name == guess.time.column)
    return column.values * guess.time.factor


def _can_be_force(unit: str) -> bool:
    return not unit or is_convertible(unit, "m/s^2") or unit in UNITS


def _analyse_columns(
    columns: Sequence[FileColumn], seconds: Array, min_rest: float, unit: str | None
) -> TriadColumns:
    """Return the rests of three columns, and their unit by answer, file or norm."""
    first, second, third = (column.name for column in columns)
    names = (first, second, third)
    values = np.column_stack([column.values[:MAX_ROWS] for column in columns])
    _refuse_unsigned(columns, values)
    poses, means = None, _find_pose_rows(values)
    if means is None:
        try:
            poses = find_poses(seconds[:MAX_ROWS], values, min_rest)
        except RecordError:
            return TriadColumns(names, unit or columns[0].unit or None, None, rest=min_rest)
        means = poses.mean
    if unit is None and not (unit := columns[0].unit):
        norms = _row_norms(means)
        matching_units = [
            candidate
            for candidate in UNITS
            if is_convertible(candidate, "m/s^2")
            and _are_gravity(norms * unit_factor(candidate, "m/s^2", gravity=STANDARD_GRAVITY))
        ]
        unit = next(iter(matching_units), "")
    # Counts and volts may have an offset at zero force, a specific force has none.
    zero = np.zeros(3) if is_convertible(unit or "", "m/s^2") else _find_zero(means)
    unit = unit or ("count" if _are_integers(values) else "")
    return TriadColumns(names, unit or None, poses, means, zero, min_rest)


def _refuse_unsigned(columns: Sequence[FileColumn], values: Array) -> None:
    """Raise RecordError for negative counts written as unsigned numbers: -1 as 65535."""
    valid_rows = values[np.isfinite(values).all(axis=1)]
    if not len(valid_rows) or not _are_integers(valid_rows) or valid_rows.min() < 0.0:
        return
    for bits in _WORD_BITS:
        modulus = 2.0**bits
        n_jumps = (np.abs(np.diff(valid_rows, axis=0)) > 0.9 * modulus).sum(axis=0)
        if 0.9 * modulus < valid_rows.max() < modulus and (n_jumps >= _MIN_JUMPS).any():
            names = ", ".join(f"'{column.name}'" for column in columns)
            raise RecordError(
                f"the columns {names} jump between 0 and {modulus - 1:.0f}, because signed "
                f"{bits}-bit numbers (two's complement) were written as unsigned numbers. "
                f"Export signed numbers, or subtract {modulus:.0f} from each number that is "
                f"{modulus / 2:.0f} or more.",
                code="unsigned-numbers",
            )


def _find_pose_rows(values: Array) -> Array | None:
    """Return the rows of a table with one pose per row, shape (n, 3); None for a record."""
    rows = values[np.isfinite(values).all(axis=1)]
    if not _MIN_POSES <= len(rows) <= _MAX_POSES:
        return None
    vectors = rows - _find_zero(rows)
    # In a record, the direction hardly changes between rows.
    median_turn = np.median(_row_norms(np.diff(vectors, axis=0))) / np.median(_row_norms(vectors))
    return rows if median_turn > _MIN_TURN and _cover_directions(vectors) else None


def _are_integers(values: Array) -> bool:
    """Return whether all values are integers, such as counts of a converter."""
    valid_values = values[np.isfinite(values)]
    return bool(np.all(valid_values == np.round(valid_values)) and np.ptp(valid_values) > 1.0)


def _find_zero(means: Array) -> Array:
    """Return the readings at zero force, shape (3,): zero, or the centre of the poses' sphere."""
    zero = np.zeros(3)
    if len(means) < _MIN_POSES_FOR_CENTRE or _cover_directions(means):
        return zero
    centre = _fit_sphere_centre(means)
    return centre if _are_equal(_row_norms(means - centre), _SPHERE_TOLERANCE) else zero


def _fit_sphere_centre(means: Array) -> Array:
    """Fit the centre c of a sphere to poses m by the linear |m|^2 = 2 c m + r^2 - |c|^2."""
    mean = means.mean(axis=0)
    centred = means - mean
    design = np.column_stack([2.0 * centred, np.ones(len(centred))])
    centre = np.linalg.lstsq(design, np.sum(centred**2, axis=1), rcond=None)[0][:3]
    return np.asarray(centre + mean, np.float64)


def _are_equal(norms: Array, tolerance: float) -> bool:
    return bool(np.mean(np.abs(norms / np.median(norms) - 1.0) < tolerance) > 0.8)


def _row_norms(vectors: Array) -> Array:
    return np.asarray(np.linalg.norm(vectors, axis=1))


def _are_gravity(norms: Array) -> bool:
    """Return whether most norms at rest, m/s^2, are gravity with a small scale error."""
    return bool(np.mean(np.abs(norms / STANDARD_GRAVITY - 1.0) < _GRAVITY_TOLERANCE) > 0.8)


def _cover_directions(means: Array) -> bool:
    """Return whether there are enough poses, (n, 3), with equal norms in all directions."""
    norms = _row_norms(means)
    if not norms.all():
        return False
    singular_values = np.linalg.svd(means / norms[:, None], compute_uv=False)
    has_many_poses = len(norms) >= _MIN_POSES
    # At least three directions must be well represented.
    return bool(
        has_many_poses
        and _are_equal(norms, _GRAVITY_TOLERANCE)
        and singular_values[-1] > 0.2 * singular_values[0]
    )


def guess_grade(triad: TriadColumns, guess: FileGuess) -> str | None:
    """Guess the grade of a sensor from its noise at rest; None if it is unclear."""
    if triad.means is None:
        return None
    if triad.poses is None:
        # Such large differences between the axes occur only in consumer sensors.
        norm_errors = _row_norms(triad.means - triad.zero) / triad.gravity - 1.0
        return "consumer" if float(np.median(np.abs(norm_errors))) > _MIN_NORM_ERROR else None
    scatter = float(np.median(triad.poses.scatter)) / triad.gravity
    density = scatter * math.sqrt(2.0 * _sample_interval(guess))
    return next(
        (grade for grade, minimum in _MIN_NOISE_BY_GRADE.items() if density > minimum), GRADES[0]
    )


def _sample_interval(guess: FileGuess) -> float:
    if guess.time is None:
        return 1.0 / (guess.sampling_rate or DEFAULT_SAMPLING_RATE)
    column = next(column for column in guess.contents.columns if column.name == guess.time.column)
    return _median_step(column.values) * guess.time.factor


def _median_step(time: Array) -> float:
    """Return the median step of a time, ignoring repeated times."""
    steps = np.diff(time)
    return float(np.median(steps[steps > 0.0]))


# Candidates for the three axes, by name and order

ColumnTriple = tuple[FileColumn, FileColumn, FileColumn]

#: Names of the gravity direction computed by a filter, which also lies on a sphere.
_GRAVITY_FILTER_NAME: Final = re.compile(r"(?i).*grav")


def candidate_triples(columns: Sequence[FileColumn]) -> Iterator[ColumnTriple]:
    """Yield columns that may be the axes X, Y and Z of a sensor, the most likely first.

    Columns whose names differ only in these letters belong together; other columns belong together
    if they are adjacent.
    """
    triples = _find_named_triples(columns)
    yield from sorted(triples, key=lambda triple: bool(_GRAVITY_FILTER_NAME.match(triple[0].name)))
    used_names = {column.name for triple in triples for column in triple}
    other_columns = [column for column in columns if column.name not in used_names]
    yield from zip(other_columns, other_columns[1:], other_columns[2:], strict=False)


def _find_named_triples(columns: Sequence[FileColumn]) -> list[ColumnTriple]:
    """Find columns whose names differ only in the letters x, y and z, in the file's order."""
    families: dict[tuple[str, str, bool], dict[str, FileColumn]] = {}
    for column in columns:
        for match in re.finditer("(?i)[xyz]", column.name):
            prefix, suffix = column.name[: match.start()], column.name[match.end() :]
            family = families.setdefault((prefix, suffix, match[0].isupper()), {})
            family[match[0].lower()] = column
    return [
        (column_by_letter["x"], column_by_letter["y"], column_by_letter["z"])
        for column_by_letter in families.values()
        if len(column_by_letter) == len("xyz")
    ]
