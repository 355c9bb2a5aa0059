"""Square matrices whose rows and columns have names."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.reports.blocks import escape_controls

if TYPE_CHECKING:
    import polars as pl

#: Rows and columns that are displayed; the others are counted.
_DISPLAYED_SHAPE: Final = (15, 6)


class LabelledMatrix:
    """A square matrix with names.

    ``matrix["Qx.K_F", "Qx.K_II"]`` is one element, ``matrix[["Qx.K_F", "Qx.K_II"]]`` an array of
    the rows and columns named, ``np.asarray(matrix)`` the whole.
    """

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of rows and columns."""
        raise NotImplementedError

    @property
    def values(self) -> Array:
        """The matrix, shape (p, p)."""
        raise NotImplementedError

    def __getitem__(self, key: Any) -> Any:
        """Return the element of two names, or the array of a list of names."""
        if isinstance(key, tuple):
            row, column = (self._place(name) for name in key)
            return float(self.values[row, column])
        if isinstance(key, str):
            return dict(zip(self.labels, self.values[self._place(key)].tolist(), strict=True))
        places = [self._place(name) for name in key]
        return self.values[np.ix_(places, places)]

    def _place(self, name: str) -> int:
        if name not in self.labels:
            raise KeyError(f"{name!r}; there are {', '.join(self.labels)}")
        return self.labels.index(name)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Any:
        """Return the whole matrix, shape (p, p)."""
        return np.array(self.values, dtype=dtype, copy=copy)

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.labels)

    def frame(self) -> pl.DataFrame:
        """Return a polars frame: the names in the column ``term``, and a column for each."""
        import polars as pl

        columns = dict(zip(self.labels, self.values.T, strict=True))
        return pl.DataFrame({"term": self.labels, **columns})

    def _cells(self) -> list[list[str]]:
        """Return names and numbers as text, the first rows and columns of a large matrix."""
        rows, columns = _DISPLAYED_SHAPE
        labels = list(map(escape_controls, self.labels))
        head = ["", *labels[:columns]]
        numbers = self.values[:rows, :columns]
        body = [
            [name, *(f"{number:.3g}" for number in row)]
            for name, row in zip(labels, numbers, strict=False)
        ]
        return [head, *body]

    def _rest(self) -> str:
        rows, columns = _DISPLAYED_SHAPE
        size = len(self.labels)
        if size <= min(rows, columns):
            return ""
        return f"{size} rows and columns in all; .frame() has them"

    def __repr__(self) -> str:
        """Return the matrix as a table of at most 17 lines."""
        cells = self._cells()
        widths = [max(len(row[place]) for row in cells) for place in range(len(cells[0]))]
        lines = (
            "  ".join(
                cell.ljust(width) if place == 0 else cell.rjust(width)
                for place, (cell, width) in enumerate(zip(row, widths, strict=True))
            ).rstrip()
            for row in cells
        )
        return "\n".join([*lines, *([self._rest()] if self._rest() else [])])

    def _repr_html_(self) -> str:
        def row(cells: Sequence[str], tag: str) -> str:
            return f"<tr>{''.join(f'<{tag}>{escape(cell)}</{tag}>' for cell in cells)}</tr>"

        head, *body = self._cells()
        rest = f"<caption>{escape(self._rest())}</caption>" if self._rest() else ""
        rows = "".join(row(cells, "td") for cells in body)
        return f"<table>{rest}<thead>{row(head, 'th')}</thead><tbody>{rows}</tbody></table>"


@frozen(eq=False)
class Covariance(LabelledMatrix):
    """Covariance matrix of the coefficients of a result."""

    terms: tuple[str, ...]  #: Names such as ``Qx.K_II``, p of them.
    matrix: Array  #: Covariances in the units of the coefficients, shape (p, p).
    units: tuple[str, ...]  #: Those units, p of them.

    @property
    def labels(self) -> tuple[str, ...]:
        """The terms."""
        return self.terms

    @property
    def values(self) -> Array:
        """The covariances."""
        return self.matrix

    __repr__ = LabelledMatrix.__repr__
