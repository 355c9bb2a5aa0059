"""A record of a sensor at rest: cleaned, cut at its gaps, and each component of its noise.

The likelihood and its search are those of every other record. Beside the sizes the drift of the
bias, a straight line, is unknown; the bias itself is. A component is kept where the records ask for
it (`KEEPING_GAIN`). Intervals are those of the profile likelihood: sizes at which the best of all
else is no less likely than chi-square with one degree of freedom allows (Venzon and Moolgavkar,
Applied Statistics 37 (1988) 87), whose ends are as uneven as what a short record says. All else is
every other component, shown or not: what a record does not show may be a part of what it does.
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
from counterspin.inference.noise.search import KEEPING_GAIN, Maximum, NoiseModelCandidate
from counterspin.inference.noise.spectrum import SpectralLine, find_lines
from counterspin.records.outliers import detect_outliers

#: Most samples missing in a row within a part; more are a gap. Where many samples are lost, more in
#: a row are, up to a number that a record of so many exceeds with a small probability.
_MAX_MISSING: Final = 3
_MAX_LOST: Final = 30
_FAR_PROBABILITY: Final = 0.01
#: Part of the samples that may be lost, and still be no gaps.
_MAX_LOST_FRACTION: Final = 0.35
#: Missing samples are put in from their neighbours if that changes N by less than this part of its
#: standard uncertainty; where more are missing, the samples that were recorded follow one another.
_MAX_FILLING_EFFECT: Final = 0.2

#: Part of a step by which a sample may stand off from an even clock.
_MAX_CLOCK_DEVIATION: Final = 0.3

#: Fewest samples of a stretch that is used.
_MIN_SAMPLES: Final = 32

#: Most samples that the noise is looked for in: of longer records velocities at longer steps.
MAX_SAMPLES: Final = 300_000

#: Changes of 2 log L at the ends of a 95 % interval, and at the upper limit of what is not seen.
_TWO_SIDED: Final = 3.841458820694124
_ONE_SIDED: Final = KEEPING_GAIN

#: Passes in which first sizes are found, and steps in which an end of an interval is.
_MULTIPLICATIVE_STEPS: Final = 60
_END_STEPS: Final = 12

#: Part of sqrt(2 log L) to which an end is found.
_END_TOLERANCE: Final = 0.05

#: Bands of the spectrum, a decade, in which the noise found is held against the record.
_BANDS_PER_DECADE: Final = 4.0


@frozen(eq=False)
class Segments:
    """The segments of a record between gaps."""

    step: float  #: Mean time from sample to sample in the parts, s.
    recorded_fraction: (
        float  #: Part of the samples that was recorded, where none is put in; otherwise 1.
    )
    #: Of each: the time of its first sample, s, and its samples, SI.
    segments: tuple[tuple[float, Array], ...]
    rows: int  #: Of the record.
    outliers: int  #: Left out.
    filled: int  #: Samples missing in the parts, outliers among them.
    gaps: int  #: Between the parts.
    unused: int  #: Samples of parts that are too short.
    resolution: float  #: Least step between different samples, SI.
    repeated: int = 0  #: Rows that repeat the previous value, as in a log faster than the sensor.
    restamped: int = 0  #: Rows that repeat the time of the row before with another value.
    stuck: int = 0  #: Rows in long stretches of one value, which are not used.

    @property
    def sample_interval(self) -> float:
        """The time from one sample of the sensor to the next, s."""
        return self.step * self.recorded_fraction

    @property
    def longest(self) -> tuple[float, Array]:
        """The longest part."""
        return max(self.segments, key=lambda part: part[1].size)


@frozen(eq=False)
class StaticAnalysis:
    """Noise estimates from a record."""

    noise: StaticNoise
    recorded: Variances  #: Variances of the series of recorded samples, as in `StaticNoise`.
    lines: tuple[SpectralLine, ...]
    step: float  #: Of the samples that it rests on, s.
    velocity: Array  #: Integral of the specific force of the longest part, without lines, m/s.
    kind: Sampling


@frozen(eq=False)
class StaticSignal:
    """One column of a record at rest."""

    name: str  #: Of the accelerometer, or of the column.
    column: str  #: In the file.
    order: int  #: 2 displacement, 1 velocity, 0 specific force.
    in_g: bool  #: Whether gravity is in its numbers.
    #: s and SI, NaN where there is none, shape (n,).
    time: Array
    values: Array


@frozen(eq=False)
class StaticRecord:
    """Noise estimates from one column."""

    signal: StaticSignal
    segments: Segments
    analysis: StaticAnalysis


def analyse_static_record(record: object, signal: StaticSignal) -> StaticRecord:
    """Return the noise estimates from a column; RecordError if they are not possible.

    record: What messages call the record.
    """
    try:
        stretches = split_segments(signal.time, signal.values)
        if np.ptp(stretches.longest[1]) == 0.0:
            raise ValueError("all samples are equal: no signal was recorded")
        analysis = analyse(stretches, signal.order)
    except (ValueError, NotIdentifiableError) as error:
        raise RecordError(
            f"{record}: column '{signal.column}': {error}.", code="not-evaluable"
        ) from error
    return StaticRecord(signal, stretches, analysis)


def split_segments(time: Array, values: Array) -> Segments:
    """Return a record without outliers, cut where samples are missing.

    time, values: s and SI, NaN where there is none, shape (n,).
    """
    rows = time.size
    is_finite = np.isfinite(time)
    time, values = time[is_finite], values[is_finite]
    if (np.diff(time) < 0.0).any():
        raise ValueError("the time decreases")
    has_value = np.isfinite(values)
    if has_value.sum() > 1 and median(np.diff(time[has_value])) > 1.5 * median(np.diff(time)):
        # Rows of other sensors stand between those of this one.
        time, values = time[has_value], values[has_value]
    samples = SensorSamples.of(time, values)
    time, values = samples.time, samples.values
    if time.size < _MIN_SAMPLES:
        raise ValueError(f"{time.size} samples are too few: {_MIN_SAMPLES} are required")
    steps = np.diff(time)
    step = median(steps)
    # The median of rounded times is off; their mean over steps that are one is not.
    single = steps < 1.5 * step
    step = float(steps[single].mean())
    outliers = detect_outliers(time, values, 0.0, step, float(steps[single].std() / step))
    outliers = outliers[np.isfinite(values[outliers])]
    clean = values.copy()
    clean[outliers] = np.nan
    good = np.isfinite(clean)
    good_times, kept = time[good], clean[good]
    if kept.size < _MIN_SAMPLES:
        raise ValueError(f"{kept.size} samples are too few: {_MIN_SAMPLES} are required")
    relative_steps = np.diff(good_times) / step
    cuts = np.flatnonzero(relative_steps > _max_missing_rows(relative_steps) + 1.5) + 1
    parts: list[tuple[float, Array, Array]] = []
    unused = 0
    for own_time, segment_values in zip(
        np.split(good_times, cuts), np.split(kept, cuts), strict=True
    ):
        if segment_values.size < _MIN_SAMPLES:
            unused += segment_values.size
            continue
        place = np.round(np.concatenate([[0.0], np.cumsum(np.diff(own_time) / step)]))
        span = own_time[-1] - own_time[0]
        # Each part has a clock of its own: over many rows a step that is off a little adds up.
        sample_index = np.round((own_time - own_time[0]) / (span / place[-1]))
        clock_deviation = (own_time - own_time[0]) / (span / place[-1]) - sample_index
        if (
            np.abs(clock_deviation).max() > _MAX_CLOCK_DEVIATION
            or (np.diff(sample_index) < 1.0).any()
        ):
            raise ValueError(
                "the noise analysis requires evenly spaced samples, but the spacing varies; if the "
                "sensor samples at a constant rate and no sample is missing, give "
                "`sampling_rate`; otherwise, resample the record"
            )
        parts.append((float(own_time[0]), sample_index, segment_values))
    if not parts:
        raise ValueError(f"there are no {_MIN_SAMPLES} successive samples without a gap")
    count = sum(int(sample_index[-1]) + 1 for _, sample_index, _ in parts)
    recorded = sum(segment_values.size for _, _, segment_values in parts)
    share = recorded / count
    fills = (1.0 - share) * math.sqrt(2.0 * recorded) < _MAX_FILLING_EFFECT
    series = [
        (
            start,
            np.interp(np.arange(sample_index[-1] + 1), sample_index, segment_values)
            if fills
            else segment_values,
        )
        for start, sample_index, segment_values in parts
    ]
    share = 1.0 if fills else share
    different = np.diff(np.unique(kept[:4096]))
    resolution = float(different.min()) if different.size else 0.0
    return Segments(
        step=step / share,
        recorded_fraction=share,
        segments=tuple(series),
        rows=rows,
        outliers=outliers.size,
        filled=count - recorded,
        gaps=len(series) - 1,
        unused=unused,
        resolution=resolution,
        repeated=samples.repeated,
        restamped=samples.restamped,
        stuck=samples.stuck,
    )


def _max_missing_rows(relative_steps: Array) -> int:
    """Return the number of missing samples in a row beyond which a record is cut.

    relative_steps: Steps of the clock from one sample to the next.
    """
    near = relative_steps[relative_steps < _MAX_LOST + 1.5]
    lost = 1.0 - near.size / max(float(np.round(near).sum()), 1.0)
    if not 0.0 < lost < _MAX_LOST_FRACTION:
        return _MAX_MISSING
    far = math.ceil(math.log(_FAR_PROBABILITY / near.size) / math.log(lost))
    return min(max(far, _MAX_MISSING), _MAX_LOST)


def analyse(segments: Segments, order: int) -> StaticAnalysis:
    """Return the noise of a record at rest.

    order: 2 displacement, 1 velocity, 0 specific force.
    """
    step = segments.step
    _, longest = segments.longest
    decimation = math.ceil(longest.size / MAX_SAMPLES)
    middle = np.mean([start + 0.5 * step * part.size for start, part in segments.segments])
    # Specific force is taken as the velocity between its samples: what is white in that is
    # quantisation noise (IEEE Std 952, C.1.3), and what is white in the force is N.
    kind = Sampling(max(order, 1), order)
    noise_order = kind.order
    records: list[EvenlySampledData] = []
    lines: list[SpectralLine] = []
    velocity = np.zeros(0)
    first = 1
    for start, part in segments.segments:
        recorded = part
        if order == SPECIFIC_FORCE:
            recorded = np.concatenate([[0.0], np.cumsum(part - part.mean()) * step])
        recorded = recorded[::decimation]
        decimated_step = step * decimation
        force = np.diff(recorded, n=noise_order) / decimated_step**noise_order
        if force.size < _MIN_SAMPLES:
            continue
        own_lines, rest = find_lines(force, decimated_step)
        for _ in range(noise_order):
            rest = np.concatenate([[0.0], np.cumsum(rest) * decimated_step])
        time = start - middle + decimated_step * (np.arange(force.size) + 0.5 * noise_order)
        records.append(EvenlySampledData.of(rest, decimated_step, kind, time[:, None], first))
        first += 2 * noise_order
        if part is longest:
            lines = own_lines
            velocity = rest if noise_order == 1 else np.diff(rest) / decimated_step
    if not records:
        raise NotIdentifiableError("the record is too short to estimate the noise")
    noise = estimate_static_noise(records)
    # A sample of a specific force holds the noise of one step, also where others are lost.
    noise_per_sample = (
        noise.with_white(segments.recorded_fraction) if order == SPECIFIC_FORCE else noise
    )
    return StaticAnalysis(
        noise_per_sample, noise.variances, tuple(lines), step * decimation, velocity, kind
    )


@frozen
class SizedComponent:
    """One component of a noise: its variance, as in `Noise.variances`, and a 95 % interval."""

    variance: float  #: Zero where the records do not show it.
    low: float  #: Zero: they may be without it.
    high: float  #: Of what is not shown: an upper limit at 95 %.


@frozen(eq=False)
class Band:
    """Ratio of the record's spectrum to that of the estimated noise, in a band."""

    low: float  #: Hz.
    high: float  #: Hz.
    ratio: float  #: Power over what the noise lets expect.
    count: float  #: Degrees of freedom.


@frozen(eq=False)
class StaticNoise:
    """The noise of records at rest."""

    components: dict[str, SizedComponent]  #: By the names of `COMPONENTS`.
    covariance: Array  #: Of the variances, (4, 4): inverse observed information.
    drift: float  #: Of the bias, m/s^2/s.
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
        scaled = SizedComponent(factor * sizes.variance, factor * sizes.low, factor * sizes.high)
        factors = np.where(np.array(COMPONENTS) == white, factor, 1.0)
        return replace(
            self,
            components=self.components | {white: scaled},
            covariance=self.covariance * np.outer(factors, factors),
        )


def estimate_static_noise(records: Sequence[EvenlySampledData]) -> StaticNoise:
    """Estimate the noise that records at rest share.

    records: Their first unknown is the drift, by a column of time in s.
    """
    if sum(record.observations.size for record in records) < 4 * (2 + len(COMPONENTS)):
        raise NotIdentifiableError("the record is too short to estimate the noise")
    likelihood = RestrictedLikelihood.of(records, None, None)
    best, full_maximum, without = _eliminate_components(likelihood)
    components: dict[str, SizedComponent] = {}
    for name in COMPONENTS:
        if name in best.names:
            components[name] = _interval(likelihood, best, full_maximum, name, without[name])
        else:
            components[name] = SizedComponent(
                0.0, 0.0, _upper_limit(likelihood, full_maximum, name)
            )
    estimate, covariance = likelihood.estimate(best.log_scale, best.ratios)
    return StaticNoise(
        components,
        best.covariance,
        float(estimate[0]),
        math.sqrt(covariance[0, 0]),
        _compare_bands(likelihood, best),
    )


def _eliminate_components(
    likelihood: RestrictedLikelihood,
) -> tuple[Maximum, Maximum, dict[str, float]]:
    """Return the best maximum, the maximum of all components, and likelihoods without each."""
    full_maximum = _candidate(likelihood, COMPONENTS).maximum(None, _initial_variances(likelihood))
    names, value, start = full_maximum.names, full_maximum.value, full_maximum.variances
    without: dict[str, float] = {}
    while True:
        smaller: dict[str, tuple[float, Variances]] = {}
        for name in names:
            rest = tuple(component for component in names if component != name)
            # Something has to be white, in the record or in its sensor.
            if set(rest) & set(COMPONENTS[:2]):
                smaller[name] = _candidate(likelihood, rest).maximize(start)
        without = without or {name: log_likelihood for name, (log_likelihood, _) in smaller.items()}
        least = max(smaller, key=lambda name: smaller[name][0], default="")
        if not smaller or 2.0 * (value - smaller[least][0]) >= KEEPING_GAIN:
            best = full_maximum if names == full_maximum.names else None
            return best or _candidate(likelihood, names).maximum(None, start), full_maximum, without
        names = tuple(name for name in names if name != least)
        value, start = smaller[least]


def _candidate(likelihood: RestrictedLikelihood, names: tuple[str, ...]) -> NoiseModelCandidate:
    return NoiseModelCandidate(
        likelihood, Noise(0.0).with_sizes(dict.fromkeys(names, ESTIMATE)), names
    )


def _initial_variances(likelihood: RestrictedLikelihood) -> Variances:
    """Return sizes near the most likely ones, without unknowns.

    Multiplicative steps uphill, whose sizes stay positive (Fevotte, Bertin and Durrieu, Neural
    Computation 21 (2009) 793, eq. 2.13 and 2.14).
    """
    parts, power, count = [], [], []
    for record in likelihood.records:
        assert isinstance(record, TransformedRecord)
        first = record.places
        parts.append(record.row_variances[:, first])
        power.append(np.add.reduceat(record.stack[:, -1] ** 2, first))
        count.append(record.counts)
    part, energy, rows = np.concatenate(parts, axis=1), np.concatenate(power), np.concatenate(count)
    sizes = energy.sum() / (part @ rows) / len(part)
    for _ in range(_MULTIPLICATIVE_STEPS):
        expected = sizes @ part
        sizes = sizes * np.sqrt((part @ (energy / expected**2)) / (part @ (rows / expected)))
    # From nothing no step leads back.
    floor = 1e-6 * (energy.sum() / (part @ rows))
    return tuple(np.maximum(sizes, floor).tolist())


def _interval(
    likelihood: RestrictedLikelihood,
    best: Maximum,
    full_maximum: Maximum,
    name: str,
    without: float,
) -> SizedComponent:
    """Return a detected component with its interval."""
    place = COMPONENTS.index(name)
    size = best.variances[place]
    spread = math.sqrt(best.covariance[place, place]) / size
    profile = _profile_likelihood(likelihood, full_maximum, name)
    middle, step = math.log(max(size, full_maximum.variances[place])), min(1.96 * spread, 2.0)
    top = max(full_maximum.value, profile(middle))
    high = _interval_end(profile, top, middle, step, _TWO_SIDED)
    low = None
    if 2.0 * (top - without) >= _TWO_SIDED:
        low = _interval_end(
            profile, top, math.log(min(size, full_maximum.variances[place])), -step, _TWO_SIDED
        )
    return SizedComponent(
        size, 0.0 if low is None else math.exp(low), math.inf if high is None else math.exp(high)
    )


def _upper_limit(likelihood: RestrictedLikelihood, full_maximum: Maximum, name: str) -> float:
    """Return the upper limit of the variance of an undetected component."""
    place = COMPONENTS.index(name)
    first = math.log(
        max(_undetectable_variances(likelihood, full_maximum)[place], full_maximum.variances[place])
    )
    profile = _profile_likelihood(likelihood, full_maximum, name)
    top = max(full_maximum.value, profile(first))
    end = _interval_end(profile, top, first, 1.0, _ONE_SIDED)
    return math.inf if end is None else math.exp(end)


def _undetectable_variances(likelihood: RestrictedLikelihood, full_maximum: Maximum) -> Variances:
    """Return variances of components that contribute at most 1 % of the noise in any row."""
    shares = [
        np.min(
            np.asarray(full_maximum.variances) @ record.row_variances / record.row_variances, axis=1
        )
        for record in likelihood.records
        if isinstance(record, TransformedRecord)
    ]
    return tuple((0.01 * np.min(shares, axis=0)).tolist())


def _profile_likelihood(
    likelihood: RestrictedLikelihood, full_maximum: Maximum, name: str
) -> Callable[[float], float]:
    """Return the profile likelihood as a function of the log variance of a component.

    Those that the records do not ask for are among them: they may be there.
    """
    free_components = tuple(component for component in COMPONENTS if component != name)
    # From where nothing of it shows no step leads back.
    least = _undetectable_variances(likelihood, full_maximum)
    free_noise = Noise(0.0).with_sizes(dict.fromkeys(free_components, ESTIMATE))
    start = [full_maximum.variances]

    def value(log_size: float) -> float:
        given = free_noise.with_sizes({name: math.exp(0.5 * log_size)})
        begin = tuple(map(max, start[0], least))
        log_likelihood, start[0] = NoiseModelCandidate(likelihood, given, free_components).maximize(
            begin
        )
        return log_likelihood

    return value


def _interval_end(
    profile: Callable[[float], float], top: float, start: float, step: float, change: float
) -> float | None:
    """Return where 2 log L is below its maximum by a change; None if nowhere.

    sqrt(2 log L) goes nearly as the distance from the top: false position in that.
    """
    target = math.sqrt(change)

    def excess(x: float) -> float:
        return math.sqrt(max(2.0 * (top - profile(x)), 0.0)) - target

    inner, below = start, -target
    outer = start + step
    above = excess(outer)
    for _ in range(_END_STEPS):
        if above > 0.0:
            break
        inner, below = outer, above
        step *= 2.0
        outer = inner + step
        above = excess(outer)
    else:
        return None
    for _ in range(_END_STEPS):
        if above < _END_TOLERANCE:
            return outer
        if below > -_END_TOLERANCE:
            return inner
        part = min(max(-below / (above - below), 0.1), 0.9)
        between = inner + part * (outer - inner)
        value = excess(between)
        if value > 0.0:
            outer, above = between, value
        else:
            inner, below = between, value
    return 0.5 * (inner + outer)


def _compare_bands(likelihood: RestrictedLikelihood, best: Maximum) -> tuple[Band, ...]:
    """Return the ratio of the records' spectrum to that of the noise in each band."""
    estimate, _ = likelihood.estimate(best.log_scale, best.ratios)
    frequency, power, count = [], [], []
    for record, places in zip(likelihood.records, likelihood.places, strict=True):
        assert isinstance(record, TransformedRecord)
        rows, _ = record.whitened(best.variances)
        residuals = rows[:, -1] - rows[:, :-1] @ estimate[places]
        power.append(np.add.reduceat(residuals**2, record.places))
        count.append(record.counts)
        number = np.cumsum(record.counts) - 0.5 * (record.counts - 1.0)
        frequency.append(number / (2.0 * record.length))
    frequencies, energy, rows = map(np.concatenate, (frequency, power, count))
    bin_of = np.floor(_BANDS_PER_DECADE * np.log10(frequencies / frequencies.min())).astype(int)
    bands = []
    for number in np.unique(bin_of):
        in_band = bin_of == number
        total = float(rows[in_band].sum())
        ratio = float(energy[in_band].sum()) / total
        bands.append(
            Band(float(frequencies[in_band].min()), float(frequencies[in_band].max()), ratio, total)
        )
    return tuple(bands)
