"""What faults that a campaign's model does not know would shift, and leave in the residuals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.arrays import Array, triangle_of
from counterspin.campaign.triads.grouped import all_groups
from counterspin.frozen import frozen
from counterspin.inference.blocks import Block
from counterspin.inference.joint.fit import solve_blocks
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.linear_readings import blocks_at
from counterspin.planning.faults import Fault
from counterspin.planning.forecast import Forecast, expected_values
from counterspin.planning.possibilities import Places

#: Columns of faults that are there at once; of one that each run has anew there is one a run.
_PARTS_AT_ONCE: Final = 16


@frozen(eq=False)
class Sensitivities:
    """What faults would shift, each by itself, and what they would leave in the residuals."""

    faults: tuple[Fault, ...]  #: The faults.
    #: For each fault, what one unit of each of its parts moves the unknowns by, (p, k).
    moved: tuple[Array, ...]
    #: For each fault, the products of what one unit of its parts leaves in the whitened rows and
    #: priors once the fit has followed it as far as it can, (k, k).
    left: tuple[Array, ...]
    #: By accelerometer, the same in its own whitened residuals.
    left_in: dict[str, tuple[Array, ...]]
    freedom: dict[str, float]  #: By accelerometer, the degrees of freedom of these.

    def shift(self, fault: int, place: int) -> float:
        """Return by how much a fault of its size moves an unknown, without sign."""
        return self.faults[fault].size * self.sensitivity(fault, place)

    def sensitivity(self, fault: int, place: int) -> float:
        """Return what one unit of a fault moves an unknown by, without sign."""
        return float(np.linalg.norm(self.moved[fault][place]))

    def deviation(self, fault: int, place: int) -> float:
        """Return how many standard deviations the best test for this very fault would see."""
        return math.sqrt(self._square(self.left, fault, place))

    def detection(self, fault: int, place: int, accelerometer: str, significance: float) -> float:
        """Return the probability that the residuals of an accelerometer fail their test."""
        from scipy.special import chdtri, chndtr

        dof = max(1.0, self.freedom[accelerometer])
        square = self._square(self.left_in[accelerometer], fault, place)
        return 1.0 - float(chndtr(chdtri(dof, significance), dof, square))

    def _square(self, left: Sequence[Array], fault: int, place: int) -> float:
        products, size = left[fault], self.faults[fault].size
        if self.faults[fault].random:
            return size**2 * float(np.trace(products))
        moved = self.moved[fault][place]
        length = float(np.linalg.norm(moved))
        phase = moved / length if length > 0.0 else np.eye(moved.size)[0]
        return max(0.0, size**2 * float(phase @ products @ phase))


def sensitivities(prediction: Forecast, faults: Sequence[Fault]) -> Sensitivities:
    """Return what faults would do to a campaign's fit, each by itself."""
    groups: list[list[Fault]] = [[]]
    for fault in faults:
        if groups[-1] and sum(len(f.parts) for f in (*groups[-1], fault)) > _PARTS_AT_ONCE:
            groups.append([])
        groups[-1].append(fault)
    found = [_together(prediction, group) for group in groups]
    return Sensitivities(
        tuple(faults),
        tuple(moved for one in found for moved in one.moved),
        tuple(left for one in found for left in one.left),
        {
            name: tuple(left for one in found for left in one.left_in[name])
            for name in found[0].left_in
        },
        found[0].freedom,
    )


def _together(prediction: Forecast, faults: Sequence[Fault]) -> Sensitivities:
    model, campaign = prediction.fit.model, prediction.campaign
    parts = [(index, part) for index, fault in enumerate(faults) for part in fault.parts]
    before, count = len(model.considered), len(parts)
    names = [part.term for _, part in parts]
    extended = Unknowns(model.unknowns, (*model.considered, *names))
    blocks = []
    for record in prediction.fit.prepared:
        shown = [(before + i, part.columns(record.series)) for i, (_, part) in enumerate(parts)]
        seen = [(place, column) for place, column in shown if column is not None]
        prepared = replace(
            record,
            fixed=np.column_stack([record.fixed, *(column for _, column in seen)]),
            considered=(*record.considered, *(place for place, _ in seen)),
        )
        # One after the other: the columns of all of them together would take much memory.
        blocks.append(prepared.block_in(extended, prediction.fit.noise))
    groups = all_groups(campaign)
    expected = expected_values(campaign, model.unknowns)
    blocks += blocks_at(groups, extended, expected)
    solution = solve_blocks(blocks, extended)
    owners = [record.accelerometer for record in prediction.fit.prepared]
    owners += [group.accelerometer for group in groups]
    here = np.arange(before, before + count)
    of_fault = [
        np.flatnonzero([index == fault for index, _ in parts]) for fault in range(len(faults))
    ]
    moved = -solution.sensitivity_considered[:, here]
    total, left_in = _left(blocks, owners, extended, here)
    kept = solution.leverages
    ends = np.cumsum([block.factor.shape[0] for block in blocks])
    freedom: dict[str, float] = {}
    for owner, block, followed in zip(owners, blocks, np.split(kept, ends[:-1]), strict=True):
        own = block.rows - block.nuisance - float(followed.sum())
        freedom[owner] = freedom.get(owner, 0.0) + own
    return Sensitivities(
        tuple(faults),
        tuple(moved[:, places] for places in of_fault),
        tuple(total[np.ix_(places, places)] for places in of_fault),
        {
            name: tuple(own[np.ix_(places, places)] for places in of_fault)
            for name, own in left_in.items()
        },
        freedom,
    )


def _left(
    blocks: Sequence[Block], owners: Sequence[str], model: Unknowns, faulty: Places
) -> tuple[Array, dict[str, Array]]:
    """Return the products of what the faults' columns leave in rows and priors.

    What is considered is followed here as what is estimated: the test of the residuals allows
    for it.
    """
    others = np.setdiff1d(np.arange(len(model.considered_names)), faulty)
    sizes = np.array(model.considered_sizes)[others]
    spread = np.array([*(u.spread for u in model.unknowns), *sizes])
    p = spread.size
    held = np.diag(1.0 / np.where(spread > 0.0, spread, 1e-30))
    rows = [
        np.hstack([block.factor, block.considered[:, others], block.considered[:, faulty]])
        for block in blocks
    ]
    prior = np.hstack([held, np.zeros((p, faulty.size))])
    triangle = triangle_of(np.vstack([*rows, prior]))
    rest = triangle[p:, p:]
    followed = np.linalg.solve(triangle[:p, :p], triangle[:p, p:])
    by_accelerometer: dict[str, Array] = {}
    for block, owner in zip(rows, owners, strict=True):
        residual = block[:, p:] - block[:, :p] @ followed
        before = by_accelerometer.get(owner, 0.0)
        by_accelerometer[owner] = before + residual.T @ residual
    return rest.T @ rest, by_accelerometer
