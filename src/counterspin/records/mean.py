"""The mean of a record over whole revolutions, and how uncertain its scatter leaves it.

- `mean_of_record`, `RecordMean`
- `stretches`: how many stretches of a record are compared
"""

from __future__ import annotations

import math
from hashlib import sha256
from pathlib import Path
from typing import Final

import numpy as np

from counterspin.errors import RecordError
from counterspin.frozen import frozen
from counterspin.records.dialect import TO_BE_FOUND, Dialect
from counterspin.records.memory import MemoryTable
from counterspin.records.record import ColumnSpec
from counterspin.records.tables import locate, read_scaled

#: Stretches of a record whose means scatter; the fewest, and the most.
_STRETCHES: Final = (8, 64)

#: Waves that a revolution may make in the output beside its mean, such as the Earth's rate does.
_HARMONICS: Final = 2

#: Empty cells and rows of text beyond this part of a record are too many.
_EMPTY: Final = 0.05


@frozen
class RecordMean:
    """The mean of a record.

    Attributes
    ----------
    value, u
        Mean and its standard uncertainty, in the signal's unit.
    samples
        That were used.
    revolutions
        Whole ones that were used; 0 at rest.
    digest
        What another record has too only if all its samples are the same; None where they do not
        differ among themselves, as those of a meter of few digits, and so tell nothing.
    """

    value: float
    u: float
    samples: int
    revolutions: int
    digest: bytes | None = None


def mean_of_record(
    path: Path | MemoryTable,
    time: ColumnSpec,
    signal: ColumnSpec,
    rate: float,
    dialect: Dialect = TO_BE_FOUND,
) -> RecordMean:
    """Return the mean of a signal over the whole revolutions of a record.

    The waves that a revolution makes are fitted beside the mean, so that samples that do not
    divide a revolution evenly do no harm. The uncertainty is from the scatter of the means of
    consecutive stretches, so that noise which is not white counts.

    Parameters
    ----------
    path
        The record, a file or a table in memory.
    time, signal
        Their columns; time in s after its factor.
    rate
        Of the spindle, rad/s; 0 at rest, where the whole record counts.
    dialect
        How the file is written, as far as that is known.

    Raises
    ------
    RecordError
        If the file cannot be read, time does not run forward, more than 5 % is empty, or it is
        shorter than a revolution or than 16 samples.
    """
    t, y = read_scaled(path, [time, signal], dialect)
    whole = np.isfinite(t) & np.isfinite(y)
    if whole.mean() < 1.0 - _EMPTY:
        raise RecordError(f"{path}: {1.0 - whole.mean():.0%} of the rows are empty; 5 % may be.")
    rows, t, y = np.flatnonzero(whole), t[whole], y[whole]
    backwards = np.flatnonzero(np.diff(t) <= 0.0)
    if backwards.size:
        where = locate(path, int(rows[backwards[0] + 1]))
        raise RecordError(f"{path}, {where}: time does not run forward.")
    # Of all: how much of them counts hangs on the rate that the run states.
    differs = y.size and np.ptp(y) > 0.0
    digest = sha256(t.tobytes() + y.tobytes()).digest() if differs else None
    turns = math.floor((t[-1] - t[0]) * abs(rate) / (2.0 * math.pi) + 1e-9) if t.size > 1 else 0
    if rate and turns < 1:
        raise RecordError(f"{path}: the record is shorter than a revolution at {rate:.4g} rad/s.")
    if rate:
        inside = t - t[0] < turns * 2.0 * math.pi / abs(rate) * (1.0 + 1e-12)
        t, y = t[inside], y[inside]
    if y.size < 2 * _STRETCHES[0]:
        raise RecordError(f"{path}: {y.size} samples are too few for a mean and its uncertainty.")
    angle = rate * (t - t[0])
    waves = [np.ones_like(t)]
    for n in range(1, _HARMONICS + 1) if rate else ():
        waves += [np.cos(n * angle), np.sin(n * angle)]
    design = np.column_stack(waves)
    fitted = np.linalg.lstsq(design, y, rcond=None)[0]
    left = y - design @ fitted
    count = stretches(turns)
    means = np.array([part.mean() for part in np.array_split(left, count)])
    return RecordMean(
        value=float(fitted[0]),
        u=float(means.std(ddof=1)) / math.sqrt(count),
        samples=int(y.size),
        revolutions=turns,
        digest=digest,
    )


def stretches(revolutions: int) -> int:
    """Return into how many stretches a record is divided, whose means scatter."""
    return min(max(revolutions, _STRETCHES[0]), _STRETCHES[1])
