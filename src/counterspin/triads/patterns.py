"""Columns that the residuals of poses may follow."""

from __future__ import annotations

from collections.abc import Collection, Iterator

import numpy as np

from counterspin.arrays import Array
from counterspin.inference.joint.alternatives import Alternative
from counterspin.inference.joint.fit import JointFit
from counterspin.physics.terms import ACCELEROMETER_TERMS, TERMS, coefficient_of, condition_of
from counterspin.readings.patterns import TERM, time_patterns
from counterspin.triads.poses import TriadPoses, design_factor

#: Owner and symbol of an unknown.
_Key = tuple[str, str]


def pose_candidates(
    poses: TriadPoses,
    group_index: int,
    fit: JointFit,
    estimated_keys: Collection[_Key],
    tested_keys: Collection[_Key],
) -> Iterator[Alternative]:
    """Yield the columns that the residuals of poses may follow.

    group_index: Index of the poses among the observations of the fit.
    estimated_keys: Owner and symbol of the unknowns that are estimated.
    tested_keys: Owner and symbol of the unknowns with a prior; their columns test the prior.
    """
    point = poses.at(fit.model, fit.solution.estimate)
    for axis_index, name in enumerate(poses.accelerometers):
        projection = point.projection[:, axis_index]
        forces = point.products[:, axis_index, [*TERMS].index("K_I")]
        for kind, symbol, column in time_patterns(poses, forces):
            yield Alternative(kind, name, symbol, {group_index: projection * column})
        products: dict[str, Array] = {
            symbol: projection * point.products[:, axis_index, index]
            for index, symbol in enumerate(TERMS)
        }
        for symbol in ACCELEROMETER_TERMS:
            if (name, symbol) in estimated_keys and (name, symbol) not in tested_keys:
                continue
            condition, factor = condition_of(symbol), design_factor(poses, symbol)
            # A slope with time without a stated value is the drift.
            if condition != "time" and (not condition or np.ptp(factor) > 0.0):
                column = products[coefficient_of(symbol)] * factor
                yield Alternative(TERM, name, symbol, {group_index: column})
