"""JSON Schema of every document and result, made from the classes that read and write them.

A schema says of every key what it means, how it is written, its unit and an example, so that an
editor can explain and check a document while it is written. It is no judge: what several keys must
have in common, a unit's dimension for example, only the program knows.
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
from counterspin.campaign.validation import model_inside, nested_models
from counterspin.certificates.lab import Lab
from counterspin.monitoring.result import NoiseResult
from counterspin.planning.plan_sections import PlanDocument, ReadingPlanDocument
from counterspin.results import ResultFile
from counterspin.studies.description import StudiedDocument, StudyDocument

#: What there is a schema of.
SchemaName = Literal["campaign", "plan", "study", "lab", "result", "noise"]

_DRAFT: Final = "https://json-schema.org/draft/2020-12/schema"

_LINK: Final = re.compile(r"\[([^\]]+)\]\([^)]*\)")
_NONE: Final = re.compile(r"`*\bNone\b`*")
#: The docstring of a table's class, such as ``[site]: gravity and latitude of the centrifuge.``
_OF_TABLE: Final = re.compile(r"(\[+.*?\]+|``\w+``)(?: of [^:]*)?: (.*)", re.DOTALL)

#: JSON Schema.
Json = dict[str, Any]

#: Kind of result that has a schema -> its class.
RESULTS: Final[Mapping[str, type[ResultFile]]] = {"result": Result, "noise": NoiseResult}

#: Section of ``campaign.toml`` -> the class of its table, or the first of each of its tables.
SECTIONS: Final[Mapping[str, type[BaseModel]]] = {
    key: table
    for key, written in nested_models(StudiedDocument).items()
    if (table := model_inside(written)) is not None
}


def schema_of(name: SchemaName) -> Json:
    """Return the JSON Schema (draft 2020-12) of a document or result."""
    title, make = _SCHEMAS[name]
    result = RESULTS.get(name)
    version = 1 if result is None else result.newest_schema()
    head = {"$schema": _DRAFT, "$id": f"urn:counterspin:schema:{name}:{version}"}
    made: Json = _plain(make(), nulls=result is not None)
    return head | {"title": title} | {key: v for key, v in made.items() if key != "title"}


def schema_text(name: SchemaName) -> str:
    """Return a schema as it is printed and published, in ASCII: JSON in UTF-8 on any console."""
    return json.dumps(schema_of(name), indent=1) + "\n"


def _document(model: type[BaseModel]) -> Json:
    return model.model_json_schema(ref_template="#/$defs/{model}")


def _plan() -> Json:
    """Return the schema of both kinds of plan: of records, and of readings."""
    records, readings = _document(PlanDocument), _document(ReadingPlanDocument)
    defined = records.pop("$defs") | readings.pop("$defs")
    return {
        "description": "Objective and limits of a plan.",
        "if": {"required": ["stations"]},
        "then": readings,
        "else": records,
        "$defs": defined,
    }


def _result(result: type[ResultFile]) -> Json:
    made = result.json_schema()
    for name, part in parts_of(result).items():
        properties = made["$defs"].get(name, made)["properties"]
        for key, words in comments_of(part).items():
            properties[name_of(part, key)]["description"] = words
    return made


def parts_of(part: type) -> dict[str, type]:
    """Return name -> class, of a part of a result and of what its fields are made of."""
    found, waiting = {part.__name__: part}, [part]
    while waiting:
        for hint in hints_of(waiting.pop()).values():
            new = {inner.__name__: inner for inner in parts_in(hint)}
            waiting += [inner for name, inner in new.items() if name not in found]
            found |= new
    return found


def name_of(part: type, field: str) -> str:
    """Return the name of a field in the file."""
    fields = part.model_fields if issubclass(part, BaseModel) else {}
    return fields[field].alias or field if field in fields else field


def hints_of(part: type[Any]) -> dict[str, Any]:
    """Return field -> its type."""
    if issubclass(part, BaseModel):
        return {key: field.annotation for key, field in part.model_fields.items()}
    hints = get_type_hints(part)
    return {field.name: hints[field.name] for field in dataclasses.fields(part)}


def parts_in(hint: Any) -> Iterator[type]:
    """Yield the classes with fields of their own that a type is made of."""
    if isinstance(hint, type) and (issubclass(hint, BaseModel) or dataclasses.is_dataclass(hint)):
        yield hint
    for inner in get_args(hint):
        yield from parts_in(inner)


def comments_of(part: type) -> dict[str, str]:
    """Return field -> what stands beside it in the source, behind it or above with ``#:``.

    What is None in Python is null in JSON.
    """
    found: dict[str, str] = {}
    for base in reversed(part.__mro__):
        if base.__module__.startswith("counterspin."):
            found |= _comments(inspect.getsource(base), set(base.__annotations__))
    return {key: words for key, words in found.items() if key in hints_of(part)}


def _comments(source: str, fields: set[str]) -> dict[str, str]:
    found: dict[str, str] = {}
    above: list[str] = []
    for line in source.splitlines():
        name, _, behind = line.strip().partition("#:")
        field = name.partition(":")[0]
        if name:
            words, above = behind or " ".join(above), []
            if field in fields and words:
                found[field] = _NONE.sub("null", unlinked(words))
        else:
            above = [*above, behind] if behind else []
    return found


_SCHEMAS: Final[Mapping[SchemaName, tuple[str, Callable[[], Json]]]] = {
    "campaign": ("campaign.toml: a campaign", partial(_document, StudiedDocument)),
    "plan": ("PLAN.toml: a plan", _plan),
    "study": ("A study of a campaign", partial(_document, StudyDocument)),
    "lab": ("LAB.toml: laboratory data for certificates", partial(_document, Lab)),
    "result": ("The result of a calibration", partial(_result, Result)),
    "noise": ("The noise of a record at rest", partial(_result, NoiseResult)),
}


def _plain(value: Any, *, nulls: bool) -> Any:
    """Return a schema in plain words: without Markdown's links, titles as people write them.

    nulls: Whether null may stand in the document; no TOML has it.
    """
    if isinstance(value, list):
        return [_plain(inner, nulls=nulls) for inner in value]
    if not isinstance(value, dict):
        return value
    made = {key: _plain(inner, nulls=nulls) for key, inner in value.items()}
    choices = [one for one in made.pop("anyOf", []) if nulls or one != {"type": "null"}]
    made |= choices[0] if len(choices) == 1 else {"anyOf": choices} if choices else {}
    if made.get("default", ...) is None:
        del made["default"]
    if "$ref" in made:
        made.pop("examples", None)  # those of its own keys say it
    said, title = made.get("description"), made.get("title")
    if isinstance(title, str):
        made["title"] = title[:1] + title[1:].lower()
    if isinstance(said, str):
        table = _OF_TABLE.fullmatch(said)
        if table is not None:
            made["title"], said = table[1], table[2][:1].upper() + table[2][1:]
        made["description"] = unlinked(said)
    made.pop("x-kind", None)
    made.pop("x-of", None)
    if (absent := made.pop("x-absent", None)) is not None and "description" in made:
        made["description"] += f" (default: {unlinked(absent)})"
    if "x-unit" in json.dumps([made.get("anyOf"), *made]):
        made.pop("default", None)  # which is in SI, not as it is written
    return made


def unlinked(markdown: str) -> str:
    """Return Markdown without its links, in one line."""
    return " ".join(_LINK.sub(r"\1", markdown).replace("``", "`").split())
