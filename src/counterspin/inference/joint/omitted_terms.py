"""What the terms would do that a model leaves out altogether.

An estimate is only as good as the terms it considers. A term that is neither estimated nor
considered moves the estimates by its size times their sensitivity to it, and nothing in the
uncertainty says so; hence the sensitivities are worked out and shown.

- `sensitivities`: d(estimate)/d(coefficient of a term left out, or an input)
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.inference.joint.fit import JointFit, blocks_of, solve_blocks
from counterspin.inference.joint.prepared import Prepared
from counterspin.inference.joint.unknowns import Considered, Unknowns
from counterspin.inference.readings import Readings, blocks_at

#: Rows that are enough: sensitivities depend on the columns' shapes, not on the sampling.
_SENSITIVITY_ROWS: Final = 3072


def sensitivities(
    fit: JointFit,
    terms: Sequence[Considered],
    inputs: Mapping[str, float] | None = None,
    readings: Sequence[Readings] = (),
) -> Array:
    """Return what one unit of each term or input would move each unknown by.

    Long records are thinned. That changes what a term of typical size moves an estimate by, by
    0.1 % of itself or 1 % of u at the most in a campaign of a few runs.

    Parameters
    ----------
    fit
        The solved problem.
    terms
        Terms that its model leaves out, q of them.
    inputs
        Inputs that its model takes as exact, r of them, with any size above 0.
    readings
        That were fitted beside the records, or alone, each with its noise.

    Returns
    -------
    Array
        Shape (p, q + r), in the unknown's unit per unit of the term or input.
    """
    model = Unknowns(fit.model.unknowns, tuple(terms), inputs)
    estimate = fit.solution.estimate[: len(fit.model.unknowns)]
    most = _SENSITIVITY_ROWS // max(1, len(fit.prepared))
    thinned = [
        _thinned(record, most).again(fit.model, model, 1.0, estimate) for record in fit.prepared
    ]
    noise = {
        name: replace(level, white=math.sqrt(level.sample_variance), quantisation=0.0)
        for name, level in fit.noise.items()
    }
    blocks = [*blocks_of(thinned, model, noise), *blocks_at(readings, model, estimate)]
    moved: Array = -solve_blocks(blocks, model).sensitivity_considered
    return moved


def _thinned(record: Prepared, most: int) -> Prepared:
    """Return so many rows or few more: middle ones of their neighbours, with the weight of all.

    Sums over these rows are midpoint sums of the whole record, its ends included. What is
    integrated for them is a shape.
    """
    step = max(record.series.time.size // max(1, most), 1) | 1  # odd, which has a middle
    first = np.arange(0, record.series.time.size, step)
    last = np.append(first[1:], record.series.time.size) - 1
    drop = np.ones(record.series.time.size, dtype=bool)
    drop[(first + last) // 2] = False
    kept = record.without(drop)
    series = replace(
        kept.series,
        count=np.add.reduceat(record.series.count, first),
        trajectory=replace(kept.series.trajectory, coarse=True),
    )
    return replace(kept, series=series)
