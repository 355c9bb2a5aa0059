"""Coverage factors of intervals and regions, for 95 % coverage."""

from __future__ import annotations

import math
from typing import Final

from counterspin.inference.conformity import COVERAGE, expanded_uncertainty

#: Decimals of a factor as stated and used, so that U/k is the standard uncertainty to the last
#: digit; rounding changes the coverage by less than 1e-5.
_FACTOR_DECIMALS: Final = 4


def coverage_factor(dof: float | None) -> float:
    """Return k of the interval value ± k u for degrees of freedom, None being infinite."""
    return round(expanded_uncertainty(1.0, dof, COVERAGE), _FACTOR_DECIMALS)


def region_factor(size: int, dof: float | None) -> float:
    """Return k of the region d' V^-1 d <= k^2 of so many quantities with covariance V.

    dof: Degrees of freedom of the common scale of V; None is infinite.
    """
    from scipy.special import chdtri, fdtri

    squared = chdtri(size, 1.0 - COVERAGE) if dof is None else size * fdtri(size, dof, COVERAGE)
    return round(math.sqrt(float(squared)), _FACTOR_DECIMALS)
