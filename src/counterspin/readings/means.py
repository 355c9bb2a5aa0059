"""Mean of a signal in a record, with its uncertainty.

The mean is taken over whole revolutions, those of the recorded angle if there is one. The checks of
the record are those of every record: clock, repeated rows, empty cells, gaps and outliers
(`counterspin.records.reading`).

The scatter of the segment means determines u of the mean if the segments are independent. For
correlated noise, this u would be too small, for a random walk by a factor of ten. Therefore u is
the Allan deviation at the length of the record: the rms difference of two successive records over
sqrt 2. The noise is white noise plus flicker (1/f) or plus a random walk, averaged over their
variance ratios with the restricted likelihood of the segment means (Patterson and Thompson,
Biometrika 58 (1971) 545). The model of flicker is that of Kasdin, Proc. IEEE 83 (1995) 802.
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

#: Largest number of segments of a record, and smallest number of samples in a segment.
_MAX_SEGMENTS: Final = 64
_MIN_SEGMENT_ROWS: Final = 3

#: Number of harmonics of a revolution in the output, such as those due to the Earth's rate.
_N_HARMONICS: Final = 2

#: Number of samples in a burst or a dead interval, whose mean is tested for outliers.
_BURST_ROWS: Final = 64

#: Prior probability of white noise alone; the rest is uniform in the logarithm of the variance
#: ratio. With this prior, u for white noise is 1.4 times too large in the median, and covers a
#: barely detectable walk in four of five records.
_WHITE_PRIOR: Final = 0.5

#: Variance of the mean due to coloured noise over that due to white noise.
_VARIANCE_RATIOS: Final = np.geomspace(0.1, 1e5, 13)


@frozen(eq=False)
class RowRotation:
    """The rotation of the spindle at the n rows of a record."""

    angle: Array  #: Spindle angle, rad, shape (n,); constant at rest.
    #: Nominal signal of the centripetal force, in the unit of the signal, shape (n,). Its variation
    #: is removed before the noise is estimated, because drift and ripple are not noise.
    centripetal: Array
    highest_harmonic: int = 0  #: Highest harmonic of the ripple.

    @property
    def is_rotating(self) -> bool:
        """True if the spindle turns."""
        return bool(np.ptp(self.angle) > 0.0)

    def __getitem__(self, rows: np.ndarray) -> RowRotation:
        """Return the rotation at some of the rows."""
        return RowRotation(self.angle[rows], self.centripetal[rows], self.highest_harmonic)


def stated_rotation(time: Array, rate: float) -> RowRotation:
    """Return a rotation at the stated rate.

    time: Times of the rows, s, shape (n,).
    rate: rad/s; 0 at rest.
    """
    return RowRotation(rate * time, np.zeros_like(time))


@frozen
class RecordMean:
    """The mean of a record."""

    value: float  #: Mean, in the unit of the signal.
    u: float  #: Standard uncertainty of the mean.
    samples: int  #: Number of samples used.
    revolutions: int  #: Number of whole revolutions used; 0 at rest.
    report: RecordReport  #: Report of the record; its outliers include those rejected here.
    #: Digest of all samples, to detect duplicate records; None if all samples are equal.
    digest: bytes | None = None


def read_rows(path: Path | MemoryTable, columns: RecordColumns, rate: float) -> Record:
    """Return all rows of a record whose mean is a reading.

    columns: Time, the angle if it was recorded, and one signal.
    rate: Stated rate, rad/s; 0 at rest, where no angle is read.
    """
    return read_record(path, columns, NominalMotion(rate, has_constant_input=True), block=None)


def mean_of_record(
    record: Record, column: str, rotation: RowRotation
) -> tuple[RecordMean, np.ndarray]:
    """Return the mean of a signal over whole revolutions, and the rows that were used.

    Harmonics of a revolution are fitted together with the mean, because the samples may not divide
    a revolution evenly. The uncertainty is the expected difference of the next record of the same
    length, over sqrt 2.

    record: All rows, with one signal.
    column: Name of the signal in the count of outliers.
    rotation: Rotation at these rows; at rest, the whole record is used.
    Returns: the mean, and the indices of the rows, shape (m,).
    """
    ((_, signal),) = record.signals.items()
    rows = np.flatnonzero(np.isfinite(signal))
    t, y = record.time[rows], signal[rows]
    # The digest covers all rows, because the rows used depend on the rate.
    has_variation = y.size and np.ptp(y) > 0.0
    digest = sha256(t.tobytes() + y.tobytes()).digest() if has_variation else None
    revolutions = 0
    if y.size and rotation.is_rotating:
        angles = np.abs(rotation.angle[rows] - rotation.angle[rows[0]])
        revolutions = math.floor(angles[-1] / (2.0 * math.pi) + 1e-9)
        rows = rows[angles < revolutions * 2.0 * math.pi * (1.0 + 1e-12)]
    if rows.size < MIN_SAMPLES:
        raise RecordError(
            f"{record.report.path}: {rows.size} samples are too few to calculate a mean and its "
            "uncertainty.",
            code="record-too-short",
        )
    is_burst = _burst_mask(record.time[rows], signal[rows], rotation[rows])
    rows = rows[~is_burst]
    value, residuals = _fit_offset(signal[rows], rotation[rows])
    segments = np.array_split(residuals, count_segments(rows.size))
    outliers = record.report.outliers[column] + int(is_burst.sum())
    mean = RecordMean(
        value=value,
        u=u_of_mean(np.array([segment.mean() for segment in segments])),
        samples=int(rows.size),
        revolutions=revolutions,
        report=replace(record.report, outliers={**record.report.outliers, column: outliers}),
        digest=digest,
    )
    return mean, rows


def count_segments(n_samples: int) -> int:
    """Return the number of segments of a record."""
    return min(_MAX_SEGMENTS, n_samples // _MIN_SEGMENT_ROWS)


def _fit_offset(y: Array, rotation: RowRotation) -> tuple[float, Array]:
    """Return the mean of a signal without harmonics of a revolution, and the residuals, (n,)."""
    y = y - (rotation.centripetal - rotation.centripetal.mean())
    angle = rotation.angle - rotation.angle[0]
    columns = [np.ones_like(y)]
    max_harmonic = max(_N_HARMONICS, rotation.highest_harmonic)
    for n in range(1, max_harmonic + 1) if rotation.is_rotating else ():
        columns += [np.cos(n * angle), np.sin(n * angle)]
    design = np.column_stack(columns)
    coefficients = np.linalg.lstsq(design, y, rcond=None)[0]
    return float(coefficients[0]), y - design @ coefficients


def _burst_mask(t: Array, y: Array, rotation: RowRotation) -> np.ndarray:
    """Return the mask of the samples in intervals whose mean is an outlier, shape (n,)."""
    count = y.size // _BURST_ROWS
    mask = np.zeros(y.size, dtype=bool)
    if count < MIN_SAMPLES:
        return mask
    boundaries = np.linspace(0, y.size, count + 1).astype(int)
    lengths = np.diff(boundaries)
    # At rest, the median is not affected by a burst of a third of the record.
    residuals = _fit_offset(y, rotation)[1] if rotation.is_rotating else y - median(y)
    means, times = (np.add.reduceat(column, boundaries[:-1]) / lengths for column in (residuals, t))
    steps = np.diff(times)
    step = median(steps)
    max_relative_deviation = float(np.abs(steps / step - 1.0).max())
    for index in detect_outliers(times, means, 0.0, step, max_relative_deviation):
        mask[boundaries[index] : boundaries[index + 1]] = True
    return mask


def u_of_mean(means: Array) -> float:
    """Return the standard uncertainty of the mean of a record.

    means: Means of its successive segments of equal length, shape (n,), n >= 3.
    """
    count = means.size
    dof = count - 1
    if not np.ptp(means) > 0.0:
        return 0.0
    scaled_means = means / means.std()
    log_weights, mean_variances = [], []
    variance_ratios = np.append(0.0, _VARIANCE_RATIOS)
    prior = np.append(_WHITE_PRIOR, np.full(_VARIANCE_RATIOS.size, 0.5 * (1.0 - _WHITE_PRIOR)))
    prior[1:] /= _VARIANCE_RATIOS.size
    for eigenvalues, contrasts in _colored_noise_contrasts(count):
        variances = 1.0 + variance_ratios[:, None] * eigenvalues
        sums_of_squares = np.sum((scaled_means @ contrasts) ** 2 / variances, axis=1)
        log_likelihoods = -0.5 * np.log(variances).sum(axis=1) - 0.5 * dof * np.log(sums_of_squares)
        # White noise alone is contained in both kinds.
        log_weights.append(log_likelihoods + np.log(np.append(0.5 * prior[0], prior[1:])))
        mean_variances.append(sums_of_squares / dof * (1.0 + variance_ratios) / count)
    posterior = np.exp(np.concatenate(log_weights) - np.max(log_weights))
    variance_of_mean = float(posterior @ np.concatenate(mean_variances)) / float(posterior.sum())
    return math.sqrt(variance_of_mean) * float(means.std())


@lru_cache(maxsize=8)
def _colored_noise_contrasts(count: int) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return for flicker and walk the variances of uncorrelated contrasts of n means, and these.

    They are scaled such that the mean of all has the same variance as for white noise of unit
    variance; shapes (n-1,) and (n, n-1).
    """
    steps = np.arange(1.0, 2.0 * count)
    response = np.append(1.0, np.cumprod((steps - 0.5) / steps))
    lag = np.subtract.outer(np.arange(2 * count), np.arange(2 * count))
    flicker = np.where(lag >= 0, response[np.abs(lag)], 0.0)
    walk = np.tril(np.ones((2 * count, 2 * count)))
    difference = np.repeat([-1.0 / count, 1.0 / count], count)
    # Contrasts: the last rows of an orthogonal matrix whose first row is constant.
    contrasts = np.linalg.svd(np.ones((1, count)))[2][1:].T
    contrast_sets = []
    for process_matrix in (flicker, walk):
        covariance = process_matrix @ process_matrix.T
        unit_variance = 0.5 * float(difference @ covariance @ difference) * count
        eigenvalues, rotation = np.linalg.eigh(
            contrasts.T @ covariance[:count, :count] @ contrasts / unit_variance
        )
        contrast_sets.append((np.maximum(eigenvalues, 0.0), contrasts @ rotation))
    return contrast_sets[0], contrast_sets[1]
