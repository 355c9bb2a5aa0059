"""Checks of a joint result: runs left out, the two-stage method beside it, what does not show."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from counterspin.calibration.diagnosis.pose_findings import pose_findings
from counterspin.calibration.diagnosis.reading_findings import readings_fit
from counterspin.calibration.findings import (
    equivalent_deviations,
    lack_of_fit,
)
from counterspin.calibration.joint_parts import coefficient, residual
from counterspin.calibration.joint_view import AccelerometerView
from counterspin.calibration.options import TwoStageOptions
from counterspin.calibration.result_parts import Comparison, Finding
from counterspin.calibration.two_stage import two_stage_view
from counterspin.calibration.two_stage_request import walk_is_stated
from counterspin.errors import NotIdentifiableError, RecordError
from counterspin.inference.diagnostics import FALSE_ALARMS
from counterspin.inference.joint import encoder
from counterspin.inference.joint.agreement import slow_parts
from counterspin.inference.joint.fit import JointFit, relax
from counterspin.physics.terms import INPUTS, OWN_TERMS, shown_by_readings
from counterspin.reports.numbers import format_number


def residual_findings(view: AccelerometerView) -> list[Finding]:
    """Return what the tests of an accelerometer's residuals found: one finding for all records."""
    findings = [*readings_fit(view), *pose_findings(view.fit, view.poses)]
    if not view.has_records:
        return findings
    tests = view.diagnostics
    if tests.findings:
        findings.insert(0, lack_of_fit(view.name, tests.findings, residual(view)))
    return [*findings, *_noise_that_differs(view)]


def _noise_that_differs(view: AccelerometerView) -> list[Finding]:
    """Return a finding where one run shows more of the noise that was found than the others."""
    components = view.estimate.components.get(view.name)
    if components is None or "random_walk" not in components.estimated:
        return []
    # What nobody asks for need not be apart.
    parts = slow_parts(relax(view.estimate.core or view.fit), view.name)
    worst = min(parts, key=lambda part: part.p, default=None)
    tests = len(parts) * len(view.campaign.accelerometers)
    if worst is None or worst.p * tests >= FALSE_ALARMS:
        return []
    text = (
        "The estimated noise of the accelerometer differs between runs: "
        f"that of {worst.run} is {format_number(math.sqrt(worst.ratio), 2)} times as large as "
        f"the others' "
        f"(p = {worst.p:.2g}). A slow error of this record, or of one that it is compared with, "
        f"may have been taken for noise and may shift the coefficients by more than u. "
        "Inspect the records."
    )
    return [
        Finding(
            code="noise-differs",
            subject=f"{worst.run}.{view.name}",
            text=text,
            size=equivalent_deviations(worst.p),
        )
    ]


def run_fits(
    views: Sequence[AccelerometerView], run: str
) -> dict[str, dict[str, float | str | None]]:
    """Return the tests of one run's residuals, by accelerometer."""
    fits: dict[str, dict[str, float | str | None]] = {}
    for view in views:
        if not view.has_records:
            continue
        tests = view.diagnostics
        test = tests.runs.get(run)
        if test is not None:
            fits[view.name] = {
                "rows": float(test.rows),
                "chi2": test.chi2,
                "dof": test.dof,
                "chi2_p": test.chi2_p if tests.noise_given else None,
                "sign_p": test.sign_p,
                "peak_frequency_hz": test.peak_frequency,
                "peak_p": test.peak_p,
            }
    return fits


def compare(view: AccelerometerView) -> Comparison | None:
    """Return the two-stage K_II beside the joint one; None where that method does not apply.

    Of what two stages do not estimate they are given what the joint fit found: else a drift, say,
    that was asked for and is there would make them disagree.
    """
    index = view.k_ii
    if index is None:
        return None
    components = {} if walk_is_stated(view.problem.noise) else view.estimate.components
    found = _found(view.fit)
    try:
        beside, _ = two_stage_view(
            view.problem,
            view.accelerometer,
            TwoStageOptions(),
            components,
            found,
        )
    except (NotIdentifiableError, RecordError):
        return None
    place = beside.places["K_II"]
    other = coefficient(beside.estimate, beside.assessment, place)
    if not other.estimated or other.value is None or other.u is None:
        return None
    solution, second = view.fit.solution, beside.fit.solution
    covariance = solution.covariance_noise + solution.covariance_prior
    theirs = (second.covariance_noise + second.covariance_prior)[place, place]
    # What the joint fit found moves each estimate by its own sensitivity: that of the joint one is
    # its regression on it, and the rest of its variance would remain if all of it were known.
    held = {(other.owner, other.symbol): k for k, other in enumerate(beside.fit.model.considered)}
    unknowns = view.fit.model.unknowns
    there = [k for k, o in enumerate(unknowns) if (o.owner, o.symbol) in {*held} & {*found}]
    here = [held[unknowns[k].owner, unknowns[k].symbol] for k in there]
    sd = np.sqrt(np.diag(covariance)[there])
    scaled = covariance[np.ix_(there, there)] / np.outer(sd, sd)
    regression = np.linalg.lstsq(scaled, covariance[there, index] / sd, rcond=None)[0]
    own = covariance[index, index] - float(regression @ scaled @ regression)
    apart = second.sensitivity_considered[place, here] * sd - regression
    both = float(apart @ scaled @ apart)
    # A term that only the two-stage method holds counts in its own variance; one that both hold
    # moves each estimate by its own sensitivity.
    considered = _considered(view.fit, index)
    known = {unknowns[k].name for k in there}
    for name, (effect, sd_of) in _considered(beside.fit, place).items():
        if name in considered:
            joint_effect, _ = considered.pop(name)
            both += ((effect - joint_effect) * sd_of) ** 2
        elif name not in known:
            theirs += (effect * sd_of) ** 2
    both += sum((effect * sd_of) ** 2 for effect, sd_of in considered.values())
    # Both rest on the same records, and the joint estimate is the better one: variances subtract
    # (Hausman). Where the two-stage method leaves more out it can seem better; then they add.
    spread = math.sqrt((theirs - own if theirs > own else theirs + own) + both)
    difference = other.value - float(solution.estimate[index])
    return Comparison(
        value=other.value,
        u=other.u,
        difference=difference,
        u_difference=spread,
        z=difference / spread,
    )


def _found(fit: JointFit) -> dict[tuple[str, str], tuple[float, float]]:
    """Return value and u of what was asked for, not stated, and determined."""
    return {
        (other.owner, other.symbol): (float(value) + other.nominal, float(u))
        for other, value, u in zip(
            fit.model.unknowns, fit.solution.estimate, fit.solution.u, strict=True
        )
        if other.asked and math.isinf(other.prior[1]) and u < other.limit
    }


def _considered(fit: JointFit, index: int) -> dict[str, tuple[float, float]]:
    """Return the considered terms: name -> sensitivity of an unknown and standard uncertainty.

    Uncertain inputs and errors of the encoder are left out: they move both methods alike.
    """
    solution = fit.solution
    return {
        other.name: (float(effect), float(sd))
        for other, effect, sd in zip(
            fit.model.considered,
            solution.sensitivity_considered[index],
            solution.considered_sd,
            strict=False,
        )
        if other.symbol not in (*encoder.SYMBOLS, *INPUTS)
        and (other.symbol in OWN_TERMS or not shown_by_readings(other.symbol))
    }


def unseen_ripple(view: AccelerometerView) -> list[Finding]:
    """Return a finding where a ripple would move K_II and no angle was recorded to show it.

    A ripple shakes the platform along the tangent with R w^2 times its ratio. In displacement
    that leaves nothing behind; in velocity or specific force it stands where K_II does. Where the
    angle is recorded, what its noise hides is in the uncertainty.
    """
    index, campaign = view.k_ii, view.campaign
    if index is None or view.accelerometer.observable == "displacement":
        return []
    if campaign.angle is not None or (view.parts and not view.has_records):
        return []
    fastest = max(abs(run.rate) for run in campaign.runs)
    force = campaign.radius.value * fastest**2 / campaign.gravity.value
    u = float(view.fit.solution.u[index])
    text = (
        "Without a recorded angle no ripple of the rate is known, and in this observable a ripple "
        f"of {0.5 * u * force:.1g} of the rate moves K_II by about half of its uncertainty, and "
        "is not included in it. Record the angle, or calibrate with displacement."
    )
    return [Finding(code="unseen-ripple", subject=f"{view.name}.K_II", text=text)]
