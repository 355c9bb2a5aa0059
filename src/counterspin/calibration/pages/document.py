"""Pages of a whole result: for a terminal, for a notebook, and as a report."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Final

from rich.console import Console

from counterspin.calibration.findings import judge_result
from counterspin.calibration.pages.accelerometer import (
    accelerometer_blocks,
    coefficient_table,
    count_blocks,
    note_blocks,
    to_field_units,
)
from counterspin.calibration.pages.budget import budget_blocks, interval_blocks
from counterspin.calibration.pages.card import NO_INTERVAL, accelerometer_card
from counterspin.calibration.pages.methods import model_blocks, origin_blocks
from counterspin.calibration.pages.pictures import (
    budget_bars,
    correlation_map,
    jackknife_plot,
    residual_plots,
    ripple_plot,
)
from counterspin.calibration.pages.triad import pose_pictures, triad_blocks, triad_summary
from counterspin.calibration.pages.uncertainty import (
    assumption_sentence,
    default_prior_sentence,
    main_source_sentence,
    prior_blocks,
)
from counterspin.calibration.pages.verdict import (
    conformity_blocks,
    misfit_blocks,
    verdict_blocks,
    verdict_tables,
)
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import AccelerometerResult, Coefficient, RunResult, State
from counterspin.characters import MultilineText
from counterspin.inference.distributions import MIN_INTERVAL_DOF, expanded_uncertainty
from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Picture, Style, Table
from counterspin.reports.numbers import (
    NOT_DETERMINED,
    find_display_unit,
    format_compact,
    format_count,
    format_estimate,
    format_interval,
    format_number,
)
from counterspin.reports.publication import seal_warnings
from counterspin.reports.text import Report, make_console
from counterspin.reports.typography import typeset_block

if TYPE_CHECKING:
    from counterspin.calibration.batch import BatchResult

#: Degrees of freedom above which an interval equals that of a normal distribution within 0.2 %.
_MIN_NORMAL_DOF: Final = 1e3

#: Key of a test of a fit -> title; other keys are their own titles.
_TEST_TITLES: Final = {
    "chi2": "chi-square",
    "chi2_p": "p (chi-square)",
    "sign_p": "p (sign test)",
    "peak_frequency_hz": "largest spectral peak, Hz",
    "peak_p": "p (peak)",
}

_BATCH_COLUMNS = (
    Column("Campaign"),
    Column("Accelerometer"),
    Column("K_II", align="right"),
    Column("Unit"),
    Column("State"),
)


def result_blocks(
    result: Result, *, show_budget: bool = False, show_details: bool = False
) -> list[Block]:
    """Return the blocks of a result, the main estimates first.

    show_budget: Whether the uncertainty budgets are written.
    show_details: Whether strong correlations, run counts and checksums of inputs are written.
    """
    result = judge_result(result)
    blocks: list[Block] = [
        *answer_blocks(result),
        *verdict_blocks(result),
        *conformity_blocks(result),
    ]
    for name, accelerometer in result.accelerometers.items():
        blocks += accelerometer_blocks(
            name, accelerometer, result.inputs.gravity, show_details=show_details
        )
        blocks += interval_blocks(name, result)
        if show_budget:
            blocks += budget_blocks(name, result)
    blocks += triad_blocks(result, show_details=show_details)
    blocks += platform_blocks(result)
    if show_budget:
        blocks += prior_blocks(result)
    if result.runs:
        blocks += [Heading("Runs"), *run_blocks(result.runs, show_details=show_details)]
    if show_details:
        blocks += _detail_blocks(result)
    return blocks


def notebook_blocks(result: Result) -> list[Block]:
    """Return the blocks of a notebook cell: main estimates, verdict, coefficients."""
    result = judge_result(result)
    blocks: list[Block] = [*answer_blocks(result), *verdict_blocks(result)]
    for name, accelerometer in result.accelerometers.items():
        blocks += [Heading(name, 3), coefficient_table(accelerometer.coefficients)]
    return blocks


# Main estimates


def answer_blocks(result: Result, *, for_report: bool = False) -> Iterator[Block]:
    """Yield title, K_II of each accelerometer, warnings on the result, and conventions.

    A contradiction by the records precedes all numbers.

    for_report: Whether K_II is also given in g/g^2, on a card for each accelerometer.
    """
    yield Heading(result.title or "Calibration", 1)
    yield from misfit_blocks(result)
    yield from seal_warnings(result)
    for name, accelerometer in result.accelerometers.items():
        paragraphs = list(_answer_paragraphs(name, accelerometer, in_g_units=for_report))
        card = accelerometer_card(name, accelerometer, paragraphs) if for_report else None
        yield from paragraphs if card is None else [card]
    yield from triad_summary(result)
    if sentence := assumption_sentence(result):
        yield Paragraph(sentence)
    for warning in result.warnings:
        yield Paragraph(f"Warning: {warning}", "warning")
    detail_texts = (f"{key.replace('_', ' ')} {text}" for key, text in result.details.items())
    if detail_line := "; ".join(detail_texts):
        yield Paragraph(f"{detail_line[:1].upper()}{detail_line[1:]}.", "quiet")
    gravity_text = format_number(result.inputs.gravity, 9)
    yield Paragraph(
        f"{result.method.capitalize()} method, {result.model} model. The number after ± is the "
        "standard uncertainty (k = 1). Coefficients are expressed in units of the local "
        f"gravity, g = {gravity_text} m/s^2, and are not normalised by K_I (IEEE Std 1293: K2 = "
        "K_II/K_I).",
        "quiet",
    )


def _answer_paragraphs(
    name: str, accelerometer: AccelerometerResult, *, in_g_units: bool
) -> Iterator[Paragraph]:
    """Yield K_II of an accelerometer and the origin of its uncertainty."""
    if (coefficient := accelerometer.coefficients.get("K_II")) is not None:
        state = accelerometer.state
        yield _answer_paragraph(f"K_II of {name}", coefficient, in_g_units=in_g_units, state=state)
        if sentence := default_prior_sentence(accelerometer) or main_source_sentence(accelerometer):
            yield Paragraph(sentence)


def _answer_paragraph(
    name: str, coefficient: Coefficient, *, in_g_units: bool, state: State | None
) -> Paragraph:
    """Return a paragraph on K_II; a contradicted value has neither interval nor colour."""
    value, u, unit = to_field_units(coefficient)
    if not coefficient.estimated or value is None or u is None:
        prior_clause = f"; prior: {format_estimate(value, u, unit)}" if value is not None else ""
        style: Style = "undetermined" if state == "not-determined" else "warning"
        return Paragraph(f"{name}: {NOT_DETERMINED} by these records{prior_clause}", style)
    text = f"{name} = {format_estimate(value, u, unit)}"
    if in_g_units:
        text += f" = {format_estimate(coefficient.value, coefficient.u, coefficient.unit)}"
    if state == "contradicted":
        return Paragraph(text)
    if coefficient.dof is not None and coefficient.dof < MIN_INTERVAL_DOF:
        text += f"   ({NO_INTERVAL})"
    elif u > 0.0:
        expanded_u = expanded_uncertainty(u, coefficient.dof)
        interval_text = format_interval(value, u, expanded_u, unit if in_g_units else "")
        has_few_dof = coefficient.dof is not None and coefficient.dof < _MIN_NORMAL_DOF
        dof_clause = f", {format_count(coefficient.dof or 0.0)} dof" if has_few_dof else ""
        text += f"   (95 %: {interval_text}{dof_clause})"
    return Paragraph(text, "answer" if state in ("good", None) else "reserved")


# Platform and runs


def platform_blocks(result: Result) -> Iterator[Block]:
    """Yield a table of the terms of the platform and of the runs, if there are any."""
    terms = dict(result.platform)
    for name, run in result.runs.items():
        terms |= {f"{symbol} ({name})": coefficient for symbol, coefficient in run.terms.items()}
    if terms:
        yield Heading("Platform" if result.runs else "Machine")
        table = coefficient_table(terms)
        yield Table(table.columns[1:], tuple(row[1:] for row in table.rows), table.quiet_rows)


def run_blocks(runs: dict[str, RunResult], *, show_details: bool) -> Iterator[Block]:
    """Yield rotation, samples and fits of the runs; with `show_details`, counts of each kind."""
    if not runs:
        return
    yield Table(
        columns=(
            Column("Run", wraps=True),
            Column("Rate, rad/s"),
            Column("Drift, ppm/h"),
            Column("Ripple, ppm of rate"),
            Column("Samples used", "right"),
            Column("Samples rejected", "right"),
        ),
        rows=tuple(
            (
                name,
                format_compact(run.rate, run.u_rate),
                format_compact(
                    run.drift * find_display_unit("1/s")[1],
                    None if run.u_drift is None else run.u_drift * find_display_unit("1/s")[1],
                ),
                _ripple_cell(run),
                str(run.samples),
                str(run.rejected),
            )
            for name, run in runs.items()
        ),
    )
    yield Paragraph(
        "The digits in parentheses are the standard uncertainty of the last digits.", "quiet"
    )
    yield from _parabola_table(runs)
    yield from _fit_table(runs)
    for name, run in runs.items():
        yield from note_blocks(name, run)
    if show_details:
        yield from _count_blocks(runs)


def _count_blocks(runs: dict[str, RunResult]) -> Iterator[Block]:
    for name, run in runs.items():
        yield from count_blocks(name, run)
        if run.angle_rms is not None:
            unit, factor = find_display_unit("rad")
            rms_text = format_number(run.angle_rms * factor)
            yield Paragraph(f"{name}: encoder residual {rms_text} {unit} rms.")


def _ripple_cell(run: RunResult) -> str:
    if not run.ripples:
        return "-"
    # parts per million of the absolute rate
    scale = 1e6 / abs(run.rate)
    return MultilineText(
        *(
            f"{ripple.harmonic}: "
            f"{format_compact(ripple.amplitude * scale, ripple.u_amplitude * scale)}"
            for ripple in run.ripples
        )
    )


def _parabola_table(runs: dict[str, RunResult]) -> Iterator[Block]:
    rows = [
        (
            name,
            accelerometer,
            str(parabola.strobes),
            format_compact(parabola.b2, parabola.u_b2),
            f"{format_number(parabola.sigma)} "
            f"{'fitted' if parabola.sigma_from_residuals else 'given'}",
        )
        for name, run in runs.items()
        for accelerometer, parabola in run.parabolas.items()
    ]
    if rows:
        yield Table(
            columns=(
                Column("First stage", wraps=True),
                Column("", wraps=True),
                Column("Strobes", "right"),
                Column("b2, m/s^2"),
                Column("sigma, m"),
            ),
            rows=tuple(rows),
        )


def _fit_table(runs: dict[str, RunResult]) -> Iterator[Block]:
    """Yield a table of the tests of each run's fit, with a column for each test."""
    tests = [
        (name, accelerometer, test)
        for name, run in runs.items()
        for accelerometer, test in run.fit.items()
    ]
    keys = tuple(dict.fromkeys(key for _, _, test in tests for key in test))
    titles = [_TEST_TITLES.get(key, key.replace("_", " ")) for key in keys]
    if keys:
        yield Table(
            columns=(
                Column("Fit", wraps=True),
                Column("", wraps=True),
                *(Column(title, "right", wraps=True) for title in titles),
            ),
            rows=tuple(
                (name, accelerometer, *(_format_test_value(key, test.get(key)) for key in keys))
                for name, accelerometer, test in tests
            ),
        )


def _format_test_value(key: str, value: float | str | None) -> str:
    if value is None or isinstance(value, str):
        return value or "-"
    if key.endswith("_p"):
        return f"{value:.3f}" if value >= 0.0005 else "< 0.001"
    return format_count(value)


def _detail_blocks(result: Result) -> Iterator[Block]:
    yield Heading("Details")
    inputs = result.inputs
    latitude_text = format_number(math.degrees(inputs.latitude), 8)
    radius_text = f"Radius {inputs.radius:.10g} m, latitude" if inputs.radius else "Latitude"
    yield Paragraph(f"{radius_text} {latitude_text} deg.")
    for file, checksum in result.provenance.shown:
        yield Paragraph(f"{file} {checksum}", "quiet")
    yield Paragraph(f"counterspin {result.provenance.version}", "quiet")


def full_report_blocks(result: Result) -> list[Block]:
    """Return the full report of a result."""
    result = judge_result(result)
    chapters = {
        "Coefficients": _coefficient_chapter(result),
        "Uncertainty budget": _budget_chapter(result),
        "Residuals": _residual_chapter(result),
        "Runs": _run_chapter(result),
    }
    blocks: list[Block] = list(answer_blocks(result, for_report=True))
    for title, chapter in chapters.items():
        if content := _demote_headings(chapter):
            blocks += [Heading(title), *content]
    # Names of files and checksums are not typeset.
    heading, input_paragraph, *origin_tables = _demote_headings(origin_blocks(result))
    blocks += [Heading("Inputs"), *_demote_headings(model_blocks(result)), heading, input_paragraph]
    return [*map(typeset_block, blocks), *origin_tables]


def _demote_headings(blocks: Iterable[Block]) -> list[Block]:
    """Return blocks with all headings lowered to level 3."""
    return [Heading(block.text, 3) if isinstance(block, Heading) else block for block in blocks]


def _coefficient_chapter(result: Result) -> Iterator[Block]:
    yield Heading("Quality checks")
    yield from verdict_tables(result)
    yield from conformity_blocks(result)
    for name, accelerometer in result.accelerometers.items():
        yield from accelerometer_blocks(
            name, accelerometer, result.inputs.gravity, show_details=True
        )
        yield from _existing_pictures(
            jackknife_plot(name, accelerometer), correlation_map(name, accelerometer)
        )
    yield from triad_blocks(result, show_details=True)
    yield from pose_pictures(result)
    yield from platform_blocks(result)


def _budget_chapter(result: Result) -> Iterator[Block]:
    for name, accelerometer in result.accelerometers.items():
        yield from interval_blocks(name, result)
        yield from budget_blocks(name, result)
        yield from _existing_pictures(budget_bars(name, accelerometer))
    yield from prior_blocks(result)


def _residual_chapter(result: Result) -> Iterator[Block]:
    for name, accelerometer in result.accelerometers.items():
        plots = list(residual_plots(name, accelerometer, result.runs))
        if plots:
            yield Heading(f"Residuals of {name}")
            yield from plots


def _run_chapter(result: Result) -> Iterator[Block]:
    yield from run_blocks(result.runs, show_details=True)
    yield from _existing_pictures(ripple_plot(result.runs))


def _existing_pictures(*pictures: Picture | None) -> Iterator[Picture]:
    yield from (picture for picture in pictures if picture is not None)


def print_result(
    result: Result, console: Console | None = None, *, budget: bool = False, details: bool = False
) -> None:
    """Print a result.

    Parameters
    ----------
    result
        Result of a calibration.
    console
        Console of the package rich; None: standard output.
    budget
        Whether to print the uncertainty budgets.
    details
        Whether to print correlations, counts, input files and their checksums.
    """
    console = console or make_console()
    console.print(render(result, show_budget=budget, show_details=details))


def render(result: Result, *, show_budget: bool = False, show_details: bool = False) -> Report:
    """Return a result as a rich renderable.

    show_budget: Whether to show the uncertainty budgets.
    show_details: Whether to show correlations, counts, input files and their checksums.
    """
    return Report(result_blocks(result, show_budget=show_budget, show_details=show_details))


def batch_blocks(batch: BatchResult) -> list[Block]:
    """Return the summary of a batch, followed by its failures."""
    rows = tuple(
        row
        for folder, outcome in batch.campaigns.items()
        if isinstance(outcome, Result)
        for row in _batch_rows(folder, outcome)
    )
    blocks: list[Block] = [Table(_BATCH_COLUMNS, rows)] if rows else []
    blocks += [
        Paragraph(line, "warning")
        for folder, error in batch.failed.items()
        for line in _error_lines(folder, error)
    ]
    blocks += [
        Paragraph(f"{folder}: the records contradict the result. Do not use it.", "warning")
        for folder in batch.contradicted
    ]
    blocks += [
        Paragraph(f"{folder}: the data do not determine all requested terms.", "undetermined")
        for folder in batch.not_determined
    ]
    n_failed = len(batch.failed)
    n_calibrated = len(batch.campaigns) - n_failed
    noun = "campaign" if n_calibrated == 1 else "campaigns"
    blocks.append(Paragraph(f"{n_calibrated} {noun} calibrated, {n_failed} failed.", "quiet"))
    return blocks


def _error_lines(folder: str, error: str) -> list[str]:
    """Return the lines of the error of a campaign, which begin with its folder."""
    begins_with_folder = error.startswith(tuple(folder + end for end in (":", "/", "\\")))
    return (error if begins_with_folder else f"{folder}: {error}").split("\n")


def _batch_rows(folder: str, result: Result) -> Iterator[tuple[str, ...]]:
    for name, accelerometer in result.accelerometers.items():
        coefficient = accelerometer.coefficients.get("K_II")
        value, u, unit = (None, None, "") if coefficient is None else to_field_units(coefficient)
        yield folder, name, format_estimate(value, u), unit, accelerometer.state or ""
