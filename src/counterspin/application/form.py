"""The sections and fields of forms, made of the models that check the file."""

from __future__ import annotations

import datetime
import re
import types
import typing
from collections.abc import Mapping, Sequence
from functools import cache, partial
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, BaseModel, PlainValidator
from pydantic.fields import FieldInfo

from counterspin.application.pages import address, page_explaining
from counterspin.campaign.field_types import (
    OUTPUTS,
    STAMPS,
    angle_unit,
    extra_of,
    force_or_output,
    parse_temperature,
    parse_temperatures,
    time_unit,
)
from counterspin.campaign.runs import READINGS, RECORDS, is_reading
from counterspin.campaign.terms import BARE_NAMES
from counterspin.campaign.truth import TRUE_TABLES, AccelerometerTruthSettings
from counterspin.campaign.validation import model_inside, nested_models
from counterspin.certificates.codes import codes_in_force
from counterspin.certificates.evidence import ALL
from counterspin.certificates.lab import Lab, parse_celsius
from counterspin.physics.terms import ACCELEROMETER_TERMS, READING_TERMS, SHARED_TERMS, TERMS
from counterspin.planning.plan_sections import PlanDocument, ReadingPlanDocument
from counterspin.schemas import SECTIONS, unlinked
from counterspin.units import advice, check_unit

#: Sections that hold a table for each name, and those that are a list of tables.
_REPEATED: Final = {
    "accelerometers": "names",
    "runs": "list",
    "persons": "list",
    "equipment": "list",
    "stations": "list",
    "truth": "names",
}

#: Check of a unit's name -> units of the dimensions that it lets pass.
_UNITS_WANTED: Final[Mapping[Any, tuple[str, ...]]] = {
    time_unit: ("s", STAMPS),
    angle_unit: ("rad", "count"),
    force_or_output: ("m/s^2", "g", *OUTPUTS),
    check_unit: ("g", *OUTPUTS),
}

#: Type -> how it is asked for; others as text.
_KINDS: Final[Mapping[Any, str]] = {
    bool: "flag",
    datetime.date: "date",
    dict: "table",
    float: "number",
    int: "number",
    list: "list",
    tuple: "list",
}

_LINK: Final = re.compile(r"\[([^\]]+)\]\(([^)]*)\)")

Field = dict[str, Any]


@cache
def campaign_form() -> tuple[Field, ...]:
    """Return the sections of ``campaign.toml``, each with its fields."""
    sections = []
    for key, model in SECTIONS.items():
        section = _section(key, model, "campaign")
        if key == "runs":
            section["fields"] = _fields(model, "campaign", READINGS)
            section["of_readings"] = _fields(model, "campaign", RECORDS)
        if key == "specification":
            section["of_names"] = _limits()
            section["fields"] = section["of_names"] + section["fields"]
        if key == "truth":
            section["fields"] = _fields(AccelerometerTruthSettings, "campaign")
            section["of_tables"] = {
                name: _fields(model, "campaign") for name, model in TRUE_TABLES.items()
            }
        sections.append(section)
    return tuple(sections)


@cache
def lab_form() -> tuple[Field, ...]:
    """Return the sections of ``LAB.toml``, each with its fields."""
    sections = []
    for name, field in Lab.model_fields.items():
        model = model_inside(field.annotation)
        if model is not None:
            sections.append(_section(field.alias or name, model, "certificate"))
    evidence = Lab.model_fields["evidence"]
    sections.append(
        {
            "key": "evidence",
            "words": unlinked(evidence.description or ""),
            "explained": "certificate#what-is-assumed",
            "repeat": None,
            "fields": [
                _text_field(ALL, "a report") | {"help": "for every term"},
                *(_text_field(symbol, "a report or a data sheet") for symbol in TERMS),
            ],
        }
    )
    return tuple(sections)


@cache
def plan_form(of_readings: bool) -> tuple[Field, ...]:
    """Return the sections of a plan: those of a campaign, and those of plans only."""
    known = {section["key"]: section for section in campaign_form()}
    document = ReadingPlanDocument if of_readings else PlanDocument
    sections = []
    for key, written in nested_models(document).items():
        model = model_inside(written)
        if model is not None:
            sections.append(known.get(key) or _section(key, model, "plan"))
    # What makes it a plan comes first.
    return tuple(sorted(sections, key=lambda section: section["key"] in known))


def run_kinds(document: Mapping[str, Any]) -> list[str]:
    """Return the kind of each run of a document, ``record`` or ``reading``."""
    runs = document.get("runs")
    some = runs if isinstance(runs, list) else []
    return ["reading" if is_reading(run) else "record" for run in some]


def _limits() -> list[Field]:
    """Return the fields of tolerance limits, one for each term of an accelerometer."""
    return [_text_field(symbol, f"abs <= … {row.unit}") for symbol, row in TERMS.items()]


def _text_field(key: str, example: str) -> Field:
    """Return an optional field of text without help."""
    return {
        "key": key,
        "label": _label(key),
        "help": "",
        "links": [],
        "required": False,
        "kind": "text",
        "example": example,
    }


def _section(key: str, model: type[BaseModel], page: str) -> Field:
    """Return a section; page: of the documentation, if the class has no table in it."""
    words = (model.__doc__ or "").partition("\n")[0]
    # "[site]: gravity and latitude of the centrifuge."
    said = words.partition("]: ")[2]
    return {
        "key": key,
        "words": (said[:1].upper() + said[1:]).replace("`", ""),
        "explained": page_explaining(model) or page,
        "repeat": _REPEATED.get(key),
        "fields": _fields(model, page),
    }


def _fields(model: type[BaseModel], page: str, left_out: str = "") -> list[Field]:
    """Return the fields of a table, without those of some tables only; page: as of `_section`."""
    page = (page_explaining(model) or page).partition("#")[0]
    return [
        _field(field.alias or name, field, page)
        for name, field in model.model_fields.items()
        if not left_out or extra_of(field).get("x-of") != left_out
    ]


def _field(key: str, field: FieldInfo, page: str) -> Field:
    base, metadata = _unwrapped(field.annotation, field.metadata)
    extra = extra_of(field)
    absent = extra.get("x-absent")
    meaning = (
        "" if key in ACCELEROMETER_TERMS else (field.description or "").removesuffix("; see below")
    )
    said = "; ".join(filter(None, [meaning, f"if left out: {absent}" if absent else ""]))
    asked = {
        "key": key,
        "label": extra.get("x-label") or _label(key),
        "help": unlinked(said).replace("`", ""),
        "links": _links(said, page),
        "required": field.is_required(),
        **_kind(base, metadata, page),
    }
    words = extra.get("x-kind", "")
    if words.startswith("date"):
        asked["kind"] = "date"
    elif words in ("country", "language"):
        asked |= {"kind": words, "names": dict(codes_in_force(words))}
    elif words.startswith("list of terms"):
        asked |= {"kind": "terms", "rows": _term_rows()}
    (example,) = field.examples or [None]
    if isinstance(example, str | int | float) and not isinstance(example, bool):
        asked["example"] = str(example)
        usual = re.fullmatch(r"\S+(?: ± \S+)? (.+)", asked["example"])
        if asked["kind"] == "quantity" and usual is not None:
            asked["units"] = list(dict.fromkeys([usual[1], *asked["units"]]))
    return asked


def _links(said: str, page: str) -> list[tuple[str, str]]:
    """Return the words of a help in order, and the page of its link."""
    found = ((words.replace("`", ""), address(to, page)) for words, to in _LINK.findall(said))
    return [(words, to) for words, to in found if to is not None]


def _label(key: str) -> str:
    """Return a key in words: a term's description with its symbol."""
    if key in ACCELEROMETER_TERMS:
        words = ACCELEROMETER_TERMS[key].words
        return f"{words[:1].upper()}{words[1:]} ({key})"
    of_what = key.removeprefix("u").removeprefix("_")
    if key in ("u", f"u_{of_what}"):
        key = "_of_".join(filter(None, ("uncertainty", of_what)))
    return key[:1].upper() + key[1:].replace("_", " ")


@cache
def _term_rows() -> tuple[Field, ...]:
    """Return the names that a list of terms may have, with descriptions: terms and families."""
    rows = {symbol: row.words for symbol, row in ACCELEROMETER_TERMS.items()}
    for family, of_family in BARE_NAMES.items():
        if family.count(".") == 1:
            rows[family] = f"{of_family[0].words}, and so on"
    for symbol, row in (*SHARED_TERMS.items(), *READING_TERMS.items()):
        if symbol.count(".") == 1:
            rows.setdefault(symbol, row.words)
    return tuple({"key": s, "words": words[:1].upper() + words[1:]} for s, words in rows.items())


def _unwrapped(annotation: Any, metadata: Sequence[Any]) -> tuple[Any, list[Any]]:
    """Return the type inside Annotated and Optional, and the collected metadata."""
    said = list(metadata)
    while True:
        origin = typing.get_origin(annotation)
        if origin is Annotated:
            annotation, *more = typing.get_args(annotation)
            said += more
        elif origin in (typing.Union, types.UnionType):
            some = [part for part in typing.get_args(annotation) if part is not type(None)]
            if len(some) > 1:
                return (dict if _a_table(some) else object), said
            annotation = some[0]
        else:
            return annotation, said


def _a_table(some: Sequence[Any]) -> bool:
    return any(typing.get_origin(part) is dict for part in some)


def _kind(base: Any, metadata: Sequence[Any], page: str) -> Field:
    """Return the input of a value: its choices or suggestions, its unit and other properties."""
    if typing.get_origin(base) is Literal:
        return {"kind": "choice", "choices": list(typing.get_args(base))}
    readers = [said for said in metadata if isinstance(said, PlainValidator)]
    if readers:
        read, written = readers[0].func, readers[0].json_schema_input_type
        asked: Field = {"kind": "number" if _is_number(written, base) else "text"}
        if isinstance(read, partial):
            units = advice(read.args[0])[1].split(", ")
            asked = {"kind": "quantity", "unit": read.args[0], "units": units}
        elif read in (parse_temperature, parse_temperatures):
            asked = {"kind": "quantity", "unit": "K", "units": ["degC", "K"]}
        elif read is parse_celsius:
            asked = {"kind": "quantity", "unit": "degC", "units": ["degC"]}
        named = [choice for part in _parts(written) for choice in _choices(part)]
        return asked | ({"suggestions": named} if named else {})
    if isinstance(base, type) and issubclass(base, BaseModel):
        return {"kind": "group", "fields": _fields(base, page)}
    checks = [said.func for said in metadata if isinstance(said, AfterValidator)]
    wanted = next((found for check in checks if (found := _units_wanted(check))), ())
    if wanted:
        named = [unit for one in wanted for unit in advice(one)[1].split(", ")]
        return {"kind": "text", "suggestions": list(dict.fromkeys(named))}
    origin = typing.get_origin(base)
    return {"kind": _KINDS.get(origin or base, "text")}


def _parts(written: Any) -> Sequence[Any]:
    """Return the alternatives of a value's type, in order."""
    return typing.get_args(written) if _is_union(written) else [written]


def _is_union(written: Any) -> bool:
    return typing.get_origin(written) in (typing.Union, types.UnionType)


def _choices(written: Any) -> Sequence[Any]:
    return typing.get_args(written) if typing.get_origin(written) is Literal else ()


def _is_number(written: Any, base: Any) -> bool:
    return any(part in (float, int) for part in _parts(base if written is Any else written))


def _units_wanted(check: Any) -> tuple[str, ...]:
    """Return units of the dimensions that a unit's validator accepts."""
    if isinstance(check, partial):
        return tuple(check.args)
    return _UNITS_WANTED.get(check, ())
