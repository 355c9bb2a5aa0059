"""Line numbers of keys in a TOML file, and documents as Python values."""

import datetime
import hashlib
import re
import tomllib
from dataclasses import replace
from importlib.resources import files
from pathlib import PurePosixPath

import campaigns
import frames
import numpy as np
import pytest
import results
from campaigns import SMALL as BASE
from campaigns import write_description
from raising import raises

from counterspin.campaign.description import read_campaign
from counterspin.campaign.documents import (
    changed_keys,
    format_key_path,
    key_lines,
    merge_patch,
    message_lines,
    parse_document,
    to_toml_value,
)
from counterspin.campaign.memory import make_campaign
from counterspin.campaign.quantity import Quantity, parse_quantity
from counterspin.campaign.validation import Problems
from counterspin.certificates.lab import read_lab, write_example
from counterspin.errors import CampaignError
from counterspin.planning.plan_file import read_plan
from counterspin.studies.description import read_study

TEXT = '''\
schema = 1
# [site] in a comment
site.gravity = "9.8 m/s^2"
"platform.tilt" = """
rate = 3
"""
names = [
  ["a", "b"],
  ["[runs]"]
]
[accelerometers.Qx]  # the first
output = { unit = "mA", sensitivity = "1 mA/g" }
[[runs]]
name = "[one]"
[runs.truth]
drift = 1
[[runs]]
name = 'two # no comment'
[[runs.truth.ripple]]
harmonic = 1
[[runs.truth.ripple]]
harmonic = 2
'''


def test_key_lines_of_tables_arrays_and_dotted_keys():
    assert tomllib.loads(TEXT)["runs"][1]["truth"]["ripple"][1] == {"harmonic": 2}
    assert key_lines(TEXT) == {
        "schema": 1,
        "site": 3,
        "site.gravity": 3,
        "platform.tilt": 4,
        "names": 7,
        "accelerometers.Qx": 11,
        "accelerometers.Qx.output": 12,
        "runs[0]": 13,
        "runs[0].name": 14,
        "runs[0].truth": 15,
        "runs[0].truth.drift": 16,
        "runs[1]": 17,
        "runs[1].name": 18,
        "runs[1].truth.ripple[0]": 19,
        "runs[1].truth.ripple[0].harmonic": 20,
        "runs[1].truth.ripple[1]": 21,
        "runs[1].truth.ripple[1].harmonic": 22,
    }


def _walk_values(value, path=()):
    """Return key, as in messages, -> value for all values of a document."""
    values = {format_key_path(path).replace('"', ""): value}
    inner = value.items() if isinstance(value, dict) else ()
    if isinstance(value, list):
        inner = enumerate(value)
    for key, one in inner:
        values |= _walk_values(one, (*path, key))
    return values


@pytest.mark.parametrize("name", ["starter.toml", "starter_tumble.toml", "starter_arm.toml"])
def test_line_contains_value_of_key(name):
    text = (files("counterspin.ingest") / name).read_text("utf-8")
    values, lines = _walk_values(tomllib.loads(text)), text.splitlines()
    checked = 0
    for key, number in key_lines(text).items():
        value = values[key]
        if not isinstance(value, dict) and not lines[number - 1].startswith("["):
            (own,) = tomllib.loads(lines[number - 1]).values()
            while isinstance(own, dict):
                (own,) = own.values()
            assert own == value, key
            checked += 1
    assert checked > 15


def test_message_has_line_of_key_or_table(tmp_path):
    file = tmp_path / "a.toml"
    file.write_text(f"{TEXT}\n[readings]\n", encoding="utf-8")
    line_by_message = {
        "accelerometers.Qx.output.zero: must be a string": 12,
        "accelerometers.Qx.input_axis: is missing": 11,
        'runs[1].rate: is missing (run "two")': 17,
        '"platform.tilt": unknown term': 4,
        'readings."table.csv row 3".reading: is not a number': None,
        "limits: is missing": None,
        'accelerometers.Qx."a.b": unknown': 11,
        "accelerometers: unknown key": 11,
        "no key at all": None,
    }
    assert message_lines(list(line_by_message), file) == list(line_by_message.values())
    assert message_lines(list(line_by_message), tmp_path / "none.toml") == [None] * len(
        line_by_message
    )


def test_errors_of_file_state_line(tmp_path):
    wrong = BASE.replace("schema = 1", "schema = 2").replace('column = "time_s"', "column = 3")
    with pytest.raises(CampaignError) as raised:
        read_campaign(write_description(tmp_path, wrong))
    lines = str(raised.value).splitlines()
    assert lines[0].endswith(f"campaign.toml: {len(raised.value.problems)} mistakes")
    for line, problem in zip(lines[1:], raised.value.problems, strict=True):
        number = int(re.fullmatch(rf"  line (\d+): {re.escape(problem)}", line)[1])
        last = re.split(r"[.:]", problem.partition(": ")[0])[-1]
        assert last in wrong.splitlines()[number - 1]


def test_errors_are_in_file_order(tmp_path):
    # The first error concerns several tables, which are compared after the separate checks.
    wrong = BASE.replace('column = "angle_rad"', 'column = "time_s"').replace("rev/s", "rev")
    with pytest.raises(CampaignError) as raised:
        read_campaign(write_description(tmp_path, wrong))
    numbers = [int(number) for number in re.findall(r"^  line (\d+): ", str(raised.value), re.M)]
    assert len(numbers) > 2
    assert numbers == sorted(numbers)
    assert raised.value.problems[0].startswith('records.angle: column "time_s"')


def test_errors_of_plan_and_laboratory_file_state_line(tmp_path):
    plan = tmp_path / "PLAN.toml"
    plan.write_text('schema = 1\n[goal]\nminimise = ["K_II"]\ntarget = 3\n', encoding="utf-8")
    with raises("wrong-type", "line 4", "goal.target:"):
        read_plan(plan)
    assert key_lines(write_example(tmp_path / "LAB.toml").read_text("utf-8"))["laboratory.name"] > 1


@pytest.mark.parametrize("name", ["campaign.toml", "PLAN.toml", "LAB.toml", "study.toml"])
def test_rejects_deeply_nested_key_with_file_and_line(tmp_path, name):
    file = tmp_path / name
    file.write_text("schema = 1\n" + "a." * 40_000 + "a = 1\n", encoding="utf-8")
    for read in (
        read_campaign,
        read_plan,
        read_study,
        lambda path: read_lab(path, results.make_qx_result()),
    ):
        with pytest.raises(CampaignError) as raised:
            read(file)
        assert raised.value.code == "invalid-toml"
        assert str(raised.value).startswith(f"{file}: line 2: ")


SYNTAX_ERRORS = {
    'title = "cut': "line 2: the file ends within a key, a value or a table; complete it",
    "title": "line 2: the file ends within a key, a value or a table; complete it",
    "terms = [1,\n": "line 2: the file ends within a key, a value or a table; complete it",
    'title = "open\na = 1\n': "line 2, column 14: the closing quotation mark is missing on this",
    "title: 3\n": "line 2, column 6: '=' is missing after the key; write KEY = VALUE",
    "rate = 3 rad/s\n": "line 2, column 10: more text follows the value; write text, such as",
    "rate = rad/s\n": "line 2, column 8: invalid value; write text, such as a quantity, in quot",
    "= 3\n": "line 2, column 1: a key, a table or a comment must begin here; write KEY = VALUE",
    "terms = [1 2]\n": "line 2, column 12: a comma or the ']' of the list is missing; write",
    "angle = { a = 1\nb = 2 }\n": "line 2, column 16: a comma or the '}' of the table is missing",
    "[site\na = 1\n": "line 2, column 6: ']' is missing after the name of the table",
    "a = 1\na = 2\n": "line 3, column 6: the key occurs twice; keep only one of them",
    "[site]\n[site]\n": "line 3, column 6: the table [site] occurs twice; keep only one of them",
    'file = "C:\\data"\n': r"line 2, column 13: unescaped '\' in a string; in double quotation",
    "a = 1\rb = 2\r": "line 2, column 6: ",
}


@pytest.mark.parametrize("text", SYNTAX_ERRORS)
def test_syntax_errors_are_explained_with_position(text):
    with pytest.raises(CampaignError) as raised:
        parse_document(f"schema = 1\n{text}".encode(), "a.toml")
    assert raised.value.code == "invalid-toml"
    assert str(raised.value).startswith(f"a.toml: {SYNTAX_ERRORS[text]}")


def test_python_values_become_toml_types():
    problems = Problems({})
    day = datetime.date(2026, 3, 1)
    written = to_toml_value(
        {
            "a": (1, np.float64(0.5), np.int64(3)),
            "b": {"axis": np.array([1.0, 0.0])},
            "c": None,
            "d": day,
            "e": PurePosixPath("x/y.csv"),
        },
        (),
        problems.add,
    )
    assert written == {"a": [1, 0.5, 3], "b": {"axis": [1.0, 0.0]}, "d": day, "e": "x/y.csv"}
    assert [type(value) for value in written["a"]] == [int, float, int]
    assert problems.lines == []


def test_quantity_round_trips_exactly():
    for quantity in (Quantity(1 / 3, 1e-7 / 3, "m"), Quantity(-1e-22, 0.0, "g/g^2")):
        text = to_toml_value(quantity, (), Problems({}).add)
        assert parse_quantity(text, quantity.unit) == quantity


def test_unsupported_values_are_reported_with_key():
    problems = Problems({})
    to_toml_value({"site": {"gravity": 1j}, 7: 1}, (), problems.add)
    assert problems.lines == [
        ": the key 7 must be a string",
        "site.gravity: a complex is not allowed here; write text or a number",
    ]


def test_merge_patch_follows_rfc_7396():
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
        assert merge_patch(before, patch) == after


def test_differences_are_named_by_key():
    before = {"a": {"b": 1, "c": [1, 2]}, "runs": [{"rate": "1"}, {"rate": "2"}]}
    after = {"a": {"b": 1, "c": [1]}, "runs": [{"rate": "1"}, {"rate": "3"}], "x.y": 0}
    assert list(changed_keys(before, after)) == ["a.c", "runs[1].rate", '"x.y"']
    assert list(changed_keys(before, before)) == []
    assert list(changed_keys({"a": 1}, {"a": True})) == ["a"]


def sha256_of(data):
    return f"sha256:{hashlib.sha256(data).hexdigest()}"


def test_file_source_has_checksum_of_bytes(tmp_path):
    file = campaigns.write_description(tmp_path, "# a comment\n" + campaigns.SMALL)
    source = read_campaign(tmp_path).source
    assert source.content_checksum() == sha256_of(file.read_bytes())
    assert (source.in_memory, source.label) == (False, str(file))


def test_changed_source_has_checksum_of_document(tmp_path):
    file = campaigns.write_description(tmp_path, campaigns.SMALL)
    campaign = read_campaign(tmp_path)
    changed = campaign.change({"centrifuge": {"radius": "2.6 m"}})
    assert changed.source.changed == ("centrifuge.radius",)
    assert changed.source.content_checksum() != sha256_of(file.read_bytes())
    assert str(changed.path) == changed.source.label == f"{file}, changed in memory"
    for name in ("slow", "middle", "fast"):
        (tmp_path / f"{name}.csv").write_text("time_s\n0\n", encoding="utf-8")
    written = changed.write(tmp_path / "written")
    assert changed.source.content_checksum() == sha256_of(written.read_bytes())


def test_reverted_change_has_source_of_file(tmp_path):
    file = campaigns.write_description(tmp_path, campaigns.SMALL)
    back = (
        read_campaign(tmp_path)
        .change({"centrifuge": {"radius": "2.6 m"}})
        .change({"centrifuge": {"radius": "2.5 m"}})
    )
    assert not back.source.in_memory
    assert back.source.content_checksum() == sha256_of(file.read_bytes())


def test_copy_with_replaced_field_has_no_source():
    campaign = make_campaign(frames.parse_small_description())
    assert campaign.source is not None
    assert replace(campaign, title="other").source is None
