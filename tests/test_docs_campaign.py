"""The page on campaign.toml has every key that may be written, and no other."""

import inspect
import re
import tomllib
from pathlib import Path

import pytest

from counterspin.campaign import settings, specification
from counterspin.campaign.truth import TRUTH_TABLES
from counterspin.physics.terms import MOTION_TERMS, OWN_TERMS
from counterspin.units import UNITS

PAGE = (Path(__file__).parents[1] / "docs" / "campaign.md").read_text(encoding="utf-8")
TABLES = re.findall(r"^<!-- keys: ([\w ]+) -->\n((?:\|.*\n)+)", PAGE, re.MULTILINE)
SECTIONS = {
    name: value
    for name, value in (vars(settings) | vars(specification)).items()
    if inspect.isclass(value) and issubclass(value, settings.SettingsSection) and name[0] != "_"
}
MODELS = [(name, table) for names, table in TABLES for name in names.split()]
#: The unit that makes the example of a column a valid one.
CHANNEL_UNITS = {
    "DisplacementChannel": "mm",
    "VelocityChannel": "mm/s",
    "ForceChannel": "mg",
}

every_table = pytest.mark.parametrize(("name", "table"), MODELS, ids=[name for name, _ in MODELS])


def rows(table):
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in table.splitlines()]


def keys_of(model):
    return {field.alias or name: field for name, field in model.model_fields.items()}


def test_every_section_has_its_table():
    # The axes are part of an accelerometer's keys, a dialect of those of records and readings.
    parts = {"SettingsSection", "AxesSettings", "TableDialect"}
    assert {name for name, _ in MODELS} == set(SECTIONS) - parts


@every_table
def test_keys_are_those_of_the_code(name, table):
    head, _, *body = rows(table)
    assert head == ["key", "kind", "default", "example", "meaning"]
    listed = [re.match(r"`(\w+)`", row[0])[1] for row in body]
    expected = set(keys_of(SECTIONS[name]))
    if any("and so on" in row[0] for row in body):
        # One row stands for all terms.
        listed = [key for key in listed if key not in OWN_TERMS]
        expected -= set(OWN_TERMS)
    assert len(listed) == len(set(listed))
    assert set(listed) == expected


@every_table
def test_defaults_are_those_of_the_code(name, table):
    fields = keys_of(SECTIONS[name])
    for cells in rows(table)[2:]:
        field = fields[re.match(r"`(\w+)`", cells[0])[1]]
        assert (cells[2] == "required") == field.is_required(), cells[0]
        if isinstance(field.default, bool):
            assert cells[2] == str(field.default).lower(), cells[0]
        elif isinstance(field.default, int | float):
            assert float(cells[2].split()[0]) == field.default, cells[0]
        elif field.default and isinstance(field.default, str):
            assert cells[2].strip("`") == field.default, cells[0]


@every_table
def test_examples_are_valid(name, table):
    text = "\n".join(cells[3].strip("`") for cells in rows(table)[2:])
    given = tomllib.loads(text.replace("UNIT", CHANNEL_UNITS.get(name, "")))
    model = SECTIONS[name]
    if name == "TimeChannel":  # a column, or this
        model.model_validate({"sampling_rate": given.pop("sampling_rate")})
    model.model_validate(given, context={"gravity": 9.8066})
    assert set(given) <= set(keys_of(model))


def test_limits_of_a_specification_are_as_the_table_has_them():
    section = PAGE.partition("## [specification]")[2].partition("\n## ")[0]
    lines = re.findall(r'^\| (`".*) \|$', section, re.MULTILINE)
    table = [[cell.strip('`" ') for cell in line.split("|")] for line in lines]
    assert len(table) == 5
    for text, *ends in table:
        limits = specification.parse_specification(text, text.split()[-1])
        shown = [float(end.split()[0]) if end else None for end in ends]
        assert [limits.low, limits.high] == shown


def test_names_that_no_accelerometer_may_have_are_listed():
    words = PAGE.partition("Names begin with a letter")[2].partition("are reserved")[0]
    words = words.partition(";")[2]
    assert tuple(re.findall(r"`(\w+)`", words)) == TRUTH_TABLES


def test_harmonics_of_the_path_are_those_of_the_terms():
    for name in ("centrifuge.imbalance", "encoder.harmonic"):
        (first, last) = re.search(rf"`{name}\.N` \(N = (\d)(?: to|,) (\d)\)", PAGE).groups()
        orders = {
            row.effect.harmonic for row in MOTION_TERMS.values() if row.symbol.startswith(name)
        }
        assert orders == set(range(int(first), int(last) + 1))


def test_every_unit_is_listed():
    listed = PAGE.partition("Units, with products")[2].partition("\n\n")[0]
    assert set(re.findall(r"`(\w+)`", listed)) - {"g/Hz^0.5", "deg/h/g"} == set(UNITS)


def test_every_record_format_is_listed():
    assert all(ending in PAGE for ending in settings.RECORD_FORMATS)
