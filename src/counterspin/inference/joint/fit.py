"""Joint fit of all observations.

Each observation, such as the record of an accelerometer in a run, is whitened and reduced to a
block of square-root information on the shared unknowns. All blocks are solved together with the
priors and the considered terms. Variants of the fit (other noise, an omitted run, an additional
unknown) start from the columns or the blocks, not from the records.

To test an assumption against the data, it must be estimated. A variant therefore estimates the
considered terms, with their priors as observations, and another has additional columns, such as
those of a possible mistake.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from functools import cached_property
from itertools import compress

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference import least_squares
from counterspin.inference.identifiability import Assessment, assess
from counterspin.inference.joint.design_blocks import DesignBlock
from counterspin.inference.joint.unknowns import Observation, Unknown, Unknowns
from counterspin.inference.least_squares import NO_PRIOR, Block, Solution
from counterspin.inference.noise.model import Noise
from counterspin.inference.priors import prior_correlation


@frozen
class Residuals:
    """Residuals of one series."""

    unweighted: Array  #: In the unit of the series, shape (n,).
    #: With unit variance, shape (m,), m <= n; differences belong to the later rows.
    whitened: Array


@frozen
class JointFit:
    """A solved joint problem."""

    model: Unknowns  #: Unknowns and considered terms.
    solution: Solution  #: Estimates minus nominal values, covariances by source, sensitivities.
    #: Observations, records first, and the square-root information of each.
    observations: tuple[Observation, ...]
    blocks: tuple[Block, ...]
    noise: Mapping[str, Noise]  #: Accelerometer, or group of readings -> its noise.
    #: Accelerometer -> undetected random walk, N in (m/s^2)/Hz^0.5, and its contribution to the
    #: covariance, shape (p, p).
    undetected_walks: Mapping[str, tuple[float, Array]] = field(default_factory=dict)

    @cached_property
    def design_blocks(self) -> tuple[DesignBlock, ...]:
        """Records among the observations; they come first."""
        return tuple(
            observation for observation in self.observations if isinstance(observation, DesignBlock)
        )

    def with_noise(self, noise: Mapping[str, Noise]) -> JointFit:
        """Return the fit with other noise; blocks with unchanged noise are reused."""
        noises = {**self.noise, **noise}
        blocks = tuple(
            observation.expand_block(self.model, noises) if observation.source in noise else block
            for block, observation in zip(self.blocks, self.observations, strict=True)
        )
        solution = solve_blocks(blocks, self.model)
        return replace(self, solution=solution, blocks=blocks, noise=noises, undetected_walks={})

    def subset(self, is_kept: Sequence[bool]) -> JointFit:
        """Return the fit of the observations that a mask selects."""
        blocks = tuple(compress(self.blocks, is_kept))
        return replace(
            self,
            observations=tuple(compress(self.observations, is_kept)),
            blocks=blocks,
            solution=solve_blocks(blocks, self.model),
            undetected_walks={},
        )

    def without_run(self, run: str) -> Solution | None:
        """Return the solution without a run; None if no observation remains."""
        if run not in self._leave_one_out_cache:
            pairs = zip(self.blocks, self.observations, strict=True)
            is_kept = [block for block, observation in pairs if observation.run != run]
            self._leave_one_out_cache[run] = solve_blocks(is_kept, self.model) if is_kept else None
        return self._leave_one_out_cache[run]

    @cached_property
    def _leave_one_out_cache(self) -> dict[str, Solution | None]:
        """Solutions by omitted run; all accelerometers use the same ones."""
        return {}

    @cached_property
    def solution_with_considered(self) -> Solution:
        """Solution that also estimates the considered terms, with their priors.

        The considered terms follow the unknowns of the model. Residuals are computed with this
        solution, so that an error of a considered term within its uncertainty is no lack of fit.
        """
        if not self.model.considered:
            return self.solution
        return solve_with_considered(self.blocks, self.model)

    @cached_property
    def assessment(self) -> Assessment:
        """Identifiability of the parameters of interest."""
        of_interest = self.model.of_interest
        assessment = assess(
            self.solution,
            [unknown.name for unknown in of_interest],
            nominal=[unknown.nominal for unknown in of_interest],
        )
        not_determined = {
            unknown.name: False for unknown in of_interest if unknown.uses_fallback_prior
        }
        return replace(assessment, determined=assessment.determined | not_determined)

    @cached_property
    def residuals(self) -> tuple[Residuals, ...]:
        """Residuals of each series, with considered terms at their estimates."""
        return tuple(self._block_residuals(block) for block in self.design_blocks)

    def _block_residuals(self, block: DesignBlock) -> Residuals:
        series, p = block.series, len(self.model.unknowns)
        estimate = self.solution_with_considered.estimate
        residuals = series.error - block.design @ estimate[list(block.unknowns)]
        considered = estimate[[p + index for index in block.considered]]
        residuals = residuals - block.considered_design @ considered
        whitener = series.whitener(self.noise[series.accelerometer])
        if whitener.polynomials == 0:
            # The whitened differences contain no start errors; the unweighted residuals do.
            polynomials = series.polynomials(series.order)
            start_errors = np.linalg.lstsq(polynomials, residuals, rcond=None)[0]
            return Residuals(residuals - polynomials @ start_errors, whitener.apply(residuals))
        polynomials = series.polynomials(whitener.polynomials)
        whitened = whitener.apply(np.column_stack([polynomials, residuals]))
        start_errors = np.linalg.lstsq(whitened[:, :-1], whitened[:, -1], rcond=None)[0]
        unweighted = residuals - polynomials @ start_errors
        return Residuals(unweighted, whitened[:, -1] - whitened[:, :-1] @ start_errors)

    @cached_property
    def degrees_of_freedom(self) -> tuple[float, ...]:
        """Degrees of freedom of each observation's residuals.

        Rows minus nuisance parameters minus the leverages of the fit.
        """
        row_ends = np.cumsum([block.factor.shape[0] for block in self.blocks])
        leverages = self.solution_with_considered.leverages[: row_ends[-1]]
        fitted_dof = np.add.reduceat(leverages, np.append(0, row_ends[:-1]))
        return tuple(
            block.rows - block.n_nuisance - float(dof)
            for block, dof in zip(self.blocks, fitted_dof, strict=True)
        )


def solve_joint(
    observations: Sequence[Observation], model: Unknowns, noise: Mapping[str, Noise]
) -> JointFit:
    """Solve a joint problem for given noise."""
    blocks = tuple(observation.expand_block(model, noise) for observation in observations)
    return JointFit(model, solve_blocks(blocks, model), tuple(observations), blocks, noise)


def solve_blocks(blocks: Sequence[Block], model: Unknowns) -> Solution:
    """Solve blocks with the priors and considered terms of a model."""
    return least_squares.solve(
        blocks,
        prior_mean=[unknown.prior_mean for unknown in model.unknowns],
        prior_sd=[unknown.prior[1] for unknown in model.unknowns],
        prior_correlation=prior_correlation(model.unknowns),
        considered_mean=model.considered_means,
        considered_sd=model.considered_sds,
        limits=[unknown.limit for unknown in model.unknowns],
    )


def estimate_considered_in_block(block: Block) -> Block:
    """Return a block with its considered terms as unknowns after the others."""
    return replace(
        block,
        factor=np.hstack([block.factor, block.considered]),
        considered=block.considered[:, :0],
    )


def solve_with_considered(blocks: Sequence[Block], model: Unknowns) -> Solution:
    """Solve blocks and estimate the considered terms; see `JointFit.solution_with_considered`."""
    unknowns = (*model.unknowns, *model.considered)
    return least_squares.solve(
        [estimate_considered_in_block(block) for block in blocks],
        prior_mean=[unknown.prior_mean for unknown in unknowns],
        prior_sd=[unknown.prior[1] for unknown in unknowns],
        prior_correlation=prior_correlation(unknowns),
        limits=[unknown.limit for unknown in unknowns],
    )


# More unknowns ---------------------------------------------------------------------------------


def estimate_considered(fit: JointFit) -> JointFit:
    """Return the fit with all considered terms as unknowns, each with its prior.

    The considered terms follow the unknowns of the model. Undetected noise is omitted.
    """
    model = fit.model
    if not model.considered:
        return replace(fit, undetected_walks={})
    p = len(model.unknowns)
    considered = [
        Unknown(
            term.owner,
            term.symbol,
            term.prior,
            term.limit,
            term.is_of_interest,
            term.has_default_prior,
        )
        for term in model.considered
    ]
    all_unknowns = Unknowns((*model.unknowns, *considered))
    return replace(
        fit,
        model=all_unknowns,
        solution=fit.solution_with_considered,
        observations=tuple(
            observation.with_considered_estimated(p) for observation in fit.observations
        ),
        blocks=tuple(estimate_considered_in_block(block) for block in fit.blocks),
        undetected_walks={},
    )


def augment_block(
    fit: JointFit, index: int, columns: Sequence[Mapping[int, Array]]
) -> tuple[Observation, Block]:
    """Append columns to an observation of a fit whose considered terms are estimated.

    columns: For each new unknown: index of an observation -> column, shape (n,); an observation
        without an entry does not depend on the unknown.
    """
    p, n_columns = len(fit.model.unknowns), len(columns)
    new_columns = {p + k: column[index] for k, column in enumerate(columns) if index in column}
    observation = fit.observations[index].with_columns([*new_columns], [*new_columns.values()])
    if not new_columns:
        block = fit.blocks[index]
        return observation, replace(block, factor=np.pad(block.factor, ((0, 0), (0, n_columns))))
    new_unknowns = (Unknown("", str(index), NO_PRIOR, 1.0) for index in range(n_columns))
    model = replace(fit.model, unknowns=(*fit.model.unknowns, *new_unknowns))
    return observation, observation.expand_block(model, fit.noise)


def augment(
    fit: JointFit, unknowns: Sequence[Unknown], columns: Sequence[Mapping[int, Array]]
) -> JointFit:
    """Add unknowns to a fit whose considered terms are estimated; columns as in `augment_block`."""
    augmented_blocks = (augment_block(fit, i, columns) for i in range(len(fit.blocks)))
    observations, blocks = zip(*augmented_blocks, strict=True)
    model = replace(fit.model, unknowns=(*fit.model.unknowns, *unknowns))
    solution = solve_blocks(blocks, model)
    return replace(fit, model=model, solution=solution, observations=observations, blocks=blocks)
