"""Means over blocks of at most 1/64 revolution, computed chunk by chunk.

A record is split into chunks of a fixed number of rows that fit into the processor cache. Blocks
never extend across two chunks, so that the result depends neither on the length of the record nor
on the batches of the file. In an evenly sampled chunk a block is a number of rows, with missing
rows a time span. Outliers are rejected before averaging; time and angle of a block are means over
the remaining rows.
"""

from __future__ import annotations

import math

import numpy as np

from counterspin.frozen import frozen
from counterspin.records.column_file import Chunk
from counterspin.records.outliers import detect_outliers

#: Smallest number of blocks per revolution, at which averaging does not affect K_II.
BLOCKS_PER_REVOLUTION = 64
#: Largest number of samples in a block.
_BLOCK_SAMPLES = 8192
#: Largest unevenness of time steps for which the times of a block count as evenly spaced.
_IGNORED_UNEVENNESS = 1e-3
#: Largest number of isolated rows beyond a gap.
_MAX_ISOLATED_ROWS = 5
#: Largest unevenness of time steps for which a block is a number of rows, not a time span.
_ROW_UNEVENNESS = 0.5


@frozen
class BlockMeans:
    """Block means (n,): mean and standard deviation of time, s; sample count; angle, rad."""

    time: np.ndarray
    time_sd: np.ndarray
    count: np.ndarray
    angle: np.ndarray | None
    signals: list[np.ndarray]
    #: Standard deviation of the angles in each block, rad; NaN if it follows from the times.
    angle_sd: np.ndarray

    @classmethod
    def concatenate(cls, blocks: list[BlockMeans]) -> BlockMeans:
        """Concatenate block means."""
        return cls(
            np.concatenate([block.time for block in blocks]),
            np.concatenate([block.time_sd for block in blocks]),
            np.concatenate([block.count for block in blocks]),
            None
            if blocks[0].angle is None
            else np.concatenate([block.angle for block in blocks if block.angle is not None]),
            [
                np.concatenate(arrays)
                for arrays in zip(*(block_means.signals for block_means in blocks), strict=True)
            ],
            np.concatenate([block.angle_sd for block in blocks]),
        )


def block_size(step: float, rate: float) -> int:
    """Return the number of samples in a block, 1 unless at least 2 samples fit into a block."""
    max_duration = 2 * math.pi / (BLOCKS_PER_REVOLUTION * abs(rate))
    # The tolerance avoids the loss of a sample if the step divides the block exactly.
    size = math.floor(min(_BLOCK_SAMPLES, max_duration / step * (1 + 1e-9)))
    return size if size >= 2 else 1


def main_segment(blocks: BlockMeans, shortest_gap: float) -> tuple[float, float] | None:
    """Return the time range of a record, s, without isolated rows at its ends; or None.

    A few rows beyond a gap contain little information, but a single wrong one distorts a fit.

    shortest_gap: Smallest gap that isolates rows, s.
    """
    # Half of a block's span is sqrt(3) standard deviations of its even times.
    half_width = math.sqrt(3) * blocks.time_sd
    start, end = (blocks.time - half_width)[1:], (blocks.time + half_width)[:-1]
    midpoints = (start + end) / 2
    gaps = np.flatnonzero(start - end > shortest_gap)
    samples_before = np.cumsum(blocks.count)[gaps]
    gaps_at_start = gaps[samples_before <= _MAX_ISOLATED_ROWS]
    gaps_at_end = gaps[blocks.count.sum() - samples_before <= _MAX_ISOLATED_ROWS]
    if not len(gaps_at_start) and not len(gaps_at_end):
        return None
    first = float(midpoints[gaps_at_start[-1]]) if len(gaps_at_start) else -math.inf
    last = float(midpoints[gaps_at_end[0]]) if len(gaps_at_end) else math.inf
    return first, last


@frozen
class AveragedChunk:
    """The block means of a chunk."""

    blocks: BlockMeans  #: Block means.
    outliers: list[np.ndarray]  #: Indices of the outliers of each signal.
    is_complete: bool  #: Whether all samples are known to be numbers.


class BlockAverager:
    """Reduces chunks of a record to block means.

    block: Samples in a block; 1 keeps single samples.
    step: Typical time step, s.
    rate: Spindle rate, rad/s.
    reject_outliers: Whether outliers are rejected.
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
                detect_outliers(time, signal, self._rate, self._step, unevenness)
                for signal in signals
            ]
        is_rowwise = unevenness < _ROW_UNEVENNESS
        if self._block == 1:
            return AveragedChunk(_point_blocks(chunk, outliers), outliers, False)
        if is_rowwise and not any(len(indices) for indices in outliers):
            blocks = self._mean_complete(chunk, unevenness)
            # The mean of a block with a missing sample is NaN.
            if all(np.isfinite(signal).all() for signal in blocks.signals):
                return AveragedChunk(blocks, outliers, True)
        is_usable = [np.isfinite(signal) for signal in signals]
        for mask, indices in zip(is_usable, outliers, strict=True):
            mask[indices] = False
        return AveragedChunk(self._mean_incomplete(chunk, is_usable, is_rowwise), outliers, False)

    def _mean_complete(self, chunk: Chunk, unevenness: float) -> BlockMeans:
        size, time = self._block, chunk.time
        full_samples = len(time) // size * size
        n_tail = len(time) - full_samples

        def average_blocks(x: np.ndarray) -> np.ndarray:
            mean: np.ndarray = x[:full_samples].reshape(-1, size) @ self._mean
            return np.append(mean, x[full_samples:].mean()) if n_tail else mean

        mean_time = average_blocks(time)
        count = np.full(len(mean_time), size)
        mean_angle = None if chunk.angle is None else average_blocks(chunk.angle)

        def block_sds(x: np.ndarray, mean: np.ndarray) -> np.ndarray:
            deviations = x[:full_samples].reshape(-1, size) - mean[: full_samples // size, None]
            sds = np.sqrt(np.einsum("ij,ij->i", deviations, deviations) / size)
            return np.append(sds, x[full_samples:].std()) if n_tail else sds

        angle_sd = np.full(len(mean_time), math.nan)
        if unevenness < _IGNORED_UNEVENNESS:
            time_sd = np.full(len(mean_time), self._step * math.sqrt((size**2 - 1) / 12))
        else:
            time_sd = block_sds(time, mean_time)
            if chunk.angle is not None and mean_angle is not None:
                angle_sd = block_sds(chunk.angle, mean_angle)
        if n_tail:
            time_sd[-1] = time[full_samples:].std()
            count[-1] = n_tail
        signals = [average_blocks(signal) for signal in chunk.signals]
        return BlockMeans(mean_time, time_sd, count, mean_angle, signals, angle_sd)

    def _mean_incomplete(
        self, chunk: Chunk, is_usable: list[np.ndarray], by_rows: bool
    ) -> BlockMeans:
        """Reduce a chunk with gaps, empty cells or outliers."""
        time = chunk.time
        if by_rows:
            block_indices = np.arange(len(time)) // self._block
        else:
            span = self._block * self._step
            block_indices = np.floor((time - time[0] + 0.5 * self._step) / span).astype(int)
        starts = np.flatnonzero(np.diff(block_indices, prepend=-1))
        row_counts = np.diff(starts, append=len(time))
        block_indices = np.repeat(np.arange(len(starts)), row_counts)
        # All signals use the same rows of a block, so that time and angle are means over the same
        # samples. A signal that lacks most of a block is omitted, so that the others keep their
        # samples.
        is_missing = [
            np.add.reduceat(mask.astype(int), starts) * 2 < row_counts for mask in is_usable
        ]
        is_used = np.ones(len(time), dtype=bool)
        for mask, missing_rows in zip(is_usable, is_missing, strict=True):
            is_used &= mask | missing_rows[block_indices]
        count = np.add.reduceat(is_used.astype(int), starts)
        is_filled = count > 0
        divisor = np.maximum(count, 1)

        def average_blocks(x: np.ndarray) -> np.ndarray:
            return np.add.reduceat(np.where(is_used, x, 0.0), starts) / divisor

        mean_time = average_blocks(time)
        time_sd = np.sqrt(average_blocks((time - mean_time[block_indices]) ** 2))
        mean_angle, angle_sd = None, np.full(len(time_sd), math.nan)
        if chunk.angle is not None:
            mean_angle = average_blocks(chunk.angle)
            angle_sd = np.sqrt(average_blocks((chunk.angle - mean_angle[block_indices]) ** 2))
        return BlockMeans(
            mean_time[is_filled],
            time_sd[is_filled],
            count[is_filled],
            None if mean_angle is None else mean_angle[is_filled],
            [
                np.where(
                    missing_rows, np.nan, average_blocks(np.where(np.isfinite(signal), signal, 0.0))
                )[is_filled]
                for signal, missing_rows in zip(chunk.signals, is_missing, strict=True)
            ],
            angle_sd[is_filled],
        )


def _point_blocks(chunk: Chunk, outliers: list[np.ndarray]) -> BlockMeans:
    """Return every sample as a separate block."""
    # Copies: the next chunk overwrites this one.
    signals = [x.copy() for x in chunk.signals]
    for x, indices in zip(signals, outliers, strict=True):
        x[indices] = np.nan
    rows = len(chunk)
    angle = None if chunk.angle is None else chunk.angle.copy()
    zeros, count = np.zeros(rows), np.ones(rows, dtype=int)
    return BlockMeans(chunk.time.copy(), zeros, count, angle, signals, zeros.copy())
