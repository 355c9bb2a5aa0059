"""Readings of a campaign in the joint fit: at rest, on an arm, on a double turntable.

- `with_readings`: an estimate from records, if there are any, with the readings beside them
- `machine_of`: the machine's terms as unknowns and considered terms
- `groups_of`, `block_name`: the readings that have one noise, and what they are called in a budget
- `AccelerometerReadings`: what was read of one accelerometer, and how it fits
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from counterspin.calibration.findings import CONTRADICTS, lack_of_fit
from counterspin.calibration.result_parts import (
    Coefficient,
    Finding,
    NoiseLine,
    ReadingResult,
    Residual,
)
from counterspin.campaign.readings import Reading
from counterspin.campaign.resolved import Campaign
from counterspin.inference.diagnostics import SIGNIFICANCE
from counterspin.inference.distributions import chi_square_tail, student_cdf
from counterspin.inference.joint.estimation import Estimate
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.unknowns import Considered, Unknown, Unknowns
from counterspin.inference.readings import Readings, ReadingsFit, solve_readings
from counterspin.physics.accelerometer import TERMS
from counterspin.physics.machine import machine_term
from counterspin.physics.station import Station
from counterspin.records.mean import mean_of_record
from counterspin.records.record import ColumnSpec

#: Terms that no position at 1 g tells from K_II and K_F: the squares' sum is that of gravity.
_SQUARES: Final = ("K_PP", "K_OO")

#: Words for the motions.
_WORDS: Final = {
    "static": "readings at rest",
    "arm": "readings on the arm",
    "counter-rotating": "readings on the double turntable",
}


def machine_of(campaign: Campaign) -> tuple[list[Unknown], list[Considered]]:
    """Return what a campaign with readings estimates and considers beside the usual terms."""
    machine = campaign.machine
    unknowns = [
        Unknown(owner, symbol, machine.prior(symbol), _limit(symbol))
        for symbol in machine.terms
        for owner in _owners(campaign, symbol)
    ]
    considered = [
        Considered(owner, symbol, machine.prior(symbol), _limit(symbol))
        for symbol in machine.considered
        for owner in _owners(campaign, symbol)
    ]
    at_rest = all(reading.motion == "static" for reading in campaign.readings)
    if campaign.readings and not campaign.runs and at_rest and "K_II" in campaign.model.terms:
        named = {*campaign.model.terms, *campaign.model.considered}
        considered += [
            Considered(name, symbol, (0.0, TERMS[symbol].limit), TERMS[symbol].limit)
            for name, accelerometer in campaign.accelerometers.items()
            for symbol in _SQUARES
            if symbol not in named and symbol not in accelerometer.priors
        ]
    return unknowns, considered


def _owners(campaign: Campaign, symbol: str) -> list[str]:
    row, _ = machine_term(symbol) or (None, "")
    return list(campaign.accelerometers) if row is not None and row.of_accelerometer else [""]


def _limit(symbol: str) -> float:
    row, _ = machine_term(symbol) or (None, "")
    assert row is not None
    return row.limit


@dataclass(frozen=True)
class AccelerometerReadings:
    """The readings of one accelerometer in one motion, and how they fit.

    Attributes
    ----------
    readings
        What was read.
    sigma, residuals, standardised
        As of `ReadingsFit`, shape (n,).
    dof
        Of an estimated noise; infinite where it was stated.
    freedom
        Readings less what the fit follows of them.
    """

    readings: Readings
    sigma: np.ndarray
    residuals: np.ndarray
    standardised: np.ndarray
    dof: float
    freedom: float

    @property
    def words(self) -> str:
        """What these readings are called."""
        return _WORDS[self.readings.motion]

    def results(self) -> list[ReadingResult]:
        """Return each reading as a result shows it."""
        return [
            ReadingResult(
                name=name,
                motion=self.readings.motion,
                rate=station.rate,
                value=float(self.readings.value[i]),
                u=float(self.sigma[i]),
                residual=float(self.residuals[i]),
                z=float(self.standardised[i]) if math.isfinite(self.standardised[i]) else None,
            )
            for i, (name, station) in enumerate(
                zip(self.readings.names, self.readings.stations, strict=True)
            )
        ]

    def outlying(self) -> list[tuple[str, float, float]]:
        """Return name, residual (g) and standardised residual of readings that noise leaves open.

        Each is compared with the noise of the others (externally studentised), at the level of
        the other tests shared out among the readings.
        """
        z, dof = self.standardised, self.dof
        if math.isfinite(dof):
            with np.errstate(divide="ignore", invalid="ignore"):
                z = np.where(z**2 < dof, z * np.sqrt((dof - 1.0) / (dof - z**2)), np.inf * z)
        others = max(dof - 1.0, 1.0)
        p = np.array([2.0 * student_cdf(others, -abs(size)) for size in z.tolist()])
        return [
            (self.readings.names[i], float(self.residuals[i]), float(z[i]))
            for i in np.flatnonzero(p < SIGNIFICANCE / z.size)
        ]


def with_readings(
    estimated: Estimate | None, model: Unknowns, campaign: Campaign
) -> tuple[Estimate, tuple[AccelerometerReadings, ...]]:
    """Return the estimate with the campaign's readings, and how these fit.

    Parameters
    ----------
    estimated
        From records; None if there are none.
    model
        What is estimated and considered, where there are no records.
    campaign
        The description.

    Raises
    ------
    NotIdentifiableError, ConvergenceError
        As `solve_readings`.
    """
    groups = groups_of(campaign, [_averaged(campaign, reading) for reading in campaign.readings])
    if estimated is None:
        beside: tuple[object, ...] = ()
        fit = solve_readings(groups, model)
        joint = JointFit(model, fit.solution, (), (), {})
        dof = np.full(len(model.unknowns), np.inf)
        estimated = Estimate(joint, {}, dof)
    else:
        beside = estimated.fit.blocks
        fit = solve_readings(groups, estimated.fit.model, estimated.fit.blocks)
    before = estimated.fit.solution
    solution = replace(fit.solution, covariance_unseen=before.covariance_unseen)
    named = dict(zip(map(block_name, groups), fit.blocks, strict=True))
    joint = replace(estimated.fit, solution=solution, beside=named)
    dof = _effective_dof(estimated.dof, fit, len(beside))
    parts = tuple(
        AccelerometerReadings(*part)
        for part in zip(
            groups, fit.sigma, fit.residuals, fit.standardised, fit.dof, fit.freedom, strict=True
        )
    )
    return replace(estimated, fit=joint, dof=dof), parts


def _effective_dof(dof: np.ndarray, fit: ReadingsFit, records: int) -> np.ndarray:
    """Return Satterthwaite's degrees of freedom with the readings' estimated noise counted.

    What the records' noise adds keeps the records' own degrees of freedom.
    """
    solution = fit.solution
    total = np.diag(solution.covariance)
    inverse = np.zeros(total.size)
    for k in range(total.size):
        weights = np.zeros(total.size)
        weights[k] = 1.0
        rows = solution.combine(weights).noise_rows
        sizes = [block.factor.shape[0] for block in fit.blocks]
        ends = np.cumsum([rows.size - sum(sizes), *sizes])
        for part, freedom in zip(np.split(rows, ends[:-1])[1:], fit.dof, strict=True):
            inverse[k] += float(part @ part) ** 2 / freedom
        of_records = rows[: ends[0]]
        if records:
            inverse[k] += float(of_records @ of_records) ** 2 / dof[k]
        inverse[k] /= total[k] ** 2 if total[k] > 0.0 else 1.0
    with np.errstate(divide="ignore"):
        return 1.0 / inverse


def _averaged(campaign: Campaign, reading: Reading) -> Reading:
    """Return a reading with its value: that of a record is its mean over whole revolutions."""
    if reading.record is None:
        return reading
    channel = campaign.accelerometers[reading.accelerometer].channel
    mean = mean_of_record(
        reading.record,
        ColumnSpec(campaign.time.column, campaign.time.factor),
        ColumnSpec(channel.column, channel.factor),
        reading.rate,
    )
    g = campaign.gravity.value
    return replace(reading, value=mean.value / g, u=mean.u / g)


def block_name(group: Readings) -> str:
    """Return what a group of readings is called in a budget."""
    estimated = "" if group.u is not None else " (noise estimated)"
    return f"{group.accelerometer}: {_WORDS[group.motion]}{estimated}"


def groups_of(campaign: Campaign, readings: Sequence[Reading]) -> list[Readings]:
    """Return the readings by accelerometer, motion and whether their noise was stated."""
    keys = dict.fromkeys((r.accelerometer, r.motion, r.u is None) for r in readings)
    return [
        _group(
            campaign,
            [r for r in readings if (r.accelerometer, r.motion, r.u is None) == key],
        )
        for key in keys
    ]


def _group(campaign: Campaign, readings: Sequence[Reading]) -> Readings:
    first = readings[0]
    every = [r.temperature for r in campaign.readings if r.temperature is not None]
    reference = campaign.reference_temperature
    if reference is None:
        reference = float(np.mean(every)) if every else 0.0
    start = min((r.time for r in campaign.readings if r.time is not None), default=0.0)
    return Readings(
        accelerometer=first.accelerometer,
        motion=first.motion,
        names=tuple(r.name for r in readings),
        site=campaign.site,
        stations=tuple(
            Station(r.motion, r.axes, rate=r.rate, radius=campaign.radius.value if r.rate else 0.0)
            for r in readings
        ),
        mountings=tuple(r.mounting for r in readings),
        head=np.array([r.head for r in readings]),
        u_head=np.array([r.u_head for r in readings]),
        value=np.array([r.value for r in readings]),
        u=None if first.u is None else np.array([r.u for r in readings], dtype=float),
        temperature=np.array([(r.temperature or reference) - reference for r in readings]),
        time=np.array([(r.time or start) - start for r in readings]),
    )


def residual_of(parts: Sequence[AccelerometerReadings]) -> Residual:
    """Return the size of the residuals of readings, and how well the model fits them."""
    left = np.concatenate([part.residuals for part in parts])
    stated = [part for part in parts if math.isinf(part.dof)]
    chi2 = sum(float(np.sum((part.residuals / part.sigma) ** 2)) for part in stated)
    freedom = sum(part.freedom for part in stated)
    judged = len(stated) == len(parts) and freedom > 0.5
    return Residual(
        rms=float(np.sqrt(np.mean(left**2))),
        unit="g",
        dof=sum(part.freedom for part in parts),
        chi2=chi2 if judged else None,
        lack_of_fit_p=chi_square_tail(freedom, chi2) if judged else None,
    )


def readings_noise(parts: Sequence[AccelerometerReadings]) -> dict[str, NoiseLine]:
    """Return the noise of readings, motion by motion."""
    return {
        part.words: NoiseLine(
            value=float(np.median(part.sigma)),
            u=float(np.median(part.sigma)) / math.sqrt(2.0 * part.dof)
            if math.isfinite(part.dof)
            else None,
            unit="g",
            estimated=math.isfinite(part.dof),
        )
        for part in parts
    }


def readings_fit(name: str, residual: Residual) -> list[Finding]:
    """Return a finding where residuals of readings are not the noise that was stated."""
    p = residual.lack_of_fit_p
    if p is None or p >= SIGNIFICANCE:
        return []
    return [
        lack_of_fit(
            name,
            [f"the residuals of the readings are not the noise that was stated (p = {p:.2g})"],
            residual,
        )
    ]


def outlying_readings(name: str, parts: Sequence[AccelerometerReadings]) -> list[Finding]:
    """Return a finding for each reading that stands out."""
    return [
        Finding(
            code="outlying-reading",
            subject=f"{name}.{reading}",
            text=f'The reading "{reading}" is {residual * 1e6:+.3g} ug off the model, '
            f"{abs(z):.1f} of its standard deviations: look at this position, or at what the "
            "model lacks.",
            size=abs(z),
            contradicts=abs(z) > CONTRADICTS and math.isinf(part.dof),
        )
        for part in parts
        for reading, residual, z in part.outlying()
    ]


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
    shown = {}
    for symbol, key, unit in (
        ("K_F", "bias", output.unit),
        ("K_I", "scale_factor", f"{output.unit}/g"),
    ):
        c = own.get(symbol)
        if c is None or c.value is None or c.u is None:
            continue
        size = output.sensitivity
        shown[key] = Coefficient(
            value=c.value * size, u=c.u * abs(size), dof=c.dof, unit=unit, estimated=c.estimated
        )
    return shown
