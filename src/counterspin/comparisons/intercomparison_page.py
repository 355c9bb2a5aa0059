"""Report of a comparison of laboratories."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from counterspin.comparisons.page import short_names
from counterspin.comparisons.result import Intercomparison, ReferenceValue
from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Plot, PlotSeries, Table
from counterspin.reports.numbers import (
    find_display_unit,
    format_estimate,
    format_number,
    format_p,
    round_to_uncertainty,
)
from counterspin.results import unsealed_sentences

#: Description in the file of a figure.
FILE_DESCRIPTION: Final = "degrees of equivalence"


def intercomparison_blocks(intercomparison: Intercomparison) -> Iterator[Block]:
    """Yield reference value, degrees of equivalence and figure of each coefficient."""
    yield Heading("Comparison of laboratories", 1)
    for sentence in unsealed_sentences(intercomparison.unsealed):
        yield Paragraph(sentence, "warning")
    for reference in intercomparison.references:
        yield Heading(_reference_title(reference))
        yield Paragraph(
            reference_sentence(reference), "answer" if reference.consistent else "warning"
        )
        yield from _degree_tables(reference)
        yield _degree_plot(reference)
        if reference.shared:
            sources = ", ".join(reference.shared)
            yield Paragraph(
                f"The comparison includes these common sources as covariances: {sources}.", "quiet"
            )
    yield from _youden_plots(intercomparison)
    yield Paragraph(
        "The number after ± is the standard uncertainty. U is the expanded uncertainty (k = 2). "
        "d is the value minus the reference value. E_n = d/U(d) and zeta = d/u(d) follow ISO "
        "13528; |E_n| <= 1 is satisfactory. The reference value is the weighted mean of the "
        "largest consistent subset (Cox, Metrologia 44 (2007) 187). The standard uncertainty of "
        "the reference value does not include the choice of the subset.",
        "quiet",
    )
    for text in intercomparison.assumed:
        yield Paragraph(f"Assumed: {text}", "quiet")


def reference_sentence(reference: ReferenceValue) -> str:
    """Return sentences on the reference value and the consistency of the results."""
    test_text = (
        f"chi-square {format_number(reference.chi2)}, degrees of freedom: {reference.dof}, "
        f"{format_p(reference.p)}"
    )
    if reference.value is None or reference.u is None or reference.p_members is None:
        return f"No two results are consistent ({test_text}), so there is no reference value."
    unit, factor = find_display_unit(reference.unit)
    value = format_estimate(reference.value * factor, reference.u * factor, unit)
    if reference.consistent:
        return f"Reference value {value}. All results are consistent ({test_text})."
    outside_names = [name for name, degree in reference.degrees.items() if not degree.member]
    member_names = [name for name, degree in reference.degrees.items() if degree.member]
    alternatives = "; ".join(", ".join(names) for names in reference.alternatives)
    return (
        f"Reference value {value}, from the largest consistent subset: {', '.join(member_names)} "
        f"({format_p(reference.p_members)}). Results outside the subset: "
        f"{', '.join(outside_names)}. The complete set of results is not consistent ({test_text})."
    ) + (f" Other consistent subsets of the same size: {alternatives}." if alternatives else "")


def intercomparison_plots(intercomparison: Intercomparison) -> list[Plot]:
    """Return the degrees of equivalence of each coefficient, and a Youden plot of the first two."""
    return [*map(_degree_plot, intercomparison.references), *_youden_plots(intercomparison)]


def _reference_title(reference: ReferenceValue) -> str:
    return f"{reference.term} of {reference.accelerometer}"


def _degree_tables(reference: ReferenceValue) -> Iterator[Table]:
    """Yield the degrees of equivalence, and the differences of all pairs."""
    unit, factor = find_display_unit(reference.unit)

    def format_rounded(d: float, expanded_u_d: float) -> tuple[str, str]:
        rounded = round_to_uncertainty(d * factor, expanded_u_d * factor) if expanded_u_d else None
        if rounded is None:
            return format_number(d * factor), format_number(expanded_u_d * factor, 2)
        return rounded.value + rounded.power, rounded.u + rounded.power

    degree_rows = []
    for title, degree in reference.degrees.items():
        value = format_estimate(degree.value * factor, degree.u * factor)
        row = [title, value, "inside" if degree.member else "outside"]
        if degree.d is not None and degree.expanded_u_d is not None:
            scores = (
                "-" if score is None else f"{score:.2f}" for score in (degree.e_n, degree.zeta)
            )
            row += [*format_rounded(degree.d, degree.expanded_u_d), *scores]
        degree_rows.append((*row, *[""] * (7 - len(row))))
    titles = ("Laboratory", f"{reference.term}, {unit}", "Subset", "d", "U(d)", "E_n", "zeta")
    text_titles = {"Laboratory", "Subset"}
    yield Table(
        tuple(Column(title, "left" if title in text_titles else "right") for title in titles),
        tuple(degree_rows),
    )
    yield Table(
        (
            Column("Pair"),
            *(Column(title, "right") for title in (f"Difference, {unit}", "U", "E_n")),
        ),
        tuple(
            (
                f"{pair.second} - {pair.first}",
                *format_rounded(pair.d, pair.expanded_u_d),
                f"{pair.e_n:.2f}",
            )
            for pair in reference.pairs
        ),
    )


def _degree_plot(reference: ReferenceValue) -> Plot:
    """Return the plot of the degrees of equivalence; without a reference value, of the values."""
    unit, factor = find_display_unit(reference.unit)
    series = []
    for is_member, label in ((True, "inside the subset"), (False, "outside the subset")):
        points = [
            (
                float(i),
                factor * (degree.value if degree.d is None else degree.d),
                half_width * factor,
            )
            for i, degree in enumerate(reference.degrees.values())
            for half_width in [
                2.0 * degree.u if degree.expanded_u_d is None else degree.expanded_u_d
            ]
            if degree.member is is_member
        ]
        if points:
            x, y, half_widths = (tuple(column) for column in zip(*points, strict=True))
            low = tuple(centre - width for centre, width in zip(y, half_widths, strict=True))
            high = tuple(centre + width for centre, width in zip(y, half_widths, strict=True))
            series.append(
                PlotSeries(
                    f"{label}; error bars: U",
                    x,
                    y,
                    low,
                    high,
                    kind="points",
                    is_highlighted=not is_member,
                )
            )
    has_reference = reference.value is not None
    return Plot(
        title=f"Degrees of equivalence, {_reference_title(reference)}",
        x_label="laboratory",
        y_label=f"{'d of ' if has_reference else ''}{reference.term}, {unit}",
        series=tuple(series),
        levels=(0.0,) if has_reference else (),
        x_names=short_names(list(reference.degrees)),
    )


def _youden_plots(intercomparison: Intercomparison) -> Iterator[Plot]:
    """Yield a plot of the zeta scores of the first two coefficients, if both have scores.

    A cause common to both coefficients moves a laboratory along a diagonal.
    """
    if len(intercomparison.references) < 2:
        return
    first_reference, second_reference = intercomparison.references[:2]
    points = [
        (name, degree.zeta, second_reference.degrees[name].zeta)
        for name, degree in first_reference.degrees.items()
        if name in second_reference.degrees
    ]
    scored_points = [(name, x, y) for name, x, y in points if x is not None and y is not None]
    if not scored_points:
        return
    limit = 1.1 * max(2.0, *(abs(score) for _, x, y in scored_points for score in (x, y)))
    axis_range = (-limit, limit)
    x_title, y_title = _reference_title(first_reference), _reference_title(second_reference)
    yield Plot(
        title=f"Youden plot of {x_title} and {y_title}",
        x_label=f"zeta of {x_title}",
        y_label=f"zeta of {y_title}",
        series=(
            PlotSeries("equal scores", axis_range, axis_range, colour="muted"),
            *(PlotSeries(name, (x,), (y,), kind="points") for name, x, y in scored_points),
        ),
        levels=(-2.0, 0.0, 2.0),
        x_range=axis_range,
        y_range=axis_range,
    )
