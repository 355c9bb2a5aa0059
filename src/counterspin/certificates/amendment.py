"""Replacement of an issued certificate by an amended one (ISO/IEC 17025:2017, 7.8.8)."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final
from unicodedata import normalize

from counterspin.certificates.certificate_reader import (
    EARLIER_PREFIX,
    CertificateNumbers,
    CertifiedAccelerometer,
    read_certificate,
    read_document,
)
from counterspin.certificates.certificate_text import coverage_factor
from counterspin.certificates.schema import NAMESPACES, Element, parse
from counterspin.errors import CampaignError, RecordError, UsageError
from counterspin.frozen import frozen
from counterspin.reports.numbers import field_unit, format_estimate

#: Hash algorithm of a replaced certificate's checksum, as the new certificate states it.
HASH_ALGORITHM: Final = "SHA-256"

_ADMINISTRATIVE: Final = "/dcc:digitalCalibrationCertificate/dcc:administrativeData"

#: Sections that are compared as text, by name -> XPath.
_COMPARED_SECTIONS: Final = {
    "calibrated item": f"{_ADMINISTRATIVE}/dcc:items",
    "laboratory": f"{_ADMINISTRATIVE}/dcc:calibrationLaboratory/dcc:contact",
    "accreditation": f"{_ADMINISTRATIVE}/dcc:calibrationLaboratory/dcc:calibrationLaboratoryCode",
    "responsible persons": f"{_ADMINISTRATIVE}/dcc:respPersons",
    "customer": f"{_ADMINISTRATIVE}/dcc:customer",
    "date of receipt": f"{_ADMINISTRATIVE}/dcc:coreData/dcc:receiptDate",
    "dates of the calibration": f"{_ADMINISTRATIVE}/dcc:coreData/*[contains(name(), 'eDate')]"
    "[contains(name(), 'Performance')]",
    "place of the calibration": f"{_ADMINISTRATIVE}/dcc:coreData/dcc:performanceLocation",
    "method": "//dcc:measurementResult[1]/dcc:usedMethods",
    "conditions": "//dcc:measurementResult[1]/dcc:influenceConditions",
    "input files": "//dcc:metaData[dcc:name/dcc:content='Input files and their checksums']",
}


@frozen
class Amendment:
    """The certificate to be replaced, and the reason."""

    path: Path  #: The issued certificate, XML or PDF.
    reason: str  #: Reason for the replacement.


@frozen
class AmendedCertificate:
    """A certificate that a new one replaces."""

    identifier: str  #: Identifier of the replaced certificate.
    checksum: str  #: SHA-256 of its XML, hexadecimal.
    reason: str  #: Reason for the replacement.
    changes: tuple[str, ...] = ()  #: Changes in the new certificate, in sentences.
    #: Identifiers of the certificates that the replaced one replaced, newest first.
    earlier: tuple[str, ...] = ()

    def next_identifier(self) -> str:
        """Return an identifier for the new certificate, if the laboratory gives none."""
        numbered = re.fullmatch(r"(.*)-A(\d+)", self.identifier)
        if numbered is None:
            return f"{self.identifier}-A1"
        return f"{numbered[1]}-A{int(numbered[2]) + 1}"


def read_amended(amendment: Amendment) -> tuple[AmendedCertificate, bytes]:
    """Return the data of the replaced certificate, and its XML."""
    if not amendment.reason.strip():
        raise UsageError("certificate", ["`reason`: give the reason for replacing the certificate"])
    data = read_document(amendment.path)
    numbers = read_certificate(data, str(amendment.path))
    if numbers.identifier.startswith("DRAFT-"):
        raise RecordError(
            f"{amendment.path} is a draft that was never issued, so it cannot be amended",
            code="wrong-amendment",
        )
    checksum = hashlib.sha256(data).hexdigest()
    reason = " ".join(amendment.reason.split())
    amended = AmendedCertificate(numbers.identifier, checksum, reason, earlier=numbers.replaced)
    return amended, data


def check_new_identifier(identifier: str, amended: AmendedCertificate) -> None:
    """Refuse the identifier of the amended certificate or of an earlier one.

    Identifiers that differ only in blanks or capitals count as equal.
    """
    if _is_same_identifier(identifier, amended.identifier):
        problem = "is the identifier of the amended certificate"
    elif any(_is_same_identifier(identifier, earlier) for earlier in amended.earlier):
        problem = f"is the identifier of a certificate that {amended.identifier} amends"
    else:
        return
    remedy = "each certificate must have a unique identifier"
    raise CampaignError(
        "certificate.identifier", [f'"{identifier}" {problem}; {remedy}'], code="duplicate-entry"
    )


def _is_same_identifier(first: str, second: str) -> bool:
    keys = ["".join(normalize("NFKC", text).split()).casefold() for text in (first, second)]
    return keys[0] == keys[1]


def record_changes(amended: AmendedCertificate, old: bytes, new: bytes) -> AmendedCertificate:
    """Return the amendment with the changes between the old and the new XML."""
    return replace(amended, changes=tuple(describe_changes(old, new)))


def describe_changes(old: bytes, new: bytes) -> list[str]:
    """Return sentences about the differences between two certificates, numbers first."""
    before, after = (read_certificate(data, "the certificate") for data in (old, new))
    return [
        *_number_changes(before, after),
        *_text_changes(parse(old, "the certificate"), parse(new, "the certificate")),
    ] or ["The amendment changes only the identifier and the date of issue."]


def amendment_lines(amended: AmendedCertificate | None) -> list[str]:
    """Return the statements about the replaced certificate; an empty list without one."""
    if amended is None:
        return []
    return [
        f"This certificate amends and replaces certificate {amended.identifier} "
        f"(SHA-256 of its XML: {amended.checksum}).",
        *amendment_reasons(amended),
        *(f"Changed: {change}" for change in amended.changes),
    ]


def amendment_reasons(amended: AmendedCertificate) -> list[str]:
    """Return the reason of the replacement, and the earlier replaced certificates."""
    earlier = [f"{EARLIER_PREFIX}{identifier}" for identifier in amended.earlier]
    return [f"Reason: {amended.reason}", *earlier]


def verify_amended(new: bytes, old: Path, source: str) -> str:
    """Return the identifier of a replaced certificate; RecordError if `new` does not amend it."""
    previous = _select(
        parse(new, source), f"{_ADMINISTRATIVE}/dcc:coreData/dcc:previousReport/dcc:value"
    )
    data = read_document(old)
    if not previous:
        raise RecordError(f"{source} does not amend a certificate", code="wrong-amendment")
    if previous[0].text != hashlib.sha256(data).hexdigest():
        raise RecordError(
            f"{source} does not amend {old}, or {old} has been changed since it was amended",
            code="wrong-amendment",
        )
    before, after = read_certificate(data, str(old)), read_certificate(new, source)
    if any(
        _is_same_identifier(after.identifier, earlier)
        for earlier in (before.identifier, *before.replaced)
    ):
        raise RecordError(
            f"{source} has the identifier of {old} or of a certificate that {old} amends. The "
            "amendments are therefore circular; do not rely on any of these certificates",
            code="wrong-amendment",
        )
    return before.identifier


def _number_changes(before: CertificateNumbers, after: CertificateNumbers) -> Iterator[str]:
    old_values, new_values = _certified_values(before), _certified_values(after)
    for name in dict.fromkeys([*old_values, *new_values]):
        versions = [
            values[name].coefficients if name in values else {}
            for values in (old_values, new_values)
        ]
        for symbol in dict.fromkeys([*versions[0], *versions[1]]):
            old_text, new_text = (_format_coefficient(values.get(symbol)) for values in versions)
            if versions[0].get(symbol) != versions[1].get(symbol):
                yield f"{symbol} of {name} was {old_text} and is now {new_text}."


def _certified_values(certified: CertificateNumbers) -> dict[str, CertifiedAccelerometer]:
    """Return the accelerometers and the triad that have certified values."""
    triad = certified.triad
    return certified.accelerometers | ({"the triad": triad.parameters} if triad else {})


def _format_coefficient(coefficient: Any) -> str:
    if coefficient is None:
        return "not certified"
    unit, factor = field_unit(coefficient.unit)
    u = coverage_factor(coefficient.dof) * (coefficient.u or 0.0)
    return format_estimate(coefficient.value * factor, u * factor, unit)


def _text_changes(before: Element, after: Element) -> Iterator[str]:
    for section, path in _COMPARED_SECTIONS.items():
        old_text, new_text = (_section_text(root, path) for root in (before, after))
        if old_text != new_text:
            yield f"{section}, {_difference(old_text.split(), new_text.split())}."
    old_statements, new_statements = (_statements(root) for root in (before, after))
    for name in dict.fromkeys([*old_statements, *new_statements]):
        if old_statements.get(name) != new_statements.get(name):
            change = (
                "is new"
                if name not in old_statements
                else "has been removed"
                if name not in new_statements
                else "has changed"
            )
            yield f'the statement "{name}" {change}.'


def _statements(root: Element) -> dict[str, str]:
    elements = _select(root, f"{_ADMINISTRATIVE}/dcc:statements/dcc:statement")
    texts: dict[str, str] = {}
    for statement in elements:
        name = " ".join(statement[0].itertext()).strip()
        if name != "Amendment":
            texts[name] = texts.get(name, "") + _element_text(statement)
    return texts


def _section_text(root: Element, path: str) -> str:
    return "; ".join(_element_text(element) for element in _select(root, path))


def _element_text(element: Element) -> str:
    return " ".join(" ".join(element.itertext()).split())


#: Maximum length of a quoted text, in characters.
_MAX_QUOTED: Final = 120


def _difference(old: list[str], new: list[str]) -> str:
    """Return the old and the new words, without the words common to the start and the end."""
    prefix = 0
    while prefix < min(len(old), len(new)) and old[prefix] == new[prefix]:
        prefix += 1
    old, new = old[prefix:], new[prefix:]
    while old and new and old[-1] == new[-1]:
        old, new = old[:-1], new[:-1]
    return f"from {_quote(' '.join(old))} to {_quote(' '.join(new))}"


def _quote(words: str) -> str:
    if not words:
        return "nothing"
    return f'"{words}"' if len(words) <= _MAX_QUOTED else f'"{words[:_MAX_QUOTED]}..."'


def _select(root: Element, path: str) -> list[Any]:
    return list(root.xpath(path, namespaces=NAMESPACES))
