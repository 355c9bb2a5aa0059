"""The paper's figures beside ours, as a person reads them."""

from __future__ import annotations

from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Table
from counterspin.reproduction.result import PaperSection, Reproduction, Row

_COLUMNS = (
    Column("Quantity", wraps=True, narrowest=30),
    Column("Paper", align="right"),
    Column("counterspin", align="right"),
    Column("Unit", wraps=True),
    Column("Why they differ", wraps=True),
)


def reproduction_blocks(reproduction: Reproduction) -> list[Block]:
    """Return the comparison with the paper: quantity, paper, counterspin, unit, why."""
    blocks: list[Block] = []
    for section in reproduction.sections:
        blocks += [Heading(section.title), _table(section)]
    blocks.append(
        Paragraph(
            "Paper: a number that it states, or that its equation gives as printed. "
            "counterspin: computed just now. The derivations are in docs/paper.md.",
            "quiet",
        )
    )
    return blocks


def _table(section: PaperSection) -> Table:
    return Table(_COLUMNS, tuple(_cells(row) for row in section.rows))


def _cells(row: Row) -> tuple[str, ...]:
    return (row.quantity, row.printed_text, row.ours_text, row.unit, row.why)
