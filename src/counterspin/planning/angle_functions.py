"""Functions of the spindle angle of which every column is a combination while the rate is constant.

1, th, th^2, th^3 and, for each harmonic m, cos m th, sin m th, th cos m th, th sin m th: the
products of specific forces have the first harmonics, the platform's drift and g-sensitivity
multiply them with time, and integration over the angle stays among them.

- `functions`, `integration`
- `prefix_factors`: what their first rows tell, row by row
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


def prefix_factors(rows: Array, ends: npt.NDArray[np.int64], drop: int) -> Array:
    """Return the triangular factor of the first rows, up to each end; the first columns dropped.

    Returns
    -------
    Array
        Shape (ends, b - drop, b - drop).
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
