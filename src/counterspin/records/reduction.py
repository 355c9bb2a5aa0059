"""Means over blocks of at most 1/64 revolution, made chunk by chunk while a record is read.

A record is cut into chunks of a fixed number of rows, each small enough for the processor's
cache, and each chunk is reduced by itself: blocks never reach across two chunks, so the result
depends on neither the length of the record nor on how the file was read. In an evenly sampled
chunk a block is a number of rows; where rows are missing it is a span of time. Outliers are found
before the mean is taken, and the rows that remain carry the block's mean time and angle.
"""

from __future__ import annotations

import math

import numpy as np

from counterspin.frozen import frozen
from counterspin.records.column_file import Chunk
from counterspin.records.outliers import detect_outliers

#: A block covers at most this part of a revolution: the means then lose nothing of K_II.
BLOCKS_PER_REVOLUTION = 64
#: More samples than this in one block gain nothing.
_BLOCK_SAMPLES = 8192
#: Steps less uneven than this give a block's times the spread of an even grid.
_IGNORED_UNEVENNESS = 1e-3
#: Up to so many rows beyond a gap stand alone.
_MAX_ISOLATED_ROWS = 5
#: Steps less uneven than this let a block be a number of rows; else it is a span of time.
_ROW_UNEVENNESS = 0.5


@frozen
class BlockMeans:
    """Reduced samples (n,): mean time and spread of the times, s; samples; angle, rad."""

    time: np.ndarray
    time_sd: np.ndarray
    count: np.ndarray
    angle: np.ndarray | None
    signals: list[np.ndarray]
    #: Standard deviation of the angles inside each block, rad; NaN where the times tell it.
    angle_sd: np.ndarray

    @classmethod
    def concatenate(cls, blocks: list[BlockMeans]) -> BlockMeans:
        """Return the parts one after the other."""
        return cls(
            np.concatenate([block.time for block in blocks]),
            np.concatenate([block.time_sd for block in blocks]),
            np.concatenate([block.count for block in blocks]),
            None
            if blocks[0].angle is None
            else np.concatenate([block.angle for block in blocks if block.angle is not None]),
            [np.concatenate(arrays) for arrays in zip(*(p.signals for p in blocks), strict=True)],
            np.concatenate([block.angle_sd for block in blocks]),
        )


def block_size(step: float, rate: float) -> int:
    """Return the samples to a block: 1 unless the record is denser than 2 samples per block."""
    longest = 2 * math.pi / (BLOCKS_PER_REVOLUTION * abs(rate))
    # The tolerance keeps a spacing that divides the block exactly from losing a sample.
    size = math.floor(min(_BLOCK_SAMPLES, longest / step * (1 + 1e-9)))
    return size if size >= 2 else 1


def main_segment(blocks: BlockMeans, shortest_gap: float) -> tuple[float, float] | None:
    """Return between which times, s, a record stands without the rows that stand alone at its ends.

    A few rows beyond a gap, at the start or at the end, tell little; but a fit follows them, and
    a single wrong one bends it. None where there are no such rows.

    shortest_gap: s, that sets rows apart.
    """
    # Half of a block's span is sqrt(3) standard deviations of its even times.
    half_width = math.sqrt(3) * blocks.time_sd
    start, end = (blocks.time - half_width)[1:], (blocks.time + half_width)[:-1]
    middle = (start + end) / 2
    gaps = np.flatnonzero(start - end > shortest_gap)
    earlier_gaps = np.cumsum(blocks.count)[gaps]
    rows_before = gaps[earlier_gaps <= _MAX_ISOLATED_ROWS]
    rows_after = gaps[blocks.count.sum() - earlier_gaps <= _MAX_ISOLATED_ROWS]
    if not len(rows_before) and not len(rows_after):
        return None
    first = float(middle[rows_before[-1]]) if len(rows_before) else -math.inf
    last = float(middle[rows_after[0]]) if len(rows_after) else math.inf
    return first, last


@frozen
class AveragedChunk:
    """A chunk, reduced."""

    blocks: BlockMeans  #: Its means.
    outliers: list[np.ndarray]  #: For each signal the places of its outlying samples.
    complete: bool  #: Whether it is certain that every sample is a number.


class BlockAverager:
    """Reduces chunks of a record to blocks.

    block: Samples in a block; 1 keeps point samples.
    step: The usual spacing of the samples, s.
    rate: Spindle rate, rad/s.
    reject_outliers: True: outlying samples are looked for.
    """

    def __init__(
        self, block: int, step: float, rate: float, *, reject_outliers: bool = True
    ) -> None:
        self._block = block
        self._step = step
        self._rate = rate
        self._reject_outliers = reject_outliers
        # A product with a constant vector is the fastest sum along short rows.
        self._mean = np.full(block, 1 / block)

    def average(self, chunk: Chunk, unevenness: float) -> AveragedChunk:
        """Reduce one chunk."""
        time, signals = chunk.time, chunk.signals
        outliers = [np.empty(0, dtype=int) for _ in signals]
        if self._reject_outliers:
            outliers = [
                detect_outliers(time, x, self._rate, self._step, unevenness) for x in signals
            ]
        rowwise = unevenness < _ROW_UNEVENNESS
        if self._block == 1:
            return AveragedChunk(_point_blocks(chunk, outliers), outliers, False)
        if rowwise and not any(len(indices) for indices in outliers):
            blocks = self._mean_complete(chunk, unevenness)
            # The mean over a sample that is no number is none either.
            if all(np.isfinite(x).all() for x in blocks.signals):
                return AveragedChunk(blocks, outliers, True)
        usable = [np.isfinite(x) for x in signals]
        for mask, indices in zip(usable, outliers, strict=True):
            mask[indices] = False
        return AveragedChunk(self._mean_incomplete(chunk, usable, rowwise), outliers, False)

    def _mean_complete(self, chunk: Chunk, unevenness: float) -> BlockMeans:
        size, time = self._block, chunk.time
        full_samples = len(time) // size * size
        tail = len(time) - full_samples

        def means(x: np.ndarray) -> np.ndarray:
            mean: np.ndarray = x[:full_samples].reshape(-1, size) @ self._mean
            return np.append(mean, x[full_samples:].mean()) if tail else mean

        mean_time = means(time)
        count = np.full(len(mean_time), size)
        mean_angle = None if chunk.angle is None else means(chunk.angle)

        def spreads(x: np.ndarray, mean: np.ndarray) -> np.ndarray:
            deviation = x[:full_samples].reshape(-1, size) - mean[: full_samples // size, None]
            spread = np.sqrt(np.einsum("ij,ij->i", deviation, deviation) / size)
            return np.append(spread, x[full_samples:].std()) if tail else spread

        angle_sd = np.full(len(mean_time), math.nan)
        if unevenness < _IGNORED_UNEVENNESS:
            sd = np.full(len(mean_time), self._step * math.sqrt((size**2 - 1) / 12))
        else:
            sd = spreads(time, mean_time)
            if chunk.angle is not None and mean_angle is not None:
                angle_sd = spreads(chunk.angle, mean_angle)
        if tail:
            sd[-1] = time[full_samples:].std()
            count[-1] = tail
        signals = [means(x) for x in chunk.signals]
        return BlockMeans(mean_time, sd, count, mean_angle, signals, angle_sd)

    def _mean_incomplete(self, chunk: Chunk, usable: list[np.ndarray], by_rows: bool) -> BlockMeans:
        """Reduce a chunk with gaps, empty cells or outliers."""
        time = chunk.time
        if by_rows:
            indices = np.arange(len(time)) // self._block
        else:
            span = self._block * self._step
            indices = np.floor((time - time[0] + 0.5 * self._step) / span).astype(int)
        starts = np.flatnonzero(np.diff(indices, prepend=-1))
        rows = np.diff(starts, append=len(time))
        indices = np.repeat(np.arange(len(starts)), rows)
        # One set of rows serves the whole block, so that time and angle are the means of the very
        # samples that the signals are means of. A signal that lacks most of a block is left out
        # of it, rather than costing the others their samples.
        is_missing = [np.add.reduceat(mask.astype(int), starts) * 2 < rows for mask in usable]
        is_used = np.ones(len(time), dtype=bool)
        for mask, missing_rows in zip(usable, is_missing, strict=True):
            is_used &= mask | missing_rows[indices]
        count = np.add.reduceat(is_used.astype(int), starts)
        is_filled = count > 0
        divisor = np.maximum(count, 1)

        def means(x: np.ndarray) -> np.ndarray:
            return np.add.reduceat(np.where(is_used, x, 0.0), starts) / divisor

        mean_time = means(time)
        sd = np.sqrt(means((time - mean_time[indices]) ** 2))
        mean_angle, angle_sd = None, np.full(len(sd), math.nan)
        if chunk.angle is not None:
            mean_angle = means(chunk.angle)
            angle_sd = np.sqrt(means((chunk.angle - mean_angle[indices]) ** 2))
        return BlockMeans(
            mean_time[is_filled],
            sd[is_filled],
            count[is_filled],
            None if mean_angle is None else mean_angle[is_filled],
            [
                np.where(missing_rows, np.nan, means(np.where(np.isfinite(x), x, 0.0)))[is_filled]
                for x, missing_rows in zip(chunk.signals, is_missing, strict=True)
            ],
            angle_sd[is_filled],
        )


def _point_blocks(chunk: Chunk, outliers: list[np.ndarray]) -> BlockMeans:
    """Return every sample as a block of its own."""
    # Copies: the next chunk overwrites this one.
    signals = [x.copy() for x in chunk.signals]
    for x, indices in zip(signals, outliers, strict=True):
        x[indices] = np.nan
    rows = len(chunk)
    angle = None if chunk.angle is None else chunk.angle.copy()
    none, count = np.zeros(rows), np.ones(rows, dtype=int)
    return BlockMeans(chunk.time.copy(), none, count, angle, signals, none.copy())
