"""Effects of error terms, for the rows of the table of terms."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import ClassVar, Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.physics.conditions import RunConditions


@frozen
class SpecificForceProduct:
    """Coefficient times a product of a_I, a_P, a_O: the error model of the accelerometer, Eq. 7.

    Factors may also be w_I, w_P (rad/s) or dw_O/dt (rad/s^2) of the instrument's rotation.
    """

    #: Factors of the product: ``("I", "I")`` is a_I^2, ``("I", "|I|")`` is a_I|a_I|; ``sign_I`` is
    #: the sign of a_I, and `ROTATIONS` are factors of the rotation.
    factors: tuple[str, ...]
    ieee_symbol: str  #: Name in IEEE Std 1293, without the division by K1.
    weight: float = 1.0  #: Factor of the product in Eq. 7.

    @property
    def text(self) -> str:
        """The product in plain text, such as ``a_I^2``; ``1`` for the bias."""
        powers = Counter(_FACTOR_TEXTS.get(factor, f"a_{factor}") for factor in self.factors)
        product = "*".join(name + (f"^{n}" if n > 1 else "") for name, n in powers.items()) or "1"
        return product if abs(self.weight) == 1.0 else f"{product}/{1.0 / abs(self.weight):g}"

    @property
    def degree(self) -> int:
        """Number of specific forces or rotations in the product."""
        return sum(factor != "sign_I" for factor in self.factors)

    @property
    def power(self) -> int:
        """Power of |a_I| in the product on either side of zero."""
        return sum(factor in ("I", "|I|") for factor in self.factors)

    @property
    def is_even(self) -> bool:
        """True if the product keeps its value when a_I changes its sign."""
        return sum(factor in ("I", "sign_I") for factor in self.factors) % 2 == 0

    @property
    def has_kink(self) -> bool:
        """True if the product or its slope jumps where a_I changes sign."""
        return "|I|" in self.factors or "sign_I" in self.factors

    @property
    def is_linear(self) -> bool:
        """True if the product is the specific force along one axis."""
        return self.factors in (("I",), ("P",), ("O",))

    @property
    def requires_rotation(self) -> bool:
        """True if the coefficient only acts while the instrument rotates in space."""
        return not set(self.factors).isdisjoint(ROTATIONS)

    def design_factors(self, conditions: Mapping[str, Array]) -> Array:
        """Return ones, because the coefficient does not depend on conditions; see `Slope`."""
        return np.ones_like(conditions["time"])

    def evaluate(
        self, a_ipo: Array, rotation: Array | None = None, sign_width: float = 0.0
    ) -> Array:
        """Return the signed product for a specific force along the axes.

        a_ipo: Specific force along I, P, O in g, shape (3, ...).
        rotation: w_I, w_P (rad/s) and dw_O/dt (rad/s^2) of the instrument, shape (3, ...); None:
            the instrument does not rotate.
        sign_width: The sign of a_I grows linearly between minus and plus this, g.
        Returns: shape ``a_ipo.shape[1:]``, in g to the power of the product's degree.
        """
        value = np.full(a_ipo.shape[1:], self.weight, dtype=np.float64)
        for factor in self.factors:
            if factor in ROTATIONS:
                value *= 0.0 if rotation is None else rotation[ROTATIONS.index(factor)]
            elif factor == "sign_I" and sign_width > 0.0:
                value *= np.clip(a_ipo[0] / sign_width, -1.0, 1.0)
            else:
                value *= _component(a_ipo, factor)
        return value

    def slope(self, a_ipo: Array, axis: str) -> Array:
        """Return the derivative of the signed product along an axis.

        a_ipo: Specific force along I, P, O in g, shape (3, ...).
        Returns: shape ``a_ipo.shape[1:]``, in g to the power of the degree minus 1.
        """
        derivative = np.zeros(a_ipo.shape[1:])
        for index, factor in enumerate(self.factors):
            if factor.strip("|") != axis:
                continue
            value = np.full(a_ipo.shape[1:], self.weight, dtype=np.float64)
            if factor == "|I|":
                value *= np.sign(a_ipo[0])
            for other_factor in self.factors[:index] + self.factors[index + 1 :]:
                value *= _component(a_ipo, other_factor)
            derivative += value
        return derivative


#: Factors of the instrument's rotation, in the order of `SpecificForceProduct.evaluate`.
ROTATIONS: Final = ("w_I", "w_P", "dw_O/dt")

#: In a reading, the sign of a_I is replaced by a linear function between minus and plus this, g,
#: because the sign in a position at right angles to gravity is unknown.
SIGN_WIDTH: Final = 1e-3

_FACTOR_TEXTS: Final = {"|I|": "|a_I|", "sign_I": "sign(a_I)"} | {name: name for name in ROTATIONS}


def _component(a_ipo: Array, factor: str) -> Array:
    if factor == "|I|":
        return np.asarray(np.abs(a_ipo[0]))
    if factor == "sign_I":
        return np.asarray(np.sign(a_ipo[0]))
    return np.asarray(a_ipo["IPO".index(factor)])


@frozen
class Slope:
    """Change of a coefficient of an accelerometer per unit of a condition."""

    coefficient: str  #: Symbol of the coefficient that changes.
    #: A key of `RunConditions.at`: ``temperature`` (K from the reference temperature), ``time`` (s
    #: from the beginning of the campaign), ``direction`` (of the temperature change) or ``force``
    #: (square of the centripetal force at the run's rate, g^2).
    condition: str
    power: int = 1  #: Power of the condition that multiplies the slope.

    def design_factor(self, conditions: RunConditions, force: float) -> float:
        """Return the factor of the slope at the start of a run, at its mean temperature.

        force: Centripetal force at the run's rate, g.
        """
        return float(self.design_factors(conditions.at_start(force)))

    def design_factors(self, conditions: Mapping[str, Array]) -> Array:
        """Return the factors of the slope; conditions: by name, all of one shape."""
        return np.asarray(conditions[self.condition] ** self.power)


_UP: Final = np.array([0.0, 0.0, 1.0])
_ROUNDING: Final = 1e-9  #: Of a unit vector: above roundoff, below any angle of a mounting.


@frozen
class AttitudeError:
    """An attitude error of the platform, and of the axes of all accelerometers.

    The small attitude error psi (rad) starts at the tilt and obeys
    d(psi)/dt = drift + D f/g + E |f|^2/g^2; compliance C adds C f/g. The sensed force is
    f - psi x f. Tilts are about the geographic axes of a run; all other errors are about the axes
    x, y, z of the platform, which point east, north, up in the level attitude.

    An instrument on the counter-rotating table rotates about up by the error of the table's angle,
    a harmonic of the spindle angle. If the table axis is not parallel to the spindle axis, the
    instrument is tilted about an axis that is fixed on the arm.
    """

    #: ``tilt``, ``drift``, ``g_sensitivity``, ``g2_sensitivity``, ``compliance``, ``table`` or
    #: ``table_axis``.
    kind: str
    #: Axis of the rotation: 0 east (x), 1 north (y), 2 up (z); for the table axis 0 outward along
    #: the arm, 1 forward.
    axis: int
    #: Axis of the force for g-sensitivity and compliance, else None.
    force_axis: int | None = None
    #: For the table: order of the harmonic, and ``cos`` or ``sin``.
    harmonic: int = 0
    quadrature: str = ""

    @property
    def part(self) -> str:
        """Part of the machine with the error: ``table``, ``gyros`` or ``platform``."""
        if self.kind in ("table", "table_axis"):
            return "table"
        return "platform" if self.kind in ("tilt", "compliance") else "gyros"

    def acts_on(self, input_axis: Array, attitude: Array) -> bool:
        """Return True if the error affects an accelerometer to first order in some run.

        input_axis: In the run's attitude, east-north-up, shape (3,).
        attitude: Rows: where the platform's axes point in the run, shape (3, 3).
        """
        if self.kind == "compliance":
            return float(np.linalg.norm(np.cross(attitude[self.axis], input_axis))) > _ROUNDING
        if self.part == "gyros" and self.force_axis is not None:
            is_steady = abs(float(attitude[self.force_axis] @ _UP)) > _ROUNDING
            axis_change = np.cross(self._turn_axis(attitude), input_axis)
            if is_steady and abs(float(axis_change @ _UP)) > _ROUNDING:
                return True  # as a drift
        return self.affects_mean(input_axis, attitude)

    def affects_output(self, input_axis: Array, attitude: Array) -> bool:
        """Return True if the error affects the output of an accelerometer, including harmonics.

        In displacement, harmonics are negligible compared with the accelerations of `acts_on`. In
        velocity and specific force, they resemble the effect of K_II. Parameters: see `acts_on`.
        """
        if self.kind == "table_axis":
            return True  # its axis takes all horizontal directions
        axis_change = np.cross(self._turn_axis(attitude), input_axis)
        return float(np.linalg.norm(axis_change)) > _ROUNDING

    def affects_mean(self, input_axis: Array, attitude: Array, start: Array | None = None) -> bool:
        """Return True if the error causes a mean acceleration over whole revolutions.

        input_axis, attitude: See `acts_on`.
        start: Direction of motion at t = 0, shape (3,); None: any horizontal direction.
        """
        if self.kind == "table_axis":
            # The centripetal force leaks into a vertical axis; gravity leaks in as a harmonic.
            return self.axis == 1 and abs(float(input_axis @ _UP)) > _ROUNDING
        # Gravity leaks in by its vertical part.
        axis_change = np.cross(self._turn_axis(attitude), input_axis)
        if self.kind == "table":
            return float(np.linalg.norm(axis_change)) > _ROUNDING
        vertical_change = abs(float(axis_change @ _UP))
        if self.force_axis is None:
            return vertical_change > _ROUNDING
        # The vertical force is constant, so a sensitivity to it is a drift or a common tilt.
        force = attitude[self.force_axis] * (1.0 - _UP)
        if self.kind == "compliance":
            return abs(float(axis_change @ force)) > _ROUNDING
        # The force's integral is the velocity, a quarter turn behind it.
        cross_change = abs(float(np.cross(_UP, force) @ axis_change))
        level_force = float(np.linalg.norm(force)) if start is None else abs(float(force @ start))
        return max(cross_change, min(vertical_change, level_force)) > _ROUNDING

    def _turn_axis(self, attitude: Array) -> Array:
        """Return the axis of the rotation, east-north-up, shape (3,).

        Tilts are about geographic axes, the table about up, others about the platform's axes.
        """
        axes = np.eye(3) if self.kind in ("tilt", "table") else attitude
        axis: Array = axes[self.axis]
        return axis


@frozen
class TrajectoryError:
    """An error of the trajectory: of the centrifuge's radius or axis, or of the recorded angle.

    With the spindle angle theta and the radius R, the distance of the platform from the axis is
    R (1 + stretch R w^2) + sum of c cos n theta + s sin n theta, and the encoder records theta plus
    such a sum. A tilt of the axis by a about east and b about north raises
    the platform by R (a sin theta - b cos theta). The platform itself stays level: its tilt is an
    `AttitudeError`. These errors are the same in all runs.

    The lever arm is the distance of the proof mass of an accelerometer from the table axis, along
    the input axis. It only acts if the table rotates in space.
    """

    kind: str  #: ``stretch``, ``imbalance``, ``axis_tilt``, ``encoder`` or ``lever_arm``.
    #: n, and ``cos`` or ``sin``; 0 and empty for the stretch and the tilts.
    harmonic: int = 0
    quadrature: str = ""
    axis: str = ""  #: For a tilt ``east`` or ``north``.
    part: ClassVar = "centrifuge"  #: As in `AttitudeError`.

    def acts_on(self, input_axis: Array, attitude: Array) -> bool:  # noqa: ARG002
        """Return True if the error affects an accelerometer; parameters as in `AttitudeError`."""
        # A tilted axis changes the height; other errors change the horizontal position.
        affected_components = input_axis[2:] if self.kind == "axis_tilt" else input_axis[:2]
        return float(np.linalg.norm(affected_components)) > _ROUNDING

    affects_output = acts_on

    def affects_mean(
        self,
        input_axis: Array,
        attitude: Array,
        start: Array | None = None,  # noqa: ARG002
    ) -> bool:
        """Return True if the error affects an accelerometer, as in `acts_on`."""
        return self.acts_on(input_axis, attitude)


@frozen
class SetupError:
    """An error of the position, direction or rate of the instrument at a reading."""

    #: ``radius``, ``rate``, ``droop``, ``misalignment``, or of the dividing head ``zero`` or
    #: ``wave``.
    kind: str
    axis: str = ""  #: For a misalignment the axis of the motion's frame about which it turns.
    #: For a wave n times a turn of the head n, and ``cos`` or ``sin``.
    harmonic: int = 0
    quadrature: str = ""


@frozen
class Input:
    """A quantity of the campaign description that enters the reference or its units."""

    quantity: str  #: ``radius``, ``gravity``, ``latitude``, ``timing_offset`` or ``clock``.
    bounds: tuple[float, float]  #: Range of possible values, SI.


#: The effect of a term.
Effect = SpecificForceProduct | Slope | AttitudeError | TrajectoryError | SetupError | Input
