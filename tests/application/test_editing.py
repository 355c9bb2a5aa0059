"""Changing a value leaves the rest of the text as written."""

import difflib
import tomllib
from importlib.resources import files

import pytest

from counterspin.application.editing import set_value
from counterspin.errors import CounterspinError

STARTER = (files("counterspin.ingest") / "starter.toml").read_text("utf-8")


def changed_lines(path, value, kind=""):
    """Return the lines that a change removes from the starter and those that it adds."""
    text = set_value(STARTER, path, value, kind)
    lines = difflib.ndiff(STARTER.splitlines(), text.splitlines())
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
def test_changed_value_keeps_comments_and_other_lines(path, value, lines):
    assert changed_lines(path, value) == lines


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
def test_new_key_precedes_commented_out_tables(path, after, ends):
    text = set_value(CLOSED + ends, path, "1")
    line = f'{path[-1]} = "1"' if len(path) == 2 else f'{path[1]} = {{{path[2]} = "1"}}'
    assert f"{after}\n{line}\n" in text
    assert path[1] in tomllib.loads(text.replace("# [", "["))[path[0]]
    assert text.replace(f"{line}\n", "", 1).rstrip() == CLOSED


def test_trailing_comment_is_preserved():
    taken, put = changed_lines(["runs", 0, "rate"], "1 rpm")
    assert taken.split("#")[1] == put.split("#")[1] != ""


def test_runs_can_be_added_and_removed():
    count = len(tomllib.loads(STARTER)["runs"])
    run = {"name": "more", "rate": "1 rpm", "record": "more.csv"}
    more = set_value(STARTER, ["runs", count], run)
    assert tomllib.loads(more)["runs"][count] == run
    assert set_value(more, ["runs", count], None).split() == STARTER.split()
    fewer = tomllib.loads(set_value(STARTER, ["runs", 0], None))["runs"]
    assert fewer == tomllib.loads(STARTER)["runs"][1:]


def test_date_is_written_as_toml_date():
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
def test_rejects_invalid_path_or_value(path, value):
    with pytest.raises(CounterspinError):
        set_value(STARTER, path, value)


def test_rejects_invalid_toml_with_line_number():
    with pytest.raises(CounterspinError, match="line 1"):
        set_value("a = 1 2\n", ["a"], 1)
