"""Stations of readings: at rest, on an arm, on a double turntable, or on a shaker.

A reading is the mean output of an accelerometer over whole revolutions or vibrations, or at rest.
For a given station, it is linear in the coefficients: each is multiplied by the mean of its product
of specific forces. Errors of the machine (stretch of the arm, droop, a rotated fixture) change the
station, and their effects on a reading are derivatives.

Vectors are in the frame of the station: east-north-up at rest and on a double turntable; on an arm
outward along the arm, forward (the direction of motion at a positive rate) and up. Both frames are
right-handed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.physics import quadrature
from counterspin.physics.accelerometer import DIRECTIONS
from counterspin.physics.effects import (
    SIGN_WIDTH,
    AttitudeError,
    Input,
    SetupError,
    TrajectoryError,
)
from counterspin.physics.motion import Site
from counterspin.physics.table import rotate_about_up
from counterspin.physics.terms import TERMS, MotionKind, term

_ARM_DIRECTIONS: Final[Mapping[str, tuple[float, float, float]]] = {
    "outward": (1.0, 0.0, 0.0),
    "inward": (-1.0, 0.0, 0.0),
    "forward": (0.0, 1.0, 0.0),
    "backward": (0.0, -1.0, 0.0),
    "up": (0.0, 0.0, 1.0),
    "down": (0.0, 0.0, -1.0),
}

#: Motion -> named directions of its frame, unit vectors.
FRAMES: Final[Mapping[str, Mapping[str, tuple[float, float, float]]]] = {
    "counter-rotating": DIRECTIONS,
    "arm": _ARM_DIRECTIONS,
    # An arm at rest points east; only gravity acts.
    "static": {**DIRECTIONS, **_ARM_DIRECTIONS},
    "vibration": DIRECTIONS,
}

#: Motion, or ``poses`` -> the name of its readings.
READING_LABELS: Final = {
    "static": "readings at rest",
    "vibration": "readings during vibration",
    "arm": "readings on the arm",
    "counter-rotating": "readings on the double turntable",
    "poses": "poses at unknown attitudes",
}

#: Number of angles for the mean over a revolution, exact for products of a lower degree.
_N_ANGLES: Final = 16


@frozen
class Stations:
    """Positions, attitudes and motions of the instrument during n readings of one motion."""

    motion: MotionKind  #: ``counter-rotating``, ``arm``, ``static`` or ``vibration``.
    axes: Array  #: I, P, O in the stations' frame, rows, shape (n, 3, 3).
    rate: Array  #: rad/s; its sign is the sense, right-handed about up. 0 at rest. Shape (n,).
    radius: Array  #: Distance of the proof mass from the spindle axis at rest, m, shape (n,).
    #: Relative growth of the radius per m/s^2 of centripetal acceleration, s^2/m, shape (n,).
    stretch: Array
    #: Rotation of the instrument about forward per squared rate, rad s^2, positive if the outer end
    #: of the arm moves down; only for arms, shape (n,).
    droop: Array
    axis_tilt: Array  #: Small right-handed turns of the spindle about east and north, rad, (n, 2).
    turn: Array  #: Small right-handed turn of the instrument about the frame's axes, rad, (n, 3).
    #: Vibration along the input axis: peak value and mean without gravity, m/s^2, shape (n,).
    amplitude: Array
    bias_acceleration: Array
    #: n -> (c, s), shape (n, 2): angle error of the counter-rotating table about up,
    #: c cos n theta + s sin n theta, rad.
    table: Mapping[int, Array]

    @classmethod
    def at(cls, motion: MotionKind, axes: Array, **settings: npt.ArrayLike) -> Stations:
        """Return stations of one motion; fields that are not in `settings` are zero.

        axes: Shape (n, 3, 3).
        """
        widths = {"axis_tilt": (2,), "turn": (3,)}
        names = ("rate", "radius", "stretch", "droop", *widths, "amplitude", "bias_acceleration")
        shapes = {name: (len(axes), *widths.get(name, ())) for name in names}
        arrays: dict[str, Any] = {
            name: np.zeros(shape) + np.asarray(settings.get(name, 0.0), np.float64)
            for name, shape in shapes.items()
        }
        return cls(motion, axes, table={}, **arrays)

    def take(self, rows: npt.NDArray[np.intp]) -> Stations:
        """Return the stations of some rows."""
        names = ("axes", "rate", "radius", "stretch", "droop", "axis_tilt", "turn", "amplitude")
        return replace(
            self,
            table={n: components[rows] for n, components in self.table.items()},
            bias_acceleration=self.bias_acceleration[rows],
            **{name: getattr(self, name)[rows] for name in names},
        )

    def forces(
        self,
        site: Site,
        angles: Array,
        rates: Array | None = None,
        acceleration: Array | float = 0.0,
    ) -> Array:
        """Return the specific force in the frame of the stations, m/s^2, shape (n, angles, 3).

        The square of the Earth's rate times the radius (1.3e-8 m/s^2 at 2.5 m) and the change of
        the plumb line across the radius are neglected.

        site: Gravity, latitude and the Earth's rotation.
        angles: Spindle angles, from east towards north, rad.
        rates: Angular rates at the angles, rad/s, shape (angles,); None: those of the stations.
        acceleration: Angular acceleration at the angles on an arm, rad/s^2, shape (angles,).
        """
        w = self.rate[:, None] if rates is None else rates[None]
        about_east, about_north = self.axis_tilt.T[:, :, None]
        radius = self.radius[:, None]
        radius = radius * (1.0 + self.stretch[:, None] * radius * w * w)
        cos, sin = np.cos(angles), np.sin(angles)
        if self.motion == "vibration":
            # The shaker moves along the nominal input axis; its phase is the angle.
            vibration = self.bias_acceleration[:, None] + self.amplitude[:, None] * np.sin(angles)
            forces: Array = vibration[:, :, None] * self.axes[:, None, 0]
            forces[:, :, 2] += site.gravity
            return forces
        if self.motion == "arm":
            # Gravity and the Earth's rotation along axes that are tilted with the spindle.
            n = len(self.rate)
            tilt = np.column_stack([self.axis_tilt, np.zeros(n)])
            machine_axes = _rotate_axes(np.broadcast_to(np.eye(3), (n, 3, 3)), tilt)
            earth_rotation = (machine_axes @ site.earth_rotation)[:, :, None]
            gravity = site.gravity * machine_axes[:, :, 2, None]
            outward = gravity[:, 0] * cos + gravity[:, 1] * sin
            outward = outward - radius * (w * w + 2.0 * w * earth_rotation[:, 2])
            forward = gravity[:, 1] * cos - gravity[:, 0] * sin
            forward = forward + self.radius[:, None] * acceleration
            up = gravity[:, 2] + 2.0 * radius * w * (
                earth_rotation[:, 0] * cos + earth_rotation[:, 1] * sin
            )
            return np.stack([outward, forward, up], axis=-1)
        _, north, up = site.earth_rotation
        # Coriolis acceleration 2 Omega x v for the forward velocity R w. The platform stays level;
        # a tilted axis lifts and lowers it.
        radial = -radius * (w * w + 2.0 * w * up)
        height = radius * (about_east * sin - about_north * cos)
        climb_rate = radius * w * (about_east * cos + about_north * sin)
        vertical = site.gravity + 2.0 * radius * w * north * sin - w * w * height
        east = radial * cos + 2.0 * north * climb_rate
        forces = np.stack([east, radial * sin, vertical], axis=-1)
        return rotate_about_up(forces, self.table_errors(angles)) if self.table else forces

    def products(self, site: Site, forces: Array) -> Array:
        """Return the signed products of specific forces, shape (number of `TERMS`, n, angles).

        forces: In the stations' frame, m/s^2, shape (n, angles, 3).
        """
        axes = self.axes_under_load()
        a_ipo = np.einsum("nij,nmj->inm", axes, forces) / site.gravity
        return _term_products(a_ipo, np.moveaxis(self.rotations(axes), 0, 1))

    def table_errors(self, angles: Array) -> Array:
        """Return the angle error of the counter-rotating table, rad, shape (n, angles)."""
        errors = np.zeros((len(self.rate), angles.size))
        for n, components in self.table.items():
            errors += components @ np.stack([np.cos(n * angles), np.sin(n * angles)])
        return errors

    def axes_under_load(self) -> Array:
        """Return the axes I, P, O rotated by droop and turn, as rows, shape (n, 3, 3)."""
        turn = self.turn.copy()
        turn[:, 1] += self.droop * self.rate**2
        return _rotate_axes(self.axes, turn)

    def rotations(self, axes: Array) -> Array:
        """Return w_I, w_P (rad/s) and dw_O/dt (rad/s^2) of the instruments, shape (n, 3, 1).

        Only an arm rotates the instrument; the Earth's rate is neglected. The mean of the angular
        acceleration over whole revolutions is zero.

        axes: Axes I, P, O of each instrument, as rows, shape (n, 3, 3).
        """
        rotations = np.zeros((len(self.rate), 3, 1))
        if self.motion == "arm":
            rotations[:, :2, 0] = axes[:, :2, 2] * self.rate[:, None]
        return rotations

    def perturb(self, symbol: str, change: Array, head: Array, head_angle: Array) -> Stations:
        """Return the stations with one machine term changed.

        change: Change of the term in its unit, shape (n,).
        head: Axis of the dividing head in the frame of the station, shape (n, 3).
        head_angle: Indicated angle of the head, rad, shape (n,).
        """
        changes: dict[str, Any]
        match term(symbol).effect:
            case SetupError("radius"):
                changes = {"radius": self.radius + change}
            case SetupError("rate") | Input("clock"):
                # A fast clock counts too few revolutions: the rate is larger than the one stated.
                changes = {"rate": self.rate * (1.0 + change)}
            case TrajectoryError("stretch"):
                changes = {"stretch": self.stretch + change}
            case TrajectoryError("axis_tilt", axis=axis):
                tilt_change = np.outer(change, (axis == "east", axis == "north"))
                changes = {"axis_tilt": self.axis_tilt + tilt_change}
            case SetupError("amplitude"):
                changes = {"amplitude": self.amplitude * (1.0 + change)}
            case SetupError("droop"):
                changes = {"droop": self.droop + change}
            case AttitudeError("table", harmonic=n, quadrature=quadrature):
                components = np.outer(change, (quadrature == "cos", quadrature == "sin"))
                changes = {"table": {**self.table, n: self.table.get(n, 0.0) + components}}
            case SetupError("misalignment", axis):
                rotation = np.outer(change, _unit_vector(axis, self.motion))
                changes = {"turn": self.turn + rotation}
            case SetupError("zero" | "wave", harmonic=n, quadrature=quadrature):
                # The zero error is the harmonic 0.
                wave = np.sin if quadrature == "sin" else np.cos
                rotation = (change * wave(n * head_angle))[:, None] * head
                changes = {"turn": self.turn + rotation}
            case _:
                raise ValueError(f"{symbol} does not affect any station")
        return replace(self, **changes)


def _rotate_axes(axes: Array, rotation_vectors: Array) -> Array:
    """Return axes (rows) after right-handed rotations (Rodrigues), (n, 3, 3) and (n, 3)."""
    if not rotation_vectors.any():
        return axes
    angle = np.linalg.norm(rotation_vectors, axis=1)[:, None, None]
    unit_vectors = rotation_vectors[:, None] / np.where(angle > 0.0, angle, 1.0)
    x, y, z = np.moveaxis(axes, -1, 0)
    u, v, w = np.moveaxis(unit_vectors, -1, 0)
    cross_product = np.stack([v * z - w * y, w * x - u * z, u * y - v * x], axis=-1)
    parallel = np.sum(axes * unit_vectors, axis=-1)[..., None] * unit_vectors
    cos, sin = np.cos(angle), np.sin(angle)
    rotated_axes: Array = cos * axes + sin * cross_product + (1.0 - cos) * parallel
    return rotated_axes


def mean_products(stations: Stations, site: Site) -> Array:
    """Return the means of the signed products of specific forces over a revolution.

    Returns: shape (n, m) in the order of `TERMS`, in g to the power of the degree of the product.
    """
    # At rest the force is the same at all angles.
    is_static = stations.motion == "static" and not stations.rate.any()
    angles = np.linspace(0.0, 2.0 * np.pi, 1 if is_static else _N_ANGLES, endpoint=False)
    forces, axes = stations.forces(site, angles), stations.axes_under_load()
    a_ipo = np.einsum("nij,nmj->inm", axes, forces)
    a_ipo /= site.gravity
    rotations = np.moveaxis(stations.rotations(axes), 0, 1)
    means: Array = _term_products(a_ipo, rotations).mean(axis=2).T
    if is_static:
        return means
    min_force, max_force = a_ipo[0].min(axis=1), a_ipo[0].max(axis=1)
    has_kink = (
        (min_force < SIGN_WIDTH) & (max_force > -SIGN_WIDTH) & (max_force - min_force > _ROUNDING)
    )
    harmonics = np.fft.rfft(a_ipo[0]) / _N_ANGLES
    is_sine = np.abs(harmonics[:, 2:]).max(axis=1) <= _ROUNDING
    rows = has_kink & is_sine
    means[np.ix_(rows, _KINKED_INDICES)] = _kinked_sine_means(
        harmonics[rows, 0].real, 2.0 * np.abs(harmonics[rows, 1])
    )
    for k in np.flatnonzero(has_kink & ~is_sine).tolist():
        means[k, _KINKED_INDICES] = _means_with_kinks(stations.take(np.array([k])), site)
    return means


#: Indices in `TERMS` of the products with a kink or a jump where a_I changes sign.
_KINKED_INDICES: Final = [index for index, row in enumerate(TERMS.values()) if row.effect.has_kink]

#: Smaller differences of forces (g) and angles (rad) are rounding.
_ROUNDING: Final = 1e-12

#: Panels per revolution in the search for sign changes.
_N_PANELS: Final = 8


def _kinked_sine_means(mean: Array, amplitude: Array) -> Array:
    """Return the means of the products with a kink for a_I = m + A sin(phase).

    mean, amplitude: g, shape (n,).
    Returns: shape (n, products).
    """

    def moments_above(threshold: float) -> tuple[Array, Array, Array]:
        """Return the means of 1, a_I and a_I^2, each set to 0 if a_I is below a threshold."""
        start = np.arcsin(np.clip((threshold - mean) / amplitude, -1.0, 1.0))
        fraction, sine = 0.5 - start / np.pi, np.cos(start) / np.pi
        square = 0.5 * fraction + np.sin(2.0 * start) / (4.0 * np.pi)
        first_moment = mean * fraction + amplitude * sine
        second_moment = mean**2 * fraction + 2.0 * mean * amplitude * sine + amplitude**2 * square
        return fraction, first_moment, second_moment

    (low_fraction, first_low, _), (high_fraction, first_high, _) = map(
        moments_above, (-SIGN_WIDTH, SIGN_WIDTH)
    )
    _, first_moment, second_moment = moments_above(0.0)
    means = {
        ("sign_I",): high_fraction + low_fraction - 1.0 + (first_low - first_high) / SIGN_WIDTH,
        ("|I|",): 2.0 * first_moment - mean,
        ("I", "|I|"): 2.0 * second_moment - mean**2 - 0.5 * amplitude**2,
    }
    effects = [row.effect for row in TERMS.values() if row.effect.has_kink]
    return np.stack([effect.weight * means[effect.factors] for effect in effects], axis=-1)


def _means_with_kinks(stations: Stations, site: Site) -> Array:
    """Return the means of the products with a kink for one station, by panels."""
    axes, end = stations.axes_under_load(), 2.0 * np.pi
    input_axis, rotation = axes[0, 0] / site.gravity, stations.rotations(axes)[0]
    edges = np.linspace(0.0, end, _N_PANELS + 1)

    def excess_force(threshold: float, angle: Array) -> Array:
        excess: Array = stations.forces(site, angle)[0] @ input_axis - threshold
        return excess

    changes = [
        quadrature.sign_changes(partial(excess_force, threshold), edges)
        for threshold in (-SIGN_WIDTH, 0.0, SIGN_WIDTH)
    ]
    edges = np.unique(np.concatenate([edges, *changes]))
    edges = edges[np.append(np.diff(edges) > _ROUNDING, True)]
    effects = [row.effect for row in TERMS.values() if row.effect.has_kink]

    def kinked_products(angle: Array) -> Array:
        a_ipo = axes[0] @ stations.forces(site, angle)[0].T / site.gravity
        return np.stack([effect.evaluate(a_ipo, rotation, SIGN_WIDTH) for effect in effects])

    return np.asarray(quadrature.integrate(kinked_products, edges, edges[-1:], 1)[0] / end)


def _term_products(a_ipo: Array, rotation: Array) -> Array:
    """Return the signed products in the order of `TERMS`, shape (terms, *a_ipo.shape[1:])."""
    rows = (row.effect for row in TERMS.values())
    return np.stack([effect.evaluate(a_ipo, rotation, SIGN_WIDTH) for effect in rows])


def _unit_vector(name: str, motion: str) -> Array:
    """Return the unit vector of a named axis in the frame of a motion; zero if it has none."""
    axis_names = ("outward", "forward", "up") if motion == "arm" else ("east", "north", "up")
    return np.array([float(name == axis_name) for axis_name in axis_names])
