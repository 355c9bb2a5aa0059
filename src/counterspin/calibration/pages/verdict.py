"""Verdict on a result and its conformity with specifications, as text and tables."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from counterspin.calibration.findings import supporting_evidence
from counterspin.calibration.pages.accelerometer import to_field_units
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import AccelerometerResult, Coefficient, Finding, State
from counterspin.inference.verdicts import Conformity
from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Style, Table
from counterspin.reports.numbers import (
    find_display_unit,
    format_estimate,
    format_number,
    format_probability,
    format_uncertainty,
)

_STATE_DESCRIPTIONS: Final = {
    "good": "passed all checks",
    "reservations": "is usable with reservations",
    "not-determined": "is not fully determined by the data",
    "contradicted": "is contradicted by the records and must not be used",
}

#: States in which a page lists the supporting evidence.
_USABLE_STATES: Final = ("good", "reservations")

#: State -> style of the sentence on it.
_STATE_STYLES: Final[dict[State, Style]] = {
    "good": "plain",
    "reservations": "warning",
    "not-determined": "undetermined",
    "contradicted": "warning",
}

_COLUMNS = (
    Column("Accelerometer"),
    Column("Term"),
    Column("Estimate"),
    Column("Tolerance"),
    Column("Unit"),
    Column("Verdict"),
    Column("Conforms with", "right", wraps=True),
    Column("Specific risk", "right"),
)


def verdict_sentence(name: str, accelerometer: AccelerometerResult) -> str:
    """Return a sentence on the state of an accelerometer's result, with the reason."""
    assert accelerometer.state is not None
    opening = f"The result for {name} {_describe_state(accelerometer)}"
    evidence_text = "; ".join(clause for _, clause in supporting_evidence(accelerometer))
    if accelerometer.findings:
        sentences = [f"{opening}: {finding_text(accelerometer.findings[0])}"]
        if n_remaining := len(accelerometer.findings) - 1:
            sentences.append(
                "One more finding is listed below."
                if n_remaining == 1
                else f"{n_remaining} more findings are listed below."
            )
        if evidence_text and accelerometer.state in _USABLE_STATES:
            sentences.append(f"Passed checks: {evidence_text}.")
    elif evidence_text and accelerometer.unseen_faults:
        sentences = [f"{opening}.", f"Passed checks: {evidence_text}."]
    else:
        sentences = [f"{opening}: {evidence_text}." if evidence_text else f"{opening}."]
    return " ".join(sentences)


def _describe_state(accelerometer: AccelerometerResult) -> str:
    assert accelerometer.state is not None
    if accelerometer.state == "good" and accelerometer.unseen_faults:
        return "passed all checks, but the readings test only part of the model"
    return _STATE_DESCRIPTIONS[accelerometer.state]


def finding_text(finding: Finding) -> str:
    """Return the text of a finding and of the findings that it explains."""
    if not finding.explains:
        return finding.text
    explained_text = " ".join(explained_finding.text for explained_finding in finding.explains)
    return f"{finding.text} This explains these other findings: {explained_text}"


def verdict_blocks(result: Result) -> Iterator[Block]:
    """Yield state and findings of each accelerometer of a judged result."""
    for name, accelerometer in result.accelerometers.items():
        assert accelerometer.state is not None
        yield Paragraph(verdict_sentence(name, accelerometer), _STATE_STYLES[accelerometer.state])
        # The sentence contains the first finding.
        for finding in accelerometer.findings[1:]:
            yield Paragraph(f"Warning for {name}: {finding_text(finding)}", "warning")


def verdict_tables(result: Result) -> Iterator[Block]:
    """Yield the content of `verdict_blocks` as a sentence and a table of the checks."""
    for name, accelerometer in result.accelerometers.items():
        assert accelerometer.state is not None
        findings, count = accelerometer.findings, len(accelerometer.findings)
        summary_text = "1 finding" if count == 1 else f"{count} findings, most serious first"
        yield Paragraph(
            f"The result for {name} {_describe_state(accelerometer)}"
            + (f" ({summary_text})." if findings else "."),
            _STATE_STYLES[accelerometer.state],
        )
        rows = [(_check_title(name, finding), finding_text(finding)) for finding in findings]
        if accelerometer.state in _USABLE_STATES:
            rows += [
                (_capitalize(check), f"{_capitalize(clause)}.")
                for check, clause in supporting_evidence(accelerometer)
            ]
        if rows:
            yield Table((Column("Check", wraps=True), Column("Outcome", wraps=True)), tuple(rows))


def _check_title(name: str, finding: Finding) -> str:
    """Return a short title of a finding, with its subject."""
    title, subject = finding.code.replace("-", " "), finding.subject.removeprefix(f"{name}.")
    return _capitalize(title) if subject in ("", name) else f"{_capitalize(title)}: {subject}"


def _capitalize(text: str) -> str:
    return text[:1].upper() + text[1:]


def misfit_blocks(result: Result) -> Iterator[Block]:
    """Yield a warning if a result is contradicted or not determined."""
    if result.state not in ("not-determined", "contradicted") or not result.findings:
        return
    first_finding = result.findings[0]
    if result.state == "not-determined":
        yield Paragraph(
            f"The data do not fully determine this result ({first_finding.subject}). "
            f"{first_finding.text}",
            "undetermined",
        )
        return
    yield Paragraph(
        f"The records contradict this result ({first_finding.subject}). {first_finding.text} Do "
        "not use the estimates below, because their uncertainties are not valid.",
        "warning",
    )
    if result.accepted_misfit is not None:
        yield Paragraph(f"The misfit was accepted: {result.accepted_misfit}", "warning")


# Specifications


def conformity_blocks(result: Result) -> Iterator[Block]:
    """Yield the verdicts and their decision rules; nothing without a specification."""
    verdicts = [
        (name, symbol, verdict, accelerometer.coefficients.get(symbol))
        for name, accelerometer in result.accelerometers.items()
        for symbol, verdict in accelerometer.conformity.items()
    ]
    if not verdicts:
        return
    yield Heading("Conformity")
    yield Table(
        _COLUMNS,
        tuple(
            (
                name,
                symbol,
                _estimate_cell(coefficient),
                _tolerance_cell(verdict),
                find_display_unit(verdict.unit)[0],
                verdict.verdict,
                "-" if verdict.probability is None else format_probability(verdict.probability),
                "-" if verdict.risk is None else format_probability(verdict.risk),
            )
            for name, symbol, verdict, coefficient in verdicts
        ),
        quiet_rows=frozenset(
            i for i, (_, _, verdict, _) in enumerate(verdicts) if verdict.probability is None
        ),
    )
    for name, symbol, verdict, _ in verdicts:
        if verdict.verdict == "fail":
            yield Paragraph(f"{symbol} of {name} does not meet the specification.", "warning")
        elif verdict.reason is not None:
            yield Paragraph(
                f"Conformity of {symbol} of {name} is undecided, because {verdict.reason}.",
                "warning",
            )
    for name, symbol, verdict, _ in verdicts:
        if (risk := verdict.global_risk) is not None:
            unit, factor = find_display_unit(verdict.unit)
            process_text = format_estimate(risk.mean * factor, risk.sigma * factor, unit)
            yield Paragraph(
                f"Global risks for {symbol} of {name}, for items from a process with "
                f"{process_text}: consumer's risk {format_probability(risk.consumer)} (an item "
                "passes but does not conform); producer's risk "
                f"{format_probability(risk.producer)} (an item conforms but does not pass).",
                "quiet",
            )
    for rule in dict.fromkeys(describe_rule(verdict) for _, _, verdict, _ in verdicts):
        yield Paragraph(rule, "quiet")
    guard_band_texts = [
        f"{symbol} of {name} {_guard_band_text(verdict)}"
        for name, symbol, verdict, _ in verdicts
        if verdict.guard_band
    ]
    if guard_band_texts:
        yield Paragraph(f"Widths w of the guard bands: {'; '.join(guard_band_texts)}.", "quiet")


def describe_rule(verdict: Conformity) -> str:
    """Return the decision rule of a verdict, as a certificate must state it."""
    risk_text = (
        "For a pass, the specific risk is the probability of false acceptance (specific "
        "consumer's risk). For a fail, the specific risk is the probability of false rejection "
        "(specific producer's risk; JCGM 106:2012)."
    )
    if verdict.rule == "simple":
        return (
            "Decision rule: simple acceptance. The verdict depends only on the estimate. "
            f"{risk_text}"
        )
    if verdict.rule == "guarded":
        return (
            "Decision rule: guard bands of width w. The verdict is pass if the estimate lies "
            "inside the tolerance limits by at least w, fail if it lies outside by more than w, "
            f"and undecided otherwise. {risk_text}"
        )
    assert verdict.needed is not None
    percent_text = format_number(100.0 * verdict.needed, 6)
    return (
        "Decision rule: probability of conformity. The verdict is pass if the coefficient "
        f"conforms with a probability of at least {percent_text} %, fail if the probability of "
        f"non-conformity is at least as high, and undecided otherwise. {risk_text}"
    )


def _estimate_cell(coefficient: Coefficient | None) -> str:
    if coefficient is None or not coefficient.estimated:
        return "-"
    value, u, _ = to_field_units(coefficient)
    return format_estimate(value, u)


def _tolerance_cell(verdict: Conformity) -> str:
    """Return the tolerance limits in the unit in which the estimate is shown."""
    _, factor = find_display_unit(verdict.unit)
    low_text, high_text = (
        None if limit is None else format_number(limit * factor, 9)
        for limit in (verdict.low, verdict.high)
    )
    if low_text is None:
        return f"at most {high_text}"
    return f"at least {low_text}" if high_text is None else f"{low_text} to {high_text}"


def _guard_band_text(verdict: Conformity) -> str:
    assert verdict.guard_band is not None
    unit, factor = find_display_unit(verdict.unit)
    return f"{format_uncertainty(verdict.guard_band * factor)} {unit}"
