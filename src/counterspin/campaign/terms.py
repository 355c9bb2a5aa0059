"""Names of error terms: what each stands for in a campaign, and where it acts.

A bare platform name means the components that act on the campaign's accelerometers to first
order, in any of the runs' attitudes, with the paper's start angle of zero:

- tilt, drift or g^2-sensitivity about the axis e: where (e x up) has a part along the input axis,
  so that gravity leaks in;
- g-sensitivity: that of the azimuth gyro to force along a horizontal input axis, and that of a
  gyro whose drift acts to force along the velocity at the start, which stays behind as a tilt;
- compliance: in azimuth, to level force at right angles to the input axis.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.campaign.reading import Reading
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.effects import AttitudeError, TrajectoryError
from counterspin.physics.terms import (
    HEAD_WAVES,
    READING_TERMS,
    SHARED_TERMS,
    Term,
    affects_readings,
    condition_of,
)


def _bare_names() -> dict[str, tuple[Term[AttitudeError | TrajectoryError], ...]]:
    names: dict[str, list[Term[AttitudeError | TrajectoryError]]] = {}
    for symbol, row in SHARED_TERMS.items():
        parts = symbol.split(".")
        for length in range(2, len(parts)):
            names.setdefault(".".join(parts[:length]), []).append(row)
    return {name: tuple(rows) for name, rows in names.items()}


#: Bare name, such as ``platform.tilt`` or ``encoder.harmonic.1`` -> the rows it stands for.
BARE_NAMES: Final[Mapping[str, tuple[Term[AttitudeError | TrajectoryError], ...]]] = _bare_names()

_NORTH: Final = np.array([0.0, 1.0, 0.0])
_UP: Final = np.array([0.0, 0.0, 1.0])
_ROUNDING: Final = 1e-9  #: of a unit vector; above roundoff, below any angle of a mounting

#: What a name of the machine's terms begins with.
_FAMILIES: Final = ("centrifuge.", "fixture.", "head.", "vibration.")

#: Axes about which a fixture may be turned, by motion: the names of the frame.
_AXES: Final = {
    "arm": ("outward", "forward", "up"),
    "static": ("east", "north", "up"),
    "vibration": ("east", "north", "up"),
    "counter-rotating": ("east", "north", "up"),
}

#: What the setting errors of all positions begin with.
POSITION: Final = "fixture.position"


def acts(row: Term[AttitudeError | TrajectoryError], mounting: Mounting, attitude: Array) -> bool:
    """Return whether a shared term reaches an accelerometer to first order in some run.

    mounting: The accelerometer's axes while the platform is level.
    attitude: Rows: where the platform's axes point in the run, shape (3, 3).
    """
    input_axis = mounting.turned(attitude).input_axis
    effect = row.effect
    if isinstance(effect, TrajectoryError):
        # A tilted axis lifts the platform; all else moves it in the level plane.
        moved = input_axis[2:] if effect.kind == "axis_tilt" else input_axis[:2]
        return float(np.linalg.norm(moved)) > _ROUNDING
    if effect.kind == "compliance":
        return float(np.linalg.norm(np.cross(attitude[effect.axis], input_axis))) > _ROUNDING
    if effect.part == "table":
        return _leaves_a_mean(effect, input_axis, attitude, None)
    along = effect.force_axis
    steady = along is not None and abs(float(attitude[along] @ _UP)) > _ROUNDING
    if steady and _leans(effect, input_axis, attitude):
        return True  # as a drift
    return _leaves_a_mean(effect, input_axis, attitude, None)


def shows(row: Term[AttitudeError | TrajectoryError], mounting: Mounting, attitude: Array) -> bool:
    """Return whether a shared term shows in an accelerometer's output at all, in waves as well.

    In displacement waves are negligible compared with the accelerations of `acts`; in velocity and
    specific force they appear where the effect of K_II does. Parameters as of `acts`.
    """
    if not isinstance(row.effect, AttitudeError):
        return acts(row, mounting, attitude)
    if row.effect.kind == "table_axis":
        return True  # its axis takes every level direction
    turned = np.cross(_axis_of(row.effect, attitude), mounting.turned(attitude).input_axis)
    return float(np.linalg.norm(turned)) > _ROUNDING


def _axis_of(turn: AttitudeError, attitude: Array) -> Array:
    """Return the axis about which a term turns, east-north-up, shape (3,).

    Tilts are about geographic axes, the table about up, all others about the platform's own axes.
    """
    axes = np.eye(3) if turn.kind in ("tilt", "table") else attitude
    axis: Array = axes[turn.axis]
    return axis


def _leans(turn: AttitudeError, input_axis: Array, attitude: Array) -> bool:
    """Return whether gravity leaks into the input axis as a term turns the platform."""
    return abs(float(np.cross(_axis_of(turn, attitude), input_axis) @ _UP)) > _ROUNDING


def rows_of(
    name: str, mountings: Iterable[Mounting], attitudes: Iterable[Array]
) -> tuple[Term[AttitudeError | TrajectoryError], ...]:
    """Return the components that a bare name names.

    For the platform these are the components that leave an acceleration, in any run that starts at
    angle zero, in any accelerometer: one that does not average out and that depends on the run.

    mountings, attitudes: Of the campaign's accelerometers and runs.
    """
    pairs = list(product(mountings, attitudes))

    def meant(
        row: Term[AttitudeError | TrajectoryError], mounting: Mounting, attitude: Array
    ) -> bool:
        if isinstance(row.effect, TrajectoryError):
            return acts(row, mounting, attitude)
        return _leaves_a_mean(row.effect, mounting.turned(attitude).input_axis, attitude, _NORTH)

    return tuple(row for row in BARE_NAMES[name] if any(meant(row, *pair) for pair in pairs))


def _leaves_a_mean(
    turn: AttitudeError, input_axis: Array, attitude: Array, start: Array | None
) -> bool:
    """Return whether a term leaves an acceleration over whole revolutions.

    input_axis: In the run's attitude, shape (3,).
    start: Direction in which the platform moves at t = 0, shape (3,); None: any level direction.
    """
    if turn.kind == "table_axis":
        # The centripetal force leaks into an upright axis; gravity leaks in as a wave.
        return turn.axis == 1 and abs(float(input_axis @ _UP)) > _ROUNDING
    # Gravity leaks in by its vertical part.
    turned = np.cross(_axis_of(turn, attitude), input_axis)
    if turn.kind == "table":
        return float(np.linalg.norm(turned)) > _ROUNDING
    leaning = abs(float(turned @ _UP))
    if turn.force_axis is None:
        return leaning > _ROUNDING
    # The vertical force is steady: a sensitivity to it is a drift or a tilt, the same in all runs.
    force = attitude[turn.force_axis] * (1.0 - _UP)
    if turn.kind == "compliance":
        return abs(float(turned @ force)) > _ROUNDING
    # The force's integral is the velocity, a quarter turn behind it.
    across = abs(float(np.cross(_UP, force) @ turned))
    moving = float(np.linalg.norm(force)) if start is None else abs(float(force @ start))
    return max(across, min(leaning, moving)) > _ROUNDING


# What readings show


def symbols_shown(readings: Sequence[Reading], *, recorded: bool = False) -> tuple[str, ...]:
    """Return every term of the machine that these readings, and records with them, can show."""
    motions = {str(reading.motion) for reading in readings}
    motions |= {"counter-rotating"} if recorded else set()
    mounted = dict.fromkeys((r.mounting, r.motion, r.accelerometer) for r in readings if r.mounting)
    shown = {round(r.head_angle, 9) for r in readings if any(r.head) and r.motion == "static"}
    symbols: dict[str, None] = {}
    for row in READING_TERMS.values():
        if not motions & set(row.motions):
            continue
        # A zero needs a head, a wave another angle of it.
        fewest = 2 if row.symbol.startswith(HEAD_WAVES) else 1
        if row.symbol.startswith("head.") and len(shown) < fewest:
            continue
        if row.scope == "position":
            positions = dict.fromkeys(r.position for r in readings if r.position)
            symbols |= {row.symbol.replace("POSITION", name): None for name in positions}
            continue
        if not row.per_mounting:
            symbols[row.symbol] = None
            continue
        for name, motion, owner in mounted:
            axis = row.symbol.rpartition(".")[2]
            if motion in row.motions and axis in ("MOUNTING", *_AXES[motion]):
                named = row.symbol.replace("ACCELEROMETER", owner).replace("MOUNTING", name)
                symbols[named] = None
    return tuple(symbols)


def is_reading_term(name: str) -> bool:
    """Return whether a name is that of a term shown by readings: of the machine, or of a slope."""
    is_family = "." in name and any(symbol.startswith(f"{name}.") for symbol in READING_TERMS)
    if is_family or affects_readings(name):
        return True
    shown_by_records = any(f"{symbol}.".startswith(f"{name}.") for symbol in SHARED_TERMS)
    return name.startswith(_FAMILIES) and not shown_by_records


def expand(name: str, known: Iterable[str]) -> tuple[str, ...]:
    """Return the terms that a name names: itself, or all that begin with it.

    The slope of a coefficient is one term, for all powers of the same condition.
    """
    if condition_of(name):
        return tuple(s for s in known if s == name)
    return tuple(s for s in known if s == name or s.startswith(f"{name}."))
