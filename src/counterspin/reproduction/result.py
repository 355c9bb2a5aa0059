"""What `counterspin.reproduction` returns: rows of printed figure, our figure and the reason."""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from counterspin.reports.shown import ShownResult


def _key(name: str) -> str:
    """Return a field's key in the JSON."""
    return "counterspin" if name == "ours" else name


@dataclass(
    frozen=True, config=ConfigDict(extra="forbid", populate_by_name=True, alias_generator=_key)
)
class Row:
    """One figure of the paper and ours."""

    key: str  #: A short name that stays the same.
    quantity: str  #: What it is.
    #: The paper's figure, or what its printed equation gives; None where it has none.
    printed: float | None
    #: The figure computed here; ``counterspin`` in the JSON.
    ours: float
    unit: str  #: Of both.
    why: str  #: Why they differ, or that they agree.
    form: str = Field(default=".4e", exclude=True)  #: Format of both numbers; not in the JSON.

    @property
    def printed_text(self) -> str:
        """The paper's figure as text, a dash where there is none."""
        return "-" if self.printed is None else format(self.printed, self.form)

    @property
    def ours_text(self) -> str:
        """Our figure as text."""
        return format(self.ours, self.form)


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class PaperSection:
    """Rows that belong together, under one title."""

    title: str
    rows: tuple[Row, ...]


class Reproduction(ShownResult):
    """The result of `reproduce`.

    Attributes
    ----------
    inputs
        What the paper states and what it leaves open, with units.
    sections
        The rows, grouped in the order of the paper.
    """

    BLOCKS: ClassVar[str] = "counterspin.reproduction.page:reproduction_blocks"
    KIND: ClassVar[str] = "reproduction"

    inputs: dict[str, Any]
    sections: tuple[PaperSection, ...]

    @property
    def rows(self) -> tuple[Row, ...]:
        """All rows in order."""
        return tuple(row for section in self.sections for row in section.rows)

    def __getitem__(self, key: str) -> Row:
        """Return the row with this key; KeyError if there is none."""
        return {row.key: row for row in self.rows}[key]
