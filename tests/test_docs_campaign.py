"""The page on campaign.toml has every key that may be written, and no other."""

import inspect
import re
from pathlib import Path

import pytest

from counterspin.campaign import settings, simulated_truth, specification, truth
from counterspin.campaign.accelerometers import TRUTH_TABLES
from counterspin.campaign.field_types import SettingsSection
from counterspin.physics.terms import MOTION_TERMS
from counterspin.records.format_registry import RECORD_FORMATS
from counterspin.units import UNITS
from key_tables import fill_tables, find_keys, find_model

PAGE = (Path(__file__).parents[1] / "docs" / "campaign.md").read_text(encoding="utf-8")
PAGES = sorted((Path(__file__).parents[1] / "docs").glob("*.md"))
TABLES = [
    name
    for page in PAGES
    for name in re.findall(r"^<!-- keys: ([\w ]+) -->$", page.read_text("utf-8"), re.MULTILINE)
]
#: Keys of which not all may be given together -> what is left out, one way after the other.
ALTERNATIVES = {
    "TimeChannel": [("sampling_rate",), ("column", "unit")],
}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_key_tables_match_classes(page):
    text = page.read_text("utf-8")
    assert fill_tables(text) == text, "run `python docs/key_tables.py`"


@pytest.mark.parametrize("name", TABLES)
def test_examples_are_valid(name):
    model = find_model(name.partition(" of ")[0])
    fields = find_keys(name)
    given = {key: example for key, field in fields.items() for example in field.examples}
    assert set(given) == set(fields)
    for left_out in ALTERNATIVES.get(name, [()]):
        some = {key: value for key, value in given.items() if key not in left_out}
        model.model_validate(some, context={"gravity": 9.8066})


def test_every_section_has_key_table():
    sections = {
        name
        for name, value in (
            vars(settings) | vars(truth) | vars(simulated_truth) | vars(specification)
        ).items()
        if inspect.isclass(value) and issubclass(value, SettingsSection) and name[0] != "_"
    }
    # The true radius is one of the keys of [truth.centrifuge].
    # A dialect is part of the keys of records and readings; all columns but that of a force have
    # the same keys. The tables of [truth] are told one by one, its noise by that of [noise].
    parts = {"SettingsSection", "TableDialect", "VelocityChannel", "CentrifugeDimensions"}
    parts |= {"TruthSettings", "TrueNoise"}
    assert sections - parts <= {name.partition(" of ")[0] for name in TABLES}


def test_specification_limits_match_table():
    section = PAGE.partition("## [specification]")[2].partition("\n## ")[0]
    lines = re.findall(r'^\| (`".*) \|$', section, re.MULTILINE)
    table = [[cell.strip('`" ') for cell in line.split("|")] for line in lines]
    assert len(table) == 5
    for text, *ends in table:
        limits = specification.parse_specification(text, text.split()[-1])
        shown = [float(end.split()[0]) if end else None for end in ends]
        assert [limits.low, limits.high] == shown


def test_reserved_accelerometer_names_are_listed():
    words = PAGE.partition("Accelerometer names begin")[2].partition("are reserved")[0]
    words = words.partition("`_`.")[2]
    assert tuple(re.findall(r"`(\w+)`", words)) == TRUTH_TABLES


def test_path_harmonics_match_terms():
    for name in ("centrifuge.imbalance", "encoder.harmonic"):
        (first, last) = re.search(rf"`{name}\.N` \(N = (\d)(?: to|,) (\d)\)", PAGE).groups()
        orders = {
            row.effect.harmonic for row in MOTION_TERMS.values() if row.symbol.startswith(name)
        }
        assert orders == set(range(int(first), int(last) + 1))


def test_every_unit_is_listed():
    listed = PAGE.partition("the following units and their products")[2].partition("\n\n")[0]
    assert set(re.findall(r"`(\w+)`", listed)) - {"g/Hz^0.5", "deg/h/g"} == set(UNITS)


def test_every_record_format_is_listed():
    assert all(ending in PAGE for ending in RECORD_FORMATS)
