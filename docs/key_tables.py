"""Generate the tables of keys, fields and error codes in these pages from the classes.

`python docs/key_tables.py` replaces each table below its marker: `<!-- keys: CLASS -->` for a
document, `<!-- fields: CLASS -->` for a result, `<!-- codes: all -->` for the error codes. A test
compares them with the classes.
"""

import re
import types
import typing
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, PlainValidator
from pydantic.fields import FieldInfo

from counterspin import schemas
from counterspin.acceleration_standard.result import AppliedAcceleration
from counterspin.calibration.result import Result
from counterspin.campaign.field_types import SettingsSection, field_extra, uncertain_quantity
from counterspin.campaign.truth import AccelerometerTruthSettings
from counterspin.campaign.validation import Section
from counterspin.certificates.lab import Lab
from counterspin.comparisons.result import Intercomparison, RepeatedCalibration, ResultComparison
from counterspin.error_codes import CODES
from counterspin.histories.result import History
from counterspin.monitoring.result import CheckedRun, NoiseResult, WatchState
from counterspin.operating_tests.result import OperatingTests
from counterspin.physics.terms import ACCELEROMETER_TERMS
from counterspin.planning.plan_sections import PlanDocument, ReadingPlanDocument
from counterspin.studies.description import StudyCampaignDocument, StudyDocument
from counterspin.toml_text import format_value
from counterspin.validation.page import Dossier

DOCS = Path(__file__).parent
TABLE_MARKER = re.compile(r"^<!-- (keys|fields|codes): ([\w ]+) -->\n(?:\|.*\n)*", re.MULTILINE)
KEYS_HEADER = "| key | kind | default | example | meaning |\n|---|---|---|---|---|\n"
FIELDS_HEADER = "| key | kind | meaning |\n|---|---|---|\n"
CODES_HEADER = "| code | mistake |\n|---|---|\n"

#: Documents with tables of keys.
DOCUMENTS = (
    StudyCampaignDocument,
    StudyDocument,
    PlanDocument,
    ReadingPlanDocument,
    Lab,
    AccelerometerTruthSettings,
)

#: Name -> class, for every class in the documented results.
RESULT_CLASSES = {
    name: part
    for result in (
        Result,
        AppliedAcceleration,
        OperatingTests,
        ResultComparison,
        RepeatedCalibration,
        Intercomparison,
        History,
        CheckedRun,
        WatchState,
        NoiseResult,
        Dossier,
    )
    for name, part in schemas.collect_models(result).items()
}

#: Names of classes with a table of keys.
CLASSES_WITH_TABLE = {
    name
    for page in DOCS.glob("*.md")
    for kind, name in TABLE_MARKER.findall(page.read_text("utf-8"))
    if kind == "keys"
}

#: A heading, or the marker of a table of fields.
SECTION = re.compile(r"^(?:#+ (?P<heading>.*)|<!-- fields: (?P<part>\w+) -->)$", re.MULTILINE)

#: Class -> row that represents all terms.
TERM_ROWS = {
    "AccelerometerKeys": "| `K_III` and so on | quantity ± | unknown | "
    '`K_III = "0 ± 1e-5 g/g^3"` | prior of another [term](physics.md#accelerometer-eq-7-9) |\n',
    "AccelerometerTruthSettings": "| `K_II` and so on | quantity | a perfect instrument's | "
    '`K_II = "2e-5 g/g^2"` | true coefficient; if the accelerometer has an `output`, its unit is '
    'also accepted, as in `"1.25 mA/g"`; write slopes such as `"K_F.trend"` in quotation marks |\n',
}

#: Type -> label; other types are "text".
TYPE_LABELS = {bool: "true, false", int: "number", float: "number", dict: "table", list: "list"}

#: Default -> label.
DEFAULT_LABELS = {
    "None": "none",
    "True": "true",
    "False": "false",
    "[]": "`[]`",
    "{}": "empty",
    "": "none",
}


def fill_tables(page: str) -> str:
    """Return a page with its tables generated from the classes."""
    anchors = _find_anchors(page)

    def format_marked_table(marker: re.Match[str]) -> str:
        if marker[1] == "codes":
            rows = format_codes_table()
        else:
            rows = (
                format_keys_table(marker[2])
                if marker[1] == "keys"
                else format_fields_table(marker[2], anchors)
            )
        return f"{marker[0].partition('|')[0]}{rows}"

    return TABLE_MARKER.sub(format_marked_table, page)


def format_codes_table() -> str:
    """Return the table of all error codes, in alphabetical order."""
    rows = (f"| `{code}` | {mistake.rstrip('.')} |\n" for code, mistake in sorted(CODES.items()))
    return CODES_HEADER + "".join(rows)


def _find_anchors(page: str) -> dict[str, str]:
    """Return class -> anchor of its heading, for the first table below each heading."""
    anchors, anchor = {}, ""
    for section in SECTION.finditer(page):
        if section["heading"] is not None:
            anchor = re.sub(r"[^\w -]", "", section["heading"]).lower().replace(" ", "-")
        elif anchor not in anchors.values():
            anchors[section["part"]] = anchor
    return anchors


def format_fields_table(name: str, anchors: dict[str, str]) -> str:
    """Return the table of fields of a class, with links to the tables of nested classes."""
    result_class = RESULT_CLASSES[name]
    comments = schemas.field_comments(result_class)
    rows = (
        (
            f"`{schemas.key_of_field(result_class, field)}`",
            _describe_type(hint, anchors),
            _escape_cell(comments[field]),
        )
        for field, hint in schemas.field_types(result_class).items()
    )
    return FIELDS_HEADER + "".join(f"| {' | '.join(cells)} |\n" for cells in rows)


def _escape_cell(comment: str) -> str:
    return re.sub(r"\bnull\b", "`null`", comment).replace("|", r"\|").rstrip(".")


def _describe_type(hint: Any, anchors: dict[str, str], *, is_plural: bool = False) -> str:
    """Return the description of a type, in the plural if is_plural."""
    arguments = [argument for argument in typing.get_args(hint) if argument is not types.NoneType]
    origin, s = typing.get_origin(hint), "s" * is_plural
    if origin in (Annotated, typing.Union, types.UnionType):
        return " or ".join(
            dict.fromkeys(
                _describe_type(argument, anchors, is_plural=is_plural) for argument in arguments
            )
        )
    if origin is Literal:
        return ", ".join(f"`{choice}`" for choice in arguments)
    if origin in (list, tuple):
        return f"list{s} of {_describe_type(arguments[0], anchors, is_plural=True)}"
    if origin is dict:
        values = _describe_type(arguments[1], anchors, is_plural=True)
        return f"tables of {values}" if is_plural else f"{values} by name"
    if hint.__name__ in RESULT_CLASSES:
        anchor = anchors.get(hint.__name__)
        return f"[table{s}](#{anchor})" if anchor else f"table{s}"
    labels = {bool: "true or false", int: f"number{s}", float: f"number{s}", str: f"text{s}"}
    return labels[hint]


def format_keys_table(name: str) -> str:
    """Return the table of keys of a class."""
    return (
        KEYS_HEADER
        + "".join(_format_row(key, field) for key, field in find_keys(name).items())
        + TERM_ROWS.get(name, "")
    )


def find_keys(name: str) -> dict[str, FieldInfo]:
    """Return key -> field, except terms and keys inherited from classes with their own table.

    name: Name of the class; "Run of readings" selects the keys restricted to "readings".
    """
    name, _, restriction = name.partition(" of ")
    model = find_model(name)
    bases = [b for b in model.__bases__ if b.__name__ in CLASSES_WITH_TABLE]
    documented_keys = {key for base in bases for key in base.model_fields} | set(
        ACCELEROMETER_TERMS
    )
    fields = {field.alias or name: field for name, field in model.model_fields.items()}
    undocumented = {key: field for key, field in fields.items() if key not in documented_keys}
    return {
        key: f
        for key, f in undocumented.items()
        if field_extra(f).get("x-of", restriction) == restriction
    }


def find_model(name: str) -> type[BaseModel]:
    """Return the class with this name, at any depth of the documents."""
    pending: list[type[BaseModel]] = [*DOCUMENTS]
    models: dict[str, type[BaseModel]] = {}
    while name not in models:
        model = pending.pop()
        models[model.__name__] = model
        for field in model.model_fields.values():
            section_models = [
                metadata.model for metadata in field.metadata if isinstance(metadata, Section)
            ]
            pending += [
                nested_model
                for annotation in (field.annotation, *section_models)
                for nested_model in _find_models(annotation)
            ]
        pending += [base for base in model.__bases__ if issubclass(base, SettingsSection)]
    return models[name]


def _find_models(annotation: Any) -> set[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return {annotation}
    return {m for inner in typing.get_args(annotation) for m in _find_models(inner)}


def _format_row(key: str, field: FieldInfo) -> str:
    extra = field_extra(field)
    type_label = extra.get("x-kind") or _describe_input(field.annotation, field.metadata)
    (value,) = field.examples or [None]
    example = f"`{key} = {format_value(value)}`"
    cells = (
        f"`{key}`",
        type_label,
        _format_default(field, extra),
        example,
        field.description or "",
    )
    return "| " + " | ".join(cells) + " |\n"


def _format_default(field: FieldInfo, extra: dict[str, str]) -> str:
    if field.is_required():
        return "required"
    default = field.get_default(call_default_factory=True)
    if extra.get("x-absent") is not None:
        return extra["x-absent"]
    if isinstance(default, float):
        return f"{default:g}"
    return DEFAULT_LABELS.get(
        str(default), f"`{default}`" if isinstance(default, str) else str(default)
    )


def _describe_input(annotation: Any, metadata: list[Any]) -> str:
    """Return a description of the values a key accepts."""
    validators = list(metadata)
    while typing.get_origin(annotation) in (Annotated, typing.Union, types.UnionType):
        arguments = [a for a in typing.get_args(annotation) if a is not types.NoneType]
        if typing.get_origin(annotation) is Annotated:
            validators += arguments[1:]
        annotation = arguments[0]
    readers = [validator.func for validator in validators if isinstance(validator, PlainValidator)]
    for reader in readers:
        if isinstance(reader, partial):
            uncertainty = " ±" if reader.func is uncertain_quantity("m").func.func else ""
            return f"quantity{uncertainty}, {reader.args[0]}"
    origin = typing.get_origin(annotation)
    if origin is Literal:
        return ", ".join(f"`{choice}`" for choice in typing.get_args(annotation))
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return "table"
    if origin is list and _find_models(annotation):
        return "list of tables"
    return TYPE_LABELS.get(origin or annotation, "date" if "date" in str(annotation) else "text")


if __name__ == "__main__":
    for page in sorted(DOCS.glob("*.md")):
        text = page.read_text("utf-8")
        if (new := fill_tables(text)) != text:
            page.write_text(new, "utf-8")
