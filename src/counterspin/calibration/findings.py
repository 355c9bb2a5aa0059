"""Findings about the reliability of a result, and the state that follows from them.

Every check of a calibration reports a `Finding`. `judge_result` adds those that follow from the
numbers of the result itself, puts each below the cause that accounts for it, ranks them and sets
the states; pages only draw them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final

from counterspin.calibration.checks.limits import (
    check_credibility,
    check_default_priors,
    check_shared_credibility,
    widest_limit,
)
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import (
    AccelerometerResult,
    Coefficient,
    Comparison,
    Finding,
    MethodAgreement,
    Residual,
    State,
)
from counterspin.frozen import frozen
from counterspin.inference.diagnostics import (
    AGREEMENT_FACTOR,
    CHI_SQUARE_SIGNIFICANCE,
    SIGNIFICANCE,
    agreement_limit,
    normal_equivalent,
)
from counterspin.inference.distributions import normal_quantile
from counterspin.inference.joint.summary import Jackknife
from counterspin.reports.numbers import find_display_unit, format_number

#: Beyond this many standard uncertainties (2e-9 by chance) no uncertainty explains a difference.
CONTRADICTION_SIGMAS: Final = 6.0

#: Residuals so many times as large as the noise: the uncertainty is not of these records.
RESIDUAL_RATIO_LIMIT: Final = 2.0

#: From the best to the worst.
_STATES: Final[tuple[State, ...]] = ("good", "reservations", "not-determined", "contradicted")

#: Largest credible white noise of an inertial accelerometer, g/Hz^0.5.
LARGEST_WALK: Final = 5e-4

#: Codes of findings that say that something is wrong, but not what.
ACCOUNTABLE: Final = frozenset(
    (
        "lack-of-fit",
        "noise-implausible",
        "noise-differs",
        "run-disagrees",
        "methods-disagree",
        "incredible",
        "beyond-typical",
        "outlying-reading",
    )
)

#: Part of what a size exceeds 1 by that may remain of a finding which a cause accounts for.
_REMAINING_FRACTION: Final = 0.2


def judge_result(
    result: Result, accepted_misfit: str | None = None, causes: Sequence[Cause] = ()
) -> Result:
    """Return the result with its findings ranked and its states set.

    accepted_misfit: The reason for which a contradicted result is to be used all the same; it is
        kept where the result is contradicted.
    """
    if result.state is not None:
        return result if result.sealed and not result.assumes_all else _with_worst_state(result)
    accelerometers = {
        name: _judge_accelerometer(name, accelerometer, result, causes)
        for name, accelerometer in result.accelerometers.items()
    }
    accelerometer_findings = [
        finding
        for judged_accelerometer in accelerometers.values()
        for finding in judged_accelerometer.findings
    ]
    # What has just been calibrated was held to what its campaign says is credible.
    shared_findings = [
        *result.findings,
        *(_check_shared_terms(result) if result.assumes_all else ()),
    ]
    all_findings = rank_findings(
        merge_shared([*group_by_cause("", shared_findings, causes), *accelerometer_findings]),
        causes,
    )
    state = state_of(all_findings)
    return result.model_copy(
        update={
            "accelerometers": accelerometers,
            "findings": all_findings,
            "state": state,
            "accepted_misfit": accepted_misfit if state == "contradicted" else None,
            "warnings": [*result.warnings, *(finding.text for finding in result.findings)],
        }
    )


def _with_worst_state(result: Result) -> Result:
    """Return a result with the worst state of what speaks against it.

    Its own state nobody vouches for, or it is of a version that knew of no credible sizes.
    """
    accelerometers = {}
    for name, stated in result.accelerometers.items():
        known_findings = {(f.code, f.subject) for f in _flatten_explained(stated.findings)}
        candidates = list(check_credibility(widest_limit, name, stated.coefficients))
        if not result.sealed:
            gravity, accelerometer_count = result.inputs.gravity, len(result.accelerometers)
            candidates += _check_model(name, stated, result)
            candidates += check_statistics(name, stated, gravity, accelerometer_count)
        new = [
            finding
            for finding in candidates
            if (finding.code, finding.subject) not in known_findings
        ]
        findings = rank_findings([*stated.findings, *new])
        accelerometers[name] = stated.model_copy(
            update={
                "findings": findings,
                "state": _worst_state(stated.state, state_of(findings)),
                "warnings": [*stated.warnings, *(f"{name}: {finding.text}" for finding in new)],
            }
        )
    accelerometer_findings = [
        finding for accelerometer in accelerometers.values() for finding in accelerometer.findings
    ]
    known_findings = {(f.code, f.subject) for f in _flatten_explained(result.findings)}
    shared_findings = [
        f for f in _check_shared_terms(result) if (f.code, f.subject) not in known_findings
    ]
    all_findings = rank_findings(
        merge_shared([*result.findings, *shared_findings, *accelerometer_findings])
    )
    states = (accelerometer.state for accelerometer in accelerometers.values())
    state = _worst_state(result.state, state_of(all_findings), *states)
    return result.model_copy(
        update={"accelerometers": accelerometers, "findings": all_findings, "state": state}
    )


def _flatten_explained(findings: Iterable[Finding]) -> Iterator[Finding]:
    for finding in findings:
        yield finding
        yield from _flatten_explained(finding.explains)


def _worst_state(*states: State | None) -> State:
    return max((state for state in states if state is not None), key=_STATES.index)


def _judge_accelerometer(
    name: str, accelerometer: AccelerometerResult, result: Result, causes: Sequence[Cause]
) -> AccelerometerResult:
    # An earlier version has sentences only.
    sentences = [] if accelerometer.findings else accelerometer.warnings
    candidates = [
        *accelerometer.findings,
        *(
            Finding(code="warning", subject=name, text=text.removeprefix(f"{name}: "))
            for text in sentences
        ),
        *_check_model(name, accelerometer, result),
        *check_statistics(name, accelerometer, result.inputs.gravity, len(result.accelerometers)),
    ]
    if result.assumes_all:
        candidates += check_credibility(widest_limit, name, accelerometer.coefficients)
    findings = rank_findings(group_by_cause(name, candidates, causes), causes)
    return accelerometer.model_copy(
        update={
            "findings": findings,
            "state": state_of(findings),
            "warnings": accelerometer.warnings
            or [f"{name}: {finding.text}" for finding in findings],
        }
    )


def rank_findings(findings: Iterable[Finding], causes: Sequence[Cause] = ()) -> list[Finding]:
    """Return findings: contradictions, undetermined terms, wrong equations, causes, others by size.

    causes: In the order in which they were found, the one that explains most first.
    """
    order = {
        (cause.finding.code, cause.finding.subject): position
        for position, cause in enumerate(causes)
    }
    return sorted(
        findings,
        key=lambda finding: (
            not finding.contradicts,
            not finding.undetermined,
            finding.code != "as-printed",
            order.get((finding.code, finding.subject), len(order)),
            not finding.explains,
            -(finding.size or 0.0),
        ),
    )


def state_of(findings: Sequence[Finding]) -> State:
    """Return the state that follows from findings."""
    if any(finding.contradicts for finding in findings):
        return "contradicted"
    if any(finding.undetermined for finding in findings):
        return "not-determined"
    return "reservations" if findings else "good"


def refusal_reason(result: Result, names: Iterable[str]) -> str | None:
    """Return the reason against certifying or applying a result; None if there is none."""
    if result.accepted_misfit is not None:
        return None
    for name in names:
        accelerometer = result.accelerometers[name]
        if accelerometer.state == "contradicted":
            why = "".join(f"{finding.text} " for finding in accelerometer.findings[:1])
            return (
                f"the records contradict the result for {name}: {why}Find the cause and "
                "calibrate again, or accept the misfit and state the reason (accept_misfit of "
                "calibrate)"
            )
    return None


# Findings from the numbers of a result


def _check_model(
    name: str, accelerometer: AccelerometerResult, result: Result
) -> Iterator[Finding]:
    known_findings = {(finding.code, finding.subject) for finding in accelerometer.findings}
    if result.model == "as-printed" and ("as-printed", name) not in known_findings:
        yield Finding(
            code="as-printed",
            subject=name,
            text="The equations as printed in the paper yield half the true K_II.",
        )
    k_ii, subject = accelerometer.coefficients.get("K_II"), f"{name}.K_II"
    if (
        k_ii is not None
        and not k_ii.estimated
        and ("not-determined", subject) not in known_findings
    ):
        yield Finding(
            code="not-determined", subject=subject, text="The records do not determine K_II."
        )


def _check_shared_terms(result: Result) -> Iterator[Finding]:
    """Yield findings on platform, machine, runs and default priors."""
    run_terms = (
        (symbol, f"{run}.{symbol}", c)
        for run, run_result in result.runs.items()
        for symbol, c in run_result.terms.items()
    )
    platform_terms = (
        (symbol, symbol, _deviation(c, result.inputs.radius))
        if symbol.startswith("centrifuge.radius.")
        else (symbol, symbol, c)
        for symbol, c in result.platform.items()
    )
    yield from check_shared_credibility(widest_limit, (*platform_terms, *run_terms))
    yield from check_default_priors(result.rests_on)


def _deviation(c: Coefficient, nominal: float) -> Coefficient:
    value = None if c.value is None else c.value - nominal
    return c.model_copy(update={"value": value})


def check_statistics(
    name: str, accelerometer: AccelerometerResult, gravity: float, accelerometer_count: int
) -> Iterator[Finding]:
    """Yield findings from the residuals, the noise, the runs and the two-stage method.

    gravity: m/s^2.
    """
    known_findings = {(finding.code, finding.subject) for finding in accelerometer.findings}
    if ("lack-of-fit", name) not in known_findings:
        yield from _check_fit(name, accelerometer.residual, accelerometer_count)
    yield from _check_noise(name, accelerometer, gravity)
    # Where the residuals are far beyond the noise, uncertainties are too small by as much, and what
    # exceeds them for that reason alone is no finding of its own.
    excess = _noise_ratio(accelerometer.residual) or 1.0
    excess = excess if excess > RESIDUAL_RATIO_LIMIT else 1.0
    yield from _check_jackknife(name, accelerometer.jackknife, excess, accelerometer_count)
    if (two_stage := accelerometer.two_stage) is not None and not methods_agree(two_stage, excess):
        z = abs(two_stage.z) / excess
        yield Finding(
            code="methods-disagree",
            subject=f"{name}.K_II",
            text="The result of the two-stage method differs: the two estimates of K_II differ "
            f"by {format_number(z)} standard uncertainties of the difference.",
            size=z,
        )


def _check_fit(name: str, residual: Residual, accelerometer_count: int) -> Iterator[Finding]:
    p = residual.lack_of_fit_p
    if p is None or _is_acceptable_fit(residual, accelerometer_count):
        return
    ratio = _noise_ratio(residual)
    description = (
        "are not consistent with independent noise"
        if ratio is None
        else f"are {format_number(ratio)} times as large as the stated noise"
    )
    text = f"The residuals {description} (p = {format_number(p, 2)})."
    yield lack_of_fit_finding(name, [text], residual)


def not_determined_finding(
    subject: str, symbol: str, data: str = "records", more: str = "", *, requested: bool = False
) -> Finding:
    """Return the finding that data do not determine a coefficient; `more` is what to do.

    requested: Whether the state follows from it; see `counterspin.calibration.model.is_requested`.
    """
    text = f"The {data} do not determine {symbol}, and no prior is stated for {symbol}.{more}"
    return Finding(code="not-determined", subject=subject, text=text, undetermined=requested)


def lack_of_fit_finding(name: str, sentences: Sequence[str], residual: Residual) -> Finding:
    """Return the finding that the residuals of an accelerometer are not its noise."""
    further_count = len(sentences) - 1
    text = sentences[0] + (
        f" ({further_count} more findings of this type concern other runs.)"
        if further_count > 1
        else ""
    )
    p, ratio = residual.lack_of_fit_p, _noise_ratio(residual)
    # A few residuals, such as two readings, are as large by chance now and then.
    significant = p is not None and equivalent_deviations(p) > CONTRADICTION_SIGMAS
    return Finding(
        code="lack-of-fit",
        subject=name,
        text=text,
        size=ratio if ratio is not None or p is None else equivalent_deviations(p),
        contradicts=significant and ratio is not None and ratio > RESIDUAL_RATIO_LIMIT,
    )


def equivalent_deviations(p: float) -> float:
    """Return the distance, in standard deviations, that a normal variable exceeds with p."""
    return -normal_quantile(0.5 * max(p, 1e-300))


def _is_acceptable_fit(residual: Residual, accelerometer_count: int = 1) -> bool:
    """Return whether the probability of a worse fit is no reason for a finding.

    All accelerometers of a campaign share the significance.
    """
    # With stated noise it is chi-square's own, which shares the significance with other tests.
    limit = SIGNIFICANCE if residual.chi2 is None else CHI_SQUARE_SIGNIFICANCE
    p = residual.lack_of_fit_p
    return p is None or p >= limit / accelerometer_count


def _noise_ratio(residual: Residual) -> float | None:
    """Return the size of the residuals relative to the stated noise."""
    if residual.chi2 is None or not residual.dof > 0.0:
        return None
    return math.sqrt(residual.chi2 / residual.dof)


def _check_noise(
    name: str, accelerometer: AccelerometerResult, gravity: float
) -> Iterator[Finding]:
    walk = accelerometer.noise.get("acceleration")
    if walk is None or not walk.estimated:
        return
    relative_walk = walk.value / gravity / LARGEST_WALK
    if relative_walk > 1.0:
        yield Finding(
            code="noise-implausible",
            subject=name,
            text=f"The estimated accelerometer noise, {1e6 * relative_walk * LARGEST_WALK:.0f} "
            f"ug/Hz^0.5, exceeds the largest credible value, {1e6 * LARGEST_WALK:.0f} "
            "ug/Hz^0.5. Such an estimate conceals a misfit, for example from a mistake in "
            "the description or from a few outliers.",
            size=relative_walk,
            contradicts=True,
        )


def _check_jackknife(
    name: str, lines: Sequence[Jackknife], excess: float, accelerometer_count: int
) -> Iterator[Finding]:
    compared_count = sum(1 for line in lines if line.z is not None)
    worst_line = _largest_shift(lines)
    if worst_line is None or worst_line.z is None or worst_line.shift is None:
        return
    z = abs(worst_line.z) / excess
    equivalent_z = normal_equivalent(z, worst_line.dof)
    if equivalent_z <= agreement_limit(compared_count * accelerometer_count):
        return
    unit, factor = find_display_unit("g/g^2")
    yield Finding(
        code="run-disagrees",
        subject=f"{name}.K_II",
        text=f"Omitting {worst_line.run} shifts K_II by "
        f"{format_number(worst_line.shift * factor, 2)} {unit}, which is {z:.1f} times the "
        "standard uncertainty of the shift. This run is therefore not consistent with the "
        "others.",
        size=equivalent_z,
        contradicts=equivalent_z > CONTRADICTION_SIGMAS,
    )


def _largest_shift(lines: Sequence[Jackknife]) -> Jackknife | None:
    compared_lines = [line for line in lines if line.z is not None]
    return max(compared_lines, key=_significance, default=None)


def _significance(line: Jackknife) -> float:
    return normal_equivalent(line.z or 0.0, line.dof)


# What speaks for a result


def method_test_level(methods: Sequence[MethodAgreement]) -> float:
    """Return the probability below which test methods disagree: all tests share a level."""
    return SIGNIFICANCE / sum(1 + len(method.without) for method in methods)


def methods_agree(comparison: Comparison, excess: float = 1.0) -> bool:
    """Return whether the two methods agree; `excess`: the residuals' size over the noise's."""
    return abs(comparison.z) / excess <= AGREEMENT_FACTOR


def supporting_evidence(accelerometer: AccelerometerResult) -> Iterator[tuple[str, str]]:
    """Yield the evidence for a result: the check, and a clause without a full stop."""
    residual = accelerometer.residual
    p = residual.lack_of_fit_p
    if p is not None and _is_acceptable_fit(residual):
        noise = "the stated noise" if residual.chi2 is not None else "independent noise"
        yield "fit", f"the residuals are consistent with {noise} (p = {format_number(p, 2)})"
    worst_line = _largest_shift(accelerometer.jackknife)
    if worst_line is not None and _significance(worst_line) <= AGREEMENT_FACTOR:
        yield "leave-one-run-out", "no single run dominates the result"
    if accelerometer.two_stage is not None and methods_agree(accelerometer.two_stage):
        yield "another method", "the two-stage result agrees with the joint result"


# Causes, and what they account for


@frozen
class Cause:
    """A cause that was found."""

    finding: Finding  #: What is said of it.
    accelerometers: tuple[str, ...]  #: Whose results it concerns.
    #: Code and subject of what the checks would still find if it were put right, and its size. The
    #: two-stage method is not tried again: its disagreement remains where a lack of fit does.
    remaining: Mapping[tuple[str, str], float]

    def accounts_for(self, name: str, finding: Finding) -> bool:
        """Return whether a finding of an accelerometer would be gone if this were put right."""
        is_method_check = finding.code == "methods-disagree"
        code, subject = (
            ("lack-of-fit", name) if is_method_check else (finding.code, finding.subject)
        )
        remaining_size = self.remaining.get((code, subject))
        if finding.code not in ACCOUNTABLE:
            return False
        return remaining_size is None or (
            finding.code != "methods-disagree"
            and remaining_size - 1.0 < _REMAINING_FRACTION * ((finding.size or 0.0) - 1.0)
        )


def group_by_cause(
    name: str, findings: Iterable[Finding], causes: Sequence[Cause]
) -> list[Finding]:
    """Return the causes of an accelerometer's findings, then what they do not account for.

    name: The accelerometer's; empty: what is found of platform, machine and inputs.
    """
    unexplained, grouped_findings = list(findings), []
    for cause in causes:
        if name and name not in cause.accelerometers:
            continue
        explained = [finding for finding in unexplained if cause.accounts_for(name, finding)]
        unexplained = [finding for finding in unexplained if finding not in explained]
        grouped_findings.append(_attach_explained(cause.finding, explained))
    return [*grouped_findings, *unexplained]


def merge_shared(findings: Iterable[Finding]) -> list[Finding]:
    """Return findings with those that several accelerometers share once."""
    known: dict[tuple[str, str, str], Finding] = {}
    for finding in findings:
        key = finding.code, finding.subject, finding.text
        known[key] = _attach_explained(known[key], finding.explains) if key in known else finding
    return list(known.values())


def _attach_explained(head: Finding, explained: Sequence[Finding]) -> Finding:
    attached_findings = [
        *head.explains,
        *(finding for finding in explained if finding not in head.explains),
    ]
    grave = head.contradicts or any(finding.contradicts for finding in attached_findings)
    return head.model_copy(update={"explains": attached_findings, "contradicts": grave})
