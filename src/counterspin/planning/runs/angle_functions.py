"""Functions of the spindle angle of which every column is a combination while the rate is constant.

1, th, th^2, th^3 and, for each harmonic m, cos m th, sin m th, th cos m th, th sin m th: the
products of specific forces have the first harmonics, the platform's drift and g-sensitivity
multiply them with time, and integration over the angle stays among them.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array, triangle_of


def functions(angle: Array, harmonics: int) -> Array:
    """Return 1, th, th^2, th^3 and, by harmonic, cos, sin, th cos, th sin; shape (n, b)."""
    columns = [angle**power for power in range(4)]
    for m in range(1, harmonics + 1):
        cos, sin = np.cos(m * angle), np.sin(m * angle)
        columns += [cos, sin, angle * cos, angle * sin]
    return np.column_stack(columns)


def integration(harmonics: int, order: int) -> Array:
    """Return the matrix that integrates a combination of the functions `order` times over th."""
    size = 4 + 4 * harmonics
    once = np.zeros((size, size))
    for power in range(3):
        once[power + 1, power] = 1.0 / (power + 1)
    for m in range(1, harmonics + 1):
        place = slice(4 * m, 4 * m + 4)
        # Columns: the derivatives of cos, sin, th cos, th sin in terms of the same four.
        derivative = np.array(
            [[0.0, m, 1.0, 0.0], [-m, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, m], [0.0, 0.0, -m, 0.0]]
        )
        once[place, place] = np.linalg.inv(derivative)
    return np.asarray(np.linalg.matrix_power(once, order))


def shifted(weights: Array, by: Array) -> Array:
    """Return combinations of the functions of th as combinations of the functions of th - by.

    weights: Shape (n, b, k).
    by: rad, shape (n,).
    """
    n, size, k = weights.shape
    s = by[:, None]
    w = [weights[:, i] for i in range(4)]
    result = np.empty_like(weights)
    result[:, 0] = w[0] + s * (w[1] + s * (w[2] + s * w[3]))
    result[:, 1] = w[1] + s * (2.0 * w[2] + 3.0 * s * w[3])
    result[:, 2] = w[2] + 3.0 * s * w[3]
    result[:, 3] = w[3]
    m = np.arange(1, size // 4)
    cos, sin = (f(m * s)[:, :, None] for f in (np.cos, np.sin))
    before = weights[:, 4:].reshape(n, m.size, 4, k)
    after = result[:, 4:].reshape(n, m.size, 4, k)
    of_cos, of_sin = (before[:, :, i] + s[:, :, None] * before[:, :, i + 2] for i in (0, 1))
    after[:, :, 0] = cos * of_cos + sin * of_sin
    after[:, :, 1] = cos * of_sin - sin * of_cos
    after[:, :, 2] = cos * before[:, :, 2] + sin * before[:, :, 3]
    after[:, :, 3] = cos * before[:, :, 3] - sin * before[:, :, 2]
    return result


def prefix_factors(rows: Array, ends: npt.NDArray[np.int64], drop: int) -> Array:
    """Return the triangular factor of the first rows, up to each end; the first columns dropped.

    Returns: shape (ends, b - drop, b - drop).
    """
    factors = []
    triangle = np.empty((0, rows.shape[1]))
    start = 0
    for end in ends:
        triangle = triangle_of(np.vstack([triangle, rows[start:end]]))
        signs = np.where(np.diagonal(triangle) < 0.0, -1.0, 1.0)
        kept = signs[:, None] * triangle
        factors.append(kept[drop:, drop:])
        start = end
    return np.array(factors)
