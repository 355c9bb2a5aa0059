"""The one array type, working arrays, and triangular factors of tall matrices."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
import numpy.typing as npt

#: Every array of this package holds floats unless its docstring says else.
Array = npt.NDArray[np.float64]

#: Standard deviation of a Gaussian over its median absolute deviation.
SIGMA_OF_MAD: Final = 1.4826

#: Rows that one QR takes at a time: a cache's worth, three times faster than all rows at once.
QR_ROWS: Final = 512

#: Values of 8 bytes in a cache line.
_CACHE_LINE_VALUES: Final = 8


def aligned(*shape: int) -> Array:
    """Return an uninitialised float array whose rows begin where a cache line does.

    Results written across the ends of cache lines take the processor up to twice as long.
    """
    *rows, length = shape
    stride = -(-length // _CACHE_LINE_VALUES) * _CACHE_LINE_VALUES
    store: Array = np.empty(math.prod(rows) * stride + _CACHE_LINE_VALUES)
    start = -(store.ctypes.data // store.itemsize) % _CACHE_LINE_VALUES
    array: Array = store[start : len(store) - _CACHE_LINE_VALUES + start].reshape(*rows, stride)
    return array[..., :length]


def median(values: Array) -> float:
    """Return the median of values (n,): NaN of none, or where one is NaN.

    `np.median` takes twenty times as long for a few hundred values, and at its first call it loads
    the masked arrays.
    """
    half = len(values) // 2
    if not half:
        return float(values[0]) if len(values) else math.nan
    low, high, last = np.partition(values, (half - 1, half, -1))[[half - 1, half, -1]].tolist()
    if math.isnan(last):
        return float(last)  # it is sorted last
    return float(high if len(values) % 2 else (low + high) / 2)


def quantile(values: npt.NDArray[Any], fraction: float) -> float:
    """Return a quantile of values (n,), linearly interpolated; NaN of none, or where one is NaN.

    `np.quantile` loads the masked arrays at its first call, and so does `np.unique`.
    """
    if not len(values):
        return math.nan
    position = fraction * (len(values) - 1)
    low, high = math.floor(position), math.ceil(position)
    below, above, last = np.partition(values, (low, high, -1))[[low, high, -1]].tolist()
    return float(last if math.isnan(last) else below + (above - below) * (position - low))


def triangle_of(matrix: Array) -> Array:
    """Return R of the QR factorisation, shape (min(n, p), p); also of a stack of matrices."""
    return np.asarray(np.linalg.qr(matrix, mode="r"))


def in_parts(rows: Array) -> Array:
    """Return the triangles of parts of the rows (n, p), one above the other, and the rows left.

    R of these is R of all rows, as exact as in one go, but each part fits the cache (Demmel et
    al., SIAM J. Sci. Comput. 34 (2012) A206).
    """
    width = rows.shape[1]
    whole = len(rows) // QR_ROWS * QR_ROWS
    if whole == 0:
        return rows
    triangles = triangle_of(rows[:whole].reshape(-1, QR_ROWS, width)).reshape(-1, width)
    return np.concatenate([triangles, rows[whole:]])


def triangular_root(factor: Array) -> Array:
    """Return the lower triangular L with L @ L.T = factor @ factor.T and no negative diagonal."""
    upper = triangle_of(factor.T)
    signs = np.where(np.diagonal(upper) < 0.0, -1.0, 1.0)
    lower: Array = (signs[:, None] * upper).T
    return lower


def semidefinite_root(covariance: Array) -> Array:
    """Return T with T @ T.T the covariance, shape (p, p); its negative eigenvalues become zero.

    They are rounding in a covariance that was computed as one. In one that was put together from
    parts that do not fit, taking them away makes no variance smaller. Rows and columns are scaled
    to unit variance first, so that coefficients of any unit keep their digits.

    covariance: Symmetric, shape (p, p).
    """
    diagonal = np.diagonal(covariance)
    scale = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    root: Array = scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    root[~np.any(covariance, axis=1)] = 0.0  # what is known exactly stays so, without rounding
    return root
