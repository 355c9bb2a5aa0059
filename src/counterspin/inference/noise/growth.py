"""What more noise takes from what a record says of its unknowns.

Where its noise has the covariance V, a record says X' V^-1 X of unknowns with the columns X. A
variance that grows by one adds a matrix B to V, and takes X' V^-1 B V^-1 X from that. Between C,
the inverse of all information, this is what it adds to the covariance of estimates whose weights
stay as they are; at the optimum their moving has no part of first order (envelope theorem).
"""

from __future__ import annotations

import numpy as np

from counterspin.arrays import Array
from counterspin.inference.noise.model import COMPONENTS, Differences, Noise, solve_banded_factor
from counterspin.inference.noise.wander import LowRank


def information_lost(
    differences: Differences,
    columns: Array,
    noise: Noise,
    before: float = 0.0,
    added: float | Array = 0.0,
) -> Array:
    """Return what each of `COMPONENTS` takes per unit of its variance, (4, m, m).

    Each is positive semi-definite. Those of a wander are zero where the noise has none.

    columns: (n, m).
    before, added: As in `make_whitener`.
    """
    white, walk = noise.sample_variance + added, noise.random_walk**2
    bands, _ = differences.factor(white, walk)
    rows = solve_banded_factor(bands, differences.apply(columns))
    shown: list[Array] = []
    if noise.wanders:
        variances = (float(np.mean(white)) * differences.relative, *noise.variances[1:])
        every, *shown = differences.wander(differences.order, variances, before)
        wander = LowRank.of(solve_banded_factor(bands, every))
        rows = wander.apply(wander.apply(rows))
    weighted = solve_banded_factor(bands, rows, transposed=True)
    size = np.sqrt(differences.relative / differences.blocks.count)
    sample = differences.back(weighted) * size[:, None]
    parts = [sample, _upper(differences.factor(0.0, 1.0)[0], weighted)]
    parts += [one.T @ weighted for one in shown]
    lost = np.zeros((len(COMPONENTS), columns.shape[1], columns.shape[1]))
    for place, part in enumerate(parts):
        lost[place] = part.T @ part
    return lost


def _upper(bands: Array, rows: Array) -> Array:
    """Return L' rows for a lower banded L."""
    product = bands[0][:, None] * rows
    for away in range(1, len(bands)):
        product[:-away] += bands[away, :-away, None] * rows[away:]
    return np.asarray(product)
