"""The joint method: from observed runs to every coefficient that full records determine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from counterspin.calibration.joint_checks import (
    compare,
    driving_runs,
    hidden_walk,
    jackknife,
    left_out,
    residual_tests,
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
from counterspin.calibration.observed import ObservedRun
from counterspin.calibration.result import described
from counterspin.calibration.result_parts import AccelerometerResult, Coefficient, ConfoundedTerms
from counterspin.campaign.resolved import Campaign
from counterspin.inference.diagnostics import Diagnostics
from counterspin.inference.identifiability import Assessment, assess
from counterspin.inference.joint.estimation import Estimate, estimate
from counterspin.inference.joint.fit import ROTATION, Unknown
from counterspin.physics.accelerometer import DEGREE_PER_HOUR, TERMS

#: Drift (deg/h) times time squared (s^2) at which first order in the attitude errs by 0.01 m.
_LARGE_DRIFT: Final = 0.2 * 400.0**2


@dataclass(frozen=True)
class JointOutcome:
    """What the joint fit says: the result's parts, and what they come from."""

    accelerometers: Mapping[str, AccelerometerResult]
    platform: Mapping[str, Coefficient]
    runs: Mapping[str, Mapping[str, Coefficient]]
    fits: Mapping[str, Mapping[str, dict[str, float | str | None]]]
    outliers: Mapping[str, int]
    confounded: tuple[ConfoundedTerms, ...]
    warnings: tuple[str, ...]
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
    series = series_of(campaign, observed)
    model = model_of(campaign)
    found = estimate(series, model, noise_of(campaign))
    fit = found.fit
    assessment = assess(
        fit.solution,
        [unknown.name for unknown in model.unknowns],
        nominal=[unknown.nominal for unknown in model.unknowns],
    )
    coefficients = {
        unknown: coefficient(found, assessment, index)
        for index, unknown in enumerate(model.unknowns)
    } | _rotations(found, assessment)
    diagnostics = {name: residual_tests(found, name) for name in campaign.accelerometers}
    not_modelled = left_out(campaign, found)
    accelerometers = {
        name: _accelerometer(
            campaign, observed, found, assessment, coefficients, name, diagnostics[name]
        ).model_copy(
            update={
                "left_out": not_modelled[name],
                "traces": traces(observed, series, found, name, diagnostics[name]),
            }
        )
        for name in campaign.accelerometers
    }
    shared = {u: c for u, c in coefficients.items() if u.symbol not in TERMS}
    outliers: dict[str, int] = {run.run.name: 0 for run in observed}
    for one, mask in zip(series, found.outliers, strict=True):
        outliers[one.run] += int(one.count[mask].sum())
    return JointOutcome(
        accelerometers=accelerometers,
        platform={u.symbol: c for u, c in shared.items() if not u.owner},
        runs={
            run.run.name: {u.symbol: c for u, c in shared.items() if u.owner == run.run.name}
            for run in observed
        },
        fits={run.run.name: run_fits(diagnostics, run.run.name) for run in observed},
        outliers=outliers,
        confounded=tuple(confounded_platform(assessment)),
        warnings=tuple(shared_warnings(coefficients, max(float(one.time[-1]) for one in series))),
        estimate=found,
    )


def _rotations(found: Estimate, assessment: Assessment) -> dict[Unknown, Coefficient]:
    """Return the rotations that were found from the displacement, as the runs had them."""
    spindles = {one.series.run: one.series.trajectory.spindle for one in found.fit.prepared}
    rotations = {}
    for index, unknown in enumerate(found.fit.model.unknowns):
        if unknown.symbol in ROTATION:
            step = coefficient(found, assessment, index)
            base = getattr(spindles[unknown.owner], unknown.symbol.removeprefix("spindle."))
            rotations[unknown] = step.model_copy(update={"value": base + (step.value or 0.0)})
    return rotations


def _accelerometer(
    campaign: Campaign,
    observed: Sequence[ObservedRun],
    found: Estimate,
    assessment: Assessment,
    coefficients: Mapping[Unknown, Coefficient],
    name: str,
    diagnostics: Diagnostics,
) -> AccelerometerResult:
    own = {u.symbol: c for u, c in coefficients.items() if u.owner == name}
    # The campaign's order is the user's; the table of terms has its own.
    own = {symbol: own[symbol] for symbol in campaign.model.terms if symbol in own}
    lines = {
        symbol: budget_lines(found, index, name)
        for index, (unknown, c) in enumerate(coefficients.items())
        if unknown.owner == name and c.estimated
        for symbol in (unknown.symbol,)
    }
    runs_left_out = jackknife(found, name)
    return AccelerometerResult(
        coefficients=own,
        correlation=correlation(found, coefficients, name),
        confounded=confounded(assessment, name),
        residual=residual(campaign, found, name, diagnostics),
        noise=noise_lines(campaign, found, name),
        budget=lines,
        jackknife=runs_left_out,
        two_stage=compare(campaign, observed, found, name),
        warnings=[f"{name}: {finding}" for finding in diagnostics.findings]
        + driving_runs(runs_left_out, name)
        + hidden_walk(found, name)
        + unseen_ripple(campaign, found, name)
        + _undetermined(own, name),
        **described(campaign.accelerometers[name], own),
    )


def _large_drift(symbol: str, drift: Coefficient, longest: float) -> list[str]:
    """Return a warning where a drift is, or with its uncertainty may be, too large."""
    rate, u = (abs(x or 0.0) / DEGREE_PER_HOUR for x in (drift.value, drift.u))
    limit = _LARGE_DRIFT / longest**2
    if rate + 2.0 * u <= limit:
        return []
    is_ = f"is {rate:.2g} deg/h" if rate > limit else f"may reach {rate + 2.0 * u:.2g} deg/h"
    return [
        f"{symbol} {is_} (u {u:.1g} deg/h): in runs of {longest:.0f} s the platform's attitude is "
        f"a first-order matter up to about {limit:.2g} deg/h only."
    ]


def _undetermined(own: Mapping[str, Coefficient], name: str) -> list[str]:
    return [
        f"{name}: the records do not determine {symbol}, and nothing is known of it beforehand."
        for symbol, c in own.items()
        if c.value is None
    ]


def shared_warnings(coefficients: Mapping[Unknown, Coefficient], longest: float) -> list[str]:
    """Return what is to be said of the unknowns that all share; `longest` run in s."""
    warnings = []
    for unknown, c in coefficients.items():
        if unknown.symbol in TERMS:
            continue
        if c.value is None:
            warnings.append(
                f"The records do not determine {unknown.name}, and nothing is known of it "
                "beforehand."
            )
        if unknown.symbol.startswith("platform.drift") and c.value is not None:
            warnings += _large_drift(unknown.symbol, c, longest)
    return warnings
