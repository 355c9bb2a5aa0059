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
from counterspin.inference.noise.even import EvenData, EvenRecord, SampleKind
from counterspin.inference.noise.likelihood import RestrictedLikelihood
from counterspin.inference.noise.model import COMPONENTS, SPECIFIC_FORCE, WANTED, Noise
from counterspin.inference.noise.samples import Samples
from counterspin.inference.noise.search import KEEPING_GAIN, Choice, Maximum
from counterspin.inference.noise.spectrum import SpectralLine, find_lines
from counterspin.inference.noise.wander import Variances
from counterspin.records.outliers import detect_outliers

#: Most samples missing in a row within a part; more are a gap. Where many samples are lost, more in
#: a row are, up to a number that a record of so many exceeds with a small probability.
_MOST_MISSING: Final = 3
_MOST_LOST: Final = 30
_FAR_PROBABILITY: Final = 0.01
#: Part of the samples that may be lost, and still be no gaps.
_MOST_LOST_PART: Final = 0.35
#: Missing samples are put in from their neighbours if that changes N by less than this part of its
#: standard uncertainty; where more are missing, the samples that were recorded follow one another.
_FILLING_PART: Final = 0.2

#: Part of a step by which a sample may stand off from an even clock.
_OFF_CLOCK: Final = 0.3

#: Fewest samples of a stretch that is used.
_FEWEST: Final = 32

#: Most samples that the noise is looked for in: of longer records velocities at longer steps.
MOST_SAMPLES: Final = 300_000

#: Changes of 2 log L at the ends of a 95 % interval, and at the upper limit of what is not seen.
_TWO_SIDED: Final = 3.841458820694124
_ONE_SIDED: Final = KEEPING_GAIN

#: Passes in which first sizes are found, and steps in which an end of an interval is.
_PASSES: Final = 60
_END_STEPS: Final = 12

#: Part of sqrt(2 log L) to which an end is found.
_END_TOLERANCE: Final = 0.05

#: Bands of the spectrum, a decade, in which the noise found is held against the record.
_BANDS_A_DECADE: Final = 4.0


@frozen(eq=False)
class Stretches:
    """The parts of a record between its gaps."""

    step: float  #: Mean time from sample to sample in the parts, s.
    share: float  #: Part of the samples that was recorded, where none is put in; otherwise 1.
    #: Of each: the time of its first sample, s, and its samples, SI.
    parts: tuple[tuple[float, Array], ...]
    rows: int  #: Of the record.
    outliers: int  #: Left out.
    filled: int  #: Samples missing in the parts, outliers among them.
    gaps: int  #: Between the parts.
    unused: int  #: Samples of parts that are too short.
    resolution: float  #: Least step between different samples, SI.
    repeated: int = 0  #: Rows that repeat the value before, as of a log faster than the sensor.
    restamped: int = 0  #: Rows that repeat the time of the row before with another value.

    @property
    def clock(self) -> float:
        """The time from one sample of the sensor to the next, s."""
        return self.step * self.share

    @property
    def longest(self) -> tuple[float, Array]:
        """The longest part."""
        return max(self.parts, key=lambda part: part[1].size)


@frozen(eq=False)
class RestAnalysis:
    """Noise estimates from a record."""

    noise: RestNoise
    recorded: Variances  #: Variances of the series of recorded samples, as of `RestNoise`.
    lines: tuple[SpectralLine, ...]
    step: float  #: Of the samples that it rests on, s.
    velocity: Array  #: Integral of the specific force of the longest part, without lines, m/s.
    kind: SampleKind


@frozen(eq=False)
class RestSignal:
    """One column of a record at rest."""

    name: str  #: Of the accelerometer, or of the column.
    column: str  #: In the file.
    order: int  #: 2 displacement, 1 velocity, 0 specific force.
    in_g: bool  #: Whether gravity is in its numbers.
    #: s and SI, NaN where there is none, shape (n,).
    time: Array
    values: Array


@frozen(eq=False)
class RestRecord:
    """Noise estimates from one column."""

    signal: RestSignal
    stretches: Stretches
    analysis: RestAnalysis


def at_rest(record: object, signal: RestSignal) -> RestRecord:
    """Return the noise estimates from a column; RecordError if they are not possible.

    record: What messages call the record.
    """
    try:
        stretches = stretches_of(signal.time, signal.values)
        if np.ptp(stretches.longest[1]) == 0.0:
            raise ValueError("all its samples are equal: nothing was recorded")
        analysis = analyse(stretches, signal.order)
    except (ValueError, NotIdentifiableError) as error:
        raise RecordError(f"{record}: column '{signal.column}': {error}.") from error
    return RestRecord(signal, stretches, analysis)


def stretches_of(time: Array, values: Array) -> Stretches:
    """Return a record without outliers, cut where samples are missing.

    time, values: s and SI, NaN where there is none, shape (n,).
    """
    rows = time.size
    there = np.isfinite(time)
    time, values = time[there], values[there]
    if (np.diff(time) < 0.0).any():
        raise ValueError("its time runs backwards")
    samples = Samples.of(time, values)
    time, values = samples.time, samples.values
    if time.size < _FEWEST:
        raise ValueError(f"{time.size} samples are too few: {_FEWEST} are needed")
    steps = np.diff(time)
    step = median(steps)
    # The median of rounded times is off; their mean over steps that are one is not.
    single = steps < 1.5 * step
    step = float(steps[single].mean())
    spikes = detect_outliers(time, values, 0.0, step, float(steps[single].std() / step))
    spikes = spikes[np.isfinite(values[spikes])]
    clean = values.copy()
    clean[spikes] = np.nan
    good = np.isfinite(clean)
    at, kept = time[good], clean[good]
    if kept.size < _FEWEST:
        raise ValueError(f"{kept.size} samples are too few: {_FEWEST} are needed")
    ahead = np.diff(at) / step
    cuts = np.flatnonzero(ahead > _most_missing(ahead) + 1.5) + 1
    parts: list[tuple[float, Array, Array]] = []
    unused = 0
    for own_time, own in zip(np.split(at, cuts), np.split(kept, cuts), strict=True):
        if own.size < _FEWEST:
            unused += own.size
            continue
        place = np.round(np.concatenate([[0.0], np.cumsum(np.diff(own_time) / step)]))
        span = own_time[-1] - own_time[0]
        # Each part has a clock of its own: over many rows a step that is off a little adds up.
        number = np.round((own_time - own_time[0]) / (span / place[-1]))
        away = (own_time - own_time[0]) / (span / place[-1]) - number
        if np.abs(away).max() > _OFF_CLOCK or (np.diff(number) < 1.0).any():
            raise ValueError(
                "its samples are not evenly spaced, which the noise "
                "analysis needs; resample the record, or name another time column"
            )
        parts.append((float(own_time[0]), number, own))
    if not parts:
        raise ValueError(f"no {_FEWEST} successive samples are without a gap")
    count = sum(int(number[-1]) + 1 for _, number, _ in parts)
    recorded = sum(own.size for _, _, own in parts)
    share = recorded / count
    fills = (1.0 - share) * math.sqrt(2.0 * recorded) < _FILLING_PART
    series = [
        (start, np.interp(np.arange(number[-1] + 1), number, own) if fills else own)
        for start, number, own in parts
    ]
    share = 1.0 if fills else share
    different = np.diff(np.unique(kept[:4096]))
    resolution = float(different.min()) if different.size else 0.0
    return Stretches(
        step=step / share,
        share=share,
        parts=tuple(series),
        rows=rows,
        outliers=spikes.size,
        filled=count - recorded,
        gaps=len(series) - 1,
        unused=unused,
        resolution=resolution,
        repeated=samples.repeated,
        restamped=samples.restamped,
    )


def _most_missing(ahead: Array) -> int:
    """Return the number of missing samples in a row beyond which a record is cut.

    ahead: Steps of the clock from one sample to the next.
    """
    near = ahead[ahead < _MOST_LOST + 1.5]
    lost = 1.0 - near.size / max(float(np.round(near).sum()), 1.0)
    if not 0.0 < lost < _MOST_LOST_PART:
        return _MOST_MISSING
    far = math.ceil(math.log(_FAR_PROBABILITY / near.size) / math.log(lost))
    return min(max(far, _MOST_MISSING), _MOST_LOST)


def analyse(stretches: Stretches, order: int) -> RestAnalysis:
    """Return the noise of a record at rest.

    order: 2 displacement, 1 velocity, 0 specific force.
    """
    step = stretches.step
    _, longest = stretches.longest
    thin = math.ceil(longest.size / MOST_SAMPLES)
    middle = np.mean([start + 0.5 * step * part.size for start, part in stretches.parts])
    # Specific force is taken as the velocity between its samples: what is white in that is
    # quantisation noise (IEEE Std 952, C.1.3), and what is white in the force is N.
    kind = SampleKind(max(order, 1), order)
    noise_order = kind.order
    records: list[EvenData] = []
    lines: list[SpectralLine] = []
    velocity = np.zeros(0)
    first = 1
    for start, part in stretches.parts:
        recorded = part
        if order == SPECIFIC_FORCE:
            recorded = np.concatenate([[0.0], np.cumsum(part - part.mean()) * step])
        recorded = recorded[::thin]
        wide = step * thin
        force = np.diff(recorded, n=noise_order) / wide**noise_order
        if force.size < _FEWEST:
            continue
        own_lines, rest = find_lines(force, wide)
        for _ in range(noise_order):
            rest = np.concatenate([[0.0], np.cumsum(rest) * wide])
        time = start - middle + wide * (np.arange(force.size) + 0.5 * noise_order)
        records.append(EvenData.of(rest, wide, kind, time[:, None], first))
        first += 2 * noise_order
        if part is longest:
            lines = own_lines
            velocity = rest if noise_order == 1 else np.diff(rest) / wide
    if not records:
        raise NotIdentifiableError("the record is too short to estimate any noise")
    noise = find_rest_noise(records)
    # A sample of a specific force holds the noise of one step, also where others are lost.
    own = noise.with_white(stretches.share) if order == SPECIFIC_FORCE else noise
    return RestAnalysis(own, noise.variances, tuple(lines), step * thin, velocity, kind)


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
class RestNoise:
    """The noise of records at rest."""

    components: dict[str, SizedComponent]  #: By the names of `COMPONENTS`.
    covariance: Array  #: Of the variances, (4, 4): inverse observed information.
    drift: float  #: Of the bias, m/s^2/s.
    u_drift: float
    bands: tuple[Band, ...]

    @property
    def variances(self) -> Variances:
        """Those of all components."""
        return tuple(one.variance for one in self.components.values())

    def with_white(self, factor: float) -> RestNoise:
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


def find_rest_noise(records: Sequence[EvenData]) -> RestNoise:
    """Estimate the noise that records at rest share.

    records: Their first unknown is the drift, by a column of time in s.
    """
    if sum(record.observations.size for record in records) < 4 * (2 + len(COMPONENTS)):
        raise NotIdentifiableError("the record is too short to estimate any noise")
    likelihood = RestrictedLikelihood.of(records, None, None)
    best, every, without = _eliminated(likelihood)
    components: dict[str, SizedComponent] = {}
    for name in COMPONENTS:
        if name in best.names:
            components[name] = _interval(likelihood, best, every, name, without[name])
        else:
            components[name] = SizedComponent(0.0, 0.0, _limit(likelihood, every, name))
    estimate, covariance = likelihood.estimate(best.log_scale, best.unit)
    return RestNoise(
        components,
        best.covariance,
        float(estimate[0]),
        math.sqrt(covariance[0, 0]),
        _bands(likelihood, best),
    )


def _eliminated(
    likelihood: RestrictedLikelihood,
) -> tuple[Maximum, Maximum, dict[str, float]]:
    """Return the best noise of what the records ask for, that of all, and that without each."""
    every = _choice(likelihood, COMPONENTS).maximum(None, _first_sizes(likelihood))
    names, value, start = every.names, every.value, every.variances
    without: dict[str, float] = {}
    while True:
        smaller: dict[str, tuple[float, Variances]] = {}
        for name in names:
            rest = tuple(other for other in names if other != name)
            # Something has to be white, in the record or in its sensor.
            if set(rest) & set(COMPONENTS[:2]):
                smaller[name] = _choice(likelihood, rest).greatest(start)
        without = without or {name: one for name, (one, _) in smaller.items()}
        least = max(smaller, key=lambda name: smaller[name][0], default="")
        if not smaller or 2.0 * (value - smaller[least][0]) >= KEEPING_GAIN:
            best = every if names == every.names else None
            return best or _choice(likelihood, names).maximum(None, start), every, without
        names = tuple(name for name in names if name != least)
        value, start = smaller[least]


def _choice(likelihood: RestrictedLikelihood, names: tuple[str, ...]) -> Choice:
    return Choice(likelihood, Noise(0.0).with_sizes(dict.fromkeys(names, WANTED)), names)


def _first_sizes(likelihood: RestrictedLikelihood) -> Variances:
    """Return sizes near the most likely ones, the unknowns being none.

    Multiplicative steps uphill, whose sizes stay positive (Fevotte, Bertin and Durrieu, Neural
    Computation 21 (2009) 793, eq. 2.13 and 2.14).
    """
    parts, power, count = [], [], []
    for record in likelihood.records:
        assert isinstance(record, EvenRecord)
        first = record.places
        parts.append(record.parts[:, first])
        power.append(np.add.reduceat(record.stack[:, -1] ** 2, first))
        count.append(record.counts)
    part, energy, rows = np.concatenate(parts, axis=1), np.concatenate(power), np.concatenate(count)
    sizes = energy.sum() / (part @ rows) / len(part)
    for _ in range(_PASSES):
        expected = sizes @ part
        sizes = sizes * np.sqrt((part @ (energy / expected**2)) / (part @ (rows / expected)))
    # From nothing no step leads back.
    floor = 1e-6 * (energy.sum() / (part @ rows))
    return tuple(np.maximum(sizes, floor).tolist())


def _interval(
    likelihood: RestrictedLikelihood, best: Maximum, every: Maximum, name: str, without: float
) -> SizedComponent:
    """Return a component that is kept, with the ends of its interval."""
    place = COMPONENTS.index(name)
    size = best.variances[place]
    spread = math.sqrt(best.covariance[place, place]) / size
    profile = _profile(likelihood, every, name)
    middle, step = math.log(max(size, every.variances[place])), min(1.96 * spread, 2.0)
    top = max(every.value, profile(middle))
    high = _end(profile, top, middle, step, _TWO_SIDED)
    low = None
    if 2.0 * (top - without) >= _TWO_SIDED:
        low = _end(profile, top, math.log(min(size, every.variances[place])), -step, _TWO_SIDED)
    return SizedComponent(
        size, 0.0 if low is None else math.exp(low), math.inf if high is None else math.exp(high)
    )


def _limit(likelihood: RestrictedLikelihood, every: Maximum, name: str) -> float:
    """Return the size above which a component that is not kept would show."""
    place = COMPONENTS.index(name)
    first = math.log(max(_least(likelihood, every)[place], every.variances[place]))
    profile = _profile(likelihood, every, name)
    top = max(every.value, profile(first))
    end = _end(profile, top, first, 1.0, _ONE_SIDED)
    return math.inf if end is None else math.exp(end)


def _least(likelihood: RestrictedLikelihood, every: Maximum) -> Variances:
    """Return a hundredth of the noise where each component is most of it: that shows nowhere."""
    shares = [
        np.min(np.asarray(every.variances) @ record.parts / record.parts, axis=1)
        for record in likelihood.records
        if isinstance(record, EvenRecord)
    ]
    return tuple((0.01 * np.min(shares, axis=0)).tolist())


def _profile(
    likelihood: RestrictedLikelihood, every: Maximum, name: str
) -> Callable[[float], float]:
    """Return the likelihood at the log of a component's variance, at the best of all others.

    Those that the records do not ask for are among them: they may be there.
    """
    others = tuple(other for other in COMPONENTS if other != name)
    # From where nothing of it shows no step leads back.
    least = _least(likelihood, every)
    wanted = Noise(0.0).with_sizes(dict.fromkeys(others, WANTED))
    start = [every.variances]

    def value(log_size: float) -> float:
        given = wanted.with_sizes({name: math.exp(0.5 * log_size)})
        begin = tuple(map(max, start[0], least))
        found, start[0] = Choice(likelihood, given, others).greatest(begin)
        return found

    return value


def _end(
    profile: Callable[[float], float], top: float, middle: float, step: float, change: float
) -> float | None:
    """Return where 2 log L is less than its top by a change; None: nowhere.

    sqrt(2 log L) goes nearly as the distance from the top: false position in that.
    """
    wanted = math.sqrt(change)

    def away(x: float) -> float:
        return math.sqrt(max(2.0 * (top - profile(x)), 0.0)) - wanted

    inner, below = middle, -wanted
    outer = middle + step
    above = away(outer)
    for _ in range(_END_STEPS):
        if above > 0.0:
            break
        inner, below = outer, above
        step *= 2.0
        outer = inner + step
        above = away(outer)
    else:
        return None
    for _ in range(_END_STEPS):
        if above < _END_TOLERANCE:
            return outer
        if below > -_END_TOLERANCE:
            return inner
        part = min(max(-below / (above - below), 0.1), 0.9)
        between = inner + part * (outer - inner)
        value = away(between)
        if value > 0.0:
            outer, above = between, value
        else:
            inner, below = between, value
    return 0.5 * (inner + outer)


def _bands(likelihood: RestrictedLikelihood, best: Maximum) -> tuple[Band, ...]:
    """Return how the records' spectrum stands to that of the noise, band by band."""
    estimate, _ = likelihood.estimate(best.log_scale, best.unit)
    frequency, power, count = [], [], []
    for record, places in zip(likelihood.records, likelihood.places, strict=True):
        assert isinstance(record, EvenRecord)
        rows, _ = record.whitened(best.variances)
        left = rows[:, -1] - rows[:, :-1] @ estimate[places]
        power.append(np.add.reduceat(left**2, record.places))
        count.append(record.counts)
        number = np.cumsum(record.counts) - 0.5 * (record.counts - 1.0)
        frequency.append(number / (2.0 * record.length))
    at, energy, rows = map(np.concatenate, (frequency, power, count))
    bin_of = np.floor(_BANDS_A_DECADE * np.log10(at / at.min())).astype(int)
    bands = []
    for number in np.unique(bin_of):
        own = bin_of == number
        total = float(rows[own].sum())
        ratio = float(energy[own].sum()) / total
        bands.append(Band(float(at[own].min()), float(at[own].max()), ratio, total))
    return tuple(bands)
