"""What the records that are there say together, and whether it is enough."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import field
from functools import cached_property
from pathlib import Path

from counterspin.calibration.joint import estimate_campaign
from counterspin.calibration.joint_parts import coefficient
from counterspin.calibration.joint_problem import JointProblem
from counterspin.calibration.joint_view import AccelerometerView
from counterspin.calibration.model import model_of
from counterspin.calibration.observed import ObservedRun
from counterspin.calibration.readings import ReadingsAndPoses
from counterspin.campaign.checking import Problems
from counterspin.campaign.description import Campaign
from counterspin.errors import CampaignError
from counterspin.frozen import frozen
from counterspin.inference.fitted_readings import FittedReadings
from counterspin.inference.joint.estimation import Estimate
from counterspin.inference.joint.unknowns import unit_of
from counterspin.inference.poses import TriadPoses
from counterspin.monitoring.result import GoalState, ReachedCoefficient
from counterspin.planning.plan_file import read_plan, resolve_goal
from counterspin.planning.plan_sections import GoalSettings


@frozen(eq=False)
class FitSoFar:
    """The joint fit of the runs that are there."""

    campaign: Campaign  #: With these runs alone.
    estimate: Estimate  #: Of its unknowns.
    #: Readings and poses, and how they fit.
    read: ReadingsAndPoses = field(default_factory=ReadingsAndPoses)

    @property
    def posed(self) -> tuple[FittedReadings, ...]:
        """The poses of its triad."""
        return tuple(part for part in self.read.parts if isinstance(part.readings, TriadPoses))

    @cached_property
    def views(self) -> tuple[AccelerometerView, ...]:
        """The fit as each accelerometer sees it."""
        problem = JointProblem(self.campaign)
        views = (
            AccelerometerView(problem, self.estimate, self.estimate.fit.assessment, name)
            for name in self.campaign.accelerometers
        )
        return tuple(view for view in views if view.has_records)


def fitted(campaign: Campaign, observed: Sequence[ObservedRun]) -> FitSoFar:
    """Fit runs together, as a calibration of them alone does."""
    return FitSoFar(campaign, *estimate_campaign(JointProblem(campaign, observed)))


def goals_of(
    campaign: Campaign, wanted: Sequence[str] | Mapping[str, float | str] | Path
) -> dict[str, float]:
    """Return goals, checked: the whole name of each coefficient and the u that is wanted of it.

    wanted: Such as ``K_II 1e-8 g/g^2`` or ``Qx.K_II 0.01 ug/g^2``; without a unit it is the
        coefficient's own. Or a mapping of names to these; or a plan, whose ``target`` it is. A term
        without an accelerometer is a goal of each.
    """
    if isinstance(wanted, Path):
        goal = read_plan(wanted).goal
        if goal.kind != "target":
            raise CampaignError(
                str(wanted), ["goal.target: missing; the plan does not state the required u"]
            )
        target: dict[str, float | str] = dict(goal.sizes)
    elif isinstance(wanted, Mapping):
        target = dict(wanted)
    else:
        parts = (goal.strip().partition(" ") for goal in wanted)
        target = {name: u.strip() for name, _, u in parts}
    if not target:
        return {}
    problems = Problems({})
    sought = GoalSettings(target={n: _with_unit(campaign, n, u) for n, u in target.items()})
    resolved = resolve_goal(sought, campaign, problems)
    if resolved is None:
        raise CampaignError("goal", problems.lines)
    return dict(resolved.sizes)


def _with_unit(campaign: Campaign, name: str, u: float | str) -> str:
    """Return the u that is wanted with its unit, the coefficient's own where none is given."""
    try:
        number = float(u)
    except ValueError:
        return str(u)
    symbols = [u.symbol for u in model_of(campaign).asked if name in (u.name, u.symbol)]
    return f"{number!r} {unit_of(symbols[0])}" if symbols else str(u)


def reached(fit: FitSoFar, names: Sequence[str]) -> list[ReachedCoefficient]:
    """Return what a fit says of unknowns, None where it does not determine them."""
    places = {u.name: i for i, u in enumerate(fit.estimate.fit.model.asked)}
    found = []
    for name in names:
        if name not in places:
            continue
        c = coefficient(fit.estimate, fit.estimate.fit.assessment, places[name])
        found.append(
            ReachedCoefficient(
                name=name,
                value=c.value if c.estimated else None,
                u=c.u if c.estimated else None,
                unit=c.unit,
            )
        )
    return found


def nothing_reached(campaign: Campaign, names: Sequence[str]) -> list[ReachedCoefficient]:
    """Return the coefficients of the names that are asked for, none of them determined."""
    symbols = {unknown.name: unknown.symbol for unknown in model_of(campaign).asked}
    return [
        ReachedCoefficient(name=name, value=None, u=None, unit=unit_of(symbols[name]))
        for name in names
        if name in symbols
    ]


def shown_names(campaign: Campaign, goals: Iterable[str] = ()) -> list[str]:
    """Return what is shown: K_II of each, all that is asked of a triad in poses, and goals."""
    of_triad = campaign.triad.accelerometers if campaign.triad and campaign.posed else ()
    asked = [unknown.name for unknown in model_of(campaign).asked if unknown.owner in of_triad]
    squares = (f"{name}.K_II" for name in campaign.accelerometers)
    return list(dict.fromkeys([*squares, *asked, *goals]))


def goal_states(goals: Mapping[str, float], found: Sequence[ReachedCoefficient]) -> list[GoalState]:
    """Return for each goal whether it is met."""
    by_name = {c.name: c for c in found}
    return [
        GoalState(
            name=name,
            wanted=wanted,
            u=(now := by_name[name]).u,
            unit=now.unit,
            met=now.u is not None and now.u <= wanted,
        )
        for name, wanted in goals.items()
        if name in by_name
    ]
