"""A form's sections and fields, made of the models that check the file: no second list of keys."""

from __future__ import annotations

import datetime
import types
import typing
from collections.abc import Mapping, Sequence
from functools import cache, partial
from typing import Annotated, Any, Final, Literal

from pydantic import BaseModel, PlainValidator
from pydantic.fields import FieldInfo

from counterspin.campaign.columns import RecordsSettings
from counterspin.campaign.machine import FixtureSettings
from counterspin.campaign.readings import ReadingRunSettings, is_reading
from counterspin.campaign.readings_table import ReadingsSettings
from counterspin.campaign.settings import (
    AccelerometerSettings,
    CampaignSettings,
    CentrifugeSettings,
    ModelSettings,
    RunSettings,
    SimulationSettings,
    SiteSettings,
    StatedNoise,
)
from counterspin.campaign.specification import SpecificationSettings
from counterspin.campaign.truth import (
    AccelerometerTruthSettings,
    CentrifugeTruthSettings,
    EncoderTruthSettings,
    PlatformTruthSettings,
    SpindleTruthSettings,
)
from counterspin.certificates.lab import Lab
from counterspin.physics.terms import TERMS
from counterspin.studies.description import StudySettings

#: Section of ``campaign.toml`` -> its model.
SECTIONS: Final[Mapping[str, type[BaseModel]]] = {
    "campaign": CampaignSettings,
    "site": SiteSettings,
    "centrifuge": CentrifugeSettings,
    "fixture": FixtureSettings,
    "records": RecordsSettings,
    "accelerometers": AccelerometerSettings,
    "noise": StatedNoise,
    "model": ModelSettings,
    "readings": ReadingsSettings,
    "runs": RunSettings,
    "specification": SpecificationSettings,
    "simulation": SimulationSettings,
    "truth": AccelerometerTruthSettings,
    "study": StudySettings,
}

#: Tables of [truth] that are no accelerometer's -> their models.
_TRUTH: Final[Mapping[str, type[BaseModel]]] = {
    "spindle": SpindleTruthSettings,
    "platform": PlatformTruthSettings,
    "centrifuge": CentrifugeTruthSettings,
    "encoder": EncoderTruthSettings,
    "noise": StatedNoise,
}

#: Sections that hold a table for each name, and those that are a list of tables.
_REPEATED: Final = {
    "accelerometers": "names",
    "runs": "list",
    "persons": "list",
    "truth": "names",
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

Field = dict[str, Any]


@cache
def campaign_form() -> tuple[Field, ...]:
    """Return the sections of ``campaign.toml``, each with its fields."""
    sections = []
    for key, model in SECTIONS.items():
        section = _section(key, model)
        if key == "runs":
            section["of_readings"] = _fields(ReadingRunSettings)
        if key == "specification":
            section["of_names"] = _limits()
            section["fields"] = section["of_names"] + section["fields"]
        if key == "truth":
            section["of_tables"] = {name: _fields(model) for name, model in _TRUTH.items()}
        sections.append(section)
    return tuple(sections)


@cache
def lab_form() -> tuple[Field, ...]:
    """Return the sections of ``LAB.toml``, each with its fields."""
    sections = []
    for name, field in Lab.model_fields.items():
        model = _model_inside(field.annotation)
        if model is not None:
            sections.append(_section(field.alias or name, model))
    return tuple(sections)


def run_kinds(document: Mapping[str, Any]) -> list[str]:
    """Return of each run of a document whether it is a ``record`` or a ``reading``."""
    runs = document.get("runs")
    some = runs if isinstance(runs, list) else []
    return ["reading" if is_reading(run) else "record" for run in some]


def _limits() -> list[Field]:
    """Return the fields of tolerance limits, one for each term of an accelerometer."""
    return [
        {"key": symbol, "required": False, "kind": "text", "example": f"abs <= … {row.unit}"}
        for symbol, row in TERMS.items()
    ]


def _section(key: str, model: type[BaseModel]) -> Field:
    words = (model.__doc__ or "").partition("\n")[0]
    # "[site]: where the centrifuge stands."
    said = words.partition("]: ")[2]
    return {
        "key": key,
        "words": said[:1].upper() + said[1:],
        "repeat": _REPEATED.get(key),
        "fields": _fields(model),
    }


def _fields(model: type[BaseModel]) -> list[Field]:
    return [_field(field.alias or name, field) for name, field in model.model_fields.items()]


def _field(key: str, field: FieldInfo) -> Field:
    base, metadata = _unwrapped(field.annotation, field.metadata)
    return {"key": key, "required": field.is_required(), **_kind(base, metadata)}


def _unwrapped(annotation: Any, metadata: Sequence[Any]) -> tuple[Any, list[Any]]:
    """Return what is annotated, without "or none", and all that is said beside it."""
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


def _kind(base: Any, metadata: Sequence[Any]) -> Field:
    """Return how a value is asked for."""
    if typing.get_origin(base) is Literal:
        return {"kind": "choice", "choices": list(typing.get_args(base))}
    readers = [said.func for said in metadata if isinstance(said, PlainValidator)]
    if readers:
        of_unit = next((reader for reader in readers if isinstance(reader, partial)), None)
        if of_unit is not None:
            return {"kind": "text", "unit": of_unit.args[0]}
        return {"kind": "number" if base in (float, int) else "text"}
    if isinstance(base, type) and issubclass(base, BaseModel):
        return {"kind": "group", "fields": _fields(base)}
    origin = typing.get_origin(base)
    return {"kind": _KINDS.get(origin or base, "text")}


def _model_inside(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next(filter(None, map(_model_inside, typing.get_args(annotation))), None)
