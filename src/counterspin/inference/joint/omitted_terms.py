"""What the terms would do that a model leaves out altogether.

An estimate is only as good as the terms it considers. A term that is neither estimated nor
considered moves the estimates by its size times their sensitivity to it, and nothing in the
uncertainty says so; hence the sensitivities are worked out and shown.

- `sensitivities`: d(estimate)/d(coefficient of a term left out)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.inference.joint import fit as joint
from counterspin.inference.joint.fit import Considered, JointFit
from counterspin.inference.joint.series import Series
from counterspin.inference.joint.unknowns import Unknowns

#: Rows that are enough: sensitivities depend on the columns' shapes, not on the sampling.
_ROWS: Final = 3072


def sensitivities(fit: JointFit, terms: Sequence[Considered]) -> Array:
    """Return what one unit of each term would move each unknown by.

    Long records are thinned evenly, all by the same factor, with the white noise reduced so that
    runs, priors and walk keep their weights; that changes the sensitivities by a few per cent at
    the most.

    Parameters
    ----------
    fit
        The solved problem.
    terms
        Terms that its model leaves out, q of them.

    Returns
    -------
    Array
        Shape (p, q), in the unknown's unit per unit of the term.
    """
    series = [one.series for one in fit.prepared]
    step = max(1, math.ceil(sum(one.time.size for one in series) / _ROWS))
    model = Unknowns(fit.model.unknowns, tuple(terms))
    scale_factors = {one.accelerometer: 1.0 for one in series}
    prepared = joint.prepare([_thinned(one, step) for one in series], model, scale_factors)
    noise = {
        name: replace(
            level,
            white=math.hypot(level.white, level.quantisation / math.sqrt(12.0)) / math.sqrt(step),
            quantisation=0.0,
        )
        for name, level in fit.noise.items()
    }
    moved: Array = -joint.solve_joint(prepared, model, noise).solution.sensitivity_considered
    return moved


def _thinned(series: Series, step: int) -> Series:
    drop = np.ones(series.time.size, dtype=bool)
    drop[::step] = False
    return series.without(drop)
