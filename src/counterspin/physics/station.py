"""Where one reading is taken: at rest, on the arm of a centrifuge, or on a double turntable.

A reading is the mean of an accelerometer's output over whole revolutions, or at rest. Given the
station, it is linear in the coefficients: each counts with the mean of its product of specific
forces. What the machine does beside turning (a radius that stretches, an arm that droops, a
fixture that is turned) moves the station, so that its effect on a reading is a derivative.

Vectors are in the station's frame: east-north-up at rest and on a double turntable; outward along
the arm, forward (the way that the arm moves at a positive rate) and up on an arm. Both frames are
right-handed.

- `Station`: motion, axes and machine
- `mean_products`: what each coefficient counts with at each of several stations
- `FRAMES`: the names of directions in each motion's frame
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from counterspin.arrays import Array
from counterspin.physics.accelerometer import DIRECTIONS, TERMS, Mounting
from counterspin.physics.motion import Site

MotionKind = Literal["counter-rotating", "arm", "static"]

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
    "static": DIRECTIONS,
}

#: Angles of a revolution at which the mean is taken: exact for products of degree below this.
_ANGLES: Final = 16

_FORWARD: Final = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True)
class Station:
    """Where and how one reading is taken.

    Attributes
    ----------
    motion
        ``counter-rotating``, ``arm`` or ``static``.
    mounting
        The accelerometer's axes in the station's frame.
    rate
        rad/s; its sign is the sense, right-handed about up. 0 at rest.
    radius
        From the spindle's axis to the proof mass when the arm is unloaded, m.
    stretch
        Relative growth of the radius per m/s^2 of centripetal acceleration, s^2/m.
    droop
        Turn of the instrument about forward per squared rate, rad s^2: a positive one lowers the
        outer end of the arm. Of the arm only.
    turn
        Small right-handed turn of the instrument about the axes of the frame, rad, shape (3,).
    """

    motion: MotionKind
    mounting: Mounting
    rate: float = 0.0
    radius: float = 0.0
    stretch: float = 0.0
    droop: float = 0.0
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def force(self, site: Site, angle: Array) -> Array:
        """Return the specific force in the station's frame at constant rate.

        Parameters
        ----------
        site
            Gravity, latitude and the Earth's rotation.
        angle
            Of the spindle, from east towards north, rad, shape (n,).

        Returns
        -------
        Array
            m/s^2, shape (n, 3). Neglected: the square of the Earth's rate times the radius
            (1.3e-8 m/s^2 at 2.5 m) and the turn of the plumb line across the radius.
        """
        w = self.rate
        radius = self.radius * (1.0 + self.stretch * self.radius * w * w)
        _, north, up = site.earth_rotation
        cos, sin = np.cos(angle), np.sin(angle)
        inward = radius * w * w
        # 2 Omega x v of the velocity R w forward; the part along the arm is the same everywhere.
        coriolis = 2.0 * radius * w * up
        lifted = site.gravity + 2.0 * radius * w * north * sin
        if self.motion == "arm":
            return np.stack([np.full_like(cos, -inward - coriolis), 0.0 * cos, lifted], axis=-1)
        along = -inward - coriolis
        return np.stack([along * cos, along * sin, lifted], axis=-1)

    def indicated(self, site: Site, coefficients: Mapping[str, float]) -> float:
        """Return the mean indication in g; coefficients that are not named are nominal."""
        values = [coefficients.get(symbol, row.nominal) for symbol, row in TERMS.items()]
        return float(mean_products([self], site, list(TERMS))[0] @ values)

    def axes_under_load(self) -> Array:
        """Return the axes I, P, O with droop and turn, rows, shape (3, 3)."""
        turn = np.array(self.turn) + self.droop * self.rate**2 * _FORWARD
        size = float(np.linalg.norm(turn))
        axes = self.mounting.matrix
        if size == 0.0:
            return axes
        about = turn / size
        # Rodrigues, row by row.
        turned: Array = (
            np.cos(size) * axes
            + np.sin(size) * np.cross(about, axes)
            + (1.0 - np.cos(size)) * (axes @ about)[:, None] * about
        )
        return turned


def mean_products(stations: Sequence[Station], site: Site, symbols: Sequence[str]) -> Array:
    """Return the signed products of specific forces, each the mean over a revolution.

    Parameters
    ----------
    stations
        n of them.
    site
        As for `Station.force`.
    symbols
        Accelerometer terms, m of them.

    Returns
    -------
    Array
        In g to the power of each product's degree, shape (n, m).

    Raises
    ------
    KeyError
        If a symbol is no term of an accelerometer.
    """
    angles = np.linspace(0.0, 2.0 * np.pi, _ANGLES, endpoint=False, dtype=np.float64)
    a_ipo = np.empty((3, len(stations), _ANGLES))
    for index, station in enumerate(stations):
        a_ipo[:, index] = station.axes_under_load() @ station.force(site, angles).T
    a_ipo /= site.gravity
    return np.stack([TERMS[symbol].evaluate(a_ipo).mean(axis=-1) for symbol in symbols], axis=-1)
