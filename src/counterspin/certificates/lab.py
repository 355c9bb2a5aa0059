"""Laboratory data for a certificate: ``LAB.toml``.

ISO/IEC 17025 7.8.2 and the administrative data of the certificate require these data. A certificate
requires complete data: all missing keys are reported together.
"""

from __future__ import annotations

import datetime
import re
from collections.abc import Collection, Iterator, Mapping
from functools import cache, partial
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, BeforeValidator, PlainValidator

from counterspin.calibration.result import Result
from counterspin.campaign.documents import (
    KeyPath,
    campaign_error,
    flatten_keys,
    format_key_path,
    list_of,
    load_document,
    table_of,
    to_toml_value,
)
from counterspin.campaign.field_types import Contradiction, SettingsSection, key_field
from counterspin.campaign.quantity import Quantity, parse_quantity
from counterspin.campaign.specification import Specifications, resolve_specifications
from counterspin.campaign.validation import Problems, Section, suggest_name
from counterspin.certificates.codes import check_code
from counterspin.certificates.evidence import ALL_TERMS, is_known_key
from counterspin.certificates.schema import clean_text
from counterspin.errors import ExistingFileError, InputError, OutOfRangeError, Problem
from counterspin.input import to_path
from counterspin.output import write_text
from counterspin.physics.terms import TABLE, TERMS
from counterspin.toml_text import parse_toml

#: Key of [cmc] for the relative uncertainty of the applied acceleration of a centrifuge.
APPLIED_ACCELERATION: Final = "applied"

#: Place of a calibration, as in the DCC schema.
Place = Literal["laboratory", "customer", "laboratoryBranch", "customerBranch", "other"]

_CELSIUS_PATTERN: Final = re.compile(r"(.*?)\s*(?:degC|°C)")


def _clean_entry(value: str) -> str:
    text = " ".join(value.split())
    if not text:
        raise InputError("must not be empty", "missing-value")
    if clean_text(text) != text:
        raise ValueError("contains a control character, which is not allowed in a certificate")
    return text


def parse_celsius(text: object) -> Quantity:
    """Parse a temperature in degrees Celsius; ValueError for other text."""
    match = _CELSIUS_PATTERN.fullmatch(text.strip()) if isinstance(text, str) else None
    if match is None:
        raise ValueError('must be a temperature, such as "20.0 ± 0.3 degC"')
    quantity = parse_quantity(f"{match[1]} 1", "1")
    return Quantity(quantity.value, quantity.u, "degC")


def _flatten_table(table: object) -> object:
    return flatten_keys(table) if isinstance(table, Mapping) else table


Text = Annotated[str, AfterValidator(_clean_entry)]

ItemState = Literal["as received", "after adjustment", "before repair", "after repair"]

#: State of an item -> DCC keyword.
ITEM_STATES: Final[Mapping[ItemState, str]] = {
    "as received": "beforeAdjustment",
    "after adjustment": "afterAdjustment",
    "before repair": "beforeRepair",
    "after repair": "afterRepair",
}
Country = Annotated[str, AfterValidator(partial(check_code, code_list="country"))]
Language = Annotated[str, AfterValidator(partial(check_code, code_list="language"))]


class CertificateSettings(SettingsSection):
    """[certificate]: identifier, dates and place of the calibration."""

    identifier: Text | None = key_field(
        "unique identifier of the certificate",
        "2026-014",
        None,
        absent="`CS-` and 12 digits of the SHA-256 digest of the result file and LAB.toml",
    )
    language: Language = key_field(
        "language of the laboratory's entries in this file; the standard texts are in English, "
        "and the English version is binding",
        "de",
        "en",
        kind="language",
    )
    begin: datetime.date = key_field("first day of the calibration", datetime.date(2026, 3, 2))
    end: datetime.date = key_field("last day of the calibration", datetime.date(2026, 3, 4))
    place: Place = key_field("place of the calibration", "customer", "laboratory")
    received: datetime.date | None = key_field(
        "date of receipt of the item", datetime.date(2026, 2, 27), None, absent="not stated"
    )
    issued: datetime.date | None = key_field(
        "date of issue",
        datetime.date(2026, 3, 9),
        None,
        absent="date in the environment variable `SOURCE_DATE_EPOCH`, or today (UTC)",
    )
    traceability: Text = key_field(
        "metrological traceability statement (ISO/IEC 17025, 7.8.4.1 c)",
        "Length, time and gravity are traceable to national standards.",
    )
    ledger: Text | None = key_field(
        "[ledger](#keep-a-ledger) file, next to LAB.toml, that lists each certificate",
        "ledger.jsonl",
        None,
    )
    procedure: Text | None = key_field(
        "identifier of the laboratory's procedure", "QP-17, issue 3", None, absent="not stated"
    )
    deviations: list[Text] = key_field(
        "deviations from the procedure (additions, exclusions), as a list of sentences",
        ["shorter warm-up"],
        [],
        absent="none",
    )
    customer_data: list[Text] = key_field(
        'data supplied by the customer, such as `"K_OO, from the maker\'s data sheet"`; '
        "the certificate marks them with the disclaimer of ISO/IEC 17025, 7.8.2.2",
        ["mass of the item"],
        [],
        absent="none",
    )
    remarks: list[Text] = key_field(
        "remarks, as a list of sentences", ["first calibration"], [], absent="none"
    )
    accelerometers: list[Text] | None = key_field(
        "names of the accelerometers to certify", ["Qx"], None, absent="all"
    )

    def contradictions(self) -> Iterator[Contradiction]:
        """Yield an identifier of a draft, dates in the wrong order, a ledger outside the folder."""
        if (self.identifier or "").upper().startswith("DRAFT"):
            message = "must not begin with DRAFT, which marks documents that are not certificates"
            yield ("identifier",), Problem(message, "conflicting-values")
        if self.end < self.begin:
            yield ("end",), Problem("lies before certificate.begin", "conflicting-values"), "begin"
        if self.received is not None and self.received > self.begin:
            problem = Problem("lies after certificate.begin", "conflicting-values")
            yield ("received",), problem, "begin"
        ledger_path = Path(self.ledger or ".")
        if ledger_path.is_absolute() or ".." in ledger_path.parts:
            message = "must be in the same folder as this file, or in a subfolder"
            yield ("ledger",), Problem(message, "path-outside-folder")
        if self.issued is not None and self.issued < self.end:
            yield ("issued",), Problem("lies before certificate.end", "conflicting-values"), "end"


class Contact(SettingsSection):
    """[customer]: name and address."""

    name: Text = key_field("name of the organisation", "Example Calibration Ltd")
    street: Text | None = key_field("street", "Main Street", None)
    number: Text | None = key_field("house number", "12", None)
    post_code: Text | None = key_field("postal code of the city", "12345", None)
    city: Text = key_field("city", "Exampletown")
    country: Country | None = key_field(
        "two-letter country code (ISO 3166-1)", "DE", None, kind="country"
    )
    email: Text | None = key_field("e-mail address", "lab@example.org", None)
    phone: Text | None = key_field("telephone number", "+49 30 123456", None)


class Laboratory(Contact):
    """[laboratory]: the calibration laboratory, with the `code` of its accreditation."""

    country: Country = key_field("two-letter country code (ISO 3166-1)", "DE", kind="country")
    code: Text | None = key_field("identifier of the accreditation", "D-K-00000-01-00", None)
    logo: Text | None = key_field(
        "logo on the pages: path of a PNG or SVG file of at most 1 MB, relative to LAB.toml",
        "logo.svg",
        None,
    )


class Item(SettingsSection):
    """[item]: the calibrated item."""

    name: Text = key_field("description of the item", "Inertial platform")
    manufacturer: Text = key_field("manufacturer of the item", "Example Instruments")
    model: Text = key_field("model of the item", "IP-3")
    serial_number: Text = key_field("serial number of the item", "0042")
    inventory_number: Text | None = key_field("customer's identifier for the item", "INV-7", None)
    state: ItemState | None = key_field(
        "state of the item during the calibration", "as received", None
    )


class LabAccelerometer(SettingsSection):
    """[accelerometers.NAME]: identity of an accelerometer within the item."""

    manufacturer: Text | None = key_field("manufacturer of the part", "Example Instruments", None)
    model: Text | None = key_field("model of the part", "QA-2000", None)
    serial_number: Text | None = key_field(
        "serial number of the part; must equal the serial number in the campaign",
        "Q-104",
        None,
        absent="the campaign's",
    )


class Person(SettingsSection):
    """[[persons]]: persons responsible for the results."""

    name: Text = key_field("full name", "N. N.")
    role: Text = key_field("position in the laboratory", "Head of the laboratory")
    email: Text | None = key_field("e-mail address", "n.n@example.org", None)


class Equipment(SettingsSection):
    """[[equipment]]: measuring equipment, with the calibration that makes it traceable."""

    name: Text = key_field("description of the equipment", "laser interferometer")
    manufacturer: Text | None = key_field(
        "manufacturer of the equipment", "Example Instruments", None
    )
    model: Text | None = key_field("model of the equipment", "LI-2", None)
    serial_number: Text | None = key_field("serial number of the equipment", "1138", None)
    quantity: Text | None = key_field(
        "quantity that the equipment measures or realises", "radius of the centrifuge", None
    )
    certificate: Text | None = key_field(
        "identifier of the equipment's calibration certificate", "2025-4711", None
    )
    calibrated_by: Text | None = key_field(
        "laboratory that calibrated the equipment", "Example Metrology Institute", None
    )
    due: datetime.date | None = key_field(
        "date on which the next calibration of the equipment is due",
        datetime.date(2027, 6, 1),
        None,
    )


class Conditions(SettingsSection):
    """[conditions]: environmental conditions during the calibration."""

    temperature: Annotated[Quantity, PlainValidator(parse_celsius)] | None = key_field(
        "temperature of the laboratory, with its standard uncertainty",
        "20.0 ± 0.3 degC",
        None,
        kind="temperature ±",
    )


class Lab(SettingsSection):
    """The laboratory's file."""

    schema_version: Literal[1] = key_field("version of this format", 1, alias="schema")
    certificate: CertificateSettings = key_field(
        "identifier, dates and place of the calibration",
        {
            "begin": datetime.date(2026, 3, 2),
            "end": datetime.date(2026, 3, 4),
            "traceability": "Length and time are traceable to national standards.",
        },
    )
    laboratory: Laboratory = key_field(
        "calibration laboratory",
        {"name": "Example Calibration Ltd", "city": "Exampletown", "country": "DE"},
    )
    customer: Contact = key_field(
        "customer", {"name": "Example Instruments", "city": "Exampletown"}
    )
    item: Item = key_field(
        "calibrated item",
        {
            "name": "Inertial platform",
            "manufacturer": "Example Instruments",
            "model": "IP-3",
            "serial_number": "0042",
        },
    )
    accelerometers: dict[str, LabAccelerometer] = key_field(
        "manufacturer, model and serial number of each accelerometer in the item, by name",
        {"Qx": {"serial_number": "Q-104"}},
        {},
        absent="none",
        kind="tables",
    )
    persons: list[Person] = key_field(
        "persons responsible for the results; the first person signs",
        [{"name": "N. N.", "role": "Head of the laboratory"}],
        min_length=1,
    )
    conditions: Conditions = key_field(
        "environmental conditions in the laboratory during the calibration",
        {"temperature": "20.0 ± 0.3 degC"},
        Conditions(),
        absent="none",
    )
    equipment: list[Equipment] = key_field(
        "measuring equipment, with the calibration certificates that establish traceability",
        [{"name": "laser interferometer", "certificate": "2025-4711"}],
        [],
        absent="none",
    )
    cmc: dict[str, str] = key_field(
        "smallest expanded uncertainty (95 %) that the laboratory may state for each term; "
        "`applied` is the relative uncertainty of the [applied acceleration](applied.md)",
        {"K_II": "1e-7 g/g^2"},
        {},
        absent="no limit",
    )
    evidence: Annotated[dict[str, Text], BeforeValidator(_flatten_table)] = key_field(
        "evidence, by term, for each term that the result [assumes](#assumed-terms) to be "
        "perfect or whose default uncertainty contributes at least 10 % of a variance",
        {"K_OO": "type test TR-12"},
        {},
        absent="none",
    )
    specification: Annotated[dict[str, Any] | None, Section(Specifications)] = key_field(
        "limits for the coefficients, in the format of [a campaign](campaign.md#specification), "
        "for statements of [conformity](conformity.md)",
        {"K_II": "abs <= 5e-5 g/g^2"},
        None,
        absent="the campaign's",
    )

    def certified_names(self, result: Result) -> list[str]:
        """Return the names of the accelerometers to certify."""
        selected_names = self.certificate.accelerometers
        return list(result.accelerometers) if selected_names is None else selected_names

    def capability(self, symbol: str, gravity: float) -> float | None:
        """Return the calibration and measurement capability (CMC) for a term; None: no limit.

        gravity: Local gravity of the site, m/s^2.
        """
        if symbol not in self.cmc:
            return None
        if symbol not in TERMS and symbol != APPLIED_ACCELERATION:
            raise InputError(
                f'unknown term "{symbol}"{suggest_name(symbol, [*TERMS, APPLIED_ACCELERATION])}',
                "unknown-term",
            )
        unit = "1" if symbol == APPLIED_ACCELERATION else TERMS[symbol].unit
        expanded_u = parse_quantity(self.cmc[symbol], unit, gravity=gravity)
        if expanded_u.value <= 0.0 or expanded_u.u:
            raise OutOfRangeError(
                "must be a single positive number: the expanded uncertainty for "
                "a coverage probability of 95 %"
            )
        return expanded_u.value

    def serial_number(self, name: str, result: Result) -> str | None:
        """Return the serial number of an accelerometer, from this file or from the result."""
        lab_accelerometer = self.accelerometers.get(name, LabAccelerometer())
        return lab_accelerometer.serial_number or result.accelerometers[name].serial_number


def read_lab(
    path: Mapping[str, Any] | Path | str, result: Result
) -> tuple[Lab, Specifications | None]:
    """Read the laboratory data and check them against the result to be certified.

    Returns: Laboratory data, and the [specification] or None.
    """
    source, document, problems, lab = _load_lab(path)
    _check_terms(lab, problems, result.inputs.gravity, result.accelerometers)
    _check_accelerometers(document, result, problems)
    _check_item(document, result, problems)
    specifications = None
    if isinstance(document.get("specification"), dict):
        specifications = resolve_specifications(
            document["specification"],
            result.accelerometers,
            problems=problems,
            gravity=result.inputs.gravity,
        )
    if lab is None or problems.lines:
        raise campaign_error(Path(source), problems.lines)
    return lab, specifications


def read_machine_lab(path: Mapping[str, Any] | Path | str, gravity: float) -> Lab:
    """Read the laboratory data for the certificate of a centrifuge, without [specification].

    gravity: Local gravity of the site, m/s^2.
    """
    source, _, problems, lab = _load_lab(path)
    _check_terms(lab, problems, gravity, ())
    if lab is None or problems.lines:
        raise campaign_error(Path(source), problems.lines)
    return lab


def _load_lab(
    path: Mapping[str, Any] | Path | str,
) -> tuple[str, Mapping[str, Any], Problems, Lab | None]:
    """Return the name of the source, the document, its problems, and the parsed data."""
    if isinstance(path, Mapping):
        source, problems = "the laboratory data", Problems(path)
        document = to_toml_value(path, (), problems.add)
    else:
        path = to_path(
            path, "a mapping with the laboratory data, or the file that contains the data"
        )
        source = str(path)
        hint = "`certificates.lab.write_example` writes a template"
        document = load_document(path, hint, "laboratory")
        problems = Problems(document)
    # With an empty table, the check reports each required key.
    empty_tables: dict[str, Any] = {"persons": [{}]}
    empty_tables |= {key: {} for key in ("certificate", "laboratory", "customer", "item")}
    return source, document, problems, problems.check(Lab, empty_tables | document, ())


def _check_terms(
    lab: Lab | None, problems: Problems, gravity: float, accelerometers: Collection[str]
) -> None:
    """Add unknown terms in [cmc] and [evidence] to the problems."""
    if lab is None:
        return
    for symbol in lab.cmc:
        problems.collect(("cmc", symbol), lab.capability, symbol, gravity)
    for key in lab.evidence:
        if not is_known_key(key, accelerometers):
            hint = suggest_name(key, [ALL_TERMS, *TABLE])
            problems.add(("evidence", key), f'unknown term "{key}"{hint}', "unknown-term")


def _check_accelerometers(document: Mapping[str, Any], result: Result, problems: Problems) -> None:
    """Add names that are not in the result, and contradictory serial numbers, to the problems."""
    result_names = result.accelerometers
    settings = table_of(document, "certificate")
    tables = table_of(document, "accelerometers")
    selected_names = settings.get("accelerometers")
    if selected_names == []:
        problems.add(
            ("certificate", "accelerometers"), "must have at least one entry", "missing-value"
        )
    listed_names = list_of(settings, "accelerometers")
    named_paths: list[tuple[KeyPath, object]] = [
        *((("certificate", "accelerometers", i), name) for i, name in enumerate(listed_names)),
        *((("accelerometers", name), name) for name in tables),
    ]
    for index, name in enumerate(listed_names):
        if name in listed_names[:index]:
            problems.add(
                ("certificate", "accelerometers", index),
                f'"{name}" occurs twice; keep only one of them',
                "conflicting-values",
            )
    for path, name in named_paths:
        if isinstance(name, str) and name not in result_names:
            problems.add(
                path,
                f'the result has no "{name}"' + suggest_name(name, result_names),
                "unknown-accelerometer",
            )
    for name, table in tables.items():
        result_serial_number = result_names[name].serial_number if name in result_names else None
        lab_serial_number = table.get("serial_number") if isinstance(table, dict) else None
        if result_serial_number and lab_serial_number and lab_serial_number != result_serial_number:
            problems.add(
                ("accelerometers", name, "serial_number"),
                f'is "{lab_serial_number}", but the result is for "{result_serial_number}"',
                "conflicting-values",
            )


def _check_item(document: Mapping[str, Any], result: Result, problems: Problems) -> None:
    """Add a serial number of the item that contradicts the campaign to the problems."""
    path = ("item", "serial_number")
    item_serial_number = table_of(document, "item").get("serial_number")
    campaign_serial_number = result.details.get("serial_number")
    # The item is the platform or an accelerometer, whose number the campaign may not state.
    settings = table_of(document, "certificate")
    names = list_of(settings, "accelerometers") or [*result.accelerometers]
    serial_numbers = [
        accelerometer.serial_number for accelerometer in result.accelerometers.values()
    ]
    if (
        campaign_serial_number
        and isinstance(item_serial_number, str)
        and item_serial_number not in (campaign_serial_number, *serial_numbers)
        and (len(names) > 1 or None not in serial_numbers)
        and not is_template_value(path, item_serial_number)
    ):
        problems.add(
            path,
            f'is "{item_serial_number}", but the campaign states "{campaign_serial_number}"',
            "conflicting-values",
        )


# The example


def write_example(path: Path | str) -> Path:
    """Write a commented example; CounterspinError if the file exists or cannot be written."""
    path = Path(path)
    if path.exists():
        raise ExistingFileError(f"{path} already exists; edit it, or choose another name")
    write_text(path, example_text())
    return path


def template_keys(lab: Lab | Mapping[str, Any]) -> list[str]:
    """Return the keys that still have a value of the template."""
    excluded_sections = {"conditions", "specification"}
    document = lab.model_dump(exclude=excluded_sections) if isinstance(lab, Lab) else dict(lab)
    leaves = _iter_leaves(
        {key: value for key, value in document.items() if key not in excluded_sections}, ()
    )
    return [format_key_path(path) for path, value in leaves if is_template_value(path, value)]


def is_template_value(path: KeyPath, value: object) -> bool:
    """Return whether a key has the value that it has in the template."""
    text = " ".join(str(value).split())
    return (
        isinstance(value, str | datetime.date) and _template_entry(path, text) in _template_values()
    )


@cache
def _template_values() -> frozenset[tuple[str, str]]:
    """Return the placeholders of the template, each with the last name in its key.

    Placeholders are dates and texts; in commented lines, only dates, zeros and texts that contain
    "example".
    """
    text = example_text()
    active_values = _iter_leaves(parse_toml(text), ())
    commented_values = _iter_leaves(parse_toml(_COMMENT_PREFIX.sub("", text)), ())
    return frozenset(
        [_template_entry(path, value) for path, value in active_values]
        + [
            _template_entry(*leaf)
            for leaf in commented_values
            if re.search("(?i)example|^2000-|^0+$", leaf[1])
        ]
    )


#: Start of a commented line of the template with a key or a heading.
_COMMENT_PREFIX: Final = re.compile(r"^# (?=\[?\[[\w.]+\]|[\w.\"*]+ = )", re.MULTILINE)


def add_required_keys(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return the laboratory data with template values for missing required keys."""
    completed_document = dict(document)
    for key, value in parse_toml(example_text()).items():
        section = document.get(key, [{}] if isinstance(value, list) else {})
        if isinstance(value, dict) and isinstance(section, dict):
            completed_document[key] = value | section
        elif isinstance(value, list) and isinstance(section, list):
            completed_document[key] = [
                value[0] | entry if isinstance(entry, dict) else entry for entry in section
            ]
        else:
            completed_document.setdefault(key, value)
    return completed_document


def _template_entry(path: KeyPath, value: str) -> tuple[str, str]:
    """Return the last name in a key path, and the value."""
    return next(str(key) for key in reversed(path) if isinstance(key, str)), value


def example_text() -> str:
    """Return the commented example of ``LAB.toml``."""
    return (files("counterspin.certificates") / "starter.toml").read_text("utf-8")


def _iter_leaves(value: Any, path: KeyPath) -> Iterator[tuple[KeyPath, str]]:
    """Yield key path and text of all texts and dates in a document."""
    if isinstance(value, str | datetime.date):
        yield path, " ".join(str(value).split())
    elif isinstance(value, dict):
        for key, child in value.items():
            yield from _iter_leaves(child, (*path, key))
    elif isinstance(value, list):
        for index, child in enumerate(value):
            yield from _iter_leaves(child, (*path, index))
