"""Linear least squares that keeps apart what each part of the uncertainty comes from.

Given the trajectory, the displacement error is linear in the coefficients, so that one solver
serves everything: the two stages of the paper, the joint fit of full records, planning and
Monte-Carlo studies. A record is first reduced to a small `Block` (its square-root information
about the shared unknowns, Bierman 1977), in which the record's own start offset and start
velocity are already projected out; then any set of blocks is solved together with what is known
beforehand.

No Gram matrix is ever formed. Householder QR has a backward error that is small column by column
(Higham, Accuracy and Stability of Numerical Algorithms, 2nd ed., theorem 19.4), so that columns
of very different size, such as t^2/2 beside cos wt, need no scaling before it.

- `reduce_block`: a whitened record -> `Block`
- `solve`: blocks + priors + considered terms -> `Solution`
- `fit`: a plain one-block problem with a stated or an unstated sigma -> `Fit`
- `triangle_of`: R of a QR factorisation
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.linalg import solve_triangular

from counterspin.errors import NotIdentifiableError

Array = npt.NDArray[np.float64]

#: Rows that one QR takes at a time: a cache's worth, three times faster than all rows at once.
_CHUNK: Final = 1024

#: The numerical regularisation of an unknown without a prior, in units of its credible limit.
#: At least a factor of 1e4 above what anybody believes, it moves no determined estimate by more
#: than 1e-8 of its uncertainty, and it keeps every estimate finite.
REGULARISATION: Final = 1e4


@dataclass(frozen=True)
class Block:
    """What one record says about the shared unknowns, in rotated rows of unit variance.

    ``target = factor @ unknowns + considered @ considered_values + noise``.

    Attributes
    ----------
    factor
        Upper trapezoidal, shape (k, p), k <= p + q.
    target
        Shape (k,).
    considered
        The columns of the considered terms in the same rows, shape (k, q).
    rss
        Sum of squares that neither unknowns, nor considered terms, nor nuisances can explain.
    rows, nuisance
        Number of observations and of the record's own unknowns that were projected out.
    """

    factor: Array
    target: Array
    considered: Array
    rss: float
    rows: int
    nuisance: int


def reduce_block(
    design: npt.ArrayLike,
    observations: npt.ArrayLike,
    nuisance: npt.ArrayLike | None = None,
    considered: npt.ArrayLike | None = None,
) -> Block:
    """Reduce one record to its square-root information about the shared unknowns.

    One QR of [nuisance | design | considered | observations]; the rows that belong to the
    nuisances are dropped, which is the exact projection.

    Parameters
    ----------
    design
        Columns of the unknowns, whitened (unit variance, uncorrelated), shape (n, p).
    observations
        Whitened observations, shape (n,).
    nuisance
        Columns of the record's own unknowns, whitened, shape (n, m); none by default.
    considered
        Columns of the considered terms, whitened, shape (n, q); none by default.

    Returns
    -------
    Block

    Raises
    ------
    ValueError
        If the numbers of rows differ or a number is not finite.
    NotIdentifiableError
        If the nuisances cannot be told apart from each other.
    """
    y = np.asarray(observations, dtype=np.float64)
    n = y.size
    parts = [
        np.empty((n, 0)) if part is None else np.asarray(part, dtype=np.float64)
        for part in (nuisance, design, considered)
    ]
    if y.ndim != 1 or any(part.ndim != 2 or part.shape[0] != n for part in parts):
        shapes = ", ".join(str(part.shape) for part in parts)
        raise ValueError(
            f"nuisance, design and considered need the {n} rows of the observations; "
            f"their shapes are {shapes}"
        )
    m, p, q = (part.shape[1] for part in parts)

    triangle = np.empty((0, m + p + q + 1))
    for start in range(0, n, _CHUNK):
        rows = slice(start, start + _CHUNK)
        chunk = np.column_stack([part[rows] for part in parts] + [y[rows]])
        triangle = triangle_of(np.vstack([triangle, chunk]))
    if not np.isfinite(triangle).all():
        raise ValueError("the columns or the observations hold numbers that are not finite")

    own = triangle[:m, :m]
    if _dependent(own).size:
        raise NotIdentifiableError(
            f"{n} samples cannot tell the {m} unknowns of the record itself (such as its start "
            "offset and start velocity) apart; the record is too short"
        )
    kept = triangle[m : m + p + q]
    return Block(
        factor=kept[:, m : m + p],
        target=kept[:, -1],
        considered=kept[:, m + p : m + p + q],
        rss=float(np.sum(triangle[m + p + q :, -1] ** 2)),
        rows=n,
        nuisance=m,
    )


@dataclass(frozen=True)
class Combination:
    """A linear combination of the unknowns and where its uncertainty comes from.

    Attributes
    ----------
    value
        The estimate of the combination.
    noise
        Standard uncertainty from the records' noise.
    noise_rows
        Signed contribution of each row of the stacked blocks; `noise` is their norm.
    prior
        Signed contribution of each unknown's prior (sensitivity x its sd), shape (p,).
    considered
        Signed contribution of each considered term, shape (q,).
    unresolved
        What only the numerical regularisation holds; negligible for all that is determined.
    """

    value: float
    noise: float
    noise_rows: Array
    prior: Array
    considered: Array
    unresolved: float

    @property
    def u(self) -> float:
        """The combined standard uncertainty."""
        return math.hypot(self.noise, self.unresolved, *self.prior, *self.considered)


@dataclass(frozen=True)
class _Rows:
    """The factorised problem, rotation @ triangle, kept for `Solution.combine`."""

    free: npt.NDArray[np.intp]  # the unknowns that are not exactly known, f of p
    rotation: Array  # (rows, f): first the data's rows, then the priors', then the regularisation's
    triangle: Array  # (f, f)
    data: int
    prior_of: npt.NDArray[np.intp]  # the unknown that each prior row holds
    considered: Array  # (data, q)


@dataclass(frozen=True)
class Solution:
    """The estimate, its uncertainty by source, and how well the model fits.

    p unknowns, q considered terms; units are those of the unknowns throughout.

    Attributes
    ----------
    estimate
        Shape (p,). An unknown known exactly (prior sd 0) has its prior mean.
    covariance_noise, covariance_prior, covariance_considered
        What noise, priors and considered terms contribute, each of shape (p, p).
    covariance_unresolved
        What only the numerical regularisation holds, shape (p, p): 1e-16 of the variance or less
        for a determined unknown, about (1e4 limits)^2 for one that the data do not determine.
        Whether an unknown is determined is decided by `identifiability.assess`.
    sensitivity_prior
        d estimate / d prior mean, shape (p, p); zero columns for unknowns without a prior.
    sensitivity_considered
        d estimate / d assumed value of the considered terms, shape (p, q).
    chi2
        Weighted sum of squares of the data's residuals and of the priors' misfits.
    dof
        rows - nuisances + priors - unknowns, where exactly known unknowns do not count and those
        held by the regularisation count only as far as the data determine them.
    information
        The data's own square-root information, without priors, shape (k, p).
    prior_mean, prior_sd, considered_sd, limits
        As given to `solve`; limits is None where there was no regularisation.
    """

    estimate: Array
    covariance_noise: Array
    covariance_prior: Array
    covariance_considered: Array
    covariance_unresolved: Array
    sensitivity_prior: Array
    sensitivity_considered: Array
    chi2: float
    dof: float
    information: Array
    prior_mean: Array
    prior_sd: Array
    considered_sd: Array
    limits: Array | None
    _rows: _Rows

    @property
    def covariance(self) -> Array:
        """The combined covariance, shape (p, p)."""
        return (
            self.covariance_noise
            + self.covariance_prior
            + self.covariance_considered
            + self.covariance_unresolved
        )

    @property
    def u(self) -> Array:
        """The combined standard uncertainties, shape (p,)."""
        return np.sqrt(np.diag(self.covariance))

    def combine(self, weights: npt.ArrayLike) -> Combination:
        """Return a linear combination of the unknowns, its uncertainty split by source.

        Worked out from the factors: the sum of two unknowns that are undetermined one by one may
        be known a billion times better than either, and would be lost in the covariance matrix.

        Parameters
        ----------
        weights
            Shape (p,).
        """
        c = np.asarray(weights, dtype=np.float64)
        rows = self._rows
        gain = rows.rotation @ solve_triangular(rows.triangle, c[rows.free], trans="T")
        data = gain[: rows.data]
        after = rows.data + rows.prior_of.size
        prior = np.zeros(c.size)
        prior[rows.prior_of] = gain[rows.data : after]
        return Combination(
            value=float(c @ self.estimate),
            noise=float(np.linalg.norm(data)),
            noise_rows=data,
            prior=prior,
            considered=-(data @ rows.considered) * self.considered_sd,
            unresolved=float(np.linalg.norm(gain[after:])),
        )


def solve(
    blocks: Sequence[Block],
    *,
    prior_mean: npt.ArrayLike | None = None,
    prior_sd: npt.ArrayLike | None = None,
    considered_mean: npt.ArrayLike | None = None,
    considered_sd: npt.ArrayLike | None = None,
    limits: npt.ArrayLike | None = None,
) -> Solution:
    """Estimate the shared unknowns from all blocks and from what is known beforehand.

    Considered terms (Schmidt) are not estimated: their assumed values are taken, and their
    uncertainty times the estimate's sensitivity enters the covariance. Leaving one block out is
    solving without it.

    Parameters
    ----------
    blocks
        At least one; all of the same p unknowns and q considered terms.
    prior_mean
        Shape (p,), zeros by default. Without a prior, the centre of the regularisation.
    prior_sd
        Standard uncertainties, shape (p,). ``inf`` (the default): no prior; 0: exactly known.
    considered_mean, considered_sd
        Shape (q,); zeros by default.
    limits
        The unknowns' largest credible sizes, shape (p,). Each unknown without a prior is held
        numerically at `REGULARISATION` times its limit, so that collinear columns do no harm.
        None: no regularisation.

    Returns
    -------
    Solution

    Raises
    ------
    ValueError
        If a shape does not fit, or an uncertainty or limit has an impossible value.
    NotIdentifiableError
        If columns are linearly dependent and there are no limits to hold them.

    References
    ----------
    Bierman, Factorization Methods for Discrete Sequential Estimation, 1977, chapters V and VIII
    (square-root information, considered parameters).
    """
    if not blocks:
        raise ValueError("there is no block to solve")
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
    held = np.flatnonzero(np.isinf(sd[free])) if bound is not None else np.empty(0, np.intp)
    weight_prior = 1.0 / sd[free][known]
    weight_held = np.empty(0) if bound is None else 1.0 / (REGULARISATION * bound[free][held])
    eye = np.eye(free.size)
    stacked = np.vstack(
        [factor[:, free], weight_prior[:, None] * eye[known], weight_held[:, None] * eye[held]]
    )
    # All unknowns are counted from their prior means, so that the added rows aim at zero.
    misfit = np.concatenate([block.target for block in blocks])
    misfit = misfit - considered @ c_mean - factor @ mean
    rotation, triangle = _factorise(stacked)
    weak = _dependent(triangle)
    if bound is None and weak.size:
        which = int(free[weak[0]])
        raise NotIdentifiableError(
            f"column {which + 1} of the design is a combination of the columns before it, so "
            "that the data cannot tell these unknowns apart; leave one out or give a prior"
        )
    data, after = factor.shape[0], factor.shape[0] + known.size
    inverse = solve_triangular(triangle, eye)
    gain = inverse @ rotation.T
    step = solve_triangular(triangle, rotation[:data].T @ misfit)

    estimate = mean.copy()
    estimate[free] += step
    # An unknown that is exactly known acts like a considered term without uncertainty.
    sensitivity_prior = np.diag((sd == 0).astype(np.float64))
    sensitivity_prior[np.ix_(free, sd == 0)] = -gain[:, :data] @ factor[:, sd == 0]
    sensitivity_prior[np.ix_(free, free[known])] = gain[:, data:after] * weight_prior
    sensitivity_considered = np.zeros((p, q))
    sensitivity_considered[free] = -gain[:, :data] @ considered

    residual = misfit - factor[:, free] @ step
    chi2 = sum(block.rss for block in blocks) + residual @ residual
    chi2 += np.sum((weight_prior * step[known]) ** 2)
    dof = sum(block.rows - block.nuisance for block in blocks) + known.size - free.size
    spread = sensitivity_considered * c_sd
    return Solution(
        estimate=estimate,
        covariance_noise=_embed(gain[:, :data], free, p),
        covariance_prior=_embed(gain[:, data:after], free, p),
        covariance_considered=spread @ spread.T,
        covariance_unresolved=_embed(gain[:, after:], free, p),
        sensitivity_prior=sensitivity_prior,
        sensitivity_considered=sensitivity_considered,
        chi2=float(chi2),
        dof=float(dof + np.sum(rotation[after:] ** 2)),
        information=triangle_of(factor),
        prior_mean=mean,
        prior_sd=sd,
        considered_sd=c_sd,
        limits=bound,
        _rows=_Rows(free, rotation, triangle, data, free[known], considered),
    )


@dataclass(frozen=True)
class Fit:
    """A plain least-squares fit.

    Attributes
    ----------
    estimate
        Shape (p,).
    covariance
        Shape (p, p).
    residuals
        observations - design @ estimate, in the units of the observations, shape (n,).
    chi2
        Weighted sum of squared residuals; with sigma from the residuals, plain sum of squares.
    dof
        n - p.
    sigma
        The standard deviation of one observation, as given or from the residuals; an array where
        it was given as one.
    sigma_from_residuals
        Whether sigma was estimated, so that intervals need Student's t.
    """

    estimate: Array
    covariance: Array
    residuals: Array
    chi2: float
    dof: int
    sigma: float | Array
    sigma_from_residuals: bool

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

    Parameters
    ----------
    design
        Shape (n, p).
    observations
        Shape (n,).
    sigma
        Standard deviation of each observation, one number or shape (n,). None: the same unknown
        one for all, estimated from the residuals, which the result says.

    Returns
    -------
    Fit

    Raises
    ------
    ValueError
        If shapes do not fit or sigma is not positive.
    NotIdentifiableError
        If columns are linearly dependent, or sigma is asked of as many unknowns as observations.
    """
    columns = np.asarray(design, dtype=np.float64)
    y = np.asarray(observations, dtype=np.float64)
    given = None if sigma is None else np.asarray(sigma, dtype=np.float64)
    weight = np.ones(()) if given is None else given
    if weight.shape not in {(), y.shape} or not ((weight > 0) & np.isfinite(weight)).all():
        raise ValueError("sigma must be positive: one number, or one for each observation")
    solution = solve([reduce_block(columns / weight.reshape(-1, 1), y / weight)])
    covariance, dof = solution.covariance_noise, y.size - columns.shape[1]
    scale: float | Array
    if given is None:
        if dof < 1:
            raise NotIdentifiableError(
                f"{y.size} observations of {columns.shape[1]} unknowns leave nothing to estimate "
                "sigma from; give sigma"
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


def triangle_of(matrix: Array) -> Array:
    """Return R of the QR factorisation, shape (min(n, p), p); also of a stack of matrices."""
    return np.asarray(np.linalg.qr(matrix, mode="r"))


def _factorise(stacked: Array) -> tuple[Array, Array]:
    """QR with the heaviest rows first, which Householder needs when rows differ much in size."""
    norms = np.linalg.norm(stacked, axis=0)
    heavy = np.max(np.abs(stacked) / np.where(norms > 0, norms, 1.0), axis=1, initial=0.0)
    order = np.argsort(-heavy, kind="stable")
    sorted_rotation, triangle = np.linalg.qr(stacked[order])
    rotation = np.empty_like(sorted_rotation)
    rotation[order] = sorted_rotation
    return rotation, triangle


def _dependent(triangle: Array) -> npt.NDArray[np.intp]:
    """Columns of a triangular factor that depend on those before them, to rounding."""
    norms = np.linalg.norm(triangle, axis=0)
    diagonal = np.zeros_like(norms)  # a column beyond the last row depends on the others
    diagonal[: triangle.shape[0]] = np.abs(np.diagonal(triangle))
    return np.flatnonzero(diagonal <= 4.0 * norms.size * np.finfo(np.float64).eps * norms)


def _vector(name: str, given: npt.ArrayLike | None, size: int, default: float) -> Array:
    """Return a checked vector of ``size``, or ``default`` throughout where none is given."""
    if given is None:
        return np.full(size, default)
    vector = np.asarray(given, dtype=np.float64)
    if vector.shape != (size,) or np.isnan(vector).any():
        raise ValueError(f"{name} needs {size} numbers; it has shape {vector.shape} or holds NaN")
    return vector


def _embed(gain: Array, free: npt.NDArray[np.intp], size: int) -> Array:
    """Covariance of unit-variance rows under ``gain``, among all ``size`` unknowns."""
    covariance = np.zeros((size, size))
    covariance[np.ix_(free, free)] = gain @ gain.T
    return covariance
