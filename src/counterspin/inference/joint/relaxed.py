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
from counterspin.inference.blocks import Block, reduce_block
from counterspin.inference.joint.fit import JointFit, blocks_of, relaxed_block, solve_blocks
from counterspin.inference.joint.prepared import Prepared
from counterspin.inference.joint.unknowns import Unknown, Unknowns
from counterspin.inference.least_squares import NO_PRIOR
from counterspin.inference.noise.model import Noise


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
    prepared = tuple(
        replace(
            part,
            unknowns=(*part.unknowns, *(p + place for place in part.considered)),
            design=np.hstack([part.design, part.fixed]),
            considered=(),
            fixed=part.fixed[:, :0],
        )
        for part in fit.prepared
    )
    return replace(
        fit,
        model=whole,
        solution=fit.relaxed,
        prepared=prepared,
        blocks=tuple(relaxed_block(block) for block in fit.blocks),
        beside={name: relaxed_block(block) for name, block in fit.beside.items()},
        unseen={},
    )


def widened(
    fit: JointFit,
    columns: Sequence[Mapping[int, Array]],
    noise: Mapping[str, Noise],
    readings: Sequence[Mapping[str, Array]] = (),
) -> tuple[tuple[Prepared, ...], tuple[Block, ...], dict[str, Block]]:
    """Return records and blocks of a relaxed fit, readings' last, with further columns.

    Arguments as of `extended`; the columns stand after those of the unknowns. `readings` has of
    each what it shows of a block beside the records: its name -> shape (n,), in `fit.beside_rows`.
    """
    p, m = len(fit.model.unknowns), len(columns)
    added = [Unknown("", str(place), NO_PRIOR, 1.0) for place in range(m)]
    model = replace(fit.model, unknowns=(*fit.model.unknowns, *added))
    prepared = tuple(
        _extended(part, [(p + k, shown[i]) for k, shown in enumerate(columns) if i in shown])
        for i, part in enumerate(fit.prepared)
    )
    blocks = tuple(blocks_of(prepared, model, noise))
    beside = {
        name: _beside(block, fit.beside_rows.get(name), [shown.get(name) for shown in readings], m)
        for name, block in fit.beside.items()
    }
    return prepared, blocks, beside


def _beside(block: Block, rows: Array | None, columns: Sequence[Array | None], m: int) -> Block:
    """Return a block beside the records with m further columns, zero where it shows nothing."""
    if rows is None or not any(column is not None for column in columns):
        return replace(block, factor=np.pad(block.factor, ((0, 0), (0, m))))
    added = [np.zeros(rows.shape[0]) if column is None else column for column in columns]
    return reduce_block(np.column_stack([rows[:, :-1], *added]), rows[:, -1])


def extended(
    fit: JointFit, unknowns: Sequence[Unknown], columns: Sequence[Mapping[int, Array]]
) -> JointFit:
    """Return a relaxed fit with further unknowns, which readings beside the records do not see.

    unknowns: What is added, m of them.
    columns: Of each: the place of a series -> what it shows per unit of it, shape (n,); a series
        that is not named shows nothing.
    """
    prepared, blocks, beside = widened(fit, columns, fit.noise)
    model = replace(fit.model, unknowns=(*fit.model.unknowns, *unknowns))
    solution = solve_blocks([*blocks, *beside.values()], model)
    return replace(
        fit,
        model=model,
        solution=solution,
        prepared=prepared,
        blocks=blocks,
        beside=beside,
        beside_rows={
            name: np.hstack([rows[:, :-1], np.zeros((len(rows), len(columns))), rows[:, -1:]])
            for name, rows in fit.beside_rows.items()
        },
    )


def _extended(part: Prepared, added: Sequence[tuple[int, Array]]) -> Prepared:
    if not added:
        return part
    return replace(
        part,
        unknowns=(*part.unknowns, *(place for place, _ in added)),
        design=np.column_stack([part.design, *(column for _, column in added)]),
    )
