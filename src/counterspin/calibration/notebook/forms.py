"""Forms of a result's numbers: in SI units, as LaTeX, and matrices whose rows have names."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from counterspin.arrays import Array
from counterspin.characters import escape_controls
from counterspin.frozen import frozen
from counterspin.reports.numbers import format_compact
from counterspin.units import SiUnit, own_unit, si_unit

if TYPE_CHECKING:
    import polars as pl


_SPECIAL: Final = re.compile(r"([\\{}$&#^_~%])")

#: Rows and columns that are displayed; the others are counted.
_DISPLAYED_SHAPE: Final = (15, 6)


@frozen
class StatedGravity:
    """The gravity in whose units a coefficient is."""

    #: m/s^2, and its standard uncertainty.
    value: float
    u: float = 0.0
    #: What the coefficient moves by per m/s^2 of the g assumed, in its own unit.
    sensitivity: float = 0.0


@frozen
class SiEstimate:
    """One coefficient in SI units."""

    #: Estimate, standard uncertainty and their unit.
    value: float
    u: float
    unit: SiUnit
    dof: float | None  #: Effective degrees of freedom of u; None is infinite.
    u_without_g: float  #: u if g were exact.
    #: What one standard uncertainty of g moves the estimate by, signed: nothing where it cancels.
    shift: float
    shift_kept: float  #: The same for the number in g-units, converted with an exact g.

    def __str__(self) -> str:
        """Return such as ``2.75772(37)e-6 m^-1 s^2``."""
        return f"{format_compact(self.value, self.u)} {self.unit.words}"


def si_estimate(
    value: float, u: float, unit: str, dof: float | None, gravity: StatedGravity
) -> SiEstimate:
    """Return a coefficient in SI units.

    The SI value is K g^n. If an error of the g assumed moves K by s per m/s^2, it moves the SI
    value by g^n (s + n K/g), which takes the place of g^n s in the uncertainty.

    value, u, unit, dof: Of the coefficient, in g-units.
    gravity: The g of the unit.
    """
    return _estimate(value, u, (1.0, *si_unit(unit)), dof, gravity)


def own_estimate(
    value: float, u: float, unit: str, dof: float | None, gravity: StatedGravity
) -> SiEstimate:
    """Return in SI units what is in an instrument's own unit, or in that over g.

    Arguments as of `si_estimate`; ValueError if the unit has no expression in SI.
    """
    return _estimate(value, u, own_unit(unit), dof, gravity)


def _estimate(
    value: float,
    u: float,
    unit: tuple[float, SiUnit, int],
    dof: float | None,
    gravity: StatedGravity,
) -> SiEstimate:
    factor, symbol, power = unit
    g = gravity.value
    scale = factor * g**power
    si_value, si_u = value * scale, u * scale
    if gravity.u == 0.0:
        return SiEstimate(si_value, si_u, symbol, dof, si_u, 0.0, 0.0)
    kept = gravity.sensitivity * gravity.u * scale
    shift = kept + power * si_value / g * gravity.u
    without = math.sqrt(max(si_u**2 - kept**2, 0.0))
    combined = math.hypot(without, shift)
    # What g adds or takes away has no degrees of freedom (GUM G.4.1).
    freedom = None if dof is None else dof * (combined / si_u) ** 4
    return SiEstimate(si_value, combined, symbol, freedom, without, shift, kept)


def latex_symbol(symbol: str) -> str:
    """Return a term's symbol in mathematics; names with dots are set as words."""
    letter, underscore, index = symbol.partition("_")
    if underscore and "." not in symbol and len(letter) == 1:
        return rf"{letter}_{{\mathrm{{{index}}}}}"
    return rf"\text{{{latex_text(symbol)}}}"


def latex_number(text: str) -> str:
    """Return a number such as ``2.70445(37)e-5`` in mathematics."""
    return re.sub(r"e([+-]?\d+)", r" \\times 10^{\1}", text)


def latex_unit(unit: str) -> str:
    """Return a unit such as ``ug/g^2`` in mathematics."""
    upright = re.sub(r"\^(-?\d+)", r"^{\1}", unit.replace(" ", r"\,")).replace("ug", r"\mu g")
    return rf"\mathrm{{{upright}}}"


def latex_text(text: str) -> str:
    """Return words with the characters escaped that LaTeX would act on."""
    named = {"\\": r"\textbackslash{}", "^": r"\^{}", "~": r"\~{}"}
    return _SPECIAL.sub(lambda found: named.get(found[1], rf"\{found[1]}"), escape_controls(text))


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


@frozen(eq=False)
class Prediction:
    """What an accelerometer indicates at specific forces."""

    indicated: Array  #: In g, shape (n,).
    #: Standard uncertainty from the coefficients, with what nothing states at its typical size; the
    #: noise of an indication is no part of it. In g, shape (n,).
    u: Array
    unit: str = "g"  #: Of both.

    def __repr__(self) -> str:
        """Return how many there are, and the extremes."""
        n = self.indicated.size
        low, high = float(self.indicated.min()), float(self.indicated.max())
        largest = float(self.u.max())
        return f"<{n} indications from {low:.6g} to {high:.6g} g, u at most {largest:.2g} g>"
