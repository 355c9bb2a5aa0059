"""JSON Schemas of documents and results, made from their classes.

A schema states the meaning, format, unit and an example of each key, so that an editor can explain
and check a document while it is written. A schema cannot express all rules: only the program checks
relations between keys and the dimensions of units.
"""

from __future__ import annotations

import dataclasses
import inspect
import json
import re
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any, Final, Literal, get_args, get_type_hints

from pydantic import BaseModel

from counterspin.calibration.result import Result
from counterspin.campaign.validation import find_model, nested_models
from counterspin.certificates.lab import Lab
from counterspin.monitoring.result import NoiseResult
from counterspin.planning.plan_sections import PlanDocument, ReadingPlanDocument
from counterspin.results import ResultFile
from counterspin.studies.description import StudyCampaignDocument, StudyDocument

#: Names of the schemas.
SchemaName = Literal["campaign", "plan", "study", "lab", "result", "noise"]

_DRAFT_URL: Final = "https://json-schema.org/draft/2020-12/schema"

_MARKDOWN_LINK: Final = re.compile(r"\[([^\]]+)\]\([^)]*\)")
_NONE_LITERAL: Final = re.compile(r"`*\bNone\b`*")
#: Docstring of the class of a table, such as ``[site]: gravity and latitude of the centrifuge.``
_TABLE_DOCSTRING: Final = re.compile(r"(\[+.*?\]+|``\w+``)(?: of [^:]*)?: (.*)", re.DOTALL)

#: JSON Schema.
JsonSchema = dict[str, Any]

#: Name of a result with a schema -> its class.
RESULT_CLASSES: Final[Mapping[str, type[ResultFile]]] = {"result": Result, "noise": NoiseResult}

#: Section of ``campaign.toml`` -> the class of its table, or the first of each of its tables.
SECTION_MODELS: Final[Mapping[str, type[BaseModel]]] = {
    key: model
    for key, annotation in nested_models(StudyCampaignDocument).items()
    if (model := find_model(annotation)) is not None
}


def make_schema(name: SchemaName) -> JsonSchema:
    """Return the JSON Schema (draft 2020-12) of a document or result."""
    title, build_schema = _SCHEMAS[name]
    result = RESULT_CLASSES.get(name)
    version = 1 if result is None else result.newest_schema()
    head = {"$schema": _DRAFT_URL, "$id": f"urn:counterspin:schema:{name}:{version}"}
    schema: JsonSchema = _simplify_schema(build_schema(), allow_null=result is not None)
    return head | {"title": title} | {key: value for key, value in schema.items() if key != "title"}


def schema_text(name: SchemaName) -> str:
    """Return a schema as JSON text, in ASCII."""
    return json.dumps(make_schema(name), indent=1) + "\n"


def _document_schema(model: type[BaseModel]) -> JsonSchema:
    return model.model_json_schema(ref_template="#/$defs/{model}")


def _plan_schema() -> JsonSchema:
    """Return the schema of plans of records and plans of readings."""
    record_schema = _document_schema(PlanDocument)
    reading_schema = _document_schema(ReadingPlanDocument)
    definitions = record_schema.pop("$defs") | reading_schema.pop("$defs")
    return {
        "description": "Objective and limits of a plan.",
        "if": {"required": ["stations"]},
        "then": reading_schema,
        "else": record_schema,
        "$defs": definitions,
    }


def _result_schema(result: type[ResultFile]) -> JsonSchema:
    schema = result.json_schema()
    for name, model in collect_models(result).items():
        properties = schema["$defs"].get(name, schema)["properties"]
        for key, description in field_comments(model).items():
            properties[key_of_field(model, key)]["description"] = description
    return schema


def collect_models(model: type) -> dict[str, type]:
    """Return name -> class, for a class and all classes in the types of its fields."""
    models, pending_models = {model.__name__: model}, [model]
    while pending_models:
        for hint in field_types(pending_models.pop()).values():
            new_models = {child_model.__name__: child_model for child_model in iterate_models(hint)}
            pending_models += [
                child_model for name, child_model in new_models.items() if name not in models
            ]
            models |= new_models
    return models


def key_of_field(model: type, field: str) -> str:
    """Return the key of a field in the file."""
    fields = model.model_fields if issubclass(model, BaseModel) else {}
    return fields[field].alias or field if field in fields else field


def field_types(model: type[Any]) -> dict[str, Any]:
    """Return field -> its type."""
    if issubclass(model, BaseModel):
        return {key: field.annotation for key, field in model.model_fields.items()}
    hints = get_type_hints(model)
    return {field.name: hints[field.name] for field in dataclasses.fields(model)}


def iterate_models(hint: Any) -> Iterator[type]:
    """Yield the models and dataclasses in a type hint."""
    if isinstance(hint, type) and (issubclass(hint, BaseModel) or dataclasses.is_dataclass(hint)):
        yield hint
    for argument in get_args(hint):
        yield from iterate_models(argument)


def field_comments(model: type) -> dict[str, str]:
    """Return field -> its ``#:`` comment in the source, behind the field or above it.

    None in Python is null in JSON.
    """
    comments: dict[str, str] = {}
    for base in reversed(model.__mro__):
        if base.__module__.startswith("counterspin."):
            comments |= _parse_comments(inspect.getsource(base), set(base.__annotations__))
    return {key: comment for key, comment in comments.items() if key in field_types(model)}


def _parse_comments(source: str, fields: set[str]) -> dict[str, str]:
    comments: dict[str, str] = {}
    comment_lines: list[str] = []
    for line in source.splitlines():
        name, _, comment_text = line.strip().partition("#:")
        field = name.partition(":")[0]
        if name:
            comment, comment_lines = comment_text or " ".join(comment_lines), []
            if field in fields and comment:
                comments[field] = _NONE_LITERAL.sub("null", strip_links(comment))
        else:
            comment_lines = [*comment_lines, comment_text] if comment_text else []
    return comments


_SCHEMAS: Final[Mapping[SchemaName, tuple[str, Callable[[], JsonSchema]]]] = {
    "campaign": ("campaign.toml: a campaign", partial(_document_schema, StudyCampaignDocument)),
    "plan": ("PLAN.toml: a plan", _plan_schema),
    "study": ("A study of a campaign", partial(_document_schema, StudyDocument)),
    "lab": ("LAB.toml: laboratory data for certificates", partial(_document_schema, Lab)),
    "result": ("The result of a calibration", partial(_result_schema, Result)),
    "noise": ("The noise of a record at rest", partial(_result_schema, NoiseResult)),
}


def _simplify_schema(value: Any, *, allow_null: bool) -> Any:
    """Return a schema without Markdown links, with titles in sentence case.

    allow_null: Whether the document may contain null, which TOML lacks.
    """
    if isinstance(value, list):
        return [_simplify_schema(item, allow_null=allow_null) for item in value]
    if not isinstance(value, dict):
        return value
    schema = {key: _simplify_schema(item, allow_null=allow_null) for key, item in value.items()}
    choices = [
        choice for choice in schema.pop("anyOf", []) if allow_null or choice != {"type": "null"}
    ]
    schema |= choices[0] if len(choices) == 1 else {"anyOf": choices} if choices else {}
    if schema.get("default", ...) is None:
        del schema["default"]
    if "$ref" in schema:
        schema.pop("examples", None)  # the referenced keys have examples
    description, title = schema.get("description"), schema.get("title")
    if isinstance(title, str):
        schema["title"] = title[:1] + title[1:].lower()
    if isinstance(description, str):
        table = _TABLE_DOCSTRING.fullmatch(description)
        if table is not None:
            schema["title"], description = table[1], table[2][:1].upper() + table[2][1:]
        schema["description"] = strip_links(description)
    schema.pop("x-kind", None)
    schema.pop("x-of", None)
    if (default_text := schema.pop("x-absent", None)) is not None and "description" in schema:
        schema["description"] += f" (default: {strip_links(default_text)})"
    if "x-unit" in json.dumps([schema.get("anyOf"), *schema]):
        schema.pop("default", None)  # the default is in SI, not in the unit of the file
    return schema


def strip_links(markdown: str) -> str:
    """Return Markdown in one line, with links replaced by their texts."""
    return " ".join(_MARKDOWN_LINK.sub(r"\1", markdown).replace("``", "`").split())
