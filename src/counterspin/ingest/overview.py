"""Describe the contents of recorder files, and guess the test type."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Final

import numpy as np

from counterspin.arrays import median
from counterspin.frozen import frozen
from counterspin.ingest.arm import looks_like_arm
from counterspin.ingest.column_roles import FileGuess, guess_file
from counterspin.ingest.column_values import is_nominal
from counterspin.ingest.contents import FileColumn, FileContents
from counterspin.ingest.poses import looks_like_poses
from counterspin.ingest.questions import AnsweredDraft, FileQuestion
from counterspin.ingest.starter import Test
from counterspin.ingest.triads import find_filtered_axes, guess_pose_file
from counterspin.ingest.tumble import looks_like_tumble
from counterspin.records.column_file import format_names
from counterspin.records.sampling import ValueHolding, join_bursts

#: Largest number of columns of a file, and of different texts of a column, that are listed.
_MAX_COLUMNS: Final = 24
_MAX_WORDS: Final = 4
#: Tolerance of multiples of the median step, and smallest fraction of such steps, for missing
#: samples.
_STEP_TOLERANCE: Final = 0.25
_MIN_EVEN_FRACTION: Final = 0.9
#: Relative tolerance of the rate of an angle compared with that of the signals.
_RATE_TOLERANCE: Final = 0.02
#: Test type -> description of its files.
TEST_LABELS: Final[dict[Test, str]] = {
    "double-turntable": "records of a double turntable",
    "tumble": "a table of readings of a multi-position tumble",
    "arm": "a table of readings on the arm of a centrifuge",
    "poses": "a record of a three-axis sensor in many poses",
}


def describe_files(all_contents: Sequence[FileContents]) -> list[str]:
    """Return lines that describe the rows and columns of each file."""
    return [line for contents in all_contents for line in _describe_file(contents)]


def _describe_file(contents: FileContents) -> Iterator[str]:
    guess = guess_pose_file(contents, {}) if contents.is_mixed else guess_file(contents)
    table_name = f", sheet '{contents.sheet}'" if contents.sheet else ""
    table_name += f", group '{contents.group}'" if contents.group else ""
    rate_text = _describe_sampling(guess)
    summary = [f"{contents.rows} rows", *filter(None, [contents.format_description, rate_text])]
    yield f"{contents.path.name}{table_name}: {', '.join(summary)}"
    for column in contents.columns[:_MAX_COLUMNS]:
        unit = f" [{column.unit}]" if column.unit and f"[{column.unit}]" not in column.name else ""
        yield f"  {column.name}{unit}: {_describe_column(column, guess)}"
    for name in contents.text_columns[:_MAX_COLUMNS]:
        yield f"  {name}: {_describe_text_column(contents, name)}"
    if n_omitted := len(contents.columns) + len(contents.text_columns) - 2 * _MAX_COLUMNS:
        yield from [f"  and {n_omitted} more columns"] if n_omitted > 0 else []
    if contents.numbers:
        numbers = (f"{name} = {value:.9g}" for name, value in contents.numbers.items())
        yield f"  scalar values: {', '.join(islice(numbers, _MAX_COLUMNS))}"
    yield from (f"  {remark}" for remark in _find_sampling_remarks(guess))
    if contents.footer:
        footer_text = ", ".join(f"'{line.strip()[:40]}'" for line in contents.footer[:_MAX_WORDS])
        n_lines = len(contents.footer)
        subject = "last line was" if n_lines == 1 else f"last {n_lines} lines were"
        reason = "it is not a data row" if n_lines == 1 else "they are not data rows"
        yield f"  the {subject} ignored because {reason}: {footer_text}"
    for reason in contents.unread_reasons:
        yield f"  part of the file could not be read: {reason}"
    yield from (f"  {remark}" for remark in contents.remarks)


def _find_sampling_remarks(guess: FileGuess) -> Iterator[str]:
    """Yield remarks on repeated values, repeated times and missing samples of a file."""
    names_by_percentage: dict[int, list[str]] = {}
    for column in guess.contents.columns:
        clocks = [guess.time and guess.time.column, guess.shared_times and guess.shared_times.name]
        if column.is_timestamp or column.name in clocks:
            continue
        try:
            holding = ValueHolding.detect(column.values)
        except ValueError as error:
            yield f"column '{column.name}': {error}"
            continue
        if holding is not None:
            percentage = round(100.0 * (1.0 - 1.0 / holding.rows))
            names_by_percentage.setdefault(percentage, []).append(column.name)
    for percentage, names in names_by_percentage.items():
        yield (
            f"repeated values: {percentage:g} % of {format_names(names)}, which is typical of a "
            "logging rate above the output rate of the sensor; only new values are used"
        )
    if guess.shared_times is not None:
        n_times = int(np.sum(np.diff(join_bursts(guess.shared_times.values)) > 0.0)) + 1
        yield (
            f"repeated times or bursts: the {guess.shared_times.values.size} rows of column "
            f"'{guess.shared_times.name}' have {n_times} distinct times or bursts; "
            f"{guess.uncounted_reason or 'time is calculated from the row count'}"
        )
    if guess.time is None or guess.contents.is_mixed:
        return
    column = next(column for column in guess.contents.columns if column.name == guess.time.column)
    time = column.values[np.isfinite(column.values)]
    steps = np.diff(time)
    n_repeats = int(np.sum(steps == 0.0))
    if n_repeats and not any(names_by_percentage):
        yield f"repeated times: {n_repeats} of {time.size} rows have the same time as the "
        "previous row"
    median_step = median(steps[steps > 0.0]) if (steps > 0.0).any() else math.nan
    long_steps = steps[steps > 1.5 * median_step] / median_step
    n_missing = int(np.round(long_steps).sum() - long_steps.size - n_repeats)
    ratios = steps[steps > 0.0] / median_step
    is_even = np.mean(np.abs(ratios - np.round(ratios)) < _STEP_TOLERANCE) > _MIN_EVEN_FRACTION
    if n_missing > 0 and is_even:
        yield (
            f"missing samples: about {n_missing} (the time advances by more than one sampling "
            "interval)"
        )


def _describe_sampling(guess: FileGuess) -> str:
    """Return the number of rows per second as text; empty if unknown."""
    if guess.time is None:
        return f"{guess.sampling_rate:.8g} rows per second" if guess.sampling_rate else ""
    if guess.time.unit is None:
        return ""
    column = next(column for column in guess.contents.columns if column.name == guess.time.column)
    steps = np.diff(column.values[np.isfinite(column.values)]) * guess.time.factor
    if guess.contents.is_mixed:  # rows of several sensors have no common step
        return f"about {1.0 / np.mean(steps):.4g} rows per second from all sensors together"
    steps = steps[steps > 0.0]
    median_step = median(steps) if steps.size else math.nan
    return f"about {1.0 / median_step:.4g} rows per second" if steps.size else ""


def _describe_column(column: FileColumn, guess: FileGuess) -> str:
    """Return the range of a column, and its likely role, as text."""
    values = column.values[np.isfinite(column.values)]
    minimum, maximum = float(values.min()), float(values.max())
    if column.is_timestamp:
        return f"time stamps that span {maximum - minimum:.6g} s"
    if minimum == maximum:
        return f"always {minimum:.6g}"
    name = column.name
    evidence = [
        (guess.time is not None and guess.time.column == name, "the time"),
        (
            guess.shared_times is not None and guess.shared_times.name == name,
            "repeated times or bursts of rows",
        ),
        (is_nominal(values), "nominal orientations (values -1, 0 and 1 only), not measurements"),
        (
            guess.angle is not None and guess.angle.column == name,
            "advances at a steady rate, like an angle",
        ),
        (guess.temperature is not None and guess.temperature[0] == name, "a temperature"),
        (
            any(signal.column == name and signal.amplitude for signal in guess.signals),
            "oscillates at a steady frequency",
        ),
    ]
    appearance = next((f", {text}" for applies, text in evidence if applies), "")
    return f"{minimum:.6g} to {maximum:.6g}{appearance}"


def _describe_text_column(contents: FileContents, name: str) -> str:
    """Return the first different texts of a column."""
    cells = contents.text_cells.get(name) or contents.first_text_cells.get(name, ())
    texts = sorted({cell for cell in cells if cell})
    if not texts:
        return "empty"
    suffix = f" and {len(texts) - _MAX_WORDS} more" if len(texts) > _MAX_WORDS else ""
    return f"text ({', '.join(word[:40] for word in texts[:_MAX_WORDS])}{suffix})"


def guess_test(all_contents: Sequence[FileContents]) -> Test | None:
    """Return the test type that the files suggest; or None."""
    # Files of a three-axis sensor may also contain rates.
    if looks_like_poses(all_contents):
        return "poses"
    if looks_like_arm(all_contents):
        return "arm"
    if looks_like_tumble(all_contents):
        return "tumble"
    is_turntable = all(_looks_like_turntable(guess_file(contents)) for contents in all_contents)
    return "double-turntable" if is_turntable else None


def _looks_like_turntable(guess: FileGuess) -> bool:
    """Return whether a record shows a rotation: signals along known axes, or an angle."""
    if not guess.signals:
        return False
    if any(signal.axis and signal.observable for signal in guess.signals):
        return True
    if any(signal.observable in ("displacement", "velocity") for signal in guess.signals):
        return True
    if guess.angle is None or guess.wave_rate is None or guess.rate is None:
        return False
    has_known_unit = guess.angle.pulses or guess.angle.unit != "count"
    is_same_rate = abs(guess.rate / guess.wave_rate - 1.0) < _RATE_TOLERANCE
    return is_same_rate and (has_known_unit or guess.angle.per_revolution is not None)


def make_sensor_question(all_contents: Sequence[FileContents]) -> FileQuestion | None:
    """Return the question that selects one of several sensors; or None."""
    for contents in all_contents:
        if contents.is_mixed and contents.sensors is not None:
            column, values = contents.sensors
            text = (
                f"Column '{column}' of {contents.path.name} has {len(values)} different values, so "
                "the rows come from several sensors or runs. Which rows should be used?"
            )
            return FileQuestion("select", text, values[0], values)
    return None


def make_test_question(guess: Test | None) -> FileQuestion:
    """Return the question about the test type."""
    descriptions = "; ".join(f"{test}: {label}" for test, label in TEST_LABELS.items())
    text = f"What is the test type? {descriptions}."
    return FileQuestion("test", text, "poses", tuple(TEST_LABELS), guess)


def explain_unknown_test(all_contents: Sequence[FileContents]) -> Iterator[str]:
    """Yield the reasons why no test type could be guessed."""
    yield (
        "no column varies with a rotation, no set of three columns contains rest periods at "
        "different attitudes, and the readings have no rate or position column"
    )
    for contents in all_contents:
        if axes := find_filtered_axes(guess_file(contents)):
            yield (
                f"columns {format_names(axes)} are nearly zero at rest, so a filter must have "
                "removed gravity. Poses require gravity; record the raw output of the sensor"
            )


@frozen
class UndecidedDraft(AnsweredDraft):
    """Draft from files of unknown test type, for which it is the only question."""

    contents: FileContents  #: The contents of the first file.

    @classmethod
    def from_contents(cls, all_contents: Sequence[FileContents]) -> UndecidedDraft:
        """Return a draft with the reasons why no test type could be guessed."""
        if (question := make_sensor_question(all_contents)) is not None:
            return cls((), (question,), {}, (), all_contents[0])
        reasons = tuple(explain_unknown_test(all_contents))
        return cls(reasons, (make_test_question(None),), {}, (), all_contents[0])
