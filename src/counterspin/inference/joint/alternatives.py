"""Parameters that would explain the records better than the model, one at a time.

Each alternative is one parameter that the fit holds at nothing: a prior that may be wrong, an input
that may be another, a scale, a jump. Its column is held against the whitened residuals of the fit
(score or Lagrange-multiplier test: Rao, Proc. Cambridge Phil. Soc. 44 (1948) 50). What the unknowns
can follow of the column is projected out; the rest, c, and the residuals e give the parameter's
estimate c'e/c'c, its standard deviation 1/|c| and the gain (c'e)^2/c'c in chi-square, exactly what
a fit with the parameter would give.

For a prior the column is its own row, so that its parameter is the distance of the prior from what
everything else says, and the test is that of the prior's misfit (Baarda's w-test).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import field, replace
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.diagnostics import MIN_RESIDUAL_FRACTION
from counterspin.inference.distributions import student_cdf
from counterspin.inference.joint import encoder
from counterspin.inference.joint.fit import JointFit, augment_block, solve_blocks
from counterspin.inference.joint.unknowns import Unknown
from counterspin.inference.least_squares import Block, Solution
from counterspin.physics.terms import INPUTS, mounting_name

#: Of the centrifuge, and behind a point each mounting's.
RADIUS: Final = "centrifuge.radius"


@frozen
class Alternative:
    """Alternative hypothesis: one parameter that a fit fixes at zero."""

    kind: str  #: What kind of thing it is, for words.
    owner: str  #: An accelerometer, a run, or empty: the campaign.
    symbol: str  #: What is otherwise: a term, an input, or a word of its own.
    #: Place of an observation -> what it shows of one unit, in its own unit, shape (n,).
    columns: Mapping[int, Array] = field(default_factory=dict, repr=False, compare=False)
    #: Place of an unknown -> by how much one unit moves its prior.
    prior_shifts: Mapping[int, float] = field(default_factory=dict, compare=False)
    time: float | None = None  #: Where in a run, s; None where it has no place.
    #: Between which sizes the parameter is credible.
    credible_range: tuple[float, float] = (-math.inf, math.inf)
    #: Between which, within these, it is not; empty unless the second is the larger one.
    excluded_range: tuple[float, float] = (0.0, 0.0)
    #: Sizes about which alone it is likely, and how far from one; empty: any size.
    likely_values: tuple[float, ...] = ()
    likely_tolerance: float = math.inf
    #: Its typical size; None of a mistake, which is of any size.
    default_sd: float | None = None
    stated: bool = False  #: Whether a value of it was written down, perhaps by mistake.

    def is_credible(self, value: float) -> bool:
        """Return whether the parameter may be as large as that."""
        (lowest, highest), (excluded_low, excluded_high) = self.credible_range, self.excluded_range
        return lowest <= value <= highest and not excluded_low < value < excluded_high

    def is_implausible(self, value: float) -> bool:
        """Return whether the parameter is credible, but far from every likely size."""
        distance = min((abs(value - likely) for likely in self.likely_values), default=0.0)
        return distance > self.likely_tolerance

    @property
    def name(self) -> str:
        """Owner and symbol in one word."""
        return f"{self.owner}.{self.symbol}" if self.owner else self.symbol


@frozen
class ScoreTests:
    """Score tests of m alternatives."""

    alternatives: tuple[Alternative, ...]  #: The alternatives.
    #: Estimate of each parameter and its standard uncertainty, shape (m,); u is infinite where the
    #: unknowns can follow all of it.
    value: Array
    u: Array
    #: Distance from nothing in standard deviations, the residuals' own scale being allowed for
    #: (shape (m,)); 0 where it cannot be told.
    z: Array
    dof: float  #: Degrees of freedom of that scale.

    def p(self, index: int) -> float:
        """Probability of as large a size or a larger one by chance, for one test alone."""
        return 2.0 * student_cdf(max(self.dof, 1.0), -float(self.z[index]))

    @property
    def test_count(self) -> int:
        """Number of alternatives that the records can distinguish."""
        return int(np.count_nonzero(np.isfinite(self.u)))


def prior_alternatives(fit: JointFit) -> tuple[Alternative, ...]:
    """Return the alternatives that a relaxed fit has in itself: one prior is wrong, or several.

    One for each unknown of which something is stated; one for each term that several runs have
    anew, one for all its components, and one for the radius of several mountings: they are off
    alike if one mistake made them so.
    """
    indexed_unknowns = [
        (index, unknown)
        for index, unknown in _unknowns_with_prior(fit)
        if not unknown.has_default_prior
    ]
    single = (
        Alternative(
            "prior", *_owner_and_symbol(u), prior_shifts={k: 1.0}, credible_range=_credible_range(u)
        )
        for k, u in indexed_unknowns
    )
    return (*single, *_shared_alternatives(fit, indexed_unknowns))


def default_prior_alternatives(fit: JointFit) -> tuple[Alternative, ...]:
    """Return likewise the alternatives that something unstated is far from its typical size."""
    indexed_unknowns = [
        (index, unknown)
        for index, unknown in _unknowns_with_prior(fit)
        if unknown.has_default_prior
    ]
    return tuple(
        Alternative(
            "input" if u.symbol in INPUTS else "term",
            *_owner_and_symbol(u),
            prior_shifts={k: 1.0},
            credible_range=_credible_range(u),
            default_sd=u.prior[1],
        )
        for k, u in indexed_unknowns
    )


def _unknowns_with_prior(fit: JointFit) -> list[tuple[int, Unknown]]:
    """Return places and unknowns of which something is known beforehand, but for encoders'."""
    return [
        (index, unknown)
        for index, unknown in enumerate(fit.model.unknowns)
        if math.isfinite(unknown.prior[1]) and unknown.symbol not in encoder.SYMBOLS
    ]


def _owner_and_symbol(unknown: Unknown) -> tuple[str, str]:
    return unknown.owner, unknown.symbol


def _credible_range(unknown: Unknown) -> tuple[float, float]:
    """Return how far from its prior an unknown may credibly be, below and above."""
    mean, limit = unknown.prior_mean, unknown.limit
    limit += abs(mean) if abs(mean) > limit else 0.0  # what is stated counts as credible
    return -limit - mean, limit - mean


def _shared_alternatives(
    fit: JointFit, indexed_unknowns: Sequence[tuple[int, Unknown]]
) -> Iterator[Alternative]:
    """Yield one alternative for each term, and each family of terms, that several runs have.

    And one for the radius that several mountings have by one statement.
    """
    runs = {block.run for block in fit.design_blocks}
    groups: dict[str, dict[int, float]] = {}
    for index, unknown in indexed_unknowns:
        if unknown.owner in runs:
            family, _, _ = unknown.symbol.rpartition(".")
            for name in (unknown.symbol, family) if family else (unknown.symbol,):
                groups.setdefault(name, {})[index] = 1.0
        elif unknown.symbol == f"{RADIUS}.{mounting_name(unknown.symbol)}":
            groups.setdefault(RADIUS, {})[index] = 1.0
    groups_done: list[Mapping[int, float]] = []
    for symbol, indices in groups.items():
        if len(indices) > 1 and indices not in groups_done:
            groups_done.append(indices)
            limit = min(fit.model.unknowns[index].limit for index in indices)
            kind = "prior" if symbol == RADIUS else "priors"  # one statement, or one a run
            yield Alternative(
                kind, "", symbol, prior_shifts=indices, credible_range=(-limit, limit)
            )


def run_score_tests(
    fit: JointFit, alternatives: Sequence[Alternative], *, noise_given: bool
) -> ScoreTests:
    """Run a score test of each alternative against a fit.

    The residuals' own scale is that which they would have with the alternative (an F test). It
    counts where it is larger than the noise, and where the noise was estimated from them.

    noise_given: Whether the noise was given.
    """
    # Rows that hold the columns of a single observation are few: those of a group at a time.
    groups: dict[frozenset[int], list[int]] = {}
    for index, alternative in enumerate(alternatives):
        groups.setdefault(frozenset(alternative.columns), []).append(index)
    value, u, z = np.zeros((3, len(alternatives)))
    dof = max(fit.solution.dof - 1.0, 1.0)
    for group in groups.values():
        projected_columns = project_columns(fit, [alternatives[index] for index in group])
        columns, residual = projected_columns.columns, projected_columns.residual
        norms = np.sum(columns**2, axis=0)
        is_testable = norms > MIN_RESIDUAL_FRACTION * projected_columns.squared_norms
        norms = np.where(is_testable, norms, np.inf)
        product = columns.T @ residual
        gain = product**2 / norms
        residual_rss = projected_columns.rss + float(residual @ residual)
        scale = np.maximum(residual_rss - gain, 0.0) / dof
        if noise_given:
            scale = np.maximum(scale, 1.0)
        value[group] = product / norms
        u[group] = np.where(is_testable, np.sqrt(scale / np.where(is_testable, norms, 1.0)), np.inf)
        z[group] = np.sqrt(gain / np.maximum(scale, np.finfo(float).tiny))
    return ScoreTests(tuple(alternatives), value, u, z, dof)


@frozen
class ProjectedColumns:
    """Columns of alternatives, projected onto the residual space of a fit."""

    columns: Array  #: Of m alternatives in the rows of blocks and priors, shape (rows, m).
    residual: Array  #: The fit's, in these rows, shape (rows,).
    rss: float  #: Sum of squares of what these rows do not hold of the residuals.
    squared_norms: (
        Array  #: Sums of squares of the columns before anything was taken away, shape (m,).
    )
    dof: float  #: Degrees of freedom of the fit.
    row_slices: tuple[slice, ...]  #: Which rows are those of each observation.


def project_columns(fit: JointFit, alternatives: Sequence[Alternative]) -> ProjectedColumns:
    """Project alternatives off a fit; arguments as in `run_score_tests`."""
    blocks, solution, augmented_rows = _augment_rows(fit, [a for a in alternatives if a.columns])
    data, priors = _columns(alternatives, blocks, solution, augmented_rows)
    target = np.concatenate([block.target for block in blocks])
    is_fixed = solution.prior_sd == 0.0
    factor = np.vstack([block.factor for block in blocks])
    target = target - factor[:, is_fixed] @ solution.prior_mean[is_fixed]
    prior_targets = solution.whiten_priors(solution.prior_mean[:, None])
    residual = solution.project_out(target[:, None], prior_targets)[:, 0]
    columns = solution.project_out(data, priors)
    return ProjectedColumns(
        columns,
        residual,
        rss=sum(block.rss for block in blocks),
        squared_norms=np.sum(data**2, axis=0) + np.sum(priors**2, axis=0),
        dof=solution.dof,
        row_slices=_row_slices(blocks),
    )


def undetected_effects(fit: JointFit, alternatives: Sequence[Alternative]) -> tuple[Array, Array]:
    """Return the effect of one unit of each alternative outside the space of the fit.

    Returns: the size of what it leaves in the residuals, in standard deviations, shape (m,), and by
        how much it moves the unknowns, shape (p, m).
    """
    blocks, solution, augmented_rows = _augment_rows(fit, [a for a in alternatives if a.columns])
    data, priors = _columns(alternatives, blocks, solution, augmented_rows)
    effects = np.linalg.norm(solution.project_out(data, priors), axis=0)
    return effects, solution.undetected_shifts(data, priors)


def _row_slices(blocks: Sequence[Block]) -> tuple[slice, ...]:
    ends = np.cumsum([block.factor.shape[0] for block in blocks]).tolist()
    return tuple(map(slice, [0, *ends], ends))


def _augment_rows(
    fit: JointFit, with_columns: Sequence[Alternative]
) -> tuple[Sequence[Block], Solution, Array]:
    """Return blocks and solution of a fit in rows that hold further columns, and these columns."""
    if not with_columns:
        return fit.blocks, fit.solution, np.empty((0, 0))
    p = len(fit.model.unknowns)
    columns = [alternative.columns for alternative in with_columns]
    blocks = list(fit.blocks)
    augmented_rows = [np.zeros((block.factor.shape[0], len(columns))) for block in blocks]
    for index in {block_index for column in columns for block_index in column}:
        _, augmented_block = augment_block(fit, index, columns)
        blocks[index] = replace(augmented_block, factor=augmented_block.factor[:, :p])
        augmented_rows[index] = augmented_block.factor[:, p:]
    return blocks, solve_blocks(blocks, fit.model), np.vstack(augmented_rows)


def _columns(
    alternatives: Sequence[Alternative],
    blocks: Sequence[Block],
    solution: Solution,
    augmented_rows: Array,
) -> tuple[Array, Array]:
    """Return the columns in the blocks' rows and in those of the priors, (rows, m) and (p, m)."""
    factor = np.vstack([block.factor for block in blocks])
    data = np.zeros((len(alternatives), factor.shape[0])).T  # columns in one piece
    priors = np.zeros((solution.estimate.size, len(alternatives)))
    remaining = iter(augmented_rows.T)
    for k, alternative in enumerate(alternatives):
        if alternative.columns:
            data[:, k] = next(remaining)
        for unknown_index, shift in alternative.prior_shifts.items():
            if solution.prior_sd[unknown_index] > 0.0:
                priors[unknown_index, k] = -shift
            else:
                # What is known exactly is no unknown: the records show how it is otherwise.
                data[:, k] += shift * factor[:, unknown_index]
    # A prior that is too large by 1 has a row whose target is too large by 1/sd.
    return data, solution.whiten_priors(priors)
