import datetime
from pathlib import PurePosixPath

import numpy as np

from counterspin.campaign.checking import Problems
from counterspin.campaign.memory.documents import differences, patched, plain
from counterspin.campaign.quantity import Quantity, parse


def test_what_python_has_becomes_what_toml_has():
    problems = Problems({})
    day = datetime.date(2026, 3, 1)
    written = plain(
        {
            "a": (1, np.float64(0.5), np.int64(3)),
            "b": {"axis": np.array([1.0, 0.0])},
            "c": None,
            "d": day,
            "e": PurePosixPath("x/y.csv"),
        },
        (),
        problems,
    )
    assert written == {"a": [1, 0.5, 3], "b": {"axis": [1.0, 0.0]}, "d": day, "e": "x/y.csv"}
    assert [type(value) for value in written["a"]] == [int, float, int]
    assert problems.lines == []


def test_a_quantity_is_read_back_to_the_last_bit():
    for quantity in (Quantity(1 / 3, 1e-7 / 3, "m"), Quantity(-1e-22, 0.0, "g/g^2")):
        text = plain(quantity, (), Problems({}))
        assert parse(text, quantity.unit) == quantity


def test_what_cannot_stand_in_a_description_is_noted_with_its_key():
    problems = Problems({})
    plain({"site": {"gravity": 1j}, 7: 1}, (), problems)
    assert problems.lines == [
        ": the key 7 must be text",
        "site.gravity: a complex cannot stand here; write text or a number",
    ]


def test_patches_are_merge_patches():
    # The cases of RFC 7396, appendix A, whose documents are objects.
    for before, patch, after in [
        ({"a": "b"}, {"a": "c"}, {"a": "c"}),
        ({"a": "b"}, {"b": "c"}, {"a": "b", "b": "c"}),
        ({"a": "b"}, {"a": None}, {}),
        ({"a": "b", "b": "c"}, {"a": None}, {"b": "c"}),
        ({"a": ["b"]}, {"a": "c"}, {"a": "c"}),
        ({"a": "c"}, {"a": ["b"]}, {"a": ["b"]}),
        ({"a": {"b": "c"}}, {"a": {"b": "d", "c": None}}, {"a": {"b": "d"}}),
        ({"a": [{"b": "c"}]}, {"a": [1]}, {"a": [1]}),
        ({"e": None}, {"a": 1}, {"e": None, "a": 1}),
        ({}, {"a": {"bb": {"ccc": None}}}, {"a": {"bb": {}}}),
    ]:
        assert patched(before, patch) == after


def test_differences_are_named_by_their_keys():
    before = {"a": {"b": 1, "c": [1, 2]}, "runs": [{"rate": "1"}, {"rate": "2"}]}
    after = {"a": {"b": 1, "c": [1]}, "runs": [{"rate": "1"}, {"rate": "3"}], "x.y": 0}
    assert list(differences(before, after)) == ["a.c", "runs[1].rate", '"x.y"']
    assert list(differences(before, before)) == []
    assert list(differences({"a": 1}, {"a": True})) == ["a"]
