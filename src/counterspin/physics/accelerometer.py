"""The accelerometer: directions of its axes, and indicated specific force (Eq. 7-9)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.physics.frequency_response import FrequencyResponse
from counterspin.physics.terms import TERMS

DIRECTIONS: Final[Mapping[str, tuple[float, float, float]]] = {
    "east": (1.0, 0.0, 0.0),
    "west": (-1.0, 0.0, 0.0),
    "north": (0.0, 1.0, 0.0),
    "south": (0.0, -1.0, 0.0),
    "up": (0.0, 0.0, 1.0),
    "down": (0.0, 0.0, -1.0),
}


def direction(value: str | Sequence[float]) -> Array:
    """Return the unit vector (east, north, up) of a named direction or of three components."""
    if isinstance(value, str):
        if value not in DIRECTIONS:
            raise ValueError(f"unknown direction {value!r}; known: {', '.join(DIRECTIONS)}")
        return np.array(DIRECTIONS[value])
    vector = np.asarray(value, dtype=float)
    # The square of a finite number can overflow.
    length = math.hypot(*vector.flat)
    if vector.shape != (3,) or not math.isfinite(length) or length == 0.0:
        raise ValueError(
            f"a direction must have three finite components that are not all zero; got {value}"
        )
    return vector / length


@frozen
class Mounting:
    """Directions of the axes of an accelerometer, and its frequency response.

    Attributes
    ----------
    axes
        Unit vectors of the input, pendulous and output axes in east-north-up, as three rows;
        a right-handed set with I x P = O.
    response
        Frequency response of the accelerometer and its recorder; None: 1 at all frequencies.
    """

    axes: tuple[tuple[float, float, float], ...]
    response: FrequencyResponse | None = None

    @classmethod
    def from_axes(
        cls,
        input_axis: str | Sequence[float],
        pendulous_axis: str | Sequence[float],
        output_axis: str | Sequence[float] | None = None,
    ) -> Mounting:
        """Make a mounting from directions.

        Parameters
        ----------
        input_axis, pendulous_axis
            Names of directions, such as ``"east"``, or vectors in east-north-up, shape (3,).
        output_axis
            Output axis in the same form; None: I x P.

        Raises
        ------
        ValueError
            If the axes are not orthogonal (within 1e-6) or the output axis makes them
            left-handed.
        """
        i, p = direction(input_axis), direction(pendulous_axis)
        if abs(float(i @ p)) > 1e-6:
            angle = math.degrees(math.acos(max(-1.0, min(1.0, float(i @ p)))))
            raise ValueError(
                f"input and pendulous axes must be at right angles; they are {angle:.4f} deg apart"
            )
        p = p - (i @ p) * i
        p /= np.linalg.norm(p)
        o = np.cross(i, p)
        if output_axis is not None:
            output_direction = direction(output_axis)
            if float(output_direction @ o) < -1.0 + 1e-6:
                raise ValueError(
                    "the axes are left-handed: input x pendulous must be the output axis; "
                    "reverse one of them"
                )
            if float(output_direction @ o) < 1.0 - 1e-6:
                raise ValueError("the output axis must be at right angles to the other two axes")
        return cls(tuple((float(v[0]), float(v[1]), float(v[2])) for v in (i, p, o)))

    @property
    def matrix(self) -> Array:
        """The rotation from east-north-up to I, P, O, shape (3, 3)."""
        return np.array(self.axes)

    @property
    def input_axis(self) -> Array:
        """The input axis in east-north-up, shape (3,)."""
        return np.array(self.axes[0])

    def turned(self, attitude: Array) -> Mounting:
        """Return the mounting for another attitude of the platform.

        Parameters
        ----------
        attitude
            Rows: where the platform's x, y, z axes (east, north, up when level) point in
            east-north-up, shape (3, 3).
        """
        rows = self.matrix @ attitude
        return replace(self, axes=tuple((float(v[0]), float(v[1]), float(v[2])) for v in rows))


QX: Final = Mounting.from_axes("east", "down")  #: Eq. 8: a_I, a_P, a_O = a_x, -a_z, a_y
QY: Final = Mounting.from_axes("north", "down")  #: output axis west
QZ: Final = Mounting.from_axes("up", "east")  #: output axis north


def indicated(
    mounting: Mounting,
    coefficients: Mapping[str, float],
    force: Array,
    rotation: Array | None = None,
) -> Array:
    """Return the indicated specific force, Eq. 7 extended to the terms of IEEE Std 1293.

    Parameters
    ----------
    mounting
        Where the axes point.
    coefficients
        Coefficients by symbol, in g-units; those not named have their nominal value.
    force
        Specific force in east-north-up in g, shape (n, 3).
    rotation
        w_I, w_P (rad/s) and dw_O/dt (rad/s^2) of the instrument, shape (3, n); None if the
        instrument does not rotate.

    Returns
    -------
    Array
        Indicated specific force in g, shape (n,), without noise.

    Raises
    ------
    ValueError
        If a coefficient is not in the table.

    Examples
    --------
    At 10 g along the input axis, a K_II of 20 ug/g^2 adds 2000 ug:

    >>> import numpy as np
    >>> import counterspin as cs
    >>> cs.indicated(cs.QX, {"K_II": 20e-6}, np.array([[10.0, 0.0, 0.0]])).round(9).tolist()
    [10.002]
    """
    unknown_symbols = set(coefficients) - set(TERMS)
    if unknown_symbols:
        raise ValueError(f"not accelerometer terms: {', '.join(sorted(unknown_symbols))}")
    a_ipo = mounting.matrix @ force.T
    output = np.zeros(force.shape[0])
    for row in TERMS.values():
        value = coefficients.get(row.symbol, row.nominal)
        if value != 0.0:
            output += value * row.effect.evaluate(a_ipo, rotation)
    return output
