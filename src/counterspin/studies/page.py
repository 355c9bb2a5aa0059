"""A study as a person reads it: a table for each analysis, and the verdict.

- `render_study`: as something that rich prints
"""

from __future__ import annotations

from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Table
from counterspin.reports.numbers import field_unit, format_number
from counterspin.reports.text import Report
from counterspin.studies.result import CoefficientResult, StudyResult
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
    state = "" if result.complete else f" of {result.trials_asked} (interrupted)"
    blocks: list[Block] = [
        Heading(f"{result.title}: {result.trials} trials{state}, seed {result.seed}"),
        Paragraph("Varying: " + ("; ".join(result.varying) or "the noise only") + "."),
    ]
    for name, analysis in result.analyses.items():
        blocks += [
            Heading(f"{name} ({analysis.engine})"),
            Table(_COLUMNS, tuple(_row(*item) for item in analysis.coefficients.items())),
        ]
        if analysis.undetermined:
            listed = ", ".join(analysis.undetermined)
            blocks.append(Paragraph(f"Not determined by the records: {listed}.", "quiet"))
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


def _row(name: str, found: CoefficientResult) -> tuple[str, ...]:
    unit, factor = field_unit(found.unit)
    bias, error = (format_number(factor * x, 2) for x in (found.bias, found.se_bias))
    return (
        name,
        unit,
        f"{bias}\n± {error}",
        format_number(found.sd * factor),
        format_number(found.u * factor),
        *(
            f"{100 * share:.2f}\n[{100 * low:.2f}, {100 * high:.2f}]"
            for share, (low, high) in zip(found.covered, found.intervals, strict=True)
        ),
        "-" if found.efficiency is None else format_number(found.efficiency, 2),
    )
