"""Printed report of a comparison of laboratories."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from counterspin.comparisons.page import short_names
from counterspin.comparisons.result import Intercomparison, ReferenceValue
from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Plot, PlotSeries, Table
from counterspin.reports.numbers import (
    field_unit,
    format_estimate,
    format_number,
    round_to_uncertainty,
)
from counterspin.results import unsealed_sentences

#: Description in the file of a figure.
FILE_DESCRIPTION: Final = "degrees of equivalence"


def intercomparison_blocks(compared: Intercomparison) -> Iterator[Block]:
    """Yield for each coefficient its reference value, degrees of equivalence and figure."""
    yield Heading("Comparison of laboratories", 1)
    for sentence in unsealed_sentences(compared.unsealed):
        yield Paragraph(sentence, "warning")
    for reference in compared.references:
        yield Heading(_title(reference))
        yield Paragraph(
            reference_sentence(reference), "answer" if reference.consistent else "warning"
        )
        yield from _tables(reference)
        yield _degree_plot(reference)
        if reference.shared:
            sources = ", ".join(reference.shared)
            yield Paragraph(
                f"The comparison includes these common sources as covariances: {sources}.", "quiet"
            )
    yield from _youden_plots(compared)
    yield Paragraph(
        "The number after ± is the standard uncertainty. U is the expanded uncertainty (k = 2). "
        "d is the value minus the reference value. E_n = d/U(d) and zeta = d/u(d) follow ISO "
        "13528; |E_n| <= 1 is satisfactory. The reference value is the weighted mean of the "
        "largest consistent subset (Cox, Metrologia 44 (2007) 187). The standard uncertainty of "
        "the reference value does not include the choice of the subset.",
        "quiet",
    )
    for text in compared.assumed:
        yield Paragraph(f"Assumed: {text}", "quiet")


def reference_sentence(reference: ReferenceValue) -> str:
    """Return the reference value and the consistency of the results in sentences."""
    test = (
        f"chi-square {format_number(reference.chi2)}, degrees of freedom: {reference.dof}, "
        f"p = {format_number(reference.p, 2)}"
    )
    if reference.value is None or reference.u is None or reference.p_members is None:
        return f"No two results are consistent ({test}), so there is no reference value."
    unit, factor = field_unit(reference.unit)
    value = format_estimate(reference.value * factor, reference.u * factor, unit)
    if reference.consistent:
        return f"Reference value {value}. All results are consistent ({test})."
    outside = [name for name, degree in reference.degrees.items() if not degree.member]
    members = [name for name, degree in reference.degrees.items() if degree.member]
    others = "; ".join(", ".join(names) for names in reference.alternatives)
    return (
        f"Reference value {value}, from the largest consistent subset: {', '.join(members)} (p "
        f"= {format_number(reference.p_members, 2)}). Results outside the subset: "
        f"{', '.join(outside)}. The complete set of results is not consistent ({test})."
    ) + (f" Other consistent subsets of the same size: {others}." if others else "")


def pictures(compared: Intercomparison) -> list[Plot]:
    """Return the degrees of equivalence of each coefficient, and a Youden plot of the first two."""
    return [*map(_degree_plot, compared.references), *_youden_plots(compared)]


def _title(reference: ReferenceValue) -> str:
    return f"{reference.term} of {reference.accelerometer}"


def _tables(reference: ReferenceValue) -> Iterator[Table]:
    """Yield the degrees of equivalence, and the differences of all pairs."""
    unit, factor = field_unit(reference.unit)

    def rounded(d: float, expanded_u: float) -> tuple[str, str]:
        both = round_to_uncertainty(d * factor, expanded_u * factor) if expanded_u else None
        if both is None or both.exponent:
            return format_number(d * factor), format_number(expanded_u * factor, 2)
        return both.value, both.u

    degree_rows = []
    for name, degree in reference.degrees.items():
        value = format_estimate(degree.value * factor, degree.u * factor)
        row = [name, value, "inside" if degree.member else "outside"]
        if degree.d is not None and degree.expanded_u_d is not None:
            scores = ("-" if s is None else f"{s:.2f}" for s in (degree.e_n, degree.zeta))
            row += [*rounded(degree.d, degree.expanded_u_d), *scores]
        degree_rows.append((*row, *[""] * (7 - len(row))))
    names = ("Laboratory", f"{reference.term}, {unit}", "Subset", "d", "U(d)", "E_n", "zeta")
    words = {"Laboratory", "Subset"}
    yield Table(
        tuple(Column(name, "left" if name in words else "right") for name in names),
        tuple(degree_rows),
    )
    yield Table(
        (
            Column("Pair"),
            *(Column(name, "right") for name in (f"Difference, {unit}", "U", "E_n")),
        ),
        tuple(
            (f"{p.second} - {p.first}", *rounded(p.d, p.expanded_u_d), f"{p.e_n:.2f}")
            for p in reference.pairs
        ),
    )


def _degree_plot(reference: ReferenceValue) -> Plot:
    """Return the degrees of equivalence; without a reference value, the values."""
    unit, factor = field_unit(reference.unit)
    series = []
    for member, label in ((True, "inside the subset"), (False, "outside the subset")):
        points = [
            (float(i), factor * (degree.value if degree.d is None else degree.d), half * factor)
            for i, degree in enumerate(reference.degrees.values())
            for half in [2.0 * degree.u if degree.expanded_u_d is None else degree.expanded_u_d]
            if degree.member is member
        ]
        if points:
            x, y, half = (tuple(column) for column in zip(*points, strict=True))
            low = tuple(a - b for a, b in zip(y, half, strict=True))
            high = tuple(a + b for a, b in zip(y, half, strict=True))
            series.append(
                PlotSeries(
                    f"{label}; error bars: U", x, y, low, high, kind="points", stands_out=not member
                )
            )
    has_reference = reference.value is not None
    return Plot(
        title=f"Degrees of equivalence, {_title(reference)}",
        x_label="laboratory",
        y_label=f"{'d of ' if has_reference else ''}{reference.term}, {unit}",
        series=tuple(series),
        levels=(0.0,) if has_reference else (),
        x_names=short_names(list(reference.degrees)),
    )


def _youden_plots(compared: Intercomparison) -> Iterator[Plot]:
    """Yield the zeta scores of the first two coefficients, if two have scores.

    A cause common to both coefficients moves a laboratory along a diagonal.
    """
    if len(compared.references) < 2:
        return
    first, second = compared.references[:2]
    points = [
        (name, degree.zeta, second.degrees[name].zeta)
        for name, degree in first.degrees.items()
        if name in second.degrees
    ]
    complete = [(name, x, y) for name, x, y in points if x is not None and y is not None]
    if not complete:
        return
    limit = 1.1 * max(2.0, *(abs(score) for _, x, y in complete for score in (x, y)))
    ends = (-limit, limit)
    yield Plot(
        title=f"Youden plot of {_title(first)} and {_title(second)}",
        x_label=f"zeta of {_title(first)}",
        y_label=f"zeta of {_title(second)}",
        series=(
            PlotSeries("equal scores", ends, ends, colour="muted"),
            *(PlotSeries(name, (x,), (y,), kind="points") for name, x, y in complete),
        ),
        levels=(-2.0, 0.0, 2.0),
        x_range=ends,
        y_range=ends,
    )
