"""Simulation of the paper's plan from first principles, and rows of the comparison."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar, Final

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from counterspin.arrays import Array
from counterspin.inference.two_stage.first_stage import Parabola, Strobes, first_stage
from counterspin.inference.two_stage.second_stage import StrobedRun
from counterspin.physics import quadrature
from counterspin.physics.accelerometer import QX, indicated
from counterspin.physics.motion import Site, Trajectory
from counterspin.physics.spindle import Ripple, Spindle
from counterspin.results import ReportableResult


def _json_key(name: str) -> str:
    """Return the JSON key of a field."""
    return "counterspin" if name == "ours" else name


@dataclass(
    frozen=True, config=ConfigDict(extra="forbid", populate_by_name=True, alias_generator=_json_key)
)
class Row:
    """A figure of the paper and the same figure computed here."""

    key: str  #: Permanent short name.
    quantity: str  #: Description of the quantity.
    #: Figure of the paper, or value of its printed equation; None if it states neither.
    printed: float | None
    #: Figure computed here; ``counterspin`` in the JSON.
    ours: float
    unit: str  #: Unit of both figures.
    why: str  #: Reason for the difference, or the statement that the figures agree.
    #: Format specification of both numbers; not in the JSON.
    number_format: str = Field(default=".4e", exclude=True)

    @property
    def printed_text(self) -> str:
        """The paper's figure as text, or a dash."""
        return "-" if self.printed is None else format(self.printed, self.number_format)

    @property
    def ours_text(self) -> str:
        """The figure computed here, as text."""
        return format(self.ours, self.number_format)


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class PaperSection:
    """Group of rows with a title."""

    title: str
    rows: tuple[Row, ...]


class Reproduction(ReportableResult):
    """The result of `reproduce`."""

    BLOCKS: ClassVar[str] = "counterspin.reproduction.page:reproduction_blocks"
    KIND: ClassVar[str] = "reproduction"

    inputs: dict[str, Any]  #: Data that the paper states, and data that it leaves open, with units.
    sections: tuple[PaperSection, ...]  #: The rows, grouped in the order of the paper.

    @property
    def rows(self) -> tuple[Row, ...]:
        """All rows in order."""
        return tuple(row for section in self.sections for row in section.rows)

    def __getitem__(self, key: str) -> Row:
        """Return the row with this key; raise KeyError if no row has it."""
        return {row.key: row for row in self.rows}[key]


# Data stated by the paper
TABLE_1: Final[Mapping[str, float]] = {
    "K_F": 0.004,
    "K_I": 1.001,
    "K_II": 2e-5,
    "K_III": 4e-6,
    "K_IP": 6e-6,
}
RADIUS: Final = 2.5  #: m, Table 2
RIPPLE_RATIO: Final = 5e-7  #: w_p/w0, Table 2
RIPPLE_PHASE: Final = math.radians(30.0)  #: Table 2
RATES: Final = (math.pi / 2, math.pi, 2 * math.pi)  #: rad/s, section 2.3
N_STROBES: Final = 100
SIGMA_DISPLACEMENT: Final = 0.01  #: m
PRINTED_SIGMA_B2: Final = (6.6220e-5, 6.5837e-5, 6.6725e-5)  #: after Eq. 31
PRINTED_SIGMA_K_II: Final = 3.0362e-7  #: g/g^2, after Eq. 34
PRINTED_BOUND: Final = 5e-7  #: g/g^2, section 3: upper bound of the uncertainties of K_II

# Data not stated by the paper
GRAVITY: Final = 9.8  #: m/s^2; the common value that agrees best
STANDARD_GRAVITY: Final = 9.80665  #: m/s^2
#: The paper neglects the rotation of the Earth.
SITE: Final = Site(GRAVITY, latitude=0.0, earth_rate=0.0)
DRIFT_RATE: Final = 1e-7  #: 1/s; the paper names C but gives no value
RADIUS_ERROR: Final = 1e-5  #: m; the paper names delta r but gives no value


def paper_inputs() -> dict[str, Any]:
    """Return the inputs with their units, in the form of the JSON document."""
    return {
        "accelerometer": dict(TABLE_1),
        "radius": {"value": RADIUS, "unit": "m"},
        "ripple_ratio": RIPPLE_RATIO,
        "ripple_phase": {"value": RIPPLE_PHASE, "unit": "rad"},
        "rates": {"value": list(RATES), "unit": "rad/s"},
        "strobes": N_STROBES,
        "sigma_displacement": {"value": SIGMA_DISPLACEMENT, "unit": "m"},
        "sigma_b2": {"value": list(PRINTED_SIGMA_B2), "unit": "m/s^2"},
        "sigma_k_ii": {"value": PRINTED_SIGMA_K_II, "unit": "g/g^2"},
        "gravity": {"value": GRAVITY, "unit": "m/s^2"},
    }


def simulate_strobes(
    rate: float,
    *,
    truth: Mapping[str, float] = TABLE_1,
    drift: float = 0.0,
    ripple_ratio: float = RIPPLE_RATIO,
    uses_nominal_angle: bool = False,
    radius_error: float = 0.0,
) -> tuple[Array, Array]:
    """Simulate the strobed displacement error of one run, without noise (Eq. 10-12).

    The indicated specific force of Eq. 7 along the exact trajectory, minus the compensated
    acceleration, is integrated twice and compared with the true position. No expansion in small
    quantities and no linearity in the coefficients is used. As in the paper, the rotation of the
    Earth is neglected.

    rate: w0, rad/s.
    truth: Coefficients by symbol, in g-units.
    drift: C, 1/s.
    ripple_ratio: w_p/w0; the phase is `RIPPLE_PHASE`.
    uses_nominal_angle: Take the strobes and the reference from w0 t instead of the true angle.
    radius_error: True radius minus the nominal radius of start position and reference, m.
    Returns: Strobe times, s, and displacement errors, m, each of shape (100,).
    """
    ripple = Ripple(1, ripple_ratio * rate, RIPPLE_PHASE)
    spindle = Spindle(rate, drift=drift, ripples=(ripple,))
    trajectory = Trajectory(spindle, RADIUS + radius_error, SITE)
    angle = math.pi / 2 + 2 * math.pi * np.arange(1.0, N_STROBES + 1.0)
    time: Array = angle / rate if uses_nominal_angle else spindle.time_at(angle)

    def sensed_acceleration(t: Array) -> Array:
        force = indicated(QX, truth, trajectory.specific_force(t) / GRAVITY) * GRAVITY
        return (force - trajectory.harmful_acceleration(t)[:, 0])[None]

    panel_edges = quadrature.panel_edges(spindle, float(time[-1]))
    displacement = quadrature.integrate(sensed_acceleration, panel_edges, time, order=2)[:, 0]
    # The platform starts due east of the spindle, moving north: no start velocity to the east.
    error: Array = RADIUS + displacement - RADIUS * np.cos(angle)
    return time, error


def fit_first_stage(time: Array, error: Array) -> Parabola:
    """Fit the parabola of strobes with the standard deviation of the plan."""
    return first_stage(Strobes(time, error, np.ones(time.size), lost=0), SIGMA_DISPLACEMENT)


def simulate_runs(*, drift: float = 0.0, uses_nominal_angle: bool = False) -> list[StrobedRun]:
    """Simulate the plan's three runs with Tables 1 and 2; a drift replaces the ripple."""
    ripple_ratio = RIPPLE_RATIO if drift == 0.0 else 0.0
    return [
        StrobedRun(
            f"{rate:.4f} rad/s",
            Trajectory(Spindle(rate), RADIUS, SITE),
            fit_first_stage(
                *simulate_strobes(
                    rate,
                    drift=drift,
                    ripple_ratio=ripple_ratio,
                    uses_nominal_angle=uses_nominal_angle,
                )
            ),
        )
        for rate in RATES
    ]
