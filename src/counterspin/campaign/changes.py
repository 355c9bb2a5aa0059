"""A campaign with named changes."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from counterspin.campaign.checking import Problems, did_you_mean
from counterspin.campaign.description import Campaign
from counterspin.campaign.documents import KeyPath, flat_keys, patched, plain, source_of
from counterspin.campaign.memory import give_records
from counterspin.campaign.resolution import CampaignDocument
from counterspin.campaign.settings import OBSERVABLES
from counterspin.errors import CampaignError
from counterspin.physics.terms import COMMON_NAMES, TERMS
from counterspin.records.memory import MemoryTable

#: Short names of keys that are changed often.
SHORT: Final[Mapping[str, KeyPath]] = {
    "title": ("campaign", "title"),
    "gravity": ("site", "gravity"),
    "latitude": ("site", "latitude"),
    "radius": ("centrifuge", "radius"),
    "terms": ("model", "terms"),
    "assume": ("model", "assume"),
    "hold": ("model", "hold"),
    "considered": ("model", "considered"),
    "priors": ("model", "priors"),
    "seed": ("simulation", "seed"),
    "sampling_rate": ("simulation", "sampling_rate"),
}

#: Sections of the file that are changed by their own names; [records] is by keys with dots.
_SECTIONS: Final = tuple(
    field.alias or name
    for name, field in CampaignDocument.model_fields.items()
    if name not in ("schema_version", "accelerometers", "runs", "records")
)

#: Keys of an accelerometer that are priors of a term -> the term.
_PRIOR_KEYS: Final = (
    COMMON_NAMES | {"sensitivity_prior": "K_I"} | {symbol: symbol for symbol in TERMS}
)


def change_campaign(
    campaign: Campaign, changes: Mapping[str, Any]
) -> tuple[dict[str, Any], dict[Path, MemoryTable]]:
    """Return a campaign's document with named changes, and the records among them by file."""
    source = source_of(campaign)
    document = copy.deepcopy(dict(source.document))
    label = source.label if source.file is None else f"{source.file}, changed in memory"
    problems = Problems(document)
    records: Mapping[str, Any] = {}
    for name, value in changes.items():
        if name == "records":
            records = _of_mapping(value, ("records",), problems)
        elif name in ("accelerometers", "runs"):
            _select(document, name, value, problems)
        elif (path := _path(name, problems)) is not None:
            _set(document, path, value, problems)
    tables = give_records(document, records, campaign.folder, problems)
    if problems.lines:
        raise CampaignError(label, problems.lines)
    return document, tables


def _path(name: str, problems: Problems) -> KeyPath | None:
    """Return the key that a name means."""
    path = SHORT.get(name) or tuple(name.split("."))
    if path[0] in (*_SECTIONS, "accelerometers", "records"):
        return path
    known = (*SHORT, "accelerometers", "runs", "records", *_SECTIONS)
    problems.add((name,), "cannot be changed" + did_you_mean(name, known))
    return None


def _of_mapping(value: Any, path: KeyPath, problems: Problems) -> Mapping[str, Any]:
    if isinstance(value, Mapping):
        return value
    problems.add(path, "must be a mapping from runs' names to records")
    return {}


def _set(document: dict[str, Any], path: KeyPath, value: Any, problems: Problems) -> None:
    """Patch a document at a key."""
    if path == ("model", "priors") and isinstance(value, Mapping):
        value = flat_keys(value)
        _forget_priors(document, value)
    patch: Any = None if value is None else _patch(value, path, problems)
    for part in reversed(path):
        patch = {part: patch}
    merged = patched(document, patch)
    document.clear()
    document.update(merged)


def _patch(value: Any, path: KeyPath, problems: Problems) -> Any:
    """Return a value as TOML would be read; None stays in tables, where it removes keys."""
    if not isinstance(value, Mapping):
        return plain(value, path, problems.add)
    return {
        key: None if inner is None else _patch(inner, (*path, key), problems)
        for key, inner in value.items()
    }


def _forget_priors(document: dict[str, Any], priors: Mapping[str, Any]) -> None:
    """Remove the priors of terms that the accelerometers' own tables state."""
    tables = {}
    for name, table in document["accelerometers"].items():
        own = {key.removeprefix(f"{name}.") for key in priors}
        tables[name] = {key: v for key, v in table.items() if _PRIOR_KEYS.get(key) not in own}
    document["accelerometers"] = tables
    if "priors" in document.get("model", {}):
        # One way of writing keys with dots, so that each is replaced by the same.
        document["model"] = {
            **document["model"],
            "priors": flat_keys(document["model"]["priors"]),
        }


# Some of the accelerometers and of the runs


def _select(document: dict[str, Any], key: str, value: Any, problems: Problems) -> None:
    """Keep the accelerometers or runs that are named, or change them by name."""
    names = _names(document, key)
    if isinstance(value, Mapping):
        _change_by_name(document, key, value, problems)
        return
    asked = [value] if isinstance(value, str) else value
    if not isinstance(asked, Sequence) or isinstance(asked, str | bytes):
        problems.add((key,), "must be a list of names, or a mapping from names to changes")
        return
    if key == "runs" and asked and all(isinstance(run, Mapping) for run in asked):
        document["runs"] = plain(list(asked), ("runs",), problems.add)
        return
    unknown = [name for name in asked if name not in names]
    for name in unknown:
        _note_unknown(key, name, names, problems)
    if unknown:
        return
    if key == "runs":
        by_name = {run.get("name"): run for run in document["runs"]}
        document["runs"] = [by_name[name] for name in dict.fromkeys(asked)]
    else:
        _keep_accelerometers(document, list(dict.fromkeys(asked)))


def _names(document: Mapping[str, Any], key: str) -> list[str]:
    if key == "accelerometers":
        return list(document["accelerometers"])
    # A run that is left out is not checked, and may have no name.
    return [run.get("name") for run in document.get("runs", ())]


def _note_unknown(key: str, name: Any, known: Iterable[str], problems: Problems) -> None:
    problems.add((key,), f'there is no "{name}"' + did_you_mean(str(name), known))


def _change_by_name(
    document: dict[str, Any], key: str, changes: Mapping[str, Any], problems: Problems
) -> None:
    if key == "accelerometers":
        _set(document, (key,), changes, problems)
        return
    names = _names(document, key)
    runs = list(document.get("runs", ()))
    for name, change in changes.items():
        if name not in names:
            _note_unknown(key, name, names, problems)
        elif change is None:
            runs = [run for run in runs if run.get("name") != name]
        else:
            place = next(i for i, run in enumerate(runs) if run.get("name") == name)
            runs[place] = patched(runs[place], _patch(change, (key, place), problems))
    document["runs"] = runs


def _keep_accelerometers(document: dict[str, Any], names: Sequence[str]) -> None:
    """Remove the other accelerometers from every section that names them."""
    tables = document["accelerometers"]
    others = [name for name in tables if name not in names]
    document["accelerometers"] = {name: tables[name] for name in names}
    recorded = {key for table in document["accelerometers"].values() for key in table}
    lost = {key for name in others for key in tables[name] if key in OBSERVABLES} - recorded
    if "noise" in document:
        document["noise"] = {k: v for k, v in document["noise"].items() if k not in lost}
    for section in ("truth", "specification"):
        if section in document:
            document[section] = {k: v for k, v in document[section].items() if k not in others}
    if not document.get("specification", True):
        del document["specification"]  # which must name a term
    model = document.get("model", {})
    for key in {"priors", "limits", "typical"} & set(model):
        sizes = flat_keys(model[key])
        model[key] = {k: v for k, v in sizes.items() if k.partition(".")[0] not in others}
    if "runs" in document:
        document["runs"] = [_of_these(run, others) for run in document["runs"]]
    if "readings" in document:
        columns = document["readings"].get("columns", {})
        kept = {key: _without(value, others) for key, value in columns.items()}
        document["readings"] = {**document["readings"], "columns": kept}


def _of_these(run: Mapping[str, Any], others: Sequence[str]) -> dict[str, Any]:
    return {**run, "reading": _without(run["reading"], others)} if "reading" in run else dict(run)


def _without(value: Any, others: Sequence[str]) -> Any:
    if not isinstance(value, Mapping):
        return value
    return {name: inner for name, inner in value.items() if name not in others}
