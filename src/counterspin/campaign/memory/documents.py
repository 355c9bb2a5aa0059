"""Descriptions as mappings, with the keys of ``campaign.toml``."""

from __future__ import annotations

import datetime
from collections.abc import Iterator, Mapping
from pathlib import PurePath
from typing import Any

import numpy as np

from counterspin.campaign.checking import Path as KeyPath
from counterspin.campaign.checking import Problems
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.toml_file import key_path


def plain(value: Any, path: KeyPath, problems: Problems) -> Any:
    """Return a copy of what stands at a key as TOML would be read; what it cannot be is noted.

    value: Text, a number, a date, a `Quantity`, or a mapping or sequence of these. Keys whose value
        is None are left out.
    """
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str):
                problems.add(path, f"the key {key!r} must be text")
        return {
            key: plain(inner, (*path, key), problems)
            for key, inner in value.items()
            if isinstance(key, str) and inner is not None
        }
    if isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and value.ndim > 0):
        return [plain(inner, (*path, place), problems) for place, inner in enumerate(value)]
    if isinstance(value, Quantity):
        return f"{value.value!r} ± {value.u!r} {value.unit}".replace(" ± 0.0 ", " ")
    if isinstance(value, np.generic | np.ndarray):
        return plain(value.item(), path, problems)
    if isinstance(value, PurePath):
        return str(value)
    if not isinstance(value, str | bool | int | float | datetime.date | datetime.time):
        problems.add(path, f"a {type(value).__name__} cannot stand here; write text or a number")
    return value


def patched(document: Mapping[str, Any], patch: Mapping[str, Any]) -> dict[str, Any]:
    """Return a document with keys changed, as a JSON Merge Patch does it (RFC 7396).

    Tables are patched key by key, None takes a key away, all else is replaced.
    """
    whole = dict(document)
    for key, value in patch.items():
        inside = whole.get(key)
        if value is None:
            whole.pop(key, None)
        elif isinstance(value, Mapping):
            whole[key] = patched(inside if isinstance(inside, Mapping) else {}, value)
        else:
            whole[key] = value
    return whole


def differences(before: Any, after: Any, path: KeyPath = ()) -> Iterator[str]:
    """Yield the keys in which documents differ; those of a list whose length differs as one."""
    if isinstance(before, Mapping) and isinstance(after, Mapping):
        for key in dict.fromkeys([*before, *after]):
            yield from differences(before.get(key), after.get(key), (*path, key))
    elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        for place, (one, other) in enumerate(zip(before, after, strict=True)):
            yield from differences(one, other, (*path, place))
    elif type(before) is not type(after) or before != after:
        yield key_path(path)
