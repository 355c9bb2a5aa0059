"""Show the contents of recorder files, and the kinds of test that they may belong to."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Final

import numpy as np

from counterspin.arrays import median
from counterspin.frozen import frozen
from counterspin.ingest.arm import shows_arm
from counterspin.ingest.column_roles import FileGuess, guess_file, is_nominal
from counterspin.ingest.contents import FileColumn, FileContents
from counterspin.ingest.poses import shows_poses
from counterspin.ingest.questions import AnsweredDraft, FileQuestion
from counterspin.ingest.starter import Test
from counterspin.ingest.triads import guessed_poses, without_gravity
from counterspin.ingest.tumble import shows_tumble
from counterspin.records.column_file import format_names
from counterspin.records.sampling import ValueHolding, join_bursts

#: Columns of a file that are shown, and different words of one.
_SHOWN: Final = 24
_SHOWN_WORDS: Final = 4
#: Deviation of a step from a multiple of the usual one, and part of the steps that are multiples
#: where samples are missing.
_OFF_STEP: Final = 0.25
_EVEN_PART: Final = 0.9
#: Relative difference between the rate of an angle in a known unit and that of the waves.
_SAME_RATE: Final = 0.02
#: Kind of test -> what the files then are.
TESTS: Final[dict[Test, str]] = {
    "double-turntable": "records of a double turntable",
    "tumble": "a table of readings of a multi-position tumble",
    "arm": "a table of readings on the arm of a centrifuge",
    "poses": "a record of a three-axis sensor in many poses",
}


def overview(all_contents: Sequence[FileContents]) -> list[str]:
    """Return an overview of each file: its rows and its columns, a line each."""
    return [line for contents in all_contents for line in _lines(contents)]


def _lines(contents: FileContents) -> Iterator[str]:
    guess = guessed_poses(contents, {}) if contents.is_mixed else guess_file(contents)
    place = f", sheet '{contents.sheet}'" if contents.sheet else ""
    place += f", group '{contents.group}'" if contents.group else ""
    rate = _sampling(guess)
    said = [f"{contents.rows} rows", *filter(None, [contents.found, rate])]
    yield f"{contents.path.name}{place}: {', '.join(said)}"
    for column in contents.columns[:_SHOWN]:
        unit = f" [{column.unit}]" if column.unit and f"[{column.unit}]" not in column.name else ""
        yield f"  {column.name}{unit}: {_appearance(column, guess)}"
    for name in contents.others[:_SHOWN]:
        yield f"  {name}: {_column_words(contents, name)}"
    if more := len(contents.columns) + len(contents.others) - 2 * _SHOWN:
        yield from [f"  and {more} more columns"] if more > 0 else []
    if contents.numbers:
        numbers = (f"{name} = {value:.9g}" for name, value in contents.numbers.items())
        yield f"  scalar values: {', '.join(islice(numbers, _SHOWN))}"
    yield from (f"  {remark}" for remark in _sampling_remarks(guess))
    if contents.footer:
        shown = ", ".join(f"'{line.strip()[:40]}'" for line in contents.footer[:_SHOWN_WORDS])
        yield (
            f"  the last {len(contents.footer)} lines were ignored because they are not data "
            f"rows: {shown}"
        )
    yield from (f"  this part could not be read: {reason}" for reason in contents.spoilt)
    yield from (f"  {remark}" for remark in contents.remarks)


def _sampling_remarks(guess: FileGuess) -> Iterator[str]:
    """Yield remarks on repeated values, repeated times and missing samples."""
    held: dict[float, list[str]] = {}
    for column in guess.contents.columns:
        clocks = [guess.time and guess.time.column, guess.shared and guess.shared.name]
        if column.stamps or column.name in clocks:
            continue
        try:
            holding = ValueHolding.detect(column.values)
        except ValueError as error:
            yield f"column '{column.name}': {error}"
            continue
        if holding is not None:
            held.setdefault(round(100.0 * (1.0 - 1.0 / holding.rows)), []).append(column.name)
    for part, names in held.items():
        yield (
            f"repeated values: {part:g} % of {format_names(names)}, which is typical of a "
            "logging rate above the output rate of the sensor; only new values are used"
        )
    if guess.shared is not None:
        stamps = int(np.sum(np.diff(join_bursts(guess.shared.values)) > 0.0)) + 1
        yield (
            f"repeated times or bursts: the {guess.shared.values.size} rows of column "
            f"'{guess.shared.name}' have {stamps} different times or bursts; "
            f"{guess.uncounted or 'time is calculated from the row count'}"
        )
    if guess.time is None or guess.contents.is_mixed:
        return
    column = next(c for c in guess.contents.columns if c.name == guess.time.column)
    time = column.values[np.isfinite(column.values)]
    steps = np.diff(time)
    again = int(np.sum(steps == 0.0))
    if again and not any(held):
        yield f"repeated times: {again} of {time.size} rows repeat the time of the previous row"
    usual = median(steps[steps > 0.0]) if (steps > 0.0).any() else math.nan
    far = steps[steps > 1.5 * usual] / usual
    missing = int(np.round(far).sum() - far.size - again)
    multiples = steps[steps > 0.0] / usual
    even = np.mean(np.abs(multiples - np.round(multiples)) < _OFF_STEP) > _EVEN_PART
    if missing > 0 and even:
        yield (
            f"missing samples: about {missing} (the time advances by more than one sampling "
            "interval)"
        )


def _sampling(guess: FileGuess) -> str:
    """Return the number of rows a second; empty text if it is not known."""
    if guess.time is None:
        return f"{guess.sampling:.8g} rows per second" if guess.sampling else ""
    if guess.time.unit is None:
        return ""
    column = next(c for c in guess.contents.columns if c.name == guess.time.column)
    steps = np.diff(column.values[np.isfinite(column.values)]) * guess.time.factor
    if guess.contents.is_mixed:  # rows of several sensors have no common step
        return f"about {1.0 / np.mean(steps):.4g} rows per second from all sensors together"
    steps = steps[steps > 0.0]
    step = median(steps) if steps.size else math.nan
    return f"about {1.0 / step:.4g} rows per second" if steps.size else ""


def _appearance(column: FileColumn, guess: FileGuess) -> str:
    """Return the range of a column, and what it looks like."""
    values = column.values[np.isfinite(column.values)]
    low, high = float(values.min()), float(values.max())
    if column.stamps:
        return f"time stamps over {high - low:.6g} s"
    if low == high:
        return f"always {low:.6g}"
    name = column.name
    evidence = [
        (guess.time is not None and guess.time.column == name, "the time"),
        (
            guess.shared is not None and guess.shared.name == name,
            "repeated times or bursts of rows",
        ),
        (is_nominal(values), "nominal orientations (values -1, 0 and 1 only), not measurements"),
        (
            guess.angle is not None and guess.angle.column == name,
            "advances at a steady rate, like an angle",
        ),
        (guess.temperature is not None and guess.temperature[0] == name, "a temperature"),
        (
            any(s.column == name and s.amplitude for s in guess.signals),
            "oscillates at a steady frequency",
        ),
    ]
    shown = next((f", {words}" for holds, words in evidence if holds), "")
    return f"{low:.6g} to {high:.6g}{shown}"


def _column_words(contents: FileContents, name: str) -> str:
    """Return the words of a column."""
    cells = contents.words.get(name) or contents.first_words.get(name, ())
    kinds = sorted({cell for cell in cells if cell})
    if not kinds:
        return "empty"
    more = f" and {len(kinds) - _SHOWN_WORDS} more" if len(kinds) > _SHOWN_WORDS else ""
    return f"words, {', '.join(word[:40] for word in kinds[:_SHOWN_WORDS])}{more}"


def likely_test(all_contents: Sequence[FileContents]) -> Test | None:
    """Return the kind of test that files look like; None if they look like none."""
    # A sensor with three axes may have rates beside them.
    if shows_poses(all_contents):
        return "poses"
    if shows_arm(all_contents):
        return "arm"
    if shows_tumble(all_contents):
        return "tumble"
    turning = all(_shows_turntable(guess_file(contents)) for contents in all_contents)
    return "double-turntable" if turning else None


def _shows_turntable(guess: FileGuess) -> bool:
    """Return whether a record follows a rotation: columns along known axes, or an angle."""
    if not guess.signals:
        return False
    if any(signal.axis and signal.observable for signal in guess.signals):
        return True
    if any(signal.observable in ("displacement", "velocity") for signal in guess.signals):
        return True
    if guess.angle is None or guess.turning is None or guess.rate is None:
        return False
    known = guess.angle.pulses or guess.angle.unit != "count"
    same = abs(guess.rate / guess.turning - 1.0) < _SAME_RATE
    return same and (known or guess.angle.per_revolution is not None)


def sensor_question(all_contents: Sequence[FileContents]) -> FileQuestion | None:
    """Return the question about the sensor whose rows are read; None if there is only one."""
    for contents in all_contents:
        if contents.is_mixed and contents.sensors is not None:
            column, values = contents.sensors
            text = (
                f"Column '{column}' of {contents.path.name} has {len(values)} different "
                "values, so the rows come from several sensors or runs. Which rows should be "
                "used?"
            )
            return FileQuestion("select", text, values[0], values)
    return None


def kind_question(likely: Test | None) -> FileQuestion:
    """Return the question about the kind of test."""
    kinds = "; ".join(f"{test}: {words}" for test, words in TESTS.items())
    text = f"What is the test type? {kinds}."
    return FileQuestion("test", text, "poses", tuple(TESTS), likely)


def no_test_reasons(all_contents: Sequence[FileContents]) -> Iterator[str]:
    """Yield the reasons why files look like no kind of test."""
    yield (
        "no column varies with a rotation, no set of three columns contains rest periods at "
        "different attitudes, and the readings have no rate or position column"
    )
    for contents in all_contents:
        if axes := without_gravity(guess_file(contents)):
            yield (
                f"columns {format_names(axes)} are nearly zero at rest, so a filter removed "
                "gravity. Poses require gravity; record the raw output of the sensor"
            )


@frozen
class UndecidedDraft(AnsweredDraft):
    """Files that look like no kind of test; the only question is its kind."""

    contents: FileContents  #: The contents of the first file.

    @classmethod
    def of(cls, all_contents: Sequence[FileContents]) -> UndecidedDraft:
        """Return a draft that says why the files look like no kind of test."""
        if (question := sensor_question(all_contents)) is not None:
            return cls((), (question,), {}, (), all_contents[0])
        reasons = tuple(no_test_reasons(all_contents))
        return cls(reasons, (kind_question(None),), {}, (), all_contents[0])
