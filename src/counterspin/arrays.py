"""Array type, aligned arrays, order statistics, and triangular factors of tall matrices."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
import numpy.typing as npt

#: Array of floats; docstrings name the exceptions.
Array = npt.NDArray[np.float64]

#: Standard deviation of a Gaussian over its median absolute deviation.
MAD_TO_SIGMA: Final = 1.4826

#: Rows per QR block: a block fits the cache, which is three times as fast as all rows at once.
QR_BLOCK_ROWS: Final = 512

#: Values of 8 bytes in a cache line.
_VALUES_PER_CACHE_LINE: Final = 8


def empty_aligned(*shape: int) -> Array:
    """Return an uninitialised float array whose rows are aligned with cache lines.

    Writing results across cache lines takes up to twice as long.
    """
    *rows, row_length = shape
    stride = -(-row_length // _VALUES_PER_CACHE_LINE) * _VALUES_PER_CACHE_LINE
    buffer: Array = np.empty(math.prod(rows) * stride + _VALUES_PER_CACHE_LINE)
    start = -(buffer.ctypes.data // buffer.itemsize) % _VALUES_PER_CACHE_LINE
    aligned_array: Array = buffer[start : len(buffer) - _VALUES_PER_CACHE_LINE + start].reshape(
        *rows, stride
    )
    return aligned_array[..., :row_length]


def median(values: Array) -> float:
    """Return the median of values (n,); NaN if there are none or any is NaN.

    `np.median` takes twenty times as long for a few hundred values, and its first call loads
    `numpy.ma`.
    """
    middle_index = len(values) // 2
    if not middle_index:
        return float(values[0]) if len(values) else math.nan
    lower, upper, maximum = np.partition(values, (middle_index - 1, middle_index, -1))[
        [middle_index - 1, middle_index, -1]
    ].tolist()
    if math.isnan(maximum):
        return float(maximum)  # NaN is sorted last
    return float(upper if len(values) % 2 else (lower + upper) / 2)


def quantile(values: npt.NDArray[Any], fraction: float) -> float:
    """Return a linearly interpolated quantile of values (n,); NaN if there are none or any is NaN.

    The first call of `np.quantile` or `np.unique` loads `numpy.ma`.
    """
    if not len(values):
        return math.nan
    position = fraction * (len(values) - 1)
    lower_index, upper_index = math.floor(position), math.ceil(position)
    lower, upper, maximum = np.partition(values, (lower_index, upper_index, -1))[
        [lower_index, upper_index, -1]
    ].tolist()
    return float(
        maximum if math.isnan(maximum) else lower + (upper - lower) * (position - lower_index)
    )


def triangular_factor(matrix: Array) -> Array:
    """Return R of the QR factorisation, shape (..., min(n, p), p); matrices can be stacked."""
    return np.asarray(np.linalg.qr(matrix, mode="r"))


def qr_blocks(rows: Array) -> Array:
    """Return the stacked R factors of row blocks of a matrix (n, p), and its remaining rows.

    R of the returned matrix is R of all rows, with the same accuracy, but each block fits the cache
    (Demmel et al., SIAM J. Sci. Comput. 34 (2012) A206).
    """
    n_columns = rows.shape[1]
    n_block_rows = len(rows) // QR_BLOCK_ROWS * QR_BLOCK_ROWS
    if n_block_rows == 0:
        return rows
    triangles = triangular_factor(
        rows[:n_block_rows].reshape(-1, QR_BLOCK_ROWS, n_columns)
    ).reshape(-1, n_columns)
    return np.concatenate([triangles, rows[n_block_rows:]])


def triangular_root(factor: Array) -> Array:
    """Return the lower triangular L with L @ L.T = factor @ factor.T and no negative diagonal."""
    upper = triangular_factor(factor.T)
    signs = np.where(np.diagonal(upper) < 0.0, -1.0, 1.0)
    lower: Array = (signs[:, None] * upper).T
    return lower


def semidefinite_root(covariance: Array) -> Array:
    """Return T with T @ T.T = covariance, shape (p, p); negative eigenvalues become zero.

    Negative eigenvalues are rounding errors, or come from combining inconsistent blocks; removing
    them does not decrease any variance. Rows and columns are scaled to unit variance first, so that
    coefficients of any unit keep their digits.

    covariance: Symmetric, shape (p, p).
    """
    variances = np.diagonal(covariance)
    scale = np.sqrt(np.where(variances > 0.0, variances, 1.0))
    eigenvalues, eigenvectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    root: Array = scale[:, None] * eigenvectors * np.sqrt(np.maximum(eigenvalues, 0.0))
    root[~np.any(covariance, axis=1)] = 0.0  # exactly known values stay exact, without rounding
    return root
