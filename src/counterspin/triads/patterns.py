"""Columns that the residuals of poses may follow."""

from __future__ import annotations

from collections.abc import Collection, Iterator

import numpy as np

from counterspin.arrays import Array
from counterspin.inference.joint.alternatives import Alternative
from counterspin.inference.joint.fit import JointFit
from counterspin.physics.terms import CONDITION_TERMS, TERMS
from counterspin.readings.patterns import TERM, in_order
from counterspin.triads.poses import TriadPoses, lever_of

#: Owner and symbol of an unknown.
_Key = tuple[str, str]


def pose_candidates(
    poses: TriadPoses,
    place: int,
    fit: JointFit,
    unknown: Collection[_Key],
    followed: Collection[_Key],
) -> Iterator[Alternative]:
    """Yield the columns that the residuals of poses may follow.

    place: Of the poses among the observations of the fit.
    unknown: Owner and symbol of what the fit may choose; `followed`, of that what it may choose
        within what is known of it.
    """
    at = poses.at(fit.model, fit.solution.estimate)
    for k, name in enumerate(poses.accelerometers):
        forces = at.products[:, k, [*TERMS].index("K_I")]
        for kind, symbol, column in in_order(poses, forces):
            yield Alternative(kind, name, symbol, {place: at.along[:, k] * column})
        products: dict[str, Array] = {
            symbol: at.along[:, k] * at.products[:, k, index] for index, symbol in enumerate(TERMS)
        }
        for symbol, product in products.items():
            if (name, symbol) not in unknown or (name, symbol) in followed:
                yield Alternative(TERM, name, symbol, {place: product})
        for symbol, row in CONDITION_TERMS.items():
            lever = lever_of(poses, symbol)
            # A slope with time that nobody has stated is the drift.
            if lever is None or np.ptp(lever) == 0.0 or row.effect.condition == "time":
                continue
            if (name, symbol) not in unknown or (name, symbol) in followed:
                changed = products[row.effect.coefficient] * lever
                yield Alternative(TERM, name, symbol, {place: changed})
