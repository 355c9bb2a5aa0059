"""The lines in which the keys of a TOML file stand."""

import re
import tomllib
from importlib.resources import files

import pytest
from campaigns import SMALL as BASE
from campaigns import write

from counterspin.campaign.description import read_campaign
from counterspin.campaign.toml_file import key_path, lines_of, lines_of_messages
from counterspin.certificates.lab import write_example
from counterspin.errors import CampaignError
from counterspin.planning.plan_file import read_plan

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


def test_keys_are_found_in_tables_lists_of_tables_and_with_dots():
    assert tomllib.loads(TEXT)["runs"][1]["truth"]["ripple"][1] == {"harmonic": 2}
    assert lines_of(TEXT) == {
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


def _values(value, path=()):
    """Return key, as messages write it, -> value, of all that stands in a document."""
    found = {key_path(path).replace('"', ""): value}
    inner = value.items() if isinstance(value, dict) else ()
    if isinstance(value, list):
        inner = enumerate(value)
    for key, one in inner:
        found |= _values(one, (*path, key))
    return found


@pytest.mark.parametrize("name", ["starter.toml", "starter_tumble.toml", "starter_arm.toml"])
def test_each_line_holds_the_value_of_its_key(name):
    text = (files("counterspin.campaign") / name).read_text("utf-8")
    values, lines = _values(tomllib.loads(text)), text.splitlines()
    checked = 0
    for key, number in lines_of(text).items():
        value = values[key]
        if not isinstance(value, dict) and not lines[number - 1].startswith("["):
            (own,) = tomllib.loads(lines[number - 1]).values()
            while isinstance(own, dict):
                (own,) = own.values()
            assert own == value, key
            checked += 1
    assert checked > 15


def test_a_message_has_the_line_of_its_key_or_of_its_table(tmp_path):
    file = tmp_path / "a.toml"
    file.write_text(TEXT, encoding="utf-8")
    told = {
        "accelerometers.Qx.output.zero: must be text": 12,
        "accelerometers.Qx.input_axis: is missing": 11,
        'runs[1].rate: is missing (run "two")': 17,
        '"platform.tilt": unknown term': 4,
        'readings."table.csv row 3".reading: is not a number': None,
        "limits: is missing": None,
        "no key at all": None,
    }
    assert lines_of_messages(list(told), file) == list(told.values())
    assert lines_of_messages(list(told), tmp_path / "none.toml") == [None] * len(told)


def test_each_mistake_of_a_file_is_told_with_its_line(tmp_path):
    wrong = BASE.replace("schema = 1", "schema = 2").replace('column = "time_s"', "column = 3")
    with pytest.raises(CampaignError) as raised:
        read_campaign(write(tmp_path, wrong))
    lines = str(raised.value).splitlines()
    assert lines[0].endswith(f"campaign.toml: {len(raised.value.problems)} mistakes")
    for told, problem in zip(lines[1:], raised.value.problems, strict=True):
        number = int(re.fullmatch(rf"  line (\d+): {re.escape(problem)}", told)[1])
        last = re.split(r"[.:]", problem.partition(": ")[0])[-1]
        assert last in wrong.splitlines()[number - 1]


def test_plans_and_laboratories_tell_theirs_too(tmp_path):
    plan = tmp_path / "PLAN.toml"
    plan.write_text('schema = 1\n[goal]\nminimise = ["K_II"]\ntarget = 3\n', encoding="utf-8")
    with pytest.raises(CampaignError, match=r"line 4: goal.target: must be a table"):
        read_plan(plan)
    assert lines_of(write_example(tmp_path / "LAB.toml").read_text("utf-8"))["laboratory.name"] > 1
