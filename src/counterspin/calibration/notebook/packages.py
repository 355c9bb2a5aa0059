"""Values for other packages of metrology, with their correlations.

- `to_uncertainties`: of E. O. Lebigot's uncertainties; `to_gtc`: of GTC (MSL New Zealand)

Neither is a requirement; each says so where it is missing.
"""

from __future__ import annotations

import math
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from counterspin.errors import CounterspinError

if TYPE_CHECKING:
    from counterspin.calibration.result import Result


def _package(name: str, distribution: str) -> Any:
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        raise CounterspinError(
            f"{distribution} is not installed: `pip install {distribution}`"
        ) from error


def to_uncertainties(result: Result) -> dict[str, Any]:
    """Return the determined coefficients as ``uncertainties`` variables, by name (``Qx.K_II``).

    Raises
    ------
    CounterspinError
        If the package is not installed, or the result states no correlations.
    """
    package = _package("uncertainties", "uncertainties")
    covariance = result.stated_covariance()
    values = [result.coefficient(name).value for name in covariance.terms]
    numbers = package.correlated_values(values, covariance.matrix, tags=covariance.terms)
    return dict(zip(covariance.terms, numbers, strict=True))


def to_gtc(result: Result) -> dict[str, Any]:
    """Return the determined coefficients as GTC's uncertain numbers, by name (``Qx.K_II``).

    They form one ensemble, since their correlations come from the same records; GTC gives an
    ensemble one number of degrees of freedom, here the smallest of the coefficients'.

    Raises
    ------
    CounterspinError
        If the package is not installed, or the result states no correlations.
    """
    package = _package("GTC", "GTC")
    covariance = result.stated_covariance()
    found = [result.coefficient(name) for name in covariance.terms]
    u = np.sqrt(np.diag(covariance.matrix))
    # GTC knows no fewer degrees of freedom than 1.
    freedom = max(1.0, min((c.dof for c in found if c.dof is not None), default=math.inf))
    values = [c.value for c in found]
    numbers = package.multiple_ureal(values, u.tolist(), freedom, list(covariance.terms))
    for row in range(len(found)):
        for column in range(row):
            r = covariance.matrix[row, column] / (u[row] * u[column])
            if r:
                package.set_correlation(float(np.clip(r, -1.0, 1.0)), numbers[row], numbers[column])
    return dict(zip(covariance.terms, numbers, strict=True))
