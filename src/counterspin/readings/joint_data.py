"""Readings and poses of a campaign in the joint fit."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import field, replace
from typing import Any, Final, Protocol

import numpy as np

from counterspin.calibration.accelerometer_view import (
    AccelerometerView,
    Contribution,
    FittedGroup,
    ReadingData,
)
from counterspin.calibration.joint_problem import JointProblem
from counterspin.calibration.model import SQUARE_TERMS
from counterspin.calibration.result_parts import Finding, ReadingResult, TriadResult
from counterspin.campaign.description import Campaign
from counterspin.errors import CampaignError, NotIdentifiableError
from counterspin.frozen import frozen
from counterspin.inference.joint.estimation import Estimate, estimate
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.mixture_distribution import mixture_dof
from counterspin.loading import is_installed, load_name
from counterspin.physics.accelerometer import Mounting
from counterspin.readings.checks import (
    check_readings,
    overstated_noise_remarks,
    record_outlier_findings,
    rounding_remarks,
)
from counterspin.readings.fit import ReadingsFit, solve_readings
from counterspin.readings.fitted import FittedReadings
from counterspin.readings.groups import group_readings
from counterspin.readings.known_attitudes import Readings
from counterspin.readings.linear import ReadingGroup
from counterspin.readings.mean_records import MeanRecords, average_records
from counterspin.readings.means import RecordMean
from counterspin.readings.methods import compare_methods
from counterspin.readings.reading_groups import pose_groups, reading_groups
from counterspin.readings.undetected_faults import fault_remarks, find_undetected_faults

#: Class of the poses of a triad, loaded for a campaign with a triad; see `TriadData`.
TRIAD: Final = "counterspin.triads.joint_data:TriadInFit"


class TriadData(Protocol):
    """Poses of a triad, and the results of the triad."""

    def groups(self) -> Sequence[ReadingGroup]:
        """Return the poses grouped by kind of noise."""

    def findings(self, fit: JointFit, groups: Sequence[FittedReadings]) -> list[Finding]:
        """Return the findings of tests of the residuals of poses."""

    def advice(self, view: AccelerometerView) -> str:
        """Return advice on poses that would determine more of an accelerometer."""

    def result(self, estimate: Estimate, groups: Sequence[FittedReadings]) -> TriadResult:
        """Return the results of the triad."""


@frozen(eq=False)
class ReadingsAndPoses(ReadingData):
    """Readings and poses of a campaign in a fit, and the averaged records."""

    groups: tuple[FittedReadings, ...] = ()  #: Groups by kind of noise.
    recorded: MeanRecords = field(default_factory=MeanRecords)
    triad: TriadData | None = None

    def result_fields(self, estimate: Estimate) -> Mapping[str, Any]:
        """Return the triad, and the rates of runs on the arm."""
        triad = self.triad.result(estimate, self.groups) if self.triad else None
        return {"triad": triad, "arm_rates": self.recorded.rates}

    def contributions(self, views: Sequence[AccelerometerView]) -> dict[str, Contribution]:
        """Return readings, test methods and undetected faults for the results of accelerometers."""
        comparisons, faults = compare_methods(views), find_undetected_faults(views)
        means = self.recorded.means
        return {
            view.name: Contribution(
                residual_view=comparisons[view.name].residual_view,
                findings=[
                    *comparisons[view.name].findings,
                    *record_outlier_findings(view.name, means),
                ],
                remarks=list(fault_remarks({view.name: faults[view.name]})),
                fields={
                    "readings": [
                        reading_result
                        for group in reading_groups(view)
                        for reading_result in reading_results(group, means)
                    ],
                    "kinds": comparisons[view.name].results,
                    "unseen_faults": faults[view.name],
                },
            )
            for view in views
        }

    def findings(self, view: AccelerometerView) -> list[Finding]:
        """Return the findings of tests of the residuals of readings and poses."""
        pose_findings = self.triad.findings(view.fit, pose_groups(view)) if self.triad else []
        return [*check_readings(view), *pose_findings]

    def remarks(self, views: Sequence[AccelerometerView]) -> Iterator[str]:
        """Yield remarks on noise, and on records without an angle."""
        yield from rounding_remarks(views)
        yield from overstated_noise_remarks(views, self.recorded.means)
        if self.recorded.without_angle:
            yield (
                f"The records of {', '.join(self.recorded.without_angle)} contain no angle, so "
                "counterspin averages over whole revolutions at the stated rate."
            )

    def advice(self, view: AccelerometerView, symbol: str) -> tuple[str, str]:
        """Return ``poses`` or ``records``, and advice on poses or on readings at rest."""
        if self.triad and pose_groups(view) and not reading_groups(view) and not view.has_records:
            return "poses", self.triad.advice(view)
        if is_only_at_rest(view.campaign) and symbol in ("K_F", "K_II", *SQUARE_TERMS):
            return "records", (
                " At 1 g, the squares of the specific force components add up to one, so no "
                "set of positions can determine K_F, K_II, K_PP and K_OO all at once. State "
                "priors for K_PP and K_OO, or test at other specific forces."
            )
        return "records", ""

    def fit_rotated_mounting(
        self,
        estimate: Estimate,
        groups: Sequence[FittedGroup],
        name: str,
        rotate: Callable[[Mounting], Mounting],
    ) -> tuple[JointFit, tuple[FittedGroup, ...]]:
        """Return the fit of groups and records with a rotated accelerometer."""
        rotated_groups: list[ReadingGroup] = []
        for fitted_group in groups:
            assert isinstance(fitted_group, FittedReadings)
            group = fitted_group.readings
            if not math.isinf(fitted_group.noise_dof):
                group = group.with_noise(fitted_group.noise)
            rotated_groups.append(group.with_rotated_mounting(name, rotate))
        if not rotated_groups:
            return estimate.fit, ()
        records = estimate if estimate.fit.design_blocks else None
        rotated_estimate, fitted_groups = estimate_with_groups(
            records, estimate.fit.model, rotated_groups
        )
        return rotated_estimate.fit, fitted_groups


def join_readings(problem: JointProblem) -> tuple[Estimate, ReadingsAndPoses]:
    """Return the estimate from all data of a campaign, and its readings and poses."""
    campaign = problem.campaign
    has_readings = campaign.readings or campaign.posed
    if not has_readings:
        joint_estimate = estimate(problem.series, problem.model, problem.noise)
        return joint_estimate, ReadingsAndPoses(triad=make_triad(campaign))
    record_estimate = None
    if problem.observed_runs:
        record_estimate = estimate(problem.series, problem.model, problem.noise)
    return estimate_with_readings(record_estimate, problem.model, campaign)


def estimate_with_readings(
    record_estimate: Estimate | None, model: Unknowns, campaign: Campaign
) -> tuple[Estimate, ReadingsAndPoses]:
    """Return the estimate with readings and poses of a campaign, and the fitted groups.

    record_estimate: From records; None if there are none.
    """
    _check_values(campaign)
    if record_estimate is None:
        _check_reading_count(campaign, model)
    readings, mean_records = average_records(campaign)
    triad = make_triad(campaign)
    groups = [*group_readings(campaign, readings), *(triad.groups() if triad else ())]
    joint_estimate, fitted_groups = estimate_with_groups(record_estimate, model, groups)
    return joint_estimate, ReadingsAndPoses(fitted_groups, mean_records, triad)


def make_triad(campaign: Campaign) -> TriadData | None:
    """Return the triad of a campaign with the poses in its records; None without a triad."""
    if campaign.triad is None:
        return None
    if not is_installed(TRIAD):
        raise CampaignError(
            str(campaign.path),
            ["triad: this installation does not support triads"],
            code="missing-package",
        )
    triad: TriadData = load_name(TRIAD)(campaign)
    return triad


def is_only_at_rest(campaign: Campaign) -> bool:
    """Return whether a campaign only has readings or poses at rest."""
    motions = {reading.motion for reading in campaign.readings}
    return motions <= {"static"} and not campaign.runs


def reading_results(
    fitted_group: FittedReadings, means: Mapping[tuple[str, str], RecordMean]
) -> list[ReadingResult]:
    """Return the results of the readings of a group."""
    group = fitted_group.readings
    assert isinstance(group, Readings)
    stations = group.stations
    arrays = (stations.axes, stations.rate, stations.amplitude, group.value)
    columns = (array.tolist() for array in (*arrays, fitted_group.sigma, fitted_group.residuals))
    rows = zip(group.names, group.mountings, fitted_group.single_readings, *columns, strict=True)
    return [
        ReadingResult(
            name=name,
            motion=group.motion,
            mounting=mounting,
            input_axis=tuple(axes[0]),
            pendulous_axis=tuple(axes[1]),
            rate=rate,
            amplitude=amplitude or None,
            value=value,
            u=u,
            residual=residual,
            z=None if math.isnan(position.standardized) else position.standardized,
            **_record_fields(means.get((group.accelerometer, name))),
        )
        for name, mounting, position, axes, rate, amplitude, value, u, residual in rows
    ]


def _record_fields(mean: RecordMean | None) -> dict[str, Any]:
    """Return the fields of a result that describe the averaged record of a reading."""
    if mean is None:
        return {}
    report = mean.report
    return {"samples": mean.samples, "counts": report.counts(), "notes": report.notes()}


def estimate_with_groups(
    record_estimate: Estimate | None, model: Unknowns, groups: Sequence[ReadingGroup]
) -> tuple[Estimate, tuple[FittedReadings, ...]]:
    """Return the estimate with groups of readings and poses, and the fitted groups.

    record_estimate: From records; None if there are none.
    """
    if record_estimate is None:
        readings_fit = solve_readings(groups, model)
        record_estimate = Estimate(readings_fit.fit, {}, np.full(len(model.unknowns), np.inf))
    else:
        readings_fit = solve_readings(groups, record_estimate.fit.model, record_estimate.fit)
    dof = _effective_dof(record_estimate.dof, readings_fit)
    return replace(
        record_estimate, fit=readings_fit.fit, dof=dof, compressed_fit=None, information_losses={}
    ), readings_fit.groups


def _check_reading_count(campaign: Campaign, model: Unknowns) -> None:
    """Raise if an accelerometer has fewer readings than coefficients without a prior."""
    pose_accelerometers = campaign.triad.accelerometers if campaign.triad and campaign.posed else ()
    for name in campaign.accelerometers:
        if name in pose_accelerometers:
            continue
        count = sum(reading.accelerometer == name for reading in campaign.readings)
        own_unknowns = [unknown for unknown in model.unknowns if unknown.owner == name]
        free_symbols = [u.symbol for u in own_unknowns if math.isinf(u.prior[1])]
        if count < len(free_symbols):
            count_text = f"{count} readings" if count != 1 else "1 reading"
            raise NotIdentifiableError(
                f"{campaign.path}: {count_text} of {name} cannot determine {len(free_symbols)} "
                f"coefficients ({', '.join(free_symbols)}); add positions, reduce model.terms, "
                "or state priors"
            )


def _effective_dof(dof: np.ndarray, fit: ReadingsFit) -> np.ndarray:
    """Return the degrees of freedom of each unknown with the estimated noise of readings.

    They are Satterthwaite's, or fewer if few readings determine a noise, so that the intervals have
    their coverage. The noise of records keeps its own degrees of freedom.
    """
    noise_dofs = [group.noise_dof for group in fit.groups]
    record_dofs = dof if fit.fit.design_blocks else np.full(dof.size, math.inf)
    unit_vectors = zip(np.eye(dof.size), record_dofs.tolist(), strict=True)
    return np.array(
        [
            combination_dof(weights, fit.fit, noise_dofs, record_dof)
            for weights, record_dof in unit_vectors
        ]
    )


def combination_dof(
    weights: np.ndarray, fit: JointFit, reading_dofs: Sequence[float], record_dof: float
) -> float:
    """Return the degrees of freedom of a combination of the unknowns.

    reading_dofs: Degrees of freedom of the noise of readings and poses, in the order of the fit.
    record_dof: Degrees of freedom of the noise of records.
    """
    combination = fit.solution.combine(weights)
    rows, variance = combination.noise_rows, float(weights @ fit.solution.covariance @ weights)
    block_sizes = [block.factor.shape[0] for block in fit.blocks[len(fit.design_blocks) :]]
    block_ends = np.cumsum([rows.size - sum(block_sizes), *block_sizes])
    dofs = (record_dof, *reading_dofs)
    inverse_dof = 0.0
    for block_rows, noise_dof in zip(np.split(rows, block_ends[:-1]), dofs, strict=True):
        inverse_dof += 1.0 / mixture_dof(_variance_share(block_rows, variance), noise_dof)
    return 1.0 / inverse_dof if inverse_dof > 0.0 else math.inf


def _variance_share(rows: np.ndarray, total_variance: float) -> float:
    return min(float(rows @ rows) / total_variance, 1.0) if total_variance > 0.0 else 0.0


def _check_values(campaign: Campaign) -> None:
    empty_names = [reading.name for reading in campaign.all_readings if math.isnan(reading.value)]
    if empty_names:
        n_others = len(empty_names) - 1
        subject = {
            0: f'"{empty_names[0]}" has',
            1: f'"{empty_names[0]}" and another reading have',
        }.get(n_others, f'"{empty_names[0]}" and {n_others} other readings have')
        raise CampaignError(
            str(campaign.path),
            [
                f"{subject} no value yet: enter the missing values, or simulate them from [truth] "
                "with `counterspin simulate`"
            ],
            code="missing-value",
        )
