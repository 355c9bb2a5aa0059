"""The joint method: from observed runs to every coefficient that full records determine."""

from __future__ import annotations

from collections.abc import Mapping

from counterspin.calibration.diagnosis.attitude_findings import large_tilts, shared_findings
from counterspin.calibration.diagnosis.credible import (
    beyond_typical,
    incredible,
    incredible_shared,
)
from counterspin.calibration.diagnosis.kinds import Kinds, compare_kinds
from counterspin.calibration.diagnosis.mountings import other_mountings, unseen_axes
from counterspin.calibration.diagnosis.pose_findings import too_few_poses
from counterspin.calibration.diagnosis.reading_findings import (
    no_more_than_rounded,
    outliers_of_means,
)
from counterspin.calibration.diagnosis.search import causes_of
from counterspin.calibration.diagnosis.untested import untested
from counterspin.calibration.findings import not_determined
from counterspin.calibration.joint_checks import (
    compare,
    residual_findings,
    run_fits,
    unseen_ripple,
)
from counterspin.calibration.joint_parts import (
    coefficient,
    confounded,
    confounded_platform,
    correlation,
    hidden_walk,
    knowledge,
    noise_lines,
    other_noise,
    residual,
    whole_correlation,
)
from counterspin.calibration.joint_problem import JointProblem
from counterspin.calibration.joint_view import AccelerometerView
from counterspin.calibration.model import SQUARES, inputs_of
from counterspin.calibration.notebook.residuals import residuals_of
from counterspin.calibration.notebook.traces import traces
from counterspin.calibration.outcome import Outcome, run_result
from counterspin.calibration.posed.triad import triad_result
from counterspin.calibration.readings import (
    ReadingsAndPoses,
    in_output_units,
    only_at_rest,
    radii,
    results_of,
    with_readings,
)
from counterspin.calibration.result import described
from counterspin.calibration.result_parts import AccelerometerResult, Coefficient, Finding
from counterspin.campaign.settings import OBSERVABLES
from counterspin.inference.identifiability import Assessment
from counterspin.inference.joint.budget import budget, what_if
from counterspin.inference.joint.estimation import Estimate, estimate
from counterspin.inference.joint.unknowns import ROTATION, Unknown
from counterspin.physics.terms import TERMS
from counterspin.records.mean import RecordMean


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
    kinds = compare_kinds(views)
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
    accelerometers = {
        view.name: _accelerometer(view, kinds[view.name], read.means) for view in views
    }
    terms = {
        run.run.name: {u.symbol: c for u, c in shared.items() if u.owner == run.run.name}
        for run in observed
    }
    mountings = other_mountings(views)
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
            *shared_findings(shared, longest),
            *large_tilts(campaign, terms, accelerometers),
            *beyond,
            *beyond_typical(rests_on),
        ],
        causes=causes_of(views, accelerometers, mountings),
        remarks=(
            *unseen_axes(mountings),
            *untested(views),
            *no_more_than_rounded(views),
            *hidden_walk(views),
            *other_noise(views),
        ),
        residuals=residuals_of(estimated.fit, units),
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
    kinds: Kinds,
    means: Mapping[tuple[str, str], RecordMean],
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
        residual=residual(kinds.judged),
        noise=noise_lines(view),
        budget=budgets,
        what_if=what_if(estimated.fit, view.places, budgets, name),
        jackknife=view.jackknife(),
        two_stage=compare(view) if view.problem.observed else None,
        traces=traces(view),
        readings=[line for part in view.readings for line in results_of(part, means)],
        kinds=kinds.results,
        output=in_output_units(view.campaign, name, own),
        findings=[
            *kinds.findings,
            *residual_findings(kinds.judged),
            *outliers_of_means(name, means),
            *unseen_ripple(view),
            *_undetermined(view, own),
            *incredible(view.campaign.limit_of, name, own),
        ],
        **described(view.accelerometer, own),
    )


def _undetermined(view: AccelerometerView, own: Mapping[str, Coefficient]) -> list[Finding]:
    at_rest = only_at_rest(view.campaign)
    squares = (
        " At 1 g the squares of the specific forces add up to one, so that no set of positions "
        "separates K_II, K_PP and K_OO together from K_F: state what is known of K_PP and "
        "K_OO, or test at other forces."
    )
    return [
        not_determined(
            f"{view.name}.{symbol}",
            symbol,
            more=too_few_poses(view)
            or (squares if at_rest and symbol in ("K_F", "K_II", *SQUARES) else ""),
        )
        for symbol, c in own.items()
        if c.value is None
    ]
