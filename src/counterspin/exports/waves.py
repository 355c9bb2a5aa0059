"""The wave that a revolution makes in a column of numbers."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from counterspin.arrays import Array

#: Samples that are looked at.
_MAX_SAMPLES: Final = 1 << 16
#: Fewest swings that tell a frequency, and how much of the square a wave must have.
_FEWEST_SWINGS: Final = 2.0
_WAVE_SHARE: Final = 0.5


def frequency(time: Array, values: Array) -> float | None:
    """Return the frequency of the wave that a column is made of, Hz; None if it is none.

    time, values: Shape (n,), NaN where there is none; time rises, in s.
    """
    good = np.isfinite(time) & np.isfinite(values)
    t, y = time[good][:_MAX_SAMPLES], values[good][:_MAX_SAMPLES]
    if t.size < 16 or t[-1] <= t[0]:
        return None
    even = np.linspace(t[0], t[-1], t.size)
    y = np.interp(even, t, y)
    x = (even - even.mean()) / (even[-1] - even[0])
    y = y - np.polynomial.polynomial.polyval(x, np.polynomial.polynomial.polyfit(x, y, 2))
    total = float(np.sum(y**2))
    power = np.abs(np.fft.rfft(y * np.hanning(y.size), 4 * y.size)) ** 2
    place = int(np.argmax(power[8:])) + 8
    at = place / (4 * y.size * (even[1] - even[0]))
    if total == 0.0 or at * (even[-1] - even[0]) < _FEWEST_SWINGS:
        return None
    # The peak of a parabola through the three highest, then the wave itself decides.
    if place + 1 < power.size:
        low, high, after = np.log(power[place - 1 : place + 2] + 1e-300)
        bend = low - 2.0 * high + after
        shift = 0.5 * (low - after) / bend if bend < 0.0 else 0.0
        at *= (place + shift) / place
    amplitude, _ = wave(2.0 * np.pi * at * even, y)
    return float(at) if amplitude**2 / 2.0 * y.size > _WAVE_SHARE * total else None


def wave(angle: Array, values: Array, degree: int = 2) -> tuple[float, float]:
    """Return amplitude and phase of values = A cos(angle + phase), beside a polynomial.

    angle, values: rad, unwrapped, and what follows it; shape (n,), NaN where there is none.
    degree: Of the polynomial in the angle.
    """
    good = np.isfinite(angle) & np.isfinite(values)
    th, y = angle[good], values[good]
    if not th.size:
        return math.nan, math.nan
    x = (th - th.mean()) / (np.ptp(th) or 1.0)
    design = np.column_stack([np.cos(th), np.sin(th), np.vander(x, degree + 1, increasing=True)])
    a, b, *_ = np.linalg.lstsq(design, y, rcond=None)[0]
    return float(np.hypot(a, b)), float(np.arctan2(-b, a))
