"""Assembly of a `Result` from observed runs, by the joint or the two-stage method."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Final

from counterspin._version import __version__
from counterspin.calibration.extensions import apply_specifications, apply_two_stage
from counterspin.calibration.findings import judge_result
from counterspin.calibration.input_location import locate_nonlinear_inputs
from counterspin.calibration.joint import fit_jointly
from counterspin.calibration.joint_problem import JointProblem
from counterspin.calibration.model import fixed_symbols
from counterspin.calibration.observed_runs import ObservedRun, detect_detrending
from counterspin.calibration.options import Method, TwoStageOptions, command_arguments
from counterspin.calibration.outcome import check_outlier_share
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import Finding, Inputs, Provenance
from counterspin.campaign.conditions import reference_point, temperatures_of
from counterspin.campaign.description import Campaign
from counterspin.campaign.questions import ask_questions
from counterspin.records.signals import TREND_LABELS as REMOVED
from counterspin.results import describe_environment

#: Fraction of the stated duration below which a record counts as incomplete.
MIN_DURATION_FRACTION: Final = 0.9

#: Largest relative difference between identified and nominal rate.
MAX_RATE_DEVIATION: Final = 1e-3

#: Relative spread below which rate differences count as equal in all runs.
_MAX_COMMON_SPREAD: Final = 0.1


def assemble_result(
    campaign: Campaign,
    observed_runs: Sequence[ObservedRun],
    method: Method,
    options: TwoStageOptions,
    collect_inputs: Callable[[], tuple[Mapping[str, str], Mapping[str, str]]],
    accepted_misfit: str | None = None,
) -> Result:
    """Estimate all coefficients and return the result.

    collect_inputs: Returns checksums of the inputs, and origins of inputs in memory.
    accepted_misfit: Reason for using the result although the records contradict it.
    """
    problem = locate_nonlinear_inputs(JointProblem(campaign, observed_runs))
    observed_runs = problem.observed_runs
    outcome = fit_jointly(problem) if method == "joint" else apply_two_stage(problem, options)
    findings = [
        *outcome.findings,
        *_question_findings(campaign),
        *_rate_findings({**_measured_rates(observed_runs), **outcome.arm_rates}),
        *(
            finding
            for name, run in outcome.runs.items()
            for finding in check_outlier_share(name, run.counts, len(campaign.accelerometers))
        ),
        *_record_end_findings(observed_runs),
    ]
    checksums, origins = collect_inputs()
    temperatures, reference_temperature = temperatures_of(campaign), campaign.reference_temperature
    result = Result(
        method=method,
        model=outcome.model,
        findings=findings,
        title=campaign.title,
        accelerometers=outcome.accelerometers,
        platform=outcome.platform,
        triad=outcome.triad,
        confounded=outcome.confounded,
        correlation=outcome.correlation,
        runs=outcome.runs,
        inputs=Inputs(
            gravity=campaign.gravity.value,
            u_gravity=campaign.gravity.u,
            latitude=campaign.latitude.value,
            u_latitude=campaign.latitude.u,
            radius=campaign.radius.value,
            u_radius=campaign.radius.u,
            reference_temperature=reference_point(campaign).temperature
            if temperatures
            else reference_temperature,
            temperatures=[min(temperatures), max(temperatures)] if temperatures else [],
        ),
        rests_on=outcome.rests_on,
        assumed=list(fixed_symbols(campaign, problem.model)),
        details=dict(campaign.details),
        warnings=[
            *_campaign_remarks(campaign),
            *_detrending_remarks(campaign, observed_runs),
            *_long_record_remarks(observed_runs),
            *outcome.remarks,
        ],
        provenance=Provenance(
            version=__version__,
            inputs=dict(checksums),
            in_memory=dict(origins),
            options=command_arguments(method, options),
            environment=describe_environment(),
        ),
    )
    result._residuals = outcome.residuals
    result = judge_result(result, accepted_misfit, outcome.causes)
    if campaign.specifications is None:
        return result
    return apply_specifications(result, campaign.specifications)


def _measured_rates(observed_runs: Sequence[ObservedRun]) -> dict[str, tuple[float, float]]:
    """Return run -> rate identified from the angle, and stated rate, rad/s."""
    return {
        run.run.name: (run.rotation.spindle.rate, run.run.rate)
        for run in observed_runs
        if run.rotation is not None
    }


def _rate_findings(rates: Mapping[str, tuple[float, float]]) -> list[Finding]:
    """Return the findings on runs whose rate differs from the nominal rate.

    If all runs differ by the same ratio, the time base is the likely cause.

    rates: Run -> rate identified from the angle, and stated rate, rad/s.
    """
    findings, deviations = [], []
    for name, (rate, stated_rate) in rates.items():
        deviation = rate / stated_rate - 1.0
        deviations.append(deviation)
        if abs(deviation) > MAX_RATE_DEVIATION:
            text = (
                f"{name}: the spindle turned at {rate:.6f} rad/s instead of the nominal "
                f"{stated_rate:.6f} rad/s. The fit uses the recorded angle."
            )
            findings.append(
                Finding(code="other-rate", subject=name, text=text, size=abs(deviation))
            )
    min_deviation, max_deviation = min(deviations, default=0.0), max(deviations, default=0.0)
    if (
        len(findings) < 2
        or len(findings) < len(deviations)
        or max_deviation - min_deviation > _MAX_COMMON_SPREAD * abs(max_deviation)
    ):
        return findings
    text = (
        f"In every run, the spindle turned {100 * abs(max_deviation):.3f} % "
        f"{'faster' if max_deviation > 0.0 else 'slower'} than stated. The deviation is the same "
        "in all runs, so either the recorder clock or the stated rates must be wrong by this "
        "amount. The fit uses the recorded times and rates."
    )
    magnitude = abs(max_deviation)
    return [Finding(code="time-base", subject="records.time", text=text, size=magnitude)]


def _record_end_findings(observed_runs: Sequence[ObservedRun]) -> list[Finding]:
    """Return the findings on records that end early or have isolated rows at an end."""
    findings = []
    for run in observed_runs:
        name = run.run.name
        duration, nominal_duration = _durations(run)
        if nominal_duration is not None and duration < MIN_DURATION_FRACTION * nominal_duration:
            text = (
                f"{name}: the record lasts {duration:.4g} s instead of the "
                f"{nominal_duration:.4g} s stated in the campaign. Check that the record is "
                "complete."
            )
            findings.append(
                Finding(
                    code="short-record", subject=name, text=text, size=nominal_duration / duration
                )
            )
        if n_isolated := run.record.report.isolated:
            row_text = "1 row" if n_isolated == 1 else f"{n_isolated} rows"
            text = (
                f"{name}: a gap separates {row_text} at one end of the record from the rest, so "
                "counterspin omitted them. Inspect the record."
            )
            findings.append(Finding(code="lone-rows", subject=name, text=text, size=n_isolated))
    return findings


def _durations(run: ObservedRun) -> tuple[float, float | None]:
    """Return the duration of a record, and its stated duration if all of it is used, s."""
    is_part = any(map(math.isfinite, run.run.time_range))
    duration = float(run.record.time[-1] - run.record.time[0])
    return duration, None if is_part else run.run.duration


def _long_record_remarks(observed_runs: Sequence[ObservedRun]) -> Iterator[str]:
    """Yield a remark on each record that is longer than its stated duration."""
    for run in observed_runs:
        duration, nominal_duration = _durations(run)
        if nominal_duration is not None and nominal_duration < MIN_DURATION_FRACTION * duration:
            yield (
                f"{run.run.name}: the record lasts {duration:.4g} s instead of the "
                f"{nominal_duration:.4g} s stated as duration. counterspin uses the whole record. "
                "To use only a part, enter start or stop in the run."
            )


def _question_findings(campaign: Campaign) -> list[Finding]:
    return [
        Finding(code=question.code, subject=question.subject, text=question.text)
        for question in ask_questions(campaign)
    ]


def _detrending_remarks(campaign: Campaign, observed_runs: Sequence[ObservedRun]) -> list[str]:
    """Return remarks on trends that recorders removed and that the start values absorb."""
    remarks = []
    for name, accelerometer in campaign.accelerometers.items():
        order, runs = detect_detrending(
            {run.run.name: run.record.polynomials[name] for run in observed_runs}
        )
        if order:
            remarks.append(
                f"A {REMOVED[order]} was removed from column '{accelerometer.channel.name}' "
                f"({name}) before the file was written ({', '.join(runs)}). The removal does not "
                "affect the result, because the fit estimates the initial offset and initial "
                "velocity of each record."
            )
    return remarks


def _campaign_remarks(campaign: Campaign) -> list[str]:
    """Return remarks on the campaign that do not affect the state of the result."""
    remarks = list[str]()
    if campaign.skipped:
        names = ", ".join(campaign.skipped)
        remarks.append(f"Omitted on request: {names}.")
    if campaign.model.positioning_error is not None and not any(
        reading.position for reading in campaign.readings
    ):
        remarks.append(
            "[fixture] position was not used. It describes the positioning error of known "
            "attitudes, but this campaign estimates all attitudes."
        )
    run_names = [run.name for run in campaign.runs if run.u_rate]
    run_names += [
        reading.name
        for reading in campaign.readings
        if reading.uses_recorder_clock and reading.u_rate
    ]
    if run_names:
        names = ", ".join(dict.fromkeys(run_names))
        remarks.append(
            f"The stated rate uncertainty of {names} was not used, because the fit estimates "
            "the rate from the record. The stated rate is used only as the nominal value."
        )
    if campaign.rate_clock is None and campaign.clock is not None:
        count = sum(
            1 for reading in campaign.readings if reading.rate and not reading.uses_recorder_clock
        )
        if count:
            remarks.append(
                f"[records] clock also applies to the stated rates of {count} readings, "
                "because [centrifuge] clock is absent. Enter [centrifuge] clock if a different "
                "clock measured these rates."
            )
    recordings = [campaign.recording_of(run) for run in campaign.runs]
    if any(recording.angle and recording.angle.kind == "pulses" for recording in recordings):
        remarks.append(
            "The records give the angle only at the pulses. Rate changes between pulses, such "
            "as ripple, are neither detected nor included in the uncertainty."
        )
    if campaign.angle is not None or not campaign.runs:
        return remarks
    return [
        *remarks,
        "The records contain no angle, so counterspin calculates the rotation from the nominal "
        "rates and estimates the rate drift.",
    ]
