"""The joint method: from observed runs to every coefficient that full records determine."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.checks.limits import beyond_typical, incredible, incredible_shared
from counterspin.calibration.checks.methods import MethodComparison, compare_methods
from counterspin.calibration.checks.priors import contradicted_prior
from counterspin.calibration.checks.readings import no_more_than_rounded, outliers_of_means
from counterspin.calibration.checks.residuals import (
    hidden_walk,
    other_noise,
    overstated_noise,
    residual_findings,
)
from counterspin.calibration.checks.small_angles import large_drifts, large_tilts
from counterspin.calibration.checks.unseen_faults import remarks_of, unseen_faults
from counterspin.calibration.extensions import (
    Diagnosis,
    compare_two_stage,
    find_diagnosis,
    thin_residuals,
)
from counterspin.calibration.findings import (
    not_determined,
)
from counterspin.calibration.joint_problem import AccelerometerView, JointProblem
from counterspin.calibration.model import SQUARES, inputs_of, is_requested
from counterspin.calibration.outcome import (
    Outcome,
    coefficient,
    confounded,
    confounded_platform,
    correlation,
    knowledge,
    noise_lines,
    own_description,
    residual,
    residual_frame,
    run_result,
    whole_correlation,
)
from counterspin.calibration.readings import (
    ReadingsAndPoses,
    in_output_units,
    only_at_rest,
    radii,
    results_of,
    with_readings,
)
from counterspin.calibration.result_parts import (
    AccelerometerResult,
    Coefficient,
    Finding,
)
from counterspin.calibration.triad import triad_result
from counterspin.campaign.settings import OBSERVABLES
from counterspin.inference.identifiability import Assessment
from counterspin.inference.joint.budget import budget, what_if
from counterspin.inference.joint.estimation import Estimate, estimate
from counterspin.inference.joint.unknowns import ROTATION, Unknown
from counterspin.inference.poses import TriadPoses
from counterspin.physics.terms import TERMS
from counterspin.records.averages import RecordMean

#: An input axis that no pose turns below the level by more than asin of this was never down.
_DOWN: Final = 0.3

#: Rates whose ratio is smaller count as one rate.
_SAME_RATE: Final = 1.05

#: What determines a term of which nothing more is known.
_PRIOR: Final = " State what is known of it in [model.priors], or remove it from model.terms."

#: Poses whose directions differ by less count as one direction in words, rad (3 deg).
_APART: Final = math.radians(3.0)


def _beside_stated(unknown: Unknown, c: Coefficient) -> Coefficient:
    """Return an estimate as far as it is from what is stated of it: a shorter arm is no mistake."""
    stated = unknown.prior_mean
    return c if c.value is None else c.model_copy(update={"value": c.value - stated})


def joint(problem: JointProblem) -> Outcome:
    """Fit all records of a campaign together."""
    campaign, observed, model = problem.campaign, problem.observed, problem.model
    estimated, read = estimate_campaign(problem)
    assessment = estimated.fit.assessment
    views = [
        AccelerometerView(problem, estimated, assessment, name).with_parts(read.parts)
        for name in campaign.accelerometers
    ]
    compared = compare_methods(views)
    shared = {
        unknown: coefficient(estimated, assessment, index)
        for index, unknown in enumerate(model.asked)
        if unknown.symbol not in TERMS and unknown.owner not in campaign.accelerometers
    } | _rotations(estimated, assessment)
    each = (
        (unknown.symbol, unknown.name, _beside_stated(unknown, c)) for unknown, c in shared.items()
    )
    beyond = list(incredible_shared(campaign.limit_of, each))
    shared |= radii(campaign, shared)
    outliers: dict[str, int] = {run.run.name: 0 for run in observed}
    for record, mask in zip(estimated.series, estimated.outliers, strict=True):
        outliers[record.run] += int(record.count[mask].sum())
    longest = max((float(record.time[-1]) for record in estimated.series), default=0.0)
    faults = unseen_faults(views)
    accelerometers = {
        view.name: _accelerometer(view, compared[view.name], read.recorded.means, faults[view.name])
        for view in views
    }
    terms = {
        run.run.name: {u.symbol: c for u, c in shared.items() if u.owner == run.run.name}
        for run in observed
    }
    diagnose = find_diagnosis()
    diagnosis = diagnose(views, accelerometers) if diagnose else Diagnosis()
    rests_on = knowledge(estimated, inputs_of(campaign))
    units = {name: OBSERVABLES[a.observable] for name, a in campaign.accelerometers.items()}
    return Outcome(
        model="exact",
        triad=triad_result(campaign, estimated, read),
        accelerometers=accelerometers,
        runs={
            name: run_result(
                run, terms=terms[name], fit=run_fits(views, name), outliers=outliers[name]
            )
            for run in observed
            for name in [run.run.name]
        },
        platform={u.symbol: c for u, c in shared.items() if not u.owner},
        confounded=confounded_platform(assessment),
        correlation=whole_correlation(estimated, assessment),
        rests_on=rests_on,
        findings=[
            *(
                not_determined(
                    u.name, u.name, more=_PRIOR, requested=is_requested(campaign, u.symbol)
                )
                for u, c in shared.items()
                if c.value is None
            ),
            *large_drifts(shared, longest),
            *large_tilts(campaign, terms, accelerometers),
            *beyond,
            *beyond_typical(rests_on),
            *(() if diagnose else contradicted_prior(views[0])),
        ],
        causes=diagnosis.causes,
        remarks=(
            *remarks_of(faults),
            *diagnosis.remarks,
            *no_more_than_rounded(views),
            *overstated_noise(views),
            *hidden_walk(views),
            *other_noise(views),
            *warn_of_stated_rates(read.recorded.without_angle),
        ),
        arm_rates=read.recorded.rates,
        residuals=residual_frame(estimated.fit, units),
    )


def estimate_campaign(problem: JointProblem) -> tuple[Estimate, ReadingsAndPoses]:
    """Return the estimate from records and readings, and how the readings fit; as `joint`."""
    campaign = problem.campaign
    read = campaign.readings or campaign.posed
    from_records = None
    if problem.observed or not read:
        from_records = estimate(problem.series, problem.model, problem.noise)
    if from_records is not None and not read:
        return from_records, ReadingsAndPoses()
    return with_readings(from_records, problem.model, campaign)


def warn_of_stated_rates(runs: Sequence[str]) -> Iterator[str]:
    """Yield a remark where records on the arm have no angle."""
    if runs:
        yield (
            f"The records of {', '.join(runs)} have no angle: the mean is that over whole "
            "revolutions at the stated rate."
        )


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
    view: AccelerometerView,
    compared: MethodComparison,
    means: Mapping[tuple[str, str], RecordMean],
    faults: list[str],
) -> AccelerometerResult:
    name, estimated = view.name, view.estimate
    own = {
        symbol: coefficient(estimated, view.assessment, index)
        for symbol, index in view.places.items()
    }
    budgets = {
        symbol: budget(estimated.fit, index, name)
        for symbol, index in view.places.items()
        if own[symbol].estimated
    }
    return AccelerometerResult(
        # The campaign's order is the user's; the table of terms has its own.
        coefficients={symbol: own[symbol] for symbol in view.campaign.model.terms if symbol in own},
        correlation=correlation(view),
        confounded=confounded(view),
        residual=residual(compared.residual_view),
        noise=noise_lines(view),
        budget=budgets,
        what_if=what_if(estimated.fit, view.places, budgets, name),
        jackknife=view.jackknife(),
        two_stage=compare_two_stage(view) if view.problem.observed else None,
        traces=thin_residuals(view),
        readings=[line for part in view.readings for line in results_of(part, means)],
        kinds=compared.results,
        output=in_output_units(view.campaign, name, own),
        unseen_faults=faults,
        findings=[
            *compared.findings,
            *residual_findings(compared.residual_view),
            *outliers_of_means(name, means),
            *unseen_ripple(view),
            *_undetermined(view, own),
            *incredible(view.campaign.limit_of, name, own),
        ],
        **own_description(view.accelerometer, own),
    )


def _undetermined(view: AccelerometerView, own: Mapping[str, Coefficient]) -> Iterator[Finding]:
    for symbol, c in own.items():
        if c.value is None:
            yield not_determined(
                f"{view.name}.{symbol}",
                symbol,
                "poses" if only_posed(view) else "records",
                too_few_poses(view) or _remedy(view, symbol),
                requested=is_requested(view.campaign, symbol, view.name),
            )


def _remedy(view: AccelerometerView, symbol: str) -> str:
    """Return what would determine a term."""
    campaign = view.campaign
    if only_at_rest(campaign) and symbol in ("K_F", "K_II", *SQUARES):
        return (
            " At 1 g the squares of the specific forces add up to one, so that no set of positions "
            "separates K_II, K_PP and K_OO together from K_F: state what is known of K_PP and "
            "K_OO, or test at other forces."
        )
    rates = [abs(run.rate) for run in campaign.runs]
    rates += [abs(reading.rate) for reading in campaign.readings if reading.rate]
    if symbol in TERMS and rates and max(rates) < _SAME_RATE * min(rates):
        return " The data have one rate only; add a run at another rate."
    return _PRIOR


# Checks


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


def only_posed(view: AccelerometerView) -> bool:
    """Return whether an accelerometer has poses of unknown attitude and no other data."""
    return bool(view.poses) and not view.readings and not view.has_records


def too_few_poses(view: AccelerometerView) -> str:
    """Return what poses would have to be added; empty where readings or records are there too."""
    if not only_posed(view):
        return ""
    axes: dict[str, list[Array]] = {}
    for part in view.poses:
        group = part.readings
        assert isinstance(group, TriadPoses)
        there = group.at(view.fit.model, view.fit.solution.estimate)
        for name, own in zip(group.accelerometers, group.axes, strict=True):
            axes.setdefault(name, []).append(there.direction @ own[0])
    count, distinct = _count_directions(view)
    free = sum(math.isinf(u.prior[1]) or u.defaulted for u in view.fit.model.unknowns)
    said = []
    if count < free:
        said.append(f" {count} poses are fewer than the {free} unknowns without a prior.")
    elif distinct < free:
        said.append(
            f" The {count} poses have only {distinct} different directions, fewer than the {free} "
            "unknowns without a prior."
        )
    for way, sign in (("up", -1.0), ("down", 1.0)):
        never = [name for name, own in axes.items() if np.min(sign * np.concatenate(own)) > -_DOWN]
        if never:
            said.append(f" No pose has {' or '.join(never)} pointing {way}.")
    return (
        "".join(said) + " Take poses whose directions are spread over the whole sphere, or "
        "request fewer coefficients in model.terms: the others then enter with their default "
        "priors."
    )


def _count_directions(view: AccelerometerView) -> tuple[int, int]:
    """Return the number of poses, and of directions that differ by more than `_APART`."""
    found: list[Array] = []
    count = 0
    for part in view.poses:
        group = part.readings
        assert isinstance(group, TriadPoses)
        count += group.size
        for direction in group.at(view.fit.model, view.fit.solution.estimate).direction:
            if all(direction @ other < math.cos(_APART) for other in found):
                found.append(direction)
    return count, len(found)
