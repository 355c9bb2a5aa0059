"""A study as a person reads it: a table for each analysis, and the verdict.

- `render_study`: as something that rich prints
"""

from __future__ import annotations

from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Table
from counterspin.reports.numbers import field_unit, format_number
from counterspin.reports.text import Report
from counterspin.studies.result import AnalysisResult, CoefficientResult, StudyResult
from counterspin.studies.tally import LEVELS

_COLUMNS = (
    Column("Coefficient"),
    Column("Unit"),
    Column("Bias", align="right"),
    Column("Sd", align="right"),
    Column("Mean u", align="right"),
    *(Column(f"In {100 * level:.0f} %", align="right") for level in LEVELS),
    Column("Efficiency", align="right"),
)


def render_study(result: StudyResult) -> Report:
    """Return the study's tables and its verdict."""
    state = "" if result.complete else f" of {result.asked} (interrupted)"
    blocks: list[Block] = [
        Heading(f"{result.title}: {result.trials} trials{state}, seed {result.seed}"),
        Paragraph("Varying: " + ("; ".join(result.varying) or "the noise only") + "."),
    ]
    for one in result.analyses:
        blocks += [
            Heading(f"{one.name} ({one.engine})"),
            Table(_COLUMNS, tuple(_row(c) for c in one.coefficients)),
        ]
        if one.lost:
            blocks.append(Paragraph(_lost(one), "quiet"))
    blocks.append(Heading("Verdict"))
    for line in result.verdict:
        good = "is trustworthy" in line
        blocks.append(Paragraph(line, "answer" if good else "warning"))
    blocks.append(
        Paragraph(
            "Bias with its standard error. In 68, 95, 99 %: share of the trials whose interval of "
            "that level held the truth, with its binomial 95 % interval. Efficiency: the "
            "Cramér-Rao bound of all samples over the mean square error.",
            "quiet",
        )
    )
    return Report(blocks)


def _lost(one: AnalysisResult) -> str:
    return f"Not determined by the records: {', '.join(one.lost)}."


def _row(one: CoefficientResult) -> tuple[str, ...]:
    unit, factor = field_unit(one.unit)
    summary = one.summary
    bias, error = (format_number(factor * x, 2) for x in (summary.bias, summary.se_bias))
    return (
        one.name,
        unit,
        f"{bias}\n± {error}",
        format_number(summary.sd * factor),
        format_number(summary.u * factor),
        *(
            f"{100 * share:.2f}\n[{100 * low:.2f}, {100 * high:.2f}]"
            for share, (low, high) in zip(summary.covered, summary.intervals, strict=True)
        ),
        "-" if one.efficiency is None else format_number(one.efficiency, 2),
    )
