"""Outliers of a joint fit: left out round by round, and taken back where a model explains them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import SIGMA_OF_MAD, Array
from counterspin.errors import ConvergenceError
from counterspin.inference.joint.fit import JointFit, solve_joint
from counterspin.inference.joint.outliers import outlying
from counterspin.inference.joint.prepared import Prepared
from counterspin.inference.joint.series import Series
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.noise.model import Noise

#: Which rows of each series are left out.
Rows = tuple[npt.NDArray[np.bool_], ...]

_ROUNDS: Final = 20

#: Share of a record beyond which what was left out is looked at again.
_MANY: Final = 0.01


def nothing_left_out(series: Sequence[Series]) -> Rows:
    """Return that no row is left out."""
    return tuple(np.zeros(record.time.size, dtype=bool) for record in series)


def kept(prepared: Sequence[Prepared], outliers: Rows) -> tuple[Prepared, ...]:
    """Return columns without the rows that are left out."""
    return tuple(
        part.without(mask) if mask.any() else part
        for part, mask in zip(prepared, outliers, strict=True)
    )


def reject(
    fit: JointFit, series: Sequence[Series], requests: Mapping[str, Noise], outliers: Rows
) -> tuple[JointFit, Rows]:
    """Leave outliers out, refitting until there are none.

    series: With all rows; `outliers` are those that the fit does not have.
    """
    for _ in range(_ROUNDS):
        further = standing_out(fit, series, requests, outliers)
        if not any(mask.any() for mask in further):
            return fit, outliers
        new = tuple(mask[~before] for mask, before in zip(further, outliers, strict=True))
        outliers = tuple(a | b for a, b in zip(outliers, further, strict=True))
        fit = solve_joint(kept(fit.prepared, new), fit.model, fit.noise)
    where = " and ".join(
        f"{part.run} ({part.accelerometer})"
        for part, mask in zip(fit.prepared, further, strict=True)
        if mask.any()
    )
    raise ConvergenceError(
        f"{where}: outliers were still found after {_ROUNDS} rounds of rejection: the residuals "
        f"are not noise around a smooth curve; inspect the record for a jump of "
        "its clock or displacement, or add the missing terms to the model"
    )


def taken_back(
    fit: JointFit,
    everything: tuple[Sequence[Prepared], Unknowns],
    series: Sequence[Series],
    requests: Mapping[str, Noise],
    outliers: Rows,
) -> tuple[JointFit, Rows]:
    """Take back what no longer stands out of a fit with another model.

    everything: The columns of all rows, and the model.
    """
    whole, model = everything
    again = solve_joint(kept(whole, outliers), model, fit.noise)
    # The same estimate, held against all rows.
    standing = standing_out(
        replace(again, observations=tuple(whole)), series, requests, nothing_left_out(series)
    )
    if not any((mask & ~new).any() for mask, new in zip(outliers, standing, strict=True)):
        return fit, outliers
    return solve_joint(kept(whole, standing), model, fit.noise), standing


def many(outliers: Rows) -> bool:
    """Return whether so many rows of a series are left out that they are worth a second look."""
    return any(mask.mean() > _MANY for mask in outliers)


def standing_out(
    fit: JointFit, series: Sequence[Series], requests: Mapping[str, Noise], outliers: Rows
) -> Rows:
    """Return which rows of each series are outliers besides those that are left out already."""
    further = []
    for index, (part, mask) in enumerate(zip(fit.prepared, outliers, strict=True)):
        time, weight = series[index].time, np.sqrt(series[index].count)
        left = np.full(time.size, np.nan)
        left[~mask] = fit.residuals[index].plain
        known = requests[part.accelerometer].known
        if part.series.jitter > 0.0:
            weight = weight / _jittered(
                left * weight,
                known.white,
                part.series.jitter,
                series[index].jitter_variance * series[index].relative,
            )
        further.append(outlying(left, weight, known.quantisation / math.sqrt(12.0), time))
    return tuple(further)


def _jittered(residuals: Array, white: float, jitter: float, variance: Array) -> Array:
    """Return each row's standard deviation over the rms, noise of the time stamps being uneven.

    What is less than usual counts as half of it: such rows are compared with noisier neighbours.
    """
    scale = SIGMA_OF_MAD * float(np.nanmedian(np.abs(residuals)))
    even = max(white**2, scale**2 - jitter**2)
    ratio: Array = np.sqrt(np.maximum((even + variance) / (even + jitter**2), 0.5))
    return ratio
