"""The mean of a signal in a record, with its uncertainty.

The mean is that over whole revolutions, which are those of the recorded angle where there is one.
The record passes what any record passes: its clock, repeated rows, empty cells, gaps and outliers
(`counterspin.records.reading`).

The scatter of a record's own stretches tells u of its mean where they are independent. Where the
level wanders they are alike, and u would be too small, of a walk by a factor of ten. So u is
what two records of this length, one after the other, differ by (over sqrt 2: the Allan deviation
at the record's length), of white noise with flicker (1/f) or with a random walk beside it, in all
proportions, each weighted with the restricted likelihood that the stretches' means give it
(Patterson and Thompson, Biometrika 58 (1971) 545). Flicker is that of Kasdin, Proc. IEEE 83
(1995) 802.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Final

import numpy as np

from counterspin.arrays import Array, median
from counterspin.errors import RecordError
from counterspin.frozen import frozen
from counterspin.records.memory import MemoryTable
from counterspin.records.outliers import MIN_SAMPLES, detect_outliers
from counterspin.records.reading import read_record
from counterspin.records.record import NominalMotion, Record, RecordColumns, RecordReport

#: Most stretches of a record whose means tell its noise; fewest samples of one.
_MAX_SEGMENTS: Final = 64
_MIN_SEGMENT_ROWS: Final = 3

#: Waves that a revolution may make in the output beside its mean, such as the Earth's rate does.
_HARMONICS: Final = 2

#: Samples of a burst or of a dead stretch, whose mean stands off where no single one does.
_BURST_ROWS: Final = 64

#: Weight of white noise alone before the record is looked at; the rest is shared out evenly among
#: the logarithms of the proportions. With it u of white noise is 1.4 times too large in the
#: median, and covers a walk that a record hardly shows in four of five records.
_WHITE_PRIOR: Final = 0.5

#: Variance of the mean by the wander over that by white noise.
_PROPORTIONS: Final = np.geomspace(0.1, 1e5, 13)


@frozen(eq=False)
class RowRotation:
    """The rotation of the spindle at the n rows of a record."""

    angle: Array  #: rad, shape (n,); the same everywhere at rest.
    #: The nominal signal of the centripetal force, in the signal's unit, shape (n,). Its variation
    #: about its mean is removed before the noise is judged, since drift and ripple are not noise.
    centripetal: Array
    highest_harmonic: int = 0  #: Of the ripple that the rate may have.

    @property
    def turns(self) -> bool:
        """Whether the spindle turns."""
        return bool(np.ptp(self.angle) > 0.0)

    def __getitem__(self, rows: np.ndarray) -> RowRotation:
        """Return the rotation at some of the rows."""
        return RowRotation(self.angle[rows], self.centripetal[rows], self.highest_harmonic)


def stated_rotation(time: Array, rate: float) -> RowRotation:
    """Return a rotation at the stated rate.

    time: Of the rows, s, shape (n,).
    rate: rad/s; 0 at rest.
    """
    return RowRotation(rate * time, np.zeros_like(time))


@frozen
class RecordMean:
    """The mean of a record."""

    #: Mean and its standard uncertainty, in the signal's unit.
    value: float
    u: float
    samples: int  #: That were used.
    revolutions: int  #: Whole ones that were used; 0 at rest.
    report: RecordReport  #: What reading found; samples left out here are among its outliers.
    #: What another record has too only if all its samples are the same; None where they do not
    #: differ among themselves, as those of a meter of few digits, and so tell nothing.
    digest: bytes | None = None


def read_rows(path: Path | MemoryTable, columns: RecordColumns, rate: float) -> Record:
    """Return all rows of a record whose mean is a reading.

    columns: Time, the angle where it is recorded, and one signal.
    rate: The stated rate, rad/s; 0 at rest, where no angle is read.
    """
    return read_record(path, columns, NominalMotion(rate, constant_input=True), block=None)


def mean_of_record(
    record: Record, column: str, rotation: RowRotation
) -> tuple[RecordMean, np.ndarray]:
    """Return the mean of a signal over whole revolutions, and the rows that were used.

    The waves of a revolution are fitted together with the mean, so that samples that do not divide
    a revolution evenly do no harm. The uncertainty is that by which the next record of the same
    length would differ, as far as this record shows it.

    record: All rows, with one signal.
    column: The signal's, under whose name outliers are counted.
    rotation: The rotation at these rows; at rest the whole record counts.
    Returns: the mean, and the places of the rows, shape (m,).
    """
    ((_, signal),) = record.signals.items()
    rows = np.flatnonzero(np.isfinite(signal))
    t, y = record.time[rows], signal[rows]
    # Of all rows: the rate decides how many of them count.
    varies = y.size and np.ptp(y) > 0.0
    digest = sha256(t.tobytes() + y.tobytes()).digest() if varies else None
    turns = 0
    if y.size and rotation.turns:
        angles = np.abs(rotation.angle[rows] - rotation.angle[rows[0]])
        turns = math.floor(angles[-1] / (2.0 * math.pi) + 1e-9)
        rows = rows[angles < turns * 2.0 * math.pi * (1.0 + 1e-12)]
    if rows.size < MIN_SAMPLES:
        raise RecordError(
            f"{record.report.path}: {rows.size} samples are too few for a mean and its "
            "uncertainty.",
            code="record-too-short",
        )
    burst = _burst_mask(record.time[rows], signal[rows], rotation[rows])
    rows = rows[~burst]
    value, residuals = _fit_offset(signal[rows], rotation[rows])
    segments = np.array_split(residuals, segment_count(rows.size))
    outliers = record.report.outliers[column] + int(burst.sum())
    mean = RecordMean(
        value=value,
        u=u_of_mean(np.array([segment.mean() for segment in segments])),
        samples=int(rows.size),
        revolutions=turns,
        report=replace(record.report, outliers={**record.report.outliers, column: outliers}),
        digest=digest,
    )
    return mean, rows


def segment_count(samples: int) -> int:
    """Return into how many stretches a record is divided."""
    return min(_MAX_SEGMENTS, samples // _MIN_SEGMENT_ROWS)


def _fit_offset(y: Array, rotation: RowRotation) -> tuple[float, Array]:
    """Return the mean of a signal without the waves of a revolution, and the residuals, (n,)."""
    y = y - (rotation.centripetal - rotation.centripetal.mean())
    angle = rotation.angle - rotation.angle[0]
    waves = [np.ones_like(y)]
    highest = max(_HARMONICS, rotation.highest_harmonic)
    for n in range(1, highest + 1) if rotation.turns else ():
        waves += [np.cos(n * angle), np.sin(n * angle)]
    design = np.column_stack(waves)
    coefficients = np.linalg.lstsq(design, y, rcond=None)[0]
    return float(coefficients[0]), y - design @ coefficients


def _burst_mask(t: Array, y: Array, rotation: RowRotation) -> np.ndarray:
    """Return a mask of the samples in stretches whose mean is an outlier, shape (n,)."""
    count = y.size // _BURST_ROWS
    mask = np.zeros(y.size, dtype=bool)
    if count < MIN_SAMPLES:
        return mask
    edges = np.linspace(0, y.size, count + 1).astype(int)
    lengths = np.diff(edges)
    # Medians: a burst of a third of the record must not make waves.
    residuals = _fit_offset(y, rotation)[1] if rotation.turns else y - median(y)
    means, times = (np.add.reduceat(column, edges[:-1]) / lengths for column in (residuals, t))
    steps = np.diff(times)
    step = median(steps)
    uneven = float(np.abs(steps / step - 1.0).max())
    for index in detect_outliers(times, means, 0.0, step, uneven):
        mask[edges[index] : edges[index + 1]] = True
    return mask


def u_of_mean(means: Array) -> float:
    """Return the standard uncertainty of the mean of a record.

    means: Of its stretches, equally long, one after the other, shape (n,), n >= 3.
    """
    count = means.size
    dof = count - 1
    if not np.ptp(means) > 0.0:
        return 0.0
    scaled_means = means / means.std()
    weight, variance = [], []
    proportions = np.append(0.0, _PROPORTIONS)
    prior = np.append(_WHITE_PRIOR, np.full(_PROPORTIONS.size, 0.5 * (1.0 - _WHITE_PRIOR)))
    prior[1:] /= _PROPORTIONS.size
    for sizes, contrasts in _colored_noise_contrasts(count):
        spread = 1.0 + proportions[:, None] * sizes
        squares = np.sum((scaled_means @ contrasts) ** 2 / spread, axis=1)
        log = -0.5 * np.log(spread).sum(axis=1) - 0.5 * dof * np.log(squares)
        # White noise alone stands once in each of the two kinds.
        weight.append(log + np.log(np.append(0.5 * prior[0], prior[1:])))
        variance.append(squares / dof * (1.0 + proportions) / count)
    posterior = np.exp(np.concatenate(weight) - np.max(weight))
    variance_of_mean = float(posterior @ np.concatenate(variance)) / float(posterior.sum())
    return math.sqrt(variance_of_mean) * float(means.std())


@lru_cache(maxsize=8)
def _colored_noise_contrasts(count: int) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return flicker and walk of n means: n-1 variances of uncorrelated contrasts, and these.

    Their scale is that at which the mean of all has the variance that white noise of unit
    variance gives it; shapes (n-1,) and (n, n-1).
    """
    steps = np.arange(1.0, 2.0 * count)
    response = np.append(1.0, np.cumprod((steps - 0.5) / steps))
    lag = np.subtract.outer(np.arange(2 * count), np.arange(2 * count))
    flicker = np.where(lag >= 0, response[np.abs(lag)], 0.0)
    walk = np.tril(np.ones((2 * count, 2 * count)))
    difference = np.repeat([-1.0 / count, 1.0 / count], count)
    # Whatever has no mean: the last rows of an orthogonal matrix whose first is even.
    contrasts = np.linalg.svd(np.ones((1, count)))[2][1:].T
    results = []
    for shape in (flicker, walk):
        covariance = shape @ shape.T
        unit = 0.5 * float(difference @ covariance @ difference) * count
        eigenvalues, rotation = np.linalg.eigh(
            contrasts.T @ covariance[:count, :count] @ contrasts / unit
        )
        results.append((np.maximum(eigenvalues, 0.0), contrasts @ rotation))
    return results[0], results[1]
