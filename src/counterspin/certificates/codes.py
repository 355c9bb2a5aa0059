"""Codes of countries (ISO 3166-1 alpha-2) and languages (ISO 639-1) in force.

The lists in ``assets`` are facts of the standards; withdrawn and reserved codes are not in them.
"""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches
from functools import cache
from importlib import resources
from typing import Final, Literal

from counterspin.errors import InputError

CodeList = Literal["country", "language"]

_ASSETS: Final[Mapping[CodeList, str]] = {"country": "countries.txt", "language": "languages.txt"}

_STANDARDS: Final[Mapping[CodeList, str]] = {"country": "ISO 3166-1", "language": "ISO 639-1"}

#: Withdrawn or merely reserved code -> code in force.
_SUCCESSORS: Final[Mapping[str, str]] = {
    **{"BU": "MM", "DD": "DE", "EL": "GR", "FX": "FR", "SU": "RU", "TP": "TL"},
    **{"UK": "GB", "VD": "VN", "YD": "YE", "YU": "RS", "ZR": "CD"},
    **{"in": "id", "iw": "he", "ji": "yi", "jw": "jv", "mo": "ro", "sh": "sr"},
}


@cache
def codes_in_force(kind: CodeList) -> Mapping[str, str]:
    """Return the codes in force, each with its English name."""
    path = resources.files("counterspin.certificates") / "assets" / _ASSETS[kind]
    return dict(line.split(" ", 1) for line in path.read_text("utf-8").splitlines())


def check_code(value: str, kind: CodeList) -> str:
    """Return a code; ValueError with close matches if the standard does not have it."""
    codes = codes_in_force(kind)
    if value in codes:
        return value
    near = [f'"{code}" ({codes[code]})' for code in _close_codes(value, codes)]
    hint = f"; did you mean {' or '.join(near)}?" if near else ""
    raise InputError(
        f'"{value}" is not a current {kind} code of {_STANDARDS[kind]}{hint}', "unknown-choice"
    )


def _close_codes(value: str, codes: Mapping[str, str]) -> list[str]:
    """Return the successor of a code, the code of a name, or similar codes."""
    folded = {code.lower(): code for code in codes}
    successor = _SUCCESSORS.get(value) or folded.get(value.lower())
    if successor is not None:
        return [successor]
    by_name = {name.lower(): code for code, name in codes.items()}
    if len(value) > 2 and (names := get_close_matches(value.lower(), by_name, n=2)):
        return [by_name[name] for name in names]
    return [folded[code] for code in get_close_matches(value.lower(), folded, n=3, cutoff=0.5)]
