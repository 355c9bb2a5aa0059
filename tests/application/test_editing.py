"""A value is changed, and all else stays as it was written."""

import difflib
import tomllib
from importlib.resources import files

import pytest

from counterspin.application.editing import set_value
from counterspin.errors import CounterspinError

STARTER = (files("counterspin.ingest") / "starter.toml").read_text("utf-8")


def lines_changed(path, value, kind=""):
    """Return what a change took out of the starter and what it put in."""
    made = set_value(STARTER, path, value, kind)
    lines = difflib.ndiff(STARTER.splitlines(), made.splitlines())
    return [line for line in lines if line[:2] in ("- ", "+ ") and line[2:].strip()]


@pytest.mark.parametrize(
    ("path", "value", "lines"),
    [
        (["site", "removed_gravity"], "9.81 m/s^2", ['+ removed_gravity = "9.81 m/s^2"']),
        (
            ["records", "time", "unit"],
            "ms",
            [
                '- time = { column = "time_s", unit = "s" }',
                '+ time = { column = "time_s", unit = "ms" }',
            ],
        ),
        (
            ["runs", 0, "name"],
            "first",
            ['- name = "run1"', '+ name = "first"'],
        ),
        (["model", "limits", "K_II"], "1 g/g^2", ["+ [model.limits]", '+ K_II = "1 g/g^2"']),
        (["accelerometers", "Qz"], {"bias": "1 g"}, ["+ [accelerometers.Qz]", '+ bias = "1 g"']),
        (["specification"], {"K_II": "1"}, ["+ [specification]", '+ K_II = "1"']),
        (["noise", "new", "in"], 1, ["+ new = {in = 1}"]),
    ],
)
def test_comments_and_all_else_are_kept(path, value, lines):
    assert lines_changed(path, value) == lines


#: A file whose last tables are commented out.
CLOSED = """\
[item]
name = "A"
# state = "as received"

# [accelerometers.Qx]
# model = "B"

[conditions]
# temperature = "20 degC"
# [cmc]
# K_II = "1 g/g^2"

# [specification]
# K_II = "2 g/g^2\""""


@pytest.mark.parametrize("ends", ["", "\n", "\n\n"])
@pytest.mark.parametrize(
    ("path", "after"),
    [
        (["item", "model"], '# state = "as received"'),
        (["conditions", "temperature"], '# temperature = "20 degC"'),
        (["conditions", "deeper", "still"], '# temperature = "20 degC"'),
    ],
)
def test_a_new_key_stays_in_its_table_when_a_comment_becomes_a_heading(path, after, ends):
    made = set_value(CLOSED + ends, path, "1")
    line = f'{path[-1]} = "1"' if len(path) == 2 else f'{path[1]} = {{{path[2]} = "1"}}'
    assert f"{after}\n{line}\n" in made
    assert path[1] in tomllib.loads(made.replace("# [", "["))[path[0]]
    assert made.replace(f"{line}\n", "", 1).rstrip() == CLOSED


def test_a_comment_behind_a_value_is_kept():
    taken, put = lines_changed(["runs", 0, "rate"], "1 rpm")
    assert taken.split("#")[1] == put.split("#")[1] != ""


def test_runs_are_added_and_taken_out():
    count = len(tomllib.loads(STARTER)["runs"])
    run = {"name": "more", "rate": "1 rpm", "record": "more.csv"}
    more = set_value(STARTER, ["runs", count], run)
    assert tomllib.loads(more)["runs"][count] == run
    assert set_value(more, ["runs", count], None).split() == STARTER.split()
    fewer = tomllib.loads(set_value(STARTER, ["runs", 0], None))["runs"]
    assert fewer == tomllib.loads(STARTER)["runs"][1:]


def test_dates_are_dates():
    assert "\ndate = 2026-03-01\n" in set_value(STARTER, ["campaign", "date"], "2026-03-01", "date")
    with pytest.raises(CounterspinError, match="not a date"):
        set_value(STARTER, ["campaign", "date"], "1st of March", "date")


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ([], 1),
        (["runs", 99, "rate"], "1"),
        (["runs", "one"], 1),
        (["schema", "deeper", "still"], 1),
        (["site", 0], 1),
    ],
)
def test_what_cannot_be_changed_is_refused(path, value):
    with pytest.raises(CounterspinError):
        set_value(STARTER, path, value)


def test_a_text_that_is_no_toml_is_refused_with_its_place():
    with pytest.raises(CounterspinError, match="line 1"):
        set_value("a = 1 2\n", ["a"], 1)
