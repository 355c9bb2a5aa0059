"""[evidence] of ``LAB.toml``: bounds of terms that a result fixes at nominal values.

A term that is fixed at its nominal value does not contribute to u. Therefore, a certificate must
justify each fixed term, for example with a measurement or a data sheet.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Final

from counterspin.errors import CampaignError
from counterspin.physics.terms import TABLE, describe_term, find_symbol, is_term

#: Key of [evidence], or name in `assume`, for all unstated terms.
ALL_TERMS: Final = "all"


def terms_without_evidence(fixed_terms: Sequence[str], evidence: Mapping[str, str]) -> list[str]:
    """Return the fixed terms without an entry in [evidence]."""
    return [name for name in fixed_terms if not any(_covers_term(key, name) for key in evidence)]


def _covers_term(key: str, name: str) -> bool:
    """Return whether a key of [evidence] covers a fixed term."""
    if key == ALL_TERMS:
        return True
    term = name if _is_pattern(name) else find_symbol(name)
    return any(
        fnmatchcase(candidate, key) or candidate.startswith(f"{key}.")
        for candidate in dict.fromkeys((name, term))
    )


def _is_pattern(name: str) -> bool:
    return any(character in name for character in "*?[")


def is_known_key(key: str, accelerometers: Collection[str]) -> bool:
    """Return whether a key names terms of these accelerometers or of the machine."""
    prefix, _, suffix = key.partition(".")
    if prefix in accelerometers and suffix and not is_term(key):
        return is_known_key(suffix, ())
    return key == ALL_TERMS or is_term(key) or any(_covers_term(key, symbol) for symbol in TABLE)


def require_evidence(fixed_terms: Sequence[str], evidence: Mapping[str, str], source: str) -> None:
    """Raise CampaignError if a fixed term has no entry in [evidence].

    source: Name of the laboratory data in the message.
    """
    missing_terms = terms_without_evidence(fixed_terms, evidence)
    if not missing_terms:
        return
    # A common prefix represents several terms.
    missing_terms = list(dict.fromkeys(".".join(name.split(".")[:2]) for name in missing_terms))
    lines = " ".join(f'"{name}" = "..."' for name in missing_terms)
    problem = (
        f"evidence: the result fixes {', '.join(missing_terms)} at nominal values, so u does not "
        "include these terms. In [evidence], give evidence for a bound on each term, such as a "
        f"measurement or a data sheet: {lines}. Alternatively, calibrate without fixing these "
        "terms"
    )
    raise CampaignError(source, [problem], code="certificate-incomplete")


def evidence_lines(fixed_terms: Sequence[str], evidence: Mapping[str, str]) -> Iterator[str]:
    """Yield the evidence for fixed terms, each with its terms."""
    for key, text in evidence.items():
        if any(_covers_term(key, name) for name in fixed_terms):
            yield f"{', '.join(fixed_terms) if key == ALL_TERMS else describe_source(key)}: {text}"


def describe_source(source: str) -> str:
    """Return a term or source of uncertainty with its description in parentheses."""
    description = describe_term(source)
    return f"{source} ({description})" if description else source
