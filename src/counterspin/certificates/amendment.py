"""An issued certificate that another one replaces (ISO/IEC 17025:2017, 7.8.8)."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final
from unicodedata import normalize

from counterspin.certificates.reading import (
    EARLIER,
    CertificateNumbers,
    CertifiedAccelerometer,
    read_certificate,
    read_document,
)
from counterspin.certificates.schema import NAMESPACES, Element, parse
from counterspin.certificates.wording import coverage_factor
from counterspin.errors import CampaignError, RecordError
from counterspin.frozen import frozen
from counterspin.reports.numbers import field_unit, format_estimate

#: How the hash of a replaced certificate is made, as the new one states it.
PROCEDURE: Final = "SHA-256"

_ADMINISTRATIVE: Final = "/dcc:digitalCalibrationCertificate/dcc:administrativeData"

#: What is compared as a whole, by what it is called.
_PARTS: Final = {
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
    reason: str  #: Why, in words.


@frozen
class AmendedCertificate:
    """A certificate that a new one replaces."""

    identifier: str  #: Of the one replaced.
    checksum: str  #: SHA-256 of its XML, hexadecimal.
    reason: str  #: Why it is replaced.
    changes: tuple[str, ...] = ()  #: What is otherwise in the new one, in sentences.
    #: Identifiers of the certificates that the replaced one replaced, newest first.
    earlier: tuple[str, ...] = ()

    def next_identifier(self) -> str:
        """Return an identifier for the new certificate, if the laboratory gives none."""
        numbered = re.fullmatch(r"(.*)-A(\d+)", self.identifier)
        if numbered is None:
            return f"{self.identifier}-A1"
        return f"{numbered[1]}-A{int(numbered[2]) + 1}"


def read_amended(amendment: Amendment) -> tuple[AmendedCertificate, bytes]:
    """Return the statements about a certificate that is replaced, and its XML."""
    if not amendment.reason.strip():
        raise CampaignError("certificate", ["`reason`: state why the certificate is replaced"])
    data = read_document(amendment.path)
    found = read_certificate(data, str(amendment.path))
    if found.identifier.startswith("DRAFT-"):
        raise RecordError(
            f"{amendment.path}: is a draft, which was never issued and cannot be amended"
        )
    checksum = hashlib.sha256(data).hexdigest()
    reason = " ".join(amendment.reason.split())
    amended = AmendedCertificate(found.identifier, checksum, reason, earlier=found.replaced)
    return amended, data


def check_new_identifier(identifier: str, amended: AmendedCertificate) -> None:
    """Refuse an identifier that the amended certificate or one before it has.

    Blanks and capitals do not make another identifier.
    """
    if _same(identifier, amended.identifier):
        words = "is the identifier of the amended certificate"
    elif any(_same(identifier, other) for other in amended.earlier):
        words = f"is the identifier of a certificate that {amended.identifier} amends"
    else:
        return
    raise CampaignError(
        "certificate.identifier", [f'"{identifier}" {words}; each certificate needs its own']
    )


def _same(first: str, second: str) -> bool:
    keys = ["".join(normalize("NFKC", text).split()).casefold() for text in (first, second)]
    return keys[0] == keys[1]


def with_changes(amended: AmendedCertificate, old: bytes, new: bytes) -> AmendedCertificate:
    """Return the amendment with the other changes in the new certificate's XML."""
    return replace(amended, changes=tuple(changes(old, new)))


def changes(old: bytes, new: bytes) -> list[str]:
    """Return sentences about the differences between two certificates, numbers first."""
    before, after = (read_certificate(data, "the certificate") for data in (old, new))
    return [
        *_numbers(before, after),
        *_words(parse(old, "the certificate"), parse(new, "the certificate")),
    ] or ["Nothing but identifier and date of issue."]


def amendment_lines(amended: AmendedCertificate | None) -> list[str]:
    """Return a certificate's statements about the one that it replaces; none without one."""
    if amended is None:
        return []
    return [
        f"This certificate amends and replaces certificate {amended.identifier} "
        f"(SHA-256 of its XML: {amended.checksum}).",
        *amendment_reasons(amended),
        *(f"Changed: {change}" for change in amended.changes),
    ]


def amendment_reasons(amended: AmendedCertificate) -> list[str]:
    """Return why a certificate was replaced, and which certificates it had replaced."""
    earlier = [f"{EARLIER}{identifier}" for identifier in amended.earlier]
    return [f"Reason: {amended.reason}", *earlier]


def check_amends(new: bytes, old: Path, source: str) -> str:
    """Return the identifier of the certificate that another replaces."""
    previous = _found(
        parse(new, source), f"{_ADMINISTRATIVE}/dcc:coreData/dcc:previousReport/dcc:value"
    )
    data = read_document(old)
    if not previous:
        raise RecordError(f"{source}: amends no certificate")
    if previous[0].text != hashlib.sha256(data).hexdigest():
        raise RecordError(f"{source}: does not amend {old}, or {old} has been changed since")
    before, after = read_certificate(data, str(old)), read_certificate(new, source)
    if any(_same(after.identifier, other) for other in (before.identifier, *before.replaced)):
        raise RecordError(
            f"{source}: has the identifier of {old} or of a certificate that {old} amends: the "
            "amendments return to their beginning; do not rely on any of them"
        )
    return before.identifier


def _numbers(before: CertificateNumbers, after: CertificateNumbers) -> Iterator[str]:
    first, second = _certified(before), _certified(after)
    for name in dict.fromkeys([*first, *second]):
        sides = [side[name].coefficients if name in side else {} for side in (first, second)]
        for symbol in dict.fromkeys([*sides[0], *sides[1]]):
            was, is_ = (_shown(side.get(symbol)) for side in sides)
            if sides[0].get(symbol) != sides[1].get(symbol):
                yield f"{symbol} of {name}: it was {was}, and is {is_}."


def _certified(certified: CertificateNumbers) -> dict[str, CertifiedAccelerometer]:
    """Return the accelerometers and the triad that have certified values."""
    triad = certified.triad
    return certified.accelerometers | ({"the triad": triad.parameters} if triad else {})


def _shown(coefficient: Any) -> str:
    if coefficient is None:
        return "not certified"
    unit, factor = field_unit(coefficient.unit)
    u = coverage_factor(coefficient.dof) * (coefficient.u or 0.0)
    return format_estimate(coefficient.value * factor, u * factor, unit)


def _words(before: Element, after: Element) -> Iterator[str]:
    for part, path in _PARTS.items():
        was, is_ = (_text(root, path) for root in (before, after))
        if was != is_:
            yield f"{part}, {_difference(was.split(), is_.split())}."
    was_said, is_said = (_statements(root) for root in (before, after))
    for name in dict.fromkeys([*was_said, *is_said]):
        if was_said.get(name) != is_said.get(name):
            how = (
                "is new"
                if name not in was_said
                else "is gone"
                if name not in is_said
                else "reads otherwise"
            )
            yield f'the statement "{name}" {how}.'


def _statements(root: Element) -> dict[str, str]:
    found = _found(root, f"{_ADMINISTRATIVE}/dcc:statements/dcc:statement")
    said: dict[str, str] = {}
    for statement in found:
        name = " ".join(statement[0].itertext()).strip()
        if name != "Amendment":
            said[name] = said.get(name, "") + _joined(statement)
    return said


def _text(root: Element, path: str) -> str:
    return "; ".join(_joined(element) for element in _found(root, path))


def _joined(element: Element) -> str:
    return " ".join(" ".join(element.itertext()).split())


#: Characters of a changed text that are repeated.
_SHOWN: Final = 120


def _difference(was: list[str], is_: list[str]) -> str:
    """Return the old and the new words, without the words common to the start and the end."""
    same = 0
    while same < min(len(was), len(is_)) and was[same] == is_[same]:
        same += 1
    was, is_ = was[same:], is_[same:]
    while was and is_ and was[-1] == is_[-1]:
        was, is_ = was[:-1], is_[:-1]
    return f"from {_short(' '.join(was))} to {_short(' '.join(is_))}"


def _short(words: str) -> str:
    if not words:
        return "nothing"
    return f'"{words}"' if len(words) <= _SHOWN else f'"{words[:_SHOWN]}..."'


def _found(root: Element, path: str) -> list[Any]:
    return list(root.xpath(path, namespaces=NAMESPACES))
