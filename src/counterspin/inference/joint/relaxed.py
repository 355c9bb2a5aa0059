"""A joint fit with more unknowns than its model has.

What a model assumes can only be held to the records where it may give way. Hence a fit in which
what is considered is estimated, its prior being one more observation; and one that has further
columns, such as those of a mistake that somebody may have made.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from counterspin.arrays import Array
from counterspin.inference.blocks import Block
from counterspin.inference.joint.fit import JointFit, relaxed_block, solve_blocks
from counterspin.inference.joint.observation import Observation
from counterspin.inference.joint.unknowns import Unknown, Unknowns
from counterspin.inference.least_squares import NO_PRIOR


def relax(fit: JointFit) -> JointFit:
    """Return the fit with all that is considered as unknowns, each with its prior.

    The unknowns of the model come first, in their order, then the considered ones. Noise that
    the records do not show is left out.
    """
    model = fit.model
    if not model.considered:
        return replace(fit, unseen={})
    p = len(model.unknowns)
    considered = [
        Unknown(other.owner, other.symbol, other.prior, other.limit, other.asked, other.unstated)
        for other in model.considered
    ]
    whole = Unknowns((*model.unknowns, *considered))
    return replace(
        fit,
        model=whole,
        solution=fit.relaxed,
        observations=tuple(one.relaxed(p) for one in fit.observations),
        blocks=tuple(relaxed_block(block) for block in fit.blocks),
        unseen={},
    )


def widened(
    fit: JointFit, columns: Sequence[Mapping[int, Array]]
) -> tuple[tuple[Observation, ...], tuple[Block, ...]]:
    """Return observations and blocks of a relaxed fit with further columns, behind the unknowns'.

    columns: Of each: the place of an observation -> what it shows of one unit, shape (n,); one
        that is not named shows nothing.
    """
    p, m = len(fit.model.unknowns), len(columns)
    added = [Unknown("", str(place), NO_PRIOR, 1.0) for place in range(m)]
    model = replace(fit.model, unknowns=(*fit.model.unknowns, *added))
    observations, blocks = [], []
    for i, (one, block) in enumerate(zip(fit.observations, fit.blocks, strict=True)):
        shown = {p + k: column[i] for k, column in enumerate(columns) if i in column}
        observations.append(one.with_columns(tuple(shown), tuple(shown.values())))
        blocks.append(
            observations[-1].block_in(model, fit.noise)
            if shown
            else replace(block, factor=np.pad(block.factor, ((0, 0), (0, m))))
        )
    return tuple(observations), tuple(blocks)


def extended(
    fit: JointFit, unknowns: Sequence[Unknown], columns: Sequence[Mapping[int, Array]]
) -> JointFit:
    """Return a relaxed fit with further unknowns; columns as of `widened`."""
    observations, blocks = widened(fit, columns)
    model = replace(fit.model, unknowns=(*fit.model.unknowns, *unknowns))
    solution = solve_blocks(blocks, model)
    return replace(fit, model=model, solution=solution, observations=observations, blocks=blocks)
