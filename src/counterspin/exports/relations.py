"""What signals show together: the sense of the angle, and the unit or axis that a file leaves open.

On a double turntable every signal swings as the centrifuge's radius does in its direction. So the
radius shows the unit of one, and the phase between two shows the sense or the axis of the second.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Final

from counterspin.campaign.kinds import COMPASS
from counterspin.campaign.quantity import parse
from counterspin.campaign.settings import OBSERVABLES
from counterspin.exports.guessing import STANDARD_GRAVITY, FileGuess, SignalGuess
from counterspin.exports.questions import SENSES, USUAL_UNITS
from counterspin.units import unit_factor

#: Axis -> the one against which it points, and by how much it is turned, rad.
_OPPOSITE: Final = {"west": ("east", math.pi), "south": ("north", math.pi)}
#: Relative difference between a radius and what a signal shows of it: of its scale factor.
_SIZE_TOLERANCE: Final = 0.1
#: Difference between the phases of waves along two axes from a quarter turn, rad.
_PHASE_TOLERANCE: Final = 0.3


def waves_sense(common: FileGuess) -> str | None:
    """Return the sense in which the angle grows, by the waves along two horizontal axes."""
    phases: dict[str, dict[str, float]] = {}
    for signal in common.signals:
        if signal.phase is not None and signal.axis is not None and signal.observable:
            axis, turned = _OPPOSITE.get(signal.axis, (signal.axis, 0.0))
            phases.setdefault(signal.observable, {})[axis] = signal.phase + turned
    for phase in phases.values():
        if "east" in phase and "north" in phase:
            ahead = math.remainder(phase["east"] - phase["north"], 2.0 * math.pi)
            if abs(abs(ahead) - math.pi / 2.0) < _PHASE_TOLERANCE:
                return SENSES[0] if ahead > 0.0 else SENSES[1]
    return None


def completed(common: FileGuess, told: Mapping[str, str]) -> FileGuess:
    """Return a guess with units that follow from the radius and axes that follow from the sense.

    told: What a person says, by the keys of questions.
    """
    signals = common.signals
    if "radius" in told and common.rate is not None and (common.time or common.sampling):
        radius = parse(told["radius"], "m").value
        signals = tuple(_with_unit(signal, radius, common.rate) for signal in signals)
    if "sense" in told:
        forward = 1.0 if told["sense"] == SENSES[0] else -1.0
        signals = tuple(_with_axis(signal, signals, forward) for signal in signals)
    return replace(common, signals=signals)


def _with_unit(signal: SignalGuess, radius: float, rate: float) -> SignalGuess:
    """Return a signal with the unit in which it swings by a radius, m, at a rate, rad/s."""
    if signal.unit is not None or signal.observable is None:
        return signal
    derivatives, si = list(OBSERVABLES).index(signal.observable), OBSERVABLES[signal.observable]
    wanted = radius * rate**derivatives
    for unit in USUAL_UNITS[si]:
        size = signal.amplitude * unit_factor(unit, si, gravity=STANDARD_GRAVITY)
        if abs(size / wanted - 1.0) < _SIZE_TOLERANCE:
            return replace(signal, unit=unit, by_radius=True)
    return signal


def _with_axis(
    signal: SignalGuess, signals: tuple[SignalGuess, ...], forward: float
) -> SignalGuess:
    """Return a signal with the axis that its phase shows against another of a known axis.

    forward: 1 where the angle grows counterclockwise, -1 where it grows clockwise.
    """
    if signal.axis is not None or signal.phase is None or signal.observable is None:
        return signal
    for other in signals:
        if other.axis not in COMPASS or other.observable != signal.observable:
            continue
        if other.phase is None:
            continue
        direction = COMPASS[other.axis] + forward * (other.phase - signal.phase)
        for axis, known in COMPASS.items():
            across = abs(math.remainder(direction - known, 2.0 * math.pi))
            if axis != other.axis and across < _PHASE_TOLERANCE:
                return replace(signal, axis=axis)
    return signal
