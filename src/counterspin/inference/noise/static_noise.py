"""Noise components of a record of a sensor at rest, which is cleaned and split at its gaps.

The likelihood and its search are those of all other records. Bias and linear drift are unknown too.
A component is kept if its gain in likelihood reaches `MIN_LIKELIHOOD_GAIN`. Intervals are those of
the profile likelihood, by chi-square with one degree of freedom (Venzon and Moolgavkar, Applied
Statistics 37 (1988) 87). The profile varies all other components, including undetected ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.arrays import Array, median
from counterspin.errors import NotIdentifiableError, RecordError
from counterspin.frozen import frozen
from counterspin.inference.noise.bias_instability import Variances
from counterspin.inference.noise.components import COMPONENTS, Sampling
from counterspin.inference.noise.even_sampling import EvenlySampledData, TransformedRecord
from counterspin.inference.noise.likelihood import RestrictedLikelihood
from counterspin.inference.noise.model import ESTIMATE, SPECIFIC_FORCE, Noise
from counterspin.inference.noise.samples import SensorSamples
from counterspin.inference.noise.search import MIN_LIKELIHOOD_GAIN, Maximum, NoiseModelCandidate
from counterspin.inference.noise.spectrum import SpectralLine, find_lines
from counterspin.records.outliers import detect_outliers

#: Largest number of successive missing samples in a segment. If samples are lost at random, the
#: limit is the number that a record exceeds with a small probability, up to a maximum.
_MAX_MISSING: Final = 3
_MAX_LOST_SAMPLES: Final = 30
_LONG_GAP_PROBABILITY: Final = 0.01
#: Largest fraction of samples lost at random.
_MAX_LOST_FRACTION: Final = 0.35
#: Missing samples are interpolated if this changes N by less than this fraction of its u;
#: otherwise, they are omitted.
_MAX_FILLING_EFFECT: Final = 0.2

#: Largest deviation of a sample from a regular clock, in steps.
_MAX_CLOCK_DEVIATION: Final = 0.3

#: Smallest number of samples of a segment.
_MIN_SAMPLES: Final = 32

#: Largest number of samples; longer records are decimated.
MAX_SAMPLES: Final = 300_000

#: Changes of 2 log L at the limits of a 95 % interval, and at the upper limit of an undetected
#: component.
_TWO_SIDED_CHANGE: Final = 3.841458820694124
_ONE_SIDED_CHANGE: Final = MIN_LIKELIHOOD_GAIN

#: Steps of the initial variances, and largest number of steps to a limit of an interval.
_MULTIPLICATIVE_STEPS: Final = 60
_MAX_LIMIT_STEPS: Final = 12

#: Tolerance of a limit, in sqrt(2 log L).
_LIMIT_TOLERANCE: Final = 0.05

#: Number of bands per decade in the comparison of spectrum and noise.
_BANDS_PER_DECADE: Final = 4.0


@frozen(eq=False)
class Segments:
    """Segments of a record between gaps."""

    step: float  #: Mean time between samples in the segments, s.
    recorded_fraction: (
        float  #: Fraction of recorded samples; 1 if missing samples are interpolated.
    )
    segments: tuple[tuple[float, Array], ...]  #: Time of the first sample, s, and samples, SI.
    rows: int  #: Number of rows of the record.
    outliers: int  #: Number of rejected outliers.
    filled: int  #: Number of missing samples in the segments, including outliers.
    gaps: int  #: Number of gaps between the segments.
    unused: int  #: Number of samples in segments that are too short.
    resolution: float  #: Smallest difference between samples, SI.
    repeated: int = 0  #: Rows that repeat the previous value, as in a log faster than the sensor.
    restamped: int = 0  #: Rows that repeat the previous time with another value.
    stuck: int = 0  #: Rows in long intervals of a constant value, which are not used.

    @property
    def sample_interval(self) -> float:
        """Time between samples of the sensor, s."""
        return self.step * self.recorded_fraction

    @property
    def longest(self) -> tuple[float, Array]:
        """Longest segment."""
        return max(self.segments, key=lambda segment: segment[1].size)


@frozen(eq=False)
class StaticAnalysis:
    """Noise estimates from a record."""

    noise: StaticNoise
    recorded: Variances  #: Variances of the series of recorded samples, as in `StaticNoise`.
    lines: tuple[SpectralLine, ...]
    step: float  #: Time between the samples used, s.
    velocity: Array  #: Integral of the specific force of the longest segment, without lines, m/s.
    kind: Sampling


@frozen(eq=False)
class StaticSignal:
    """One column of a record at rest."""

    name: str  #: Name of the accelerometer, or of the column.
    column: str  #: Name of the column in the file.
    order: int  #: 2 displacement, 1 velocity, 0 specific force.
    in_g: bool  #: True if the values are in g.
    time: Array  #: s, shape (n,); NaN: missing.
    values: Array  #: SI, shape (n,); NaN: missing.


@frozen(eq=False)
class StaticRecord:
    """Noise estimates from one column."""

    signal: StaticSignal
    segments: Segments
    analysis: StaticAnalysis


def analyse_static_record(record_name: object, signal: StaticSignal) -> StaticRecord:
    """Return the noise estimates from a column; RecordError if they are not possible.

    record_name: Name of the record in messages.
    """
    try:
        segments = split_segments(signal.time, signal.values)
        if np.ptp(segments.longest[1]) == 0.0:
            raise ValueError("all samples are equal: no signal was recorded")
        analysis = analyse(segments, signal.order)
    except (ValueError, NotIdentifiableError) as error:
        raise RecordError(
            f"{record_name}: column '{signal.column}': {error}.", code="not-evaluable"
        ) from error
    return StaticRecord(signal, segments, analysis)


def split_segments(time: Array, values: Array) -> Segments:
    """Return a record without outliers, split at its gaps.

    time, values: s and SI, shape (n,); NaN: missing.
    """
    rows = time.size
    is_finite = np.isfinite(time)
    time, values = time[is_finite], values[is_finite]
    if (np.diff(time) < 0.0).any():
        raise ValueError("the time decreases")
    has_value = np.isfinite(values)
    if has_value.sum() > 1 and median(np.diff(time[has_value])) > 1.5 * median(np.diff(time)):
        # The log also contains rows of other sensors.
        time, values = time[has_value], values[has_value]
    samples = SensorSamples.from_rows(time, values)
    time, values = samples.time, samples.values
    if time.size < _MIN_SAMPLES:
        raise ValueError(f"{time.size} samples are too few: {_MIN_SAMPLES} are required")
    steps = np.diff(time)
    step = median(steps)
    # The median of rounded times is biased; the mean over single steps is not.
    is_single_step = steps < 1.5 * step
    step = float(steps[is_single_step].mean())
    outliers = detect_outliers(time, values, 0.0, step, float(steps[is_single_step].std() / step))
    outliers = outliers[np.isfinite(values[outliers])]
    clean_values = values.copy()
    clean_values[outliers] = np.nan
    is_good = np.isfinite(clean_values)
    good_times, good_values = time[is_good], clean_values[is_good]
    if good_values.size < _MIN_SAMPLES:
        raise ValueError(f"{good_values.size} samples are too few: {_MIN_SAMPLES} are required")
    relative_steps = np.diff(good_times) / step
    cuts = np.flatnonzero(relative_steps > _max_missing_rows(relative_steps) + 1.5) + 1
    segments: list[tuple[float, Array, Array]] = []
    n_unused = 0
    for segment_times, segment_values in zip(
        np.split(good_times, cuts), np.split(good_values, cuts), strict=True
    ):
        if segment_values.size < _MIN_SAMPLES:
            n_unused += segment_values.size
            continue
        nominal_index = np.round(np.concatenate([[0.0], np.cumsum(np.diff(segment_times) / step)]))
        duration = segment_times[-1] - segment_times[0]
        # Each segment has its own step, because a small error of the step accumulates.
        sample_index = np.round((segment_times - segment_times[0]) / (duration / nominal_index[-1]))
        clock_deviation = (segment_times - segment_times[0]) / (
            duration / nominal_index[-1]
        ) - sample_index
        if (
            np.abs(clock_deviation).max() > _MAX_CLOCK_DEVIATION
            or (np.diff(sample_index) < 1.0).any()
        ):
            raise ValueError(
                "the noise analysis requires evenly spaced samples, but the spacing varies; if the "
                "sensor samples at a constant rate and no sample is missing, give "
                "`sampling_rate`; otherwise, resample the record"
            )
        segments.append((float(segment_times[0]), sample_index, segment_values))
    if not segments:
        raise ValueError(f"the record has no {_MIN_SAMPLES} successive samples without a gap")
    n_expected = sum(int(sample_index[-1]) + 1 for _, sample_index, _ in segments)
    n_recorded = sum(segment_values.size for _, _, segment_values in segments)
    recorded_fraction = n_recorded / n_expected
    is_filled = (1.0 - recorded_fraction) * math.sqrt(2.0 * n_recorded) < _MAX_FILLING_EFFECT
    filled_segments = [
        (
            start,
            np.interp(np.arange(sample_index[-1] + 1), sample_index, segment_values)
            if is_filled
            else segment_values,
        )
        for start, sample_index, segment_values in segments
    ]
    recorded_fraction = 1.0 if is_filled else recorded_fraction
    first_values = good_values[:4096] if np.ptp(good_values[:4096]) else good_values
    value_steps = np.diff(np.unique(first_values))
    resolution = float(value_steps.min()) if value_steps.size else 0.0
    return Segments(
        step=step / recorded_fraction,
        recorded_fraction=recorded_fraction,
        segments=tuple(filled_segments),
        rows=rows,
        outliers=outliers.size,
        filled=n_expected - n_recorded,
        gaps=len(filled_segments) - 1,
        unused=n_unused,
        resolution=resolution,
        repeated=samples.repeated,
        restamped=samples.restamped,
        stuck=samples.stuck,
    )


def _max_missing_rows(relative_steps: Array) -> int:
    """Return the largest number of successive missing samples in a segment.

    relative_steps: Time steps between samples, in median steps.
    """
    short_steps = relative_steps[relative_steps < _MAX_LOST_SAMPLES + 1.5]
    lost_fraction = 1.0 - short_steps.size / max(float(np.round(short_steps).sum()), 1.0)
    if not 0.0 < lost_fraction < _MAX_LOST_FRACTION:
        return _MAX_MISSING
    max_missing = math.ceil(
        math.log(_LONG_GAP_PROBABILITY / short_steps.size) / math.log(lost_fraction)
    )
    return min(max(max_missing, _MAX_MISSING), _MAX_LOST_SAMPLES)


def analyse(segments: Segments, order: int) -> StaticAnalysis:
    """Return the noise of a record at rest.

    order: 2 displacement, 1 velocity, 0 specific force.
    """
    step = segments.step
    _, longest_segment = segments.longest
    decimation = math.ceil(longest_segment.size / MAX_SAMPLES)
    mean_time = np.mean([start + 0.5 * step * segment.size for start, segment in segments.segments])
    # Specific force is integrated to velocity. White noise of the velocity is quantisation noise
    # (IEEE Std 952, C.1.3), white noise of the force is N.
    sampling = Sampling(max(order, 1), order)
    noise_order = sampling.order
    records: list[EvenlySampledData] = []
    lines: list[SpectralLine] = []
    velocity = np.zeros(0)
    first = 1
    for start, samples in segments.segments:
        integrated_samples = samples
        if order == SPECIFIC_FORCE:
            integrated_samples = np.concatenate([[0.0], np.cumsum(samples - samples.mean()) * step])
        integrated_samples = integrated_samples[::decimation]
        decimated_step = step * decimation
        force = np.diff(integrated_samples, n=noise_order) / decimated_step**noise_order
        if force.size < _MIN_SAMPLES:
            continue
        segment_lines, residual = find_lines(force, decimated_step)
        for _ in range(noise_order):
            residual = np.concatenate([[0.0], np.cumsum(residual) * decimated_step])
        time = start - mean_time + decimated_step * (np.arange(force.size) + 0.5 * noise_order)
        records.append(
            EvenlySampledData.from_samples(residual, decimated_step, sampling, time[:, None], first)
        )
        first += 2 * noise_order
        if samples is longest_segment:
            lines = segment_lines
            velocity = residual if noise_order == 1 else np.diff(residual) / decimated_step
    if not records:
        raise NotIdentifiableError("the record is too short to estimate the noise")
    noise = estimate_static_noise(records)
    # A sample of specific force contains the noise of one step, even if other samples are lost.
    noise_per_sample = (
        noise.with_white(segments.recorded_fraction) if order == SPECIFIC_FORCE else noise
    )
    return StaticAnalysis(
        noise_per_sample, noise.variances, tuple(lines), step * decimation, velocity, sampling
    )


@frozen
class SizedComponent:
    """Variance of a noise component, as in `Noise.variances`, with a 95 % interval."""

    variance: float  #: 0 if the component is not detected.
    low: float  #: 0 if the component may be absent.
    high: float  #: Upper limit, for an undetected component at 95 %.


@frozen(eq=False)
class Band:
    """Ratio of the record's spectrum to that of the estimated noise, in a band."""

    low: float  #: Hz.
    high: float  #: Hz.
    ratio: float  #: Observed over expected power.
    count: float  #: Degrees of freedom.


@frozen(eq=False)
class StaticNoise:
    """Noise of records at rest."""

    components: dict[str, SizedComponent]  #: Name in `COMPONENTS` -> component.
    covariance: Array  #: Covariance of the variances, (4, 4): inverse observed information.
    drift: float  #: Drift of the bias, m/s^2/s.
    u_drift: float
    bands: tuple[Band, ...]

    @property
    def variances(self) -> Variances:
        """Variances of all components."""
        return tuple(component.variance for component in self.components.values())

    def with_white(self, factor: float) -> StaticNoise:
        """Return the noise with N^2 multiplied by a factor."""
        white = COMPONENTS[1]
        sizes = self.components[white]
        component = SizedComponent(factor * sizes.variance, factor * sizes.low, factor * sizes.high)
        factors = np.where(np.array(COMPONENTS) == white, factor, 1.0)
        return replace(
            self,
            components=self.components | {white: component},
            covariance=self.covariance * np.outer(factors, factors),
        )


def estimate_static_noise(records: Sequence[EvenlySampledData]) -> StaticNoise:
    """Estimate the common noise of records at rest.

    records: Records whose first unknown is the drift, with a column of time in s.
    """
    if sum(record.observations.size for record in records) < 4 * (2 + len(COMPONENTS)):
        raise NotIdentifiableError("the record is too short to estimate the noise")
    likelihood = RestrictedLikelihood.from_records(records, None, None)
    best_maximum, full_maximum, log_likelihoods_without = _eliminate_components(likelihood)
    components: dict[str, SizedComponent] = {}
    for name in COMPONENTS:
        if name in best_maximum.names:
            components[name] = _profile_interval(
                likelihood, best_maximum, full_maximum, name, log_likelihoods_without[name]
            )
        else:
            components[name] = SizedComponent(
                0.0, 0.0, _upper_limit(likelihood, full_maximum, name)
            )
    estimate, covariance = likelihood.estimate(best_maximum.log_scale, best_maximum.ratios)
    return StaticNoise(
        components,
        best_maximum.covariance,
        float(estimate[0]),
        math.sqrt(covariance[0, 0]),
        _compare_bands(likelihood, best_maximum),
    )


def _eliminate_components(
    likelihood: RestrictedLikelihood,
) -> tuple[Maximum, Maximum, dict[str, float]]:
    """Return the best maximum, the maximum of all components, and likelihoods without each."""
    full_maximum = _candidate(likelihood, COMPONENTS).maximum(None, _initial_variances(likelihood))
    names, value, start = full_maximum.names, full_maximum.value, full_maximum.variances
    log_likelihoods_without: dict[str, float] = {}
    while True:
        reduced_maxima: dict[str, tuple[float, Variances]] = {}
        for name in names:
            remaining_names = tuple(component for component in names if component != name)
            # A white component of samples or sensor is required.
            if set(remaining_names) & set(COMPONENTS[:2]):
                reduced_maxima[name] = _candidate(likelihood, remaining_names).maximize(start)
        log_likelihoods_without = log_likelihoods_without or {
            name: log_likelihood for name, (log_likelihood, _) in reduced_maxima.items()
        }
        least_important = max(reduced_maxima, key=lambda name: reduced_maxima[name][0], default="")
        if (
            not reduced_maxima
            or 2.0 * (value - reduced_maxima[least_important][0]) >= MIN_LIKELIHOOD_GAIN
        ):
            final_maximum = full_maximum if names == full_maximum.names else None
            return (
                final_maximum or _candidate(likelihood, names).maximum(None, start),
                full_maximum,
                log_likelihoods_without,
            )
        names = tuple(name for name in names if name != least_important)
        value, start = reduced_maxima[least_important]


def _candidate(likelihood: RestrictedLikelihood, names: tuple[str, ...]) -> NoiseModelCandidate:
    return NoiseModelCandidate(
        likelihood, Noise(0.0).with_sizes(dict.fromkeys(names, ESTIMATE)), names
    )


def _initial_variances(likelihood: RestrictedLikelihood) -> Variances:
    """Return variances near the most likely ones, ignoring the unknowns.

    Multiplicative updates keep the variances positive (Fevotte, Bertin and Durrieu, Neural
    Computation 21 (2009) 793, eq. 2.13 and 2.14).
    """
    row_variances, group_energies, group_counts = [], [], []
    for record in likelihood.records:
        assert isinstance(record, TransformedRecord)
        first_rows = record.first_rows
        row_variances.append(record.row_variances[:, first_rows])
        group_energies.append(np.add.reduceat(record.stack[:, -1] ** 2, first_rows))
        group_counts.append(record.counts)
    unit_variances, energy, rows = (
        np.concatenate(row_variances, axis=1),
        np.concatenate(group_energies),
        np.concatenate(group_counts),
    )
    variances = energy.sum() / (unit_variances @ rows) / len(unit_variances)
    for _ in range(_MULTIPLICATIVE_STEPS):
        expected = variances @ unit_variances
        variances = variances * np.sqrt(
            (unit_variances @ (energy / expected**2)) / (unit_variances @ (rows / expected))
        )
    # Multiplicative updates cannot leave zero.
    floor = 1e-6 * (energy.sum() / (unit_variances @ rows))
    return tuple(np.maximum(variances, floor).tolist())


def _profile_interval(
    likelihood: RestrictedLikelihood,
    best_maximum: Maximum,
    full_maximum: Maximum,
    name: str,
    log_likelihood_without: float,
) -> SizedComponent:
    """Return a detected component with its interval."""
    index = COMPONENTS.index(name)
    variance = best_maximum.variances[index]
    relative_u = math.sqrt(best_maximum.covariance[index, index]) / variance
    profile = _profile_likelihood(likelihood, full_maximum, name)
    log_variance, step = (
        math.log(max(variance, full_maximum.variances[index])),
        min(1.96 * relative_u, 2.0),
    )
    max_log_likelihood = max(full_maximum.value, profile(log_variance))
    high = _interval_end(profile, max_log_likelihood, log_variance, step, _TWO_SIDED_CHANGE)
    low = None
    if 2.0 * (max_log_likelihood - log_likelihood_without) >= _TWO_SIDED_CHANGE:
        low = _interval_end(
            profile,
            max_log_likelihood,
            math.log(min(variance, full_maximum.variances[index])),
            -step,
            _TWO_SIDED_CHANGE,
        )
    return SizedComponent(
        variance,
        0.0 if low is None else math.exp(low),
        math.inf if high is None else math.exp(high),
    )


def _upper_limit(likelihood: RestrictedLikelihood, full_maximum: Maximum, name: str) -> float:
    """Return the upper limit of the variance of an undetected component."""
    index = COMPONENTS.index(name)
    start = math.log(
        max(_undetectable_variances(likelihood, full_maximum)[index], full_maximum.variances[index])
    )
    profile = _profile_likelihood(likelihood, full_maximum, name)
    max_log_likelihood = max(full_maximum.value, profile(start))
    log_limit = _interval_end(profile, max_log_likelihood, start, 1.0, _ONE_SIDED_CHANGE)
    return math.inf if log_limit is None else math.exp(log_limit)


def _undetectable_variances(likelihood: RestrictedLikelihood, full_maximum: Maximum) -> Variances:
    """Return variances of components that contribute at most 1 % of the noise in any row."""
    variances = [
        np.min(
            np.asarray(full_maximum.variances) @ record.row_variances / record.row_variances, axis=1
        )
        for record in likelihood.records
        if isinstance(record, TransformedRecord)
    ]
    return tuple((0.01 * np.min(variances, axis=0)).tolist())


def _profile_likelihood(
    likelihood: RestrictedLikelihood, full_maximum: Maximum, name: str
) -> Callable[[float], float]:
    """Return the profile likelihood as a function of the log variance of a component.

    Undetected components are varied too, because they may be present.
    """
    free_components = tuple(component for component in COMPONENTS if component != name)
    # The search cannot leave variances far below these.
    undetectable_variances = _undetectable_variances(likelihood, full_maximum)
    free_noise = Noise(0.0).with_sizes(dict.fromkeys(free_components, ESTIMATE))
    last_variances = [full_maximum.variances]

    def profile(log_variance: float) -> float:
        fixed_noise = free_noise.with_sizes({name: math.exp(0.5 * log_variance)})
        initial = tuple(map(max, last_variances[0], undetectable_variances))
        log_likelihood, last_variances[0] = NoiseModelCandidate(
            likelihood, fixed_noise, free_components
        ).maximize(initial)
        return log_likelihood

    return profile


def _interval_end(
    profile: Callable[[float], float],
    max_log_likelihood: float,
    start: float,
    step: float,
    change: float,
) -> float | None:
    """Return the point at which 2 log L is below its maximum by a change; None if there is none.

    False position in sqrt(2 log L), which is nearly linear in the distance from the maximum.
    """
    target = math.sqrt(change)

    def excess(x: float) -> float:
        return math.sqrt(max(2.0 * (max_log_likelihood - profile(x)), 0.0)) - target

    inner, inner_excess = start, -target
    outer = start + step
    outer_excess = excess(outer)
    for _ in range(_MAX_LIMIT_STEPS):
        if outer_excess > 0.0:
            break
        inner, inner_excess = outer, outer_excess
        step *= 2.0
        outer = inner + step
        outer_excess = excess(outer)
    else:
        return None
    for _ in range(_MAX_LIMIT_STEPS):
        if outer_excess < _LIMIT_TOLERANCE:
            return outer
        if inner_excess > -_LIMIT_TOLERANCE:
            return inner
        fraction = min(max(-inner_excess / (outer_excess - inner_excess), 0.1), 0.9)
        trial = inner + fraction * (outer - inner)
        value = excess(trial)
        if value > 0.0:
            outer, outer_excess = trial, value
        else:
            inner, inner_excess = trial, value
    return 0.5 * (inner + outer)


def _compare_bands(likelihood: RestrictedLikelihood, best_maximum: Maximum) -> tuple[Band, ...]:
    """Return the ratio of the records' spectrum to that of the noise in each band."""
    estimate, _ = likelihood.estimate(best_maximum.log_scale, best_maximum.ratios)
    frequency, power, count = [], [], []
    for record, indices in zip(likelihood.records, likelihood.column_indices, strict=True):
        assert isinstance(record, TransformedRecord)
        rows, _ = record.whitened(best_maximum.variances)
        residuals = rows[:, -1] - rows[:, :-1] @ estimate[indices]
        power.append(np.add.reduceat(residuals**2, record.first_rows))
        count.append(record.counts)
        number = np.cumsum(record.counts) - 0.5 * (record.counts - 1.0)
        frequency.append(number / (2.0 * record.length))
    frequencies, energy, rows = map(np.concatenate, (frequency, power, count))
    decades = np.log10(frequencies / frequencies.min())
    band_numbers = np.floor(_BANDS_PER_DECADE * decades).astype(int)
    bands = []
    for number in np.unique(band_numbers):
        is_in_band = band_numbers == number
        n_total = float(rows[is_in_band].sum())
        ratio = float(energy[is_in_band].sum()) / n_total
        bands.append(
            Band(
                float(frequencies[is_in_band].min()),
                float(frequencies[is_in_band].max()),
                ratio,
                n_total,
            )
        )
    return tuple(bands)
