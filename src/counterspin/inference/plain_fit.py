"""A plain least-squares fit, with a stated sigma or one from the residuals."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array
from counterspin.errors import NotIdentifiableError
from counterspin.frozen import frozen
from counterspin.inference.blocks import reduce_block
from counterspin.inference.least_squares import solve


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
        raise ValueError("sigma must be positive: one number, or one for each observation")
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
