"""Names of error terms, and the components that each name includes in a campaign.

A bare platform name includes the components that affect the campaign's accelerometers to first
order, in any attitude of the runs, with the paper's start angle of zero:

- tilt, drift or g^2-sensitivity about the axis e: if (e x up) has a component along the input axis,
  so that gravity couples in;
- g-sensitivity: that of the azimuth gyro to force along a horizontal input axis, and that of a
  gyro whose drift matters to force along the initial velocity, which leaves a tilt;
- compliance: in azimuth, to horizontal force at right angles to the input axis.
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


def _group_by_bare_name() -> dict[str, tuple[Term[AttitudeError | TrajectoryError], ...]]:
    names: dict[str, list[Term[AttitudeError | TrajectoryError]]] = {}
    for symbol, row in SHARED_TERMS.items():
        symbol_parts = symbol.split(".")
        for n_parts in range(2, len(symbol_parts)):
            names.setdefault(".".join(symbol_parts[:n_parts]), []).append(row)
    return {name: tuple(rows) for name, rows in names.items()}


#: Bare name, such as ``platform.tilt`` or ``encoder.harmonic.1`` -> its terms.
BARE_NAMES: Final[Mapping[str, tuple[Term[AttitudeError | TrajectoryError], ...]]] = (
    _group_by_bare_name()
)

_NORTH: Final = np.array([0.0, 1.0, 0.0])

#: Prefixes of the machine terms' names.
_FAMILIES: Final = ("centrifuge.", "fixture.", "head.", "vibration.")

#: Motion -> names of the axes about which a fixture may be rotated.
_AXES: Final = {
    "arm": ("outward", "forward", "up"),
    "static": ("east", "north", "up"),
    "vibration": ("east", "north", "up"),
    "counter-rotating": ("east", "north", "up"),
}

#: Prefix of the positioning errors of all positions.
POSITION_SYMBOL: Final = "fixture.position"


def acting_rows(
    name: str, mountings: Iterable[Mounting], attitudes: Iterable[Array]
) -> tuple[Term[AttitudeError | TrajectoryError], ...]:
    """Return the terms that a bare name includes.

    For the platform these are the components that leave an acceleration in an accelerometer, in a
    run with start angle zero, which does not average out and depends on the run.

    mountings, attitudes: Mountings of the accelerometers, attitudes of the runs.
    """
    axes = [
        (mounting.turned(attitude).input_axis, attitude)
        for mounting, attitude in product(mountings, attitudes)
    ]
    return tuple(
        row
        for row in BARE_NAMES[name]
        if any(row.effect.affects_mean(*axis_and_attitude, _NORTH) for axis_and_attitude in axes)
    )


# Terms that affect readings


def shown_symbols(readings: Sequence[Reading], *, has_records: bool = False) -> tuple[str, ...]:
    """Return all machine terms that affect readings, and records if there are any."""
    motions = {str(reading.motion) for reading in readings}
    motions |= {"counter-rotating"} if has_records else set()
    mounting_keys = dict.fromkeys(
        (reading.mounting, reading.motion, reading.accelerometer)
        for reading in readings
        if reading.mounting
    )
    head_angles = {
        round(reading.head_angle, 9)
        for reading in readings
        if any(reading.head) and reading.motion == "static"
    }
    symbols: dict[str, None] = {}
    for row in READING_TERMS.values():
        if not motions & set(row.motions):
            continue
        # A zero error needs one head angle, a harmonic another.
        min_angles = 2 if row.symbol.startswith(HEAD_HARMONICS) else 1
        if row.symbol.startswith("head.") and len(head_angles) < min_angles:
            continue
        if row.scope == "position":
            positions = dict.fromkeys(reading.position for reading in readings if reading.position)
            symbols |= {row.symbol.replace("POSITION", name): None for name in positions}
            continue
        if not row.per_mounting:
            symbols[row.symbol] = None
            continue
        for name, motion, owner in mounting_keys:
            axis = row.symbol.rpartition(".")[2]
            if motion in row.motions and axis in ("MOUNTING", *_AXES[motion]):
                symbol = row.symbol.replace("ACCELEROMETER", owner).replace("MOUNTING", name)
                symbols[symbol] = None
    return tuple(symbols)


def is_reading_term(name: str) -> bool:
    """Return whether a name is that of a machine term or slope that affects readings."""
    is_family = "." in name and any(symbol.startswith(f"{name}.") for symbol in READING_TERMS)
    if is_family or affects_readings(name):
        return True
    is_in_records = any(f"{symbol}.".startswith(f"{name}.") for symbol in SHARED_TERMS)
    return name.startswith(_FAMILIES) and not is_in_records


def expand_name(name: str, symbols: Iterable[str]) -> tuple[str, ...]:
    """Return the terms of a name: the term itself, or all terms of the family.

    A slope of a coefficient is a single term for all powers of its condition.
    """
    if condition_of(name):
        return tuple(symbol for symbol in symbols if symbol == name)
    return tuple(symbol for symbol in symbols if symbol == name or symbol.startswith(f"{name}."))
