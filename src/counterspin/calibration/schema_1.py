"""Results of schema 1, in which what was not stated was no part of u, as those of schema 2.

Such a result took as perfect what its model left out; so it says that it assumed it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any, Final

_LINE: Final = re.compile(r"(?P<name>.+) \((?P<kind>prior|considered|input|encoder)\)")

#: What was considered, inputs among it, was not adjusted by the data.
_KINDS: Final = {"prior": "stated", "considered": "held", "input": "held", "encoder": "noise"}


def upgraded(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return the document of a result of schema 1 as one of schema 2, with what it assumed.

    document: As it was read; what is not as schema 1 has it is left for the checks to find.
    """
    new = _of_coefficients(dict(document))
    assumed: dict[str, None] = {}
    accelerometers = new.get("accelerometers")
    for own in accelerometers.values() if isinstance(accelerometers, dict) else ():
        if isinstance(own, dict):
            left_out = own.pop("left_out", None)
            assumed |= dict.fromkeys(left_out if isinstance(left_out, dict) else ())
            if isinstance(own.get("budget"), dict):
                own["budget"] = {s: _lines(lines) for s, lines in own["budget"].items()}
    return {**new, "schema": 2, "assumed": list(assumed)}


def _of_coefficients(value: Any) -> Any:
    """Return a document with the parts of every coefficient's u under their new names."""
    if isinstance(value, list):
        return [_of_coefficients(item) for item in value] if _nested(value) else value
    if not isinstance(value, dict):
        return value
    own = {key: _of_coefficients(item) for key, item in value.items()}
    if "u_prior" in own or "u_considered" in own or "u_typical" in own:
        own.pop("u_typical", None)
        parts = [own.pop("u_prior", None), own.pop("u_considered", None)]
        sizes = [part for part in parts if isinstance(part, int | float)]
        own["u_stated"] = math.hypot(*sizes) if sizes else None
        own["u_unstated"] = 0.0 if sizes else None
    return own


def _nested(values: list[Any]) -> bool:
    # Rows of numbers, which are most of a document, have nothing to rename.
    return bool(values) and isinstance(values[0], dict)


def _lines(lines: Any) -> Any:
    if not isinstance(lines, list):
        return lines
    return [_line(line) if isinstance(line, dict) else line for line in lines]


def _line(line: dict[str, Any]) -> dict[str, Any]:
    source = line.get("source")
    match = _LINE.fullmatch(source) if isinstance(source, str) else None
    if match is None:
        return {**line, "kind": "noise"}
    return {**line, "source": match["name"], "kind": _KINDS[match["kind"]]}
