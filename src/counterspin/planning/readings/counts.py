"""How often to take each of several possible readings: whole numbers, and what bounds them.

The relaxation in which the numbers need not be whole is convex (`planning.possibilities`). It is
rounded, and one reading after another is exchanged for a better one for as long as it gains.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.planning.design import Criterion
from counterspin.planning.possibilities import Possibilities

Counts = npt.NDArray[np.int64]

#: Smallest relative gain of u for which readings are exchanged, and the largest number of them.
_GAIN: Final = 1e-9
_EXCHANGES: Final = 400

#: Of at most so many possible readings the search begins from so many drawn numbers too.
_FEW: Final = 60
_DRAWN: Final = 6
#: Of so few readings that exchanges of one end in many places it begins from so many.
_FEW_READINGS: Final = 12
_DRAWN_OF_FEW: Final = 60
_SEED: Final = 1

#: A target is reached to rounding.
_ROUNDING: Final = 1e-9

#: Steps of the search for the least limit.
_BISECTIONS: Final = 12


@frozen(eq=False)
class Allocation:
    """How often each possible reading is taken."""

    counts: Counts  #: Shape (n,).
    value: float  #: The criterion.
    bound: float  #: What no other choice within the limits can be below.


def best_counts(
    possible: Possibilities, criterion: Criterion, number: float, time: float
) -> Allocation:
    """Return the numbers with the smallest criterion.

    number, time: Largest sum of the numbers and of their times, s; one of them finite.
    """
    relaxed = possible.relaxed(criterion, number, time)
    ends = [
        _exchanged(possible, criterion, start, number, time)
        for start in _starts(possible, relaxed.weight, number, time)
    ]
    value, counts = min(ends, key=lambda end: end[0])
    return Allocation(counts, value, min(relaxed.bound, value))


def _starts(possible: Possibilities, weight: Array, number: float, time: float) -> list[Counts]:
    """Return numbers from which to exchange: some ends are worse than others.

    weight: The numbers that need not be whole, shape (n,).
    """
    whole = np.floor(weight + 1e-6).astype(np.int64)
    drawn = _DRAWN_OF_FEW if number <= _FEW_READINGS else _DRAWN
    rng, drawn = np.random.default_rng(_SEED), drawn if weight.size <= _FEW else 0
    # Rounded; nothing, to which the best is added one by one; and drawn about the first.
    starts = [whole.copy(), np.zeros_like(whole), *(whole.copy() for _ in range(drawn))]
    for counts in (starts[0], *starts[2:]):
        first = weight - whole + (0.0 if counts is starts[0] else rng.uniform(size=weight.size))
        for index in np.argsort(-first, kind="stable"):
            counts[index] += _within(possible, counts, number, time)[index]
    return starts


def _exchanged(
    possible: Possibilities, criterion: Criterion, counts: Counts, number: float, time: float
) -> tuple[float, Counts]:
    """Return the criterion and the numbers where no exchange of one reading gains any more."""
    value = float(possible.value(criterion, counts))
    for _ in range(_EXCHANGES):
        found, better = math.inf, counts
        for gone in (None, *np.flatnonzero(counts)):
            left = counts.copy()
            fits = np.ones(counts.size, dtype=np.bool_)
            if gone is not None:
                left[gone] -= 1
                fits[gone] = False
            fits &= _within(possible, left, number, time)
            if not fits.any():
                continue
            values = np.where(fits, possible.with_one_more(criterion, left), math.inf)
            best = int(np.argmin(values))
            if values[best] < found:
                found, better = float(values[best]), left
                better[best] += 1
        after = float(possible.value(criterion, better))
        if not after < value - _GAIN:
            break
        value, counts = after, better
    return value, counts


def _within(
    possible: Possibilities, counts: Counts, number: float, time: float
) -> npt.NDArray[np.bool_]:
    """Return of which observations there may be one more within the limits, shape (n,)."""
    took = float(possible.cost @ counts) + possible.cost
    return np.asarray((float(counts.sum()) + 1.0 <= number) & (took <= time * (1.0 + 1e-12)))


def least_counts(
    possible: Possibilities,
    criterion: Criterion,
    number: float,
    time: float,
    u_of: Callable[[Counts], Array],
) -> tuple[Allocation, float] | None:
    """Return the fewest readings, or the least time, with which every u is at most its scale.

    u_of: What u will be, of all that the criterion asks for, in its order: what goes with time
        makes it larger than `Possibilities` know.
    Returns: the choice; the part of the limit below which none can be. None if all of the limit
        does not suffice.
    """
    scales = np.array(criterion.scales)

    def reached(chosen: Allocation) -> bool:
        variance = np.diag(possible.covariance(chosen.counts))[list(criterion.places)]
        near = bool(np.all(np.sqrt(variance) <= scales * (1.0 + _ROUNDING)))
        return near and bool(np.all(u_of(chosen.counts) <= scales * (1.0 + _ROUNDING)))

    def limits(part: float) -> tuple[float, float] | None:
        if math.isfinite(time):
            return (number, part * time) if part * time >= float(possible.cost.min()) else None
        return (whole, time) if (whole := math.floor(part * number + 1e-9)) else None

    best = best_counts(possible, criterion, number, time)
    if not reached(best):
        return None
    low, high = 0.0, 1.0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        within = limits(middle)
        chosen = None if within is None else best_counts(possible, criterion, *within)
        if chosen is not None and reached(chosen):
            best, high = chosen, middle
        else:
            low = middle
    floor = 0.0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (floor + high)
        within = limits(middle)
        if within is None or possible.relaxed(criterion, *within).bound > 0.0:
            floor = middle
        else:
            high = middle
    return best, floor
