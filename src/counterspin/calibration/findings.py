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
    max_limit,
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

#: Ratio of residuals to noise above which the uncertainty does not apply to these records.
RESIDUAL_RATIO_LIMIT: Final = 2.0

#: From the best to the worst.
_STATES: Final[tuple[State, ...]] = ("good", "reservations", "not-determined", "contradicted")

#: Largest credible white noise of an inertial accelerometer, g/Hz^0.5.
MAX_RANDOM_WALK: Final = 5e-4

#: Codes of findings that report a symptom, which a cause may explain.
EXPLAINABLE_CODES: Final = frozenset(
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

#: Largest fraction of (size - 1) that may remain of a finding after its cause is removed.
_MAX_REMAINING_FRACTION: Final = 0.2


def judge_result(
    result: Result, accepted_misfit: str | None = None, causes: Sequence[Cause] = ()
) -> Result:
    """Return the result with its findings ranked and its states set.

    accepted_misfit: Reason for using a contradicted result; stored only if it is contradicted.
    """
    if result.state is not None:
        return result if result.sealed and not result.assumes_all else _update_state(result)
    accelerometers = {
        name: _judge_accelerometer(name, accelerometer, result, causes)
        for name, accelerometer in result.accelerometers.items()
    }
    accelerometer_findings = [
        finding
        for judged_accelerometer in accelerometers.values()
        for finding in judged_accelerometer.findings
    ]
    # A new calibration has already been checked against the limits of its campaign.
    findings = [*result.findings, *(_check_shared_terms(result) if result.assumes_all else ())]
    all_findings = rank_findings(
        merge_shared_findings([*group_by_cause("", findings, causes), *accelerometer_findings]),
        causes,
    )
    state = determine_state(all_findings)
    return result.model_copy(
        update={
            "accelerometers": accelerometers,
            "findings": all_findings,
            "state": state,
            "accepted_misfit": accepted_misfit if state == "contradicted" else None,
            "warnings": [*result.warnings, *(finding.text for finding in result.findings)],
        }
    )


def _update_state(result: Result) -> Result:
    """Return a stored result with the worst state among its findings and new checks.

    The result has no valid seal, or is from a version without credibility limits.
    """
    accelerometers = {}
    for name, accelerometer in result.accelerometers.items():
        known_keys = _keys(_flatten_explained(accelerometer.findings))
        candidates = list(check_credibility(max_limit, name, accelerometer.coefficients))
        if not result.sealed:
            gravity, n_accelerometers = result.inputs.gravity, len(result.accelerometers)
            candidates += _check_model(name, accelerometer, result)
            candidates += check_statistics(name, accelerometer, gravity, n_accelerometers)
        new_findings = [
            finding for finding in candidates if (finding.code, finding.subject) not in known_keys
        ]
        findings = rank_findings([*accelerometer.findings, *new_findings])
        accelerometers[name] = accelerometer.model_copy(
            update={
                "findings": findings,
                "state": _worst_state(accelerometer.state, determine_state(findings)),
                "warnings": [
                    *accelerometer.warnings,
                    *(f"{name}: {finding.text}" for finding in new_findings),
                ],
            }
        )
    accelerometer_findings = [
        finding for accelerometer in accelerometers.values() for finding in accelerometer.findings
    ]
    known_keys = _keys(_flatten_explained(result.findings))
    shared_findings = [
        finding
        for finding in _check_shared_terms(result)
        if (finding.code, finding.subject) not in known_keys
    ]
    all_findings = rank_findings(
        merge_shared_findings([*result.findings, *shared_findings, *accelerometer_findings])
    )
    states = (accelerometer.state for accelerometer in accelerometers.values())
    state = _worst_state(result.state, determine_state(all_findings), *states)
    return result.model_copy(
        update={"accelerometers": accelerometers, "findings": all_findings, "state": state}
    )


def _flatten_explained(findings: Iterable[Finding]) -> Iterator[Finding]:
    for finding in findings:
        yield finding
        yield from _flatten_explained(finding.explains)


def _keys(findings: Iterable[Finding]) -> set[tuple[str, str]]:
    return {(finding.code, finding.subject) for finding in findings}


def _worst_state(*states: State | None) -> State:
    return max((state for state in states if state is not None), key=_STATES.index)


def _judge_accelerometer(
    name: str, accelerometer: AccelerometerResult, result: Result, causes: Sequence[Cause]
) -> AccelerometerResult:
    # Earlier versions wrote warnings instead of findings.
    old_warnings = [] if accelerometer.findings else accelerometer.warnings
    candidates = [
        *accelerometer.findings,
        *(
            Finding(code="warning", subject=name, text=text.removeprefix(f"{name}: "))
            for text in old_warnings
        ),
        *_check_model(name, accelerometer, result),
        *check_statistics(name, accelerometer, result.inputs.gravity, len(result.accelerometers)),
    ]
    if result.assumes_all:
        candidates += check_credibility(max_limit, name, accelerometer.coefficients)
    findings = rank_findings(group_by_cause(name, candidates, causes), causes)
    return accelerometer.model_copy(
        update={
            "findings": findings,
            "state": determine_state(findings),
            "warnings": accelerometer.warnings
            or [f"{name}: {finding.text}" for finding in findings],
        }
    )


def rank_findings(findings: Iterable[Finding], causes: Sequence[Cause] = ()) -> list[Finding]:
    """Return findings: contradictions, undetermined terms, wrong equations, causes, others by size.

    causes: In the order of detection, the best explanation first.
    """
    ranks = {(cause.finding.code, cause.finding.subject): rank for rank, cause in enumerate(causes)}
    return sorted(
        findings,
        key=lambda finding: (
            not finding.contradicts,
            not finding.undetermined,
            finding.code != "as-printed",
            ranks.get((finding.code, finding.subject), len(ranks)),
            not finding.explains,
            -(finding.size or 0.0),
        ),
    )


def determine_state(findings: Sequence[Finding]) -> State:
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
            finding_text = "".join(f"{finding.text} " for finding in accelerometer.findings[:1])
            return (
                f"the records contradict the result for {name}: {finding_text}Find the cause and "
                "calibrate again, or accept the misfit and state the reason (accept_misfit of "
                "calibrate)"
            )
    return None


# Findings from the numbers of a result


def _check_model(
    name: str, accelerometer: AccelerometerResult, result: Result
) -> Iterator[Finding]:
    known_keys = _keys(accelerometer.findings)
    if result.model == "as-printed" and ("as-printed", name) not in known_keys:
        yield Finding(
            code="as-printed",
            subject=name,
            text="The equations as printed in the paper yield half the true K_II.",
        )
    k_ii, subject = accelerometer.coefficients.get("K_II"), f"{name}.K_II"
    if k_ii is not None and not k_ii.estimated and ("not-determined", subject) not in known_keys:
        yield Finding(
            code="not-determined", subject=subject, text="The records do not determine K_II."
        )


def _check_shared_terms(result: Result) -> Iterator[Finding]:
    """Yield findings on platform, machine, runs and default priors."""
    run_terms = (
        (symbol, f"{run}.{symbol}", coefficient)
        for run, run_result in result.runs.items()
        for symbol, coefficient in run_result.terms.items()
    )
    platform_terms = (
        (symbol, symbol, _subtract_nominal(coefficient, result.inputs.radius))
        if symbol.startswith("centrifuge.radius.")
        else (symbol, symbol, coefficient)
        for symbol, coefficient in result.platform.items()
    )
    yield from check_shared_credibility(max_limit, (*platform_terms, *run_terms))
    yield from check_default_priors(result.rests_on)


def _subtract_nominal(coefficient: Coefficient, nominal: float) -> Coefficient:
    value = None if coefficient.value is None else coefficient.value - nominal
    return coefficient.model_copy(update={"value": value})


def check_statistics(
    name: str, accelerometer: AccelerometerResult, gravity: float, n_accelerometers: int
) -> Iterator[Finding]:
    """Yield findings from the residuals, the noise, the runs and the two-stage method.

    gravity: m/s^2.
    """
    known_keys = _keys(accelerometer.findings)
    if ("lack-of-fit", name) not in known_keys:
        yield from _check_fit(name, accelerometer.residual, n_accelerometers)
    yield from _check_noise(name, accelerometer, gravity)
    # If the residuals are much larger than the noise, all uncertainties are too small by this
    # ratio, which must not cause further findings.
    noise_ratio = _noise_ratio(accelerometer.residual) or 1.0
    noise_ratio = noise_ratio if noise_ratio > RESIDUAL_RATIO_LIMIT else 1.0
    yield from _check_jackknife(name, accelerometer.jackknife, noise_ratio, n_accelerometers)
    if (two_stage := accelerometer.two_stage) is not None and not methods_agree(
        two_stage, noise_ratio
    ):
        z = abs(two_stage.z) / noise_ratio
        yield Finding(
            code="methods-disagree",
            subject=f"{name}.K_II",
            text="The result of the two-stage method differs: the two estimates of K_II differ "
            f"by {format_number(z)} standard uncertainties of the difference.",
            size=z,
        )


def _check_fit(name: str, residual: Residual, n_accelerometers: int) -> Iterator[Finding]:
    p = residual.lack_of_fit_p
    if p is None or _is_acceptable_fit(residual, n_accelerometers):
        return
    ratio = _noise_ratio(residual)
    comparison_text = (
        "are not consistent with independent noise"
        if ratio is None
        else f"are {format_number(ratio)} times as large as the stated noise"
    )
    text = f"The residuals {comparison_text} (p = {format_number(p, 2)})."
    yield lack_of_fit_finding(name, [text], residual)


def not_determined_finding(
    subject: str,
    symbol: str,
    data_name: str = "records",
    advice: str = "",
    *,
    is_requested: bool = False,
) -> Finding:
    """Return the finding that the data do not determine a coefficient.

    data_name: Name of the data in the text.
    advice: Sentence on the action to take, with a leading space.
    is_requested: Whether the finding sets the state; see `calibration.model.is_requested`.
    """
    text = (
        f"The {data_name} do not determine {symbol}, and no prior is stated for {symbol}.{advice}"
    )
    return Finding(code="not-determined", subject=subject, text=text, undetermined=is_requested)


def lack_of_fit_finding(name: str, sentences: Sequence[str], residual: Residual) -> Finding:
    """Return the finding that the residuals of an accelerometer do not agree with its noise."""
    n_remaining = len(sentences) - 1
    text = sentences[0] + (
        f" (There are {n_remaining} more findings of this type.)" if n_remaining > 1 else ""
    )
    p, ratio = residual.lack_of_fit_p, _noise_ratio(residual)
    # With few residuals, such as two readings, a large ratio may occur by chance.
    is_significant = p is not None and two_sided_z(p) > CONTRADICTION_SIGMAS
    return Finding(
        code="lack-of-fit",
        subject=name,
        text=text,
        size=ratio if ratio is not None or p is None else two_sided_z(p),
        contradicts=is_significant and ratio is not None and ratio > RESIDUAL_RATIO_LIMIT,
    )


def two_sided_z(p: float) -> float:
    """Return the number of standard deviations with the two-sided normal tail probability p."""
    return -normal_quantile(0.5 * max(p, 1e-300))


def _is_acceptable_fit(residual: Residual, n_accelerometers: int = 1) -> bool:
    """Return whether p is above the significance level, which all accelerometers share."""
    # With stated noise, chi-square shares the significance level with other tests.
    limit = SIGNIFICANCE if residual.chi2 is None else CHI_SQUARE_SIGNIFICANCE
    p = residual.lack_of_fit_p
    return p is None or p >= limit / n_accelerometers


def _noise_ratio(residual: Residual) -> float | None:
    """Return the ratio of the residuals to the stated noise; None if the noise was estimated."""
    if residual.chi2 is None or not residual.dof > 0.0:
        return None
    return math.sqrt(residual.chi2 / residual.dof)


def _check_noise(name: str, accelerometer: AccelerometerResult, g: float) -> Iterator[Finding]:
    random_walk = accelerometer.noise.get("acceleration")
    if random_walk is None or not random_walk.estimated:
        return
    ratio = random_walk.value / g / MAX_RANDOM_WALK
    if ratio > 1.0:
        yield Finding(
            code="noise-implausible",
            subject=name,
            text=f"The estimated accelerometer noise, {1e6 * ratio * MAX_RANDOM_WALK:.0f} "
            f"ug/Hz^0.5, exceeds the largest credible value, {1e6 * MAX_RANDOM_WALK:.0f} "
            "ug/Hz^0.5. Such an estimate conceals a misfit, for example from a mistake in "
            "the description or from a few outliers.",
            size=ratio,
            contradicts=True,
        )


def _check_jackknife(
    name: str, lines: Sequence[Jackknife], noise_ratio: float, n_accelerometers: int
) -> Iterator[Finding]:
    n_tested = sum(1 for line in lines if line.z is not None)
    worst_line = _largest_shift_line(lines)
    if worst_line is None or worst_line.z is None or worst_line.shift is None:
        return
    z = abs(worst_line.z) / noise_ratio
    equivalent_z = normal_equivalent(z, worst_line.dof)
    if equivalent_z <= agreement_limit(n_tested * n_accelerometers):
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


def _largest_shift_line(lines: Sequence[Jackknife]) -> Jackknife | None:
    tested_lines = [line for line in lines if line.z is not None]
    return max(tested_lines, key=_significance, default=None)


def _significance(line: Jackknife) -> float:
    return normal_equivalent(line.z or 0.0, line.dof)


# Supporting evidence


def method_test_level(methods: Sequence[MethodAgreement]) -> float:
    """Return the significance level of each test of the methods; all tests share one level."""
    return SIGNIFICANCE / sum(1 + len(method.without) for method in methods)


def methods_agree(comparison: Comparison, noise_ratio: float = 1.0) -> bool:
    """Return whether the two methods agree; noise_ratio: ratio of residuals to noise."""
    return abs(comparison.z) / noise_ratio <= AGREEMENT_FACTOR


def supporting_evidence(accelerometer: AccelerometerResult) -> Iterator[tuple[str, str]]:
    """Yield the evidence for a result: the check, and a clause without a full stop."""
    residual = accelerometer.residual
    p = residual.lack_of_fit_p
    if p is not None and _is_acceptable_fit(residual):
        noise_text = "the stated noise" if residual.chi2 is not None else "independent noise"
        yield "fit", f"the residuals are consistent with {noise_text} (p = {format_number(p, 2)})"
    worst_line = _largest_shift_line(accelerometer.jackknife)
    if worst_line is not None and _significance(worst_line) <= AGREEMENT_FACTOR:
        yield "leave-one-run-out", "no single run dominates the result"
    if accelerometer.two_stage is not None and methods_agree(accelerometer.two_stage):
        yield "another method", "the two-stage result agrees with the joint result"


# Causes and the findings that they explain


@frozen
class Cause:
    """A cause of a misfit."""

    finding: Finding  #: Its finding.
    accelerometers: tuple[str, ...]  #: Names of the affected accelerometers.
    #: (code, subject) -> size of the findings that remain without this cause. The two-stage method
    #: is not repeated: its disagreement remains if a lack of fit does.
    remaining_sizes: Mapping[tuple[str, str], float]

    def accounts_for(self, name: str, finding: Finding) -> bool:
        """Return whether a finding of an accelerometer disappears without this cause."""
        if finding.code not in EXPLAINABLE_CODES:
            return False
        if finding.code == "methods-disagree":
            return ("lack-of-fit", name) not in self.remaining_sizes
        size = self.remaining_sizes.get((finding.code, finding.subject))
        return size is None or size - 1.0 < _MAX_REMAINING_FRACTION * ((finding.size or 0.0) - 1.0)


def group_by_cause(
    name: str, findings: Iterable[Finding], causes: Sequence[Cause]
) -> list[Finding]:
    """Return the causes of an accelerometer's findings, then the unexplained findings.

    name: Name of the accelerometer; empty: findings on platform, machine and inputs.
    """
    unexplained_findings, grouped_findings = list(findings), []
    for cause in causes:
        if name and name not in cause.accelerometers:
            continue
        explained_findings = [
            finding for finding in unexplained_findings if cause.accounts_for(name, finding)
        ]
        unexplained_findings = [
            finding for finding in unexplained_findings if finding not in explained_findings
        ]
        grouped_findings.append(_attach_explained(cause.finding, explained_findings))
    return [*grouped_findings, *unexplained_findings]


def merge_shared_findings(findings: Iterable[Finding]) -> list[Finding]:
    """Return findings without duplicates among accelerometers."""
    findings_by_key: dict[tuple[str, str, str], Finding] = {}
    for finding in findings:
        key = finding.code, finding.subject, finding.text
        findings_by_key[key] = (
            _attach_explained(findings_by_key[key], finding.explains)
            if key in findings_by_key
            else finding
        )
    return list(findings_by_key.values())


def _attach_explained(cause: Finding, findings: Sequence[Finding]) -> Finding:
    explained_findings = [
        *cause.explains,
        *(finding for finding in findings if finding not in cause.explains),
    ]
    contradicts = cause.contradicts or any(finding.contradicts for finding in explained_findings)
    return cause.model_copy(update={"explains": explained_findings, "contradicts": contradicts})
