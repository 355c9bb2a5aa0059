"""Changes of estimates by effects that a model lacks, and the residuals of these effects."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from counterspin.arrays import Array, triangular_factor
from counterspin.frozen import frozen
from counterspin.inference.joint.design_blocks import DesignBlock, build_design_blocks
from counterspin.inference.joint.fit import JointFit, solve_blocks
from counterspin.inference.joint.unknowns import (
    Considered,
    Observation,
    Unknowns,
)
from counterspin.inference.least_squares import Block
from counterspin.inference.priors import prior_correlation, whiten_priors
from counterspin.readings.linear import LinearReadings

#: What an observation shows of one unit of each of m effects, in its own unit, shape (n, m).
Columns = Callable[[Observation], Array]


@frozen(eq=False)
class Sensitivities:
    """Shifts of the estimates by m unmodelled effects, and the residuals of those effects."""

    #: What one unit of each moves the unknowns by, shape (p, m).
    moved: Array
    #: The products of what one unit of each leaves in the whitened rows and priors once the fit has
    #: followed it as far as it can, shape (m, m).
    left: Array
    #: By accelerometer, the same in its own whitened residuals, and their degrees of freedom.
    left_in: Mapping[str, Array]
    freedom: Mapping[str, float]


def sensitivities(fit: JointFit, columns: Columns) -> Sensitivities:
    """Return the effect of each further column, alone, on a fit."""
    model = fit.model
    # One after the other: the columns of all of them together would take much memory.
    blocks = [_block(observation, columns(observation), fit) for observation in fit.observations]
    solution = solve_blocks(blocks, _with_further(model, blocks[0].considered.shape[1]))
    owners = [_owner(observation) for observation in fit.observations]
    products, products_by_name = _residual_products(blocks, owners, model)
    ends = np.cumsum([block.factor.shape[0] for block in blocks])
    freedom: dict[str, float] = {}
    block_leverages = np.split(solution.leverages, ends[:-1])
    for owner, block, leverages in zip(owners, blocks, block_leverages, strict=True):
        block_dof = block.rows - block.nuisance - float(leverages.sum())
        freedom[owner] = freedom.get(owner, 0.0) + block_dof
    shifts = -solution.sensitivity_considered[:, len(model.considered) :]
    return Sensitivities(shifts, products, products_by_name, freedom)


def _with_further(model: Unknowns, count: int) -> Unknowns:
    """Return a model with so many considered columns, the further ones of no uncertainty."""
    further = range(len(model.considered), count)
    added_terms = (Considered("", str(index), (0.0, 0.0), 1.0) for index in further)
    return Unknowns(model.unknowns, (*model.considered, *added_terms))


def _block(observation: Observation, columns: Array, fit: JointFit) -> Block:
    """Return the block of an observation with columns (n, m) after the considered ones."""
    start = len(fit.model.considered)
    count = start + columns.shape[1]
    full_observation = replace(
        observation,
        fixed=np.column_stack([observation.fixed, columns]),
        considered=(*observation.considered, *range(start, count)),
    )
    return full_observation.block_in(_with_further(fit.model, count), fit.noise)


def _owner(observation: Observation) -> str:
    """Return whose residuals an observation has."""
    return (
        observation.group.accelerometer
        if isinstance(observation, LinearReadings)
        else observation.source
    )


def columns_of(fit: JointFit, terms: Sequence[Considered], expected: Array) -> Columns:
    """Return the columns of terms and inputs that are not in a fit.

    expected: Values of the fit's unknowns, less nominal, on which inputs act, shape (p,).
    """
    model, acting = fit.model, np.flatnonzero(expected)
    # An input acts on what is expected: nothing else is needed for its column.
    acting_model = Unknowns(tuple(model.unknowns[i] for i in acting), tuple(terms))
    full_model = Unknowns(model.unknowns, (*model.considered, *terms))

    def columns_at(observation: Observation) -> Array:
        if isinstance(observation, LinearReadings):
            return observation.group.linearize(full_model, expected).fixed[
                :, len(model.considered) :
            ]
        assert isinstance(observation, DesignBlock)
        factors = {observation.accelerometer: observation.scale_factor}
        (block,) = build_design_blocks(
            [observation.series], acting_model, factors, expected[acting]
        )
        columns = np.zeros((len(observation.design), len(terms)))
        columns[:, list(block.considered)] = block.fixed
        return columns

    return columns_at


def _residual_products(
    blocks: Sequence[Block], owners: Sequence[str], model: Unknowns
) -> tuple[Array, dict[str, Array]]:
    """Return the products of what columns behind the considered ones leave in rows and priors.

    What is considered is followed here as what is estimated: the test of the residuals allows
    for it.
    """
    spread = np.array([*(u.prior_sd for u in model.unknowns), *model.considered_sds])
    p = spread.size
    spread = np.where(spread > 0.0, spread, 1e-30)
    correlation = prior_correlation((*model.unknowns, *model.considered))
    prior_rows = whiten_priors(np.eye(p), spread, correlation)
    rows = [np.hstack([block.factor, block.considered]) for block in blocks]
    prior = np.hstack([prior_rows, np.zeros((p, rows[0].shape[1] - p))])
    triangle = triangular_factor(np.vstack([*rows, prior]))
    remainder = triangle[p:, p:]
    solution = np.linalg.solve(triangle[:p, :p], triangle[:p, p:])
    by_accelerometer: dict[str, Array] = {}
    for block, owner in zip(rows, owners, strict=True):
        residual = block[:, p:] - block[:, :p] @ solution
        previous_sum = by_accelerometer.get(owner, 0.0)
        by_accelerometer[owner] = previous_sum + residual.T @ residual
    return remainder.T @ remainder, by_accelerometer
