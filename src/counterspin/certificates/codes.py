"""Codes of countries (ISO 3166-1 alpha-2) and languages (ISO 639-1) in force.

The lists in ``assets`` do not contain withdrawn and reserved codes.
"""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches
from functools import cache
from importlib import resources
from typing import Final, Literal

from counterspin.errors import InputError

CodeList = Literal["country", "language"]

_CODE_FILES: Final[Mapping[CodeList, str]] = {
    "country": "countries.txt",
    "language": "languages.txt",
}

_STANDARD_NAMES: Final[Mapping[CodeList, str]] = {"country": "ISO 3166-1", "language": "ISO 639-1"}

#: Withdrawn or reserved code -> code in force.
_REPLACEMENT_CODES: Final[Mapping[str, str]] = {
    **{"BU": "MM", "DD": "DE", "EL": "GR", "FX": "FR", "SU": "RU", "TP": "TL"},
    **{"UK": "GB", "VD": "VN", "YD": "YE", "YU": "RS", "ZR": "CD"},
    **{"in": "id", "iw": "he", "ji": "yi", "jw": "jv", "mo": "ro", "sh": "sr"},
}


@cache
def codes_in_force(code_list: CodeList) -> Mapping[str, str]:
    """Return code in force -> English name."""
    path = resources.files("counterspin.certificates") / "assets" / _CODE_FILES[code_list]
    return dict(line.split(" ", 1) for line in path.read_text("utf-8").splitlines())


def check_code(value: str, code_list: CodeList) -> str:
    """Return a valid code; ValueError with close matches for an invalid code."""
    codes = codes_in_force(code_list)
    if value in codes:
        return value
    suggestions = [f'"{code}" ({codes[code]})' for code in _close_codes(value, codes)]
    hint = f"; did you mean {' or '.join(suggestions)}?" if suggestions else ""
    raise InputError(
        f'"{value}" is not a current {code_list} code of {_STANDARD_NAMES[code_list]}{hint}',
        "unknown-choice",
    )


def _close_codes(value: str, codes: Mapping[str, str]) -> list[str]:
    """Return the successor of a code, the code of a name, or similar codes."""
    code_by_lowercase = {code.lower(): code for code in codes}
    replacement_code = _REPLACEMENT_CODES.get(value) or code_by_lowercase.get(value.lower())
    if replacement_code is not None:
        return [replacement_code]
    code_by_name = {name.lower(): code for code, name in codes.items()}
    if len(value) > 2 and (names := get_close_matches(value.lower(), code_by_name, n=2)):
        return [code_by_name[name] for name in names]
    return [
        code_by_lowercase[code]
        for code in get_close_matches(value.lower(), code_by_lowercase, n=3, cutoff=0.5)
    ]
