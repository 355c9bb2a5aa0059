"""Predict the result of a campaign's calibration from its description, without records.

A forecast uses the columns, whitening, priors and solver of the calibration at the sample times of
the future records. It does not need their values, because the covariance does not depend on them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Final

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
from counterspin.inference.noise.components import component_keys
from counterspin.inference.noise.model import Noise
from counterspin.physics.motion import Trajectory
from counterspin.physics.spindle import Spindle, forecast_angle_error
from counterspin.physics.terms import ACCELEROMETER_TERMS, CONDITION_TERMS
from counterspin.planning.weights import PlannedInstrument, Setup, expected_record
from counterspin.records.reduction import block_size
from counterspin.reports.numbers import find_display_unit, format_number
from counterspin.simulation.simulable import check_size
from counterspin.triads.groups import all_groups

#: Number of readings named in an error message.
_MAX_NAMES: Final = 3


@frozen(eq=False)
class Forecast:
    """Predicted uncertainties of a campaign.

    Attributes
    ----------
    campaign
        The campaign.
    fit
        The solved fit, with the estimates for records without errors.
    """

    campaign: Campaign
    fit: JointFit

    def __repr__(self) -> str:
        """Return u of the parameters of interest, one line each."""
        parameters = self.fit.model.of_interest
        name_width = max((len(unknown.name) for unknown in parameters), default=0)
        lines = []
        for unknown in parameters:
            unit, factor = find_display_unit(unknown.unit)
            u = format_number(self.u[unknown.name] * factor, 2)
            lines.append(f"{unknown.name.ljust(name_width)}  u = {u} {unit}")
        return "\n".join([f"Forecast of {self.campaign.title}", *lines])

    @cached_property
    def assessment(self) -> Assessment:
        """Assessment of the identifiability of the unknowns."""
        return self.fit.assessment

    @property
    def u(self) -> dict[str, float]:
        """Standard uncertainty of each unknown by name, such as ``Qx.K_II``."""
        names = (unknown.name for unknown in self.fit.model.unknowns)
        return dict(zip(names, map(float, self.fit.solution.u), strict=True))

    @property
    def estimate(self) -> Estimate:
        """The forecast as an estimate with known noise."""
        infinite_dof = np.full(len(self.fit.model.unknowns), math.inf)
        return Estimate(self.fit, {}, infinite_dof, ())


def forecast(
    source: Path | str | Campaign,
    *,
    sampling_rate: float | Mapping[str, float] | None = None,
    model: Unknowns | None = None,
    expected: Array | None = None,
) -> Forecast:
    """Predict the uncertainties of a calibration.

    Parameters
    ----------
    source
        The campaign's folder, its ``campaign.toml``, or a `Campaign`. It must state the duration of
        every run, the noise, and the standard uncertainty of every reading.
    sampling_rate
        Sampling rate, Hz, or sampling rates by run; None: the rate in [simulation].
    model
        Estimated and considered terms; None: those of the campaign.
    expected
        Values of the model's unknowns minus nominal, for the effect of uncertain inputs; None:
        those of `expected_values`.

    Returns
    -------
    Forecast

    Raises
    ------
    CampaignError
        If the campaign file is missing or invalid, the noise, the duration of a run or the sampling
        rate is unknown, or the runs are too long.
    NotIdentifiableError
        If a run is too short for its own start offset and velocity.
    """
    campaign = source if isinstance(source, Campaign) else read_campaign(source)
    if sampling_rate is None and campaign.simulation is not None:
        sampling_rate = campaign.simulation.sampling_rate
    _require_data(campaign, sampling_rate)
    model = model or make_unknowns(campaign)
    if expected is None:
        expected = expected_values(campaign, model.unknowns)
    groups = all_groups(campaign)
    if not campaign.runs:
        linear_readings = [group.linearize(model, expected) for group in groups]
        return Forecast(campaign, solve_joint(linear_readings, model, {}))
    assert sampling_rate is not None
    rate_by_run = (
        dict(sampling_rate)
        if isinstance(sampling_rate, Mapping)
        else dict.fromkeys((run.name for run in campaign.runs), sampling_rate)
    )
    check_size(campaign, max(rate_by_run.values()), "forecast")
    series = [
        planned_series(campaign, run, name, rate_by_run[run.name])
        for run in campaign.runs
        for name in campaign.accelerometers
    ]
    noise = record_noise(campaign)
    full_model = add_encoder_terms(model, series, noise)
    expected = np.pad(expected, (0, len(full_model.unknowns) - len(model.unknowns)))
    design_blocks = build_design_blocks(series, full_model, scale_factors(campaign), expected)
    linear_readings = [group.linearize(full_model, expected) for group in groups]
    return Forecast(campaign, solve_joint([*design_blocks, *linear_readings], full_model, noise))


def _require_data(campaign: Campaign, sampling_rate: float | Mapping[str, float] | None) -> None:
    problems = [
        f"runs[{index}]: neither duration nor revolutions are given; a prediction requires one "
        f'of them (run "{run.name}")'
        for index, run in enumerate(campaign.runs)
        if run.duration is None
    ]
    names = [f'"{reading.name}"' for reading in campaign.all_readings if reading.u is None]
    if names:
        shown_names = ", ".join(names[:_MAX_NAMES])
        suffix = f" and {len(names) - _MAX_NAMES} more" if len(names) > _MAX_NAMES else ""
        problems.append(
            "a prediction requires the standard uncertainty of each reading; state u in "
            f"[readings], or the reading with ± in [[runs]] ({shown_names}{suffix})"
        )
    problems += [
        f'"{reading.name}" has no value, but unknown attitudes are estimated from the '
        "readings; simulate the readings first"
        for reading in campaign.all_readings[len(campaign.readings) :]
        if math.isnan(reading.value)
    ]
    if campaign.triad is not None and campaign.triad.records:
        problems.append(
            "a prediction requires the list of poses in the record, not the record itself"
        )
    if sampling_rate is None and campaign.runs:
        problems.append("simulation.sampling_rate: this entry is missing; a prediction requires it")
    for name, accelerometer in campaign.accelerometers.items() if campaign.runs else ():
        noise = _resolve_noise_sizes(campaign, name)
        for key in (*component_keys(accelerometer.observable).values(), "quantisation", "timing"):
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


def _resolve_noise_sizes(campaign: Campaign, name: str) -> Mapping[str, float | str]:
    """Return the stated noise; take noise to be estimated from the truth of a simulation."""
    stated_sizes = dict(resolve_noise(campaign, 0.0)[name].sizes or ())
    true_sizes = simulated_noise(campaign) if campaign.simulation else {}
    return {
        key: stated_sizes.get(key, size) for key, size in {**true_sizes, **stated_sizes}.items()
    } | {
        key: size
        for key, size in true_sizes.items()
        if not isinstance(stated_sizes.get(key), float)
    }


def record_noise(campaign: Campaign) -> dict[str, Noise]:
    """Return the noise of each accelerometer's records."""
    return {
        name: Noise.from_sizes(_resolve_noise_sizes(campaign, name), accelerometer.observable)
        for name, accelerometer in campaign.accelerometers.items()
    }


def planned_series(campaign: Campaign, run: Run, name: str, sampling_rate: float) -> ResidualSeries:
    """Return the expected series of a run, its samples or block means, without errors.

    sampling_rate: Hz.
    """
    assert run.duration is not None
    accelerometer = campaign.accelerometers[name]
    sample_interval = 1.0 / sampling_rate
    block_length = block_size(sample_interval, run.rate * max(1.0, abs(run.table_ratio)))
    n_samples = sample_count(run.duration, sampling_rate)
    # As in the reduction of a record, the last block may be shorter.
    starts = np.arange(0, n_samples, block_length)
    counts = np.minimum(block_length, n_samples - starts).astype(np.float64)
    times = np.asarray((starts + 0.5 * (counts - 1.0)) * sample_interval, dtype=np.float64)
    noise = _resolve_noise_sizes(campaign, name)
    timing_noise = float(noise.get("timing", 0.0))
    encoder_noise = float(noise.get("angle", 0.0))
    angle_noise = math.hypot(encoder_noise, run.rate * timing_noise)
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
        time=times,
        time_sd=sample_interval * np.sqrt((counts**2 - 1.0) / 12.0),
        count=counts,
        spacing=sample_interval,
        error=np.zeros_like(times),
        in_g=accelerometer.channel.in_g,
        recorder=campaign.recording_of(run).recorder,
        angle_error=forecast_angle_error(times, run.rate, angle_noise, counts)
        if campaign.angle is not None and angle_noise > 0.0
        else None,
        timestamp_errors=TimestampErrors(
            np.zeros_like(times),
            angle_noise / abs(run.rate),
            times.size,
            np.zeros_like(times),
            timing_noise,
            encoder_noise / abs(run.rate),
        )
        if campaign.angle is not None and timing_noise > 0.0
        else None,
    )
    if not series.in_g and timing_noise == 0.0:
        return series
    # A record in g depends on the assumed gravity, errors included. The effect of noise of the time
    # stamps depends on the slope of the record.
    unknowns = make_unknowns(campaign).unknowns
    values = expected_values(campaign, unknowns).tolist()
    expected = dict(zip(unknowns, values, strict=True))
    record = expected_record(series, expected, scale_factors(campaign)[name])
    record = record.with_timestamp_noise(timing_noise)
    errors = record.timestamp_errors
    return record.correct_times(errors.prior[0]) if errors else record


def expected_values(campaign: Campaign, unknowns: tuple[Unknown, ...] | list[Unknown]) -> Array:
    """Return expected values of unknowns, minus nominal: the truth, else the prior, else zero."""
    truth = campaign.simulation.truth if campaign.simulation else None
    true_coefficients = truth.coefficients if truth else {}
    platform_truth = {name: run.shared for name, run in truth.runs.items()} if truth else {}
    values = []
    for unknown in unknowns:
        true_value = true_coefficients.get(unknown.owner, {}).get(unknown.symbol)
        if unknown.symbol not in ACCELEROMETER_TERMS and platform_truth:
            run_truth = platform_truth.get(unknown.owner) or next(iter(platform_truth.values()))
            true_value = run_truth.get(unknown.symbol)
        if true_value is None:
            values.append(unknown.prior_mean)
            continue
        values.append(true_value - unknown.nominal)
    return np.array(values)


def scale_factors(campaign: Campaign) -> dict[str, float]:
    """Return the expected K_I of each accelerometer."""
    truth = campaign.simulation.truth.coefficients if campaign.simulation else {}
    factors = {}
    for name, accelerometer in campaign.accelerometers.items():
        prior = accelerometer.priors.get("K_I")
        factors[name] = truth.get(name, {}).get("K_I", prior.value if prior else 1.0)
    return factors


def make_setup(campaign: Campaign, sampling_rate: float, *, keep_considered: bool = True) -> Setup:
    """Return the setup of a plan from its template campaign, with one run in each attitude.

    sampling_rate: Hz.
    keep_considered: True: keep considered terms; False: estimate them with their priors and omit
        changes from run to run, which gives a bound for any estimator.
    """
    reference_temperature = campaign.reference_temperature or 0.0
    runs_at_temperature = tuple(
        run.model_copy(update={"temperature": (reference_temperature + 1.0,)})
        for run in campaign.runs
    )
    model = make_unknowns(
        replace(campaign, reference_temperature=reference_temperature, runs=runs_at_temperature)
    )
    # The warming is a slope, as in runs without a recorded temperature.
    model = model.without([row.symbol for row in CONDITION_TERMS.values() if row.effect.power > 1])
    if not keep_considered:
        estimated_terms = tuple(
            Unknown(
                considered_term.owner,
                considered_term.symbol,
                considered_term.prior,
                considered_term.limit,
                False,
                considered_term.has_default_prior,
            )
            for considered_term in model.considered
        )
        time_dependent_symbols = [
            row.symbol for row in CONDITION_TERMS.values() if row.effect.condition != "force"
        ]
        model = Unknowns(model.unknowns + estimated_terms).without(time_dependent_symbols)
    stated_sizes = _resolve_noise_sizes(campaign, next(iter(campaign.accelerometers)))
    timing_noise = float(stated_sizes.get("timing", 0.0))
    encoder_noise = float(stated_sizes.get("angle", 0.0))
    if campaign.angle is None:
        encoder_noise = math.inf
    noise = record_noise(campaign)
    return Setup(
        instruments=tuple(
            PlannedInstrument(
                name,
                accelerometer.mounting,
                accelerometer.observable,
                noise[name],
                timing_noise,
                encoder_noise,
            )
            for name, accelerometer in campaign.accelerometers.items()
        ),
        attitudes={run.name: run.attitude for run in campaign.runs},
        radius=campaign.radius.value,
        site=campaign.site,
        sampling_rate=sampling_rate,
        model=model,
        expected=expected_values(campaign, model.unknowns),
        scale_factors=scale_factors(campaign),
    )
