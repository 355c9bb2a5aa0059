"""What faults that a campaign's model does not know would shift, and leave in the residuals."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.arrays import Array, triangle_of
from counterspin.campaign.triads.grouped import all_groups
from counterspin.frozen import frozen
from counterspin.inference.blocks import Block
from counterspin.inference.joint.fit import solve_blocks
from counterspin.inference.joint.prepared import Prepared, prepare_columns
from counterspin.inference.joint.unknowns import Considered, Unknowns
from counterspin.inference.linear_readings import blocks_at
from counterspin.planning.faults import Fault
from counterspin.planning.forecast import Forecast, expected_values, scale_factors
from counterspin.planning.possibilities import Places

#: Columns of faults that are there at once; of one that each run has anew there is one a run.
_PARTS_AT_ONCE: Final = 16


@frozen(eq=False)
class Sensitivity:
    """What a fault would shift, and what it would leave in the residuals."""

    fault: Fault  #: The fault.
    #: What one unit of each of its parts moves the unknowns by, (p, k).
    moved: Array
    #: The products of what one unit of its parts leaves in the whitened rows and priors once the
    #: fit has followed it as far as it can, (k, k).
    left: Array
    #: By accelerometer, the same in its own whitened residuals, and their degrees of freedom.
    left_in: dict[str, Array]
    freedom: dict[str, float]

    def of_unit(self, place: int) -> float:
        """Return what one unit of the fault moves an unknown by, without sign."""
        return float(np.linalg.norm(self.moved[place]))

    def shift(self, place: int) -> float:
        """Return by how much the fault of its size moves an unknown, without sign."""
        return self.fault.size * self.of_unit(place)

    def deviation(self, place: int) -> float:
        """Return how many standard deviations the best test for this very fault would see."""
        return math.sqrt(self.square(self.left, place))

    def detection(self, place: int, accelerometer: str, significance: float) -> float:
        """Return the probability that the residuals of an accelerometer fail their test."""
        from scipy.special import chdtri, chndtr

        dof = max(1.0, self.freedom[accelerometer])
        square = self.square(self.left_in[accelerometer], place)
        return 1.0 - float(chndtr(chdtri(dof, significance), dof, square))

    def square(self, left: Array, place: int) -> float:
        """Return the sum of squares that the fault of its size leaves, as of `left`.

        Of parts that are one amplitude, in the phase that moves an unknown most.
        """
        size = self.fault.size
        if self.fault.random:
            return size**2 * float(np.trace(left))
        moved = self.moved[place]
        length = float(np.linalg.norm(moved))
        phase = moved / length if length > 0.0 else np.eye(moved.size)[0]
        return max(0.0, size**2 * float(phase @ left @ phase))


def sensitivities(
    prediction: Forecast, faults: Sequence[Fault], expected: Array | None = None
) -> list[Sensitivity]:
    """Return what faults would do to a campaign's fit, each by itself.

    expected: Values of the model's unknowns, less nominal, on which inputs act; None: what
        `expected_values` says.
    """
    if expected is None:
        expected = expected_values(prediction.campaign, prediction.fit.model.unknowns)
    groups: list[list[Fault]] = [[]]
    for fault in faults:
        if groups[-1] and sum(len(f.parts) for f in (*groups[-1], fault)) > _PARTS_AT_ONCE:
            groups.append([])
        groups[-1].append(fault)
    return [one for group in groups for one in _together(prediction, group, expected)]


def _together(prediction: Forecast, faults: Sequence[Fault], expected: Array) -> list[Sensitivity]:
    model, campaign = prediction.fit.model, prediction.campaign
    parts = [(fault, part) for fault in faults for part in fault.parts]
    here = len(model.considered) + np.arange(len(parts))
    extended = Unknowns(model.unknowns, (*model.considered, *(part for _, part in parts)))
    # An input acts on what is expected: nothing else is needed for its column.
    acting = np.flatnonzero(expected)
    on = Unknowns(tuple(model.unknowns[i] for i in acting), model.considered)
    factors = scale_factors(campaign)
    blocks = []
    for record in prediction.fit.prepared:
        # One after the other: the columns of all of them together would take much memory.
        whole = _with_faults(record, parts, on, expected[acting], factors)
        blocks.append(whole.block_in(extended, prediction.fit.noise))
    groups = all_groups(campaign)
    blocks += blocks_at(groups, extended, expected)
    solution = solve_blocks(blocks, extended)
    owners = [record.accelerometer for record in prediction.fit.prepared]
    owners += [group.accelerometer for group in groups]
    moved = -solution.sensitivity_considered[:, here]
    total, left_in = _left(blocks, owners, extended, here)
    ends = np.cumsum([block.factor.shape[0] for block in blocks])
    freedom: dict[str, float] = {}
    followed = np.split(solution.leverages, ends[:-1])
    for owner, block, leverages in zip(owners, blocks, followed, strict=True):
        own = block.rows - block.nuisance - float(leverages.sum())
        freedom[owner] = freedom.get(owner, 0.0) + own
    found = []
    for fault in faults:
        places = np.flatnonzero([owner is fault for owner, _ in parts])
        square = np.ix_(places, places)
        by_accelerometer = {name: own[square] for name, own in left_in.items()}
        found.append(Sensitivity(fault, moved[:, places], total[square], by_accelerometer, freedom))
    return found


def _with_faults(
    record: Prepared,
    faults: Sequence[tuple[Fault, Considered]],
    on: Unknowns,
    expected: Array,
    factors: Mapping[str, float],
) -> Prepared:
    """Return a record with the columns of faults' parts after those of what is considered.

    on, expected: What inputs act on, and how large it is, shape (p,).
    """
    shown = [(i, fault.shown(record.series)) for i, (fault, _) in enumerate(faults) if fault.shown]
    seen = [(i, column) for i, column in shown if column is not None]
    model = Unknowns(on.unknowns, tuple(part for _, part in faults))
    (made,) = prepare_columns([record.series], model, factors, expected)
    places = (*made.considered, *(i for i, _ in seen))
    return replace(
        record,
        fixed=np.column_stack([record.fixed, made.fixed, *(column for _, column in seen)]),
        considered=(*record.considered, *(len(on.considered) + i for i in places)),
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
