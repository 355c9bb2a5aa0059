"""Predict the result of a campaign's calibration from its description, without records.

The same columns, whitening, priors and solve as the calibration's, on the times at which the
records will be sampled. Only the errors are missing, and the covariance does not need them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.model import make_unknowns
from counterspin.campaign.conditions import run_conditions
from counterspin.campaign.description import Campaign, read_campaign
from counterspin.campaign.runs import Run, sample_count
from counterspin.campaign.static_noise import resolve_noise, simulated_noise
from counterspin.errors import CampaignError
from counterspin.frozen import frozen
from counterspin.inference.identifiability import Assessment
from counterspin.inference.joint.design_blocks import build_design_blocks
from counterspin.inference.joint.encoder import add_encoder_terms
from counterspin.inference.joint.estimation import Estimate
from counterspin.inference.joint.fit import JointFit, solve_joint
from counterspin.inference.joint.series import ResidualSeries, TimestampErrors
from counterspin.inference.joint.unknowns import Unknown, Unknowns
from counterspin.inference.noise.components import size_keys
from counterspin.inference.noise.model import Noise
from counterspin.physics.motion import Trajectory
from counterspin.physics.spindle import Spindle, forecast_angle_error
from counterspin.physics.terms import ACCELEROMETER_TERMS, CONDITION_TERMS
from counterspin.planning.weights import PlannedInstrument, Setup, expected_record
from counterspin.records.reduction import block_size
from counterspin.reports.numbers import field_unit, format_number
from counterspin.simulation.simulable import check_size
from counterspin.triads.groups import all_groups


@frozen(eq=False)
class Forecast:
    """A campaign's uncertainties as they will be.

    Attributes
    ----------
    campaign
        The campaign.
    fit
        The solved problem; its estimates are those of records without errors.
    """

    campaign: Campaign
    fit: JointFit

    def __repr__(self) -> str:
        """Return the u of the parameters of interest, a line each."""
        requested = self.fit.model.of_interest
        width = max((len(unknown.name) for unknown in requested), default=0)
        lines = []
        for unknown in requested:
            unit, factor = field_unit(unknown.unit)
            u = format_number(self.u[unknown.name] * factor, 2)
            lines.append(f"{unknown.name.ljust(width)}  u = {u} {unit}")
        return "\n".join([f"Forecast of {self.campaign.title}", *lines])

    @cached_property
    def assessment(self) -> Assessment:
        """The assessment of the unknowns that the records will and will not determine."""
        return self.fit.assessment

    @property
    def u(self) -> dict[str, float]:
        """Standard uncertainty of each unknown by name, such as ``Qx.K_II``."""
        names = (unknown.name for unknown in self.fit.model.unknowns)
        return dict(zip(names, map(float, self.fit.solution.u), strict=True))

    @property
    def estimate(self) -> Estimate:
        """The forecast in the form of an estimate whose noise is given."""
        infinite = np.full(len(self.fit.model.unknowns), math.inf)
        return Estimate(self.fit, {}, infinite, ())


def forecast(
    source: Path | str | Campaign,
    *,
    sampling_rate: float | Mapping[str, float] | None = None,
    model: Unknowns | None = None,
    expected: Array | None = None,
) -> Forecast:
    """Predict what a calibration will say.

    Parameters
    ----------
    where
        The campaign's folder, its ``campaign.toml``, or a campaign already read; every run with
        its duration, the noise given, every reading with its standard uncertainty.
    sampling_rate
        Samples a second, Hz, or those of each run by name; None: that of the campaign's
        [simulation].
    model
        The estimated and considered terms; None: those of the campaign.
    expected
        Values of the model's unknowns, minus nominal, on which uncertain inputs act; None: those
        of `expected_values`.

    Raises
    ------
    CampaignError
        If the campaign file is missing or wrong, the noise, a run's length or the sampling
        rate is not known, or the runs are too long.
    NotIdentifiableError
        If a run is too short for its own start offset and velocity.
    """
    campaign = source if isinstance(source, Campaign) else read_campaign(source)
    if sampling_rate is None and campaign.simulation is not None:
        sampling_rate = campaign.simulation.sampling_rate
    _check(campaign, sampling_rate)
    model = model or make_unknowns(campaign)
    if expected is None:
        expected = expected_values(campaign, model.unknowns)
    groups = all_groups(campaign)
    if not campaign.runs:
        read = [group.linearize(model, expected) for group in groups]
        return Forecast(campaign, solve_joint(read, model, {}))
    assert sampling_rate is not None
    rates = (
        dict(sampling_rate)
        if isinstance(sampling_rate, Mapping)
        else dict.fromkeys((run.name for run in campaign.runs), sampling_rate)
    )
    check_size(campaign, max(rates.values()), "forecast")
    series = [
        planned_series(campaign, run, name, rates[run.name])
        for run in campaign.runs
        for name in campaign.accelerometers
    ]
    noise = noise_of_records(campaign)
    full_model = add_encoder_terms(model, series, noise)
    expected = np.pad(expected, (0, len(full_model.unknowns) - len(model.unknowns)))
    prepared = build_design_blocks(series, full_model, scale_factors(campaign), expected)
    read = [group.linearize(full_model, expected) for group in groups]
    return Forecast(campaign, solve_joint([*prepared, *read], full_model, noise))


def _check(campaign: Campaign, sampling_rate: float | Mapping[str, float] | None) -> None:
    problems = [
        f"runs[{index}]: neither duration nor revolutions are given; a prediction requires one "
        f'of them (run "{run.name}")'
        for index, run in enumerate(campaign.runs)
        if run.duration is None
    ]
    problems += [
        f'a prediction requires the standard uncertainty of the reading "{reading.name}"'
        for reading in campaign.all_readings
        if reading.u is None
    ]
    problems += [
        f'"{reading.name}" has no value, but unknown attitudes are estimated from the '
        "readings; simulate the readings first"
        for reading in campaign.all_readings[len(campaign.readings) :]
        if math.isnan(reading.value)
    ]
    if campaign.triad is not None and campaign.triad.records:
        problems.append("a prediction requires the list of poses in the record, not the record")
    if sampling_rate is None and campaign.runs:
        problems.append("simulation.sampling_rate: this entry is missing; a prediction requires it")
    for name, accelerometer in campaign.accelerometers.items() if campaign.runs else ():
        noise = _resolved_noise(campaign, name)
        for key in (*size_keys(accelerometer.observable).values(), "quantisation", "timing"):
            if not isinstance(noise.get(key, "estimate"), float):
                problems.append(
                    f"noise.{key}: a prediction requires a value, because the noise cannot be "
                    "estimated without records"
                )
        noise_levels = [noise.get(key) for key in (accelerometer.observable, "acceleration")]
        if noise_levels == [0.0, 0.0]:
            problems.append(
                f"noise: the noise of {name} is missing; state {accelerometer.observable}"
            )
    if problems:
        raise CampaignError(str(campaign.path), dict.fromkeys(problems), code="missing-key")


def _resolved_noise(campaign: Campaign, name: str) -> Mapping[str, float | str]:
    """Return the stated noise; noise to be estimated is taken from a simulation's truth."""
    stated = dict(resolve_noise(campaign, 0.0)[name].sizes or ())
    truth = simulated_noise(campaign) if campaign.simulation else {}
    return {key: stated.get(key, size) for key, size in {**truth, **stated}.items()} | {
        key: size for key, size in truth.items() if not isinstance(stated.get(key), float)
    }


def noise_of_records(campaign: Campaign) -> dict[str, Noise]:
    """Return the noise of each accelerometer's records."""
    return {
        name: Noise.from_sizes(_resolved_noise(campaign, name), accelerometer.observable)
        for name, accelerometer in campaign.accelerometers.items()
    }


def planned_series(campaign: Campaign, run: Run, name: str, sampling_rate: float) -> ResidualSeries:
    """Return the series that a run will give, its samples or block means, without errors.

    sampling_rate: Hz.
    """
    assert run.duration is not None
    accelerometer = campaign.accelerometers[name]
    step = 1.0 / sampling_rate
    block = block_size(step, run.rate * max(1.0, abs(run.table_ratio)))
    samples = sample_count(run.duration, sampling_rate)
    # As in the reduction of a record: the remainder at the end is a shorter block.
    block_starts = np.arange(0, samples, block)
    count = np.minimum(block, samples - block_starts).astype(np.float64)
    time = np.asarray((block_starts + 0.5 * (count - 1.0)) * step, dtype=np.float64)
    noise = _resolved_noise(campaign, name)
    timing = float(noise.get("timing", 0.0))
    encoder_noise = float(noise.get("angle", 0.0))
    angle_noise = math.hypot(encoder_noise, run.rate * timing)
    series = ResidualSeries(
        accelerometer=name,
        run=run.name,
        trajectory=Trajectory(
            Spindle(run.rate),
            campaign.radius.value,
            campaign.site,
            conditions=run_conditions(campaign)[run.name],
            table_ratio=run.table_ratio,
        ),
        mounting=accelerometer.mounting,
        observable=accelerometer.observable,
        attitude=run.attitude,
        time=time,
        time_sd=step * np.sqrt((count**2 - 1.0) / 12.0),
        count=count,
        spacing=step,
        error=np.zeros_like(time),
        in_g=accelerometer.channel.in_g,
        recorder=campaign.recording_of(run).recorder,
        angle_error=forecast_angle_error(time, run.rate, angle_noise, count)
        if campaign.angle is not None and angle_noise > 0.0
        else None,
        timestamp_errors=TimestampErrors(
            np.zeros_like(time),
            angle_noise / abs(run.rate),
            time.size,
            np.zeros_like(time),
            timing,
            encoder_noise / abs(run.rate),
        )
        if campaign.angle is not None and timing > 0.0
        else None,
    )
    if not series.in_g and timing == 0.0:
        return series
    # Of a record in g the size depends on the gravity assumed, errors included; what noise of the
    # time stamps does depends on its slope.
    unknowns = make_unknowns(campaign).unknowns
    values = expected_values(campaign, unknowns).tolist()
    expected = dict(zip(unknowns, values, strict=True))
    record = expected_record(series, expected, scale_factors(campaign)[name]).with_timestamp_noise(
        timing
    )
    return (
        record.correct_times(record.timestamp_errors.prior[0])
        if record.timestamp_errors
        else record
    )


def expected_values(campaign: Campaign, unknowns: tuple[Unknown, ...] | list[Unknown]) -> Array:
    """Return expected values of unknowns, minus nominal: the truth, else the prior, else zero."""
    truth = campaign.simulation.truth if campaign.simulation else None
    coefficients = truth.coefficients if truth else {}
    platform = {name: run_values.shared for name, run_values in truth.runs.items()} if truth else {}
    values = []
    for unknown in unknowns:
        priors = coefficients.get(unknown.owner, {}).get(unknown.symbol)
        if unknown.symbol not in ACCELEROMETER_TERMS and platform:
            run_values = platform.get(unknown.owner) or next(iter(platform.values()))
            priors = run_values.get(unknown.symbol)
        if priors is None:
            values.append(unknown.prior_mean)
            continue
        values.append(priors - unknown.nominal)
    return np.array(values)


def scale_factors(campaign: Campaign) -> dict[str, float]:
    """Return the K_I expected of each accelerometer."""
    truth = campaign.simulation.truth.coefficients if campaign.simulation else {}
    factors = {}
    for name, accelerometer in campaign.accelerometers.items():
        prior = accelerometer.priors.get("K_I")
        factors[name] = truth.get(name, {}).get("K_I", prior.value if prior else 1.0)
    return factors


def make_setup(campaign: Campaign, sampling_rate: float, *, with_considered: bool = True) -> Setup:
    """Return a plan's problem from its template campaign, which has one run in each attitude.

    sampling_rate: Hz.
    with_considered: True: considered terms stay considered; False: they are estimated with their
        priors, and nothing changes from run to run, which is a bound for any estimator.
    """
    reference = campaign.reference_temperature or 0.0
    warm = tuple(
        run.model_copy(update={"temperature": (reference + 1.0,)}) for run in campaign.runs
    )
    model = make_unknowns(replace(campaign, reference_temperature=reference, runs=warm))
    # The warming is assumed, as in runs without a recorded temperature: it is a slope.
    model = model.without([row.symbol for row in CONDITION_TERMS.values() if row.effect.power > 1])
    if not with_considered:
        estimated_terms = tuple(
            Unknown(c.owner, c.symbol, c.prior, c.limit, False, c.has_default_prior)
            for c in model.considered
        )
        dated = [row.symbol for row in CONDITION_TERMS.values() if row.effect.condition != "force"]
        model = Unknowns(model.unknowns + estimated_terms).without(dated)
    stated = _resolved_noise(campaign, next(iter(campaign.accelerometers)))
    timing, encoder_noise = float(stated.get("timing", 0.0)), float(stated.get("angle", 0.0))
    if campaign.angle is None:
        encoder_noise = math.inf
    noise = noise_of_records(campaign)
    return Setup(
        instruments=tuple(
            PlannedInstrument(name, a.mounting, a.observable, noise[name], timing, encoder_noise)
            for name, a in campaign.accelerometers.items()
        ),
        attitudes={run.name: run.attitude for run in campaign.runs},
        radius=campaign.radius.value,
        site=campaign.site,
        sampling_rate=sampling_rate,
        model=model,
        estimate=expected_values(campaign, model.unknowns),
        scale_factors=scale_factors(campaign),
    )
