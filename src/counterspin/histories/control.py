"""Control limits from the results themselves: individuals and moving range."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.frozen import frozen

#: Mean and standard deviation of the range of two normal values of unit variance.
_D2: Final = 2.0 / math.sqrt(math.pi)
_D3: Final = math.sqrt(2.0 - 4.0 / math.pi)

#: Action and warning limits, in standard deviations.
ACTION_SIGMAS: Final = 3.0
WARNING_SIGMAS: Final = 2.0

#: Fewer results have no limits that could tell anything.
FEWEST_RESULTS: Final = 3


@frozen
class Individuals:
    """An individuals chart with its moving range."""

    centre: float  #: Mean of the results.
    sigma: float  #: Their standard deviation from one to the next: mean moving range over 1.128.
    #: Mean of the sizes of the changes, and their upper action limit.
    mean_range: float
    range_limit: float
    beyond: tuple[int, ...]  #: Places of the results beyond the action limits.
    #: Places of the results whose change since the one before is beyond `range_limit`.
    leaps: tuple[int, ...]

    def limits(self, width: float = ACTION_SIGMAS) -> tuple[float, float]:
        """Return the lower and the upper limit at so many standard deviations."""
        return self.centre - width * self.sigma, self.centre + width * self.sigma


def individuals(values: npt.ArrayLike) -> Individuals | None:
    """Return the chart of results in order of time (NIST/SEMATECH e-Handbook, 6.3.2.2).

    values: Shape (n,).
    Returns: none for fewer than `FEWEST_RESULTS` results.
    """
    measured = np.asarray(values, dtype=np.float64)
    if measured.size < FEWEST_RESULTS:
        return None
    ranges = np.abs(np.diff(measured))
    mean_range = float(ranges.mean())
    centre, sigma = float(measured.mean()), mean_range / _D2
    limit = mean_range + ACTION_SIGMAS * _D3 * sigma
    return Individuals(
        centre=centre,
        sigma=sigma,
        mean_range=mean_range,
        range_limit=limit,
        beyond=tuple(map(int, np.nonzero(np.abs(measured - centre) > ACTION_SIGMAS * sigma)[0])),
        leaps=tuple(int(place) + 1 for place in np.nonzero(ranges > limit)[0]),
    )
