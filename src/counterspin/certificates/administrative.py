"""The administrative data of a certificate: who, what, when, and where (DCC, first ring)."""

from __future__ import annotations

import datetime
import re
from collections.abc import Iterator, Sequence

from counterspin._version import __version__
from counterspin.calibration.result import Result
from counterspin.certificates.amendment import PROCEDURE, Amended
from counterspin.certificates.elements import ENGLISH, Element, dcc, rich, text
from counterspin.certificates.lab import Contact, Lab, LabAccelerometer, Person
from counterspin.frozen import frozen


@frozen
class Issue:
    """Identifier and date of a certificate."""

    identifier: str  #: Unique.
    date: datetime.datetime  #: Of issue, UTC.
    signed: bool = False  #: Whether an electronic signature follows.
    #: Whether the laboratory's data are not its own yet, so that nothing is certified.
    draft: bool = False
    amended: Amended | None = None  #: The certificate that this one replaces.

    def file_name(self, ending: str) -> str:
        """Return a file name made of the identifier, in which a slash would name a folder."""
        return re.sub(r"[^\w.-]+", "_", self.identifier) + ending


def administrative_data(
    lab: Lab, result: Result, issue: Issue, statements: Sequence[Element]
) -> Element:
    """Return ``dcc:administrativeData``; statements are `dcc:statement` elements."""
    return dcc(
        "administrativeData",
        dcc("dccSoftware", software(__version__)),
        _core_data(lab, issue),
        items(lab, result),
        _laboratory(lab, issue),
        _persons(lab),
        _contact("customer", lab.customer, lab.certificate.language),
        dcc("statements", *statements),
    )


def software(version: str) -> Element:
    """Return this program as ``dcc:software``."""
    number = re.match(r"\d{1,3}(\.\d{1,3}){0,3}", version)
    release = f"v{number[0]}" if number else f"v{version}"
    return dcc(
        "software",
        text("name", "counterspin"),
        dcc("release", release),
        dcc("type", "application"),
        None if release == f"v{version}" else rich("description", f"Version {version}."),
    )


def _core_data(lab: Lab, issue: Issue) -> Element:
    settings = lab.certificate
    # English first: the program's statements are in English, and that version is binding.
    languages = dict.fromkeys((ENGLISH, settings.language))
    return dcc(
        "coreData",
        dcc("countryCodeISO3166_1", lab.laboratory.country),
        *(dcc("usedLangCodeISO639_1", language) for language in languages),
        dcc("mandatoryLangCodeISO639_1", ENGLISH),
        dcc("uniqueIdentifier", issue.identifier),
        None if settings.received is None else dcc("receiptDate", settings.received.isoformat()),
        dcc("beginPerformanceDate", settings.begin.isoformat()),
        dcc("endPerformanceDate", settings.end.isoformat()),
        dcc("performanceLocation", settings.place),
        dcc("issueDate", issue.date.date().isoformat()),
        *_replaced(issue.amended),
    )


def _replaced(amended: Amended | None) -> Iterator[Element]:
    if amended is None:
        return
    yield dcc(
        "reportAmendedSubstituted",
        dcc("typeOfChange", "amended"),
        dcc("replacedUniqueIdentifier", amended.identifier),
    )
    yield dcc(
        "previousReport",
        text("referral", "The certificate that this one amends and replaces"),
        dcc("referralID", amended.identifier),
        dcc("procedure", PROCEDURE),
        dcc("value", amended.checksum),
        rich("description", f"Reason: {amended.reason}"),
    )


def item_id(lab: Lab, result: Result, name: str) -> str:
    """Return the id of an accelerometer's own item."""
    return f"item-{lab.certified(result).index(name) + 1}"


def items(lab: Lab, result: Result) -> Element:
    """Return ``dcc:items``: the item, and in it every accelerometer that is certified."""
    language = lab.certificate.language
    item = lab.item
    return dcc(
        "items",
        dcc(
            "item",
            text("name", item.name, language),
            _named("manufacturer", item.manufacturer, language),
            dcc("model", item.model),
            dcc(
                "identifications",
                _serial_number(item.serial_number),
                None
                if item.inventory_number is None
                else _identification("customer", item.inventory_number, "Inventory number"),
            ),
            dcc("subItems", *(_accelerometer(lab, result, n) for n in lab.certified(result))),
            id="item",
        ),
    )


def _accelerometer(lab: Lab, result: Result, name: str) -> Element:
    part = lab.accelerometers.get(name, LabAccelerometer())
    serial_number = lab.serial_number(name, result)
    return dcc(
        "item",
        text("name", f"Accelerometer {name}"),
        None
        if part.manufacturer is None
        else _named("manufacturer", part.manufacturer, lab.certificate.language),
        None if part.model is None else dcc("model", part.model),
        dcc(
            "identifications",
            _identification("calibrationLaboratory", name, "Designation in the result"),
            None if serial_number is None else _serial_number(serial_number),
        ),
        id=item_id(lab, result, name),
    )


def _serial_number(value: str) -> Element:
    return _identification("manufacturer", value, "Serial number", "basic_serialNumber")


def _identification(issuer: str, value: str, name: str, ref_type: str | None = None) -> Element:
    return dcc(
        "identification",
        dcc("issuer", issuer),
        dcc("value", " ".join(value.split())),
        text("name", name),
        refType=ref_type,
    )


def _named(tag: str, name: str, language: str) -> Element:
    return dcc(tag, text("name", name, language))


def _laboratory(lab: Lab, issue: Issue) -> Element:
    code = lab.laboratory.code
    return dcc(
        "calibrationLaboratory",
        None if code is None else dcc("calibrationLaboratoryCode", code),
        _contact("contact", lab.laboratory, lab.certificate.language),
        dcc("cryptElectronicSignature", _boolean(issue.signed)),
    )


def _persons(lab: Lab) -> Element:
    return dcc(
        "respPersons",
        *(
            _person(person, place == 0, lab.certificate.language)
            for place, person in enumerate(lab.persons)
        ),
    )


def _person(person: Person, signs: bool, language: str) -> Element:
    return dcc(
        "respPerson",
        dcc(
            "person",
            text("name", person.name, language),
            None if person.email is None else dcc("eMail", person.email),
        ),
        dcc("role", person.role),
        dcc("mainSigner", _boolean(signs)),
    )


def _boolean(value: bool) -> str:
    return "true" if value else "false"


def _contact(tag: str, contact: Contact, language: str) -> Element:
    place = (
        ("city", contact.city),
        ("countryCode", contact.country),
        ("postCode", contact.post_code),
        ("street", contact.street),
        ("streetNo", contact.number),
    )
    return dcc(
        tag,
        text("name", contact.name, language),
        None if contact.email is None else dcc("eMail", contact.email),
        None if contact.phone is None else dcc("phone", contact.phone),
        dcc("location", *(dcc(key, value) for key, value in place if value is not None)),
    )
