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
from counterspin.campaign.accelerometers import AccelerometerKeys
from counterspin.campaign.columns import RecordsSettings
from counterspin.campaign.readings import ReadingRunSettings
from counterspin.campaign.readings_table import ReadingsSettings
from counterspin.campaign.resolved import Simulation
from counterspin.campaign.runs import Run
from counterspin.campaign.settings import (
    CampaignSettings,
    CentrifugeSettings,
    DocumentSettings,
    FixtureSettings,
    ModelSettings,
    NoiseSettings,
    SiteSettings,
)
from counterspin.campaign.specification import SpecificationSettings
from counterspin.campaign.triads.declared import TriadSettings
from counterspin.campaign.truth import (
    TRUE_TABLES,
    AccelerometerTruthSettings,
    RunTruthSettings,
)
from counterspin.certificates.lab import Lab
from counterspin.monitoring.result_noise import NoiseResult
from counterspin.planning.plan_sections import (
    GoalSettings,
    LimitsSettings,
    PlanDocument,
    ReadingLimitsSettings,
    ReadingPlanDocument,
    StationsSettings,
)
from counterspin.results import ResultFile
from counterspin.studies.description import (
    AnalysisSettings,
    DistributionSettings,
    StudySettings,
)

#: What there is a schema of.
SchemaName = Literal["campaign", "plan", "study", "lab", "result", "noise"]

_DRAFT: Final = "https://json-schema.org/draft/2020-12/schema"

_LINK: Final = re.compile(r"\[([^\]]+)\]\([^)]*\)")
_NONE: Final = re.compile(r"`*\bNone\b`*")
#: The docstring of a table's class, such as ``[site]: where the centrifuge stands.``
_OF_TABLE: Final = re.compile(r"(\[+.*?\]+|``\w+``)(?: of [^:]*)?: (.*)", re.DOTALL)

#: JSON Schema.
Json = dict[str, Any]

_TEXT: Final[Json] = {"type": "string"}

#: Kind of result that has a schema -> its class.
RESULTS: Final[Mapping[str, type[ResultFile]]] = {"result": Result, "noise": NoiseResult}

#: Section of ``campaign.toml`` -> the class of its table, or of each of its tables.
SECTIONS: Final[Mapping[str, type[BaseModel]]] = {
    "campaign": CampaignSettings,
    "site": SiteSettings,
    "centrifuge": CentrifugeSettings,
    "fixture": FixtureSettings,
    "triad": TriadSettings,
    "records": RecordsSettings,
    "accelerometers": AccelerometerKeys,
    "noise": NoiseSettings,
    "model": ModelSettings,
    "readings": ReadingsSettings,
    "runs": Run,
    "specification": SpecificationSettings,
    "simulation": Simulation,
    "truth": AccelerometerTruthSettings,
    "study": StudySettings,
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
    """Return a schema as it is printed and published."""
    return json.dumps(schema_of(name), indent=1, ensure_ascii=False) + "\n"


class _Definitions:
    """Collects the schemas of tables; a call returns the reference to one."""

    def __init__(self) -> None:
        self.found: Json = {}

    def __call__(self, model: type[BaseModel]) -> Json:
        if model.__name__ not in self.found:
            made = model.model_json_schema(ref_template="#/$defs/{model}")
            self.found |= made.pop("$defs", {})
            self.found[model.__name__] = made
        return {"$ref": f"#/$defs/{model.__name__}"}

    def open(self, model: type[BaseModel], **more: Any) -> Json:
        """Return the reference to a table that may have more keys than its class."""
        reference = self(model)
        self.found[model.__name__] |= more
        return reference

    def named(self, model: type[BaseModel]) -> Json:
        """Return what is a table of tables by name."""
        return {"type": "object", "additionalProperties": self(model)}


def _document(
    model: type[BaseModel], sections: Mapping[str, Json], definitions: _Definitions
) -> Json:
    """Return the schema of a document whose sections are checked by classes of their own."""
    whole = model.model_json_schema(ref_template="#/$defs/{model}")
    for key, section in sections.items():
        if key in whole["properties"]:
            said = whole["properties"][key]
            kept = {word: said[word] for word in ("title", "description") if word in said}
            whole["properties"][key] = kept | section
    whole["description"] = "All tables; a key that is not here is a mistake."
    return whole | {"$defs": whole.pop("$defs", {}) | definitions.found}


def _sections(to: _Definitions) -> dict[str, Json]:
    """Return section of a campaign -> what may stand in it."""
    limits = {"anyOf": [_TEXT, {"type": "object", "additionalProperties": _TEXT}]}
    runs = {"type": "array", "items": {"anyOf": [_run(to), to(ReadingRunSettings)]}}
    of_own_kind = {
        "accelerometers": to.named(AccelerometerKeys) | {"minProperties": 1},
        "specification": to.open(SpecificationSettings, additionalProperties=limits),
        "runs": runs,
        "truth": _truth(to),
        "study": _study_section(to),
    }
    return {key: of_own_kind.get(key) or to(model) for key, model in SECTIONS.items()}


def _run(to: _Definitions) -> Json:
    reference = to(Run)
    properties = to.found["Run"]["properties"]
    properties["truth"] |= to(RunTruthSettings)
    return reference


def _truth(to: _Definitions) -> Json:
    """Return what [truth] may have: tables of its own, and one for each accelerometer."""
    own = {
        name: to(model) | {"description": model.__doc__} for name, model in TRUE_TABLES.items()
    } | {
        "noise": {
            "type": "object",
            "description": "of records, with the keys of [noise]; `reading` is that of readings",
            "examples": [{"displacement": "0.01 m"}],
        },
        "machine": {
            "type": "object",
            "description": "terms of the machine that readings show",
            "examples": [{"centrifuge.radius.in": "1.00001 m"}],
        },
    }
    each = to(AccelerometerTruthSettings)
    return {"type": "object", "properties": own, "additionalProperties": each}


def _study_section(to: _Definitions) -> Json:
    reference = to(StudySettings)
    properties = to.found["StudySettings"]["properties"]
    properties["vary"] |= to.named(DistributionSettings)
    properties["analyses"] |= to.named(AnalysisSettings)
    return reference


def _campaign() -> Json:
    to = _Definitions()
    return _document(DocumentSettings, _sections(to), to)


def _plan() -> Json:
    """Return the schema of both kinds of plan: of records, and of readings."""
    to = _Definitions()
    shared = _sections(to) | {"goal": to(GoalSettings)}
    records = _document(PlanDocument, shared | {"limits": to(LimitsSettings)}, to)
    of_readings = {
        "limits": to(ReadingLimitsSettings),
        "stations": {"type": "array", "minItems": 1, "items": to(StationsSettings)},
    }
    readings = _document(ReadingPlanDocument, shared | of_readings, to)
    defined = records.pop("$defs") | readings.pop("$defs")
    return {
        "description": "What a plan is for, and what the machine allows.",
        "if": {"required": ["stations"]},
        "then": readings,
        "else": records,
        "$defs": defined,
    }


def _study() -> Json:
    to = _Definitions()
    return {
        "description": "A study in a file of its own, beside the campaign that it names.",
        "type": "object",
        "properties": {
            "schema": {"const": 1, "description": "version of this format", "examples": [1]},
            "campaign": _TEXT
            | {"description": "folder or description of the campaign", "examples": ["campaign"]},
            "study": _study_section(to) | {"description": StudySettings.__doc__},
        },
        "required": ["schema", "campaign", "study"],
        "additionalProperties": False,
        "$defs": to.found,
    }


def _lab() -> Json:
    to = _Definitions()
    whole = Lab.model_json_schema(ref_template="#/$defs/{model}")
    whole["properties"]["specification"] |= _sections(to)["specification"]
    whole["$defs"]["SpecificationSettings"] = to.found["SpecificationSettings"]
    return whole


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
    """Return what a field is called in the file."""
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
    "campaign": ("campaign.toml: a campaign", _campaign),
    "plan": ("PLAN.toml: a plan", _plan),
    "study": ("A study of a campaign", _study),
    "lab": ("LAB.toml: a laboratory's data for certificates", _lab),
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
    if (absent := made.pop("x-absent", None)) is not None and "description" in made:
        made["description"] += f" (if left out: {unlinked(absent)})"
    if "x-unit" in json.dumps([made.get("anyOf"), *made]):
        made.pop("default", None)  # which is in SI, not as it is written
    return made


def unlinked(markdown: str) -> str:
    """Return Markdown without its links, in one line."""
    return " ".join(_LINK.sub(r"\1", markdown).replace("``", "`").split())
