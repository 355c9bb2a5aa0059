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
_ROWS: Final = 3072


def sensitivities(
    fit: JointFit,
    terms: Sequence[Considered],
    inputs: Mapping[str, float] | None = None,
    readings: Sequence[Readings] = (),
) -> Array:
    """Return what one unit of each term or input would move each unknown by.

    Long records are thinned evenly, all by the same factor, with the white noise reduced so that
    runs, priors and walk keep their weights; that changes the sensitivities by a few per cent at
    the most.

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
    step = max(1, math.ceil(sum(record.series.time.size for record in fit.prepared) / _ROWS))
    model = Unknowns(fit.model.unknowns, tuple(terms), inputs)
    estimate = fit.solution.estimate[: len(fit.model.unknowns)]
    thinned = [
        _thinned(record, step).again(fit.model, model, 1.0, estimate) for record in fit.prepared
    ]
    noise = {
        name: replace(
            level,
            white=math.sqrt(level.sample_variance / step),
            quantisation=0.0,
        )
        for name, level in fit.noise.items()
    }
    blocks = [*blocks_of(thinned, model, noise), *blocks_at(readings, model, estimate)]
    moved: Array = -solve_blocks(blocks, model).sensitivity_considered
    return moved


def _thinned(record: Prepared, step: int) -> Prepared:
    """Return every so many rows, the last one among them: panels and motion are the whole's."""
    drop = np.ones(record.series.time.size, dtype=bool)
    drop[::-step] = False
    return record.without(drop)
