"""Conversion of an estimate to parts of a result: coefficients, noise, residuals, runs."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import field
from typing import Any, Final

import numpy as np

from counterspin.arrays import median
from counterspin.calibration.accelerometer_view import AccelerometerView, FittedGroup
from counterspin.calibration.findings import Cause
from counterspin.calibration.observed_runs import ObservedRun
from counterspin.calibration.result_parts import (
    AccelerometerResult,
    Coefficient,
    Correlation,
    Finding,
    Knowledge,
    NoiseLine,
    NominalOutput,
    ParabolaResult,
    Residual,
    RippleResult,
    RunResult,
    TriadResult,
)
from counterspin.campaign.accelerometers import Accelerometer
from counterspin.campaign.description import Campaign
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.settings import NOISE_UNITS, OBSERVABLES
from counterspin.frozen import frozen
from counterspin.inference.distributions import chi_square_tail, finite_dof
from counterspin.inference.identifiability import Assessment, ConfoundedTerms
from counterspin.inference.joint import encoder
from counterspin.inference.joint.budget import prior_kind, unknown_u_by_category
from counterspin.inference.joint.estimation import Estimate
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.unknowns import ROTATION, Unknown
from counterspin.inference.noise.components import component_keys
from counterspin.inference.noise.model import Noise
from counterspin.inference.noise.search import NoiseEstimate
from counterspin.physics.terms import SHARED_TERMS, TERMS, find_symbol
from counterspin.records.record import rejected_count

#: Largest fraction of outliers in a record without a finding.
MAX_OUTLIER_SHARE: Final = 0.05


def make_coefficient(estimate: Estimate, assessment: Assessment, index: int) -> Coefficient:
    """Return an unknown as a coefficient: its estimate, else its prior, else no value."""
    unknown, solution = estimate.fit.model.unknowns[index], estimate.fit.solution
    unit = unknown.unit
    if not assessment.determined[unknown.name]:
        has_prior = math.isfinite(unknown.prior[1]) and not unknown.uses_fallback_prior
        return Coefficient(
            value=unknown.prior[0] if has_prior else None,
            u=unknown.prior[1] if has_prior else None,
            unit=unit,
            estimated=False,
        )
    u_noise, u_stated, u_unstated = unknown_u_by_category(estimate.fit, index)
    dof = float(estimate.dof[index])
    return Coefficient(
        value=float(solution.estimate[index]) + unknown.nominal,
        u=math.hypot(u_noise, u_stated, u_unstated),
        u_noise=u_noise,
        u_stated=u_stated,
        u_unstated=u_unstated,
        dof=finite_dof(dof),
        unit=unit,
        estimated=True,
    )


def prior_information(estimate: Estimate, stated_inputs: Mapping[str, Quantity]) -> list[Knowledge]:
    """Return the prior information of an estimate, in the order of the fit."""
    model, solution = estimate.fit.model, estimate.fit.solution
    rows = []
    for index, parameter in enumerate((*model.unknowns, *model.considered)):
        if parameter.is_of_interest or parameter.symbol in encoder.SYMBOLS:
            continue
        stated_input = stated_inputs.get(parameter.name)
        # The prior of an input is relative to the value at which derivatives are evaluated.
        offset = stated_input.value - parameter.prior[0] if stated_input else 0.0
        posterior = u_posterior = None
        if index < len(model.unknowns):
            posterior = offset + parameter.nominal + float(solution.estimate[index])
            u_posterior = float(solution.u[index])
        rows.append(
            Knowledge(
                name=parameter.name,
                kind=prior_kind(parameter),
                unit=parameter.unit,
                value=offset + parameter.prior[0],
                u=parameter.prior[1],
                found=posterior,
                u_found=u_posterior,
            )
        )
    return rows


def accelerometer_correlation(view: AccelerometerView) -> Correlation | None:
    """Return the correlations of the coefficients of an accelerometer and the platform."""
    prefix = f"{view.name}."
    return _make_correlation(
        view.estimate,
        {
            index: unknown.name.removeprefix(prefix)
            for index, unknown in enumerate(view.fit.model.unknowns)
            if view.assessment.determined.get(unknown.name)
            and (unknown.owner == view.name or unknown.symbol not in TERMS)
        },
    )


def full_correlation(estimate: Estimate, assessment: Assessment) -> Correlation | None:
    """Return the correlations of all determined terms except the rotations of runs."""
    return _make_correlation(
        estimate,
        {
            index: unknown.name
            for index, unknown in enumerate(estimate.fit.model.unknowns)
            if assessment.determined.get(unknown.name) and unknown.symbol not in ROTATION
        },
    )


def _make_correlation(estimate: Estimate, terms: Mapping[int, str]) -> Correlation | None:
    if not terms:
        return None
    covariance = estimate.fit.solution.covariance[np.ix_(list(terms), list(terms))]
    u = np.sqrt(np.diag(covariance))
    return Correlation(terms=list(terms.values()), matrix=(covariance / np.outer(u, u)).tolist())


def confounded_terms(view: AccelerometerView) -> list[ConfoundedTerms]:
    """Return the confounded sets with terms of an accelerometer, without its name."""
    return [
        confounded_set.without_owner(view.name)
        for confounded_set in view.assessment.confounded
        if any(name.startswith(f"{view.name}.") for name in confounded_set.terms)
    ]


def confounded_platform_terms(assessment: Assessment) -> list[ConfoundedTerms]:
    """Return the confounded sets that contain only shared terms."""
    return [
        confounded_set
        for confounded_set in assessment.confounded
        if all(find_symbol(name) in SHARED_TERMS for name in confounded_set.terms)
    ]


def summarize_residuals(view: AccelerometerView) -> Residual:
    """Return rms and goodness of fit of the residuals of an accelerometer."""
    if not view.has_records:
        return summarize_group_residuals(view.groups)
    square_sum, n_samples, diagnostics = 0.0, 0.0, view.diagnostics
    for _, block, residuals in view.records():
        square_sum += float(np.sum(residuals.unweighted**2 * block.series.count))
        n_samples += residuals.unweighted.size
    return Residual(
        rms=math.sqrt(square_sum / n_samples),
        unit=OBSERVABLES[view.accelerometer.observable],
        dof=diagnostics.dof,
        chi2=diagnostics.chi2 if diagnostics.noise_given else None,
        lack_of_fit_p=diagnostics.lack_of_fit_p,
    )


def summarize_group_residuals(groups: Sequence[FittedGroup]) -> Residual:
    """Return rms and goodness of fit of the residuals of readings."""
    residuals = np.concatenate([group.residuals for group in groups])
    stated_groups = [group for group in groups if math.isinf(group.noise_dof)]
    chi2 = sum(group.chi2 for group in stated_groups)
    dof = sum(group.residual_dof for group in stated_groups)
    is_testable = len(stated_groups) == len(groups) and dof > 0.5
    return Residual(
        rms=float(np.sqrt(np.mean(residuals**2))),
        unit="g",
        # 0 for as many unknowns as readings.
        dof=round(sum(group.residual_dof for group in groups), 9),
        chi2=chi2 if is_testable else None,
        lack_of_fit_p=chi_square_tail(dof, chi2) if is_testable else None,
    )


def reading_noise_lines(groups: Sequence[FittedGroup]) -> dict[str, NoiseLine]:
    """Return the noise of readings by label of their group."""
    return {
        group.label: NoiseLine(
            value=median(group.sigma),
            u=median(group.sigma) / math.sqrt(2.0 * group.noise_dof)
            if math.isfinite(group.noise_dof)
            else None,
            unit="g",
            estimated=math.isfinite(group.noise_dof),
        )
        for group in groups
    }


def noise_lines(view: AccelerometerView) -> dict[str, NoiseLine]:
    """Return the noise of an accelerometer, by component of records and label of readings."""
    reading_lines = reading_noise_lines(view.groups)
    if not view.has_records:
        return reading_lines
    components = view.estimate.estimated_noise.get(view.name)
    noise, observable = view.fit.noise[view.name], view.accelerometer.observable
    record_lines = record_noise_lines(noise, components, observable)
    all_series = view.series
    if any(series.variance_ratio != 1.0 for series in all_series):
        line = record_lines[observable]
        runs = {series.run: line.value * math.sqrt(series.variance_ratio) for series in all_series}
        record_lines[observable] = line.model_copy(update={"runs": runs})
    if timing_noise := estimated_timing_noise(view):
        record_lines["timing"] = NoiseLine(value=timing_noise, unit="s", estimated=True)
    return add_static_uncertainty(record_lines, view.campaign, noise, observable) | reading_lines


def estimated_timing_noise(view: AccelerometerView) -> float:
    """Return the time-stamp noise estimated from the residuals, s; 0: none."""
    if view.campaign.noise is not None and view.campaign.noise.timing:
        return 0.0
    return max((series.timestamp_noise for series in view.series), default=0.0)


def add_static_uncertainty(
    lines: dict[str, NoiseLine], campaign: Campaign, noise: Noise, observable: str
) -> dict[str, NoiseLine]:
    """Return noise lines with the uncertainties of components from the static record."""
    updated_lines = dict(lines)
    keys = component_keys(observable) if noise.covariance else {}
    for index, key in enumerate(keys.values()):
        variance, line = noise.covariance[index][index], lines.get(key)
        if variance > 0.0 and line is not None and not line.estimated and campaign.noise:
            u = 0.5 * math.sqrt(variance) / line.value
            updated_lines[key] = line.model_copy(update={"u": u, "record": campaign.noise.rest})
    return updated_lines


def record_noise_lines(
    noise: Noise, components: NoiseEstimate | None, observable: str
) -> dict[str, NoiseLine]:
    """Return the stated or estimated noise of records, by component."""
    lines = {}
    for index, (component, key) in enumerate(component_keys(observable).items()):
        value = float(getattr(noise, component))
        is_estimated = components is not None and component in components.estimated
        is_dropped = components is not None and component in components.dropped
        if value == 0.0 and not is_dropped:
            continue
        u = None
        if components is not None and is_estimated and value > 0.0:
            # Standard uncertainty of the square root of an estimated variance.
            u = 0.5 * math.sqrt(float(components.covariance[index, index])) / value
        lines[key] = NoiseLine(
            value=value, u=u, unit=NOISE_UNITS[key], estimated=is_estimated or is_dropped
        )
    if noise.quantisation > 0.0:
        lines["quantisation"] = NoiseLine(
            value=noise.quantisation, unit=NOISE_UNITS["quantisation"], estimated=False
        )
    return lines


def residual_tables(fit: JointFit, units: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return the columns of `Result.residuals`, one table for each record.

    units: Accelerometer -> unit of its records.
    """
    tables: list[dict[str, Any]] = []
    for block, residuals in zip(fit.design_blocks, fit.residuals, strict=True):
        series, unweighted_residuals = block.series, residuals.unweighted
        whitened = np.full(unweighted_residuals.size, np.nan)
        # A difference is assigned to the later of its rows.
        whitened[unweighted_residuals.size - residuals.whitened.size :] = residuals.whitened
        tables.append(
            {
                "accelerometer": block.accelerometer,
                "run": block.run,
                "time": series.time,
                "count": series.count,
                "error": series.error,
                "fitted": series.error - unweighted_residuals,
                "residual": unweighted_residuals,
                "whitened": whitened,
                "unit": units[block.accelerometer],
            }
        )
    return tables


def mounting_radii(
    campaign: Campaign, shared_coefficients: Mapping[Unknown, Coefficient]
) -> dict[Unknown, Coefficient]:
    """Return the radii of mountings; the fit estimates deviations from the stated radius."""
    return {
        unknown: coefficient.model_copy(update={"value": coefficient.value + campaign.radius.value})
        for unknown, coefficient in shared_coefficients.items()
        if unknown.symbol.startswith("centrifuge.radius.") and coefficient.value is not None
    }


def convert_to_output_units(
    campaign: Campaign, name: str, coefficients: dict[str, Coefficient]
) -> dict[str, Coefficient]:
    """Return bias and scale factor in the unit of the readings; empty if this unit is g."""
    output = campaign.accelerometers[name].output
    if output is None:
        return {}
    output_coefficients, sensitivity = {}, output.sensitivity
    for symbol, key, unit, offset in (
        ("K_F", "bias", output.unit, output.zero),
        ("K_I", "scale_factor", f"{output.unit}/g", 0.0),
    ):
        coefficient = coefficients.get(symbol)
        if coefficient is None or coefficient.value is None or coefficient.u is None:
            continue
        value, u = offset + coefficient.value * sensitivity, coefficient.u * abs(sensitivity)
        output_coefficients[key] = Coefficient(
            value=value, u=u, dof=coefficient.dof, unit=unit, estimated=coefficient.estimated
        )
    return output_coefficients


@frozen
class Outcome:
    """Outcome of a method; the fields are those of `Result`, except the last four."""

    model: str
    accelerometers: dict[str, AccelerometerResult]
    runs: dict[str, RunResult]
    platform: dict[str, Coefficient] = field(default_factory=dict)
    triad: TriadResult | None = None
    confounded: list[ConfoundedTerms] = field(default_factory=list)
    correlation: Correlation | None = None
    rests_on: list[Knowledge] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)
    causes: tuple[Cause, ...] = ()  #: Causes of a misfit, the likeliest first.
    remarks: tuple[str, ...] = ()  #: Warnings in addition to those on the campaign.
    #: From `residual_tables`; not stored in files.
    residuals: Sequence[Mapping[str, Any]] = ()
    #: Run on the arm -> rate identified from the angle, and stated rate, rad/s.
    arm_rates: Mapping[str, tuple[float, float]] = field(default_factory=dict)


def make_run_result(
    run: ObservedRun,
    *,
    parabolas: Mapping[str, ParabolaResult] | None = None,
    terms: Mapping[str, Coefficient] | None = None,
    fit: Mapping[str, dict[str, float | str | None]] | None = None,
    n_outliers: int = 0,
) -> RunResult:
    """Return the rotation and the counts of samples of a run."""
    rotation, report = run.rotation, run.record.report
    spindle, run_terms = run.trajectory.spindle, dict(terms or {})
    # Without a recorded angle, the joint fit estimates the rotation.
    rotation_terms = {symbol: run_terms.pop(symbol) for symbol in ROTATION if symbol in run_terms}
    _, rate, drift = (rotation_terms.get(symbol) for symbol in ROTATION)
    counts = report.counts(n_outliers)
    ripples = [
        RippleResult(
            harmonic=ripple.harmonic,
            amplitude=ripple.amplitude,
            u_amplitude=u_amplitude,
            phase=ripple.phase,
            u_phase=u_phase,
        )
        for ripple, (u_amplitude, u_phase) in zip(
            spindle.ripples, rotation.u_ripples if rotation else (), strict=True
        )
    ]
    return RunResult(
        rate=rate.value if rate and rate.value is not None else spindle.rate,
        u_rate=rotation.u_rate if rotation else rate.u if rate else None,
        drift=drift.value if drift and drift.value is not None else spindle.drift,
        u_drift=rotation.u_drift if rotation else drift.u if drift else None,
        ripples=ripples,
        angle_rms=rotation.rms if rotation else None,
        samples=report.used,
        rejected=rejected_count(counts),
        counts=counts,
        notes=report.notes(),
        parabolas=dict(parabolas or {}),
        terms=run_terms,
        fit=dict(fit or {}),
    )


def check_outlier_share(
    subject: str, counts: Mapping[str, int], n_accelerometers: int = 1
) -> list[Finding]:
    """Return a finding if the fraction of outliers exceeds `MAX_OUTLIER_SHARE`."""
    n_samples = counts["rows"] * n_accelerometers
    share = counts["outliers"] / n_samples
    if share <= MAX_OUTLIER_SHARE:
        return []
    text = (
        f"{subject}: {counts['outliers']} of {n_samples} samples were rejected as outliers. Find "
        "the cause, because the remaining samples may also be affected."
    )
    return [Finding(code="many-outliers", subject=subject, text=text, size=share)]


def prior_correlations(campaign: Campaign, name: str) -> dict[str, dict[str, float]]:
    """Return the stated prior correlations of an accelerometer's terms, by symbol."""
    prefix = f"{name}."
    return {
        term.removeprefix(prefix): {
            other_term.removeprefix(prefix): r for other_term, r in correlations.items()
        }
        for term, correlations in campaign.model.correlations.items()
        if term.startswith(prefix)
    }


def describe_instrument(
    accelerometer: Accelerometer, estimated_symbols: Collection[str]
) -> dict[str, Any]:
    """Return the fields of a result that describe an accelerometer."""
    output = accelerometer.output
    return {
        "serial_number": accelerometer.serial_number,
        "known": {
            symbol: Coefficient(value=prior.value, u=prior.u, unit=prior.unit, estimated=False)
            for symbol, prior in accelerometer.priors.items()
            if symbol not in estimated_symbols
        },
        "axes": list(accelerometer.mounting.axes),
        "observable": accelerometer.observable,
        "nominal": None if output is None else NominalOutput(**output.model_dump()),
    }
