"""Means over blocks of at most 1/64 revolution, made piece by piece while a record is read.

A record is cut into pieces of a fixed number of rows, each small enough for the processor's
cache, and each piece is reduced by itself: blocks never reach across two pieces, so the result
depends on neither the length of the record nor on how the file was read. In an evenly sampled
piece a block is a number of rows; where rows are missing it is a span of time. Outliers are found
before the mean is taken, and the rows that remain carry the block's mean time and angle.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np

from counterspin.arrays import aligned
from counterspin.records.column_file import Columns
from counterspin.records.spikes import find_spikes

#: A block covers at most this part of a revolution: the means then lose nothing of K_II.
BLOCKS_PER_REVOLUTION = 64
#: More samples than this in one block gain nothing.
_LARGEST_BLOCK = 8192
#: Steps less uneven than this give a block's times the spread of an even grid.
_EVEN = 1e-3
#: Rows in a piece, about: three columns of them fit the processor's second cache.
_PIECE = 65536


@dataclass(frozen=True)
class Blocks:
    """Reduced samples (n,): mean time and spread of the times, s; samples; angle, rad."""

    time: np.ndarray
    time_sd: np.ndarray
    count: np.ndarray
    angle: np.ndarray | None
    signals: list[np.ndarray]

    @classmethod
    def joined(cls, parts: list[Blocks]) -> Blocks:
        """Return the parts one after the other."""
        return cls(
            np.concatenate([part.time for part in parts]),
            np.concatenate([part.time_sd for part in parts]),
            np.concatenate([part.count for part in parts]),
            None
            if parts[0].angle is None
            else np.concatenate([part.angle for part in parts if part.angle is not None]),
            [np.concatenate(arrays) for arrays in zip(*(p.signals for p in parts), strict=True)],
        )


def block_size(step: float, rate: float) -> int:
    """Return the samples to a block: 1 unless the record is denser than 2 samples per block."""
    longest = 2 * math.pi / (BLOCKS_PER_REVOLUTION * abs(rate))
    # The tolerance keeps a spacing that divides the block exactly from losing a sample.
    size = math.floor(longest / step * (1 + 1e-9))
    return min(size, _LARGEST_BLOCK) if size >= 2 else 1


def piece_size(block: int) -> int:
    """Return the rows to a piece: a whole number of blocks."""
    return block * max(1, _PIECE // block)


def in_pieces(
    batches: Iterator[Columns], places: Sequence[int], choose_size: Callable[[Columns], int]
) -> Iterator[Columns]:
    """Yield columns in pieces of a fixed number of rows, however the file was batched.

    Parameters
    ----------
    batches
        Consecutive batches of the file's columns.
    places
        Which column of the batches each column of the pieces is.
    choose_size
        Takes the columns of the first rows and returns the rows to a piece.

    Yields
    ------
    Columns
        To be read, not changed, and only until the next piece is asked for.
    """
    head: list[Columns] = []
    for batch in batches:
        head.append(batch)
        if sum(len(columns[0]) for columns in head) >= piece_size(1):
            break
    if not sum(len(columns[0]) for columns in head):
        return
    first = [joined(head)[place] for place in places]
    size = choose_size(first)
    # What lies across two batches is brought together in a buffer; the rest are views.
    buffer = aligned(len(places), size)
    filled = 0
    for batch in chain([first], ([batch[place] for place in places] for batch in batches)):
        rows = len(batch[0])
        start = 0
        while start < rows:
            stop = min(start + size - filled, rows)
            if stop - start == size:
                yield [column[start:stop] for column in batch]
            else:
                for column, part in zip(buffer, batch, strict=True):
                    column[filled : filled + stop - start] = part[start:stop]
                filled += stop - start
            if filled == size:
                yield list(buffer)
                filled = 0
            start = stop
    if filled:
        yield list(buffer[:, :filled])


def joined(batches: list[Columns]) -> Columns:
    """Return the columns of several batches, one batch after the other."""
    if len(batches) == 1:
        return batches[0]
    return [np.concatenate(columns) for columns in zip(*batches, strict=True)]


class Reducer:
    """Reduces pieces of a record to blocks.

    Parameters
    ----------
    block
        Samples in a block; 1 keeps point samples.
    step
        The usual spacing of the samples, s.
    rate
        Spindle rate, rad/s.
    """

    def __init__(self, block: int, step: float, rate: float) -> None:
        self._block = block
        self._step = step
        self._rate = rate
        # A product with a constant vector is the fastest sum along short rows.
        self._mean = np.full(block, 1 / block)

    def reduce(
        self, columns: Columns, has_angle: bool, unevenness: float
    ) -> tuple[Blocks, list[np.ndarray], bool]:
        """Reduce one piece.

        Parameters
        ----------
        columns
            Arrays (n,): time, s, increasing; if `has_angle`, the angle, rad, unwrapped; then the
            signals, NaN where empty (or infinite).
        has_angle
            Whether the second column is the angle.
        unevenness
            Largest relative deviation of a time step from the usual one.

        Returns
        -------
        blocks
            The piece, reduced.
        outliers
            For each signal the places of its outlying samples.
        complete
            Whether it is certain that every sample is a number.
        """
        time, signals = columns[0], columns[2 if has_angle else 1 :]
        outliers = [find_spikes(time, x, self._rate, self._step, unevenness) for x in signals]
        even = unevenness < 0.5
        clean = not any(len(places) for places in outliers)
        if self._block == 1:
            # A copy: the next piece overwrites this one.
            points = [x.copy() for x in columns]
            for x, places in zip(points[len(points) - len(signals) :], outliers, strict=True):
                x[places] = np.nan
            alone = np.ones(len(time), dtype=int)
            return _blocks(points, has_angle, np.zeros(len(time)), alone), outliers, False
        if even and clean:
            blocks = self._even_means(columns, has_angle, unevenness)
            # The mean over a sample that is no number is none either.
            if all(np.isfinite(x).all() for x in blocks.signals):
                return blocks, outliers, True
        usable = [np.isfinite(x) for x in signals]
        for mask, places in zip(usable, outliers, strict=True):
            mask[places] = False
        angle = columns[1] if has_angle else None
        return self._means(time, angle, signals, usable, even), outliers, False

    def _even_means(self, columns: Columns, has_angle: bool, unevenness: float) -> Blocks:
        size, time = self._block, columns[0]
        whole = len(time) // size * size
        tail = len(time) - whole
        means = [x[:whole].reshape(-1, size) @ self._mean for x in columns]
        if tail:
            means = [np.append(m, x[whole:].mean()) for m, x in zip(means, columns, strict=True)]
        mean_time = means[0]
        count = np.full(len(mean_time), size)
        if unevenness < _EVEN:
            sd = np.full(len(mean_time), self._step * math.sqrt((size**2 - 1) / 12))
        else:
            apart = time[:whole].reshape(-1, size) - mean_time[: whole // size, None]
            sd = np.sqrt(np.einsum("ij,ij->i", apart, apart) / size)
        if tail:
            sd = np.append(sd, 0.0) if len(sd) < len(mean_time) else sd
            sd[-1] = time[whole:].std()
            count[-1] = tail
        return _blocks(means, has_angle, sd, count)

    def _means(
        self,
        time: np.ndarray,
        angle: np.ndarray | None,
        signals: list[np.ndarray],
        usable: list[np.ndarray],
        even: bool,
    ) -> Blocks:
        """Reduce a piece with gaps, empty cells or outliers."""
        if even:
            places = np.arange(len(time)) // self._block
        else:
            span = self._block * self._step
            places = np.floor((time - time[0] + 0.5 * self._step) / span).astype(int)
        starts = np.flatnonzero(np.diff(places, prepend=-1))
        places = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(time)))
        rows = np.diff(starts, append=len(time))
        # One set of rows serves the whole block, so that time and angle are the means of the very
        # samples that the signals are means of. A signal that lacks most of a block is left out
        # of it, rather than costing the others their samples.
        absent = [np.add.reduceat(mask.astype(int), starts) * 2 < rows for mask in usable]
        keep = np.ones(len(time), dtype=bool)
        for mask, gone in zip(usable, absent, strict=True):
            keep &= mask | gone[places]
        count = np.add.reduceat(keep.astype(int), starts)
        filled = count > 0
        divisor = np.maximum(count, 1)

        def means(x: np.ndarray) -> np.ndarray:
            return np.add.reduceat(np.where(keep, x, 0.0), starts) / divisor

        mean_time = means(time)
        sd = np.sqrt(means((time - mean_time[places]) ** 2))
        reduced = []
        for x, gone in zip(signals, absent, strict=True):
            reduced.append(np.where(gone, np.nan, means(np.where(np.isfinite(x), x, 0.0)))[filled])
        return Blocks(
            mean_time[filled],
            sd[filled],
            count[filled],
            None if angle is None else means(angle)[filled],
            reduced,
        )


def _blocks(columns: Columns, has_angle: bool, sd: np.ndarray, count: np.ndarray) -> Blocks:
    angle = columns[1] if has_angle else None
    return Blocks(columns[0], sd, count, angle, columns[2 if has_angle else 1 :])
