"""Tell the samples of a sensor from the rows of its log.

A log that is faster than the sensor repeats each value until the next one arrives. A clock that is
coarser than the rows, or packets of several samples, repeat time stamps. Rows that never arrive are
lost samples.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array, median
from counterspin.errors import RecordError
from counterspin.frozen import frozen
from counterspin.records.outliers import resolution

#: Rows that show whether values repeat.
_SHOWING_ROWS: Final = 100_000
#: Part of the rows that repeat a value beyond which these are repeats, in addition to three times
#: the part that is equal by chance.
_REPEATED_PART: Final = 2e-3
#: Part of the samples that may be equal by chance where a change of the value tells a new sample.
_CHANCE_PART: Final = 0.02
#: Part of the changes that are at one phase of a whole number of rows.
_PHASED_PART: Final = 0.999
#: Steps that are so many times the median step are outliers.
_OUTLYING_STEPS: Final = 8.0
#: Steps of the resolution by which values change if they are not those of a smooth coarse signal.
_COARSE_STEPS: Final = 1.25
#: Most rows for a sample.
_MOST_ROWS: Final = 1000
#: Fewest rows that tell.
_FEWEST: Final = 32

Mask = npt.NDArray[np.bool_]


@frozen
class Holding:
    """The way in which a log repeats the values of a slower sensor."""

    rows: float  #: Mean number of rows for a sample.
    period: int  #: Rows for every sample; 0: the number varies.
    phase: int  #: Row of the first new value, from 0, where the period is not 0.

    @classmethod
    def of(cls, values: Array) -> Holding | None:
        """Return how values repeat; None if they do not. ValueError if it cannot be told.

        values: As logged, NaN where a cell is empty, shape (n,).
        """
        part = values[:_SHOWING_ROWS]
        good = part[np.isfinite(part)]
        if good.size < _FEWEST or np.ptp(good) == 0.0:
            return None
        steps = np.diff(good)
        changed = steps[steps != 0.0]
        repeated = 1.0 - changed.size / steps.size
        sizes = np.abs(changed)
        usual = sizes[sizes <= _OUTLYING_STEPS * median(sizes)]
        step = float(np.sqrt(np.mean(usual**2)))
        chance = min(1.0, resolution(good) / (math.sqrt(2.0 * math.pi) * step))
        limit = 3.0 * chance + 5.0 * math.sqrt(chance / steps.size) + _REPEATED_PART
        places = np.flatnonzero(np.diff(part, prepend=math.nan) != 0.0)[1:]
        # Of samples that are equal by chance, many differ from both neighbours.
        lengths = np.diff(places)
        few = lengths.size < _FEWEST or step < _COARSE_STEPS * resolution(good)
        alternate = few or np.quantile(lengths, 0.01) < 2.0
        if (repeated <= limit and alternate) or _is_stuck(lengths, 1.0 / (1.0 - repeated)):
            return None
        if period := _period(places):
            return cls(float(period), period, int(places[0]) % period)
        rows = 1.0 / (1.0 - repeated)
        if chance > _CHANCE_PART:
            raise ValueError(
                f"it repeats {100.0 * repeated:.2g} % of its values at irregular distances, as "
                "where a log is faster than the sensor, and its resolution is too coarse to tell "
                "a repeat from an equal sample; export the sensor's own samples"
            )
        return cls(rows, 0, 0)

    def new(self, values: Array, first_row: int = 0, before: float = math.nan) -> Mask:
        """Return the rows with new values.

        first_row: Row of the first value, from 0.
        before: The value before the first one; NaN: none.
        """
        if self.period:
            return np.asarray((np.arange(values.size) + first_row - self.phase) % self.period == 0)
        return np.asarray(np.diff(values, prepend=before) != 0.0)


class RepeatedValues:
    """Repeated values in the signals of a record, chunk after chunk.

    names: The columns of the signals.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._holding: list[Holding | None] = []
        self._held = [0] * len(names)
        self._last = [math.nan] * len(names)
        self._first_row = 0
        self.blank = [0] * len(names)  #: Values of each signal that were replaced by NaN.

    def start(self, path: object, first_row: int, time: Array, signals: Sequence[Array]) -> None:
        """Find how values repeat in the first chunk; RecordError if it cannot be told.

        Rows that repeat the time of the row before are no evidence: the clock drops them.
        """
        self._first_row = first_row
        later = np.diff(time, prepend=math.nan) != 0.0
        for name, signal in zip(self._names, signals, strict=True):
            try:
                repeats = later.all() or Holding.of(signal[later]) is not None
                self._holding.append(Holding.of(signal) if repeats else None)
            except ValueError as error:
                raise RecordError(f"{path}: column '{name}': {error}.") from None

    def without(self, first_row: int, signals: Sequence[Array], interpolates: bool) -> list[Array]:
        """Return the signals of a chunk with repeated values replaced.

        interpolates: Whether they are interpolated between new values, as the mean of a block
            needs them; otherwise they are NaN.
        """
        replaced = list(signals)
        for place, (signal, holding) in enumerate(zip(signals, self._holding, strict=True)):
            if holding is None:
                continue
            fresh = holding.new(signal, first_row - self._first_row, self._last[place])
            old = ~fresh & ~np.isnan(signal)
            new = np.flatnonzero(fresh & ~np.isnan(signal))
            self._held[place] += int(old.sum())
            self._last[place] = float(signal[-1])
            filled = np.full(len(signal), math.nan)
            if interpolates and len(new):
                filled = np.interp(np.arange(len(signal)), new, signal[new])
            else:
                self.blank[place] += int(old.sum())
            replaced[place] = np.where(old, filled, signal)
        return replaced

    def words(self, rows: int) -> list[str]:
        """Return a statement on each signal that repeats its values, of so many rows."""
        shares = ((name, held / rows) for name, held in zip(self._names, self._held, strict=True))
        return [
            f"column '{name}' repeats {100.0 * share:.3g} % of its values, not used"
            for name, share in shares
            if share
        ]


def _is_stuck(lengths: npt.NDArray[np.int_], rows: float) -> bool:
    """Return whether values stand still in places, as of a dead channel or beyond a range."""
    several = lengths[lengths > 1]
    return bool(several.size == 0 or np.quantile(several, 0.95) > 3.0 * rows + 2.0)


def _period(places: npt.NDArray[np.int_]) -> int:
    """Return the whole number of rows between changes, of which some may be missing; 0: none is."""
    lengths = np.diff(places)
    if lengths.size < _FEWEST or not 1 < (shortest := int(np.quantile(lengths, 0.01))) < _MOST_ROWS:
        return 0
    for period in range(shortest, 1, -1):
        at_phase = np.bincount(places % period).max()
        if at_phase >= _PHASED_PART * places.size:
            return period
    return 0
