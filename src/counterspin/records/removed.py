"""What a recorder took off a signal before it wrote it: its mean, a line or a parabola.

The rows of such a column are orthogonal to 1, to 1 and t, or to 1, t and t^2, but for the last
digit with which it was written. No real record is: its noise alone leaves parts along each of them,
as large as that of any single sample. A line through the first row and the last, which some take
for a base line, leaves both of them zero in every record. Only all rows of a file show it, those
too that are not used.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from counterspin.arrays import Array

#: What may be removed, by how many of 1, t and t^2 it is.
WORDS: Final = ("", "mean", "line", "parabola")

#: Probability by chance below which something was removed.
_CHANCE: Final = 1e-6

#: What rounding leaves of a part, over the noise, is less than this.
_ROUNDING: Final = 0.02

#: And of a row, over the rows beside it; where these are as small they are all rounded to zero.
_ROUNDING_OF_A_ROW: Final = 1e-3


class PolynomialParts:
    """The parts along 1, t and t^2 of columns that are read in pieces.

    signals: How many columns there are.
    """

    def __init__(self, signals: int) -> None:
        self._origin: float | None = None
        self._last = 0.0
        self._of_time = np.zeros((signals, 3, 3))
        self._of_signals = np.zeros((signals, 3))
        self._first: list[list[float]] = [[] for _ in range(signals)]
        self._final: list[list[float]] = [[] for _ in range(signals)]

    def add(self, time: Array, signals: Sequence[Array]) -> None:
        """Take in further rows; time in any unit, shapes (n,)."""
        stamped = np.isfinite(time)
        if not stamped.any():
            return
        if self._origin is None:
            self._origin = float(time[np.argmax(stamped)])
        since = time - self._origin
        powers = np.stack([np.ones_like(since), since, since * since])
        self._last = max(self._last, float(since[stamped][-1]))
        whole = powers @ powers.T
        for place, signal in enumerate(signals):
            sums = powers @ signal
            if np.isfinite(sums[2]):
                self._of_time[place] += whole
            else:
                good = stamped & np.isfinite(signal)
                own = powers[:, good]
                sums = own @ signal[good]
                self._of_time[place] += own @ own.T
            self._of_signals[place] += sums
            self._take_ends(place, signal)

    def _take_ends(self, place: int, signal: Array) -> None:
        """Keep the first two rows and the last two that have a value."""
        first, final = self._first[place], self._final[place]
        filled = signal[np.isfinite(signal)]
        first += filled[: 2 - len(first)].tolist()
        self._final[place] = [*final, *filled[-2:].tolist()][-2:]

    def ends(self, place: int) -> float:
        """Return the larger of a column's first and last row, in its unit.

        Infinite if they are not far below the rows beside them.
        """
        (first, *second), (*before, last) = self._first[place] or [0.0], self._final[place] or [0.0]
        size = max(abs(first), abs(last))
        beside = min((abs(row) for row in (*second, *before)), default=0.0)
        return size if size < _ROUNDING_OF_A_ROW * beside else math.inf

    def of(self, place: int) -> Array:
        """Return a column's parts along the polynomials made orthonormal, shape (3,).

        In the column's unit; each is as large as the noise of one row where that is all there is.
        """
        scale = (self._last or 1.0) ** -np.arange(3.0)
        gram = self._of_time[place] * np.outer(scale, scale)
        try:
            root = np.linalg.cholesky(gram)
        except np.linalg.LinAlgError:  # fewer than three times
            return np.full(3, math.inf)
        return np.asarray(np.linalg.solve(root, self._of_signals[place] * scale))


def removed(parts: Sequence[Array]) -> int:
    """Return how many of 1, t and t^2 were removed from records that one recorder made.

    A line through the ends counts as one of least squares. One record does not show it: a recorder
    that begins at zero may come back to its last digit of it by chance.

    By chance, where noise is all that there is, the answer is wrong once in a million times; any
    part of an error along them makes it rarer.

    parts: Of each record as of `PolynomialParts`, over the noise of one row, shape (4,): along the
        polynomials, and of the ends.
    """
    sizes = np.abs(np.array(parts).reshape(-1, 4))
    if len(sizes) > 1 and float(sizes[:, 3].max()) < _ROUNDING:
        return 2
    for count in (3, 2, 1) if np.isfinite(sizes[:, :3]).all() else ():
        largest = float(sizes[:, :count].max(initial=0.0))
        chance = math.erf(largest / math.sqrt(2.0)) ** (count * len(sizes))
        if largest < _ROUNDING and chance < _CHANCE:
            return count
    return 0
