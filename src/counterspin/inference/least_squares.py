"""Linear least squares with an uncertainty that is split by source.

Given the trajectory, the displacement error is linear in the coefficients, so that one solver
serves the two stages of the paper, the joint fit of full records, planning and Monte-Carlo studies.
The information of a record of any length on p unknowns fits into p rows of square-root information
(Bierman 1977). This `Block` does not contain the start offset and start velocity of the record,
which are projected out. `solve` solves any set of blocks together with the prior information; `fit`
fits a single set of observations.

No Gram matrix is ever formed. Householder QR has a backward error that is small column by column
(Higham, Accuracy and Stability of Numerical Algorithms, 2nd ed., theorem 19.4), so that columns
of very different size, such as t^2/2 beside cos wt, need no scaling before it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import QR_BLOCK_ROWS, Array, qr_blocks, triangular_factor
from counterspin.errors import NotIdentifiableError
from counterspin.frozen import frozen
from counterspin.inference.priors import whiten_priors

_CHUNK_ROWS: Final = 32 * QR_BLOCK_ROWS  #: rows copied at a time, which bounds the memory
_CHUNK_COLUMNS: Final = 256  #: columns projected at a time, which bounds the memory


@frozen
class Block:
    """Information of one record on the shared unknowns, in rotated rows of unit variance.

    ``target = factor @ unknowns + considered @ considered_values + noise``.
    """

    factor: Array  #: Upper trapezoidal, shape (k, p), k <= p + q.
    target: Array  #: Shape (k,).
    considered: Array  #: The columns of the considered terms in the same rows, shape (k, q).
    rss: float  #: Residual sum of squares.
    rows: int  #: Number of observations.
    n_nuisance: int  #: Number of nuisance parameters that were projected out.

    def scaled(self, ratio: float) -> Block:
        """Return the block with its rows multiplied by a factor."""
        return replace(
            self,
            factor=ratio * self.factor,
            target=ratio * self.target,
            considered=ratio * self.considered,
            rss=ratio**2 * self.rss,
        )


def reduce_block(
    design: npt.ArrayLike,
    observations: npt.ArrayLike,
    nuisance: npt.ArrayLike | None = None,
    considered: npt.ArrayLike | None = None,
) -> Block:
    """Reduce one record to its square-root information about the shared unknowns.

    One QR of [nuisance | design | considered | observations]; the rows that belong to the
    nuisances are dropped, which is the exact projection.

    design: Columns of the unknowns, whitened (unit variance, uncorrelated), shape (n, p).
    observations: Whitened observations, shape (n,).
    nuisance: Columns of the record's own unknowns, whitened, shape (n, m); none by default.
    considered: Columns of the considered terms, whitened, shape (n, q); none by default.
    """
    y = np.asarray(observations, dtype=np.float64)
    n = y.size
    matrices = [
        np.empty((n, 0)) if columns is None else np.asarray(columns, dtype=np.float64)
        for columns in (nuisance, design, considered)
    ]
    if y.ndim != 1 or any(columns.ndim != 2 or columns.shape[0] != n for columns in matrices):
        shapes = ", ".join(str(columns.shape) for columns in matrices)
        raise ValueError(
            f"nuisance, design and considered must each have {n} rows, the number of "
            f"observations, but the shapes are {shapes}"
        )
    return reduce_rows(np.column_stack([*matrices, y]), matrices[0].shape[1], matrices[1].shape[1])


def reduce_rows(rows: Array, n_nuisance: int, p: int) -> Block:
    """Reduce a record as `reduce_block`, with all columns in one array.

    rows: [nuisance | design | considered | observations], shape (n, m + p + q + 1).
    """
    n, q = rows.shape[0], rows.shape[1] - n_nuisance - p - 1
    triangle = np.empty((0, n_nuisance + p + q + 1))
    for start in range(0, n, _CHUNK_ROWS):
        triangle = triangular_factor(
            np.vstack([triangle, qr_blocks(rows[start : start + _CHUNK_ROWS])])
        )
    if not np.isfinite(triangle).all():
        raise ValueError("the columns or the observations contain numbers that are not finite")

    nuisance_triangle = triangle[:n_nuisance, :n_nuisance]
    if dependent_columns(nuisance_triangle).size:
        raise NotIdentifiableError(
            f"{n} samples cannot separate the {n_nuisance} unknowns of the record itself (such as "
            "its initial offset and initial velocity); the record is too short"
        )
    shared_rows = triangle[n_nuisance : n_nuisance + p + q]
    return Block(
        factor=shared_rows[:, n_nuisance : n_nuisance + p],
        target=shared_rows[:, -1],
        considered=shared_rows[:, n_nuisance + p : n_nuisance + p + q],
        rss=float(np.sum(triangle[n_nuisance + p + q :, -1] ** 2)),
        rows=n,
        n_nuisance=n_nuisance,
    )


def dependent_columns(triangle: Array) -> npt.NDArray[np.intp]:
    """Return the columns of a triangular factor that depend on those before them, to rounding."""
    norms = np.linalg.norm(triangle, axis=0)
    diagonal = np.zeros_like(norms)  # a column beyond the last row depends on the others
    diagonal[: triangle.shape[0]] = np.abs(np.diagonal(triangle))
    return np.flatnonzero(diagonal <= 4.0 * norms.size * np.finfo(np.float64).eps * norms)


# Blocks together -------------------------------------------------------------------------------

#: Value and standard uncertainty of an unknown without prior information.
NO_PRIOR: Final = (0.0, math.inf)


#: The numerical regularisation of an unknown without a prior, in units of its credible limit.
#: This large factor keeps every estimate finite, and changes no determined estimate by more than
#: 1e-8 of its uncertainty.
REGULARISATION: Final = 1e4


@frozen
class Combination:
    """A linear combination of the unknowns, and its uncertainty by source."""

    value: float  #: The estimate of the combination.
    noise: float  #: Standard uncertainty from the records' noise.
    #: Signed contribution of each row of the stacked blocks; `noise` is their norm.
    noise_rows: Array
    #: Signed contribution of each unknown's prior (sensitivity x its sd), shape (p,); of correlated
    #: priors, of each row of `whiten_priors`.
    prior: Array
    considered: Array  #: Signed contribution of each considered term, shape (q,).
    #: From the numerical regularisation; negligible for a determined combination.
    unresolved: float
    undetected: float = 0.0  #: Standard uncertainty from noise that the records do not show.

    @property
    def u(self) -> float:
        """The combined standard uncertainty."""
        return math.hypot(
            self.noise, self.undetected, self.unresolved, *self.prior, *self.considered
        )


@frozen
class _Factorisation:
    """The factorised problem, rotation @ triangle, kept for `Solution.combine`."""

    free: npt.NDArray[np.intp]  # the unknowns that are not exactly known, f of p
    rotation: Array  # (rows, f): first the data's rows, then the priors', then the regularisation's
    triangle: Array  # (f, f)
    n_data: int
    prior_indices: npt.NDArray[np.intp]  # the unknown that each prior row holds
    considered: Array  # (data, q)
    row_sd: Array | float = 1.0  # standard deviations of the data's rows, (data,)


@frozen
class Solution:
    """The estimate, its uncertainty by source, and how well the model fits.

    p unknowns, q considered terms; units are those of the unknowns throughout.
    """

    estimate: Array  #: Shape (p,). An unknown known exactly (prior sd 0) has its prior mean.
    #: Contributions of noise, priors and considered terms, each of shape (p, p).
    covariance_noise: Array
    covariance_prior: Array
    covariance_considered: Array
    #: From the numerical regularisation, shape (p, p): 1e-16 of the variance or less for a
    #: determined unknown, about (1e4 limits)^2 for one that the data do not determine.
    #: `identifiability.assess` decides which unknowns are determined.
    covariance_unresolved: Array
    #: d estimate / d prior mean, shape (p, p); zero columns for unknowns without a prior.
    sensitivity_prior: Array
    #: d estimate / d assumed value of the considered terms, shape (p, q).
    sensitivity_considered: Array
    chi2: float  #: Weighted sum of squares of the data's residuals and of the priors' misfits.
    #: rows - nuisances + priors - unknowns, where exactly known unknowns do not count and those
    #: held by the regularisation count only as far as the data determine them.
    dof: float
    information: Array  #: The data's own square-root information, without priors, shape (k, p).
    #: As given to `solve`; limits is None where there was no regularisation.
    prior_mean: Array
    prior_sd: Array
    considered_sd: Array
    limits: Array | None
    prior_correlation: Array | None  #: Shape (p, p); None: independent priors.
    _factors: _Factorisation
    #: From noise that the records do not show, shape (p, p); None without. `solve` knows none.
    covariance_undetected: Array | None = None

    @property
    def covariance(self) -> Array:
        """The combined covariance, shape (p, p)."""
        total = self.weighted_covariance + self.covariance_considered
        return total if self.covariance_undetected is None else total + self.covariance_undetected

    @property
    def weighted_covariance(self) -> Array:
        """Covariance that the weights minimise, from noise, priors and regularisation, (p, p).

        Considered terms and undetected noise do not affect the weights.
        """
        return self.covariance_noise + self.covariance_prior + self.covariance_unresolved

    @property
    def u(self) -> Array:
        """The combined standard uncertainties, shape (p,)."""
        return np.sqrt(np.diag(self.covariance))

    def whiten_priors(self, columns: Array) -> Array:
        """Return whitened deviations from the prior means, shape (p, c).

        Rows of unknowns without a prior, and of exactly known unknowns, are zero.

        columns: Shape (p, c).
        """
        known = np.flatnonzero((self.prior_sd > 0.0) & np.isfinite(self.prior_sd))
        correlation = self.prior_correlation
        if correlation is not None:
            correlation = correlation[np.ix_(known, known)]
        rows = np.zeros_like(columns)
        rows[known] = whiten_priors(columns[known], self.prior_sd[known], correlation)
        return rows

    @property
    def leverages(self) -> Array:
        """Leverage of each of the blocks' stacked rows, from 0 to 1.

        If the priors are right, the expected squared residual of a row is 1 minus its leverage.
        """
        rotation: Array = self._factors.rotation[: self._factors.n_data]
        leverages: Array = np.sum(rotation**2, axis=1)
        return leverages

    def replace_row_noise(self, noise: Array) -> Solution:
        """Return the solution with the same estimates and other standard deviations of the rows.

        noise: Standard deviations of the blocks' stacked rows, shape (n,); the solver assumed 1.
        """
        factors = self._factors
        gain = np.linalg.solve(factors.triangle, factors.rotation[: factors.n_data].T) * noise
        return replace(
            self,
            covariance_noise=_embed_covariance(gain, factors.free, self.estimate.size),
            _factors=replace(factors, row_sd=noise),
        )

    def covariance_root(self, rows: Array) -> Array:
        """Return G with G @ G.T the `weighted_covariance` of rows @ unknowns, shape (n, f).

        Computed from the factors, for the reason given in `combine`.

        rows: Shape (n, p).
        """
        free = self._factors.free
        return np.asarray(np.linalg.solve(self._factors.triangle.T, rows[:, free].T).T, np.float64)

    def whiten_unknowns(self, unknowns: Array) -> Array:
        """Return whitened unknowns, whose `weighted_covariance` is the identity, shape (f,).

        unknowns: Shape (p,); exactly known unknowns are omitted.
        """
        return np.asarray(self._factors.triangle @ unknowns[self._factors.free])

    def project_out(self, data: Array, priors: Array) -> Array:
        """Return the part of additional columns that the unknowns cannot explain.

        data: In the blocks' stacked rows, shape (n, c).
        priors: In the rows of `whiten_priors`, shape (p, c); only unknowns with a prior count, and
        none that is known exactly.
        Returns: shape (rows, c), first the blocks' rows; orthogonal to the columns of the problem.
        """
        stacked_rows, rotation = self._stack_rows(data, priors), self._factors.rotation
        # Twice: the rounding errors of one projection matter if the remainder is small.
        for start in range(0, stacked_rows.shape[1], _CHUNK_COLUMNS):
            columns = stacked_rows[:, start : start + _CHUNK_COLUMNS]
            for _ in range(2):
                columns -= rotation @ (rotation.T @ columns)
        return stacked_rows

    def undetected_shifts(self, data: Array, priors: Array) -> Array:
        """Return the shifts of the unknowns by additional columns that are omitted, shape (p, c).

        The parameters are those of `project_out`.
        """
        factors = self._factors
        shifts = np.zeros((self.estimate.size, data.shape[1]))
        stacked_rows = self._stack_rows(data, priors)
        shifts[factors.free] = np.linalg.solve(factors.triangle, factors.rotation.T @ stacked_rows)
        return shifts

    def _stack_rows(self, data: Array, priors: Array) -> Array:
        """Return columns in all rows: of the blocks, the priors and the regularisation."""
        factors = self._factors
        rows = np.zeros((factors.rotation.shape[0], data.shape[1]), order="F")
        n, indices = factors.n_data, factors.prior_indices
        rows[:n] = data
        rows[n : n + indices.size] = priors[indices]
        return rows

    def combine(self, weights: npt.ArrayLike) -> Combination:
        """Return a linear combination of the unknowns, with its uncertainty split by source.

        Computed from the factors: the sum of two undetermined unknowns may be known a billion times
        better than either, and the covariance matrix would lose its digits.

        weights: Shape (p,).
        """
        c = np.asarray(weights, dtype=np.float64)
        factors = self._factors
        gain = factors.rotation @ np.linalg.solve(factors.triangle.T, c[factors.free])
        data = gain[: factors.n_data]
        row_noise = data * factors.row_sd
        prior_end = factors.n_data + factors.prior_indices.size
        prior = np.zeros(c.size)
        prior[factors.prior_indices] = gain[factors.n_data : prior_end]
        return Combination(
            value=float(c @ self.estimate),
            noise=float(np.linalg.norm(row_noise)),
            noise_rows=row_noise,
            prior=prior,
            considered=-(data @ factors.considered) * self.considered_sd,
            unresolved=float(np.linalg.norm(gain[prior_end:])),
            undetected=0.0
            if self.covariance_undetected is None
            else math.sqrt(max(float(c @ self.covariance_undetected @ c), 0.0)),
        )


def solve(
    blocks: Sequence[Block],
    *,
    prior_mean: npt.ArrayLike | None = None,
    prior_sd: npt.ArrayLike | None = None,
    prior_correlation: Array | None = None,
    considered_mean: npt.ArrayLike | None = None,
    considered_sd: npt.ArrayLike | None = None,
    limits: npt.ArrayLike | None = None,
) -> Solution:
    """Estimate the shared unknowns from all blocks and the prior information.

    Considered terms (Schmidt) are not estimated: the solver uses their assumed values, and adds
    their uncertainty times the sensitivity of the estimate to the covariance.

    prior_mean: Shape (p,), zeros by default. Without a prior, the centre of the regularisation.
    prior_sd: Standard uncertainties, shape (p,). ``inf`` (the default): no prior; 0: exactly known.
    prior_correlation: Positive definite, shape (p, p); None: independent priors.
    considered_mean, considered_sd: Shape (q,); zeros by default.
    limits: Largest credible sizes of the unknowns, shape (p,). An unknown without a prior gets one
        of `REGULARISATION` times its limit, so that collinear columns do no harm. None: no
        regularisation.
    References: Bierman, Factorization Methods for Discrete Sequential Estimation, 1977, chapters V
        and VIII (square-root information, considered parameters).
    """
    if not blocks:
        raise ValueError("no blocks of observations were given")
    factor = np.vstack([block.factor for block in blocks])
    considered = np.vstack([block.considered for block in blocks])
    p, q = factor.shape[1], considered.shape[1]
    mean = _checked_vector("prior_mean", prior_mean, p, 0.0)
    sd = _checked_vector("prior_sd", prior_sd, p, np.inf)
    considered_values = _checked_vector("considered_mean", considered_mean, q, 0.0)
    c_sd = _checked_vector("considered_sd", considered_sd, q, 0.0)
    if (sd < 0).any() or (c_sd < 0).any() or not np.isfinite(c_sd).all():
        raise ValueError(
            "prior_sd must not be negative; considered_sd must be finite and not negative"
        )
    bounds = None if limits is None else _checked_vector("limits", limits, p, 0.0)
    if bounds is not None and not ((bounds > 0) & np.isfinite(bounds)).all():
        raise ValueError("limits must be positive and finite")

    free = np.flatnonzero(sd > 0)
    prior_positions = np.flatnonzero(np.isfinite(sd[free]))  # positions among the free ones
    is_regularised = np.isinf(sd[free]) & (bounds is not None)
    priors = free[prior_positions]
    correlation = None if prior_correlation is None else prior_correlation[np.ix_(priors, priors)]
    prior_weights = whiten_priors(np.eye(prior_positions.size), sd[priors], correlation)
    regularisation_weights = (
        np.empty(0) if bounds is None else 1.0 / (REGULARISATION * bounds[free][is_regularised])
    )
    identity = np.eye(free.size)
    prior_rows = np.zeros((prior_positions.size, free.size))
    prior_rows[:, prior_positions] = prior_weights
    stacked_rows = np.vstack(
        [factor[:, free], prior_rows, regularisation_weights[:, None] * identity[is_regularised]]
    )
    # Unknowns are relative to their prior means, so the target of the added rows is zero.
    misfit = np.concatenate([block.target for block in blocks])
    misfit = misfit - considered @ considered_values - factor @ mean
    rotation, triangle = _factorise(stacked_rows)
    dependent = dependent_columns(triangle)
    if bounds is None and dependent.size:
        index = int(free[dependent[0]])
        raise NotIdentifiableError(
            f"column {index + 1} of the design matrix is a linear combination of the preceding "
            "columns, so the data cannot separate these unknowns; omit one of them or give a prior"
        )
    n_data, prior_end = factor.shape[0], factor.shape[0] + prior_positions.size
    inverse = np.linalg.solve(triangle, identity)
    gain = inverse @ rotation.T
    step = np.linalg.solve(triangle, rotation[:n_data].T @ misfit)

    estimate = mean.copy()
    estimate[free] += step
    # An unknown that is exactly known acts like a considered term without uncertainty.
    sensitivity_prior = np.diag((sd == 0).astype(np.float64))
    sensitivity_prior[np.ix_(free, sd == 0)] = -gain[:, :n_data] @ factor[:, sd == 0]
    prior_gain = gain[:, n_data:prior_end]
    sensitivity_prior[np.ix_(free, priors)] = (
        prior_gain * np.diag(prior_weights) if correlation is None else prior_gain @ prior_weights
    )
    sensitivity_considered = np.zeros((p, q))
    sensitivity_considered[free] = -gain[:, :n_data] @ considered

    residual = misfit - factor[:, free] @ step
    chi2 = sum(block.rss for block in blocks) + residual @ residual
    chi2 += np.sum((prior_rows @ step) ** 2)
    dof = sum(block.rows - block.n_nuisance for block in blocks) + prior_positions.size - free.size
    considered_effects = sensitivity_considered * c_sd
    return Solution(
        estimate=estimate,
        covariance_noise=_embed_covariance(gain[:, :n_data], free, p),
        covariance_prior=_embed_covariance(gain[:, n_data:prior_end], free, p),
        covariance_considered=considered_effects @ considered_effects.T,
        covariance_unresolved=_embed_covariance(gain[:, prior_end:], free, p),
        sensitivity_prior=sensitivity_prior,
        sensitivity_considered=sensitivity_considered,
        chi2=float(chi2),
        dof=float(dof + np.sum(rotation[prior_end:] ** 2)),
        information=triangular_factor(factor),
        prior_mean=mean,
        prior_sd=sd,
        considered_sd=c_sd,
        limits=bounds,
        prior_correlation=prior_correlation,
        _factors=_Factorisation(free, rotation, triangle, n_data, priors, considered),
    )


def _factorise(rows: Array) -> tuple[Array, Array]:
    """Return Q and R, with the largest rows first: Householder QR requires this order."""
    norms = np.linalg.norm(rows, axis=0)
    relative_sizes = np.max(np.abs(rows) / np.where(norms > 0, norms, 1.0), axis=1, initial=0.0)
    order = np.argsort(-relative_sizes, kind="stable")
    sorted_rotation, triangle = np.linalg.qr(rows[order])
    rotation = np.empty_like(sorted_rotation)
    rotation[order] = sorted_rotation
    return rotation, triangle


def _checked_vector(name: str, values: npt.ArrayLike | None, size: int, default: float) -> Array:
    """Return a validated vector, or a vector of `default` if no values are given."""
    if values is None:
        return np.full(size, default)
    vector = np.asarray(values, dtype=np.float64)
    if vector.shape != (size,) or np.isnan(vector).any():
        raise ValueError(
            f"{name} must contain {size} numbers; it has the shape {vector.shape} or contains NaN"
        )
    return vector


def _embed_covariance(gain: Array, free: npt.NDArray[np.intp], n_unknowns: int) -> Array:
    """Return the covariance of all unknowns from the gain of the free unknowns."""
    covariance = np.zeros((n_unknowns, n_unknowns))
    covariance[np.ix_(free, free)] = gain @ gain.T
    return covariance


# One set of observations alone -----------------------------------------------------------------


@frozen
class Fit:
    """A plain least-squares fit."""

    estimate: Array  #: Shape (p,).
    covariance: Array  #: Shape (p, p).
    #: observations - design @ estimate, in the units of the observations, shape (n,).
    residuals: Array
    #: Weighted sum of squared residuals; with sigma from the residuals, plain sum of squares.
    chi2: float
    dof: int  #: n - p.
    #: Standard deviation of an observation, given or estimated from the residuals; an array if it
    #: was given as an array.
    sigma: float | Array
    sigma_from_residuals: bool  #: Whether sigma was estimated, so that intervals need Student's t.

    @property
    def u(self) -> Array:
        """The standard uncertainties, shape (p,)."""
        return np.sqrt(np.diag(self.covariance))


def fit(
    design: npt.ArrayLike, observations: npt.ArrayLike, sigma: float | npt.ArrayLike | None = None
) -> Fit:
    """Fit one set of observations by (weighted) least squares.

    design: Shape (n, p).
    observations: Shape (n,).
    sigma: Standard deviation of each observation, a number or shape (n,). None: a common value is
        estimated from the residuals.
    """
    columns = np.asarray(design, dtype=np.float64)
    y = np.asarray(observations, dtype=np.float64)
    row_sd = None if sigma is None else np.asarray(sigma, dtype=np.float64)
    scale = np.ones(()) if row_sd is None else row_sd
    if scale.shape not in {(), y.shape} or not ((scale > 0) & np.isfinite(scale)).all():
        raise ValueError("sigma must be positive: a single number, or one per observation")
    solution = solve([reduce_block(columns / scale.reshape(-1, 1), y / scale)])
    covariance, dof = solution.covariance_noise, y.size - columns.shape[1]
    residual_sd: float | Array
    if row_sd is None:
        if dof < 1:
            raise NotIdentifiableError(
                f"{y.size} observations of {columns.shape[1]} unknowns leave no degrees of "
                "freedom to estimate sigma; give sigma"
            )
        residual_sd = math.sqrt(solution.chi2 / dof)
        covariance = covariance * (solution.chi2 / dof)
    else:
        residual_sd = float(row_sd) if row_sd.ndim == 0 else row_sd
    return Fit(
        estimate=solution.estimate,
        covariance=covariance,
        residuals=y - columns @ solution.estimate,
        chi2=solution.chi2,
        dof=dof,
        sigma=residual_sd,
        sigma_from_residuals=row_sd is None,
    )
