"""What `counterspin.reproduction` returns: rows of printed figure, our figure and the reason.

- `Row`, `PaperSection`, `Reproduction`
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Row:
    """One figure of the paper and ours.

    Attributes
    ----------
    key
        A short name that stays the same.
    quantity
        What it is.
    printed
        The paper's figure, or what its printed equation gives; None where it has none.
    ours
        The figure computed here.
    unit
        Of both.
    why
        Why they differ, or that they agree.
    form
        Format of both numbers.
    """

    key: str
    quantity: str
    printed: float | None
    ours: float
    unit: str
    why: str
    form: str = ".4e"

    @property
    def printed_text(self) -> str:
        """The paper's figure as text, a dash where there is none."""
        return "-" if self.printed is None else format(self.printed, self.form)

    @property
    def ours_text(self) -> str:
        """Our figure as text."""
        return format(self.ours, self.form)


@dataclass(frozen=True)
class PaperSection:
    """Rows that belong together, under one title."""

    title: str
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class Reproduction:
    """The result of `reproduce`.

    Attributes
    ----------
    inputs
        What the paper states and what it leaves open, with units.
    sections
        The rows, grouped in the order of the paper.
    """

    inputs: Mapping[str, Any]
    sections: tuple[PaperSection, ...]

    @property
    def rows(self) -> tuple[Row, ...]:
        """All rows in order."""
        return tuple(row for section in self.sections for row in section.rows)

    def __getitem__(self, key: str) -> Row:
        """Return the row with this key; KeyError if there is none."""
        return {row.key: row for row in self.rows}[key]

    def to_dict(self) -> dict[str, Any]:
        """Return the reproduction as its JSON document."""
        return {
            "schema": 1,
            "inputs": dict(self.inputs),
            "sections": [
                {
                    "title": section.title,
                    "rows": [
                        {
                            "key": row.key,
                            "quantity": row.quantity,
                            "printed": row.printed,
                            "counterspin": row.ours,
                            "unit": row.unit,
                            "why": row.why,
                        }
                        for row in section.rows
                    ],
                }
                for section in self.sections
            ],
        }
