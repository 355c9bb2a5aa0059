"""[evidence] of ``LAB.toml``: bounds of the terms that a result takes as perfect.

A term that a description assumes to be perfect adds nothing to u. Therefore a certificate that
states u has to justify each such term with a text of the laboratory, such as a measurement or a
data sheet.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Final

from counterspin.errors import CampaignError
from counterspin.physics.terms import TABLE, describe_term, find_symbol, is_term

#: Key of [evidence], or name in `assume`, for all unstated terms.
ALL: Final = "all"


def terms_without_evidence(assumed: Sequence[str], evidence: Mapping[str, str]) -> list[str]:
    """Return the terms without a text in [evidence]."""
    return [name for name in assumed if not any(_covers(key, name) for key in evidence)]


def _covers(key: str, name: str) -> bool:
    """Return whether a key of [evidence] covers an assumed term."""
    if key == ALL:
        return True
    term = name if _is_pattern(name) else find_symbol(name)
    return any(
        fnmatchcase(candidate, key) or candidate.startswith(f"{key}.")
        for candidate in dict.fromkeys((name, term))
    )


def _is_pattern(name: str) -> bool:
    return any(sign in name for sign in "*?[")


def names_terms(key: str, accelerometers: Collection[str]) -> bool:
    """Return whether a key names terms of these accelerometers or of the machine."""
    owner, _, rest = key.partition(".")
    if owner in accelerometers and rest and not is_term(key):
        return names_terms(rest, ())
    return key == ALL or is_term(key) or any(_covers(key, symbol) for symbol in TABLE)


def require_evidence(assumed: Sequence[str], evidence: Mapping[str, str], source: str) -> None:
    """Refuse a certificate of a result with assumptions that the laboratory does not justify.

    source: Name of the laboratory's data in the message.
    """
    lacking = terms_without_evidence(assumed, evidence)
    if not lacking:
        return
    # A common prefix stands for several terms.
    lacking = list(dict.fromkeys(".".join(name.split(".")[:2]) for name in lacking))
    lines = " ".join(f'"{name}" = "..."' for name in lacking)
    problem = (
        f"evidence: the result fixes {', '.join(lacking)} at nominal values, so u does not "
        "include these terms. In [evidence], give evidence for a bound on each term, such as a "
        f"measurement or a data sheet: {lines}. Alternatively, calibrate without fixing these "
        "terms"
    )
    raise CampaignError(source, [problem], code="certificate-incomplete")


def evidence_lines(assumed: Sequence[str], evidence: Mapping[str, str]) -> Iterator[str]:
    """Yield the texts for assumed terms, each with its terms."""
    for key, text in evidence.items():
        if any(_covers(key, name) for name in assumed):
            yield f"{', '.join(assumed) if key == ALL else name_with_words(key)}: {text}"


def name_with_words(source: str) -> str:
    """Return a term or source of uncertainty with its description in parentheses."""
    words = describe_term(source)
    return f"{source} ({words})" if words else source
