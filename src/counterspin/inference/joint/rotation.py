"""The rotation of runs whose spindle angle nobody recorded, found from the output itself."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.errors import ConvergenceError
from counterspin.inference.joint.fit import solve_joint
from counterspin.inference.joint.prepared import prepare_columns
from counterspin.inference.joint.series import Series
from counterspin.inference.joint.unknowns import ROTATION, Unknown, Unknowns
from counterspin.inference.noise.model import Noise

_ROUNDS: Final = 20  #: of Gauss and Newton's iteration

#: Angle at the end of a run, rad, below which the iteration has settled.
_ANGLE_TOLERANCE: Final = 1e-7

#: Fewest samples of a stretch from which a phase is taken: five functions are fitted to them.
_STRETCH_SAMPLES: Final = 8

#: Horizontal part of an input axis from which the rotation can be seen.
_HORIZONTAL_PART: Final = 0.1


def find_rotation(
    series: Sequence[Series],
    model: Unknowns,
    scale_factors: Mapping[str, float],
    rough: Mapping[str, Noise],
) -> tuple[Series, ...]:
    """Find start angle, rate and drift of each run.

    The phase of each revolution against the nominal rate gives a first guess, whatever the start
    angle, for rates that are off by up to a tenth; the joint fit of all series is then iterated
    about it (Gauss and Newton).
    """
    turned = _guessed(series)
    # What turns the output by a right angle, such as a misalignment of which nothing is known, is
    # as good as a start angle; a step to any size of it would not be small.
    held = replace(model, unknowns=tuple(map(_credible, model.unknowns)))
    for _ in range(_ROUNDS):
        prepared = prepare_columns(turned, held, scale_factors)
        solution = solve_joint(prepared, held, rough).solution
        change: dict[str, dict[str, float]] = {}
        for unknown, value in zip(model.unknowns, solution.estimate, strict=True):
            if unknown.symbol in ROTATION:
                change.setdefault(unknown.owner, {})[unknown.symbol] = float(value)
        turned = tuple(
            _turned(record, *(change[record.run][symbol] for symbol in ROTATION))
            for record in turned
        )
        if all(_end_angle(record, change[record.run]) < _ANGLE_TOLERANCE for record in turned):
            return turned
    raise ConvergenceError(
        "the rotation could not be found from the displacement: the nominal rate is too "
        "inaccurate; "
        "record the spindle's angle, or state the rate more accurately"
    )


def _credible(unknown: Unknown) -> Unknown:
    """Return an unknown of which nothing is known with its largest credible size for a prior."""
    if unknown.symbol in ROTATION or math.isfinite(unknown.prior[1]):
        return unknown
    return replace(unknown, prior=(unknown.nominal, unknown.limit))


def _guessed(series: Sequence[Series]) -> tuple[Series, ...]:
    """Return the series about a first guess of each run's rotation."""
    guesses = {}
    for run in dict.fromkeys(record.run for record in series):
        own = [record for record in series if record.run == run]
        horizontal = [
            float(np.linalg.norm(record.mounting.turned(record.attitude).input_axis[:2]))
            for record in own
        ]
        best = int(np.argmax(horizontal))
        guesses[run] = _guess(own[best]) if horizontal[best] > _HORIZONTAL_PART else (0.0, 0.0, 0.0)
    return tuple(_turned(record, *guesses[record.run]) for record in series)


def _guess(series: Series) -> tuple[float, float, float]:
    """Return changes of start angle, rate and drift from the phases of the revolutions."""
    spindle = series.trajectory.spindle
    ahead = replace(
        series.trajectory,
        spindle=replace(spindle, start_angle=spindle.start_angle + math.pi / 2.0),
    )
    output = series.error + series.reference()
    waves = np.column_stack([series.reference(), series.reference(ahead)])
    turn = 2.0 * math.pi / abs(spindle.rate)
    places = np.floor((series.time - series.time[0]) / turn).astype(int)
    times, phases = [], []
    for place in range(places[-1] + 1):
        rows = places == place
        if np.count_nonzero(rows) < _STRETCH_SAMPLES:
            continue
        middle = float(series.time[rows].mean())
        # Over one revolution all else that the output does is a parabola.
        slow = np.vander((series.time[rows] - middle) / turn, 3)
        size = np.linalg.lstsq(np.column_stack([waves[rows], slow]), output[rows], rcond=None)[0]
        times.append(middle)
        phases.append(math.atan2(size[1], size[0]))
    if not times:
        return (0.0, 0.0, 0.0)
    degree = min(2, len(times) - 1)
    lag = np.polynomial.Polynomial.fit(times, np.unwrap(phases), degree).convert().coef
    start, rate, bend = (*lag, 0.0, 0.0)[:3]
    return (float(start), float(rate), float(2.0 * bend / (spindle.rate + rate)))


def _turned(series: Series, start_angle: float, rate: float, drift: float) -> Series:
    """Return the series about the reference of a rotation changed by the given steps."""
    spindle = series.trajectory.spindle
    moved = replace(
        series.trajectory,
        spindle=replace(
            spindle,
            start_angle=spindle.start_angle + start_angle,
            rate=spindle.rate + rate,
            drift=spindle.drift + drift,
        ),
    )
    output = series.error + series.reference()
    return replace(series, trajectory=moved, error=output - series.reference(moved))


def _end_angle(series: Series, change: Mapping[str, float]) -> float:
    """Return how far the last sample has turned, at most, by a change of the rotation, rad."""
    end = float(series.time[-1])
    sizes = (1.0, end, abs(series.trajectory.spindle.rate) * end**2)
    return sum(abs(change[s]) * size for s, size in zip(ROTATION, sizes, strict=True))
