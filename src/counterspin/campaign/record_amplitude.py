"""The unit of a signal: its wave of one period a revolution must keep its amplitude.

The amplitude of an accelerometer's signal on a centrifuge follows from the radius and the rate
alone, so a change of unit in the middle of a record, a dead channel or a wrong unit in the
campaign description shows in it at once, long before a fit would misreport it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

#: Fewest samples from which one revolution's amplitude is taken.
_FEWEST = 12
#: The factor by which an amplitude must be off to be refused.
_OFF = 2.0

#: Ratios that come of a mistaken unit, and the units' names.
_UNIT_RATIOS = (
    (1000.0, "m and mm"),
    (100.0, "m and cm"),
    (10.0, "cm and mm"),
    (1e6, "m and um"),
    (3.28084, "m and ft"),
    (39.3701, "m and in"),
    (25.4, "mm and in"),
    (2.54, "cm and in"),
    (9.80665, "g and m/s^2"),
    (980.665, "g and Gal"),
    (9806.65, "mg and m/s^2"),
    (3.6, "m/s and km/h"),
)


@dataclass(frozen=True)
class Waves:
    """One period a revolution: complex amplitudes, residual deviations, first and last sample."""

    amplitude: np.ndarray
    deviation: np.ndarray
    first: np.ndarray
    last: np.ndarray


def waves(angle: np.ndarray, signal: np.ndarray) -> Waves:
    """Fit a wave to each revolution (or to a few, where samples are sparse).

    Parameters
    ----------
    angle
        (n,) rad, unwrapped.
    signal
        (n,), NaN where there is no sample.

    Returns
    -------
    Waves
        Re is the amplitude of the cosine of the angle, Im that of the sine.
    """
    turns = np.abs(angle - angle[0]) / (2 * math.pi)
    per_turn = len(angle) / max(float(turns[-1]), 1.0)
    together = math.ceil(2 * _FEWEST / max(per_turn, 1e-9))
    bins = (turns // together).astype(int)
    order = np.flatnonzero(np.isfinite(signal))
    bins, th, s = bins[order], angle[order], signal[order]
    edges = np.flatnonzero(np.diff(bins, prepend=-1))
    sizes = np.diff(edges, append=len(bins))
    # An incomplete last revolution carries too little of the wave.
    enough = sizes >= max(_FEWEST, 0.7 * float(np.median(sizes))) if len(sizes) else sizes > 0
    edges, sizes = edges[enough], sizes[enough]
    rows = len(edges)
    index = edges[:, None] + np.arange(sizes.max(initial=0))
    valid = np.arange(sizes.max(initial=0)) < sizes[:, None]
    index = np.where(valid, index, edges[:, None])
    th, s = th[index], s[index]
    u = (th - th.mean(axis=1, keepdims=True)) / math.pi if rows else th
    functions = np.stack([np.cos(th), np.sin(th), np.ones_like(u), u, u**2], axis=-1)
    functions *= valid[..., None]
    s = np.where(valid, s, 0.0)
    transposed = np.swapaxes(functions, -1, -2)
    normal = transposed @ functions + 1e-12 * np.eye(5)
    fitted = np.linalg.solve(normal, transposed @ s[..., None])
    rest = s - (functions @ fitted)[..., 0]
    deviation = np.sqrt((rest**2).sum(axis=1) / np.maximum(sizes - 5, 1))
    amplitude = fitted[:, 0, 0] + 1j * fitted[:, 1, 0]
    return Waves(amplitude, deviation, order[edges], order[edges + sizes - 1])


def change_of_unit(found: Waves, angle: np.ndarray, signal: np.ndarray) -> tuple[int, str] | None:
    """Find where the amplitude of a wave changes by a factor.

    Returns
    -------
    (sample, words) or None
        The first sample after the change, and what changed; None where all is well, or where the
        signal has no wave to judge by.
    """
    size = np.abs(found.amplitude)
    if len(size) < 3:
        return None
    usual = float(np.median(size))
    if usual < 5 * float(np.median(found.deviation)):
        return None
    ratio = size / usual
    odd = np.flatnonzero((ratio > _OFF) | (ratio < 1 / _OFF))
    if not len(odd):
        return None
    # The revolution in which the unit changes is a mixture: take the ratio from the next one.
    begin = int(odd[0])
    settled = begin + 1 if begin + 1 < len(ratio) and begin + 1 in odd else begin
    factor = float(ratio[settled])
    if begin == 0:  # the odd part stands at the start: what changes is where it ends
        inside = int(np.argmin(np.isin(np.arange(len(ratio)), odd)))
        factor = 1 / factor
        before, after = inside - 1, inside
    else:
        before, after = begin - 1, begin
    low, high = int(found.first[before]), int(found.last[after]) + 1
    part = slice(low, high)
    sample = low + _switch(
        angle[part], signal[part], found, before if begin else after, factor, begin
    )
    near = min(_UNIT_RATIOS, key=lambda known: abs(abs(math.log(factor)) - math.log(known[0])))
    words = f"its wave of one period a revolution changes by a factor of {factor:.4g}"
    if abs(abs(math.log(factor)) - math.log(near[0])) < 0.02:
        words += f", as between {near[1]}"
    return sample, words


def _switch(
    angle: np.ndarray, signal: np.ndarray, found: Waves, good: int, factor: float, begin: int
) -> int:
    """Return the sample at which a signal turns from one scale to the other."""
    wave = found.amplitude[good].real * np.cos(angle) + found.amplitude[good].imag * np.sin(angle)
    if begin:
        first, second = wave, wave * factor
    else:
        first, second = wave / factor, wave
    scale = np.maximum(np.abs(first), np.abs(second)).max()
    cost = np.nan_to_num((np.abs(signal - first) - np.abs(signal - second)) / scale)
    return int(np.argmin(np.append(0.0, np.cumsum(cost))))


def against_reference(
    found: Waves, radius: float, input_axis: np.ndarray, has_angle: bool
) -> str | None:
    """Compare a displacement's wave with the motion's; say what is wrong, or return None.

    Parameters
    ----------
    found
        The displacement's waves, m.
    radius
        m.
    input_axis
        (3,) unit vector in east, north, up.
    has_angle
        Whether the waves are over the recorded angle; else their phase means nothing.
    """
    across = math.hypot(input_axis[0], input_axis[1])
    if across < 0.05 or not len(found.amplitude):
        return None
    expected = radius * complex(input_axis[0], input_axis[1])
    ratio = complex(np.median(found.amplitude.real), np.median(found.amplitude.imag)) / expected
    size = abs(ratio)
    if (has_angle and abs(ratio - 1) < 0.5) or (not has_angle and 0.5 < size < 2):
        return None
    words = (
        f"swings by {size * abs(expected):.4g} m about the spindle axis, "
        f"where the radius and the input axis make {abs(expected):.4g} m"
    )
    if 0.5 < size < 2:
        turn = math.degrees(math.atan2(ratio.imag, ratio.real))
        return (
            f"is turned by {turn:.0f} degrees against the input axis: "
            "check the input axis, its sign, and which column is which"
        )
    near = min(_UNIT_RATIOS, key=lambda known: abs(abs(math.log(size)) - math.log(known[0])))
    if abs(abs(math.log(size)) - math.log(near[0])) < 0.05:
        words += f"; the factor {size:.4g} is that between {near[1]}: check the column's unit"
    return words
