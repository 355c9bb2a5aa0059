"""A record of a sensor at rest: cleaned, cut at its gaps, and what it says of its noise."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from counterspin.arrays import Array, median
from counterspin.errors import NotIdentifiableError, RecordError
from counterspin.frozen import frozen
from counterspin.inference.noise.even import EvenData, SampleKind
from counterspin.inference.noise.model import SPECIFIC_FORCE
from counterspin.inference.noise.rest import RestNoise, find_rest_noise
from counterspin.inference.noise.spectrum import Line, find_lines
from counterspin.records.spikes import find_spikes

#: Most samples in a row that are put in from their neighbours; more are a gap.
_MOST_FILLED: Final = 3

#: Part of a step by which a sample may stand off from an even clock.
_OFF_CLOCK: Final = 0.3

#: Fewest samples of a stretch that is used.
_FEWEST: Final = 32

#: Most samples that the noise is looked for in: of longer records velocities at longer steps.
MOST_SAMPLES: Final = 300_000


@frozen(eq=False)
class Stretches:
    """The parts of a record between its gaps."""

    step: float  #: Of the clock, s.
    #: Of each: the time of its first sample, s, and its samples, SI.
    parts: tuple[tuple[float, Array], ...]
    rows: int  #: Of the record.
    outliers: int  #: Left out.
    filled: int  #: Samples put in from their neighbours, outliers among them.
    gaps: int  #: Between the parts.
    unused: int  #: Samples of parts that are too short.
    resolution: float  #: Least step between different samples, SI.

    @property
    def longest(self) -> tuple[float, Array]:
        """The longest part."""
        return max(self.parts, key=lambda part: part[1].size)


@frozen(eq=False)
class RestAnalysis:
    """What a record says of its noise."""

    noise: RestNoise
    lines: tuple[Line, ...]
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
    """What one column says of its noise."""

    signal: RestSignal
    stretches: Stretches
    analysis: RestAnalysis


def at_rest(record: object, signal: RestSignal) -> RestRecord:
    """Return what a column says of its noise; RecordError if it cannot.

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
    order = np.diff(time) > 0.0
    if (np.diff(time) < 0.0).any():
        raise ValueError("its time runs backwards")
    keep = np.append(True, order)
    time, values = time[keep], values[keep]
    if time.size < _FEWEST:
        raise ValueError(f"{time.size} samples are too few: {_FEWEST} are needed")
    steps = np.diff(time)
    step = median(steps)
    # The median of rounded times is off; their mean over steps that are one is not.
    single = steps < 1.5 * step
    step = float(steps[single].mean())
    spikes = find_spikes(time, values, 0.0, step, float(steps[single].std() / step))
    spikes = spikes[np.isfinite(values[spikes])]
    clean = values.copy()
    clean[spikes] = np.nan
    good = np.isfinite(clean)
    at, kept = time[good], clean[good]
    if kept.size < _FEWEST:
        raise ValueError(f"{kept.size} samples are too few: {_FEWEST} are needed")
    ahead = np.diff(at) / step
    cuts = np.flatnonzero(ahead > _MOST_FILLED + 1.5) + 1
    parts, filled, unused = [], 0, 0
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
        count = int(number[-1]) + 1
        filled += count - own.size
        parts.append((float(own_time[0]), np.interp(np.arange(count), number, own)))
    if not parts:
        raise ValueError(f"no {_FEWEST} successive samples are without a gap")
    different = np.diff(np.unique(kept[:4096]))
    resolution = float(different.min()) if different.size else 0.0
    return Stretches(
        step, tuple(parts), rows, spikes.size, filled, len(parts) - 1, unused, resolution
    )


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
    lines: list[Line] = []
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
    return RestAnalysis(noise, tuple(lines), step * thin, velocity, kind)
