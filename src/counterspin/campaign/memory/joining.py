"""Campaigns of the same instruments joined into one fit."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from counterspin.campaign.memory.documents import differences
from counterspin.campaign.memory.records import record_name
from counterspin.campaign.memory.source import Documented, source_of
from counterspin.errors import CampaignError
from counterspin.records.memory import MemoryTable

#: What all must have in common -> its key in the description.
_COMMON: Final = {
    "gravity": "site.gravity",
    "latitude": "site.latitude",
    "radius": "centrifuge.radius",
    "reference_temperature": "centrifuge.reference_temperature",
    "time": "records.time",
    "angle": "records.angle",
    "dialect": "records",
    "timing_offset": "records.timing_offset",
    "clock": "records.clock",
    "own_velocity": "records.reference",
    "noise": "noise",
    "rest": "noise.from",
    "specifications": "specification",
}

#: What each accelerometer must have in common with its namesakes.
_OF_EACH: Final = (
    "mounting",
    "observable",
    "channel",
    "priors",
    "serial_number",
    "output",
    "force",
    "grade",
)


def join_campaigns(
    campaigns: Sequence[Documented],
) -> tuple[dict[str, Any], dict[Path, MemoryTable]]:
    """Return one document with the runs of several campaigns, and the records in memory by file.

    It is for the folder of the first.
    """
    first = campaigns[0]
    problems = [
        p for place, other in enumerate(campaigns[1:], 2) for p in _apart(first, other, place)
    ]
    if problems:
        raise CampaignError("join", problems)
    document = copy.deepcopy(dict(source_of(first).document))
    if not all(_same_simulation(first, other) for other in campaigns[1:]):
        for key in ("truth", "simulation"):
            document.pop(key, None)
    runs: list[dict[str, Any]] = []
    tables: dict[Path, MemoryTable] = {}
    for place, campaign in enumerate(campaigns, 1):
        for run in copy.deepcopy(source_of(campaign).document.get("runs", [])):
            if "truth" not in document:
                run.pop("truth", None)
            run["name"] = _distinct(run["name"], place, [other["name"] for other in runs])
            for key in ("continued_in", "pulses"):
                if key in run and campaign.folder != first.folder:
                    names = run[key]
                    run[key] = (
                        str(campaign.folder / names)
                        if isinstance(names, str)
                        else [str(campaign.folder / name) for name in names]
                    )
            if "record" in run:
                _place_record(run, campaign, first.folder, runs, tables)
            runs.append(run)
    document["runs"] = runs
    titles = dict.fromkeys(campaign.title for campaign in campaigns if campaign.title)
    if titles:
        document["campaign"] = {**document.get("campaign", {}), "title": " + ".join(titles)}
    if first.rest is not None and isinstance(rest := first.record_at(first.rest), MemoryTable):
        tables[first.rest] = rest
    return document, tables


def _apart(first: Documented, other: Documented, place: int) -> Iterator[str]:
    """Yield what two campaigns would have to have in common, and have not."""
    words = f"is not the same in campaign {place}"
    for attribute, key in _COMMON.items():
        if getattr(first, attribute) != getattr(other, attribute):
            yield f"{key}: {words} ({_said(first, key)}, {_said(other, key)})"
    rest = [c.rest and c.record_at(c.rest) for c in (first, other)]
    in_memory = [one.checksum if isinstance(one, MemoryTable) else "" for one in rest]
    if first.rest == other.rest and in_memory[0] != in_memory[1]:
        yield f"noise.from: {words}"
    for name in dict.fromkeys([*first.accelerometers, *other.accelerometers]):
        one, two = first.accelerometers.get(name), other.accelerometers.get(name)
        if one is None or two is None:
            yield f"accelerometers.{name}: is not in campaign {1 if one is None else place}"
            continue
        unequal = [key for key in _OF_EACH if getattr(one, key) != getattr(two, key)]
        if unequal:
            yield f"accelerometers.{name}: {words} ({', '.join(unequal)})"
    for section in ("model", "centrifuge"):
        one, two = (source_of(c).document.get(section, {}) for c in (first, other))
        for key in differences(one, two, (section,)):
            if key != "centrifuge.radius":
                yield f"{key}: {words}"
    for number, campaign in ((1, first), (place, other)):
        if "readings" in source_of(campaign).document:
            yield f"readings: campaign {number} has a table of readings; write them as [[runs]]"


def _said(campaign: Documented, key: str) -> str:
    """Return what a description says at a key."""
    value: Any = source_of(campaign).document
    for part in key.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    return "nothing" if value is None else str(value)


def _same_simulation(first: Documented, other: Documented) -> bool:
    one, two = (source_of(c).document for c in (first, other))
    return all(one.get(key) == two.get(key) for key in ("truth", "simulation"))


def _distinct(name: str, place: int, taken: Sequence[str]) -> str:
    """Return a run's name that no other has: with the number of its campaign where it must be."""
    new, number = name, place
    while new in taken:
        new, number = f"{name} ({number})", number + 1
    return new


def _place_record(
    run: dict[str, Any],
    campaign: Documented,
    folder: Path,
    runs: Sequence[Mapping[str, Any]],
    tables: dict[Path, MemoryTable],
) -> None:
    """Name a run's record as the joined campaign finds it, and take along what is in memory."""
    record = campaign.record_at(campaign.folder / run["record"])
    if isinstance(record, Path):
        inside = campaign.folder == folder
        run["record"] = run["record"] if inside else str(record)
        return
    taken = [other.get("record") for other in runs]
    ending = Path(run["record"]).suffix
    if str(run["record"]).lower() in {str(name).lower() for name in taken}:
        run["record"] = record_name(run["name"], ending, taken)
    tables[folder / run["record"]] = MemoryTable(
        f"{run['name']} in memory", record.columns, record.others
    )
