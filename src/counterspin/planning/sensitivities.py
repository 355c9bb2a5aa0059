"""Shifts of estimates by effects that a model omits, and the residuals of these effects."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from counterspin.arrays import Array, triangular_factor
from counterspin.frozen import frozen
from counterspin.inference.joint.design_blocks import DesignBlock, build_design_blocks
from counterspin.inference.joint.fit import JointFit, solve_blocks
from counterspin.inference.joint.unknowns import Considered, Observation, Unknowns
from counterspin.inference.least_squares import Block
from counterspin.inference.priors import prior_correlation, whiten_priors
from counterspin.readings.linear import LinearReadings

#: Function that returns the columns of m effects in an observation, shape (n, m).
ColumnFunction = Callable[[Observation], Array]


@frozen(eq=False)
class Sensitivities:
    """Shifts of the estimates by m unmodelled effects, and the residuals of those effects."""

    #: Shifts of the unknowns per unit of each effect, shape (p, m).
    shifts: Array
    #: Inner products of the residuals per unit of each effect, in the whitened rows and priors,
    #: shape (m, m).
    residual_products: Array
    #: By accelerometer: inner products of its own whitened residuals, and degrees of freedom.
    accelerometer_products: Mapping[str, Array]
    dof: Mapping[str, float]


def sensitivities(fit: JointFit, columns: ColumnFunction) -> Sensitivities:
    """Return the effect of each additional column, alone, on a fit."""
    model = fit.model
    # One observation at a time, to save memory.
    blocks = [
        _extend_block(observation, columns(observation), fit) for observation in fit.observations
    ]
    solution = solve_blocks(blocks, _add_considered_terms(model, blocks[0].considered.shape[1]))
    owners = [_residual_owner(observation) for observation in fit.observations]
    residual_products, accelerometer_products = _residual_products(blocks, owners, model)
    row_ends = np.cumsum([block.factor.shape[0] for block in blocks])
    dof: dict[str, float] = {}
    block_leverages = np.split(solution.leverages, row_ends[:-1])
    for owner, block, leverages in zip(owners, blocks, block_leverages, strict=True):
        block_dof = block.rows - block.n_nuisance - float(leverages.sum())
        dof[owner] = dof.get(owner, 0.0) + block_dof
    shifts = -solution.sensitivity_considered[:, len(model.considered) :]
    return Sensitivities(shifts, residual_products, accelerometer_products, dof)


def _add_considered_terms(model: Unknowns, n_considered: int) -> Unknowns:
    """Return a model with `n_considered` considered terms; the added ones have no uncertainty."""
    added_indices = range(len(model.considered), n_considered)
    added_terms = (Considered("", str(index), (0.0, 0.0), 1.0) for index in added_indices)
    return Unknowns(model.unknowns, (*model.considered, *added_terms))


def _extend_block(observation: Observation, columns: Array, fit: JointFit) -> Block:
    """Return the block of an observation with columns (n, m) after the considered ones."""
    start = len(fit.model.considered)
    n_considered = start + columns.shape[1]
    full_observation = replace(
        observation,
        considered_design=np.column_stack([observation.considered_design, columns]),
        considered=(*observation.considered, *range(start, n_considered)),
    )
    return full_observation.expand_block(_add_considered_terms(fit.model, n_considered), fit.noise)


def _residual_owner(observation: Observation) -> str:
    """Return the name of the accelerometer of an observation, or its source."""
    if isinstance(observation, LinearReadings):
        return observation.group.accelerometer
    return observation.source


def make_column_function(
    fit: JointFit, terms: Sequence[Considered], expected: Array
) -> ColumnFunction:
    """Return the function that computes the columns of terms and inputs that a fit omits.

    expected: Values of the fit's unknowns minus nominal, shape (p,), for the effect of inputs.
    """
    model, active_indices = fit.model, np.flatnonzero(expected)
    # An input acts only on unknowns with an expected value.
    active_model = Unknowns(tuple(model.unknowns[i] for i in active_indices), tuple(terms))
    full_model = Unknowns(model.unknowns, (*model.considered, *terms))

    def evaluate_columns(observation: Observation) -> Array:
        if isinstance(observation, LinearReadings):
            return observation.group.linearize(full_model, expected).considered_design[
                :, len(model.considered) :
            ]
        assert isinstance(observation, DesignBlock)
        factors = {observation.accelerometer: observation.scale_factor}
        (block,) = build_design_blocks(
            [observation.series], active_model, factors, expected[active_indices]
        )
        columns = np.zeros((len(observation.design), len(terms)))
        columns[:, list(block.considered)] = block.considered_design
        return columns

    return evaluate_columns


def _residual_products(
    blocks: Sequence[Block], owners: Sequence[str], model: Unknowns
) -> tuple[Array, dict[str, Array]]:
    """Return the inner products of the residuals of the additional columns, in total and by owner.

    Considered terms are estimated here, because the test of the residuals allows for them.
    """
    prior_sds = np.array([*(unknown.prior_sd for unknown in model.unknowns), *model.considered_sds])
    p = prior_sds.size
    prior_sds = np.where(prior_sds > 0.0, prior_sds, 1e-30)
    correlation = prior_correlation((*model.unknowns, *model.considered))
    prior_rows = whiten_priors(np.eye(p), prior_sds, correlation)
    rows = [np.hstack([block.factor, block.considered]) for block in blocks]
    prior = np.hstack([prior_rows, np.zeros((p, rows[0].shape[1] - p))])
    triangle = triangular_factor(np.vstack([*rows, prior]))
    residual_factor = triangle[p:, p:]
    solution = np.linalg.solve(triangle[:p, :p], triangle[:p, p:])
    products_by_accelerometer: dict[str, Array] = {}
    for block, owner in zip(rows, owners, strict=True):
        residual = block[:, p:] - block[:, :p] @ solution
        previous_products = products_by_accelerometer.get(owner, 0.0)
        products_by_accelerometer[owner] = previous_products + residual.T @ residual
    return residual_factor.T @ residual_factor, products_by_accelerometer
