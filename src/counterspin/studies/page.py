"""Report of a study: the verdict, tables for each analysis, and figures."""

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
from counterspin.studies.result import (
    CONFIDENCE_LEVELS,
    N_Z_BINS,
    Z_EDGE,
    CoefficientResult,
    StudyResult,
)

#: File type in the metadata of every figure.
FIGURE_TYPE: Final = "a figure of a study"

#: Height of one of several panels, relative to a single plot.
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
    *(
        Column(f"Coverage of the {100 * level:.0f} % intervals, %", align="right")
        for level in CONFIDENCE_LEVELS
    ),
)


def study_blocks(result: StudyResult) -> list[Block]:
    """Return the verdict of a study, its tables, and the varied quantities."""
    progress_text = "" if result.complete else f" of {result.trials_asked} (interrupted)"
    blocks: list[Block] = [
        Heading(f"{result.title}: {result.trials} trials{progress_text}, seed {result.seed}"),
        *_verdict_blocks(result),
    ]
    for name, analysis in result.analyses.items():
        blocks += [
            Heading(f"{name} ({analysis.engine})"),
            Table(
                _ERROR_COLUMNS, tuple(_error_row(*pair) for pair in analysis.coefficients.items())
            ),
            Table(
                _COVERAGE_COLUMNS,
                tuple(_coverage_row(*pair) for pair in analysis.coefficients.items()),
            ),
        ]
        if analysis.undetermined:
            names_text = ", ".join(analysis.undetermined)
            blocks.append(Paragraph(f"The records do not determine {names_text}.", "quiet"))
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
    verdicts = [analysis.trustworthy for analysis in result.analyses.values()]
    has_verdict = None not in verdicts
    n_trustworthy = verdicts.count(True) if has_verdict else 0  # their lines come first
    for index, line in enumerate(result.verdict):
        style: Style = "answer" if index < n_trustworthy else "warning"
        yield Paragraph(line, style if has_verdict or index == 0 else "quiet")


def _varied_quantity_blocks(result: StudyResult) -> Iterator[Block]:
    yield Heading("Varied quantities")
    if not result.varying:
        yield Paragraph("Only the noise varies between trials.")
        return
    rows = tuple(tuple(line.split(": ", 1)) for line in result.varying)
    yield Table((Column("Quantity"), Column("Distribution", wraps=True)), rows)


def report_blocks(result: StudyResult) -> list[Block]:
    """Return the verdict, the tables, and the plots of the coverage."""
    return [*study_blocks(result), *coverage_plots(result)]


def _error_row(name: str, coefficient: CoefficientResult) -> tuple[str, ...]:
    unit, factor = find_display_unit(coefficient.unit)
    bias_text, error_text = (
        format_number(factor * value, 2) for value in (coefficient.bias, coefficient.se_bias)
    )
    efficiency = coefficient.efficiency
    return (
        name,
        unit,
        f"{bias_text} ± {error_text}",
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
    """Yield the distribution of error / stated u of each coefficient with the normal density."""
    edges = np.linspace(-Z_EDGE, Z_EDGE, N_Z_BINS + 1)
    centres = tuple((0.5 * (edges[1:] + edges[:-1])).tolist())
    curve_z = tuple(np.linspace(-Z_EDGE, Z_EDGE, 241).tolist())
    normal_density = tuple(math.exp(-0.5 * z**2) / math.sqrt(2.0 * math.pi) for z in curve_z)
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
                PlotSeries("", curve_z, normal_density, colour=1),
            ),
            x_range=(-Z_EDGE, Z_EDGE),
            height=_PANEL_HEIGHT,
        )


def coverage_plots(result: StudyResult) -> Iterator[Plot]:
    """Yield the coverage of the intervals for each level, with binomial 95 % error bars."""
    names, coefficients = zip(*_named_coefficients(result), strict=True)
    for i, level in enumerate(CONFIDENCE_LEVELS):
        low, high = zip(*(coefficient.intervals[i] for coefficient in coefficients), strict=True)
        shares = tuple(coefficient.covered[i] for coefficient in coefficients)
        yield Plot(
            title=f"Share of trials whose {100 * level:.0f} % interval contains the true "
            "value; error bars: 95 % intervals",
            x_label="",
            y_label="share, %",
            series=(
                PlotSeries(
                    "",
                    tuple(map(float, range(len(names)))),
                    _to_percent(shares),
                    _to_percent(low),
                    _to_percent(high),
                    "points",
                    colour=i,
                ),
            ),
            levels=(100.0 * level,),
            x_names=names,
            height=_PANEL_HEIGHT,
        )


def bias_plots(result: StudyResult, covariate: str) -> Iterator[Plot]:
    """Yield the bias of each coefficient against a varied quantity."""
    for name, coefficient in _named_coefficients(result):
        bias_table = coefficient.against[covariate]
        columns = (bias_table.value, bias_table.trials, bias_table.bias, bias_table.se_bias)
        bin_centres, trials, bias, se_bias = (np.array(column, dtype=float) for column in columns)
        half_bin = 0.5 * (bin_centres[1] - bin_centres[0])
        has_trials = trials > 1
        unit, factor = find_display_unit(coefficient.unit)
        bias_values = factor * bias[has_trials]
        expanded_errors = 2.0 * factor * se_bias[has_trials]
        yield Plot(
            title=f"Bias of {name}; error bars: two standard errors",
            x_label=covariate,
            y_label=f"bias, {unit}" if unit else "bias",
            series=(
                PlotSeries(
                    "",
                    tuple(bin_centres[has_trials].tolist()),
                    tuple(bias_values.tolist()),
                    tuple((bias_values - expanded_errors).tolist()),
                    tuple((bias_values + expanded_errors).tolist()),
                    "points",
                ),
            ),
            levels=(0.0,),
            x_range=(float(bin_centres[0] - half_bin), float(bin_centres[-1] + half_bin)),
            height=_PANEL_HEIGHT,
        )


def write_figures(result: StudyResult, folder: Path | str, *, overwrite: bool = False) -> None:
    """Write all figures of a study to a folder, as SVG.

    overwrite: True: replace earlier figures, but no other files.
    """
    covariates = dict.fromkeys(
        covariate
        for _, coefficient in _named_coefficients(result)
        for covariate in coefficient.against
    )
    figures = {
        Path(folder) / "z.svg": z_plots(result),
        Path(folder) / "coverage.svg": coverage_plots(result),
        **{
            Path(folder) / f"bias-{covariate}.svg": bias_plots(result, covariate)
            for covariate in covariates
        },
    }
    check_figures_writable(figures, FIGURE_TYPE, overwrite=overwrite)
    for path, plots in figures.items():
        save_figure(list(plots), path, FIGURE_TYPE, overwrite=overwrite)


def _named_coefficients(result: StudyResult) -> list[tuple[str, CoefficientResult]]:
    return [
        (f"{analysis_name}: {name}", coefficient)
        for analysis_name, analysis in result.analyses.items()
        for name, coefficient in analysis.coefficients.items()
    ]


def _to_percent(shares: Iterable[float]) -> tuple[float, ...]:
    return tuple(100.0 * share for share in shares)
