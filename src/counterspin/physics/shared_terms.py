"""Errors that all accelerometers share: of what carries them.

- `PlatformTerm`, `PLATFORM_TERMS`: the platform's attitude and its gyros
- `MotionTerm`, `MOTION_TERMS`: the path on which the centrifuge carries the platform
- `SharedTerm`, `SHARED_TERMS`: both
- `term`, `AnyTerm`: the row of any table with a symbol; `symbol_of`: the symbol in an unknown's
  name
- `OWN_TERMS`: the terms of which each accelerometer has its own, slopes under conditions included
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from counterspin.frozen import frozen
from counterspin.physics.accelerometer import TERMS, Term
from counterspin.physics.conditions import CONDITION_TERMS, ConditionTerm

DEGREE_PER_HOUR: Final = math.radians(1.0) / 3600.0  #: rad/s


@frozen
class PlatformTerm:
    """One error term of the platform: it turns the attitude and so every accelerometer's axes.

    The small attitude error psi (rad) starts at the tilt and obeys
    d(psi)/dt = drift + D f/g + E |f|^2/g^2; a platform of compliance C leans by C f/g besides. It
    then senses f - psi x f. Tilts are about the geographic axes of a run; all others belong to
    gyros and frame and are about the platform's own axes x, y, z, which point east, north, up in
    the level attitude.

    Attributes
    ----------
    symbol
        Such as ``platform.tilt.north`` or ``platform.g_sensitivity.zx`` (gyro axis, force axis).
    kind
        ``tilt``, ``drift``, ``g_sensitivity``, ``g2_sensitivity`` or ``compliance``.
    axis
        The axis about which the attitude turns: 0 east (x), 1 north (y), 2 up (z).
    force_axis
        For g-sensitivity and compliance the axis of the force, else None.
    unit, limit, typical
        SI unit; the largest credible size and, as for `Term`, the typical one in it.
    words
        What it is called.
    """

    symbol: str
    kind: str
    axis: int
    force_axis: int | None
    unit: str
    limit: float
    typical: float
    words: str

    nominal = 0.0

    @property
    def per_run(self) -> bool:
        """Whether every run has a value of its own (the tilt, set anew at each alignment)."""
        return self.kind == "tilt"


_NAMES: Final = ("east", "north", "up")

ARCSEC: Final = math.pi / 648000.0  #: rad

PLATFORM_TERMS: Final[Mapping[str, PlatformTerm]] = {
    row.symbol: row
    for row in (
        *(
            PlatformTerm(
                f"platform.tilt.{name}",
                "tilt",
                axis,
                None,
                "rad",
                1e-2,
                # Levelling is against gravity; the azimuth is found less well.
                (10.0 if name == "up" else 0.5) * ARCSEC,
                f"tilt about {name}",
            )
            for axis, name in enumerate(_NAMES)
        ),
        *(
            PlatformTerm(
                f"platform.drift.{n}",
                "drift",
                i,
                None,
                "rad/s",
                10.0 * DEGREE_PER_HOUR,
                0.01 * DEGREE_PER_HOUR,
                f"gyro drift about {n}",
            )
            for i, n in enumerate(_NAMES)
        ),
        *(
            PlatformTerm(
                f"platform.g_sensitivity.{'xyz'[i]}{'xyz'[j]}",
                "g_sensitivity",
                i,
                j,
                "rad/s/g",
                10.0 * DEGREE_PER_HOUR,
                0.01 * DEGREE_PER_HOUR,
                f"g-sensitivity of the {'xyz'[i]} gyro to force along {'xyz'[j]}",
            )
            for i in range(3)
            for j in range(3)
        ),
        *(
            PlatformTerm(
                f"platform.g2_sensitivity.{name}",
                "g2_sensitivity",
                axis,
                None,
                "rad/s/g^2",
                DEGREE_PER_HOUR,
                1e-4 * DEGREE_PER_HOUR,
                f"sensitivity of the gyro about {name} to the square of the force",
            )
            for axis, name in enumerate(_NAMES)
        ),
        *(
            PlatformTerm(
                f"platform.compliance.{'xyz'[i]}{'xyz'[j]}",
                "compliance",
                i,
                j,
                "rad/g",
                1e-4,
                0.1 * ARCSEC,
                f"turn of the platform about {'xyz'[i]} by force along {'xyz'[j]}",
            )
            for i in range(3)
            for j in range(3)
        ),
    )
}


@frozen
class MotionTerm:
    """One error of the path: the centrifuge's radius, or the angle that its encoder records.

    With the spindle's angle theta and the radius R, the platform is at the distance
    R (1 + stretch R w^2) + sum of c cos n theta + s sin n theta from the axis, and the encoder
    records theta + sum of c cos n theta + s sin n theta. An axis that is tilted by a about east and
    b about north carries the platform R (a sin theta - b cos theta) above the level; the platform
    itself stays level, and its own tilt is a `PlatformTerm`. The errors are those of the machine,
    the same in every run.

    Attributes
    ----------
    symbol
        Such as ``centrifuge.imbalance.1.cos``.
    kind
        ``stretch``, ``imbalance``, ``axis_tilt`` or ``encoder``.
    harmonic, quadrature
        n, and ``cos`` or ``sin``; 0 and empty for the stretch and the tilts.
    unit, limit, typical
        As of `PlatformTerm`.
    words
        What it is called.
    """

    symbol: str
    kind: str
    harmonic: int
    quadrature: str
    unit: str
    limit: float
    typical: float
    words: str

    nominal = 0.0
    per_run = False

    @property
    def of_harmonic(self) -> str:
        """What both quadratures are called together."""
        return self.words.partition(" (")[0]


_TIMES: Final = ("once", "twice", "three times", "four times")
_WAVES: Final = {"cos": "cosine", "sin": "sine"}

SharedTerm = PlatformTerm | MotionTerm

MOTION_TERMS: Final[Mapping[str, MotionTerm]] = {
    row.symbol: row
    for row in (
        MotionTerm(
            "centrifuge.stretch", "stretch", 0, "", "s^2/m", 1e-5, 4.6e-9, "stretch of the arm"
        ),
        *(
            MotionTerm(
                f"centrifuge.imbalance.{n}.{wave}",
                "imbalance",
                n,
                wave,
                "m",
                1e-3,
                1e-6,
                f"imbalance, radius varying {_TIMES[n - 1]} a revolution ({_WAVES[wave]})",
            )
            for n in (1, 2)
            for wave in ("cos", "sin")
        ),
        *(
            MotionTerm(
                f"centrifuge.axis_tilt.{axis}",
                "axis_tilt",
                0,
                "",
                "rad",
                1e-2,
                10.0 * ARCSEC,
                f"tilt of the spindle's axis about {axis}",
            )
            for axis in ("east", "north")
        ),
        *(
            MotionTerm(
                f"encoder.harmonic.{n}.{wave}",
                "encoder",
                n,
                wave,
                "rad",
                1e-3,
                ARCSEC,
                f"error of an eccentric encoder, {_TIMES[n - 1]} a revolution ({_WAVES[wave]})",
            )
            for n in (1, 2, 3, 4)
            for wave in ("cos", "sin")
        ),
    )
}

SHARED_TERMS: Final[Mapping[str, SharedTerm]] = {**PLATFORM_TERMS, **MOTION_TERMS}

OWN_TERMS: Final[Mapping[str, Term | ConditionTerm]] = {**TERMS, **CONDITION_TERMS}


def symbol_of(name: str) -> str:
    """Return the term in the name of an unknown: ``K_II`` of ``Qx.K_II``."""
    return name if name in SHARED_TERMS else name.partition(".")[2] or name


#: A row of any table.
AnyTerm = Term | ConditionTerm | SharedTerm


def term(symbol: str) -> AnyTerm:
    """Return the row of the table with this symbol.

    Raises
    ------
    ValueError
        If there is no such term; the message lists those there are.
    """
    row = TERMS.get(symbol) or CONDITION_TERMS.get(symbol) or SHARED_TERMS.get(symbol)
    if row is None:
        known = ", ".join([*TERMS, *CONDITION_TERMS, *SHARED_TERMS])
        raise ValueError(f"no term is called {symbol!r}; known: {known}")
    return row
