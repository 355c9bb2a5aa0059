"""A form made of the models: every key of every section, and none besides."""

import re
from itertools import chain

from prose import sentences

from counterspin.application.form import SECTIONS, campaign_form, lab_form, plan_form, run_kinds
from counterspin.campaign.accelerometers import TRUTH_TABLES
from counterspin.campaign.field_types import COMPASS
from counterspin.campaign.resolution import CampaignDocument
from counterspin.campaign.terms import BARE_NAMES
from counterspin.certificates.lab import Lab
from counterspin.physics.accelerometer import DIRECTIONS
from counterspin.physics.terms import ACCELEROMETER_TERMS, TERMS, is_term
from counterspin.units import unit_factor


def section(form, key):
    (found,) = (one for one in form if one["key"] == key)
    return found


def field(form, *path):
    name, *inner = path
    fields = section(form, name)["fields"]
    for key in inner:
        (found,) = (one for one in fields if one["key"] == key)
        fields = found.get("fields", [])
    return found


def test_every_section_is_in_the_form():
    keys = {f.alias or name for name, f in CampaignDocument.model_fields.items()}
    (laboratory,) = re.findall(
        r"In the laboratory file, edit (.*?) as text", sentences("application")
    )
    of_laboratory = set(re.findall(r"\[(\w+)\]", laboratory))
    assert keys - {"schema"} == set(SECTIONS)
    assert [one["key"] for one in campaign_form()] == list(SECTIONS)
    sections = {one["key"] for one in lab_form()}
    assert set(Lab.model_fields) - {"schema_version"} - of_laboratory == sections


def test_quantities_say_their_unit_and_coefficients_are_all_there():
    form = campaign_form()
    latitude = field(form, "site", "latitude")
    assert latitude["kind"] == "quantity"
    assert latitude["unit"] == "rad"
    assert latitude["units"][0] == "deg"  # in which it is usually written
    assert set(latitude["units"]) > {"rad", "arcsec"}
    assert field(form, "noise", "acceleration")["unit"] == "m/s^2/Hz^0.5"
    assert field(form, "runs", "rate")["unit"] == "rad/s"
    units = {f["key"]: f.get("unit") for f in section(form, "accelerometers")["fields"]}
    assert {symbol: units[symbol] for symbol in TERMS} == {s: row.unit for s, row in TERMS.items()}


def test_kinds_of_values():
    form = campaign_form()
    kinds = {
        ("records", "time"): "group",
        ("records", "time", "column"): "text",
        ("records", "reference"): "choice",
        ("records", "skip_lines"): "number",
        ("runs", "skip"): "flag",
        ("runs", "revolutions"): "number",
        ("model", "terms"): "terms",
        ("runs", "continued_in"): "list",
        ("model", "priors"): "table",
        ("accelerometers", "input_axis"): "text",
        ("campaign", "date"): "date",
        ("runs", "temperature"): "quantity",
    }
    kinds |= {
        ("specification", "decision_rule"): "choice",
        ("specification", "guard_factor"): "number",
        ("simulation", "sampling_rate"): "quantity",
        ("study", "trials"): "number",
        ("study", "vary"): "table",
    }
    assert {path: field(form, *path)["kind"] for path in kinds} == kinds
    assert field(form, "records", "reference")["choices"] == ["platform", "own velocity"]
    assert field(lab_form(), "certificate", "begin")["kind"] == "date"
    assert section(form, "accelerometers")["repeat"] == "names"
    assert section(lab_form(), "persons")["repeat"] == "list"


def inside(fields):
    """Yield every field, those of groups too."""
    for one in fields:
        yield one
        yield from inside(one.get("fields", []))


def test_every_field_has_a_label_and_help_in_words():
    for form in (campaign_form(), lab_form(), plan_form(False), plan_form(True)):
        for one in form:
            for asked in inside(one["fields"]):
                assert re.match(r"[A-Z][a-z]", asked["label"]), asked
                assert asked["key"] in ACCELEROMETER_TERMS or "_" not in asked["label"], asked
            tables = (one.get("of_readings", []), *one.get("of_tables", {}).values())
            for asked in inside(chain(one["fields"], *tables)):
                assert asked["help"] or asked["key"] in ACCELEROMETER_TERMS, asked
                assert not re.search(r"`|\]\(", asked["help"]), asked
    assert field(campaign_form(), "accelerometers", "K_II")["label"] == (
        "Second-order coefficient (K_II)"
    )


def test_units_offered_are_units_of_the_key():
    fields = [one for part in campaign_form() for one in inside(part["fields"])]
    quantities = [one for one in fields if one["kind"] == "quantity"]
    assert len(quantities) > 40
    for one in quantities:
        for unit in one["units"]:
            if unit != "degC":
                unit_factor(unit, one["unit"], gravity=9.8)
    columns = field(campaign_form(), "records", "time", "unit")
    assert "ms" in columns["suggestions"]
    assert "iso" in columns["suggestions"]
    force = field(campaign_form(), "accelerometers", "specific_force", "unit")
    assert {"mm/s^2", "ug", "A"} <= set(force["suggestions"])


def test_choices_are_offered_where_other_things_may_stand_too():
    form = campaign_form()
    assert field(form, "accelerometers", "input_axis")["suggestions"] == list(DIRECTIONS)
    assert field(form, "records", "angle", "zero")["suggestions"] == list(COMPASS)
    assert field(form, "noise", "acceleration")["suggestions"] == ["estimate"]
    country = field(lab_form(), "laboratory", "country")
    assert (country["kind"], country["names"]["DE"]) == ("country", "Germany")
    assert "DD" not in country["names"]
    assert field(lab_form(), "certificate", "language")["kind"] == "language"


def test_terms_to_tick_are_those_that_a_model_may_name():
    rows = field(campaign_form(), "model", "terms")["rows"]
    symbols = [row["key"] for row in rows]
    assert len(symbols) == len(set(symbols))
    assert set(ACCELEROMETER_TERMS) < set(symbols)
    assert all(is_term(s) or s in BARE_NAMES for s in symbols)
    assert {name for name in BARE_NAMES if name.count(".") == 1} < set(symbols)
    assert all(re.match("[A-Z]", row["words"]) for row in rows)


def test_readings_among_the_runs_have_their_own_keys():
    runs = section(campaign_form(), "runs")
    assert "reading" in {f["key"] for f in runs["of_readings"]}
    document = {"runs": [{"rate": "1 rad/s"}, {"reading": "1 g"}, {"motion": "arm"}, 7]}
    assert run_kinds(document) == ["record", "reading", "reading", "record"]
    assert run_kinds({"runs": "none"}) == run_kinds({}) == []


def test_limits_of_every_term_and_truth_of_every_table():
    form = campaign_form()
    limits = section(form, "specification")
    assert [f["key"] for f in limits["of_names"]] == list(TERMS)
    assert field(form, "specification", "K_II")["example"] == "abs <= … g/g^2"
    truth = section(form, "truth")
    assert {*truth["of_tables"], "machine"} == set(TRUTH_TABLES)
    assert set(TERMS) <= {f["key"] for f in truth["fields"]}
    assert "drift" in {f["key"] for f in truth["of_tables"]["spindle"]}
