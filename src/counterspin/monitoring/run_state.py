"""States of runs and pose records, with remarks and current estimates."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import field
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.accelerometer_view import AccelerometerView, ReadingData
from counterspin.calibration.assembly import MAX_RATE_DEVIATION, MIN_DURATION_FRACTION
from counterspin.calibration.joint import estimate_campaign
from counterspin.calibration.joint_problem import JointProblem
from counterspin.calibration.model import make_unknowns
from counterspin.calibration.observed_runs import ObservedRun
from counterspin.calibration.outcome import MAX_OUTLIER_SHARE, make_coefficient
from counterspin.campaign.description import Campaign
from counterspin.campaign.reading import PoseRecord
from counterspin.campaign.settings import OBSERVABLES
from counterspin.campaign.static_noise import resolve_noise
from counterspin.campaign.validation import Problems
from counterspin.errors import CampaignError, error_code
from counterspin.frozen import frozen
from counterspin.inference.diagnostics import CHI_SQUARE_SIGNIFICANCE
from counterspin.inference.joint.estimation import Estimate
from counterspin.inference.joint.unknowns import unit_of
from counterspin.monitoring.observer import record_name
from counterspin.monitoring.result import (
    CurrentEstimate,
    GoalState,
    PosesState,
    ResidualState,
    RunState,
)
from counterspin.physics.spindle import SpindleFit
from counterspin.physics.terms import TERMS
from counterspin.planning.plan_file import read_plan, resolve_goal
from counterspin.planning.plan_sections import GoalSettings
from counterspin.planning.stations import (
    describe_upward_direction,
    set_pose_values,
    upward_directions,
)
from counterspin.readings.fitted import FittedReadings
from counterspin.records.record import RecordReport
from counterspin.triads.checks import pose_findings
from counterspin.triads.groups import make_group
from counterspin.triads.poses import TriadPoses
from counterspin.triads.record_poses import LocatedPose


def make_run_state(
    campaign: Campaign, observed_run: ObservedRun, views: Sequence[AccelerometerView]
) -> RunState:
    """Return the state of a run.

    views: Views of a fit with the run, by accelerometer; empty without a fit.
    """
    run = observed_run.run
    return RunState(
        run=run.name,
        record=record_name(run.record, campaign.folder),
        state="read",
        stated_seconds=run.duration,
        nominal_rate=run.rate,
        **report_fields(observed_run.record.report, observed_run.record.time),
        **rotation_fields(observed_run.rotation),
        residuals={
            view.name: state
            for view in views
            if (state := _make_residual_state(campaign, view, run.name)) is not None
        },
    )


def report_fields(report: RecordReport, time: Array) -> dict[str, Any]:
    """Return the fields of `RunState` that follow from the rows of a record.

    time: Time of the rows, s, shape (n,).
    """
    return {
        "rows": report.rows,
        "seconds": float(time[-1] - time[0]),
        "sampling_rate": 1.0 / report.step,
        "repeated": report.repeated,
        "empty": sum(report.empty.values()),
        "outliers": sum(report.outliers.values()),
        "gaps": report.n_gaps,
        "longest_gap": max((gap.length for gap in report.gaps), default=0.0),
    }


def rotation_fields(rotation: SpindleFit | None) -> dict[str, Any]:
    """Return the fields of `RunState` that follow from the recorded angle."""
    if rotation is None:
        return {}
    spindle = rotation.spindle
    largest_ripple = max(spindle.ripples, key=lambda ripple: ripple.amplitude, default=None)
    return {
        "rate": spindle.rate,
        "u_rate": rotation.u_rate,
        "drift": spindle.drift,
        "ripple": largest_ripple.amplitude if largest_ripple else None,
        "harmonic": largest_ripple.harmonic if largest_ripple else None,
        "angle_rms": rotation.rms,
    }


def _make_residual_state(
    campaign: Campaign, view: AccelerometerView, run_name: str
) -> ResidualState | None:
    tests = view.diagnostics.runs.get(run_name)
    if tests is None:
        return None
    sum_of_squares = n_residuals = 0.0
    for _, record, residuals in view.records():
        if record.run == run_name:
            sum_of_squares += float((residuals.unweighted**2 * record.series.count).sum())
            n_residuals += residuals.unweighted.size
    observable = view.accelerometer.observable
    stated_noise = getattr(resolve_noise(campaign)[view.name].sizes, observable, None)
    return ResidualState(
        rms=math.sqrt(sum_of_squares / n_residuals),
        stated=stated_noise if isinstance(stated_noise, float) and stated_noise > 0.0 else None,
        ratio=math.sqrt(tests.chi2 / tests.dof),
        p=tests.chi2_p if view.diagnostics.noise_given else None,
        unit=OBSERVABLES[observable],
    )


def run_remarks(
    state: RunState, notes: Sequence[str], views: Sequence[AccelerometerView]
) -> tuple[list[str], bool]:
    """Return remarks on a run, in sentences, and True if the run has no faults."""
    faults, warnings = list[str](), list[str]()
    if state.rate is not None:
        relative_deviation = state.rate / state.nominal_rate - 1.0
        if abs(relative_deviation) > MAX_RATE_DEVIATION:
            faults.append(
                f"The spindle turned at {state.rate:.6f} rad/s instead of the nominal "
                f"{state.nominal_rate:.6f} rad/s ({100 * relative_deviation:+.2f} %)."
            )
    if state.stated_seconds and state.seconds < MIN_DURATION_FRACTION * state.stated_seconds:
        faults.append(
            f"The record lasts {state.seconds:.4g} s instead of the stated "
            f"{state.stated_seconds:.4g} s."
        )
    if state.outliers > MAX_OUTLIER_SHARE * max(state.rows, 1) * max(len(views), 1):
        faults.append(f"{state.outliers} of {state.rows} samples are outliers.")
    for view in views:
        texts = [f"{view.name}: {text}" for text in view.diagnostics.findings]
        p = view.diagnostics.lack_of_fit_p if view.diagnostics.noise_given else None
        (faults if p is not None and p < CHI_SQUARE_SIGNIFICANCE else warnings).extend(texts)
    return [*faults, *warnings, *notes], not faults


@frozen(eq=False)
class CurrentFit:
    """Joint fit of the existing runs."""

    campaign: Campaign  #: Campaign with these runs only.
    estimate: Estimate  #: Estimate of its unknowns.
    data: ReadingData = field(default_factory=ReadingData)  #: Readings and poses in it.

    @property
    def pose_groups(self) -> tuple[FittedReadings, ...]:
        """Fitted poses of its triad."""
        groups = (group for group in self.data.groups if isinstance(group, FittedReadings))
        return tuple(group for group in groups if group.readings.triad)

    @cached_property
    def views(self) -> tuple[AccelerometerView, ...]:
        """Views of the fit, one for each accelerometer."""
        problem = JointProblem(self.campaign)
        views = (
            AccelerometerView(problem, self.estimate, self.estimate.fit.assessment, name)
            for name in self.campaign.accelerometers
        )
        return tuple(view for view in views if view.has_records)


def fit_runs(campaign: Campaign, observed_runs: Sequence[ObservedRun]) -> CurrentFit:
    """Fit runs jointly, as in a calibration of only these runs."""
    return CurrentFit(campaign, *estimate_campaign(JointProblem(campaign, observed_runs)))


def resolve_goals(
    campaign: Campaign, goals: Sequence[str] | Mapping[str, float | str] | Path
) -> dict[str, float]:
    """Return full name of each coefficient -> its target u.

    goals: Text such as ``K_II 1e-8 g/g^2`` or ``Qx.K_II 0.01 ug/g^2``, by default in the unit of
        the coefficient; a mapping from names to values; or a plan with a ``target``. A term without
        an accelerometer applies to all accelerometers.
    """
    if isinstance(goals, Path):
        goal = read_plan(goals).goal
        if goal.kind != "target":
            raise CampaignError(
                str(goals),
                ["goal.target: missing; the plan does not state the required u"],
                code="missing-key",
            )
        targets: dict[str, float | str] = dict(goal.sizes)
    elif isinstance(goals, Mapping):
        targets = dict(goals)
    else:
        name_value_pairs = (goal.strip().partition(" ") for goal in goals)
        targets = {name: u.strip() for name, _, u in name_value_pairs}
    if not targets:
        return {}
    problems = Problems({})
    goal_settings = GoalSettings(
        target={name: _parse_target(campaign, name, u) for name, u in targets.items()}
    )
    resolved_goal = resolve_goal(goal_settings, campaign, problems)
    if resolved_goal is None:
        if isinstance(goals, Path):
            raise CampaignError(str(goals), problems.lines)
        messages = [problem.removeprefix("goal.target.") for problem in problems.lines]
        raise CampaignError("goal", messages, code=[error_code(p) for p in problems.lines])
    return dict(resolved_goal.sizes)


def _parse_target(campaign: Campaign, name: str, target_u: float | str) -> str:
    """Return the target u with its unit, which defaults to that of the coefficient."""
    try:
        target_value = float(target_u)
    except ValueError:
        return str(target_u)
    symbols = [
        unknown.symbol
        for unknown in make_unknowns(campaign).of_interest
        if name in (unknown.name, unknown.symbol)
    ]
    return f"{target_value!r} {unit_of(symbols[0])}" if symbols else str(target_u)


def current_estimates(fit: CurrentFit, names: Sequence[str]) -> list[CurrentEstimate]:
    """Return the estimates of named coefficients; value and u are None if not determined."""
    indices = {u.name: i for i, u in enumerate(fit.estimate.fit.model.of_interest)}
    estimates = []
    for name in names:
        if name not in indices:
            continue
        estimate = make_coefficient(fit.estimate, fit.estimate.fit.assessment, indices[name])
        estimates.append(
            CurrentEstimate(
                name=name,
                value=estimate.value if estimate.estimated else None,
                u=estimate.u if estimate.estimated else None,
                unit=estimate.unit,
            )
        )
    return estimates


def undetermined_estimates(campaign: Campaign, names: Sequence[str]) -> list[CurrentEstimate]:
    """Return undetermined estimates of named coefficients."""
    symbols = {unknown.name: unknown.symbol for unknown in make_unknowns(campaign).of_interest}
    return [
        CurrentEstimate(name=name, value=None, u=None, unit=unit_of(symbols[name]))
        for name in names
        if name in symbols
    ]


def list_displayed_names(campaign: Campaign, goals: Iterable[str] = ()) -> list[str]:
    """Return the displayed names: each K_II, the parameters of a triad in poses, and goals."""
    accelerometers = campaign.triad.accelerometers if campaign.triad and campaign.posed else ()
    triad_names = [
        unknown.name
        for unknown in make_unknowns(campaign).of_interest
        if unknown.owner in accelerometers
    ]
    second_order_names = (f"{name}.K_II" for name in campaign.accelerometers)
    return list(dict.fromkeys([*second_order_names, *triad_names, *goals]))


def goal_states(
    goals: Mapping[str, float], estimates: Sequence[CurrentEstimate]
) -> list[GoalState]:
    """Return the state of each goal."""
    estimates_by_name = {c.name: c for c in estimates}
    return [
        GoalState(
            name=name,
            wanted=target,
            u=(estimate := estimates_by_name[name]).u,
            unit=estimate.unit,
            met=estimate.u is not None and estimate.u <= target,
        )
        for name, target in goals.items()
        if name in estimates_by_name
    ]


#: Negligible prior information, in poses, that makes the information matrix regular.
_PRIOR_INFORMATION: Final = 1e-9

#: Largest number of named directions; a triad without prior information needs nine.
_MAX_DIRECTIONS: Final = 12


def make_poses_state(
    campaign: Campaign,
    record: PoseRecord,
    located_poses: Sequence[LocatedPose],
    fit: CurrentFit | None,
) -> RunState:
    """Return the state of a record of poses.

    located_poses: Poses of the record, at least one.
    fit: Fit with the record; None without a fit.
    """
    pose_record = located_poses[0].record
    assert pose_record is not None
    poses, report = pose_record.poses, pose_record.report
    names = {located_pose.pose[0].name for located_pose in located_poses}
    residuals = [value for name, value in _pose_residuals(fit) if name in names] if fit else []
    return RunState(
        run=record.name,
        record=record_name(record.record, campaign.folder),
        state="read",
        **report_fields(report, poses.time),
        nominal_rate=0.0,
        poses=PosesState(
            count=len(located_poses),
            threshold=poses.threshold,
            rms=campaign.gravity.value * float(np.sqrt(np.mean(np.square(residuals))))
            if residuals
            else None,
            outlying=[
                outlier.name
                for group in (fit.pose_groups if fit else ())
                for outlier in group.outliers()
                if outlier.name in names
            ],
            missing=find_missing_directions(campaign, located_poses, fit),
        ),
    )


def pose_remarks(
    located_poses: Sequence[LocatedPose], fit: CurrentFit | None
) -> tuple[list[str], bool]:
    """Return remarks on a record of poses, in sentences, and True if it is consistent."""
    record = located_poses[0].record
    assert record is not None
    findings = pose_findings(fit.estimate.fit, fit.pose_groups) if fit else []
    warnings = [*record.poses.warnings, *record.poses.rejected, *record.report.notes()]
    is_good = not any(finding.contradicts for finding in findings)
    return [*(finding.text for finding in findings), *warnings], is_good


def find_missing_directions(
    campaign: Campaign, located_poses: Sequence[LocatedPose], fit: CurrentFit | None
) -> list[str]:
    """Return the directions in which one pose would be more informative than all existing poses.

    Directions are selected greedily, the most informative first. Nine optimal poses leave no
    direction: the variance of |f| nowhere exceeds that of a single pose (Kiefer and Wolfowitz,
    Canadian J. Math. 12 (1960) 363).
    """
    model = fit.estimate.fit.model if fit else make_unknowns(campaign)
    expected_values = fit.estimate.fit.solution.estimate if fit else np.zeros(len(model.unknowns))
    group = make_group(campaign, [located_pose.pose for located_pose in located_poses])
    directions = upward_directions(group.accelerometers)
    priors = [
        {
            unknown.symbol: unknown.nominal + float(value)
            for unknown, value in zip(model.unknowns, expected_values, strict=True)
            if unknown.owner == name and unknown.symbol in TERMS
        }
        for name in group.accelerometers
    ]
    candidate_poses = set_pose_values(
        make_group(campaign, [located_poses[0].pose] * len(directions)), directions, priors
    )
    columns = [
        index
        for index, unknown in enumerate(model.of_interest)
        if unknown.owner in group.accelerometers
    ]
    pose_rows = group.linearize(model, expected_values).design[:, columns]
    candidate_rows = candidate_poses.linearize(model, expected_values).design[:, columns]
    information = pose_rows.T @ pose_rows + _PRIOR_INFORMATION * np.eye(len(columns))
    missing_directions: list[str] = []
    while len(missing_directions) < _MAX_DIRECTIONS:
        # Variance of |f| in each direction, relative to that of a single pose.
        relative_variances = np.einsum(
            "np,pn->n", candidate_rows, np.linalg.solve(information, candidate_rows.T)
        )
        worst_index = int(np.argmax(relative_variances))
        if relative_variances[worst_index] <= 1.0:
            break
        missing_directions.append(describe_upward_direction(directions[worst_index]))
        information += np.outer(candidate_rows[worst_index], candidate_rows[worst_index])
    return missing_directions


def _pose_residuals(fit: CurrentFit) -> Iterator[tuple[str, float]]:
    """Yield the name of each pose, and its residual of |f|, g."""
    model, point = fit.estimate.fit.model, fit.estimate.fit.solution.estimate
    for group in fit.pose_groups:
        poses = group.readings
        assert isinstance(poses, TriadPoses)
        gain = poses.at(model, point).gain
        yield from zip(poses.names, (group.residuals / gain).tolist(), strict=True)
