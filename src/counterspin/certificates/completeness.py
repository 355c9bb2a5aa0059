"""Missing data that prevent the issue of a certificate.

A certificate with missing data is a draft: every page is marked, and it cannot be signed.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, Final

from counterspin.calibration.result import Result
from counterspin.certificates.certificate_text import is_determined
from counterspin.certificates.evidence import ALL_TERMS, describe_source, terms_without_evidence
from counterspin.certificates.lab import Lab, add_required_keys, read_lab, template_keys
from counterspin.errors import CampaignError
from counterspin.frozen import frozen
from counterspin.reports.numbers import format_share

#: Share of the variance above which a default uncertainty requires evidence: without this
#: contribution, u would be more than 5 % smaller.
MIN_EVIDENCE_SHARE: Final = 0.1

_TEMPLATE_MESSAGE: Final = "this entry still has the value from the template; replace it"


@frozen
class MissingEntry:
    """A key of the laboratory data that must be completed."""

    key: str  #: Key of ``LAB.toml``, such as ``item.model``.
    message: str  #: Problem and remedy.


def missing_data(lab: Lab, result: Result) -> list[MissingEntry]:
    """Return the missing data of the certificate of a result: values, conditions, evidence."""
    return [*missing_administrative_data(lab), *_missing_evidence_entries(lab, result)]


def missing_administrative_data(lab: Lab) -> list[MissingEntry]:
    """Return missing data of any certificate: values of the template, and conditions."""
    template_entries = [MissingEntry(key, _TEMPLATE_MESSAGE) for key in template_keys(lab)]
    return [*template_entries, *_missing_condition_entries(lab)]


def missing_evidence_entry(source: str, share: float, quantity: str) -> MissingEntry:
    """Return the missing entry of a default uncertainty with its share of a variance."""
    return MissingEntry(
        f"evidence.{source}",
        f"this entry is missing; the default standard uncertainty of {describe_source(source)} "
        f"contributes {format_share(share)} of the variance of {quantity}. Give evidence for a "
        "bound on this term, such as a data sheet, or state a prior for the term in the campaign",
    )


def missing_data_despite_mistakes(
    document: Mapping[str, Any], invalid_keys: Collection[str], result: Result
) -> list[MissingEntry]:
    """Return the missing data of a document with mistakes.

    invalid_keys: Sections with mistakes; only values of the template are detected in them.
    """
    template_entries = [
        MissingEntry(key, _TEMPLATE_MESSAGE)
        for key in template_keys({key: document[key] for key in invalid_keys if key in document})
    ]
    valid_document = {key: value for key, value in document.items() if key not in invalid_keys}
    try:
        lab, _ = read_lab(add_required_keys(valid_document), result)
    except CampaignError:
        return template_entries
    other_entries = (
        entry for entry in missing_data(lab, result) if section_name(entry.key) not in invalid_keys
    )
    return [*template_entries, *other_entries]


def section_name(key: str) -> str:
    """Return the section of a key, such as ``persons`` of ``persons[0].name``."""
    return re.split(r"[.\[]", key, maxsplit=1)[0]


def missing_lines(entries: Sequence[MissingEntry]) -> list[str]:
    """Return a line for each entry, and one line for all keys with values of the template."""
    keys = [entry.key for entry in entries if entry.message == _TEMPLATE_MESSAGE]
    lines = (
        [
            f"{', '.join(keys)}: these entries still have the values from the template; replace "
            "them before signing"
        ]
        if keys
        else []
    )
    return lines + [
        f"{entry.key}: {entry.message}" for entry in entries if entry.message != _TEMPLATE_MESSAGE
    ]


def _missing_condition_entries(lab: Lab) -> Iterator[MissingEntry]:
    if lab.conditions.temperature is None:
        yield MissingEntry(
            "conditions.temperature",
            "this entry is missing; a certificate must state the environmental conditions that "
            'influence the results (ISO/IEC 17025, 7.8.4.1 b), such as temperature = "20.0 ± '
            '0.3 degC"',
        )


def _missing_evidence_entries(lab: Lab, result: Result) -> Iterator[MissingEntry]:
    for term in terms_without_evidence(result.assumed, lab.evidence):
        yield MissingEntry(
            f"evidence.{term}",
            "this entry is missing, but the result fixes this term at its nominal value. Give "
            "evidence for a bound on this term",
        )
    share_by_source = dict[str, tuple[float, str]]()
    for name, source, share, symbol in _default_shares(lab, result):
        if not any(_is_evidence_for(key, name, source) for key in lab.evidence):
            share_by_source[source] = max(
                share_by_source.get(source, (0.0, "")), (share, f"{symbol} of {name}")
            )
    for source, (share, coefficient) in share_by_source.items():
        yield missing_evidence_entry(source, share, coefficient)


def _default_shares(lab: Lab, result: Result) -> Iterator[tuple[str, str, float, str]]:
    """Yield accelerometer, source, share and coefficient of important default uncertainties.

    Only certified coefficients and shares of at least `MIN_EVIDENCE_SHARE` are included.
    """
    for name in lab.certified_names(result):
        accelerometer = result.accelerometers[name]
        for symbol, lines in accelerometer.budget.items():
            if not is_determined(accelerometer.coefficients[symbol]):
                continue
            for line in lines:
                if line.kind == "unstated" and line.share >= MIN_EVIDENCE_SHARE:
                    yield name, line.source, line.share, symbol


def _is_evidence_for(key: str, name: str, source: str) -> bool:
    """Return whether a key of [evidence] covers a source of uncertainty of an accelerometer."""
    return any(
        not terms_without_evidence([candidate], {key: ""})
        for candidate in (source, f"{name}.{source}")
    )


def default_evidence_lines(lab: Lab, result: Result) -> list[str]:
    """Return the evidence for default uncertainties, each with its term."""
    lines = (
        f"{describe_source(source if key == ALL_TERMS else key)}: {text}"
        for name, source, *_ in _default_shares(lab, result)
        for key, text in lab.evidence.items()
        if _is_evidence_for(key, name, source)
    )
    return list(dict.fromkeys(lines))
