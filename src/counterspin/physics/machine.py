"""What the machine does to a reading: centrifuge, fixture, dividing head, temperature, time.

Each term moves the `Station` of a reading, or multiplies a coefficient's product with what was
recorded beside the reading (its temperature, its time). Sizes are from the literature on precision
centrifuges and from IEEE Std 836.

- `MachineTerm`, `MACHINE_TERMS`: the table; names of mountings stand in place of ``MOUNTING``
- `machine_term`: the row that a symbol belongs to, and its mounting
- `moved`: a station with one of its terms changed
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.physics.conditions import CONDITION_TERMS
from counterspin.physics.shared_terms import MOTION_TERMS
from counterspin.physics.station import Station


@frozen
class MachineTerm:
    """One error term of the machine that carries the accelerometer.

    Attributes
    ----------
    symbol
        As in a campaign, with ``MOUNTING`` for the name of a mounting.
    unit, limit
        SI unit (coefficients: g-units) and the largest credible size in it.
    typical
        Size to reckon with where nothing is known.
    words
        What it is called.
    motions
        The motions in which it acts.
    multiplies
        The accelerometer's coefficient whose product it multiplies, with `recorded`; else empty.
    recorded
        ``temperature`` (K from the reference temperature), ``time`` (s from the first reading) or
        ``force`` (the centripetal one, whose square in g^2 multiplies).
    """

    symbol: str
    unit: str
    limit: float
    typical: float
    words: str
    motions: tuple[str, ...] = ("arm", "counter-rotating")
    multiplies: str = ""
    recorded: str = ""

    @property
    def per_mounting(self) -> bool:
        """Whether every mounting has a value of its own."""
        return "MOUNTING" in self.symbol

    @property
    def of_accelerometer(self) -> bool:
        """Whether every accelerometer has a value of its own."""
        return bool(self.multiplies)


#: Shown by records as well as by readings.
_OF_THE_PATH: Final = [row for row in MOTION_TERMS.values() if row.kind in ("stretch", "axis_tilt")]

_TURNING: Final = ("arm", "counter-rotating")
_EVERYWHERE: Final = (*_TURNING, "static")
_ABOUT: Final = ("east", "north", "outward", "forward", "up")

#: Every term of the machine, by symbol.
MACHINE_TERMS: Final[Mapping[str, MachineTerm]] = {
    row.symbol: row
    for row in (
        MachineTerm("centrifuge.radius.MOUNTING", "m", 0.1, 1e-3, "radius of a mounting"),
        *(
            MachineTerm(row.symbol, row.unit, row.limit, row.typical, row.words)
            for row in _OF_THE_PATH
        ),
        MachineTerm("centrifuge.droop", "rad s^2", 1e-3, 1e-8, "droop of the arm", ("arm",)),
        *(
            MachineTerm(
                f"fixture.misalignment.MOUNTING.{axis}",
                "rad",
                1e-2,
                5e-5,
                f"misalignment of a mounting about {axis}",
                _EVERYWHERE,
            )
            for axis in _ABOUT
        ),
        MachineTerm("head.zero", "rad", 1e-2, 2.5e-5, "zero of the dividing head", ("static",)),
        *(
            MachineTerm(
                row.symbol,
                row.unit,
                row.limit,
                row.typical,
                row.words,
                _TURNING if row.condition == "force" else _EVERYWHERE,
                row.coefficient,
                row.condition,
            )
            for row in CONDITION_TERMS.values()
        ),
    )
}


def machine_term(symbol: str) -> tuple[MachineTerm, str] | None:
    """Return the row that a symbol belongs to, and its mounting or an empty name; else None."""
    if symbol in MACHINE_TERMS and "MOUNTING" not in symbol:
        return MACHINE_TERMS[symbol], ""
    family, _, name = symbol.rpartition(".")
    if family == "centrifuge.radius" and name:
        return MACHINE_TERMS["centrifuge.radius.MOUNTING"], name
    kind, _, mounting = family.rpartition(".")
    row = MACHINE_TERMS.get(f"{kind}.MOUNTING.{name}")
    return (row, mounting) if row is not None and mounting else None


def moved(station: Station, symbol: str, size: float, head: Array) -> Station:
    """Return a station with one of the machine's terms larger by a size.

    Parameters
    ----------
    station
        Where the reading was taken.
    symbol
        A term of the machine that moves stations.
    size
        By how much, in the term's unit.
    head
        The axis about which the dividing head turns, in the station's frame, shape (3,).

    Raises
    ------
    ValueError
        If the term moves no station.
    """
    kind = symbol.split(".")
    match kind:
        case ["centrifuge", "radius", _]:
            return replace(station, radius=station.radius + size)
        case ["centrifuge", "stretch"]:
            return replace(station, stretch=station.stretch + size)
        case ["centrifuge", "axis_tilt", axis]:
            east, north = station.axis_tilt
            east, north = (east + size, north) if axis == "east" else (east, north + size)
            return replace(station, axis_tilt=(east, north))
        case ["centrifuge", "droop"]:
            return replace(station, droop=station.droop + size)
        case ["fixture", "misalignment", _, axis]:
            return _turned(station, size * axis_of(axis, station.motion))
        case ["head", "zero"]:
            return _turned(station, size * head)
    raise ValueError(f"{symbol} moves no station")


def axis_of(name: str, motion: str) -> Array:
    """Return the unit vector of a named axis in a motion's frame; zero where it has none."""
    names = ("outward", "forward", "up") if motion == "arm" else ("east", "north", "up")
    return np.array([float(name == other) for other in names])


def _turned(station: Station, turn: Array) -> Station:
    east, north, up = np.array(station.turn) + turn
    return replace(station, turn=(float(east), float(north), float(up)))
