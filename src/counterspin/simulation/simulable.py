"""Checks of campaigns before a simulation, and the campaign with its true inputs."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Final, Literal

from counterspin.campaign.accelerometers import update_responses
from counterspin.campaign.columns import Recording
from counterspin.campaign.conditions import rate_clock_input
from counterspin.campaign.description import Campaign
from counterspin.campaign.field_types import ESTIMATE
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.runs import MAX_COMPUTED_ROWS, MAX_SIMULATED_ROWS
from counterspin.campaign.settings import NoiseSettings, StatedNoise
from counterspin.errors import CampaignError
from counterspin.inference.joint.series import CLOCK, RATE_CLOCK, TIMING
from counterspin.physics.spindle import Spindle
from counterspin.physics.terms import term
from counterspin.readings.entries import MAX_RECORDS
from counterspin.readings.known_attitudes import Readings, perturb_input
from counterspin.records.record import ColumnSpec
from counterspin.simulation.pose_record import record_duration

#: Maximum ratio of a true value to its largest credible size.
MAX_TRUTH_RATIO: Final = 5.0
#: Maximum relative change of the rate by ripple and drift together.
_MAX_RATE_CHANGE: Final = 0.5
#: Highest simulated ripple harmonic.
_MAX_RIPPLE_HARMONIC: Final = 1000
#: Problem of a record at rest without duration.
_MISSING_DURATION: Final = "simulating a record at rest requires a duration"


def simulation_problems(campaign: Campaign) -> list[str]:
    """Return the problems of [truth] in a simulation: noise without value, implausible values.

    The largest credible sizes come from the term table or from [model.limits].
    """
    if campaign.simulation is None:
        return []
    truth = campaign.simulation.truth
    is_inherited = truth.noise is campaign.noise
    problems = [
        f"{'noise' if is_inherited else 'truth.noise'}.{key}: a simulation requires the true value"
        + ("; write it in [truth.noise]" if is_inherited else "")
        for key in StatedNoise.model_fields
        if getattr(truth.noise, key) == ESTIMATE
    ]
    for name, coefficients in truth.coefficients.items():
        for symbol, value in coefficients.items():
            limit = campaign.limit_of(symbol, name)
            problems += _check_plausible_value(f"truth.{name}.{symbol}", symbol, value, limit)
    for index, run in enumerate(campaign.runs):
        if (run_truth := truth.runs.get(run.name)) is None:
            continue
        location = f'truth of runs[{index}] ("{run.name}")'
        for symbol, value in run_truth.shared.items():
            limit = campaign.limit_of(symbol)
            problems += _check_plausible_value(f"{location}, {symbol}", symbol, value, limit)
        problems += [
            f"{location}: {text}" for text in _check_steady_rate(run_truth.spindle, run.duration)
        ]
    return problems


def _check_plausible_value(location: str, symbol: str, value: float, limit: float) -> Iterator[str]:
    row = term(symbol)
    if abs(value - row.nominal) > MAX_TRUTH_RATIO * limit:
        yield (
            f"{location}: {value:.6g} {row.unit} is more than {MAX_TRUTH_RATIO:g} times the "
            f"largest credible size, {limit:.6g} {row.unit}"
            + (f" about {row.nominal:g}" if row.nominal else "")
            + f'; check its unit, or raise "{symbol}" in [model.limits]'
        )


def _check_steady_rate(spindle: Spindle, duration: float | None) -> Iterator[str]:
    if spindle.highest_harmonic > _MAX_RIPPLE_HARMONIC:
        yield (
            f"harmonic {spindle.highest_harmonic} of the ripple is above "
            f"{_MAX_RIPPLE_HARMONIC}, the highest harmonic that can be simulated"
        )
    ripple_sum = sum(abs(ripple.amplitude / spindle.rate) for ripple in spindle.ripples)
    rate_change = ripple_sum + abs(spindle.drift) * (duration or 0.0)
    if not rate_change < _MAX_RATE_CHANGE:
        yield (
            f"ripple and drift change the rate by {100.0 * rate_change:.3g} % within the run; "
            f"less than {100.0 * _MAX_RATE_CHANGE:g} % can be simulated"
        )


def reading_problems(campaign: Campaign) -> list[str]:
    """Return the problems of readings in a simulation: missing noise, implausible values."""
    if campaign.simulation is None:
        return []
    truth = campaign.simulation.truth
    problems = []
    if campaign.triad and campaign.triad.records and _is_noiseless(truth.noise):
        problems.append(
            "truth.noise.specific_force: missing; a sensor without noise at rest would look like "
            "a stopped sensor, and counterspin would not find any pose in its record"
        )
    for (name, _), run_truth in truth.reading_runs.items():
        duration = max(
            (reading.duration or 0.0 for reading in campaign.readings if reading.name == name),
            default=0.0,
        )
        problems += [
            f'truth of run "{name}": {text}'
            for text in _check_steady_rate(run_truth.spindle, duration)
        ]
    for reading in campaign.all_readings:
        if reading.record is not None:
            if reading.motion == "static" and reading.duration is None:
                problems.append(f'run "{reading.name}": {_MISSING_DURATION}')
        elif reading.u is None and reading.accelerometer not in truth.reading_noise:
            problems.append(
                f'truth.noise.reading: missing; "{reading.name}" has no stated uncertainty, so '
                "the true noise is required"
            )
            break
    for symbol, value in truth.machine.items():
        row = term(symbol)
        if not math.fabs(value) <= MAX_TRUTH_RATIO * row.limit:
            problems.append(
                f"truth.machine, {symbol}: {value:.6g} {row.unit} is more than {MAX_TRUTH_RATIO:g} "
                f"times the largest credible size, {row.limit:.6g} {row.unit}; check its unit"
            )
    return problems


def _is_noiseless(noise: StatedNoise) -> bool:
    has_static_record = isinstance(noise, NoiseSettings) and noise.rest is not None
    return not (has_static_record or noise.specific_force or noise.acceleration)


def refuse_unsupported(campaign: Campaign) -> None:
    """Raise CampaignError if the format of the records is not supported in simulations."""
    problems = []
    campaign_recording = Recording(
        campaign.time, campaign.angle, campaign.dialect, campaign.temperature
    )
    run_recordings = {
        f'run "{run.name}", records': run.recording for run in campaign.runs if run.recording
    }
    for location, recording in ({"records": campaign_recording} | run_recordings).items():
        stated_keys = [key for key, value in vars(recording.dialect).items() if value is not None]
        problems += [
            f"{location}.{key}: simulated records cannot have this key; omit it"
            for key in stated_keys
        ]
        for key, channel in (("time", recording.time), ("angle", recording.angle)):
            if channel is not None and channel.name and (channel.kind != "numbers"):
                message = "simulated records contain numbers, not time stamps or pulses"
                problems.append(f"{location}.{key}: {message}")
            elif channel is not None and channel.name and not channel.unit:
                problems.append(f"{location}.{key}.unit: missing; required to simulate records")
        if recording.time.kind == "rows" and campaign.runs:
            problems.append(f"{location}.time: simulated records contain a time column")
    for name, accelerometer in campaign.accelerometers.items():
        if accelerometer.channel.name and not accelerometer.channel.unit:
            key = f"accelerometers.{name}.{accelerometer.observable}.unit"
            problems.append(f"{key}: missing; required to simulate records")
    problems += _check_clock(campaign)
    problems += _check_temperatures(campaign)
    records = [run.record for run in campaign.runs]
    for run in campaign.runs:
        if records.count(run.record) > 1:
            problems.append(f'run "{run.name}": a simulated record can belong to only one run')
        if len(run.files) > 1:
            problems.append(f'run "{run.name}": a simulated record is a single file')
    if problems:
        raise CampaignError(str(campaign.path), problems, code="not-simulable")


def _check_temperatures(campaign: Campaign) -> Iterator[str]:
    """Yield a problem for each record with a temperature column but no stated temperature."""
    runs = [run for run in campaign.runs if campaign.recording_of(run).temperature]
    recorded_readings = [
        record for record in campaign.readings if record.record is not None and campaign.temperature
    ]
    pose_records = campaign.triad.records if campaign.triad and campaign.temperature else ()
    temperatures = {
        record.name: record.temperature
        for records in (runs, recorded_readings, pose_records)
        for record in records
    }
    for name in (name for name, temperature in temperatures.items() if not temperature):
        yield (
            f'run "{name}": temperature is missing; the record has a temperature column, so the '
            "true temperature is required"
        )


def _check_clock(campaign: Campaign) -> Iterator[str]:
    """Yield a problem if the simulated sampling rate of pose records is not the stated rate."""
    if campaign.time.kind != "rows" or campaign.runs or campaign.simulation is None:
        return
    if campaign.triad and campaign.triad.records:
        rate, stated_rate = campaign.simulation.sampling_rate, 1.0 / campaign.time.factor
        if not math.isclose(rate, stated_rate, rel_tol=1e-9):
            yield (
                f"simulation.sampling_rate: is {rate:g} Hz, but records.time states "
                f"{stated_rate:g} Hz"
            )


def count_computed_rows(
    rate: float, duration: float, sampling_rate: float, *, is_averaged: bool
) -> float:
    """Return the number of rows of a computed record.

    rate, duration, sampling_rate: rad/s, s, Hz.
    is_averaged: True if the samples are averaged in blocks, as in `calibrate`.
    """
    from counterspin.records.reduction import BLOCKS_PER_REVOLUTION, block_size

    n_rows = duration * sampling_rate
    if is_averaged and rate:
        n_rows /= block_size(1.0 / sampling_rate, rate)
    # The integrals need a minimum number of points per revolution.
    return max(n_rows, BLOCKS_PER_REVOLUTION * abs(rate) * duration / (2.0 * math.pi))


def check_size(
    campaign: Campaign, sampling_rate: float, purpose: Literal["forecast", "study", "simulation"]
) -> None:
    """Raise CampaignError if the records of a campaign are too large to compute.

    A simulation processes one record at a time, so that it may have any number of runs.

    sampling_rate: Hz.
    """
    record_lengths = [
        (f"runs[{index}]", run.rate, run.duration, len(campaign.accelerometers))
        for index, run in enumerate(campaign.runs)
    ]
    if purpose == "simulation":  # other purposes need only the noise of means
        record_lengths += [
            (f'run "{reading.name}"', reading.rate, reading.duration, 1)
            for reading in campaign.readings
            if reading.record is not None
        ]
        assert campaign.simulation is not None
        record_lengths += [
            (f'run "{record.name}"', 0.0, record_duration(record, campaign.simulation.poses), 1)
            for record in (campaign.triad.records if campaign.triad else ())
        ]
    row_counts = [
        (
            (1 if purpose == "simulation" else n_accelerometers)
            * count_computed_rows(rate, duration, sampling_rate, is_averaged=purpose == "forecast"),
            f"{location}: {duration:.4g} s at {abs(rate) / (2.0 * math.pi):.3g} rev/s, sampled at "
            f"{sampling_rate:.4g} Hz,",
        )
        for location, rate, duration, n_accelerometers in record_lengths
        if duration is not None
    ]
    total_rows = sum(rows for rows, _ in row_counts)
    n_records = len(campaign.runs) * len(campaign.accelerometers)
    if purpose != "simulation" and n_records > MAX_RECORDS:
        text = f"runs: {n_records} records are too many; a {purpose} can have at most {MAX_RECORDS}"
        raise CampaignError(str(campaign.path), [text], code="too-many-rows")
    max_rows = MAX_SIMULATED_ROWS if purpose == "simulation" else MAX_COMPUTED_ROWS
    advice = (
        f"rows, but a {purpose} can have at most {max_rows:.2g}; choose fewer revolutions, a "
        "shorter duration or a lower sampling rate"
    )
    if purpose == "simulation":
        problems = [
            f"{record_text} makes {rows:.3g} {advice}"
            for rows, record_text in row_counts
            if rows > max_rows
        ]
    elif total_rows > max_rows:
        rows, text = max(row_counts)
        problems = [f"{text} makes {rows:.3g} of the {total_rows:.3g} {advice}"]
    else:
        problems = []
    if problems:
        raise CampaignError(str(campaign.path), problems, code="too-many-rows")


def apply_true_inputs(campaign: Campaign) -> Campaign:
    """Return the campaign with the true radius, gravity, latitude, angle delay and responses.

    Its columns and clocks keep the stated values, which apply to reading its records.
    """
    assert campaign.simulation is not None
    true_values = campaign.simulation.truth.inputs
    gravity, latitude, radius = (
        replace(stated_value, value=true_values.get(("", symbol), stated_value.value))
        for symbol, stated_value in (
            ("site.gravity", campaign.gravity),
            ("site.latitude", campaign.latitude),
            ("centrifuge.radius", campaign.radius),
        )
    )
    angle_delay = true_values.get(("", TIMING))
    return replace(
        campaign,
        accelerometers=update_responses(campaign.accelerometers, true_values),
        site=replace(campaign.site, gravity=gravity.value, latitude=latitude.value),
        gravity=gravity,
        latitude=latitude,
        radius=radius,
        timing_offset=campaign.timing_offset
        if angle_delay is None
        else Quantity(angle_delay, 0.0, "s"),
    )


def apply_inputs_to_readings(campaign: Campaign, group: Readings) -> Readings:
    """Return readings with the true radius, gravity, latitude and clocks.

    A mounting with its own radius term does not depend on the radius of the centrifuge.
    """
    assert campaign.simulation is not None
    true_campaign, model = apply_true_inputs(campaign), campaign.model
    symbols = {*model.terms, *model.considered, *model.priors}
    symbols |= campaign.simulation.truth.machine.keys()
    for symbol, (true_value, stated_value) in {
        "centrifuge.radius": (true_campaign.radius, campaign.radius),
        "site.gravity": (true_campaign.gravity, campaign.gravity),
        "site.latitude": (true_campaign.latitude, campaign.latitude),
    }.items():
        group = perturb_input(group, symbol, true_value.value - stated_value.value, symbols)
    inputs = campaign.simulation.truth.inputs
    for owner, symbol in dict.fromkeys(
        rate_clock_input(campaign, reading) for reading in campaign.readings
    ):
        stated_clock = campaign.rate_clock if symbol == RATE_CLOCK else campaign.clock
        stated_error = stated_clock.value if stated_clock else 0.0
        name = f"{owner}.{symbol}" if owner else symbol
        group = perturb_input(
            group, name, inputs.get((owner, symbol), stated_error) - stated_error, symbols
        )
    return group


def clock_ratio(campaign: Campaign, recording: Recording) -> float:
    """Return recorded over true time, corrected by the stated clock error."""
    assert campaign.simulation is not None
    stated_error = recording.clock.value if recording.clock else 0.0
    true_error = campaign.simulation.truth.inputs.get((recording.recorder, CLOCK), stated_error)
    return (1.0 + true_error) / (1.0 + stated_error)


def gravity_ratio(campaign: Campaign, channel: ColumnSpec) -> float:
    """Return stated over true gravity for an output in g; 1 for other outputs."""
    true_gravity = apply_true_inputs(campaign).gravity.value
    return campaign.gravity.value / true_gravity if channel.in_g else 1.0
