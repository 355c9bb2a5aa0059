"""The result of a plan or a forecast: one object, its JSON, and its values from a forecast.

Units are SI, coefficients in g-units of the stated gravity, as in the result of a calibration.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import model_validator

from counterspin._version import __version__
from counterspin.arrays import Array
from counterspin.calibration.model import fixed_symbols, make_unknowns
from counterspin.calibration.outcome import make_coefficient
from counterspin.calibration.result_parts import Provenance
from counterspin.campaign.description import Campaign
from counterspin.campaign.questions import ask_questions
from counterspin.campaign.reading import Reading
from counterspin.inference.identifiability import ConfoundedTerms
from counterspin.inference.joint.budget import budget
from counterspin.inference.joint.summary import BudgetLine, WhatIf
from counterspin.inference.joint.what_if import what_if
from counterspin.physics.station import FRAMES
from counterspin.physics.terms import TERMS
from counterspin.planning.design import Criterion
from counterspin.planning.faults import FaultEffect, Requirement, undetected_faults
from counterspin.planning.forecast import Forecast
from counterspin.results import ReportableResult, ResultPart


class PlannedRun(ResultPart):
    """A planned run: rad/s (signed by sense), centripetal force in g, s; `start` of the record."""

    name: str
    rate: float
    specific_force: float
    revolutions: float
    duration: float
    attitude: str
    start: float | None = None


class PlannedReading(ResultPart):
    """A planned reading: rad/s, centripetal force in g, u in g; `time` of its middle, s.

    `axes`: directions of input and pendulous axis in the frame of the motion.
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
    """The expected uncertainty of a coefficient and its sources; None: not determined."""

    u: float | None
    u_noise: float | None = None
    u_stated: float | None = None
    u_unstated: float | None = None
    prior: float | None = None
    unit: str
    estimated: bool


class PlannedAccelerometer(ResultPart):
    """The expected result of an accelerometer.

    `harmonic_share` is the share of the estimate of K_II from the second harmonic; the remaining
    share comes from the mean of a_I^2. It is None with readings. `faults` has the largest fault
    first. Both are None if K_II is not estimated or not determined.
    """

    coefficients: dict[str, PredictedCoefficient]
    budget: dict[str, list[BudgetLine]]
    what_if: WhatIf | None = None
    confounded: list[ConfoundedTerms]
    harmonic_share: float | None = None
    faults: list[FaultEffect] | None = None


class GoalResult(ResultPart):
    """The goal of a plan, and its efficiency.

    `sizes`: unknown, such as ``Qx.K_II``, -> u that counts as 1, or the target of u.
    `efficiency` is the lower bound of u (or, for a target, time) of any plan within the limits,
    over the u of this plan; None if no theorem gives a bound.
    """

    #: ``minimise``: smallest uncertainty within the time; ``target``: shortest time.
    kind: Literal["minimise", "target"]
    criterion: Literal["sum", "determinant"]
    sizes: dict[str, float]
    efficiency: float | None = None

    def make_criterion(self, names: Sequence[str]) -> Criterion:
        """Return the criterion to minimise, for unknowns with `names`."""
        indices = tuple(names.index(name) for name in self.sizes)
        return Criterion(indices, tuple(self.sizes.values()), self.criterion)

    def with_efficiency(self, efficiency: float | None) -> GoalResult:
        """Return the goal with the efficiency of a plan."""
        return self.model_copy(update={"efficiency": efficiency})


class OtherPlan(ResultPart):
    """Another plan, in the same time or in half; `ratio` is this plan's u over the other's."""

    words: str
    total_time: float
    u: dict[str, float]
    ratio: dict[str, float]


class LimitResult(ResultPart):
    """A limit of the plan: binding or not, and the gain from relaxing it.

    `gain` is the relative decrease of u (mean over the goal's coefficients), or of the time.
    """

    key: str
    words: str
    binds: bool
    gain: float


class PlanResult(ReportableResult):
    """A plan, or the forecast of a campaign that exists (then without goal and limits).

    `assumed` are the terms and inputs fixed at nominal values, which do not contribute to u.
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
    warnings: list[str] = []
    provenance: Provenance

    @model_validator(mode="before")
    @classmethod
    def _drop_curves(cls, document: Any) -> Any:
        """Return a document without the curves in files of earlier versions."""
        if isinstance(document, Mapping):
            return {key: value for key, value in document.items() if key != "curves"}
        return document


def make_plan_result(
    prediction: Forecast,
    sampling_rate: float | None,
    total_time: float,
    attitudes: Mapping[str, str] | None = None,
    starts: Mapping[str, float] | None = None,
) -> PlanResult:
    """Return the result of a campaign's forecast, without goal and limits.

    attitudes: Descriptions of the attitudes by run; None: omit the runs.
    starts: Start times of the records by run, s; None: not planned.
    """
    campaign = prediction.campaign
    return PlanResult(
        title=campaign.title,
        gravity=campaign.site.gravity,
        radius=campaign.radius.value,
        sampling_rate=sampling_rate,
        total_time=total_time,
        runs=[] if attitudes is None else planned_runs(campaign, attitudes, starts),
        readings=planned_readings(campaign),
        accelerometers=predict_accelerometers(prediction),
        platform=predict_platform(prediction),
        assumed=list(fixed_symbols(campaign, make_unknowns(campaign))),
        warnings=[
            *_single_rate_warnings(campaign),
            *(question.text for question in ask_questions(campaign)),
        ],
        provenance=Provenance(version=__version__, inputs={}),
    )


def compare_plan(
    words: str,
    total_time: float,
    plan_u: Mapping[str, float],
    other_u: Mapping[str, float],
    names: Iterable[str],
) -> OtherPlan:
    """Return the comparison of another plan with this one.

    plan_u, other_u: u of this plan and of the other, by name.
    """
    u = {name: other_u[name] for name in names}
    ratio = {name: plan_u[name] / u_value for name, u_value in u.items()}
    return OtherPlan(words=words, total_time=total_time, u=u, ratio=ratio)


def _single_rate_warnings(campaign: Campaign) -> list[str]:
    """Return the warning for runs at a single rate; empty for other campaigns."""
    rates = [abs(run.rate) for run in campaign.runs]
    if campaign.readings or not rates or max(rates) > 1.001 * min(rates):
        return []
    return [
        f"All runs have the same rate, {rates[0]:.6g} rad/s. At a single rate, the mean effects "
        "of K_F, K_II, K_4 and K_F.heating cannot be separated, so K_II depends on the priors "
        "for the other terms. If these priors are wrong, the records will not reveal the error. "
        "Add runs at a second rate."
    ]


def predict_accelerometers(prediction: Forecast) -> dict[str, PlannedAccelerometer]:
    """Return the expected result of each accelerometer of a campaign."""
    parameters = prediction.fit.model.of_interest
    indices = {
        name: {
            parameter.symbol: i
            for i, parameter in enumerate(parameters)
            if parameter.owner == name and parameter.symbol in TERMS
        }
        for name in prediction.campaign.accelerometers
    }
    return {
        name: _predict_accelerometer(prediction, name, symbol_indices)
        for name, symbol_indices in indices.items()
    }


def _predict_accelerometer(
    prediction: Forecast, name: str, indices: Mapping[str, int]
) -> PlannedAccelerometer:
    coefficients = {symbol: _predict_coefficient(prediction, i) for symbol, i in indices.items()}
    campaign = prediction.campaign
    other_prefixes = [f"{prefix}." for prefix in campaign.accelerometers if prefix != name]
    is_determined = "K_II" in coefficients and coefficients["K_II"].estimated
    harmonic_share, faults = (
        undetected_faults(prediction, name, indices["K_II"]) if is_determined else (None, None)
    )
    budgets = {
        symbol: budget(prediction.fit, index, name)
        for symbol, index in indices.items()
        if coefficients[symbol].estimated
    }
    return PlannedAccelerometer(
        coefficients={
            symbol: coefficients[symbol]
            for symbol in campaign.model.terms
            if symbol in coefficients
        },
        budget=budgets,
        what_if=what_if(prediction.fit, indices, budgets, name),
        confounded=[
            replace(confounded.without_owner(name), value=None)
            for confounded in prediction.assessment.confounded
            if not any(
                term.startswith(prefix) for term in confounded.terms for prefix in other_prefixes
            )
        ],
        harmonic_share=harmonic_share,
        faults=faults,
    )


def predict_platform(prediction: Forecast) -> dict[str, PredictedCoefficient]:
    """Return the expected uncertainties of the platform terms that all runs share."""
    return {
        unknown.symbol: _predict_coefficient(prediction, index)
        for index, unknown in enumerate(prediction.fit.model.of_interest)
        if not unknown.owner
    }


def _predict_coefficient(prediction: Forecast, index: int) -> PredictedCoefficient:
    """Return the expected uncertainty of an unknown."""
    coefficient_result = make_coefficient(prediction.estimate, prediction.assessment, index)
    prior = prediction.fit.model.unknowns[index].prior[1]
    return PredictedCoefficient(
        u=coefficient_result.u if coefficient_result.estimated else None,
        u_noise=coefficient_result.u_noise,
        u_stated=coefficient_result.u_stated,
        u_unstated=coefficient_result.u_unstated,
        prior=prior if math.isfinite(prior) else None,
        unit=coefficient_result.unit,
        estimated=coefficient_result.estimated,
    )


def planned_runs(
    campaign: Campaign, attitudes: Mapping[str, str], starts: Mapping[str, float] | None = None
) -> list[PlannedRun]:
    """Return a campaign's runs in their order.

    starts: Start times of the records by run, s; None: not planned.
    """
    runs = []
    for run in campaign.runs:
        duration = run.duration or 0.0
        runs.append(
            PlannedRun(
                name=run.name,
                rate=run.rate,
                specific_force=campaign.radius.value * run.rate**2 / campaign.site.gravity,
                revolutions=abs(run.rate) * duration / (2.0 * math.pi),
                duration=duration,
                attitude=attitudes[run.name],
                start=None if starts is None else starts[run.name],
            )
        )
    return runs


def planned_readings(campaign: Campaign) -> list[PlannedReading]:
    """Return a campaign's readings in their order."""
    return [
        PlannedReading(
            name=reading.name,
            accelerometer=reading.accelerometer,
            motion=reading.motion,
            mounting=reading.mounting,
            rate=reading.rate,
            specific_force=campaign.radius.value * reading.rate**2 / campaign.site.gravity,
            axes=", ".join(
                _describe_direction(axis, FRAMES[reading.motion])
                for axis in reading.axes.matrix[:2]
            ),
            u=reading.u or 0.0,
            time=reading.time,
        )
        for reading in campaign.readings
    ] + [_planned_pose(pose) for pose in (campaign.triad.poses if campaign.triad else ())]


def _planned_pose(pose: Sequence[Reading]) -> PlannedReading:
    """Return a planned pose of a triad as a single reading of its three accelerometers."""
    values = np.array([reading.value for reading in pose])
    components = zip(pose, values / np.linalg.norm(values), strict=True)
    return PlannedReading(
        name=pose[0].name,
        accelerometer=", ".join(reading.accelerometer for reading in pose),
        motion=pose[0].motion,
        mounting="",
        rate=0.0,
        specific_force=0.0,
        axes="up: "
        + ", ".join(
            f"{reading.accelerometer} {component:+.2f}" for reading, component in components
        ),
        u=max(reading.u or 0.0 for reading in pose),
        time=pose[0].time,
    )


def _describe_direction(axis: Array, names: Mapping[str, tuple[float, float, float]]) -> str:
    """Return the name of a direction, or its components."""
    for name, components in names.items():
        if np.allclose(axis, components, atol=1e-9):
            return name
    return "[" + ", ".join(f"{component:.4f}" for component in axis) + "]"
