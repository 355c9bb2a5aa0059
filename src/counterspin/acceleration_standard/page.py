"""Report on the uncertainty budget of the applied acceleration."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

from counterspin.acceleration_standard.result import AppliedAcceleration, AppliedLevel
from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Plot, PlotSeries, Table
from counterspin.reports.numbers import (
    find_display_unit,
    format_estimate,
    format_number,
    format_share,
    format_uncertainty,
)

#: Description in the file of a figure.
FILE_DESCRIPTION: Final = "a figure of applied acceleration"

_ORIGIN_NAMES: Final = {"stated": "stated", "default": "default uncertainty", "assumed": "exact"}

#: Unit of the latitude, and its conversion factor.
_DEGREE_UNIT: Final = ("deg", math.degrees(1.0))

#: Smallest share of a variance of a source with a curve in the figure.
_MIN_DRAWN_SHARE: Final = 0.01


def applied_blocks(result: AppliedAcceleration) -> Iterator[Block]:
    """Yield the levels with their uncertainty, the figure and the sources."""
    yield Heading(f"Applied acceleration: {result.title}", 1)
    yield _levels_table(result)
    yield Paragraph(validation_sentence(result))
    for level in result.levels:
        if not level.monte_carlo.validated:
            low, high = level.monte_carlo.low, level.monte_carlo.high
            yield Paragraph(
                f"At {format_level(level)}, use the 95 % Monte Carlo interval, "
                f"{format_number(low, 9)} to {format_number(high, 9)} m/s^2.",
                "warning",
            )
    yield relative_plot(result)
    yield Heading("Uncertainty sources")
    yield _sources_table(result)
    default_sources = [source for source in result.applied_sources if source.origin == "default"]
    if default_sources:
        symbol_list = ", ".join(source.symbol for source in default_sources)
        yield Paragraph(
            "For these sources without a stated uncertainty, the budgets contain the default "
            f"standard uncertainty: {symbol_list}.",
            "warning",
        )
    yield Paragraph(
        "The number after ± is the standard uncertainty (k = 1). The acceleration is the mean "
        "over one revolution along an input axis that points inward. 1 g = "
        f"{format_number(result.gravity, 9)} m/s^2.",
        "quiet",
    )


def report_blocks(result: AppliedAcceleration) -> Iterator[Block]:
    """Yield the blocks of `applied_blocks`, and the full budget of each level."""
    yield from applied_blocks(result)
    yield Heading("Uncertainty budgets")
    for level in result.levels:
        yield Heading(f"{format_level(level)}, {format_number(level.rate, 6)} rad/s", 3)
        yield budget_table(result, level)


def format_level(level: AppliedLevel) -> str:
    """Return the nominal level as text."""
    return f"{format_number(level.level, 6)} g"


def _levels_table(result: AppliedAcceleration) -> Table:
    rows = tuple(
        (
            format_level(level),
            format_number(level.rate, 7),
            format_estimate(level.acceleration, level.u, "m/s^2"),
            format_number(level.u_relative),
            format_number(level.monte_carlo.u / abs(level.acceleration)),
            "" if level.dominant is None else _describe_dominant_source(result, level),
        )
        for level in result.levels
    )
    return Table(
        (
            Column("Level"),
            Column("Rate, rad/s", "right"),
            Column("Applied acceleration", "right"),
            Column("u/a, GUM", "right"),
            Column("u/a, Monte Carlo", "right"),
            Column("Largest source", wraps=True, min_width=16),
        ),
        rows,
    )


def _describe_dominant_source(result: AppliedAcceleration, level: AppliedLevel) -> str:
    contribution = level.budget[0]
    return f"{result.source(contribution.source).words}, {format_share(contribution.share)}"


def validation_sentence(result: AppliedAcceleration) -> str:
    """Return a sentence on the validation of the GUM intervals."""
    draws_text = f"{result.draws} draws, seed {result.seed}"
    failures = [format_level(level) for level in result.levels if not level.monte_carlo.validated]
    if not failures:
        return (
            f"Monte Carlo (JCGM 101, {draws_text}) validates the 95 % GUM interval at all levels "
            "to two digits of u."
        )
    return (
        f"Monte Carlo (JCGM 101, {draws_text}) does not validate the 95 % GUM interval to two "
        f"digits of u at {', '.join(failures)}."
    )


def _sources_table(result: AppliedAcceleration) -> Table:
    rows = []
    for source in result.applied_sources:
        unit, factor = _DEGREE_UNIT if source.name == "latitude" else find_display_unit(source.unit)
        unit_text = "" if unit == "1" else unit
        rows.append(
            (
                source.words,
                format_estimate(source.value * factor, source.u * factor, unit_text),
                _ORIGIN_NAMES[source.origin],
                source.symbol,
            )
        )
    return Table(
        (
            Column("Source", wraps=True, min_width=16),
            Column("Value", "right"),
            Column("Origin", wraps=True),
            Column("Symbol"),
        ),
        tuple(rows),
    )


def budget_table(result: AppliedAcceleration, level: AppliedLevel) -> Table:
    """Return a table of the contributions at a level, largest first, and their sum."""
    rows = [
        (
            result.source(line.source).words,
            format_uncertainty(result.source(line.source).u),
            format_number(line.sensitivity, 4),
            _sensitivity_unit(result.source(line.source).unit),
            format_uncertainty(line.u),
            format_uncertainty(line.u / abs(level.acceleration)),
            format_share(line.share),
        )
        for line in level.budget
    ]
    rows.append(
        (
            "Combined",
            "",
            "",
            "",
            format_uncertainty(level.u),
            format_uncertainty(level.u_relative),
            "",
        )
    )
    return Table(
        (
            Column("Source", wraps=True, min_width=16),
            Column("Standard uncertainty of the source", "right"),
            Column("Sensitivity", "right"),
            Column("Unit"),
            Column("Contribution, m/s^2", "right"),
            Column("Relative", "right"),
            Column("Share", "right"),
        ),
        tuple(rows),
    )


def _sensitivity_unit(unit: str) -> str:
    return (
        "m/s^2"
        if unit == "1"
        else f"(m/s^2)/({unit})"
        if " " in unit or "/" in unit
        else f"(m/s^2)/{unit}"
    )


def relative_plot(result: AppliedAcceleration) -> Plot:
    """Return the relative standard uncertainty against the level, with its largest sources."""
    sorted_levels = sorted(result.levels, key=lambda level: level.level)
    levels = tuple(level.level for level in sorted_levels)
    u_values = tuple(level.u_relative for level in sorted_levels)
    curves: dict[str, list[float | None]] = {}
    for index, level in enumerate(sorted_levels):
        for line in level.budget:
            curve = curves.setdefault(line.source, [None] * len(sorted_levels))
            curve[index] = line.u / abs(level.acceleration) or None
    drawn_sources = {
        line.source
        for level in sorted_levels
        for line in level.budget
        if line.share >= _MIN_DRAWN_SHARE
    }
    lines = [
        PlotSeries(result.source(name).words, levels, tuple(curves[name]), colour=index)
        for index, name in enumerate((name for name in curves if name in drawn_sources), 1)
    ]
    return Plot(
        title="Relative standard uncertainty of the applied acceleration",
        x_label="level, g",
        y_label="u/a",
        series=(
            PlotSeries("combined", levels, u_values, colour=0),
            PlotSeries("", levels, u_values, kind="points", colour=0),
            *lines,
        ),
        log_x=levels[-1] > levels[0],
        log_y=min(u_values) > 0.0,
    )
