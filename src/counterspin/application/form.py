"""Sections and fields of forms, generated from the models that validate the files."""

from __future__ import annotations

import datetime
import re
import types
import typing
from collections.abc import Mapping, Sequence
from functools import cache, partial
from typing import Annotated, Any, Final, Literal, cast

from pydantic import AfterValidator, BaseModel, PlainValidator
from pydantic.fields import FieldInfo

from counterspin.application.answers import FormField, FormSection, TermRow
from counterspin.application.pages import find_page_of_model, resolve_page_link
from counterspin.campaign.field_types import (
    OUTPUT_UNITS,
    TIME_STAMP_UNIT,
    check_angle_unit,
    check_output_unit,
    check_time_unit,
    field_extra,
    parse_temperature,
    parse_temperatures,
)
from counterspin.campaign.runs import READINGS, RECORDS, is_reading
from counterspin.campaign.terms import BARE_NAMES
from counterspin.campaign.truth import TRUE_TABLES, AccelerometerTruthSettings
from counterspin.campaign.validation import find_model, nested_models
from counterspin.certificates.codes import codes_in_force
from counterspin.certificates.evidence import ALL_TERMS
from counterspin.certificates.lab import Lab, parse_celsius
from counterspin.physics.terms import ACCELEROMETER_TERMS, READING_TERMS, SHARED_TERMS, TERMS
from counterspin.planning.plan_sections import PlanDocument, ReadingPlanDocument
from counterspin.schemas import SECTION_MODELS, strip_links
from counterspin.units import expected_quantity, normalise_unit

#: Sections with a table for each name, and sections that are lists of tables.
_REPEATED_SECTIONS: Final = {
    "accelerometers": "names",
    "runs": "list",
    "persons": "list",
    "equipment": "list",
    "stations": "list",
    "truth": "names",
}

#: Validator of a unit -> units of the accepted dimensions.
_UNIT_CHOICES: Final[Mapping[Any, tuple[str, ...]]] = {
    check_time_unit: ("s", TIME_STAMP_UNIT),
    check_angle_unit: ("rad", "count"),
    check_output_unit: ("m/s^2", "g", *OUTPUT_UNITS),
    normalise_unit: ("g", *OUTPUT_UNITS),
}

#: Type -> type of the input; "text" for all other types.
_INPUT_KINDS: Final[Mapping[Any, str]] = {
    bool: "flag",
    datetime.date: "date",
    dict: "table",
    float: "number",
    int: "number",
    list: "list",
    tuple: "list",
}

_MARKDOWN_LINK: Final = re.compile(r"\[([^\]]+)\]\(([^)]*)\)")


@cache
def campaign_form() -> tuple[FormSection, ...]:
    """Return the sections of ``campaign.toml`` with their fields."""
    sections = []
    for key, model in SECTION_MODELS.items():
        section = _make_section(key, model, "campaign")
        if key == "runs":
            section["fields"] = _make_fields(model, "campaign", READINGS)
            section["reading_fields"] = _make_fields(model, "campaign", RECORDS)
        if key == "specification":
            section["name_fields"] = _make_tolerance_fields()
            section["fields"] = section["name_fields"] + section["fields"]
        if key == "truth":
            section["fields"] = _make_fields(AccelerometerTruthSettings, "campaign")
            section["table_fields"] = {
                name: _make_fields(model, "campaign") for name, model in TRUE_TABLES.items()
            }
        sections.append(section)
    return tuple(sections)


@cache
def lab_form() -> tuple[FormSection, ...]:
    """Return the sections of ``LAB.toml`` with their fields."""
    sections = []
    for name, field in Lab.model_fields.items():
        model = find_model(field.annotation)
        if model is not None:
            sections.append(_make_section(field.alias or name, model, "certificate"))
    evidence_field = Lab.model_fields["evidence"]
    sections.append(
        {
            "key": "evidence",
            "words": strip_links(evidence_field.description or ""),
            "explained": "certificate#assumed-terms",
            "repeat": None,
            "fields": [
                _make_text_field(ALL_TERMS, "a report", "evidence for every term"),
                *(_make_text_field(symbol, "a report or a data sheet") for symbol in TERMS),
            ],
        }
    )
    return tuple(sections)


@cache
def plan_form(is_reading_plan: bool) -> tuple[FormSection, ...]:
    """Return the sections of a plan: sections of plans only, then sections of campaigns."""
    campaign_sections = {section["key"]: section for section in campaign_form()}
    document = ReadingPlanDocument if is_reading_plan else PlanDocument
    sections = []
    for key, annotation in nested_models(document).items():
        model = find_model(annotation)
        if model is not None:
            sections.append(campaign_sections.get(key) or _make_section(key, model, "plan"))
    # Sections of plans only come first.
    return tuple(sorted(sections, key=lambda section: section["key"] in campaign_sections))


def detect_run_types(document: Mapping[str, Any]) -> list[str]:
    """Return the type of each run of a document, ``record`` or ``reading``."""
    runs = document.get("runs")
    entries = runs if isinstance(runs, list) else []
    return ["reading" if is_reading(run) else "record" for run in entries]


def _make_tolerance_fields() -> list[FormField]:
    """Return the fields of tolerance limits, one for each term of an accelerometer."""
    return [_make_text_field(symbol, f"abs <= … {row.unit}") for symbol, row in TERMS.items()]


def _make_text_field(key: str, example: str, help_text: str = "") -> FormField:
    """Return an optional text field."""
    return {
        "key": key,
        "label": _key_label(key),
        "help": help_text,
        "links": [],
        "required": False,
        "kind": "text",
        "example": example,
    }


def _make_section(key: str, model: type[BaseModel], page: str) -> FormSection:
    """Return a section; `page` is used if no documentation page has a table for the model."""
    docstring = (model.__doc__ or "").partition("\n")[0]
    # "[site]: gravity and latitude of the centrifuge."
    description = docstring.partition("]: ")[2]
    return {
        "key": key,
        "words": (description[:1].upper() + description[1:]).replace("`", ""),
        "explained": find_page_of_model(model) or page,
        "repeat": _REPEATED_SECTIONS.get(key),
        "fields": _make_fields(model, page),
    }


def _make_fields(model: type[BaseModel], page: str, excluded_method: str = "") -> list[FormField]:
    """Return the fields of a table, except those for `excluded_method` only."""
    page = (find_page_of_model(model) or page).partition("#")[0]
    return [
        _make_field(field.alias or name, field, page)
        for name, field in model.model_fields.items()
        if not excluded_method or field_extra(field).get("x-of") != excluded_method
    ]


def _make_field(key: str, field: FieldInfo, page: str) -> FormField:
    base_type, metadata = _unwrap_annotation(field.annotation, field.metadata)
    field_options = field_extra(field)
    default = field_options.get("x-absent")
    meaning = (
        ""
        if key in ACCELEROMETER_TERMS
        else (field.description or "").removesuffix("; see the following table")
    )
    help_text = "; ".join(filter(None, [meaning, f"default: {default}" if default else ""]))
    form_field: FormField = {
        "key": key,
        "label": field_options.get("x-label") or _key_label(key),
        "help": strip_links(help_text).replace("`", ""),
        "links": _find_links(help_text, page),
        "required": field.is_required(),
        **cast("FormField", _describe_input(base_type, metadata, page)),
    }
    kind_text = field_options.get("x-kind", "")
    if kind_text.startswith("date"):
        form_field["kind"] = "date"
    elif kind_text in ("country", "language"):
        form_field["kind"], form_field["names"] = kind_text, dict(codes_in_force(kind_text))
    elif kind_text.startswith("list of terms"):
        form_field["kind"], form_field["rows"] = "terms", _make_term_rows()
    (example,) = field.examples or [None]
    if isinstance(example, str | int | float) and not isinstance(example, bool):
        form_field["example"] = str(example)
        example_unit = re.fullmatch(r"\S+(?: ± \S+)? (.+)", form_field["example"])
        if form_field["kind"] == "quantity" and example_unit is not None:
            form_field["units"] = list(dict.fromkeys([example_unit[1], *form_field["units"]]))
    return form_field


def _find_links(help_text: str, page: str) -> list[tuple[str, str]]:
    """Return text and page of each link in a help text."""
    links = (
        (link_text.replace("`", ""), resolve_page_link(target, page))
        for link_text, target in _MARKDOWN_LINK.findall(help_text)
    )
    return [(link_text, target) for link_text, target in links if target is not None]


def _key_label(key: str) -> str:
    """Return the label of a key; for a term, its description with its symbol."""
    if key in ACCELEROMETER_TERMS:
        description = ACCELEROMETER_TERMS[key].words
        return f"{description[:1].upper()}{description[1:]} ({key})"
    quantity = key.removeprefix("u").removeprefix("_")
    if key in ("u", f"u_{quantity}"):
        key = "_of_".join(filter(None, ("uncertainty", quantity)))
    return key[:1].upper() + key[1:].replace("_", " ")


@cache
def _make_term_rows() -> tuple[TermRow, ...]:
    """Return the terms and families that a list of terms can contain, with descriptions."""
    rows = {symbol: row.words for symbol, row in ACCELEROMETER_TERMS.items()}
    for family, member_terms in BARE_NAMES.items():
        if family.count(".") == 1:
            rows[family] = f"{member_terms[0].words} (and similar terms)"
    for symbol, row in (*SHARED_TERMS.items(), *READING_TERMS.items()):
        if symbol.count(".") == 1:
            rows.setdefault(symbol, row.words)
    return tuple({"key": name, "words": text[:1].upper() + text[1:]} for name, text in rows.items())


def _unwrap_annotation(annotation: Any, metadata: Sequence[Any]) -> tuple[Any, list[Any]]:
    """Return the type inside Annotated and Optional, and the collected metadata."""
    all_metadata = list(metadata)
    while True:
        origin = typing.get_origin(annotation)
        if origin is Annotated:
            annotation, *arguments = typing.get_args(annotation)
            all_metadata += arguments
        elif origin in (typing.Union, types.UnionType):
            alternatives = [
                alternative
                for alternative in typing.get_args(annotation)
                if alternative is not type(None)
            ]
            if len(alternatives) > 1:
                return (dict if _includes_table(alternatives) else object), all_metadata
            annotation = alternatives[0]
        else:
            return annotation, all_metadata


def _includes_table(alternatives: Sequence[Any]) -> bool:
    return any(typing.get_origin(alternative) is dict for alternative in alternatives)


def _describe_input(base_type: Any, metadata: Sequence[Any], page: str) -> dict[str, Any]:
    """Return type, choices, suggestions, units and other properties of an input."""
    if typing.get_origin(base_type) is Literal:
        return {"kind": "choice", "choices": list(typing.get_args(base_type))}
    value_parsers = [item for item in metadata if isinstance(item, PlainValidator)]
    if value_parsers:
        value_parser, input_type = value_parsers[0].func, value_parsers[0].json_schema_input_type
        fields: dict[str, Any] = {"kind": "number" if _is_number(input_type, base_type) else "text"}
        if isinstance(value_parser, partial):
            units = expected_quantity(value_parser.args[0])[1].split(", ")
            fields = {"kind": "quantity", "unit": value_parser.args[0], "units": units}
        elif value_parser in (parse_temperature, parse_temperatures):
            fields = {"kind": "quantity", "unit": "K", "units": ["degC", "K"]}
        elif value_parser is parse_celsius:
            fields = {"kind": "quantity", "unit": "degC", "units": ["degC"]}
        suggestions = [
            choice
            for alternative in _alternatives(input_type)
            for choice in _literal_choices(alternative)
        ]
        return fields | ({"suggestions": suggestions} if suggestions else {})
    if isinstance(base_type, type) and issubclass(base_type, BaseModel):
        return {"kind": "group", "fields": _make_fields(base_type, page)}
    checks = [item.func for item in metadata if isinstance(item, AfterValidator)]
    unit_choices = next((choices for check in checks if (choices := _accepted_units(check))), ())
    if unit_choices:
        suggestions = [
            unit for choice in unit_choices for unit in expected_quantity(choice)[1].split(", ")
        ]
        return {"kind": "text", "suggestions": list(dict.fromkeys(suggestions))}
    origin = typing.get_origin(base_type)
    return {"kind": _INPUT_KINDS.get(origin or base_type, "text")}


def _alternatives(annotation: Any) -> Sequence[Any]:
    """Return the alternatives of a union type, or the type itself."""
    return typing.get_args(annotation) if _is_union(annotation) else [annotation]


def _is_union(annotation: Any) -> bool:
    return typing.get_origin(annotation) in (typing.Union, types.UnionType)


def _literal_choices(annotation: Any) -> Sequence[Any]:
    return typing.get_args(annotation) if typing.get_origin(annotation) is Literal else ()


def _is_number(annotation: Any, base_type: Any) -> bool:
    return any(
        alternative in (float, int)
        for alternative in _alternatives(base_type if annotation is Any else annotation)
    )


def _accepted_units(check: Any) -> tuple[str, ...]:
    """Return units of the dimensions that a validator of units accepts."""
    if isinstance(check, partial):
        return tuple(check.args)
    return _UNIT_CHOICES.get(check, ())
