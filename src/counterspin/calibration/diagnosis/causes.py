"""Causes beside what they account for: one finding for each cause, the others below it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from counterspin.calibration.result_parts import Finding
from counterspin.frozen import frozen

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
_PART_LEFT: Final = 0.2


@frozen
class Cause:
    """A cause that was found."""

    finding: Finding  #: What is said of it.
    accelerometers: tuple[str, ...]  #: Whose results it concerns.
    #: Code and subject of what the checks would still find if it were put right, and its size. The
    #: two-stage method is not tried again: its disagreement remains where a lack of fit does.
    remaining: Mapping[tuple[str, str], float]

    def accounts_for(self, name: str, found: Finding) -> bool:
        """Return whether a finding of an accelerometer would be gone if this were put right."""
        by_method = found.code == "methods-disagree"
        code, subject = ("lack-of-fit", name) if by_method else (found.code, found.subject)
        left = self.remaining.get((code, subject))
        if found.code not in ACCOUNTABLE:
            return False
        return left is None or (
            found.code != "methods-disagree"
            and left - 1.0 < _PART_LEFT * ((found.size or 0.0) - 1.0)
        )


def below_causes(name: str, found: Iterable[Finding], causes: Sequence[Cause]) -> list[Finding]:
    """Return the causes of an accelerometer's findings, then what they do not account for.

    name: The accelerometer's; empty: what is found of platform, machine and inputs.
    """
    left, heads = list(found), []
    for cause in causes:
        if name and name not in cause.accelerometers:
            continue
        explained = [finding for finding in left if cause.accounts_for(name, finding)]
        left = [finding for finding in left if finding not in explained]
        heads.append(_above(cause.finding, explained))
    return [*heads, *left]


def merged(found: Iterable[Finding]) -> list[Finding]:
    """Return findings with those that several accelerometers share once."""
    known: dict[tuple[str, str, str], Finding] = {}
    for finding in found:
        key = finding.code, finding.subject, finding.text
        known[key] = _above(known[key], finding.explains) if key in known else finding
    return list(known.values())


def _above(head: Finding, explained: Sequence[Finding]) -> Finding:
    below = [*head.explains, *(finding for finding in explained if finding not in head.explains)]
    grave = head.contradicts or any(finding.contradicts for finding in below)
    return head.model_copy(update={"explains": below, "contradicts": grave})
