"""Readings of a campaign in the joint fit: at rest, on an arm, on a double turntable, in poses."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import field, replace
from typing import Any

import numpy as np

from counterspin.arrays import median
from counterspin.calibration.mean_records import MeanRecords, average_records
from counterspin.calibration.result_parts import (
    Coefficient,
    NoiseLine,
    ReadingResult,
    Residual,
)
from counterspin.campaign.conditions import groups_of, origin_of, poses_together
from counterspin.campaign.description import Campaign
from counterspin.campaign.readings import Reading
from counterspin.campaign.triad import PoseRecord
from counterspin.errors import CampaignError, NotIdentifiableError
from counterspin.frozen import frozen
from counterspin.inference.distributions import chi_square_tail, dof_beside
from counterspin.inference.fitted_readings import FittedReadings
from counterspin.inference.joint.estimation import Estimate
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.unknowns import Unknown, Unknowns
from counterspin.inference.linear_readings import Readings
from counterspin.inference.poses import TriadPoses
from counterspin.inference.readings import ReadingsFit, solve_readings
from counterspin.records.averages import RecordMean
from counterspin.records.poses import Poses, read_poses
from counterspin.records.record import ColumnSpec, RecordColumns, RecordReport


def only_at_rest(campaign: Campaign) -> bool:
    """Return whether readings at rest are all that a campaign has, poses among them."""
    motions = {reading.motion for reading in campaign.readings}
    return motions <= {"static"} and not campaign.runs


@frozen(eq=False)
class ReadingsAndPoses:
    """Readings and poses of a campaign, and what was found in their records."""

    parts: tuple[FittedReadings, ...] = ()  #: How they fit.
    recorded: MeanRecords = field(default_factory=MeanRecords)  #: Records whose means are readings.
    #: By name, where each pose was found.
    poses: Mapping[str, FoundPose] = field(default_factory=dict)


def with_readings(
    estimated: Estimate | None, model: Unknowns, campaign: Campaign
) -> tuple[Estimate, ReadingsAndPoses]:
    """Return the estimate with the campaign's readings and poses, and how these fit.

    estimated: From records; None if there are none.
    """
    _require_values(campaign)
    if estimated is None:
        _require_enough(campaign, model)
    (taken, recorded), posed = average_records(campaign), poses_of(campaign)
    groups: list[Readings | TriadPoses] = [*groups_of(campaign, taken)]
    if posed:
        groups += poses_together(
            campaign, [one.pose for one in posed], noise_within(posed, campaign.gravity.value)
        )
    estimated, parts = with_groups(estimated, model, groups)
    found = {one.pose[0].name: one for one in posed}
    return estimated, ReadingsAndPoses(parts, recorded, found)


def with_groups(
    estimated: Estimate | None, model: Unknowns, groups: Sequence[Readings | TriadPoses]
) -> tuple[Estimate, tuple[FittedReadings, ...]]:
    """Return the estimate with readings in groups; as `with_readings`."""
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
    own = [group.dof for group in fit.groups]
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
    """Return what a result states of the record that a reading is the mean of."""
    if mean is None:
        return {}
    report = mean.report
    return {"samples": mean.samples, "counts": report.counts(), "notes": report.notes()}


def residual_of(parts: Sequence[FittedReadings]) -> Residual:
    """Return the size of the residuals of readings, and how well the model fits them."""
    left = np.concatenate([part.residuals for part in parts])
    stated = [part for part in parts if math.isinf(part.dof)]
    chi2 = sum(part.squares for part in stated)
    freedom = sum(part.freedom for part in stated)
    testable = len(stated) == len(parts) and freedom > 0.5
    return Residual(
        rms=float(np.sqrt(np.mean(left**2))),
        unit="g",
        dof=round(sum(part.freedom for part in parts), 9),  # of as many readings as unknowns: 0
        chi2=chi2 if testable else None,
        lack_of_fit_p=chi_square_tail(freedom, chi2) if testable else None,
    )


def readings_noise(parts: Sequence[FittedReadings]) -> dict[str, NoiseLine]:
    """Return the noise of readings, motion by motion."""
    return {
        part.words: NoiseLine(
            value=median(part.sigma),
            u=median(part.sigma) / math.sqrt(2.0 * part.dof) if math.isfinite(part.dof) else None,
            unit="g",
            estimated=math.isfinite(part.dof),
        )
        for part in parts
    }


def radii(campaign: Campaign, shared: Mapping[Unknown, Coefficient]) -> dict[Unknown, Coefficient]:
    """Return the radii of mountings as such; the fit has their deviations from the machine's."""
    return {
        unknown: c.model_copy(update={"value": c.value + campaign.radius.value})
        for unknown, c in shared.items()
        if unknown.symbol.startswith("centrifuge.radius.") and c.value is not None
    }


def in_output_units(
    campaign: Campaign, name: str, own: dict[str, Coefficient]
) -> dict[str, Coefficient]:
    """Return bias and scale factor in what the readings are in; empty where that is g."""
    output = campaign.accelerometers[name].output
    if output is None:
        return {}
    shown, size = {}, output.sensitivity
    for symbol, key, unit, zero in (
        ("K_F", "bias", output.unit, output.zero),
        ("K_I", "scale_factor", f"{output.unit}/g", 0.0),
    ):
        c = own.get(symbol)
        if c is None or c.value is None or c.u is None:
            continue
        value, u = zero + c.value * size, c.u * abs(size)
        shown[key] = Coefficient(value=value, u=u, dof=c.dof, unit=unit, estimated=c.estimated)
    return shown


@frozen(eq=False)
class RecordOfPoses:
    """A record with poses in it, and what was found."""

    name: str  #: Of the run.
    poses: Poses  #: Where the triad lay still; forces in m/s^2.
    report: RecordReport  #: What the reading found.


@frozen(eq=False)
class FoundPose:
    """A pose: the readings of all three, and where it was found."""

    pose: tuple[Reading, ...]  #: In the order of the triad's accelerometers.
    record: RecordOfPoses | None = None  #: The record that it was found in; None: it was read.
    place: int = 0  #: Among the poses of the record.

    @property
    def noise_within(self) -> float:
        """What the means of a record's rows scatter by, if each row is by itself, m/s^2."""
        if self.record is None:
            return 0.0
        found = self.record.poses
        return float(np.sqrt(np.mean(found.scatter[self.place] ** 2) / found.count[self.place]))


def poses_of(campaign: Campaign) -> list[FoundPose]:
    """Return every pose of a campaign's triad."""
    if campaign.triad is None:
        return []
    read = [FoundPose(pose) for pose in campaign.triad.poses]
    return [
        *read,
        *(one for record in campaign.triad.records for one in found_in(campaign, record)),
    ]


def noise_within(poses: Sequence[FoundPose], gravity: float) -> float:
    """Return what is known of the noise from within poses that were found in records, g."""
    within = [one.noise_within for one in poses if one.record is not None]
    return math.sqrt(sum(size**2 for size in within) / len(within)) / gravity if within else 0.0


def columns_of_poses(campaign: Campaign) -> RecordColumns:
    """Return the columns of records with poses, and how their files are written."""
    return RecordColumns(campaign.time, None, _channels(campaign), campaign.dialect)


def _channels(campaign: Campaign) -> dict[str, ColumnSpec]:
    """Return the columns of specific force of a triad's accelerometers."""
    names = campaign.triad.accelerometers if campaign.triad else ()
    forces = {name: campaign.accelerometers[name].force for name in names}
    return {name: force for name, force in forces.items() if force is not None}


def found_in(campaign: Campaign, record: PoseRecord) -> Iterator[FoundPose]:
    """Yield the poses of a record, each with its means as readings."""
    g, source = campaign.gravity.value, campaign.record_at(record.record)
    # Within a record times are known, from its first row, whether or not it says when it began.
    begun = origin_of(campaign).time if record.time is None else record.time
    in_si = {name: not channel.in_g for name, channel in _channels(campaign).items()}
    found, read = read_poses(source, columns_of_poses(campaign), record.rest, record.threshold)
    whole = RecordOfPoses(record.name, found, read.report)
    warm, middles = record.temperature, 0.5 * (found.start + found.end)
    knots = np.linspace(found.time[0], found.time[-1], len(warm or ()))
    every = zip(found.start, middles, found.mean / g, strict=True)
    for place, (start, middle, mean) in enumerate(every):
        pose = tuple(
            Reading(
                name=f"{record.name} {start:.6g} s",
                accelerometer=name,
                motion="static",
                mounting="",
                axes=campaign.accelerometers[name].mounting,
                rate=0.0,
                value=float(value),
                u=None if record.u is None else record.u / g,
                head=(0.0, 0.0, 0.0),
                u_head=0.0,
                temperature=warm and (float(np.interp(middle, knots, warm)),),
                time=begun + float(start - found.time[0]),
                in_si=si,
            )
            for (name, si), value in zip(in_si.items(), mean, strict=True)
        )
        yield FoundPose(pose, whole, place)
