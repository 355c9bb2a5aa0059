"""Pieces of a record: consecutive rows, few enough for the processor's cache."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import chain

import numpy as np

from counterspin.arrays import aligned
from counterspin.frozen import frozen

Columns = dict[str, np.ndarray]

#: Rows in a piece, about: three columns of them fit the processor's second cache.
_PIECE_ROWS = 65536


@frozen
class Piece:
    """Consecutive rows of a record, arrays (n,), NaN where a cell is empty."""

    time: np.ndarray  #: s since the record's first sample.
    angle: np.ndarray | None  #: rad; None when the file has no angle column.
    signals: list[np.ndarray]  #: One array for each accelerometer, in the unit of its column.

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.time)

    def __getitem__(self, rows: np.ndarray) -> Piece:
        """Return the rows at (m,) places, or those that a (n,) mask marks."""
        angle = None if self.angle is None else self.angle[rows]
        return Piece(self.time[rows], angle, [signal[rows] for signal in self.signals])

    @property
    def columns(self) -> list[np.ndarray]:
        """Time, the angle if there is one, and the signals."""
        return [self.time, *([] if self.angle is None else [self.angle]), *self.signals]


def piece_rows(block: int) -> int:
    """Return the rows to a piece: a whole number of blocks."""
    return block * max(1, _PIECE_ROWS // block)


def in_pieces(
    batches: Iterator[Columns], choose_rows: Callable[[Columns], int]
) -> Iterator[Columns]:
    """Yield columns in pieces of a fixed number of rows, however the file was batched.

    batches: Consecutive batches of the file's columns.
    """
    head: list[Columns] = []
    for batch in batches:
        head.append(batch)
        if sum(map(column_rows, head)) >= piece_rows(1):
            break
    if not sum(map(column_rows, head)):
        return
    first = joined(head)
    size = choose_rows(first)
    # What lies across two batches is brought together in a buffer; the rest are views.
    buffer = dict(zip(first, aligned(len(first), size), strict=True))
    filled = 0
    for batch in chain([first], batches):
        rows = column_rows(batch)
        start = 0
        while start < rows:
            stop = min(start + size - filled, rows)
            if stop - start == size:
                yield {name: column[start:stop] for name, column in batch.items()}
            else:
                for name, column in batch.items():
                    buffer[name][filled : filled + stop - start] = column[start:stop]
                filled += stop - start
            if filled == size:
                yield buffer
                filled = 0
            start = stop
    if filled:
        yield {name: column[:filled] for name, column in buffer.items()}


def joined(batches: list[Columns]) -> Columns:
    """Return the columns of several batches, one batch after the other."""
    if len(batches) == 1:
        return batches[0]
    return {name: np.concatenate([batch[name] for batch in batches]) for name in batches[0]}


def column_rows(columns: Columns) -> int:
    """Return the length of the columns."""
    return len(next(iter(columns.values())))
