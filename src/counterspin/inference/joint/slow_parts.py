"""Whether the slow part of the residuals is alike in all runs, where its noise was found in them.

Noise of the accelerometer is looked for in the slowest changes of a record, where a bend of the
record itself stands too: a slow error of one run makes the noise of all runs seem larger, and moves
what rests on that run by more than this noise allows. Noise acts in every run. So the whitened
residuals that cosines of a run can follow, up to where the record's own noise is the larger one,
are compared with those of the other runs: a quotient of chi-squares (Fisher's F), in which the
size of the noise cancels.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.joint.alternatives import Alternative, beside_fit
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.prepared import Prepared

#: Cosines beyond the last one that the accelerometer's noise dominates; most of all.
_FURTHER_COSINES: Final = 2
_MAX_COSINES: Final = 24

#: Singular value of columns of unit size below which the unknowns follow all of one.
_RANK_TOLERANCE: Final = 1e-4


@frozen
class SlowPart:
    """The slow part of one run's residuals, against those of the other runs."""

    run: str  #: The run.
    ratio: float  #: Its mean square over that of the others.
    p: float  #: Probability of as large a ratio or a larger one by chance, for this run alone.


def slow_parts(fit: JointFit, accelerometer: str) -> list[SlowPart]:
    """Compare the slow residuals of each run of an accelerometer with those of its others."""
    places = [i for i, part in enumerate(fit.prepared) if part.accelerometer == accelerometer]
    cosines = [
        Alternative("cosine", str(i), "cosine", {i: column})
        for i in places
        for column in _cosines(fit, fit.prepared[i])
    ]
    if len(places) < 2:
        return []
    held = beside_fit(fit, cosines)
    columns = held.columns / np.sqrt(held.before)
    found = []
    for i in places:
        own = columns[:, [other.owner == str(i) for other in cosines]]
        left, sizes, _ = np.linalg.svd(own, full_matrices=False)
        basis = left[:, sizes > _RANK_TOLERANCE]
        found.append((float(np.sum((basis.T @ held.residual) ** 2)), basis.shape[1]))
    return [_against(fit.prepared[i], found, k) for k, i in enumerate(places)]


def _against(prepared: Prepared, found: list[tuple[float, int]], k: int) -> SlowPart:
    from scipy.special import fdtrc

    own, freedom = found[k]
    rest = sum(energy for energy, _ in found) - own
    others = sum(count for _, count in found) - freedom
    if not freedom or not others or not rest > 0.0:
        return SlowPart(prepared.run, 1.0, 1.0)
    ratio = own / freedom / (rest / others)
    return SlowPart(prepared.run, ratio, float(fdtrc(freedom, others, ratio)))


def _cosines(fit: JointFit, prepared: Prepared) -> list[Array]:
    """Return cosines of half periods in a record, up to where its own noise is the larger one."""
    series = prepared.series
    noise = series.total(fit.noise[series.accelerometer])
    length = float(series.time[-1] - series.time[0])
    per_sample = length / float(np.sum(series.count))
    white = math.sqrt(noise.sample_variance * per_sample)
    count = _MAX_COSINES
    if (
        series.order
        and noise.random_walk < white * (math.pi * _MAX_COSINES / length) ** series.order
    ):
        corner = (noise.random_walk / white) ** (1.0 / series.order)
        count = min(_MAX_COSINES, math.ceil(corner * length / math.pi) + _FURTHER_COSINES)
    phase = math.pi * (series.time - series.time[0]) / length
    return [np.cos(j * phase) for j in range(1, count + 1)]
