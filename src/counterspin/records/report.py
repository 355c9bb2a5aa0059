"""What reading a record found: counts of everything, and the first places of each kind."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from counterspin.frozen import frozen


@frozen
class Gap:
    """Missing rows: the time of the last row before them and the time to the next row, s."""

    time: float
    length: float


@frozen
class Outlier:
    """A sample that was left out.

    Its column, data row (from 1), time in the file's clock (s) and value (SI); NaN where the file
    says too little of it.
    """

    column: str
    row: int
    time: float
    value: float


@frozen
class RecordReport:
    """What reading a record found."""

    path: Path  #: The file.
    #: Rows of the file, and rows that entered the record.
    rows: int
    used: int
    #: Rows that repeat the time of the row before (dropped), and those of them whose other columns
    #: differ from it.
    repeated: int
    differing: int
    #: Column name -> count of empty cells, and of outlying ones. A row without time or angle is
    #: dropped; a cell of a signal is left out of its block, or NaN in a record of points.
    empty: dict[str, int]
    outliers: dict[str, int]
    #: Rows that were left out because they stand alone, before the first or after the last gap.
    lone: int
    listed: tuple[Outlier, ...]  #: The first outliers, at most 100 for each column.
    #: The first hundred stretches of missing rows, and how many there are.
    gaps: tuple[Gap, ...]
    gap_count: int
    wrapped: bool  #: Whether the angle was unwrapped.
    #: Usual spacing of the samples, s; rate of the recorded angle, rad/s (None without one).
    step: float
    rate: float | None
    block: int  #: Samples that a full block holds; 1 for point samples.
    found: str = ""  #: How the file is written, where that is not plain.
    outside: int = 0  #: Rows outside the part that is used.

    def counts(self, outliers: int = 0) -> dict[str, int]:
        """Return how many rows of each kind there are; `outliers`: found after reading."""
        return {
            "rows": self.rows,
            "repeated": self.repeated,
            "empty": sum(self.empty.values()),
            "outliers": outliers + sum(self.outliers.values()),
            "gaps": self.gap_count,
            "block": self.block,
        }

    def notes(self) -> list[str]:
        """Return one plain sentence for each thing found, for warnings and reports."""
        notes = []
        if self.found:
            notes.append(f"The file was read as follows: {self.found}.")
        if self.outside:
            notes.append(f"{self.outside} rows outside the part to be used were left out.")
        if self.repeated:
            words = f", {self.differing} of them with other values" if self.differing else ""
            notes.append(f"{self.repeated} repeated rows were dropped{words}.")
        for column, count in self.empty.items():
            if count:
                notes.append(f"{count} empty cells in column '{column}' were left out.")
        for column, count in self.outliers.items():
            if count:
                notes.append(f"{count} outliers in column '{column}' were left out.")
        if self.lone:
            words = "1 row that stands" if self.lone == 1 else f"{self.lone} rows that stand"
            was = "was" if self.lone == 1 else "were"
            notes.append(f"{words} alone beyond a gap {was} left out.")
        if self.gap_count:
            longest = max(gap.length for gap in self.gaps)
            words = "1 gap" if self.gap_count == 1 else f"{self.gap_count} gaps"
            notes.append(f"{words} in the record; the longest takes {longest:.6g} s.")
        return notes


def rejected_of(counts: Mapping[str, int]) -> int:
    """Return how many samples were recorded but not used, of `RecordReport.counts`."""
    return counts["repeated"] + counts["empty"] + counts["outliers"]
