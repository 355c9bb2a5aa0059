"""Types of the responses: responses match them, and the copy for the scripts is current."""

import typing
from types import UnionType
from typing import Any, Literal, NotRequired

import pytest

import answer_types
from counterspin.application.endpoints import ENDPOINTS


def matches_any(value, parts):
    return any(matches_type(value, part) for part in parts)


#: Origin of a generic type -> check of a value against its parts; others are lists.
CHECKS = {
    Literal: lambda value, parts: value in parts,
    typing.Union: matches_any,
    UnionType: matches_any,
    dict: lambda value, parts: all(matches_type(item, parts[1]) for item in value.values()),
    tuple: lambda value, parts: len(value) == len(parts) and all(map(matches_type, value, parts)),
}


def matches_type(value, hint):
    """Check a JSON value against a type."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any:
        return True
    if typing.is_typeddict(hint):
        hints = typing.get_type_hints(hint)
        extras = typing.get_type_hints(hint, include_extras=True)
        optional = {key for key, of in extras.items() if typing.get_origin(of) is NotRequired}
        is_complete = isinstance(value, dict) and set(hints) - optional <= set(value) <= set(hints)
        return is_complete and all(matches_type(item, hints[key]) for key, item in value.items())
    if origin in CHECKS:
        return CHECKS[origin](value, parts)
    if origin is not None:
        return isinstance(value, list) and all(matches_type(item, parts[0]) for item in value)
    return isinstance(value, (float, int) if hint is float else hint)


RESULT = "three/result.json"


@pytest.mark.parametrize(
    ("method", "name", "message"),
    [
        ("GET", "folder", {}),
        ("GET", "campaign", {"name": "three"}),
        ("GET", "description", {"name": "three"}),
        ("GET", "lab", {"file": "LAB.toml", "result": RESULT}),
        ("GET", "manual", {"name": "glossary"}),
        ("GET", "page", {"kind": "result", "names": RESULT}),
        ("GET", "ways", {"name": "three", "result": RESULT}),
        ("GET", "record-about", {"name": "three", "run": "slow"}),
        ("GET", "record", {"name": "three", "run": "slow", "low": 0, "high": 1}),
        ("GET", "check", {"name": "three", "run": "slow"}),
        ("POST", "draft", {"names": ["three/slow.csv"]}),
        ("POST", "copy", {"name": "three", "to": "four"}),
        ("POST", "put-away", {"name": "three"}),
    ],
)
def test_response_matches_type_of_endpoint(page, method, name, message):
    kind = "params" if method == "GET" else "json"
    answer = page.request(method, f"/api/{name}", **{kind: message})
    assert answer.status_code == 200
    assert matches_type(answer.json(), typing.get_type_hints(ENDPOINTS[method, name])["return"])


def test_generated_script_types_are_up_to_date():
    text = answer_types.SCRIPT_FILE.read_text(encoding="utf-8")
    assert text == answer_types.format_script(), "run `python docs/answer_types.py`"
    assert 'kind: "calibration" | "study"' in text
    assert "extent: ([number, number] | null)[]," in text
    assert "title?: string," in text
