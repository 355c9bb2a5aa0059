"""The result of a plan or a forecast: one object, its JSON.

Units are SI, coefficients in g-units of the stated gravity, as in the result of a calibration.
"""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from counterspin.calibration.result_parts import Provenance
from counterspin.inference.identifiability import ConfoundedTerms
from counterspin.inference.joint.budget import BudgetLine, WhatIf
from counterspin.reports.publication import ShownResult, load_function, on_axes
from counterspin.results import ResultPart


class PlannedRun(ResultPart):
    """One run: rad/s (its sign is the sense), centripetal force in g, s; `start` of the record."""

    name: str
    rate: float
    specific_force: float
    revolutions: float
    duration: float
    attitude: str
    start: float | None = None


class PlannedReading(ResultPart):
    """One reading: rad/s, centripetal force in g, u in g; `time` of its middle, s.

    `axes` says where input and pendulous axis point in the frame of the motion.
    """

    name: str
    accelerometer: str
    motion: str
    mounting: str
    rate: float
    specific_force: float
    axes: str
    u: float
    time: float | None = None


class PredictedCoefficient(ResultPart):
    """The uncertainty that a coefficient will have, and where from; None: not determined."""

    u: float | None
    u_noise: float | None = None
    u_stated: float | None = None
    u_unstated: float | None = None
    prior: float | None = None
    unit: str
    estimated: bool


class FaultEffect(ResultPart):
    """Something assumed to be perfect that would move K_II by more than its u."""

    #: As in the table of terms, or as it would stand there; what it is called.
    symbol: str
    words: str
    #: At which it is taken: a typical one.
    size: float
    unit: str
    #: Of K_II, g/g^2, without sign; of parts with unknown phase the largest, of those that each run
    #: has anew the root of the sum of squares.
    shift: float
    ratio: float  #: The shift over u(K_II).
    #: Standard deviations that the best test for it would see: a fit that estimates it.
    deviation: float
    detection: float  #: Probability that the residuals of the fit without it fail their test.
    noticed: bool  #: Whether they nearly always do.


class PlannedAccelerometer(ResultPart):
    """What is expected of one accelerometer.

    `harmonic_share` is the part of K_II's estimate that rests on the second harmonic of the
    revolution, the rest being the mean of a_I^2, and None where there are readings; `faults`, the
    largest first; both only where K_II is estimated and determined.
    """

    coefficients: dict[str, PredictedCoefficient]
    budget: dict[str, list[BudgetLine]]
    what_if: WhatIf | None = None
    confounded: list[ConfoundedTerms]
    harmonic_share: float | None = None
    faults: list[FaultEffect] | None = None


class GoalResult(ResultPart):
    """What was sought, and how it was met.

    `efficiency` is the least u (or, for a target, time) that any plan within the limits could
    have, over this plan's; None where no theorem says it.
    """

    kind: Literal["minimise", "target"]
    criterion: Literal["sum", "determinant"]
    sizes: dict[str, float]
    efficiency: float | None


class OtherPlan(ResultPart):
    """Another plan, in the same time or in half; `ratio` is this plan's u over the other's."""

    words: str
    total_time: float
    u: dict[str, float]
    ratio: dict[str, float]


class LimitResult(ResultPart):
    """One limit: whether the plan touches it, and what it gains if the limit gives way.

    `gain` is the relative decrease of u (mean over the goal's coefficients), or of the time.
    """

    key: str
    words: str
    binds: bool
    gain: float


class Requirement(ResultPart):
    """How large a fault of the centrifuge may be before u of the goal grows by a twentieth.

    `size` is None where any size that can occur would do.
    """

    words: str
    size: float | None
    unit: str


class Curve(ResultPart):
    """A line of a figure: the criterion's u over an abscissa."""

    x: list[float]
    u: list[float]


class Curves(ResultPart):
    """What the figures show.

    `time` and `rate`: the best plan's u against total time, s, and against the highest rate,
    rad/s; `sources`: by source its contribution to u against the highest rate of this plan's runs,
    all rates scaled together.
    """

    coefficient: str
    unit: str
    time: Curve
    rate: Curve
    sources: dict[str, Curve]


class PlanResult(ShownResult):
    """A plan, or the forecast of a campaign that exists (then without goal and limits).

    `assumed` are the terms and inputs that are taken as perfect, and so no part of u.
    """

    BLOCKS: ClassVar[str] = "counterspin.planning.page:plan_blocks"
    KIND: ClassVar[str] = "plan's result"

    title: str
    gravity: float
    radius: float
    sampling_rate: float | None
    total_time: float
    runs: list[PlannedRun]
    readings: list[PlannedReading] = []
    order: str = ""
    accelerometers: dict[str, PlannedAccelerometer]
    platform: dict[str, PredictedCoefficient]
    goal: GoalResult | None = None
    others: list[OtherPlan] = []
    limits: list[LimitResult] = []
    requirements: list[Requirement] = []
    requirements_for: str = ""
    assumed: list[str] = []
    curves: Curves | None = None
    warnings: list[str] = []
    provenance: Provenance

    def plot(self, *, axes: Any = None) -> list[Any]:
        """Draw what limits the plan; `plan` makes the curves with `curves=True`."""
        return on_axes(list(load_function("counterspin.planning.figures:plan_plots")(self)), axes)
