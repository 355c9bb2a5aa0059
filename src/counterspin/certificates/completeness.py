"""Data that a certificate lacks before it can be issued.

A certificate that lacks something is a draft: every page says so, and nobody can sign it.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, Final

from counterspin.calibration.result import Result
from counterspin.certificates.certificate_text import is_determined
from counterspin.certificates.evidence import ALL, name_with_words, terms_without_evidence
from counterspin.certificates.lab import Lab, read_lab, template_keys, with_required_keys
from counterspin.errors import CampaignError
from counterspin.frozen import frozen
from counterspin.reports.numbers import format_share

#: Share of the variance from which a default uncertainty needs evidence: without it, u would be
#: smaller by more than 5 %.
EVIDENCE_SHARE: Final = 0.1

_TEMPLATE: Final = "this entry still has the value from the template; replace it"


@frozen
class MissingEntry:
    """A key of the laboratory's data that has to be filled in."""

    key: str  #: Of ``LAB.toml``, such as ``item.model``.
    words: str  #: What is missing, and what to write.


def missing_data(lab: Lab, result: Result) -> list[MissingEntry]:
    """Return the data that the certificate of a result lacks: values, conditions, evidence."""
    return [*missing_administrative_data(lab), *_missing_evidence(lab, result)]


def missing_administrative_data(lab: Lab) -> list[MissingEntry]:
    """Return the data that any certificate lacks: values of the template, and conditions."""
    template = [MissingEntry(key, _TEMPLATE) for key in template_keys(lab)]
    return [*template, *_missing_conditions(lab)]


def missing_evidence(source: str, share: float, quantity: str) -> MissingEntry:
    """Return the entry for a default uncertainty that causes a share of a variance."""
    return MissingEntry(
        f"evidence.{source}",
        f"this entry is missing; the default standard uncertainty of {name_with_words(source)} "
        f"contributes {format_share(share)} of the variance of {quantity}. Give evidence for a "
        "bound on this term, such as a data sheet, or state a prior for the term in the campaign",
    )


def missing_despite_mistakes(
    document: Mapping[str, Any], invalid_keys: Collection[str], result: Result
) -> list[MissingEntry]:
    """Return the data that are missing in a document with mistakes, as far as it can be read.

    invalid_keys: Sections with mistakes; in these, only values of the template are found.
    """
    template = [
        MissingEntry(key, _TEMPLATE)
        for key in template_keys({key: document[key] for key in invalid_keys if key in document})
    ]
    valid_document = {key: value for key, value in document.items() if key not in invalid_keys}
    try:
        lab, _ = read_lab(with_required_keys(valid_document), result)
    except CampaignError:
        return template
    others = (
        entry for entry in missing_data(lab, result) if section_of(entry.key) not in invalid_keys
    )
    return [*template, *others]


def section_of(key: str) -> str:
    """Return the section of a key, such as ``persons`` of ``persons[0].name``."""
    return re.split(r"[.\[]", key, maxsplit=1)[0]


def missing_lines(entries: Sequence[MissingEntry]) -> list[str]:
    """Return a line for each entry; one line for all keys with values of the template."""
    keys = [entry.key for entry in entries if entry.words == _TEMPLATE]
    lines = (
        [
            f"{', '.join(keys)}: these entries still have the values from the template; replace "
            "them before signing"
        ]
        if keys
        else []
    )
    return lines + [f"{e.key}: {e.words}" for e in entries if e.words != _TEMPLATE]


def _missing_conditions(lab: Lab) -> Iterator[MissingEntry]:
    if lab.conditions.temperature is None:
        yield MissingEntry(
            "conditions.temperature",
            "this entry is missing; a certificate must state the environmental conditions that "
            'influence the results (ISO/IEC 17025, 7.8.4.1 b), such as temperature = "20.0 ± '
            '0.3 degC"',
        )


def _missing_evidence(lab: Lab, result: Result) -> Iterator[MissingEntry]:
    for term in terms_without_evidence(result.assumed, lab.evidence):
        yield MissingEntry(
            f"evidence.{term}",
            "this entry is missing, but the result fixes this term at its nominal value. Give "
            "evidence for a bound on this term",
        )
    lacking = dict[str, tuple[float, str]]()
    for name, source, share, symbol in _default_shares(lab, result):
        if not any(_supports(key, name, source) for key in lab.evidence):
            lacking[source] = max(lacking.get(source, (0.0, "")), (share, f"{symbol} of {name}"))
    for source, (share, coefficient) in lacking.items():
        yield missing_evidence(source, share, coefficient)


def _default_shares(lab: Lab, result: Result) -> Iterator[tuple[str, str, float, str]]:
    """Yield accelerometer, source, share and coefficient of default uncertainties that carry u.

    Only certified coefficients count, and shares of at least `EVIDENCE_SHARE`.
    """
    for name in lab.certified(result):
        accelerometer = result.accelerometers[name]
        for symbol, lines in accelerometer.budget.items():
            if not is_determined(accelerometer.coefficients[symbol]):
                continue
            for line in lines:
                if line.kind == "unstated" and line.share >= EVIDENCE_SHARE:
                    yield name, line.source, line.share, symbol


def _supports(key: str, name: str, source: str) -> bool:
    """Return whether a key of [evidence] covers a source of an accelerometer's uncertainty."""
    return any(not terms_without_evidence([s], {key: ""}) for s in (source, f"{name}.{source}"))


def default_evidence(lab: Lab, result: Result) -> list[str]:
    """Return the laboratory's texts for default uncertainties, each with its term."""
    lines = (
        f"{name_with_words(source if key == ALL else key)}: {text}"
        for name, source, *_ in _default_shares(lab, result)
        for key, text in lab.evidence.items()
        if _supports(key, name, source)
    )
    return list(dict.fromkeys(lines))
