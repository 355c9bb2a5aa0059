"""Outliers among residuals: samples that the noise of their neighbours does not explain.

- `outlying`: one pass over the residuals of one series
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri

from counterspin.physics.accelerometer import Array

#: Expected number of good samples of a whole series that Gaussian noise loses.
FALSE_ALARMS: Final = 0.01

#: Samples on either side whose median is taken away: slow wander is not outlying.
_REACH: Final = 32

#: Standard deviation of a Gaussian over its median absolute deviation.
_MAD: Final = 1.4826


def outlying(residuals: Array, weight: Array, floor: float = 0.0) -> npt.NDArray[np.bool_]:
    """Return which residuals are outliers.

    A residual is one where its distance from the median of its neighbours exceeds what Gaussian
    noise of the series' own robust scale (median absolute deviation) reaches in `FALSE_ALARMS`
    samples of the whole series: 5 standard deviations for 20,000 samples. The caller fits again
    without them and asks again, until none is left; gross ones no longer mask the others then.

    Parameters
    ----------
    residuals
        In time order, shape (n,).
    weight
        Inverse relative standard deviation of each residual, shape (n,).
    floor
        Least credible standard deviation at weight 1, such as that of a quantisation step.

    Returns
    -------
    array of bool
        Shape (n,).
    """
    n = residuals.size
    if n < 2 * _REACH:
        return np.zeros(n, dtype=bool)
    padded = np.pad(residuals, _REACH, mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _REACH + 1)
    # Every fourth neighbour serves as well and takes a quarter of the time. The sample itself is
    # none of them: where it was the median its distance would be zero, and the scale too small.
    local = np.median(windows[:, 2::4], axis=1)
    distance = np.abs(residuals - local) * weight
    scale = max(_MAD * float(np.median(distance)), floor)
    if scale == 0.0:
        # More than half of the residuals are alike (coarse steps): use the spread of the rest.
        scale = float(np.sqrt(np.mean(distance**2)))
    threshold = -float(ndtri(0.5 * FALSE_ALARMS / n))
    found: npt.NDArray[np.bool_] = distance > threshold * scale
    return found
