"""What was done with an accelerometer, kind of test by kind of test: in words, in a table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import PoseResult, ReadingResult
from counterspin.physics.terms import SHARED_TERMS, shown_by_readings
from counterspin.reports.blocks import Block, Column, Paragraph, Table
from counterspin.reports.numbers import format_number

#: What each kind of test is called; the standard that describes it.
_TESTS: Final = {
    "static": "multi-position, at rest (IEEE Std 1293)",
    "arm": "arm centrifuge (IEEE Std 836)",
    "counter-rotating": "double turntable",
}

#: The specific force of each motion, along the axes of its frame.
_FORCES: Final = {
    "static": "At rest, along east, north and up: f = (0, 0, g)",
    "arm": "On the arm, outward, forward and up: f = (−R (w² + 2 w Ω sin L), 0, "
    "g + 2 R w Ω cos L sin θ)",
    "counter-rotating": "On the double turntable, east, north and up: f = (−R (w² + 2 w Ω sin L) "
    "cos θ, −R (w² + 2 w Ω sin L) sin θ, g + 2 R w Ω cos L sin θ)",
}


def readings_of(result: Result) -> dict[str, list[ReadingResult]]:
    """Return the readings of all accelerometers by motion."""
    by_motion: dict[str, list[ReadingResult]] = {}
    for accelerometer in result.accelerometers.values():
        for reading in accelerometer.readings:
            by_motion.setdefault(reading.motion, []).append(reading)
    return by_motion


def poses_of(result: Result) -> list[PoseResult]:
    """Return the poses of unknown attitude."""
    return [] if result.triad is None else result.triad.poses


def lines_of_tests(result: Result) -> Iterator[str]:
    """Yield a sentence for each kind of test that a campaign with readings or poses had."""
    for motion, readings in readings_of(result).items():
        count = _counted(len(readings), "reading")
        if motion == "static":
            where = _counted(len(_positions(readings)), "position")
            yield f"Readings at rest in {where}, {count} (multi-position test, IEEE Std 1293)."
            continue
        rates = sorted({abs(reading.rate) for reading in readings})
        range_ = f"{_counted(len(rates), 'rate')}, {_range(rates)} rad/s"
        senses = "both senses" if len({r.rate > 0.0 for r in readings}) > 1 else "one sense"
        mountings = list(dict.fromkeys(r.mounting for r in readings if r.mounting))
        named = ", ".join(mountings)
        places = f", {_counted(len(mountings), 'mounting')} ({named})" if mountings else ""
        carried = (
            "Readings on the arm of a centrifuge (IEEE Std 836)"
            if motion == "arm"
            else "Readings on a double turntable"
        )
        yield (
            f"{carried} at {range_}, {senses}{places}: {count}, each the mean over whole "
            "revolutions."
        )
    if poses := poses_of(result):
        yield f"At rest in {_counted(len(poses), 'pose')} of unknown attitude."
    if result.runs:
        runs = _counted(len(result.runs), "record")
        yield f"Records of a double turntable centrifuge at the stated rates: {runs}."


def table_of_tests(readings: Sequence[ReadingResult]) -> Table:
    """Return positions, rates and readings of an accelerometer by kind of test and mounting."""
    groups: dict[tuple[str, str], list[ReadingResult]] = {}
    for reading in readings:
        groups.setdefault((reading.motion, reading.mounting), []).append(reading)
    return Table(
        columns=(
            Column("Test", wraps=True),
            Column("Mounting"),
            Column("Positions", "right"),
            Column("Rates, rad/s", "right"),
            Column("Indication, g", "right"),
            Column("Readings", "right"),
        ),
        rows=tuple(
            (
                _TESTS[motion],
                mounting,
                str(len(_positions(own))),
                _range(sorted({r.rate for r in own})) if motion != "static" else "",
                _range(sorted(r.value for r in own)),
                str(len(own)),
            )
            for (motion, mounting), own in groups.items()
        ),
    ).without_empty_columns()


def reading_blocks(result: Result) -> Iterator[Block]:
    """Yield what a reading was taken to be, and which forces act where it was taken."""
    if poses_of(result):
        yield Paragraph(
            "In a pose whose attitude is unknown, |f| = g; the direction of f is estimated with "
            "the coefficients."
        )
    motions = readings_of(result)
    if not motions:
        return
    yield Paragraph(
        "A reading is the indication at rest, or its mean over whole revolutions. The "
        "specific force, with the radius R, the rate w, the Earth's rate Ω and the latitude L:"
    )
    for motion in motions:
        yield Paragraph(_FORCES[motion], "equation")
    machine = [s for s in result.platform if s not in SHARED_TERMS and shown_by_readings(s)]
    if machine:
        yield Paragraph(f"Estimated with the coefficients, of the machine: {', '.join(machine)}.")


def _positions(readings: Sequence[ReadingResult]) -> set[tuple[float, ...]]:
    # Directions are known to rounding only; 0.0 and -0.0 are one.
    return {tuple(round(c, 6) + 0.0 for c in (*r.input_axis, *r.pendulous_axis)) for r in readings}


def _range(values: Sequence[float]) -> str:
    low, high = (format_number(value, 4) for value in (values[0], values[-1]))
    return low if low == high else f"{low} to {high}"


def _counted(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"
