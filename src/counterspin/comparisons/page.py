"""Printed reports of a comparison and of a calibration made again."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from counterspin.comparisons.estimates import g_units_ratio
from counterspin.comparisons.result import (
    AgreementOfTwo,
    ComparedCoefficient,
    ComparedEstimate,
    ComparedResult,
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
from counterspin.reports.numbers import NOT_DETERMINED, field_unit, format_estimate, format_number
from counterspin.results import unsealed_sentences

_TITLE: Final = "Comparison of results"

#: Description in the file of a comparison.
FILE_DESCRIPTION: Final = "a comparison"

_RECORDS: Final = {
    "same": "the same records",
    "part": "some records in common",
    "independent": "independent records",
}


def comparison_blocks(compared: ResultComparison) -> Iterator[Block]:
    """Yield the verdict on agreement, the values and differences, and the changes."""
    yield Heading(_TITLE, 1)
    yield from _unsealed(compared.unsealed)
    for agreement in sorted(compared.agreements, key=lambda agreement: agreement.agrees):
        yield Paragraph(agreement_sentence(compared, agreement), _style(agreement))
    for result in compared.results:
        if result.gravity is not None:
            yield Paragraph(_conversion_note(compared, result, result.gravity))
    for name in dict.fromkeys(c.accelerometer for c in compared.coefficients):
        yield Heading(name)
        coefficients = [c for c in compared.coefficients if c.accelerometer == name]
        yield _table(compared, coefficients)
        yield from _pictures(
            coefficients, short_names([result.name for result in compared.results])
        )
    yield Paragraph(
        "The number after ± is the standard uncertainty (k = 1). Differences are relative to "
        f"{_references(compared)}. The uncertainties of the differences account for sources "
        "common to both results. z is the difference divided by the standard uncertainty of the "
        "difference.",
        "quiet",
    )
    yield from _shared_source_blocks(compared)
    yield Heading("Changes")
    if compared.changes:
        columns = [Column("", wraps=True), *(Column(r.name, wraps=True) for r in compared.results)]
        rows = tuple((change.subject, *change.values) for change in compared.changes)
        yield Table(tuple(columns), rows)
    else:
        yield Paragraph("The results use the same model, noise and inputs.")


def _unsealed(names: Sequence[str]) -> list[Paragraph]:
    """Return the warning of results whose files have no seal."""
    return [Paragraph(sentence, "warning") for sentence in unsealed_sentences(names)]


def _style(agreement: AgreementOfTwo) -> Style:
    if agreement.p is None:
        return "plain"
    return "answer" if agreement.agrees else "warning"


def _references(compared: ResultComparison) -> str:
    names = dict.fromkeys(c.accelerometer for c in compared.coefficients)
    by_result = dict[str, list[str]]()
    for name in names:
        by_result.setdefault(compared.reference(name).name, []).append(name)
    if len(by_result) == 1:
        return next(iter(by_result))
    return " and ".join(
        f"{result} ({', '.join(names_of_result)})" for result, names_of_result in by_result.items()
    )


def _conversion_note(compared: ResultComparison, result: ComparedResult, gravity: float) -> str:
    """Return the note on the conversion of a result's numbers to the first result's g."""
    moved = dict[float, list[str]]()
    terms = (c.term for c in compared.coefficients if result.has(c.accelerometer))
    for symbol in dict.fromkeys(terms):
        percent = 100.0 * (g_units_ratio(symbol, gravity, compared.gravity) - 1.0)
        moved.setdefault(percent, []).append(symbol)
    amounts = (
        f"{', '.join(symbols)} by {percent:+.2g} %" for percent, symbols in moved.items() if percent
    )
    return (
        f"{result.name} was calibrated at a gravity of {format_number(gravity, 9)} m/s^2. The "
        f"comparison converts the values to the g-units of {compared.results[0].name} "
        f"({format_number(compared.gravity, 9)} m/s^2). The conversion changes "
        f"{'; '.join(amounts) or 'no coefficient'}."
    )


def agreement_sentence(compared: ResultComparison, agreement: AgreementOfTwo) -> str:
    """Return a sentence on the agreement of two results."""
    first = compared.reference(agreement.accelerometer).name
    whose = f"{agreement.accelerometer}: {agreement.result} and {first}"
    records = _RECORDS[agreement.records]
    if not agreement.terms:
        return f"{whose} determine no coefficient in common ({records})."
    if agreement.p is None and _is_identical(compared, agreement):
        return f"{whose} are equal ({records})."
    if agreement.p is None:
        return (
            f"{whose} use the same records, so chance cannot explain the difference "
            f"({records}). The changes listed below cause the difference."
        )
    agree = "agree" if agreement.agrees else "differ significantly"
    words = (
        f"chi-square {format_number(agreement.chi2)} with {agreement.dof} "
        f"{'degree' if agreement.dof == 1 else 'degrees'} of freedom, "
        f"p = {format_number(agreement.p, 2)}"
    )
    return f"{whose} {agree} ({words}; {records})."


def _is_identical(compared: ResultComparison, agreement: AgreementOfTwo) -> bool:
    """Check that all coefficients determined by both results are equal."""
    place = [result.name for result in compared.results].index(agreement.result)
    return not any(
        coefficient.estimates[place].difference
        for coefficient in compared.coefficients
        if coefficient.accelerometer == agreement.accelerometer
        and coefficient.term in agreement.terms
    )


def _table(compared: ResultComparison, coefficients: Sequence[ComparedCoefficient]) -> Table:
    rows, quiet = list[tuple[str, ...]](), set[int]()
    for coefficient in coefficients:
        unit, factor = field_unit(coefficient.unit)
        label = f"{coefficient.term}, {unit}"
        for result, estimate in zip(compared.results, coefficient.estimates, strict=True):
            if not result.has(coefficient.accelerometer):
                continue  # a result may lack an accelerometer of another one
            if estimate.value is None or estimate.u is None:
                quiet.add(len(rows))
                rows.append((label, result.name, NOT_DETERMINED, "", ""))
            else:
                value = format_estimate(estimate.value * factor, estimate.u * factor)
                z = "" if estimate.z is None else f"{estimate.z:.2f}"
                rows.append((label, result.name, value, _difference(estimate, factor), z))
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
        quiet=frozenset(quiet),
    )


def _difference(estimate: ComparedEstimate, factor: float) -> str:
    if estimate.difference is None or estimate.u_difference is None:
        return ""
    difference, u = estimate.difference * factor, estimate.u_difference * factor
    return format_estimate(difference, u) if u else format_number(difference)


def short_names(names: Sequence[str]) -> tuple[str, ...]:
    """Return file names without their common folders and suffix."""
    parts = [name.split("/") for name in names]
    if len({*names}) < len(names):
        return tuple(names)  # the name would be empty
    while all(len(path) > 1 for path in parts) and len({path[0] for path in parts}) == 1:
        parts = [path[1:] for path in parts]
    while all(len(path) > 1 for path in parts) and len({path[-1] for path in parts}) == 1:
        parts = [path[:-1] for path in parts]
    return tuple("/".join(path) for path in parts)


def _pictures(coefficients: list[ComparedCoefficient], names: tuple[str, ...]) -> Iterator[Block]:
    """Yield K_II through the results, with its standard uncertainties."""
    for coefficient in coefficients:
        if coefficient.term != "K_II":
            continue
        unit, factor = field_unit(coefficient.unit)
        points = [
            (name, e.value * factor, e.u * factor)
            for name, e in zip(names, coefficient.estimates, strict=True)
            if e.value is not None and e.u is not None
        ]
        if len(points) > 1:
            shown, y, u = (tuple(row) for row in zip(*points, strict=True))
            yield Plot(
                title=f"K_II of {coefficient.accelerometer} in each result",
                x_label="result",
                y_label=f"K_II, {unit}",
                series=(
                    PlotSeries(
                        "estimate; error bars: standard uncertainty",
                        tuple(map(float, range(len(y)))),
                        y,
                        low=tuple(a - b for a, b in zip(y, u, strict=True)),
                        high=tuple(a + b for a, b in zip(y, u, strict=True)),
                        kind="points",
                    ),
                ),
                x_names=shown,
            )


def _shared_source_blocks(compared: ResultComparison) -> Iterator[Block]:
    shared = dict.fromkeys(source for a in compared.agreements for source in a.shared)
    if shared:
        yield Paragraph(
            (
                "Sources common to both results, which the comparison takes into account: "
                f"{', '.join(shared)}."
            ),
            "quiet",
        )
    for text in dict.fromkeys(text for a in compared.agreements for text in a.assumed):
        yield Paragraph(f"Assumed: {text}", "quiet")


def repeat_blocks(repeated: RepeatedCalibration) -> list[Block]:
    """Return the verdict on a repeated result, and the changes."""
    blocks: list[Block] = [
        Heading("Repeated calibration", 1),
        *_unsealed(repeated.unsealed),
        Paragraph(repetition_sentence(repeated), "answer" if repeated.same else "warning"),
    ]
    if repeated.moved:
        locations = "; ".join(f"{name}: {where}" for name, where in repeated.moved.items())
        blocks.append(
            Paragraph(f"These inputs were found under different file names: {locations}.", "quiet")
        )
    differing = [c for c in repeated.coefficients if c.relative is None or c.relative > 0.0]
    if not repeated.same and differing:
        blocks.append(_difference_table(differing))
    if repeated.changes:
        blocks.append(Heading("Changes"))
        blocks.append(
            Table(
                (Column(""), Column("Then", wraps=True), Column("Now", wraps=True)),
                tuple((change.subject, *change.values) for change in repeated.changes),
            )
        )
    return blocks


def repetition_sentence(repeated: RepeatedCalibration) -> str:
    """Return a sentence on the validity of a repeated result."""
    limit = format_number(repeated.limit)
    if repeated.same:
        size = repeated.largest or 0.0
        most = f"largest relative difference {size:.1e}" if size else "all numbers are equal"
        return (
            f"{repeated.result}: the repeated result equals the original within {limit} ({most})."
        )
    whose = "; ".join(change.subject for change in repeated.changes)
    cause = (
        f" Changed: {whose}."
        if whose
        else (" The inputs, the version and the environment are the same.")
    )
    if repeated.largest is None:
        how = "the sets of coefficients, or of determined coefficients, differ"
    elif repeated.largest <= repeated.limit:
        how = f"the state was {repeated.state_before} and is now {repeated.state_now}"
    elif repeated.largest_in_u is None:
        how = f"the largest relative difference is {repeated.largest:.1e}"
    else:
        how = (
            f"the largest difference is {format_number(repeated.largest_in_u)} u "
            f"(relative: {repeated.largest:.1e})"
        )
    return (
        f"{repeated.result}: the repeated result differs from the original by more than "
        f"{limit}: {how}.{cause}"
    )


def _difference_table(differing: list[RepeatedCoefficient]) -> Table:
    rows = list[tuple[str, ...]]()
    for c in differing:
        unit, factor = field_unit(c.unit)
        in_u = "" if c.in_u is None else f"{c.in_u:.2g}"
        rows.append(
            (
                f"{c.name}, {unit}",
                _number(c.before, c.u_before, factor),
                _number(c.now, c.u_now, factor),
                in_u,
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


def _number(value: float | None, u: float | None, factor: float) -> str:
    if value is None:
        return NOT_DETERMINED
    return format_estimate(value * factor, u * factor) if u else format_number(value * factor, 12)
