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
    HEAD_HARMONICS,
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


def rows_of(
    name: str, mountings: Iterable[Mounting], attitudes: Iterable[Array]
) -> tuple[Term[AttitudeError | TrajectoryError], ...]:
    """Return the components that a bare name names.

    For the platform these are the components that leave an acceleration, in any run that starts at
    angle zero, in any accelerometer: one that does not average out and that depends on the run.

    mountings, attitudes: Of the campaign's accelerometers and runs.
    """
    axes = [(mounting.turned(a).input_axis, a) for mounting, a in product(mountings, attitudes)]
    return tuple(
        row
        for row in BARE_NAMES[name]
        if any(row.effect.leaves_mean(*directions, _NORTH) for directions in axes)
    )


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
        fewest = 2 if row.symbol.startswith(HEAD_HARMONICS) else 1
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
