"""What the pages on plans, readings and studies list is what the code has."""

import re
from pathlib import Path
from typing import get_args

from counterspin.physics.terms import READING_TERMS
from counterspin.planning.plan_file import SHORT_KEYS
from counterspin.readings.section import COLUMNS, ReadingsSettings
from counterspin.studies import description
from counterspin.studies.draws import NOISE_LEVEL_UNITS
from counterspin.studies.engine_selection import EngineName

DOCS = Path(__file__).parents[1] / "docs"
PAGES = {name: (DOCS / f"{name}.md").read_text("utf-8") for name in ("plan", "readings")}


def test_columns_of_reading_table_are_listed():
    description = ReadingsSettings.model_fields["columns"].description
    assert set(re.findall(r"`(\w+)`", description)) == {*COLUMNS, "reading", "u"}


def test_machine_terms_are_listed_with_units():
    section = PAGES["readings"].partition("## Machine terms")[2].partition("\n## ")[0]
    listed = {}
    for symbols, unit in re.findall(r"^\| (`.*?) \| (.*?) \| .* \|$", section, re.MULTILINE):
        first, *more = re.findall(r"`([\w.]+)`", symbols)
        stem = first.rpartition(".")[0]
        listed |= dict.fromkeys((first, *(stem + s if s[0] == "." else s for s in more)), unit)
    axes = ("outward", "forward", "up", "east", "north")
    turn = listed.pop("fixture.misalignment.MOUNTING.AXIS")
    listed |= {f"fixture.misalignment.MOUNTING.{axis}": turn for axis in axes}
    assert set(listed) == set(READING_TERMS)
    assert {symbol: unit for symbol, unit in listed.items() if not unit.startswith("per K")} == {
        symbol: row.unit for symbol, row in READING_TERMS.items() if "per" not in listed[symbol]
    }


def test_varying_quantities_of_study_are_listed():
    page = (DOCS / "study.md").read_text("utf-8")
    assert set(re.findall(r"`(noise\.\w+)`", page)) == set(NOISE_LEVEL_UNITS)
    (kinds,) = re.findall(r"A distribution is (.*?)\. ", page)
    assert tuple(re.findall(r"`(\w+)`", kinds)) == description._DISTRIBUTIONS
    options = re.search(r"^\| engine \|.*?\n\n", page, re.MULTILINE | re.DOTALL)[0]
    assert set(re.findall(r"--engine (\w+)", options)) <= set(get_args(EngineName))


def test_short_names_of_changes_are_listed():
    page = (DOCS / "python.md").read_text("utf-8")
    sentence = page.partition("or a short name:")[2].partition(".")[0]
    assert set(re.findall(r"`(\w+)`", sentence)) == set(SHORT_KEYS)
