"""Strobes: one sample a revolution, where the reference displacement is zero (Eq. 15).

At these angles every harmonic of the revolution has the same phase, so that only what
accumulates shows: a parabola in time, and around it noise.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array, median
from counterspin.errors import NotIdentifiableError, RecordError
from counterspin.frozen import frozen
from counterspin.physics.spindle import TURN

FEWEST_STROBES: Final = 4  #: strobes that a parabola and one degree of freedom need

#: A strobe this near to a sample is on it: of a sample's spacing, and of a turn at the ends.
_ROUNDING: Final = 1e-9


@frozen
class Strobes:
    """The strobed displacement error of one run."""

    time: Array  #: s, shape (m,).
    error: Array  #: Displacement error S - S_ref at the strobes, m, shape (m,).
    #: Standard deviation of each strobe's error per standard deviation of one sample, shape (m,): 1
    #: on a sample, 0.71 midway between two.
    noise_factor: Array
    lost: int  #: Strobes that the record passes but cannot give, because samples are missing there.


def strobe_angle(input_axis: Array) -> float:
    """Return the spindle angle in [0, 2 pi) at which an input axis sees zero displacement.

    It is pi/2 past the axis' own azimuth, measured from east towards north: pi/2 for east
    (the paper's choice), pi for north.

    Parameters
    ----------
    input_axis
        Unit vector in east-north-up, shape (3,).

    Raises
    ------
    NotIdentifiableError
        If the axis is not horizontal within 1 mrad.

    Examples
    --------
    >>> import math
    >>> import counterspin as cs
    >>> [math.degrees(cs.strobe_angle(one.input_axis)) for one in (cs.QX, cs.QY)]
    [90.0, 180.0]
    """
    if abs(float(input_axis[2])) > 1e-3:
        raise NotIdentifiableError(
            "strobes need a horizontal input axis; this one is "
            f"{math.degrees(math.asin(float(input_axis[2]))):.3f} deg above the horizontal"
        )
    return (math.atan2(float(input_axis[1]), float(input_axis[0])) + math.pi / 2) % TURN


def by_angle(
    time: Array, angle: Array, error: Array, phase: float, count: Array | None = None
) -> Strobes:
    """Interpolate the displacement error where the recorded angle passes the strobe angle.

    Parameters
    ----------
    time, angle, error
        Recorded time (s), unwrapped angle (rad), displacement error (m), shape (n,). The
        error's missing samples are NaN.
    phase
        Strobe angle, rad, taken modulo 2 pi.
    count
        Samples averaged into each value, shape (n,); None for one each.

    Returns
    -------
    Strobes

    Raises
    ------
    RecordError
        If fewer than `FEWEST_STROBES` strobes are found.
    """
    turns = (angle - phase) / TURN
    turns = turns * (1.0 if turns[-1] >= turns[0] else -1.0)  # a strobe lies at each whole number
    first, last = math.ceil(turns[0] - _ROUNDING), math.floor(turns[-1] + _ROUNDING)
    target = np.arange(first, last + 1.0)
    # A noisy angle may pass a strobe to and fro: the first time counts.
    reached = np.searchsorted(np.maximum.accumulate(turns), target)
    left = np.clip(reached, 1, turns.size - 1) - 1
    share = (target - turns[left]) / (turns[left + 1] - turns[left])
    return _interpolate(time, error, left, share, count)


def by_nominal_rate(
    time: Array, rate: float, error: Array, phase: float, count: Array | None = None
) -> Strobes:
    """Interpolate the displacement error at the strobe times of a perfectly uniform rotation.

    Parameters
    ----------
    time, error, phase, count
        As for `by_angle`; the angle is zero at time zero.
    rate
        Nominal rate, rad/s, signed.

    Returns
    -------
    Strobes

    Raises
    ------
    RecordError
        If fewer than `FEWEST_STROBES` strobes are found.
    """
    return by_angle(time, rate * time, error, phase, count)


def _interpolate(
    time: Array, error: Array, left: npt.NDArray[np.intp], share: Array, count: Array | None
) -> Strobes:
    spacing = np.diff(time)
    # Across a gap a straight line is no interpolation any more.
    whole = spacing[left] <= 1.5 * median(spacing)
    # On a sample the other neighbour does not matter, even if it is missing or far away.
    share = np.where(np.abs(share) < _ROUNDING, 0.0, share)
    share = np.where(np.abs(share - 1.0) < _ROUNDING, 1.0, share)
    before, after = error[left], error[left + 1]
    value = np.where(share == 0.0, before, (1.0 - share) * before + share * after)
    value = np.where(share == 1.0, after, value)
    samples = np.ones(time.size) if count is None else count
    variance = (1.0 - share) ** 2 / samples[left] + share**2 / samples[left + 1]
    keep = (whole | (share == 0.0) | (share == 1.0)) & np.isfinite(value)
    if np.count_nonzero(keep) < FEWEST_STROBES:
        raise RecordError(
            f"only {np.count_nonzero(keep)} of the {FEWEST_STROBES} strobes that the parabola of "
            "the first stage needs could be read: record more revolutions or fill the gaps"
        )
    at = time[left] + share * spacing[left]
    return Strobes(at[keep], value[keep], np.sqrt(variance[keep]), int(np.sum(~keep)))
