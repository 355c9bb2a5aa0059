"""Readings of a campaign in the joint fit: at rest, on an arm, on a double turntable, in poses."""

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
from counterspin.calibration.model import SQUARES
from counterspin.calibration.result_parts import Finding, ReadingResult, TriadResult
from counterspin.campaign.description import Campaign
from counterspin.errors import CampaignError, NotIdentifiableError
from counterspin.frozen import frozen
from counterspin.inference.combined_distribution import dof_beside
from counterspin.inference.joint.estimation import Estimate, estimate
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.loading import is_installed, load_name
from counterspin.physics.accelerometer import Mounting
from counterspin.readings.checks import (
    no_more_than_rounded,
    outliers_of_means,
    overstated_noise,
    readings_fit,
)
from counterspin.readings.fit import ReadingsFit, solve_readings
from counterspin.readings.fitted import FittedReadings
from counterspin.readings.groups import groups_of
from counterspin.readings.known_attitudes import Readings
from counterspin.readings.linear import Measured
from counterspin.readings.mean_records import MeanRecords, average_records
from counterspin.readings.means import RecordMean
from counterspin.readings.methods import compare_methods
from counterspin.readings.parts import poses_of, readings_of
from counterspin.readings.unseen_faults import remarks_of, unseen_faults

#: Poses of a triad, loaded for a campaign that has one: signature of `TriadData`.
TRIAD: Final = "counterspin.triads.joining:TriadInFit"


class TriadData(Protocol):
    """Poses of a campaign's triad, and the triad's part of the result."""

    def groups(self) -> Sequence[Measured]:
        """Return the poses in groups with noise of one kind."""

    def findings(self, fit: JointFit, posed: Sequence[FittedReadings]) -> list[Finding]:
        """Return the findings of tests of the residuals of poses."""

    def advice(self, view: AccelerometerView) -> str:
        """Return the poses that would determine more of an accelerometer with poses only."""

    def result(self, estimated: Estimate, parts: Sequence[FittedReadings]) -> TriadResult:
        """Return the triad as the result states it."""


@frozen(eq=False)
class ReadingsAndPoses(ReadingData):
    """Readings and poses of a campaign in a fit, and the records that they are means of."""

    groups: tuple[FittedReadings, ...] = ()  #: With noise of one kind each.
    recorded: MeanRecords = field(default_factory=MeanRecords)
    triad: TriadData | None = None

    def fields(self, estimate: Estimate) -> Mapping[str, Any]:
        """Return the triad, and the rates of runs on the arm."""
        triad = self.triad.result(estimate, self.groups) if self.triad else None
        return {"triad": triad, "arm_rates": self.recorded.rates}

    def contributions(self, views: Sequence[AccelerometerView]) -> dict[str, Contribution]:
        """Return readings, test methods and unseen faults for the results of accelerometers."""
        compared, faults = compare_methods(views), unseen_faults(views)
        means = self.recorded.means
        return {
            view.name: Contribution(
                residual_view=compared[view.name].residual_view,
                findings=[*compared[view.name].findings, *outliers_of_means(view.name, means)],
                remarks=list(remarks_of({view.name: faults[view.name]})),
                fields={
                    "readings": [r for part in readings_of(view) for r in results_of(part, means)],
                    "kinds": compared[view.name].results,
                    "unseen_faults": faults[view.name],
                },
            )
            for view in views
        }

    def findings(self, view: AccelerometerView) -> list[Finding]:
        """Return the findings of tests of the residuals of readings and poses."""
        posed = self.triad.findings(view.fit, poses_of(view)) if self.triad else []
        return [*readings_fit(view), *posed]

    def remarks(self, views: Sequence[AccelerometerView]) -> Iterator[str]:
        """Yield remarks on the noise, and on records without an angle."""
        yield from no_more_than_rounded(views)
        yield from overstated_noise(views)
        if self.recorded.without_angle:
            yield (
                f"The records of {', '.join(self.recorded.without_angle)} have no angle: the mean "
                "is that over whole revolutions at the stated rate."
            )

    def advice(self, view: AccelerometerView, symbol: str) -> tuple[str, str]:
        """Return poses or records, and advice on poses, or on readings at rest only."""
        if self.triad and poses_of(view) and not readings_of(view) and not view.has_records:
            return "poses", self.triad.advice(view)
        if only_at_rest(view.campaign) and symbol in ("K_F", "K_II", *SQUARES):
            return "records", (
                " At 1 g the squares of the specific forces add up to one, so that no set of "
                "positions separates K_II, K_PP and K_OO together from K_F: state what is known "
                "of K_PP and K_OO, or test at other forces."
            )
        return "records", ""

    def fit_rotated_mounting(
        self,
        estimate: Estimate,
        parts: Sequence[FittedGroup],
        name: str,
        turn: Callable[[Mounting], Mounting],
    ) -> tuple[JointFit, tuple[FittedGroup, ...]]:
        """Return the fit of groups with an accelerometer mounted otherwise, beside records."""
        groups: list[Measured] = []
        for part in parts:
            assert isinstance(part, FittedReadings)
            group = part.readings
            if not math.isinf(part.noise_dof):
                group = group.with_noise(part.noise)
            groups.append(group.turned_about(name, turn))
        if not groups:
            return estimate.fit, ()
        records = estimate if estimate.fit.prepared else None
        joined, fitted = with_groups(records, estimate.fit.model, groups)
        return joined.fit, fitted


def join(problem: JointProblem) -> tuple[Estimate, ReadingsAndPoses]:
    """Return the estimate from all data of a campaign, with its readings and poses in it."""
    campaign = problem.campaign
    read = campaign.readings or campaign.posed
    if not read:
        records = estimate(problem.series, problem.model, problem.noise)
        return records, ReadingsAndPoses(triad=triad_of(campaign))
    from_records = None
    if problem.observed:
        from_records = estimate(problem.series, problem.model, problem.noise)
    return with_readings(from_records, problem.model, campaign)


def with_readings(
    estimated: Estimate | None, model: Unknowns, campaign: Campaign
) -> tuple[Estimate, ReadingsAndPoses]:
    """Return the estimate with the campaign's readings and poses, and how these fit.

    estimated: From records; None if there are none.
    """
    _require_values(campaign)
    if estimated is None:
        _require_enough(campaign, model)
    taken, recorded = average_records(campaign)
    triad = triad_of(campaign)
    groups = [*groups_of(campaign, taken), *(triad.groups() if triad else ())]
    estimated, parts = with_groups(estimated, model, groups)
    return estimated, ReadingsAndPoses(parts, recorded, triad)


def triad_of(campaign: Campaign) -> TriadData | None:
    """Return the triad of a campaign with the poses in its records; None: it has no triad."""
    if campaign.triad is None:
        return None
    if not is_installed(TRIAD):
        raise CampaignError(str(campaign.path), ["triad: this installation has no triads"])
    triad: TriadData = load_name(TRIAD)(campaign)
    return triad


def only_at_rest(campaign: Campaign) -> bool:
    """Return whether readings at rest are all that a campaign has, poses among them."""
    motions = {reading.motion for reading in campaign.readings}
    return motions <= {"static"} and not campaign.runs


def results_of(
    part: FittedReadings, means: Mapping[tuple[str, str], RecordMean]
) -> list[ReadingResult]:
    """Return each reading as a result shows it."""
    group = part.readings
    assert isinstance(group, Readings)
    return [
        ReadingResult(
            name=name,
            motion=group.motion,
            mounting=group.mountings[i],
            input_axis=tuple(map(float, station.mounting.matrix[0])),
            pendulous_axis=tuple(map(float, station.mounting.matrix[1])),
            rate=station.rate,
            value=float(group.value[i]),
            u=float(part.sigma[i]),
            residual=float(part.residuals[i]),
            z=None if math.isnan(part.single[i].standardised) else part.single[i].standardised,
            **_found_in(means.get((group.accelerometer, name))),
        )
        for i, (name, station) in enumerate(zip(group.names, group.stations, strict=True))
    ]


def _found_in(mean: RecordMean | None) -> dict[str, Any]:
    """Return the fields of a result that describe the record averaged in a reading."""
    if mean is None:
        return {}
    report = mean.report
    return {"samples": mean.samples, "counts": report.counts(), "notes": report.notes()}


def with_groups(
    estimated: Estimate | None, model: Unknowns, groups: Sequence[Measured]
) -> tuple[Estimate, tuple[FittedReadings, ...]]:
    """Return the estimate with readings and poses, and how these fit.

    estimated: From records; None if there are none.
    """
    if estimated is None:
        fit = solve_readings(groups, model)
        estimated = Estimate(fit.fit, {}, np.full(len(model.unknowns), np.inf))
    else:
        fit = solve_readings(groups, estimated.fit.model, estimated.fit)
    dof = _effective_dof(estimated.dof, fit)
    return replace(estimated, fit=fit.fit, dof=dof, core=None, lost={}), fit.groups


def _require_enough(campaign: Campaign, model: Unknowns) -> None:
    """Refuse fewer readings of an accelerometer than coefficients of which nothing is known."""
    posed = campaign.triad.accelerometers if campaign.triad and campaign.posed else ()
    for name in campaign.accelerometers:
        if name in posed:
            continue
        count = sum(reading.accelerometer == name for reading in campaign.readings)
        free = [u.symbol for u in model.unknowns if u.owner == name and math.isinf(u.prior[1])]
        if count < len(free):
            have = f"{count} readings" if count != 1 else "1 reading"
            raise NotIdentifiableError(
                f"{campaign.path}: {have} of {name} cannot determine {len(free)} coefficients "
                f"({', '.join(free)}); add positions, reduce model.terms, "
                "or give priors"
            )


def _effective_dof(dof: np.ndarray, fit: ReadingsFit) -> np.ndarray:
    """Return the degrees of freedom of each unknown with the readings' estimated noise counted.

    Satterthwaite's, or fewer where few readings tell a noise, so that the intervals cover. What the
    records' noise adds keeps the records' own degrees of freedom.
    """
    own = [group.noise_dof for group in fit.groups]
    of_records = dof if fit.fit.prepared else np.full(dof.size, math.inf)
    every = zip(np.eye(dof.size), of_records.tolist(), strict=True)
    return np.array([dof_of(weights, fit.fit, own, beside) for weights, beside in every])


def dof_of(weights: np.ndarray, fit: JointFit, dof: Sequence[float], of_records: float) -> float:
    """Return the degrees of freedom of a combination of the unknowns.

    dof: Of the noise of readings and poses, in the order of the fit.
    of_records: What records' noise has in it.
    """
    combined = fit.solution.combine(weights)
    rows, total = combined.noise_rows, float(weights @ fit.solution.covariance @ weights)
    sizes = [block.factor.shape[0] for block in fit.blocks[len(fit.prepared) :]]
    ends = np.cumsum([rows.size - sum(sizes), *sizes])
    inverse = 1.0 / dof_beside(_share(rows[: ends[0]], total), of_records)
    for part, own in zip(np.split(rows, ends[:-1])[1:], dof, strict=True):
        inverse += 1.0 / dof_beside(_share(part, total), own)
    return 1.0 / inverse if inverse > 0.0 else math.inf


def _share(rows: np.ndarray, total: float) -> float:
    return min(float(rows @ rows) / total, 1.0) if total > 0.0 else 0.0


def _require_values(campaign: Campaign) -> None:
    blank = [reading.name for reading in campaign.all_readings if math.isnan(reading.value)]
    if blank:
        raise CampaignError(
            str(campaign.path),
            [
                f'"{blank[0]}" and {len(blank) - 1} other readings have no value yet: enter '
                "the readings, or simulate them from [truth] with `counterspin simulate`"
            ],
        )
