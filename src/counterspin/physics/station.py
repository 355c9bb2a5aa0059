"""Stations of readings: at rest, on the arm of a centrifuge, or on a double turntable.

A reading is the mean of an accelerometer's output over whole revolutions, or at rest. Given the
station, it is linear in the coefficients: each counts with the mean of its product of specific
forces. What the machine does beside turning (a radius that stretches, an arm that droops, a
fixture that is turned) moves the station, so that its effect on a reading is a derivative.

Vectors are in the station's frame: east-north-up at rest and on a double turntable; outward along
the arm, forward (the way that the arm moves at a positive rate) and up on an arm. Both frames are
right-handed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.physics import quadrature
from counterspin.physics.accelerometer import DIRECTIONS, Mounting
from counterspin.physics.effects import (
    SIGN_WIDTH,
    AttitudeError,
    Input,
    SetupError,
    TrajectoryError,
)
from counterspin.physics.motion import Site
from counterspin.physics.terms import TERMS, MotionKind, term

_ON_THE_ARM: Final[Mapping[str, tuple[float, float, float]]] = {
    "outward": (1.0, 0.0, 0.0),
    "inward": (-1.0, 0.0, 0.0),
    "forward": (0.0, 1.0, 0.0),
    "backward": (0.0, -1.0, 0.0),
    "up": (0.0, 0.0, 1.0),
    "down": (0.0, 0.0, -1.0),
}

#: Motion -> the directions that have a name in its frame, unit vectors.
FRAMES: Final[Mapping[str, Mapping[str, tuple[float, float, float]]]] = {
    "counter-rotating": DIRECTIONS,
    "arm": _ON_THE_ARM,
    # An arm that stands still is one that points east: gravity is all that acts.
    "static": {**DIRECTIONS, **_ON_THE_ARM},
}

#: Motion, or ``poses`` -> the name of its readings.
READINGS: Final = {
    "static": "readings at rest",
    "arm": "readings on the arm",
    "counter-rotating": "readings on the double turntable",
    "poses": "poses at unknown attitudes",
}

#: Angles of a revolution at which the mean is taken: exact for products of degree below this.
_ANGLES: Final = 16


@frozen
class Station:
    """Position, attitude and motion of the instrument during one reading."""

    motion: MotionKind  #: ``counter-rotating``, ``arm`` or ``static``.
    mounting: Mounting  #: The accelerometer's axes in the station's frame.
    rate: float = 0.0  #: rad/s; its sign is the sense, right-handed about up. 0 at rest.
    radius: float = 0.0  #: From the spindle's axis to the proof mass when the arm is unloaded, m.
    #: Relative growth of the radius per m/s^2 of centripetal acceleration, s^2/m.
    stretch: float = 0.0
    #: Turn of the instrument about forward per squared rate, rad s^2: a positive one lowers the
    #: outer end of the arm. Of the arm only.
    droop: float = 0.0
    #: Small right-handed turns of the spindle's axis about east and north, rad.
    axis_tilt: tuple[float, float] = (0.0, 0.0)
    #: Small right-handed turn of the instrument about the axes of the frame, rad, shape (3,).
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    #: (n, c, s): the counter-rotating table, and the instrument on it, is turned about up by
    #: c cos n theta + s sin n theta, rad.
    table: tuple[tuple[int, float, float], ...] = ()

    def force(
        self,
        site: Site,
        angle: Array,
        rate: Array | None = None,
        acceleration: Array | float = 0.0,
    ) -> Array:
        """Return the specific force in the station's frame.

        site: Gravity, latitude and the Earth's rotation.
        angle: Of the spindle, from east towards north, rad, shape (n,).
        rate: There, rad/s, shape (n,); None: that of the station.
        acceleration: Of the angle there, rad/s^2, shape (n,), on an arm.
        Returns: m/s^2, shape (n, 3).

        Neglected are the square of the Earth's rate times the radius (1.3e-8 m/s^2 at 2.5 m) and
        the turn of the plumb line across the radius.
        """
        force: Array = _forces([self], site, angle, rate)[0]
        if self.motion == "arm":
            force[:, 1] += self.radius * acceleration
        return force

    def products(self, site: Site, force: Array) -> Array:
        """Return the signed products of specific forces, shape (number of `TERMS`, n).

        force: In the station's frame, m/s^2, shape (n, 3).
        """
        axes = self.axes_under_load()
        rotation = _rotations([self], axes[None])[0]
        return _products(axes @ force.T / site.gravity, rotation)

    def axes_under_load(self) -> Array:
        """Return the axes I, P, O with droop and turn, rows, shape (3, 3)."""
        axes: Array = _axes_under_load([self])[0]
        return axes

    def indicated(self, site: Site, coefficients: Mapping[str, float]) -> float:
        """Return the mean indication in g; coefficients that are not named are nominal."""
        values = [coefficients.get(symbol, row.nominal) for symbol, row in TERMS.items()]
        return float(mean_products([self], site)[0] @ values)


def _forces(
    stations: Sequence[Station], site: Site, angles: Array, rates: Array | None = None
) -> Array:
    """Return `Station.force` of several stations without acceleration, (stations, angles, 3).

    rates: At the angles, rad/s, shape (angles,); None: those of the stations.
    """
    w, radius, stretch = (
        np.array([[part] for part in parts])
        for parts in zip(*((s.rate, s.radius, s.stretch) for s in stations), strict=True)
    )
    if rates is not None:
        w = np.broadcast_to(rates, (len(stations), angles.size))
    about_east, about_north = (
        np.array([[s.axis_tilt[axis]] for s in stations]) for axis in range(2)
    )
    radius = radius * (1.0 + stretch * radius * w * w)
    cos, sin = np.cos(angles), np.sin(angles)
    _, north, up = site.earth_rotation
    # 2 Omega x v of the velocity R w forward; the part along the arm is the same everywhere. The
    # platform stays level; a tilted axis lifts and lowers it.
    along = -radius * (w * w + 2.0 * w * up)
    rises = radius * (about_east * sin - about_north * cos)
    speed = radius * w * (about_east * cos + about_north * sin)
    lifted = site.gravity + 2.0 * radius * w * north * sin - w * w * rises
    forces = np.stack([along * cos + 2.0 * north * speed, along * sin, lifted], axis=-1)
    for k, station in enumerate(stations):
        if station.table:
            forces[k] = _rotate_about_up(forces[k], _error_of_table(station, angles))
    carried = np.array([station.motion == "arm" for station in stations])
    if not carried.any():
        return forces
    # The machine's axes lean with its spindle: gravity and the Earth's rotation as they see them.
    w, radius = w[carried], radius[carried]
    leaning = np.column_stack([about_east, about_north, np.zeros(len(stations))])[carried]
    machine = _rotate_axes(np.broadcast_to(np.eye(3), (len(w), 3, 3)), leaning)
    earth = (machine @ site.earth_rotation)[:, :, None]
    plumb = site.gravity * machine[:, :, 2, None]
    forces[carried, :, 0] = (
        plumb[:, 0] * cos + plumb[:, 1] * sin - radius * (w * w + 2.0 * w * earth[:, 2])
    )
    forces[carried, :, 1] = plumb[:, 1] * cos - plumb[:, 0] * sin
    forces[carried, :, 2] = plumb[:, 2] + 2.0 * radius * w * (earth[:, 0] * cos + earth[:, 1] * sin)
    return forces


def _error_of_table(station: Station, angles: Array) -> Array:
    """Return the turn of the counter-rotating table about up at angles of the spindle, rad."""
    total = np.zeros(angles.shape)
    for n, c, s in station.table:
        total += c * np.cos(n * angles) + s * np.sin(n * angles)
    return total


def _rotate_about_up(forces: Array, turn: Array) -> Array:
    """Return forces (n, 3) in a frame that is turned about up by (n,), rad."""
    cos, sin = np.cos(turn), np.sin(turn)
    east, north, up = forces.T
    return np.column_stack([cos * east + sin * north, cos * north - sin * east, up])


def _axes_under_load(stations: Sequence[Station]) -> Array:
    """Return `Station.axes_under_load` of several stations, shape (stations, 3, 3)."""
    turns = np.array([station.turn for station in stations])
    turns[:, 1] += [station.droop * station.rate**2 for station in stations]
    return _rotate_axes(np.array([station.mounting.axes for station in stations]), turns)


def _rotate_axes(axes: Array, turns: Array) -> Array:
    """Return axes, rows, after right-handed turns (Rodrigues), shapes (n, 3, 3) and (n, 3)."""
    if not turns.any():
        return axes
    size = np.linalg.norm(turns, axis=1)[:, None, None]
    about = turns[:, None] / np.where(size > 0.0, size, 1.0)
    x, y, z = np.moveaxis(axes, -1, 0)
    u, v, w = np.moveaxis(about, -1, 0)
    across = np.stack([v * z - w * y, w * x - u * z, u * y - v * x], axis=-1)
    along = np.sum(axes * about, axis=-1)[..., None] * about
    turned: Array = np.cos(size) * axes + np.sin(size) * across + (1.0 - np.cos(size)) * along
    return turned


def mean_products(stations: Sequence[Station], site: Site) -> Array:
    """Return the signed products of specific forces, each the mean over a revolution.

    Returns: in g to the power of each product's degree, shape (n, m), in the order of `TERMS`.
    """
    angles = np.linspace(0.0, 2.0 * np.pi, _ANGLES, endpoint=False, dtype=np.float64)
    forces, axes = _forces(stations, site, angles), _axes_under_load(stations)
    a_ipo = np.einsum("nij,nmj->inm", axes, forces)
    a_ipo /= site.gravity
    rotations = np.moveaxis(_rotations(stations, axes), 0, 1)
    means: Array = _products(a_ipo, rotations).mean(axis=2).T
    lowest, highest = a_ipo[0].min(axis=1), a_ipo[0].max(axis=1)
    bent = (lowest < SIGN_WIDTH) & (highest > -SIGN_WIDTH) & (highest - lowest > _ROUNDING)
    for k in np.flatnonzero(bent).tolist():
        means[k, _KINKED] = _means_with_kinks(stations[k], site)
    return means


#: Places in `TERMS` of the products with a kink or a jump where a_I changes sign.
_KINKED: Final = [place for place, row in enumerate(TERMS.values()) if row.effect.has_kink]

#: Forces (g) and angles (rad) that differ by less are the same.
_ROUNDING: Final = 1e-12

#: Panels of a revolution in which sign changes are sought.
_PANELS: Final = 8


def _means_with_kinks(station: Station, site: Site) -> Array:
    """Return the means of the products that have a kink, by panels that end at sign changes."""
    axis, end = station.axes_under_load()[0] / site.gravity, 2.0 * np.pi
    edges = np.linspace(0.0, end, _PANELS + 1)

    def above(least: float, angle: Array) -> Array:
        over: Array = station.force(site, angle) @ axis - least
        return over

    changes = [
        quadrature.sign_changes(partial(above, least), edges)
        for least in (-SIGN_WIDTH, 0.0, SIGN_WIDTH)
    ]
    edges = np.unique(np.concatenate([edges, *changes]))
    edges = edges[np.append(np.diff(edges) > _ROUNDING, True)]
    whole = edges[-1:]
    integrals = quadrature.integrate(
        lambda angle: station.products(site, station.force(site, angle))[_KINKED], edges, whole, 1
    )
    return np.asarray(integrals[0] / end)


def _rotations(stations: Sequence[Station], axes: Array) -> Array:
    """Return w_I, w_P (rad/s) and dw_O/dt (rad/s^2) of the instruments, shape (stations, 3, 1).

    Only an arm takes the instrument round; the Earth's rate is left out. The mean of the angular
    acceleration over whole revolutions is zero.

    axes: I, P, O of each, rows, shape (stations, 3, 3).
    """
    rates = np.array([station.rate if station.motion == "arm" else 0.0 for station in stations])
    rotations = np.zeros((len(stations), 3, 1))
    rotations[:, :2, 0] = axes[:, :2, 2] * rates[:, None]
    return rotations


def _products(a_ipo: Array, rotation: Array) -> Array:
    """Return the signed products in the order of `TERMS`, shape (terms, *a_ipo.shape[1:])."""
    rows = (row.effect for row in TERMS.values())
    return np.stack([effect.evaluate(a_ipo, rotation, SIGN_WIDTH) for effect in rows])


def perturb_station(
    station: Station, symbol: str, size: float, head: Array, head_angle: float = 0.0
) -> Station:
    """Return a station with one of the machine's terms larger by a size.

    size: By how much, in the term's unit.
    head: The axis about which the dividing head turns, in the station's frame, shape (3,).
    head_angle: What the head shows, rad.
    """
    perturbed: dict[str, Any] = {}
    match term(symbol).effect:
        case SetupError("radius"):
            perturbed["radius"] = station.radius + size
        case SetupError("rate") | Input("clock"):
            # A fast clock counts too few revolutions: the rate is larger than the one stated.
            perturbed["rate"] = station.rate * (1.0 + size)
        case TrajectoryError("stretch"):
            perturbed["stretch"] = station.stretch + size
        case TrajectoryError("axis_tilt", about=axis):
            east, north = station.axis_tilt
            perturbed["axis_tilt"] = (
                (east + size, north) if axis == "east" else (east, north + size)
            )
        case SetupError("droop"):
            perturbed["droop"] = station.droop + size
        case AttitudeError("table", harmonic=n, quadrature=quadrature):
            components = (n, size, 0.0) if quadrature == "cos" else (n, 0.0, size)
            perturbed["table"] = (*station.table, components)
        case SetupError("misalignment", axis):
            perturbed["turn"] = _compose_rotations(
                station, size * _named_axis(axis, station.motion)
            )
        case SetupError("zero" | "wave", harmonic=n, quadrature=quadrature):
            # The zero is a wave of no turns.
            wave = np.sin if quadrature == "sin" else np.cos
            perturbed["turn"] = _compose_rotations(station, size * wave(n * head_angle) * head)
        case _:
            raise ValueError(f"{symbol} moves no station")
    return replace(station, **perturbed)


def _named_axis(name: str, motion: str) -> Array:
    """Return the unit vector of a named axis in a motion's frame; zero where it has none."""
    names = ("outward", "forward", "up") if motion == "arm" else ("east", "north", "up")
    return np.array([float(name == axis_name) for axis_name in names])


def _compose_rotations(station: Station, turn: Array) -> tuple[float, float, float]:
    """Return the turn of a station's instrument after a further one, rad."""
    first, second, up = np.array(station.turn) + turn
    return float(first), float(second), float(up)
