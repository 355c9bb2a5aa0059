"""What nobody asks for, in as few columns as the records can tell from nothing.

Beside a few coefficients that are asked for a fit has dozens of unknowns that only have a prior:
inputs, and terms at their typical sizes. In units of its prior's standard uncertainty each is a
normal deviate, and so is every orthogonal combination of them. In the directions of the columns'
singular vectors most of them do nothing that the noise would not hide a thousand times: what is
left is a dozen columns, which serve wherever a fit is repeated for other rows or another noise.
What is asked for has the same estimate and covariance, but for that.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.arrays import SIGMA_OF_MAD, Array, median, triangle_of
from counterspin.inference.joint.prepared import Prepared
from counterspin.inference.joint.unknowns import Unknown, Unknowns

#: Columns are left out whose effect, all rows together, is below this part of the noise of one row.
_LEAST_EFFECT: Final = 0.02

#: Largest credible size of a condensed unknown, in standard deviations.
_LIMIT: Final = 1e3


def condense(
    prepared: Sequence[Prepared], model: Unknowns, noise: Mapping[str, float | None]
) -> tuple[tuple[Prepared, ...], Unknowns]:
    """Return columns and model with what nobody asks for condensed, after what is asked for.

    noise: Accelerometer -> white noise of a sample, in its record's unit; None where it is not
        known.
    """
    unasked = [unknown for unknown in model.unknowns if not unknown.asked]
    spread = np.array([other.prior[1] for other in unasked])
    if not unasked or not np.isfinite(spread).all():
        return tuple(prepared), model
    mean = np.array([other.prior_mean for other in unasked])
    floors = {part.accelerometer: noise.get(part.accelerometer) or math.inf for part in prepared}
    for part in prepared:
        if not noise.get(part.accelerometer):
            floors[part.accelerometer] = min(floors[part.accelerometer], white_level(part))
    if min(floors.values(), default=0.0) == 0.0:
        # Nothing hides anything.
        return tuple(prepared), model
    others = [k for k, unknown in enumerate(model.unknowns) if not unknown.asked]
    weighted = []
    for part in prepared:
        rows = np.zeros((part.white.factor.shape[0], len(model.unknowns)))
        rows[:, list(part.unknowns)] = part.white.factor
        weighted.append(rows[:, others] * (spread / floors[part.accelerometer]))
    _, sizes, directions = np.linalg.svd(triangle_of(np.vstack(weighted)))
    kept = directions[: int(np.sum(sizes > _LEAST_EFFECT))]
    few = [Unknown("", f"condensed.{k}", (0.0, 1.0), _LIMIT, asked=False) for k in range(len(kept))]
    shapes = np.zeros((len(model.unknowns), len(kept)))
    shapes[others] = kept.T * spread[:, None]
    means = np.zeros(len(model.unknowns))
    means[others] = mean
    condensed = replace(model, unknowns=(*model.asked, *few))
    return tuple(_condensed(part, model, means, shapes) for part in prepared), condensed


def _condensed(part: Prepared, model: Unknowns, means: Array, shapes: Array) -> Prepared:
    """Return a record with what nobody asks for in other columns.

    means: (p,) of the unknowns that are condensed, 0 of others.
    shapes: (p, few): what one unit of each new unknown is.
    """
    own = [k for k, place in enumerate(part.unknowns) if model.unknowns[place].asked]
    asked = [place for place, unknown in enumerate(model.unknowns) if unknown.asked]
    places = [asked.index(part.unknowns[k]) for k in own]
    here = list(part.unknowns)
    turned = np.hstack([np.eye(len(here))[:, own], shapes[here]])
    series, white = part.series, part.white
    condensed = replace(
        part,
        series=replace(series, error=series.error - part.design @ means[here]),
        unknowns=(*places, *range(len(asked), len(asked) + shapes.shape[1])),
        design=part.design @ turned,
    )
    # Of white noise it says in the new columns what it said in the old ones.
    triangle = replace(
        white, factor=white.factor @ turned, target=white.target - white.factor @ means[here]
    )
    vars(condensed)["white"] = triangle
    return condensed


def white_level(part: Prepared) -> float:
    """Return the white noise of a record's samples, from what changes from row to row.

    Third differences of what no column explains: slow noise does not show in them.
    """
    series, white = part.series, part.white
    scale = np.linalg.norm(white.factor, axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    found = np.linalg.lstsq(white.factor / scale, white.target, rcond=None)[0] / scale
    left = series.error - part.design @ found
    own = series.polynomials(max(series.order, 1))
    left = left - own @ np.linalg.lstsq(own, left, rcond=None)[0]
    rough = np.diff(left * np.sqrt(series.count / series.relative), 3)
    if rough.size == 0:
        return 0.0
    return SIGMA_OF_MAD * median(np.abs(rough)) / math.sqrt(20.0)
