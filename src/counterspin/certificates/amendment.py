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
from counterspin.certificates.schema import NAMESPACES, Element, parse_xml
from counterspin.errors import CampaignError, RecordError, UsageError
from counterspin.frozen import frozen
from counterspin.reports.numbers import find_display_unit, format_estimate

#: Hash algorithm of the checksum of a replaced certificate, as stated in the new certificate.
HASH_ALGORITHM: Final = "SHA-256"

_ADMINISTRATIVE_PATH: Final = "/dcc:digitalCalibrationCertificate/dcc:administrativeData"

#: Section that is compared as text -> XPath.
_SECTION_PATHS: Final = {
    "calibrated item": f"{_ADMINISTRATIVE_PATH}/dcc:items",
    "laboratory": f"{_ADMINISTRATIVE_PATH}/dcc:calibrationLaboratory/dcc:contact",
    "accreditation": f"{_ADMINISTRATIVE_PATH}/dcc:calibrationLaboratory"
    "/dcc:calibrationLaboratoryCode",
    "responsible persons": f"{_ADMINISTRATIVE_PATH}/dcc:respPersons",
    "customer": f"{_ADMINISTRATIVE_PATH}/dcc:customer",
    "date of receipt": f"{_ADMINISTRATIVE_PATH}/dcc:coreData/dcc:receiptDate",
    "dates of the calibration": f"{_ADMINISTRATIVE_PATH}/dcc:coreData/*[contains(name(), 'eDate')]"
    "[contains(name(), 'Performance')]",
    "place of the calibration": f"{_ADMINISTRATIVE_PATH}/dcc:coreData/dcc:performanceLocation",
    "method": "//dcc:measurementResult[1]/dcc:usedMethods",
    "conditions": "//dcc:measurementResult[1]/dcc:influenceConditions",
    "input files": "//dcc:metaData[dcc:name/dcc:content='Input files and their checksums']",
}


@frozen
class Amendment:
    """Path of the certificate to be replaced, and the reason."""

    path: Path  #: The issued certificate, XML or PDF.
    reason: str  #: Reason for the replacement.


@frozen
class AmendedCertificate:
    """A certificate that a new certificate replaces."""

    identifier: str  #: Identifier of the replaced certificate.
    checksum: str  #: SHA-256 of its XML, hexadecimal.
    reason: str  #: Reason for the replacement.
    changes: tuple[str, ...] = ()  #: Sentences on the changes in the new certificate.
    #: Identifiers of earlier replaced certificates, newest first.
    earlier_identifiers: tuple[str, ...] = ()

    def next_identifier(self) -> str:
        """Return the default identifier of the new certificate."""
        match = re.fullmatch(r"(.*)-A(\d+)", self.identifier)
        if match is None:
            return f"{self.identifier}-A1"
        return f"{match[1]}-A{int(match[2]) + 1}"


def read_amended_certificate(amendment: Amendment) -> tuple[AmendedCertificate, bytes]:
    """Read the certificate to be replaced; return its data and its XML."""
    if not amendment.reason.strip():
        raise UsageError("certificate", ["`reason`: give the reason for replacing the certificate"])
    document = read_document(amendment.path)
    certificate = read_certificate(document, str(amendment.path))
    if certificate.identifier.startswith("DRAFT-"):
        raise RecordError(
            f"{amendment.path} is a draft that was never issued, so it cannot be amended",
            code="wrong-amendment",
        )
    checksum = hashlib.sha256(document).hexdigest()
    reason = " ".join(amendment.reason.split())
    amended_certificate = AmendedCertificate(
        certificate.identifier,
        checksum,
        reason,
        earlier_identifiers=certificate.replaced_identifiers,
    )
    return amended_certificate, document


def check_new_identifier(identifier: str, amended_certificate: AmendedCertificate) -> None:
    """Raise an error if the amended certificate or an earlier certificate has the identifier.

    Blanks and case are ignored.
    """
    if _is_same_identifier(identifier, amended_certificate.identifier):
        problem = "is the identifier of the amended certificate"
    elif any(
        _is_same_identifier(identifier, earlier_identifier)
        for earlier_identifier in amended_certificate.earlier_identifiers
    ):
        problem = f"is the identifier of a certificate that {amended_certificate.identifier} amends"
    else:
        return
    remedy = "each certificate must have a unique identifier"
    raise CampaignError(
        "certificate.identifier", [f'"{identifier}" {problem}; {remedy}'], code="duplicate-entry"
    )


def _is_same_identifier(identifier: str, other_identifier: str) -> bool:
    normalized_identifiers = [
        "".join(normalize("NFKC", text).split()).casefold()
        for text in (identifier, other_identifier)
    ]
    return normalized_identifiers[0] == normalized_identifiers[1]


def record_changes(
    amended_certificate: AmendedCertificate, old_document: bytes, new_document: bytes
) -> AmendedCertificate:
    """Return the amended certificate with the changes between the old and the new XML."""
    return replace(amended_certificate, changes=tuple(describe_changes(old_document, new_document)))


def describe_changes(old_document: bytes, new_document: bytes) -> list[str]:
    """Return sentences about the differences between two certificates, numbers first."""
    old_certificate, new_certificate = (
        read_certificate(document, "the certificate") for document in (old_document, new_document)
    )
    return [
        *_value_changes(old_certificate, new_certificate),
        *_text_changes(
            parse_xml(old_document, "the certificate"), parse_xml(new_document, "the certificate")
        ),
    ] or ["The amendment changes only the identifier and the date of issue."]


def amendment_lines(amended_certificate: AmendedCertificate | None) -> list[str]:
    """Return the statements on the replaced certificate; empty without an amendment."""
    if amended_certificate is None:
        return []
    return [
        f"This certificate amends and replaces certificate {amended_certificate.identifier} "
        f"(SHA-256 of its XML: {amended_certificate.checksum}).",
        *amendment_reasons(amended_certificate),
        *(f"Changed: {change}" for change in amended_certificate.changes),
    ]


def amendment_reasons(amended_certificate: AmendedCertificate) -> list[str]:
    """Return the reason of the replacement, and the earlier replaced certificates."""
    earlier_lines = [
        f"{EARLIER_PREFIX}{identifier}" for identifier in amended_certificate.earlier_identifiers
    ]
    return [f"Reason: {amended_certificate.reason}", *earlier_lines]


def verify_amendment(new_document: bytes, old_path: Path, source: str) -> str:
    """Return the identifier of the replaced certificate; RecordError if it is not amended."""
    checksum_elements = _select_elements(
        parse_xml(new_document, source),
        f"{_ADMINISTRATIVE_PATH}/dcc:coreData/dcc:previousReport/dcc:value",
    )
    old_document = read_document(old_path)
    if not checksum_elements:
        raise RecordError(f"{source} does not amend a certificate", code="wrong-amendment")
    if checksum_elements[0].text != hashlib.sha256(old_document).hexdigest():
        raise RecordError(
            f"{source} does not amend {old_path}, or {old_path} has been changed since it was "
            "amended",
            code="wrong-amendment",
        )
    old_certificate = read_certificate(old_document, str(old_path))
    new_certificate = read_certificate(new_document, source)
    if any(
        _is_same_identifier(new_certificate.identifier, identifier)
        for identifier in (old_certificate.identifier, *old_certificate.replaced_identifiers)
    ):
        raise RecordError(
            f"{source} has the identifier of {old_path} or of a certificate that {old_path} "
            "amends. The amendments are therefore circular; do not rely on any of these "
            "certificates",
            code="wrong-amendment",
        )
    return old_certificate.identifier


def _value_changes(
    old_certificate: CertificateNumbers, new_certificate: CertificateNumbers
) -> Iterator[str]:
    old_values, new_values = _certified_values(old_certificate), _certified_values(new_certificate)
    for name in dict.fromkeys([*old_values, *new_values]):
        coefficient_versions = [
            values[name].coefficients if name in values else {}
            for values in (old_values, new_values)
        ]
        for symbol in dict.fromkeys([*coefficient_versions[0], *coefficient_versions[1]]):
            old_text, new_text = (
                _format_coefficient(values.get(symbol)) for values in coefficient_versions
            )
            if coefficient_versions[0].get(symbol) != coefficient_versions[1].get(symbol):
                yield f"{symbol} of {name} was {old_text} and is now {new_text}."


def _certified_values(certificate: CertificateNumbers) -> dict[str, CertifiedAccelerometer]:
    """Return the accelerometers and the triad that have certified values."""
    triad = certificate.triad
    return certificate.accelerometers | ({"the triad": triad.parameters} if triad else {})


def _format_coefficient(coefficient: Any) -> str:
    if coefficient is None:
        return "not certified"
    unit, factor = find_display_unit(coefficient.unit)
    u = coverage_factor(coefficient.dof) * (coefficient.u or 0.0)
    return format_estimate(coefficient.value * factor, u * factor, unit)


def _text_changes(old_root: Element, new_root: Element) -> Iterator[str]:
    for section, path in _SECTION_PATHS.items():
        old_text, new_text = (_section_text(root, path) for root in (old_root, new_root))
        if old_text != new_text:
            yield f"{section}, {_describe_difference(old_text.split(), new_text.split())}."
    old_statements, new_statements = (_statement_texts(root) for root in (old_root, new_root))
    for name in dict.fromkeys([*old_statements, *new_statements]):
        if old_statements.get(name) != new_statements.get(name):
            change_text = (
                "is new"
                if name not in old_statements
                else "has been removed"
                if name not in new_statements
                else "has changed"
            )
            yield f'the statement "{name}" {change_text}.'


def _statement_texts(root: Element) -> dict[str, str]:
    statements = _select_elements(root, f"{_ADMINISTRATIVE_PATH}/dcc:statements/dcc:statement")
    text_by_name: dict[str, str] = {}
    for statement in statements:
        name = " ".join(statement[0].itertext()).strip()
        if name != "Amendment":
            text_by_name[name] = text_by_name.get(name, "") + _element_text(statement)
    return text_by_name


def _section_text(root: Element, path: str) -> str:
    return "; ".join(_element_text(element) for element in _select_elements(root, path))


def _element_text(element: Element) -> str:
    return " ".join(" ".join(element.itertext()).split())


#: Maximum length of a quoted text, in characters.
_MAX_QUOTED_LENGTH: Final = 120


def _describe_difference(old_words: list[str], new_words: list[str]) -> str:
    """Return the old and the new words, without common words at the start and the end."""
    n_common = 0
    while (
        n_common < min(len(old_words), len(new_words))
        and old_words[n_common] == new_words[n_common]
    ):
        n_common += 1
    old_words, new_words = old_words[n_common:], new_words[n_common:]
    while old_words and new_words and old_words[-1] == new_words[-1]:
        old_words, new_words = old_words[:-1], new_words[:-1]
    return f"from {_quote(' '.join(old_words))} to {_quote(' '.join(new_words))}"


def _quote(text: str) -> str:
    if not text:
        return "nothing"
    return f'"{text}"' if len(text) <= _MAX_QUOTED_LENGTH else f'"{text[:_MAX_QUOTED_LENGTH]}..."'


def _select_elements(root: Element, path: str) -> list[Any]:
    return list(root.xpath(path, namespaces=NAMESPACES))
