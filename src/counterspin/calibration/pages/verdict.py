"""Whether a result is good, in words."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from counterspin.calibration.findings import supports
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import AccelerometerResult, Finding
from counterspin.reports.blocks import Block, Column, Paragraph, Table

_OPENINGS: Final = {
    "good": "is good",
    "reservations": "can be used with reservations",
    "contradicted": "is contradicted by its records and must not be used",
}


def verdict_sentence(name: str, accelerometer: AccelerometerResult) -> str:
    """Return in words whether an accelerometer's result is good, and why."""
    assert accelerometer.state is not None
    opening = f"{name} {_OPENINGS[accelerometer.state]}"
    speaks_for = "; ".join(clause for _, clause in supports(accelerometer))
    if accelerometer.findings:
        sentences = [f"{opening}: {finding_text(accelerometer.findings[0])}"]
        if more := len(accelerometer.findings) - 1:
            sentences.append(
                f"There {'is 1 more finding' if more == 1 else f'are {more} more findings'}."
            )
        if speaks_for and accelerometer.state != "contradicted":
            sentences.append(f"In its favour: {speaks_for}.")
    else:
        sentences = [f"{opening}: {speaks_for}." if speaks_for else f"{opening}."]
    return " ".join(sentences)


def finding_text(finding: Finding) -> str:
    """Return what was found, and of a cause what it accounts for."""
    if not finding.explains:
        return finding.text
    others = " ".join(other.text for other in finding.explains)
    return f"{finding.text} That explains the other findings: {others}"


def verdict_blocks(result: Result) -> Iterator[Block]:
    """Yield for each accelerometer of a judged result whether it is good, and what was found."""
    for name, accelerometer in result.accelerometers.items():
        yield Paragraph(
            verdict_sentence(name, accelerometer),
            "plain" if accelerometer.state == "good" else "warning",
        )
        # The first of them stands in the sentence.
        for finding in accelerometer.findings[1:]:
            yield Paragraph(f"Warning: {name}: {finding_text(finding)}", "warning")


def verdict_tables(result: Result) -> Iterator[Block]:
    """Yield the same as `verdict_blocks` as a sentence and a table of what was checked."""
    for name, accelerometer in result.accelerometers.items():
        assert accelerometer.state is not None
        found, count = accelerometer.findings, len(accelerometer.findings)
        why = f"{count} findings, the most serious first" if found else "no check found a fault"
        why = "1 finding" if count == 1 else why
        yield Paragraph(
            f"{name} {_OPENINGS[accelerometer.state]}: {why}.",
            "plain" if accelerometer.state == "good" else "warning",
        )
        rows = [(_check(name, finding), finding_text(finding)) for finding in found]
        if accelerometer.state != "contradicted":
            rows += [
                (_capital(check), f"{_capital(clause)}.")
                for check, clause in supports(accelerometer)
            ]
        if rows:
            yield Table((Column("Check", wraps=True), Column("Outcome", wraps=True)), tuple(rows))


def _check(name: str, finding: Finding) -> str:
    """Return what a finding is about, in a word or two, and of what it is."""
    words, about = finding.code.replace("-", " "), finding.subject.removeprefix(f"{name}.")
    return _capital(words) if about in ("", name) else f"{_capital(words)}: {about}"


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def misfit_blocks(result: Result) -> Iterator[Block]:
    """Yield the first lines of a judged result whose records contradict it; nothing otherwise."""
    if result.state != "contradicted":
        return
    first = result.findings[0]
    yield Paragraph(
        f"The records contradict this result ({first.subject}): {first.text} Do not "
        "use the numbers below; their uncertainties are not valid.",
        "warning",
    )
    if result.accepted_misfit is not None:
        yield Paragraph(f"The misfit was accepted: {result.accepted_misfit}", "warning")
