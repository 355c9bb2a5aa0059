"""Score tests of single additional parameters.

Each alternative is a parameter that the fit fixes at zero, such as the error of a prior or an
input, a scale or a jump. Its column is tested against the whitened residuals of the fit (score or
Lagrange-multiplier test: Rao, Proc. Cambridge Phil. Soc. 44 (1948) 50). With the unknowns projected
out of the column c and the residuals e, the estimate of the parameter is c'e/c'c, its standard
deviation 1/|c| and the gain in chi-square (c'e)^2/c'c. A fit with the parameter gives the same
values.

For a prior, the parameter is the distance of the prior from the estimate of all other data, and the
test is Baarda's w-test.
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

#: Radius of the centrifuge; for a mounting, a point and its name follow.
RADIUS: Final = "centrifuge.radius"


@frozen
class Alternative:
    """Alternative hypothesis: a parameter that a fit fixes at zero."""

    kind: str  #: Kind of the parameter, such as ``prior``, ``input`` or a kind of mistake.
    owner: str  #: An accelerometer, a run, or empty: the campaign.
    symbol: str  #: A term, an input, or the name of a mistake.
    #: Index of an observation -> effect of one unit, in the unit of the observation, shape (n,).
    columns: Mapping[int, Array] = field(default_factory=dict, repr=False, compare=False)
    #: Index of an unknown -> shift of its prior per unit.
    prior_shifts: Mapping[int, float] = field(default_factory=dict, compare=False)
    time: float | None = None  #: Time in a run, s; None: not localised.
    credible_range: tuple[float, float] = (-math.inf, math.inf)  #: Range of credible values.
    #: Excluded values inside the credible range; empty unless the second limit is larger.
    excluded_range: tuple[float, float] = (0.0, 0.0)
    #: Values near which the parameter is likely, and the largest distance; empty: any value.
    likely_values: tuple[float, ...] = ()
    likely_tolerance: float = math.inf
    #: Default standard uncertainty; None for a mistake, which may have any size.
    default_sd: float | None = None
    stated: bool = False  #: True if the description states a value, which may be mistaken.

    def is_credible(self, value: float) -> bool:
        """Return whether a value of the parameter is credible."""
        (low, high), (excluded_low, excluded_high) = self.credible_range, self.excluded_range
        return low <= value <= high and not excluded_low < value < excluded_high

    def is_implausible(self, value: float) -> bool:
        """Return whether a value is far from every likely value."""
        distance = min(
            (abs(value - likely_value) for likely_value in self.likely_values), default=0.0
        )
        return distance > self.likely_tolerance

    @property
    def name(self) -> str:
        """Owner and symbol, separated by a point."""
        return f"{self.owner}.{self.symbol}" if self.owner else self.symbol


@frozen
class ScoreTests:
    """Score tests of m alternatives."""

    alternatives: tuple[Alternative, ...]  #: The alternatives.
    #: Estimate of each parameter and its standard uncertainty, shape (m,); u is infinite if the
    #: unknowns explain its effect completely.
    value: Array
    u: Array
    #: Estimate in standard deviations, scaled by the residuals, shape (m,); 0 if untestable.
    z: Array
    dof: float  #: Degrees of freedom of the scale of the residuals.

    def p(self, index: int) -> float:
        """Return the probability of a value at least this large by chance, for a single test."""
        return 2.0 * student_cdf(max(self.dof, 1.0), -float(self.z[index]))

    @property
    def n_tests(self) -> int:
        """Number of alternatives that the records can distinguish."""
        return int(np.count_nonzero(np.isfinite(self.u)))


def prior_alternatives(fit: JointFit) -> tuple[Alternative, ...]:
    """Return the alternatives of wrong stated priors.

    There is an alternative for each unknown with a stated prior. Terms of several runs, their
    components, and radii of several mountings have common alternatives too, because a single
    mistake may affect all of them.
    """
    indexed_unknowns = [
        (index, unknown)
        for index, unknown in _unknowns_with_prior(fit)
        if not unknown.has_default_prior
    ]
    single_alternatives = (
        Alternative(
            "prior", *_owner_and_symbol(u), prior_shifts={k: 1.0}, credible_range=_credible_range(u)
        )
        for k, u in indexed_unknowns
    )
    return (*single_alternatives, *_shared_alternatives(fit, indexed_unknowns))


def default_prior_alternatives(fit: JointFit) -> tuple[Alternative, ...]:
    """Return the alternatives of parameters far outside their default priors."""
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


def rotation_alternatives(fit: JointFit) -> tuple[Alternative, ...]:
    """Return the alternatives of a rotation that differs from the recorded angle."""
    return tuple(
        Alternative("rotation", *_owner_and_symbol(unknown), prior_shifts={index: 1.0})
        for index, unknown in enumerate(fit.model.unknowns)
        if math.isfinite(unknown.prior[1]) and unknown.symbol in encoder.SYMBOLS
    )


def _unknowns_with_prior(fit: JointFit) -> list[tuple[int, Unknown]]:
    """Return indices and unknowns with a prior, without encoder terms."""
    return [
        (index, unknown)
        for index, unknown in enumerate(fit.model.unknowns)
        if math.isfinite(unknown.prior[1]) and unknown.symbol not in encoder.SYMBOLS
    ]


def _owner_and_symbol(unknown: Unknown) -> tuple[str, str]:
    return unknown.owner, unknown.symbol


def _credible_range(unknown: Unknown) -> tuple[float, float]:
    """Return the credible range of an unknown, relative to its prior."""
    mean, limit = unknown.prior_mean, unknown.limit
    limit += abs(mean) if abs(mean) > limit else 0.0  # the stated value is credible
    return -limit - mean, limit - mean


def _shared_alternatives(
    fit: JointFit, indexed_unknowns: Sequence[tuple[int, Unknown]]
) -> Iterator[Alternative]:
    """Yield an alternative for each term, and family of terms, of several runs.

    The radii of several mountings that depend on one statement have an alternative too.
    """
    runs = {block.run for block in fit.design_blocks}
    prior_shifts: dict[str, dict[int, float]] = {}
    for index, unknown in indexed_unknowns:
        if unknown.owner in runs:
            family, _, _ = unknown.symbol.rpartition(".")
            for name in (unknown.symbol, family) if family else (unknown.symbol,):
                prior_shifts.setdefault(name, {})[index] = 1.0
        elif unknown.symbol == f"{RADIUS}.{mounting_name(unknown.symbol)}":
            prior_shifts.setdefault(RADIUS, {})[index] = 1.0
    unique_shifts: list[Mapping[int, float]] = []
    for symbol, shifts in prior_shifts.items():
        if len(shifts) > 1 and shifts not in unique_shifts:
            unique_shifts.append(shifts)
            limit = min(fit.model.unknowns[index].limit for index in shifts)
            kind = "prior" if symbol == RADIUS else "priors"  # one statement, or one a run
            yield Alternative(kind, "", symbol, prior_shifts=shifts, credible_range=(-limit, limit))


def run_score_tests(
    fit: JointFit, alternatives: Sequence[Alternative], *, noise_given: bool
) -> ScoreTests:
    """Run a score test of each alternative against a fit.

    The scale of the residuals is that of a fit with the alternative (F test). With given noise, it
    is at least 1. Otherwise, residuals without degrees of freedom test nothing.

    noise_given: Whether the noise was given.
    """
    # Alternatives of the same observations share their augmented rows.
    indices_by_observations: dict[frozenset[int], list[int]] = {}
    for index, alternative in enumerate(alternatives):
        indices_by_observations.setdefault(frozenset(alternative.columns), []).append(index)
    value, u, z = np.zeros((3, len(alternatives)))
    dof = max(fit.solution.dof - 1.0, 1.0)
    has_scale = noise_given or fit.solution.dof > 1.5
    for indices in indices_by_observations.values():
        projected_columns = project_columns(fit, [alternatives[index] for index in indices])
        columns, residual = projected_columns.columns, projected_columns.residual
        squared_norms = np.sum(columns**2, axis=0)
        min_norms = MIN_RESIDUAL_FRACTION * projected_columns.squared_norms
        is_testable = (squared_norms > min_norms) & has_scale
        squared_norms = np.where(is_testable, squared_norms, np.inf)
        inner_products = columns.T @ residual
        gain = inner_products**2 / squared_norms
        residual_rss = projected_columns.rss + float(residual @ residual)
        variance_factor = np.maximum(residual_rss - gain, 0.0) / dof
        if noise_given:
            variance_factor = np.maximum(variance_factor, 1.0)
        value[indices] = inner_products / squared_norms
        u[indices] = np.where(
            is_testable,
            np.sqrt(variance_factor / np.where(is_testable, squared_norms, 1.0)),
            np.inf,
        )
        z[indices] = np.sqrt(gain / np.maximum(variance_factor, np.finfo(float).tiny))
    return ScoreTests(tuple(alternatives), value, u, z, dof)


@frozen
class ProjectedColumns:
    """Columns of alternatives, projected onto the residual space of a fit."""

    columns: Array  #: Columns of m alternatives in the rows of blocks and priors, shape (rows, m).
    residual: Array  #: Residuals of the fit in these rows, shape (rows,).
    rss: float  #: Sum of squares of the residuals outside these rows.
    squared_norms: Array  #: Sums of squares of the columns before the projection, shape (m,).
    dof: float  #: Degrees of freedom of the fit.
    row_slices: tuple[slice, ...]  #: Rows of each observation.


def project_columns(fit: JointFit, alternatives: Sequence[Alternative]) -> ProjectedColumns:
    """Project the columns of alternatives onto the residual space of a fit."""
    blocks, solution, augmented_rows = _augment_rows(fit, [a for a in alternatives if a.columns])
    data, priors = _alternative_columns(alternatives, blocks, solution, augmented_rows)
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

    Returns: norms of the effects in the residuals, in standard deviations, shape (m,), and shifts
        of the unknowns, shape (p, m).
    """
    blocks, solution, augmented_rows = _augment_rows(fit, [a for a in alternatives if a.columns])
    data, priors = _alternative_columns(alternatives, blocks, solution, augmented_rows)
    effects = np.linalg.norm(solution.project_out(data, priors), axis=0)
    return effects, solution.undetected_shifts(data, priors)


def _row_slices(blocks: Sequence[Block]) -> tuple[slice, ...]:
    row_ends = np.cumsum([block.factor.shape[0] for block in blocks]).tolist()
    return tuple(map(slice, [0, *row_ends], row_ends))


def _augment_rows(
    fit: JointFit, alternatives: Sequence[Alternative]
) -> tuple[Sequence[Block], Solution, Array]:
    """Return blocks and solution of a fit in augmented rows, and the additional columns."""
    if not alternatives:
        return fit.blocks, fit.solution, np.empty((0, 0))
    p = len(fit.model.unknowns)
    columns = [alternative.columns for alternative in alternatives]
    blocks = list(fit.blocks)
    augmented_rows = [np.zeros((block.factor.shape[0], len(columns))) for block in blocks]
    for index in {block_index for column in columns for block_index in column}:
        _, augmented_block = augment_block(fit, index, columns)
        blocks[index] = replace(augmented_block, factor=augmented_block.factor[:, :p])
        augmented_rows[index] = augmented_block.factor[:, p:]
    return blocks, solve_blocks(blocks, fit.model), np.vstack(augmented_rows)


def _alternative_columns(
    alternatives: Sequence[Alternative],
    blocks: Sequence[Block],
    solution: Solution,
    augmented_rows: Array,
) -> tuple[Array, Array]:
    """Return the columns in the rows of blocks and of priors, shapes (rows, m) and (p, m)."""
    factor = np.vstack([block.factor for block in blocks])
    data = np.zeros((len(alternatives), factor.shape[0])).T  # columns in one piece
    priors = np.zeros((solution.estimate.size, len(alternatives)))
    remaining_columns = iter(augmented_rows.T)
    for k, alternative in enumerate(alternatives):
        if alternative.columns:
            data[:, k] = next(remaining_columns)
        for unknown_index, shift in alternative.prior_shifts.items():
            if solution.prior_sd[unknown_index] > 0.0:
                priors[unknown_index, k] = -shift
            else:
                # An exactly known parameter has no prior row; use its column in the records.
                data[:, k] += shift * factor[:, unknown_index]
    # For a prior that is too large by 1, the target of its row is too large by 1/sd.
    return data, solution.whiten_priors(priors)
