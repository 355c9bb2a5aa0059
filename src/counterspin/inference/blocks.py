"""One record's square-root information about the shared unknowns (Bierman 1977).

However long a record is, what it says about p unknowns fits into p rows. The record's own start
offset and start velocity are projected out on the way.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import QR_ROWS, Array, in_parts, triangle_of
from counterspin.errors import NotIdentifiableError
from counterspin.frozen import frozen

_CHUNK: Final = 32 * QR_ROWS  #: rows copied at a time, which bounds the memory


@frozen
class Block:
    """What one record says about the shared unknowns, in rotated rows of unit variance.

    ``target = factor @ unknowns + considered @ considered_values + noise``.
    """

    factor: Array  #: Upper trapezoidal, shape (k, p), k <= p + q.
    target: Array  #: Shape (k,).
    considered: Array  #: The columns of the considered terms in the same rows, shape (k, q).
    #: Sum of squares that neither unknowns, nor considered terms, nor nuisances can explain.
    rss: float
    #: Number of observations and of the record's own unknowns that were projected out.
    rows: int
    nuisance: int

    def scaled(self, ratio: float) -> Block:
        """Return the block of rows that weigh more by a factor."""
        return replace(
            self,
            factor=ratio * self.factor,
            target=ratio * self.target,
            considered=ratio * self.considered,
            rss=ratio**2 * self.rss,
        )


def reduce_block(
    design: npt.ArrayLike,
    observations: npt.ArrayLike,
    nuisance: npt.ArrayLike | None = None,
    considered: npt.ArrayLike | None = None,
) -> Block:
    """Reduce one record to its square-root information about the shared unknowns.

    One QR of [nuisance | design | considered | observations]; the rows that belong to the
    nuisances are dropped, which is the exact projection.

    design: Columns of the unknowns, whitened (unit variance, uncorrelated), shape (n, p).
    observations: Whitened observations, shape (n,).
    nuisance: Columns of the record's own unknowns, whitened, shape (n, m); none by default.
    considered: Columns of the considered terms, whitened, shape (n, q); none by default.
    """
    y = np.asarray(observations, dtype=np.float64)
    n = y.size
    parts = [
        np.empty((n, 0)) if part is None else np.asarray(part, dtype=np.float64)
        for part in (nuisance, design, considered)
    ]
    if y.ndim != 1 or any(part.ndim != 2 or part.shape[0] != n for part in parts):
        shapes = ", ".join(str(part.shape) for part in parts)
        raise ValueError(
            f"nuisance, design and considered need the {n} rows of the observations; "
            f"their shapes are {shapes}"
        )
    m, p, q = (part.shape[1] for part in parts)

    triangle = np.empty((0, m + p + q + 1))
    for start in range(0, n, _CHUNK):
        rows = slice(start, start + _CHUNK)
        chunk = np.column_stack([part[rows] for part in parts] + [y[rows]])
        triangle = triangle_of(np.vstack([triangle, in_parts(chunk)]))
    if not np.isfinite(triangle).all():
        raise ValueError("the columns or the observations hold numbers that are not finite")

    own = triangle[:m, :m]
    if dependent(own).size:
        raise NotIdentifiableError(
            f"{n} samples cannot tell the {m} unknowns of the record itself (such as its start "
            "offset and start velocity) apart; the record is too short"
        )
    kept = triangle[m : m + p + q]
    return Block(
        factor=kept[:, m : m + p],
        target=kept[:, -1],
        considered=kept[:, m + p : m + p + q],
        rss=float(np.sum(triangle[m + p + q :, -1] ** 2)),
        rows=n,
        nuisance=m,
    )


def dependent(triangle: Array) -> npt.NDArray[np.intp]:
    """Return the columns of a triangular factor that depend on those before them, to rounding."""
    norms = np.linalg.norm(triangle, axis=0)
    diagonal = np.zeros_like(norms)  # a column beyond the last row depends on the others
    diagonal[: triangle.shape[0]] = np.abs(np.diagonal(triangle))
    return np.flatnonzero(diagonal <= 4.0 * norms.size * np.finfo(np.float64).eps * norms)
