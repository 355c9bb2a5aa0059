"""Reports of a comparison of results and of a repeated calibration."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from counterspin.comparability import OUTPUT_SENTENCE_START, g_units_ratio
from counterspin.comparisons.result import (
    ComparedCoefficient,
    ComparedEstimate,
    ComparedResult,
    PairAgreement,
    RepeatedCalibration,
    RepeatedCoefficient,
    ResultComparison,
)
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
from counterspin.reports.numbers import (
    NOT_DETERMINED,
    find_display_unit,
    format_estimate,
    format_items,
    format_number,
    format_p,
)
from counterspin.results import unsealed_sentences

_COMPARISON_TITLE: Final = "Comparison of results"

#: Description in the file of a comparison.
FILE_DESCRIPTION: Final = "a comparison"

_OVERLAP_TEXTS: Final = {
    "same": "both use the same records",
    "part": "they share some records",
    "independent": "their records are independent",
}


def comparison_blocks(comparison: ResultComparison) -> Iterator[Block]:
    """Yield the verdict on agreement, the values and differences, and the changes."""
    yield Heading(_COMPARISON_TITLE, 1)
    yield from _unsealed_warnings(comparison.unsealed)
    for result in comparison.results:
        if result.state == "contradicted":
            yield Paragraph(
                f"The records contradict {result.name}, so its uncertainties and its tests below "
                "are not valid.",
                "warning",
            )
    for agreement in sorted(comparison.agreements, key=lambda agreement: agreement.agrees):
        yield Paragraph(agreement_sentence(comparison, agreement), _agreement_style(agreement))
    for result in comparison.results:
        if result.gravity is not None:
            yield Paragraph(_conversion_note(comparison, result, result.gravity))
    result_names = short_names([result.name for result in comparison.results])
    for name in dict.fromkeys(coefficient.accelerometer for coefficient in comparison.coefficients):
        yield Heading(name)
        coefficients = [
            coefficient
            for coefficient in comparison.coefficients
            if coefficient.accelerometer == name
        ]
        yield _coefficient_table(comparison, coefficients)
        yield from _k_ii_plots(coefficients, result_names)
    yield Paragraph(
        "The number after ± is the standard uncertainty (k = 1). Differences are relative to "
        f"{_reference_names(comparison)}. The uncertainties of the differences account for sources "
        "common to both results. z is the difference divided by the standard uncertainty of the "
        "difference.",
        "quiet",
    )
    yield from _shared_source_blocks(comparison)
    yield Heading("Changes")
    if comparison.changes:
        columns = [
            Column("", wraps=True),
            *(Column(result.name, wraps=True) for result in comparison.results),
        ]
        rows = tuple((change.subject, *change.values) for change in comparison.changes)
        yield Table(tuple(columns), rows)
    else:
        yield Paragraph("The results use the same model, noise and inputs.")


def _unsealed_warnings(names: Sequence[str]) -> list[Paragraph]:
    """Return warnings about results without a seal."""
    return [Paragraph(sentence, "warning") for sentence in unsealed_sentences(names)]


def _agreement_style(agreement: PairAgreement) -> Style:
    if agreement.p is None:
        return "plain"
    return "answer" if agreement.agrees else "warning"


def _reference_names(comparison: ResultComparison) -> str:
    names = dict.fromkeys(coefficient.accelerometer for coefficient in comparison.coefficients)
    names_by_result = dict[str, list[str]]()
    for name in names:
        names_by_result.setdefault(comparison.reference(name).name, []).append(name)
    if len(names_by_result) == 1:
        return next(iter(names_by_result))
    return " and ".join(
        f"{result} ({', '.join(result_names)})" for result, result_names in names_by_result.items()
    )


def _conversion_note(comparison: ResultComparison, result: ComparedResult, gravity: float) -> str:
    """Return a note on the conversion of a result to the gravity of the first result."""
    symbols_by_percent = dict[float, list[str]]()
    terms = (
        coefficient.term
        for coefficient in comparison.coefficients
        if result.has(coefficient.accelerometer)
    )
    for symbol in dict.fromkeys(terms):
        percent = 100.0 * (g_units_ratio(symbol, gravity, comparison.gravity) - 1.0)
        symbols_by_percent.setdefault(percent, []).append(symbol)
    change_texts = (
        f"{', '.join(symbols)} by {percent:+.2g} %"
        for percent, symbols in symbols_by_percent.items()
        if percent
    )
    has_converted_output = any(
        text.startswith(OUTPUT_SENTENCE_START)
        for agreement in comparison.agreements
        if agreement.result == result.name
        for text in agreement.assumed
    )
    return (
        f"{result.name} was calibrated at a gravity of {format_number(gravity, 9)} m/s^2. The "
        f"comparison converts the values to the g-units of {comparison.results[0].name} "
        f"({format_number(comparison.gravity, 9)} m/s^2)."
    ) + (
        ""
        if has_converted_output
        else f" The conversion changes {'; '.join(change_texts) or 'no coefficient'}."
    )


def agreement_sentence(comparison: ResultComparison, agreement: PairAgreement) -> str:
    """Return a sentence on the agreement of two results."""
    first_name = comparison.reference(agreement.accelerometer).name
    subject = f"{agreement.accelerometer}: {agreement.result} and {first_name}"
    overlap_text = _OVERLAP_TEXTS[agreement.records]
    if not agreement.terms:
        return f"{subject} determine no coefficient in common ({overlap_text})."
    if agreement.p is None and _is_identical(comparison, agreement):
        return f"{subject} are equal ({overlap_text})."
    if agreement.p is None:
        return (
            f"{subject} use the same records, so chance cannot explain the difference. The "
            "changes listed below cause the difference."
        )
    verdict = "agree" if agreement.agrees else "differ significantly"
    test_text = (
        f"chi-square {format_number(agreement.chi2)} with "
        f"{format_items(agreement.dof, 'degree')} of freedom, {format_p(agreement.p)}"
    )
    return f"{subject} {verdict} ({test_text}; {overlap_text})."


def _is_identical(comparison: ResultComparison, agreement: PairAgreement) -> bool:
    """Check that all coefficients determined by both results are equal."""
    result_index = [result.name for result in comparison.results].index(agreement.result)
    return not any(
        coefficient.estimates[result_index].difference
        for coefficient in comparison.coefficients
        if coefficient.accelerometer == agreement.accelerometer
        and coefficient.term in agreement.terms
    )


def _coefficient_table(
    comparison: ResultComparison, coefficients: Sequence[ComparedCoefficient]
) -> Table:
    rows, quiet_rows = list[tuple[str, ...]](), set[int]()
    for coefficient in coefficients:
        unit, factor = find_display_unit(coefficient.unit)
        label = f"{coefficient.term}, {unit}"
        for result, estimate in zip(comparison.results, coefficient.estimates, strict=True):
            if not result.has(coefficient.accelerometer):
                continue  # the accelerometer occurs only in other results
            if estimate.value is None or estimate.u is None:
                quiet_rows.add(len(rows))
                rows.append((label, result.name, NOT_DETERMINED, "", ""))
            else:
                value = format_estimate(estimate.value * factor, estimate.u * factor)
                z = "" if estimate.z is None else f"{estimate.z:.2f}"
                rows.append((label, result.name, value, _format_difference(estimate, factor), z))
            label = ""
    return Table(
        columns=(
            Column("Coefficient"),
            Column("Result", wraps=True),
            Column("Value", "right"),
            Column("Difference", "right"),
            Column("z", "right"),
        ),
        rows=tuple(rows),
        quiet_rows=frozenset(quiet_rows),
    )


def _format_difference(estimate: ComparedEstimate, factor: float) -> str:
    if estimate.difference is None or estimate.u_difference is None:
        return ""
    difference, u = estimate.difference * factor, estimate.u_difference * factor
    return format_estimate(difference, u) if u else format_number(difference)


def short_names(names: Sequence[str]) -> tuple[str, ...]:
    """Return file names without their common folders and suffix."""
    paths = [name.split("/") for name in names]
    if len({*names}) < len(names):
        return tuple(names)  # the name would be empty
    while all(len(path) > 1 for path in paths) and len({path[0] for path in paths}) == 1:
        paths = [path[1:] for path in paths]
    while all(len(path) > 1 for path in paths) and len({path[-1] for path in paths}) == 1:
        paths = [path[:-1] for path in paths]
    return tuple("/".join(path) for path in paths)


def _k_ii_plots(coefficients: list[ComparedCoefficient], names: tuple[str, ...]) -> Iterator[Block]:
    """Yield a plot of K_II in each result, with standard uncertainties."""
    for coefficient in coefficients:
        if coefficient.term != "K_II":
            continue
        unit, factor = find_display_unit(coefficient.unit)
        points = [
            (name, estimate.value * factor, estimate.u * factor)
            for name, estimate in zip(names, coefficient.estimates, strict=True)
            if estimate.value is not None and estimate.u is not None
        ]
        if len(points) > 1:
            plotted_names, y, u = (tuple(row) for row in zip(*points, strict=True))
            yield Plot(
                title=f"K_II of {coefficient.accelerometer} in each result",
                x_label="result",
                y_label=f"K_II, {unit}",
                series=(
                    PlotSeries(
                        "estimate; error bars: standard uncertainty",
                        tuple(map(float, range(len(y)))),
                        y,
                        low=tuple(
                            value - uncertainty for value, uncertainty in zip(y, u, strict=True)
                        ),
                        high=tuple(
                            value + uncertainty for value, uncertainty in zip(y, u, strict=True)
                        ),
                        kind="points",
                    ),
                ),
                x_names=plotted_names,
            )


def _shared_source_blocks(comparison: ResultComparison) -> Iterator[Block]:
    shared_sources = dict.fromkeys(
        source for agreement in comparison.agreements for source in agreement.shared
    )
    if shared_sources:
        yield Paragraph(
            "Sources common to both results, which the comparison takes into account: "
            f"{', '.join(shared_sources)}.",
            "quiet",
        )
    for text in dict.fromkeys(
        text for agreement in comparison.agreements for text in agreement.assumed
    ):
        yield Paragraph(f"Assumed: {text}", "quiet")


def repeated_calibration_blocks(calibration: RepeatedCalibration) -> list[Block]:
    """Return the verdict on a repeated result, and the changes."""
    blocks: list[Block] = [
        Heading("Repeated calibration", 1),
        *_unsealed_warnings(calibration.unsealed),
        Paragraph(
            repeated_calibration_sentence(calibration), "answer" if calibration.same else "warning"
        ),
    ]
    if calibration.moved:
        locations_text = "; ".join(f"{name}: {path}" for name, path in calibration.moved.items())
        blocks.append(
            Paragraph(
                f"These inputs were found under different file names: {locations_text}.", "quiet"
            )
        )
    changed_coefficients = [
        coefficient
        for coefficient in calibration.coefficients
        if coefficient.relative is None or coefficient.relative > 0.0
    ]
    if not calibration.same and changed_coefficients:
        blocks.append(_difference_table(changed_coefficients))
    if calibration.changes:
        blocks.append(Heading("Changes"))
        blocks.append(
            Table(
                (Column(""), Column("Then", wraps=True), Column("Now", wraps=True)),
                tuple((change.subject, *change.values) for change in calibration.changes),
            )
        )
    return blocks


def repeated_calibration_sentence(calibration: RepeatedCalibration) -> str:
    """Return a sentence on the validity of a repeated result."""
    limit = format_number(calibration.limit)
    if calibration.same:
        largest_difference = calibration.largest or 0.0
        max_difference_text = (
            f"largest relative difference {largest_difference:.1e}"
            if largest_difference
            else "all numbers are equal"
        )
        return (
            f"{calibration.result}: the repeated result equals the original within {limit} "
            f"({max_difference_text})."
        )
    subjects_text = "; ".join(change.subject for change in calibration.changes)
    cause = (
        f" Changed: {subjects_text}."
        if subjects_text
        else " The inputs, the version and the environment are the same."
    )
    if calibration.largest is None:
        difference_text = "the sets of coefficients, or of determined coefficients, differ"
    elif calibration.largest <= calibration.limit:
        difference_text = (
            f"the state was {calibration.state_before} and is now {calibration.state_now}"
        )
    elif calibration.largest_in_u is None:
        difference_text = f"the largest relative difference is {calibration.largest:.1e}"
    else:
        difference_text = (
            f"the largest difference is {format_number(calibration.largest_in_u)} u "
            f"(relative: {calibration.largest:.1e})"
        )
    return (
        f"{calibration.result}: the repeated result differs from the original by more than "
        f"{limit}: {difference_text}.{cause}"
    )


def _difference_table(changed_coefficients: list[RepeatedCoefficient]) -> Table:
    rows = list[tuple[str, ...]]()
    for coefficient in changed_coefficients:
        unit, factor = find_display_unit(coefficient.unit)
        in_u_text = "" if coefficient.in_u is None else format_number(coefficient.in_u)
        rows.append(
            (
                f"{coefficient.name}, {unit}",
                _format_value(coefficient.before, coefficient.u_before, factor),
                _format_value(coefficient.now, coefficient.u_now, factor),
                in_u_text,
            )
        )
    return Table(
        (
            Column("Coefficient"),
            Column("Then", "right"),
            Column("Now", "right"),
            Column("Difference in u", "right"),
        ),
        tuple(rows),
    )


def _format_value(value: float | None, u: float | None, factor: float) -> str:
    if value is None:
        return NOT_DETERMINED
    return format_estimate(value * factor, u * factor) if u else format_number(value * factor, 12)
