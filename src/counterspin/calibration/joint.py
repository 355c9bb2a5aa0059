"""The joint method: from observed runs to every coefficient that full records determine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from counterspin.calibration.joint_checks import (
    compare,
    hidden_walk,
    jackknife,
    residual_findings,
    run_fits,
    unseen_ripple,
)
from counterspin.calibration.joint_parts import (
    budget_lines,
    coefficient,
    confounded,
    confounded_platform,
    correlation,
    noise_lines,
    residual,
)
from counterspin.calibration.joint_problem import model_of, noise_of, series_of
from counterspin.calibration.joint_traces import traces
from counterspin.calibration.joint_view import AccelerometerView
from counterspin.calibration.left_out import joint_omissions, with_typical
from counterspin.calibration.observed import ObservedRun
from counterspin.calibration.readings import (
    AccelerometerReadings,
    in_output_units,
    outlying_readings,
    radii,
    with_readings,
)
from counterspin.calibration.result import described
from counterspin.calibration.result_parts import (
    AccelerometerResult,
    Coefficient,
    ConfoundedTerms,
    Finding,
    OmittedTerm,
)
from counterspin.campaign.resolved import Campaign
from counterspin.inference.identifiability import Assessment, assess
from counterspin.inference.joint.estimation import Estimate, estimate
from counterspin.inference.joint.unknowns import ROTATION, Unknown, Unknowns
from counterspin.physics.accelerometer import TERMS
from counterspin.physics.shared_terms import DEGREE_PER_HOUR

#: Drift (deg/h) times time squared (s^2) at which first order in the attitude errs by 0.01 m.
_FIRST_ORDER_LIMIT: Final = 0.2 * 400.0**2


@dataclass(frozen=True)
class JointOutcome:
    """What the joint fit says: the result's parts, and what they come from."""

    accelerometers: Mapping[str, AccelerometerResult]
    platform: Mapping[str, Coefficient]
    runs: Mapping[str, Mapping[str, Coefficient]]
    fits: Mapping[str, Mapping[str, dict[str, float | str | None]]]
    outliers: Mapping[str, int]
    confounded: tuple[ConfoundedTerms, ...]
    findings: tuple[Finding, ...]
    estimate: Estimate


def joint(campaign: Campaign, observed: Sequence[ObservedRun]) -> JointOutcome:
    """Fit all records of a campaign together.

    Parameters
    ----------
    campaign
        The description.
    observed
        Its runs.

    Returns
    -------
    JointOutcome

    Raises
    ------
    NotIdentifiableError, ConvergenceError
        As `counterspin.inference.joint.estimation.estimate`.
    """
    model = model_of(campaign)
    estimated, read = _estimate(campaign, observed, model)
    assessment = assess(
        estimated.fit.solution,
        [unknown.name for unknown in model.unknowns],
        nominal=[unknown.nominal for unknown in model.unknowns],
    )
    views = [
        AccelerometerView(
            campaign,
            estimated,
            assessment,
            name,
            tuple(part for part in read if part.readings.accelerometer == name),
        )
        for name in campaign.accelerometers
    ]
    omissions = joint_omissions(views)
    shared = {
        unknown: coefficient(estimated, assessment, index)
        for index, unknown in enumerate(model.unknowns)
        if unknown.symbol not in TERMS and unknown.owner not in campaign.accelerometers
    } | _rotations(estimated, assessment)
    shared |= radii(campaign, shared)
    outliers: dict[str, int] = {run.run.name: 0 for run in observed}
    for record, mask in zip(estimated.series, estimated.outliers, strict=True):
        outliers[record.run] += int(record.count[mask].sum())
    longest = max((float(record.time[-1]) for record in estimated.series), default=0.0)
    return JointOutcome(
        accelerometers={
            view.name: _accelerometer(view, observed, omissions[view.name]) for view in views
        },
        platform={u.symbol: c for u, c in shared.items() if not u.owner},
        runs={
            run.run.name: {u.symbol: c for u, c in shared.items() if u.owner == run.run.name}
            for run in observed
        },
        fits={run.run.name: run_fits(views, run.run.name) for run in observed},
        outliers=outliers,
        confounded=tuple(confounded_platform(assessment)),
        findings=tuple(shared_findings(shared, longest)),
        estimate=estimated,
    )


def _estimate(
    campaign: Campaign, observed: Sequence[ObservedRun], model: Unknowns
) -> tuple[Estimate, tuple[AccelerometerReadings, ...]]:
    """Return the estimate from records and readings, and how the readings fit."""
    if not campaign.readings:
        return estimate(series_of(campaign, observed), model, noise_of(campaign)), ()
    from_records = None
    if observed:
        from_records = estimate(series_of(campaign, observed), model, noise_of(campaign))
    return with_readings(from_records, model, campaign)


def _rotations(estimated: Estimate, assessment: Assessment) -> dict[Unknown, Coefficient]:
    """Return the rotations that were found from the displacement, as the runs had them."""
    spindles = {record.run: record.trajectory.spindle for record in estimated.series}
    rotations = {}
    for index, unknown in enumerate(estimated.fit.model.unknowns):
        if unknown.symbol in ROTATION:
            step = coefficient(estimated, assessment, index)
            base = getattr(spindles[unknown.owner], unknown.symbol.removeprefix("spindle."))
            rotations[unknown] = step.model_copy(update={"value": base + (step.value or 0.0)})
    return rotations


def _accelerometer(
    view: AccelerometerView, observed: Sequence[ObservedRun], omissions: dict[str, OmittedTerm]
) -> AccelerometerResult:
    name, estimated = view.name, view.estimate
    own = {
        symbol: coefficient(estimated, view.assessment, index)
        for symbol, index in view.places.items()
    }
    return AccelerometerResult(
        # The campaign's order is the user's; the table of terms has its own.
        coefficients=with_typical(
            {
                symbol: own[symbol]
                for symbol in (*view.campaign.model.terms, *view.campaign.machine.terms)
                if symbol in own
            },
            omissions,
        ),
        correlation=correlation(view),
        confounded=confounded(view),
        residual=residual(view),
        noise=noise_lines(view),
        budget={
            symbol: budget_lines(estimated, index, name)
            for symbol, index in view.places.items()
            if own[symbol].estimated
        },
        jackknife=jackknife(view),
        two_stage=compare(view, observed) if observed else None,
        left_out=omissions,
        traces=traces(view, observed),
        readings=[line for part in view.readings for line in part.results()],
        output=in_output_units(view.campaign, name, own),
        findings=[
            *residual_findings(view),
            *outlying_readings(name, view.readings),
            *hidden_walk(view),
            *unseen_ripple(view),
            *_undetermined(own, name),
        ],
        **described(view.accelerometer, own),
    )


def _large_drift(symbol: str, drift: Coefficient, longest: float) -> list[Finding]:
    """Return a finding where a drift is, or with its uncertainty may be, too large."""
    rate, u = (abs(x or 0.0) / DEGREE_PER_HOUR for x in (drift.value, drift.u))
    limit = _FIRST_ORDER_LIMIT / longest**2
    if rate + 2.0 * u <= limit:
        return []
    is_ = f"is {rate:.2g} deg/h" if rate > limit else f"may reach {rate + 2.0 * u:.2g} deg/h"
    text = (
        f"{symbol} {is_} (u {u:.1g} deg/h): in runs of {longest:.0f} s the platform's attitude is "
        f"a first-order matter up to about {limit:.2g} deg/h only."
    )
    return [Finding(code="large-drift", subject=symbol, text=text, size=(rate + 2.0 * u) / limit)]


def _undetermined(own: Mapping[str, Coefficient], name: str) -> list[Finding]:
    return [
        Finding(
            code="not-determined",
            subject=f"{name}.{symbol}",
            text=f"The records do not determine {symbol}, and nothing is known of it beforehand.",
        )
        for symbol, c in own.items()
        if c.value is None
    ]


def shared_findings(coefficients: Mapping[Unknown, Coefficient], longest: float) -> list[Finding]:
    """Return what speaks against the unknowns that all share; `longest` run in s."""
    findings = []
    for unknown, c in coefficients.items():
        if unknown.symbol in TERMS:
            continue
        if c.value is None:
            text = (
                f"The records do not determine {unknown.name}, and nothing is known of it "
                "beforehand."
            )
            findings.append(Finding(code="not-determined", subject=unknown.name, text=text))
        if unknown.symbol.startswith("platform.drift") and c.value is not None:
            findings += _large_drift(unknown.symbol, c, longest)
    return findings
