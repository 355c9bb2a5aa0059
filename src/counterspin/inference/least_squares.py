"""Linear least squares that keeps apart what each part of the uncertainty comes from.

Given the trajectory, the displacement error is linear in the coefficients, so that one solver
serves everything: the two stages of the paper, the joint fit of full records, planning and
Monte-Carlo studies. However long a record is, what it says about p unknowns fits into p rows of
square-root information (Bierman 1977): a small `Block`, from which the record's own start offset
and start velocity are projected out. Any set of blocks is solved together with what is known
beforehand; `fit` is the fit of one set of observations alone.

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

_CHUNK: Final = 32 * QR_BLOCK_ROWS  #: rows copied at a time, which bounds the memory
_COLUMNS: Final = 256  #: columns projected at a time, which bounds the memory


@frozen
class Block:
    """Information of one record on the shared unknowns, in rotated rows of unit variance.

    ``target = factor @ unknowns + considered @ considered_values + noise``.
    """

    factor: Array  #: Upper trapezoidal, shape (k, p), k <= p + q.
    target: Array  #: Shape (k,).
    considered: Array  #: The columns of the considered terms in the same rows, shape (k, q).
    #: Sum of squares that neither unknowns, nor considered terms, nor nuisances can explain.
    rss: float
    #: Number of observations and of the record's own unknowns that were projected out.
    rows: int
    nuisance: int

    def scaled(self, ratio: float) -> Block:
        """Return the block of rows that weigh more by a factor."""
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
    groups = [
        np.empty((n, 0)) if columns is None else np.asarray(columns, dtype=np.float64)
        for columns in (nuisance, design, considered)
    ]
    if y.ndim != 1 or any(columns.ndim != 2 or columns.shape[0] != n for columns in groups):
        shapes = ", ".join(str(columns.shape) for columns in groups)
        raise ValueError(
            f"nuisance, design and considered must each have {n} rows, the number of "
            f"observations, but the shapes are {shapes}"
        )
    return reduce_rows(np.column_stack([*groups, y]), groups[0].shape[1], groups[1].shape[1])


def reduce_rows(rows: Array, m: int, p: int) -> Block:
    """Reduce a record as `reduce_block`, its columns beside each other already.

    rows: [nuisance | design | considered | observations], shape (n, m + p + q + 1).
    """
    n, q = rows.shape[0], rows.shape[1] - m - p - 1
    triangle = np.empty((0, m + p + q + 1))
    for start in range(0, n, _CHUNK):
        triangle = triangular_factor(np.vstack([triangle, qr_blocks(rows[start : start + _CHUNK])]))
    if not np.isfinite(triangle).all():
        raise ValueError("the columns or the observations contain numbers that are not finite")

    nuisance_triangle = triangle[:m, :m]
    if dependent_columns(nuisance_triangle).size:
        raise NotIdentifiableError(
            f"{n} samples cannot separate the {m} unknowns of the record itself (such as its "
            "initial offset and initial velocity); the record is too short"
        )
    kept_rows = triangle[m : m + p + q]
    return Block(
        factor=kept_rows[:, m : m + p],
        target=kept_rows[:, -1],
        considered=kept_rows[:, m + p : m + p + q],
        rss=float(np.sum(triangle[m + p + q :, -1] ** 2)),
        rows=n,
        nuisance=m,
    )


def dependent_columns(triangle: Array) -> npt.NDArray[np.intp]:
    """Return the columns of a triangular factor that depend on those before them, to rounding."""
    norms = np.linalg.norm(triangle, axis=0)
    diagonal = np.zeros_like(norms)  # a column beyond the last row depends on the others
    diagonal[: triangle.shape[0]] = np.abs(np.diagonal(triangle))
    return np.flatnonzero(diagonal <= 4.0 * norms.size * np.finfo(np.float64).eps * norms)


# Blocks together -------------------------------------------------------------------------------

#: Value and standard uncertainty of what nothing is known of beforehand.
NO_PRIOR: Final = (0.0, math.inf)


#: The numerical regularisation of an unknown without a prior, in units of its credible limit.
#: At least a factor of 1e4 above what anybody believes, it moves no determined estimate by more
#: than 1e-8 of its uncertainty, and it keeps every estimate finite.
REGULARISATION: Final = 1e4


@frozen
class Combination:
    """A linear combination of the unknowns and where its uncertainty comes from."""

    value: float  #: The estimate of the combination.
    noise: float  #: Standard uncertainty from the records' noise.
    #: Signed contribution of each row of the stacked blocks; `noise` is their norm.
    noise_rows: Array
    #: Signed contribution of each unknown's prior (sensitivity x its sd), shape (p,); of correlated
    #: priors, of each row of `whiten_priors`.
    prior: Array
    considered: Array  #: Signed contribution of each considered term, shape (q,).
    #: What only the numerical regularisation holds; negligible for all that is determined.
    unresolved: float
    undetected: float = 0.0  #: Standard uncertainty from noise that the records do not show.

    @property
    def u(self) -> float:
        """The combined standard uncertainty."""
        return math.hypot(
            self.noise, self.undetected, self.unresolved, *self.prior, *self.considered
        )


@frozen
class _Rows:
    """The factorised problem, rotation @ triangle, kept for `Solution.combine`."""

    free: npt.NDArray[np.intp]  # the unknowns that are not exactly known, f of p
    rotation: Array  # (rows, f): first the data's rows, then the priors', then the regularisation's
    triangle: Array  # (f, f)
    data: int
    prior_of: npt.NDArray[np.intp]  # the unknown that each prior row holds
    considered: Array  # (data, q)
    noise: Array | float = 1.0  # standard deviations of the data's rows, (data,)


@frozen
class Solution:
    """The estimate, its uncertainty by source, and how well the model fits.

    p unknowns, q considered terms; units are those of the unknowns throughout.
    """

    estimate: Array  #: Shape (p,). An unknown known exactly (prior sd 0) has its prior mean.
    #: What noise, priors and considered terms contribute, each of shape (p, p).
    covariance_noise: Array
    covariance_prior: Array
    covariance_considered: Array
    #: What only the numerical regularisation holds, shape (p, p): 1e-16 of the variance or less for
    #: a determined unknown, about (1e4 limits)^2 for one that the data do not determine. Whether an
    #: unknown is determined is decided by `identifiability.assess`.
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
    _rows: _Rows
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

        Considered terms and noise that does not show have no part in the weights.
        """
        return self.covariance_noise + self.covariance_prior + self.covariance_unresolved

    @property
    def u(self) -> Array:
        """The combined standard uncertainties, shape (p,)."""
        return np.sqrt(np.diag(self.covariance))

    def whiten_priors(self, columns: Array) -> Array:
        """Return deviations from prior means in the rows of the priors, shape (p, c).

        Rows of unknowns without a prior, or that are exactly known, are zero.

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
        """Leverage of each of the blocks' stacked rows: 0 none, 1 full.

        A row's residual has one minus this for its expected square, priors being right.
        """
        rotation: Array = self._rows.rotation[: self._rows.data]
        leverages: Array = np.sum(rotation**2, axis=1)
        return leverages

    def with_row_noise(self, noise: Array) -> Solution:
        """Return the same estimates where the data's rows are not of the variance assumed.

        noise: Standard deviations of the blocks' stacked rows, shape (n,); 1 as assumed.
        """
        rows = self._rows
        gain = np.linalg.solve(rows.triangle, rows.rotation[: rows.data].T) * noise
        return replace(
            self,
            covariance_noise=_embed(gain, rows.free, self.estimate.size),
            _rows=replace(rows, noise=noise),
        )

    def covariance_root(self, rows: Array) -> Array:
        """Return G with G @ G.T the `weighted_covariance` of rows @ unknowns, shape (n, f).

        From the factors, for the reason that `combine` gives.

        rows: Shape (n, p).
        """
        free = self._rows.free
        return np.asarray(np.linalg.solve(self._rows.triangle.T, rows[:, free].T).T, np.float64)

    def whiten_unknowns(self, unknowns: Array) -> Array:
        """Return values of the unknowns in rows in which `weighted_covariance` is one, shape (f,).

        unknowns: Shape (p,); those that are exactly known are left out.
        """
        return np.asarray(self._rows.triangle @ unknowns[self._rows.free])

    def project_out(self, data: Array, priors: Array) -> Array:
        """Return the part of additional columns that no value of the unknowns explains.

        data: In the blocks' stacked rows, shape (n, c).
        priors: In the rows of the priors as `whiten_priors` returns them, shape (p, c); only rows
        that have one count, and none that is known exactly.
        Returns: shape (rows, c), first the blocks' rows; orthogonal to the columns of the problem.
        """
        stacked, rotation = self._stack_rows(data, priors), self._rows.rotation
        # Twice: what rounding leaves of the first projection matters where little is left.
        for start in range(0, stacked.shape[1], _COLUMNS):
            columns = stacked[:, start : start + _COLUMNS]
            for _ in range(2):
                columns -= rotation @ (rotation.T @ columns)
        return stacked

    def undetected_shifts(self, data: Array, priors: Array) -> Array:
        """Return by how much the unknowns move, shape (p, c), where columns go unnoticed.

        The shifts are what `project_out` leaves; the arguments are the same.
        """
        rows = self._rows
        shifts = np.zeros((self.estimate.size, data.shape[1]))
        stacked = self._stack_rows(data, priors)
        shifts[rows.free] = np.linalg.solve(rows.triangle, rows.rotation.T @ stacked)
        return shifts

    def _stack_rows(self, data: Array, priors: Array) -> Array:
        """Return columns in all rows: of the blocks, the priors and the unknowns that are held."""
        rows = self._rows
        stacked = np.zeros((data.shape[1], rows.rotation.shape[0])).T  # columns in one piece
        stacked[: rows.data] = data
        stacked[rows.data : rows.data + rows.prior_of.size] = priors[rows.prior_of]
        return stacked

    def combine(self, weights: npt.ArrayLike) -> Combination:
        """Return a linear combination of the unknowns, its uncertainty split by source.

        Worked out from the factors: the sum of two unknowns that are undetermined one by one may
        be known a billion times better than either, and would be lost in the covariance matrix.

        weights: Shape (p,).
        """
        c = np.asarray(weights, dtype=np.float64)
        rows = self._rows
        gain = rows.rotation @ np.linalg.solve(rows.triangle.T, c[rows.free])
        data = gain[: rows.data]
        noise = data * rows.noise
        prior_end = rows.data + rows.prior_of.size
        prior = np.zeros(c.size)
        prior[rows.prior_of] = gain[rows.data : prior_end]
        return Combination(
            value=float(c @ self.estimate),
            noise=float(np.linalg.norm(noise)),
            noise_rows=noise,
            prior=prior,
            considered=-(data @ rows.considered) * self.considered_sd,
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
    """Estimate the shared unknowns from all blocks and from what is known beforehand.

    Considered terms (Schmidt) are not estimated: their assumed values are taken, and their
    uncertainty times the estimate's sensitivity enters the covariance. Leaving one block out is
    solving without it.

    prior_mean: Shape (p,), zeros by default. Without a prior, the centre of the regularisation.
    prior_sd: Standard uncertainties, shape (p,). ``inf`` (the default): no prior; 0: exactly known.
    prior_correlation: Of the priors, positive definite, shape (p, p); None: independent.
    considered_mean, considered_sd: Shape (q,); zeros by default.
    limits: The unknowns' largest credible sizes, shape (p,). Each unknown without a prior is held
        numerically at `REGULARISATION` times its limit, so that collinear columns do no harm. None:
        no regularisation.
    References: Bierman, Factorization Methods for Discrete Sequential Estimation, 1977, chapters V
        and VIII (square-root information, considered parameters).
    """
    if not blocks:
        raise ValueError("no blocks of observations were given")
    factor = np.vstack([block.factor for block in blocks])
    considered = np.vstack([block.considered for block in blocks])
    p, q = factor.shape[1], considered.shape[1]
    mean = _vector("prior_mean", prior_mean, p, 0.0)
    sd = _vector("prior_sd", prior_sd, p, np.inf)
    c_mean = _vector("considered_mean", considered_mean, q, 0.0)
    c_sd = _vector("considered_sd", considered_sd, q, 0.0)
    if (sd < 0).any() or (c_sd < 0).any() or not np.isfinite(c_sd).all():
        raise ValueError(
            "prior_sd must not be negative; considered_sd must be finite and not negative"
        )
    bound = None if limits is None else _vector("limits", limits, p, 0.0)
    if bound is not None and not ((bound > 0) & np.isfinite(bound)).all():
        raise ValueError("limits must be positive and finite")

    free = np.flatnonzero(sd > 0)
    known = np.flatnonzero(np.isfinite(sd[free]))  # positions among the free ones
    unbounded = np.flatnonzero(np.isinf(sd[free])) if bound is not None else np.empty(0, np.intp)
    priors = free[known]
    correlation = None if prior_correlation is None else prior_correlation[np.ix_(priors, priors)]
    weight_prior = whiten_priors(np.eye(known.size), sd[priors], correlation)
    weight_regularisation = (
        np.empty(0) if bound is None else 1.0 / (REGULARISATION * bound[free][unbounded])
    )
    eye = np.eye(free.size)
    prior_rows = np.zeros((known.size, free.size))
    prior_rows[:, known] = weight_prior
    stacked = np.vstack(
        [
            factor[:, free],
            prior_rows,
            weight_regularisation[:, None] * eye[unbounded],
        ]
    )
    # All unknowns are counted from their prior means, so that the added rows aim at zero.
    misfit = np.concatenate([block.target for block in blocks])
    misfit = misfit - considered @ c_mean - factor @ mean
    rotation, triangle = _factorise(stacked)
    weak = dependent_columns(triangle)
    if bound is None and weak.size:
        index = int(free[weak[0]])
        raise NotIdentifiableError(
            f"column {index + 1} of the design matrix is a linear combination of the preceding "
            "columns, so the data cannot separate these unknowns; omit one of them or give a prior"
        )
    data, prior_end = factor.shape[0], factor.shape[0] + known.size
    inverse = np.linalg.solve(triangle, eye)
    gain = inverse @ rotation.T
    step = np.linalg.solve(triangle, rotation[:data].T @ misfit)

    estimate = mean.copy()
    estimate[free] += step
    # An unknown that is exactly known acts like a considered term without uncertainty.
    sensitivity_prior = np.diag((sd == 0).astype(np.float64))
    sensitivity_prior[np.ix_(free, sd == 0)] = -gain[:, :data] @ factor[:, sd == 0]
    prior_gain = gain[:, data:prior_end]
    sensitivity_prior[np.ix_(free, priors)] = (
        prior_gain * np.diag(weight_prior) if correlation is None else prior_gain @ weight_prior
    )
    sensitivity_considered = np.zeros((p, q))
    sensitivity_considered[free] = -gain[:, :data] @ considered

    residual = misfit - factor[:, free] @ step
    chi2 = sum(block.rss for block in blocks) + residual @ residual
    chi2 += np.sum((prior_rows @ step) ** 2)
    dof = sum(block.rows - block.nuisance for block in blocks) + known.size - free.size
    spread = sensitivity_considered * c_sd
    return Solution(
        estimate=estimate,
        covariance_noise=_embed(gain[:, :data], free, p),
        covariance_prior=_embed(gain[:, data:prior_end], free, p),
        covariance_considered=spread @ spread.T,
        covariance_unresolved=_embed(gain[:, prior_end:], free, p),
        sensitivity_prior=sensitivity_prior,
        sensitivity_considered=sensitivity_considered,
        chi2=float(chi2),
        dof=float(dof + np.sum(rotation[prior_end:] ** 2)),
        information=triangular_factor(factor),
        prior_mean=mean,
        prior_sd=sd,
        considered_sd=c_sd,
        limits=bound,
        prior_correlation=prior_correlation,
        _rows=_Rows(free, rotation, triangle, data, priors, considered),
    )


def _factorise(rows: Array) -> tuple[Array, Array]:
    """QR with the heaviest rows first, which Householder needs when rows differ much in size."""
    norms = np.linalg.norm(rows, axis=0)
    heavy = np.max(np.abs(rows) / np.where(norms > 0, norms, 1.0), axis=1, initial=0.0)
    order = np.argsort(-heavy, kind="stable")
    sorted_rotation, triangle = np.linalg.qr(rows[order])
    rotation = np.empty_like(sorted_rotation)
    rotation[order] = sorted_rotation
    return rotation, triangle


def _vector(name: str, values: npt.ArrayLike | None, size: int, default: float) -> Array:
    """Return a checked vector of ``size``, or ``default`` throughout where none is given."""
    if values is None:
        return np.full(size, default)
    vector = np.asarray(values, dtype=np.float64)
    if vector.shape != (size,) or np.isnan(vector).any():
        raise ValueError(
            f"{name} must contain {size} numbers; it has the shape {vector.shape} or contains NaN"
        )
    return vector


def _embed(gain: Array, free: npt.NDArray[np.intp], length: int) -> Array:
    """Covariance of unit-variance rows under ``gain``, among all ``size`` unknowns."""
    covariance = np.zeros((length, length))
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
    #: The standard deviation of one observation, as given or from the residuals; an array where it
    #: was given as one.
    sigma: float | Array
    sigma_from_residuals: bool  #: Whether sigma was estimated, so that intervals need Student's t.

    @property
    def u(self) -> Array:
        """The standard uncertainties, shape (p,)."""
        return np.sqrt(np.diag(self.covariance))


def fit(
    design: npt.ArrayLike,
    observations: npt.ArrayLike,
    sigma: float | npt.ArrayLike | None = None,
) -> Fit:
    """Fit one set of observations by (weighted) least squares.

    design: Shape (n, p).
    observations: Shape (n,).
    sigma: Standard deviation of each observation, one number or shape (n,). None: the same unknown
        one for all, estimated from the residuals, which the result says.
    """
    columns = np.asarray(design, dtype=np.float64)
    y = np.asarray(observations, dtype=np.float64)
    given = None if sigma is None else np.asarray(sigma, dtype=np.float64)
    weight = np.ones(()) if given is None else given
    if weight.shape not in {(), y.shape} or not ((weight > 0) & np.isfinite(weight)).all():
        raise ValueError("sigma must be positive: a single number, or one per observation")
    solution = solve([reduce_block(columns / weight.reshape(-1, 1), y / weight)])
    covariance, dof = solution.covariance_noise, y.size - columns.shape[1]
    scale: float | Array
    if given is None:
        if dof < 1:
            raise NotIdentifiableError(
                f"{y.size} observations of {columns.shape[1]} unknowns leave no degrees of "
                "freedom to estimate sigma; give sigma"
            )
        scale = math.sqrt(solution.chi2 / dof)
        covariance = covariance * (solution.chi2 / dof)
    else:
        scale = float(given) if given.ndim == 0 else given
    return Fit(
        estimate=solution.estimate,
        covariance=covariance,
        residuals=y - columns @ solution.estimate,
        chi2=solution.chi2,
        dof=dof,
        sigma=scale,
        sigma_from_residuals=given is None,
    )
