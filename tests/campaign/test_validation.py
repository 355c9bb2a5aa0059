"""Validation of a document: each error is reported once in the user's terms."""

import datetime
from typing import Annotated, Literal

import pytest
from pydantic import Field

from counterspin.campaign.field_types import SettingsSection, Text
from counterspin.campaign.runs import PerAccelerometer
from counterspin.campaign.validation import Problems, suggest_name


class Inner(SettingsSection):
    ratio: float = 1.0
    on: bool = True


class Section(SettingsSection):
    count: Annotated[int, Field(ge=2, le=9)] = 3
    day: datetime.date | None = None
    axis: Text | list[float] = "up"
    named: Text | list[Text] | dict[str, Text | list[Text]] = "x"
    kind: Literal["a", "b"] = "a"
    reading: PerAccelerometer | None = None
    inner: Inner | None = None


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        ({"count": 1}, "count: must be at least 2"),
        ({"count": 10}, "count: must be at most 9"),
        ({"count": "3"}, "count: must be a whole number"),
        ({"day": "Monday"}, "day: must be a date, such as 2026-03-02"),
        ({"axis": 3}, "axis: must be a string or a list"),
        ({"axis": ""}, "axis: must not be empty"),
        ({"axis": [1.0, "x"]}, "axis[1]: must be a number"),
        ({"named": True}, "named: must be a string, a list or a table"),
        ({"named": ["a", 1]}, "named[1]: must be a string"),
        ({"named": {"Qx": 1}}, "named.Qx: must be a string or a list"),
        ({"named": {"Qx": ["a", []]}}, "named.Qx[1]: must be a string"),
        ({"kind": "c"}, "kind: 'c' is not one of 'a' or 'b'"),
        ({"inner": {"on": 1}}, "inner.on: must be true or false"),
        ({"inner": {"ratoi": 1.0}}, 'inner.ratoi: unknown key; did you mean "ratio"?'),
        (
            {"reading": 1.5},
            'reading: has no unit; write the quantity as text, such as "1.5 g"',
        ),
        ({"reading": {"Qx": ["1 g", 2]}},
         'reading: has no unit; write the quantity as text, such as "2 g"'),
        ({"reading": []}, "reading: must have at least one entry"),
    ],
)  # fmt: skip
def test_error_is_reported_once_at_key(raw, message):
    problems = Problems(raw)
    assert problems.check(Section, raw, ()) is None
    assert problems.lines == [message]


def test_value_of_each_type_is_accepted():
    for raw in ({"axis": [0.0, 1.0]}, {"named": {"Qx": ["a"]}}, {"reading": {"Qx": "1 g"}}):
        assert Problems(raw).check(Section, raw, ()) is not None


def test_no_suggestion_without_similar_name():
    assert suggest_name("x", []) == ""
    assert suggest_name("alpah", ["alpha", "beta"]) == '; did you mean "alpha"?'
