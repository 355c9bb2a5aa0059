"""A study as a person reads it: a table for each analysis, the verdict, and figures."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

import numpy as np

from counterspin.reports.blocks import (
    Block,
    Column,
    Heading,
    Paragraph,
    Plot,
    PlotSeries,
    Style,
    Table,
)
from counterspin.reports.charts import check_figures_writable, save_figure
from counterspin.reports.numbers import find_display_unit, format_number
from counterspin.studies.result import LEVELS, Z_BINS, Z_EDGE, CoefficientResult, StudyResult

#: What every figure of one says that it is.
FIGURE: Final = "a figure of a study"

#: Height of one of many panels, of that of a plot by itself.
_PANEL_HEIGHT: Final = 0.7

_ERROR_COLUMNS = (
    Column("Coefficient"),
    Column("Unit"),
    Column("Bias", align="right"),
    Column("Sd", align="right"),
    Column("Mean u", align="right"),
    Column("Efficiency", align="right"),
)

_COVERAGE_COLUMNS = (
    Column("Coefficient"),
    *(Column(f"Coverage of the {100 * level:.0f} % intervals", align="right") for level in LEVELS),
)


def study_blocks(result: StudyResult) -> list[Block]:
    """Return the study's verdict, its tables, and the varied quantities."""
    state = "" if result.complete else f" of {result.trials_asked} (interrupted)"
    blocks: list[Block] = [
        Heading(f"{result.title}: {result.trials} trials{state}, seed {result.seed}"),
        *_verdict_blocks(result),
    ]
    for name, analysis in result.analyses.items():
        blocks += [
            Heading(f"{name} ({analysis.engine})"),
            Table(
                _ERROR_COLUMNS, tuple(_error_row(*item) for item in analysis.coefficients.items())
            ),
            Table(
                _COVERAGE_COLUMNS,
                tuple(_coverage_row(*item) for item in analysis.coefficients.items()),
            ),
        ]
        if analysis.undetermined:
            listed = ", ".join(analysis.undetermined)
            blocks.append(Paragraph(f"The records do not determine {listed}.", "quiet"))
    blocks.append(
        Paragraph(
            "The number after ± is the standard error of the bias. The coverage columns give "
            "the share of trials whose 68 %, 95 % or 99 % interval contains the true value, "
            "with a binomial 95 % interval. Efficiency is the Cramér-Rao bound for all "
            "samples, divided by the mean square error.",
            "quiet",
        )
    )
    return [*blocks, *_varied_quantity_blocks(result)]


def _verdict_blocks(result: StudyResult) -> Iterator[Block]:
    yield Heading("Verdict")
    trusted = [analysis.trustworthy for analysis in result.analyses.values()]
    has_verdict = None not in trusted
    trustworthy_count = trusted.count(True) if has_verdict else 0  # their lines come first
    for index, line in enumerate(result.verdict):
        style: Style = "answer" if index < trustworthy_count else "warning"
        yield Paragraph(line, style if has_verdict or index == 0 else "quiet")


def _varied_quantity_blocks(result: StudyResult) -> Iterator[Block]:
    yield Heading("Varied quantities")
    if not result.varying:
        yield Paragraph("Only the noise varies between trials.")
        return
    rows = tuple(tuple(line.split(": ", 1)) for line in result.varying)
    yield Table((Column("Quantity"), Column("Distribution", wraps=True)), rows)


def report_blocks(result: StudyResult) -> list[Block]:
    """Return the tables, the verdict, and how intervals cover."""
    return [*study_blocks(result), *coverage_plots(result)]


def _error_row(name: str, coefficient: CoefficientResult) -> tuple[str, ...]:
    unit, factor = find_display_unit(coefficient.unit)
    bias, error = (format_number(factor * x, 2) for x in (coefficient.bias, coefficient.se_bias))
    efficiency = coefficient.efficiency
    return (
        name,
        unit,
        f"{bias} ± {error}",
        format_number(coefficient.sd * factor),
        format_number(coefficient.u * factor),
        "-" if efficiency is None else format_number(efficiency, 2),
    )


def _coverage_row(name: str, coefficient: CoefficientResult) -> tuple[str, ...]:
    return (
        name,
        *(
            f"{100 * share:.2f} [{100 * low:.2f}, {100 * high:.2f}]"
            for share, (low, high) in zip(coefficient.covered, coefficient.intervals, strict=True)
        ),
    )


def z_plots(result: StudyResult) -> Iterator[Plot]:
    """Yield how each coefficient's error over its stated u is distributed, and the normal curve."""
    edges = np.linspace(-Z_EDGE, Z_EDGE, Z_BINS + 1)
    centres = tuple((0.5 * (edges[1:] + edges[:-1])).tolist())
    fine = tuple(np.linspace(-Z_EDGE, Z_EDGE, 241).tolist())
    normal = tuple(math.exp(-0.5 * z**2) / math.sqrt(2.0 * math.pi) for z in fine)
    for name, coefficient in _named_coefficients(result):
        counts = np.array(coefficient.histogram)
        density = counts[1:-1] / (counts.sum() * (edges[1] - edges[0]))
        percent_outside = 100.0 * (counts[0] + counts[-1]) / counts.sum()
        yield Plot(
            title=f"{name}: {percent_outside:.3g} % beyond ±{Z_EDGE:g}",
            x_label="error / stated standard uncertainty",
            y_label="density",
            series=(
                PlotSeries("", centres, tuple(density.tolist()), kind="columns", colour=0),
                PlotSeries("", fine, normal, colour=1),
            ),
            x_range=(-Z_EDGE, Z_EDGE),
            height=_PANEL_HEIGHT,
        )


def coverage_plots(result: StudyResult) -> Iterator[Plot]:
    """Yield for each level how often the intervals contained the truth; bars: binomial, 95 %."""
    names, coefficients = zip(*_named_coefficients(result), strict=True)
    for index, level in enumerate(LEVELS):
        low, high = zip(*(c.intervals[index] for c in coefficients), strict=True)
        share = tuple(c.covered[index] for c in coefficients)
        yield Plot(
            title=f"Share of trials whose {100 * level:.0f} % interval contains the true "
            "value; error bars: 95 % intervals",
            x_label="",
            y_label="share, %",
            series=(
                PlotSeries(
                    "",
                    tuple(map(float, range(len(names)))),
                    _to_percent(share),
                    _to_percent(low),
                    _to_percent(high),
                    "points",
                    colour=index,
                ),
            ),
            levels=(100.0 * level,),
            x_names=names,
            height=_PANEL_HEIGHT,
        )


def bias_plots(result: StudyResult, covariate: str) -> Iterator[Plot]:
    """Yield each coefficient's bias against one of the quantities that varied."""
    for name, coefficient in _named_coefficients(result):
        bias_table = coefficient.against[covariate]
        columns = (bias_table.value, bias_table.trials, bias_table.bias, bias_table.se_bias)
        value, trials, bias, spread = (np.array(column, dtype=float) for column in columns)
        half_bin = 0.5 * (value[1] - value[0])
        has_trials = trials > 1
        unit, factor = find_display_unit(coefficient.unit)
        bias_values, expanded_errors = factor * bias[has_trials], 2.0 * factor * spread[has_trials]
        yield Plot(
            title=f"Bias of {name}; error bars: two standard errors",
            x_label=covariate,
            y_label=f"bias, {unit}" if unit else "bias",
            series=(
                PlotSeries(
                    "",
                    tuple(value[has_trials].tolist()),
                    tuple(bias_values.tolist()),
                    tuple((bias_values - expanded_errors).tolist()),
                    tuple((bias_values + expanded_errors).tolist()),
                    "points",
                ),
            ),
            levels=(0.0,),
            x_range=(float(value[0] - half_bin), float(value[-1] + half_bin)),
            height=_PANEL_HEIGHT,
        )


def write_figures(result: StudyResult, folder: Path | str, *, overwrite: bool = False) -> None:
    """Write all figures of a study to a folder, as SVG.

    overwrite: Whether earlier figures may be replaced; no other file is.
    """
    covariates = dict.fromkeys(
        covariate for _, c in _named_coefficients(result) for covariate in c.against
    )
    figures = {
        Path(folder) / "z.svg": z_plots(result),
        Path(folder) / "coverage.svg": coverage_plots(result),
        **{Path(folder) / f"bias-{d}.svg": bias_plots(result, d) for d in covariates},
    }
    check_figures_writable(figures, FIGURE, overwrite=overwrite)
    for path, plots in figures.items():
        save_figure(list(plots), path, FIGURE, overwrite=overwrite)


def _named_coefficients(result: StudyResult) -> list[tuple[str, CoefficientResult]]:
    return [
        (f"{analysis_name}: {name}", coefficient)
        for analysis_name, analysis in result.analyses.items()
        for name, coefficient in analysis.coefficients.items()
    ]


def _to_percent(shares: Iterable[float]) -> tuple[float, ...]:
    return tuple(100.0 * share for share in shares)
