"""The accelerometer: its axes, its error model and **the** table of terms (Eq. 7-9).

Every coefficient that counterspin knows is one row of `TERMS` (the accelerometer's own) or of
`counterspin.physics.shared_terms` (of what carries it). Simulation, design matrices, budgets,
reports and documentation all read these tables; there is no other list of coefficients.

Accelerometer coefficients are in g-units (g, g/g, g/g^2, ...), g being the site's own gravity.
Eq. 7 does not divide by the scale factor K_I; IEEE Std 1293 factors it out, so that the paper's
K_II is K1 x K2 there, and likewise for the other terms.

- `Term`, `TERMS`: the table
- `Mounting`, `direction`, `QX`, `QY`, `QZ`: where the axes point
- `indicated`: the error model itself, Eq. 7
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen


@frozen
class Term:
    """One error term of the accelerometer: coefficient x product of a_I, a_P, a_O.

    Attributes
    ----------
    symbol
        The paper's symbol, the name used everywhere.
    factors
        The product, factor by factor: ``("I", "I")`` is a_I^2, ``("I", "|I|")`` is a_I|a_I|.
    words
        What it is called.
    ieee
        The name in IEEE Std 1293, before that standard's division by K1.
    limit
        The largest credible size (g-units). A standard uncertainty that is not below it says
        that the data do not determine the coefficient.
    typical
        Standard uncertainty to assume where nothing is known of it (g-units): the order of
        magnitude that is left in navigation-grade instruments after compensation.
    nominal
        The value of a perfect accelerometer.
    sign
        The sign with which the product enters Eq. 7.
    """

    symbol: str
    factors: tuple[str, ...]
    words: str
    ieee: str
    limit: float
    typical: float
    nominal: float = 0.0
    sign: float = 1.0

    per_run = False

    @property
    def product(self) -> str:
        """The product in plain text, such as ``a_I^2``; ``1`` for the bias."""
        if self.factors == ("I", "|I|"):
            return "a_I*|a_I|"
        powers = Counter(self.factors)
        return "*".join(f"a_{f}" + (f"^{n}" if n > 1 else "") for f, n in powers.items()) or "1"

    @property
    def power(self) -> int:
        """How many times a_I or |a_I| stands in the product."""
        return sum(factor in ("I", "|I|") for factor in self.factors)

    @property
    def unit(self) -> str:
        """The unit in g-units; misalignments are angles."""
        if self.symbol.startswith("delta"):
            return "rad"
        degree = len(self.factors)
        return "g" if degree == 0 else "g/g" if degree == 1 else f"g/g^{degree}"

    def evaluate(self, a_ipo: Array) -> Array:
        """Return the signed product for specific force along the axes.

        Parameters
        ----------
        a_ipo
            Specific force along I, P, O in g, shape (3, ...).

        Returns
        -------
        Array
            Shape ``a_ipo.shape[1:]``, in g to the power of the product's degree.
        """
        value = np.full(a_ipo.shape[1:], self.sign, dtype=np.float64)
        for factor in self.factors:
            value *= _component(a_ipo, factor)
        return value

    def slope(self, a_ipo: Array, axis: str) -> Array:
        """Return the signed product's derivative along one axis.

        Parameters
        ----------
        a_ipo
            Specific force along I, P, O in g, shape (3, ...).
        axis
            ``I``, ``P`` or ``O``.

        Returns
        -------
        Array
            Shape ``a_ipo.shape[1:]``, in g to the power of the product's degree less one.
        """
        total = np.zeros(a_ipo.shape[1:])
        for place, factor in enumerate(self.factors):
            if factor.strip("|") != axis:
                continue
            value = np.full(a_ipo.shape[1:], self.sign, dtype=np.float64)
            if factor == "|I|":
                value *= np.sign(a_ipo[0])
            for other in self.factors[:place] + self.factors[place + 1 :]:
                value *= _component(a_ipo, other)
            total += value
        return total


def _component(a_ipo: Array, factor: str) -> Array:
    along: Array = np.abs(a_ipo[0]) if factor == "|I|" else a_ipo["IPO".index(factor)]
    return along


TERMS: Final[Mapping[str, Term]] = {
    row.symbol: row
    for row in (
        Term("K_F", (), "bias", "K0", 0.1, 1e-4),
        Term("K_I", ("I",), "scale factor", "K1", 0.1, 1e-4, nominal=1.0),
        Term("K_II", ("I", "I"), "second-order coefficient", "K2", 1e-4, 1e-5),
        Term("K_III", ("I", "I", "I"), "third-order coefficient", "K3", 1e-4, 1e-6),
        Term("K_4", ("I", "I", "I", "I"), "fourth-order coefficient", "K4", 1e-5, 1e-9),
        Term("K_IP", ("I", "P"), "cross-coupling of input and pendulous axes", "Kip", 1e-4, 2e-6),
        Term("K_IO", ("I", "O"), "cross-coupling of input and output axes", "Kio", 1e-4, 2e-6),
        Term("K_PO", ("P", "O"), "cross-coupling of pendulous and output axes", "Kpo", 1e-4, 2e-6),
        Term("K_PP", ("P", "P"), "second-order pendulous-axis coefficient", "Kpp", 1e-4, 2e-6),
        Term("K_OO", ("O", "O"), "second-order output-axis coefficient", "Koo", 1e-4, 2e-6),
        Term("K_OQ", ("I", "|I|"), "odd second-order coefficient", "Koq", 1e-4, 1e-6),
        Term("delta_O", ("P",), "misalignment about the output axis", "delta_o", 1e-2, 5e-5),
        Term(
            "delta_P",
            ("O",),
            "misalignment about the pendulous axis",
            "delta_p",
            1e-2,
            5e-5,
            sign=-1.0,
        ),
    )
}

DIRECTIONS: Final[Mapping[str, tuple[float, float, float]]] = {
    "east": (1.0, 0.0, 0.0),
    "west": (-1.0, 0.0, 0.0),
    "north": (0.0, 1.0, 0.0),
    "south": (0.0, -1.0, 0.0),
    "up": (0.0, 0.0, 1.0),
    "down": (0.0, 0.0, -1.0),
}


def direction(value: str | Sequence[float]) -> Array:
    """Return the unit vector (east, north, up) of a named direction or of three components.

    Raises
    ------
    ValueError
        If the name is unknown, or the components are not three finite numbers, not all zero.
    """
    if isinstance(value, str):
        if value not in DIRECTIONS:
            raise ValueError(f"no direction is called {value!r}; known: {', '.join(DIRECTIONS)}")
        return np.array(DIRECTIONS[value])
    vec = np.asarray(value, dtype=float)
    # The square of a finite number may be beyond all numbers.
    length = math.hypot(*vec.flat)
    if vec.shape != (3,) or not math.isfinite(length) or length == 0.0:
        raise ValueError(f"a direction needs three finite components, not all zero; got {value}")
    return vec / length


#: What files call the terms that everybody knows by a name.
COMMON_NAMES: Final = {"bias": "K_F", "scale_factor": "K_I"}


@frozen
class Mounting:
    """Where an accelerometer's axes point.

    Attributes
    ----------
    axes
        Unit vectors of the input, pendulous and output axes in east-north-up, as three rows;
        a right-handed set with I x P = O.
    """

    axes: tuple[tuple[float, float, float], ...]

    @classmethod
    def from_axes(
        cls,
        input_axis: str | Sequence[float],
        pendulous_axis: str | Sequence[float],
        output_axis: str | Sequence[float] | None = None,
    ) -> Mounting:
        """Make a mounting from directions; the output axis follows as I x P unless given.

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
            given = direction(output_axis)
            if float(given @ o) < -1.0 + 1e-6:
                raise ValueError(
                    "the axes are left-handed: input x pendulous must be the output axis; "
                    "reverse one of them"
                )
            if float(given @ o) < 1.0 - 1e-6:
                raise ValueError("the output axis must be at right angles to the other two")
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
        """Return the mounting when the platform stands in another attitude.

        Parameters
        ----------
        attitude
            Rows: where the platform's x, y, z axes (east, north, up when level) point in
            east-north-up, shape (3, 3).
        """
        rows = self.matrix @ attitude
        return Mounting(tuple((float(v[0]), float(v[1]), float(v[2])) for v in rows))


QX: Final = Mounting.from_axes("east", "down")  #: Eq. 8: a_I, a_P, a_O = a_x, -a_z, a_y
QY: Final = Mounting.from_axes("north", "down")  #: output axis west
QZ: Final = Mounting.from_axes("up", "east")  #: output axis north


def indicated(mounting: Mounting, coefficients: Mapping[str, float], force: Array) -> Array:
    """Return the indicated specific force, Eq. 7 extended to the terms of IEEE Std 1293.

    Parameters
    ----------
    mounting
        Where the axes point.
    coefficients
        Coefficients by symbol, in g-units; those not named have their nominal value.
    force
        Specific force in east-north-up in g, shape (n, 3).

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
    Ten g along the input axis, and K_II of 20 ug/g^2: 2000 ug too much.

    >>> import numpy as np
    >>> import counterspin as cs
    >>> cs.indicated(cs.QX, {"K_II": 20e-6}, np.array([[10.0, 0.0, 0.0]])).round(9).tolist()
    [10.002]
    """
    unknown = set(coefficients) - set(TERMS)
    if unknown:
        raise ValueError(f"not accelerometer terms: {', '.join(sorted(unknown))}")
    a_ipo = mounting.matrix @ force.T
    total = np.zeros(force.shape[0])
    for row in TERMS.values():
        value = coefficients.get(row.symbol, row.nominal)
        if value != 0.0:
            total += value * row.evaluate(a_ipo)
    return total
