"""What a record shows of uncertain inputs: radius, gravity, latitude, timing, rotation."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.inference.joint.series import Series
from counterspin.physics.motion import Trajectory

#: Uncertain inputs: how each changes the trajectory, and the relative step of its derivative.
_STEP: Final = 1e-5
_INPUT_STEP: Final = 1e-6
INPUTS: Final[Mapping[str, Callable[[Trajectory, float], Trajectory]]] = {
    "centrifuge.radius": lambda motion, step: replace(motion, radius=motion.radius + step),
    "site.gravity": lambda motion, step: replace(
        motion, site=replace(motion.site, gravity=motion.site.gravity + step)
    ),
    "site.latitude": lambda motion, step: replace(
        motion, site=replace(motion.site, latitude=motion.site.latitude + step)
    ),
}
TIMING: Final = "records.timing_offset"  #: s, by which an angle is sampled after its output
CLOCK: Final = "records.clock"  #: the part of itself by which the recorder's clock runs fast


def rotation_column(series: Series, symbol: str) -> Array:
    """Return d(reference)/d(a parameter of the rotation), by central differences, shape (n,)."""
    spindle = series.trajectory.spindle
    duration = float(series.time[-1])
    name, step = {
        "spindle.start_angle": ("start_angle", _STEP),
        "spindle.rate": ("rate", _STEP / duration),
        "spindle.drift": ("drift", _STEP / (abs(spindle.rate) * duration**2)),
    }[symbol]
    ahead, behind = (
        series.reference(
            replace(
                series.trajectory,
                spindle=replace(spindle, **{name: getattr(spindle, name) + change}),
            )
        )
        for change in (step, -step)
    )
    return (ahead - behind) / (2.0 * step)


def concerns(series: Series, name: str, recorder: str) -> bool:
    """Return whether an input shows in a series; of clocks it is that of its own recorder."""
    return name != CLOCK or recorder == series.recorder


def input_column(
    series: Series,
    name: str,
    scale_factor: float,
    known: Mapping[str, float],
    table: Mapping[str, Array],
    base: Array | None = None,
) -> Array:
    """Return d(recorded output)/d(input) at the estimate, by a forward difference, shape (n,).

    scale_factor: K_I, with which the accelerometer sees the platform's errors.
    """
    base = series.reference() if base is None else base
    symbols = list(known)
    errors = np.array([known[symbol] for symbol in symbols])
    before = np.column_stack([table[s] for s in symbols] or [np.empty((base.size, 0))]) @ errors
    reference, columns, step = with_input(series, name, symbols, scale_factor)
    change: Array = (reference + columns @ errors - base - before) / step
    if name == "site.latitude" and series.by_latitude is not None:
        change = change - series.by_latitude
    if name == "site.gravity" and series.in_g:
        # A record in g was turned into m/s^2 with the gravity assumed. What it should be is what
        # counts: with its noise in the column, it would explain itself.
        change = change - (base + before) / series.trajectory.site.gravity
    return change


def with_input(
    series: Series, name: str, symbols: Sequence[str], scale_factor: float
) -> tuple[Array, Array, float]:
    """Return reference (n,) and columns (n, q) with an input off by a small step, and the step."""
    if name == TIMING:
        spindle = series.trajectory.spindle
        step = _STEP / abs(spindle.rate)
        # Angles that were taken later were reached later: the spindle was behind by that time, for
        # what the errors make of the motion too. In these its ripple no longer counts.
        behind = replace(spindle, start_angle=spindle.start_angle - spindle.rate * step)
        late = series.columns(symbols, scale_factor, replace(series.trajectory, spindle=behind))
        return series.reference(later=-step), late, step
    if name == CLOCK:
        there = series.by_clock(_STEP)
        return there.reference(), there.columns(symbols, scale_factor), _STEP
    size = {
        "centrifuge.radius": series.trajectory.radius,
        "site.gravity": series.trajectory.site.gravity,
        "site.latitude": 1.0,
    }[name]
    step = _INPUT_STEP * size
    moved = INPUTS[name](series.trajectory, step)
    return series.reference(moved), series.columns(symbols, scale_factor, moved), step
