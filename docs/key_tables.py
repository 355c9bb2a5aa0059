"""Make the tables of keys and fields in these pages from the classes that read and write them.

`python docs/key_tables.py` writes them anew, each below its `<!-- keys: CLASS -->` of a document or
`<!-- fields: CLASS -->` of a result; the table of error codes below `<!-- codes: all -->`. A test
compares.
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

HERE = Path(__file__).parent
PLACE = re.compile(r"^<!-- (keys|fields|codes): ([\w ]+) -->\n(?:\|.*\n)*", re.MULTILINE)
HEAD = "| key | kind | default | example | meaning |\n|---|---|---|---|---|\n"
FIELDS_HEAD = "| key | kind | meaning |\n|---|---|---|\n"
CODES_HEAD = "| code | mistake |\n|---|---|\n"

#: What has tables of keys.
DOCUMENTS = (
    StudyCampaignDocument,
    StudyDocument,
    PlanDocument,
    ReadingPlanDocument,
    Lab,
    AccelerometerTruthSettings,
)

#: Name -> class, of every part of the results that have a page of their own.
PARTS = {
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

#: Classes that have a table of keys.
SHOWN = {
    name
    for page in HERE.glob("*.md")
    for kind, name in PLACE.findall(page.read_text("utf-8"))
    if kind == "keys"
}

#: A heading, or the place of a table of fields below it.
SECTION = re.compile(r"^(?:#+ (?P<heading>.*)|<!-- fields: (?P<part>\w+) -->)$", re.MULTILINE)

#: The one row that stands for all terms.
TERMS = {
    "AccelerometerKeys": "| `K_III` and so on | quantity ± | unknown | "
    '`K_III = "0 ± 1e-5 g/g^3"` | prior of another [term](physics.md#accelerometer-eq-7-9) |\n',
    "AccelerometerTruthSettings": "| `K_II` and so on | quantity | a perfect instrument's | "
    '`K_II = "2e-5 g/g^2"` | true coefficient; if the accelerometer has an `output`, its unit is '
    'also accepted, as in `"1.25 mA/g"`; write slopes such as `"K_F.trend"` in quotation marks |\n',
}

#: What a type is called; of other types it is text.
KINDS = {bool: "true, false", int: "number", float: "number", dict: "table", list: "list"}

#: How defaults are called.
DEFAULTS = {
    "None": "none",
    "True": "true",
    "False": "false",
    "[]": "`[]`",
    "{}": "empty",
    "": "none",
}


def filled(page: str) -> str:
    """Return a page with its tables as the classes have them."""
    anchors = _anchors(page)

    def made(place: re.Match[str]) -> str:
        if place[1] == "codes":
            rows = codes_table()
        else:
            rows = table(place[2]) if place[1] == "keys" else fields_table(place[2], anchors)
        return f"{place[0].partition('|')[0]}{rows}"

    return PLACE.sub(made, page)


def codes_table() -> str:
    """Return the table of all error codes, in alphabetical order."""
    rows = (f"| `{code}` | {mistake.rstrip('.')} |\n" for code, mistake in sorted(CODES.items()))
    return CODES_HEAD + "".join(rows)


def _anchors(page: str) -> dict[str, str]:
    """Return class -> anchor of the heading above its table, the first that is below it."""
    found, anchor = {}, ""
    for section in SECTION.finditer(page):
        if section["heading"] is not None:
            anchor = re.sub(r"[^\w -]", "", section["heading"]).lower().replace(" ", "-")
        elif anchor not in found.values():
            found[section["part"]] = anchor
    return found


def fields_table(name: str, anchors: dict[str, str]) -> str:
    """Return the table of a part of a result, with links to the tables of its own parts."""
    part = PARTS[name]
    said = schemas.field_comments(part)
    rows = (
        (f"`{schemas.key_of_field(part, field)}`", _shape(hint, anchors), _cell(said[field]))
        for field, hint in schemas.field_types(part).items()
    )
    return FIELDS_HEAD + "".join(f"| {' | '.join(cells)} |\n" for cells in rows)


def _cell(words: str) -> str:
    return re.sub(r"\bnull\b", "`null`", words).replace("|", r"\|").rstrip(".")


def _shape(hint: Any, anchors: dict[str, str], *, several: bool = False) -> str:
    """Return what a value of a result is; several: in the plural."""
    inner = [one for one in typing.get_args(hint) if one is not types.NoneType]
    origin, s = typing.get_origin(hint), "s" * several
    if origin in (Annotated, typing.Union, types.UnionType):
        return " or ".join(dict.fromkeys(_shape(one, anchors, several=several) for one in inner))
    if origin is Literal:
        return ", ".join(f"`{choice}`" for choice in inner)
    if origin in (list, tuple):
        return f"list{s} of {_shape(inner[0], anchors, several=True)}"
    if origin is dict:
        values = _shape(inner[1], anchors, several=True)
        return f"tables of {values}" if several else f"{values} by name"
    if hint.__name__ in PARTS:
        anchor = anchors.get(hint.__name__)
        return f"[table{s}](#{anchor})" if anchor else f"table{s}"
    words = {bool: "true or false", int: f"number{s}", float: f"number{s}", str: f"text{s}"}
    return words[hint]


def table(name: str) -> str:
    """Return the table of a class."""
    return (
        HEAD + "".join(_row(key, field) for key, field in keys(name).items()) + TERMS.get(name, "")
    )


def keys(name: str) -> dict[str, FieldInfo]:
    """Return key -> field, without terms and without those of a class that has a table itself.

    name: Of the class; "Run of readings" where it has keys that only some of its tables have.
    """
    name, _, some = name.partition(" of ")
    model = model_of(name)
    bases = [b for b in model.__bases__ if b.__name__ in SHOWN]
    told = {key for base in bases for key in base.model_fields} | set(ACCELEROMETER_TERMS)
    named = {field.alias or name: field for name, field in model.model_fields.items()}
    own = {key: field for key, field in named.items() if key not in told}
    return {key: f for key, f in own.items() if field_extra(f).get("x-of", some) == some}


def model_of(name: str) -> type[BaseModel]:
    """Return the class of a table, wherever a document has it."""
    waiting: list[type[BaseModel]] = [*DOCUMENTS]
    found: dict[str, type[BaseModel]] = {}
    while name not in found:
        model = waiting.pop()
        found[model.__name__] = model
        for field in model.model_fields.values():
            apart = [said.model for said in field.metadata if isinstance(said, Section)]
            waiting += [m for one in (field.annotation, *apart) for m in _models(one)]
        waiting += [base for base in model.__bases__ if issubclass(base, SettingsSection)]
    return found[name]


def _models(annotation: Any) -> set[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return {annotation}
    return {m for inner in typing.get_args(annotation) for m in _models(inner)}


def _row(key: str, field: FieldInfo) -> str:
    extra = field_extra(field)
    kind = extra.get("x-kind") or _kind(field.annotation, field.metadata)
    (value,) = field.examples or [None]
    example = f"`{key} = {format_value(value)}`"
    cells = (f"`{key}`", kind, _default(field, extra), example, field.description or "")
    return "| " + " | ".join(cells) + " |\n"


def _default(field: FieldInfo, extra: dict[str, str]) -> str:
    if field.is_required():
        return "required"
    default = field.get_default(call_default_factory=True)
    if extra.get("x-absent") is not None:
        return extra["x-absent"]
    if isinstance(default, float):
        return f"{default:g}"
    return DEFAULTS.get(str(default), f"`{default}`" if isinstance(default, str) else str(default))


def _kind(annotation: Any, metadata: list[Any]) -> str:
    """Return how a value is written."""
    said = list(metadata)
    while typing.get_origin(annotation) in (Annotated, typing.Union, types.UnionType):
        parts = [a for a in typing.get_args(annotation) if a is not types.NoneType]
        if typing.get_origin(annotation) is Annotated:
            said += parts[1:]
        annotation = parts[0]
    readers = [one.func for one in said if isinstance(one, PlainValidator)]
    for reader in readers:
        if isinstance(reader, partial):
            spread = " ±" if reader.func is uncertain_quantity("m").func.func else ""
            return f"quantity{spread}, {reader.args[0]}"
    origin = typing.get_origin(annotation)
    if origin is Literal:
        return ", ".join(f"`{choice}`" for choice in typing.get_args(annotation))
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return "table"
    if origin is list and _models(annotation):
        return "list of tables"
    return KINDS.get(origin or annotation, "date" if "date" in str(annotation) else "text")


if __name__ == "__main__":
    for page in sorted(HERE.glob("*.md")):
        text = page.read_text("utf-8")
        if (new := filled(text)) != text:
            page.write_text(new, "utf-8")
