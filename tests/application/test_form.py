"""The form generated from the settings models: all keys of all sections and no others."""

import re
from itertools import chain

from prose import read_text

from counterspin.application.form import (
    SECTION_MODELS,
    campaign_form,
    detect_run_types,
    lab_form,
    plan_form,
)
from counterspin.campaign.accelerometers import TRUTH_TABLES
from counterspin.campaign.field_types import COMPASS_ANGLES
from counterspin.campaign.resolution import CampaignDocument
from counterspin.campaign.terms import BARE_NAMES
from counterspin.certificates.lab import Lab
from counterspin.physics.accelerometer import DIRECTIONS
from counterspin.physics.terms import ACCELEROMETER_TERMS, TERMS, is_term
from counterspin.units import unit_factor


def find_section(form, key):
    (actual_section,) = (section for section in form if section["key"] == key)
    return actual_section


def find_field(form, *path):
    name, *inner = path
    fields = find_section(form, name)["fields"]
    for key in inner:
        (actual_field,) = (field for field in fields if field["key"] == key)
        fields = actual_field.get("fields", [])
    return actual_field


def test_form_has_all_sections():
    keys = {f.alias or name for name, f in CampaignDocument.model_fields.items()}
    (laboratory,) = re.findall(
        r"In the laboratory file, edit (.*?) as text", read_text("application")
    )
    of_laboratory = set(re.findall(r"\[(\w+)\]", laboratory))
    assert keys - {"schema"} == set(SECTION_MODELS)
    assert [section["key"] for section in campaign_form()] == list(SECTION_MODELS)
    sections = {section["key"] for section in lab_form()}
    assert set(Lab.model_fields) - {"schema_version"} - of_laboratory == sections


def test_form_states_units_and_lists_all_coefficients():
    form = campaign_form()
    latitude = find_field(form, "site", "latitude")
    assert latitude["kind"] == "quantity"
    assert latitude["unit"] == "rad"
    assert latitude["units"][0] == "deg"  # the usual unit
    assert set(latitude["units"]) > {"rad", "arcsec"}
    assert find_field(form, "noise", "acceleration")["unit"] == "m/s^2/Hz^0.5"
    assert find_field(form, "runs", "rate")["unit"] == "rad/s"
    units = {f["key"]: f.get("unit") for f in find_section(form, "accelerometers")["fields"]}
    assert {symbol: units[symbol] for symbol in TERMS} == {s: row.unit for s, row in TERMS.items()}


def test_field_kinds():
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
    assert {path: find_field(form, *path)["kind"] for path in kinds} == kinds
    assert find_field(form, "records", "reference")["choices"] == ["platform", "own velocity"]
    assert find_field(lab_form(), "certificate", "begin")["kind"] == "date"
    assert find_section(form, "accelerometers")["repeat"] == "names"
    assert find_section(lab_form(), "persons")["repeat"] == "list"


def flatten_fields(fields):
    """Yield all fields, including those of groups."""
    for field in fields:
        yield field
        yield from flatten_fields(field.get("fields", []))


def test_fields_have_label_and_help():
    for form in (campaign_form(), lab_form(), plan_form(False), plan_form(True)):
        for section in form:
            for field in flatten_fields(section["fields"]):
                assert re.match(r"[A-Z][a-z]", field["label"]), field
                assert field["key"] in ACCELEROMETER_TERMS or "_" not in field["label"], field
            tables = (section.get("reading_fields", []), *section.get("table_fields", {}).values())
            for field in flatten_fields(chain(section["fields"], *tables)):
                assert field["help"] or field["key"] in ACCELEROMETER_TERMS, field
                assert not re.search(r"`|\]\(", field["help"]), field
    assert find_field(campaign_form(), "accelerometers", "K_II")["label"] == (
        "Second-order coefficient (K_II)"
    )


def test_offered_units_match_key():
    fields = [field for part in campaign_form() for field in flatten_fields(part["fields"])]
    quantities = [field for field in fields if field["kind"] == "quantity"]
    assert len(quantities) > 40
    for quantity in quantities:
        for unit in quantity["units"]:
            if unit != "degC":
                unit_factor(unit, quantity["unit"], gravity=9.8)
    columns = find_field(campaign_form(), "records", "time", "unit")
    assert "ms" in columns["suggestions"]
    assert "iso" in columns["suggestions"]
    force = find_field(campaign_form(), "accelerometers", "specific_force", "unit")
    assert {"mm/s^2", "ug", "A"} <= set(force["suggestions"])


def test_fields_with_free_text_offer_suggestions():
    form = campaign_form()
    assert find_field(form, "accelerometers", "input_axis")["suggestions"] == list(DIRECTIONS)
    assert find_field(form, "records", "angle", "zero")["suggestions"] == list(COMPASS_ANGLES)
    assert find_field(form, "noise", "acceleration")["suggestions"] == ["estimate"]
    country = find_field(lab_form(), "laboratory", "country")
    assert (country["kind"], country["names"]["DE"]) == ("country", "Germany")
    assert "DD" not in country["names"]
    assert find_field(lab_form(), "certificate", "language")["kind"] == "language"


def test_selectable_terms_are_valid_model_terms():
    rows = find_field(campaign_form(), "model", "terms")["rows"]
    symbols = [row["key"] for row in rows]
    assert len(symbols) == len(set(symbols))
    assert set(ACCELEROMETER_TERMS) < set(symbols)
    assert all(is_term(s) or s in BARE_NAMES for s in symbols)
    assert {name for name in BARE_NAMES if name.count(".") == 1} < set(symbols)
    assert all(re.match("[A-Z]", row["words"]) for row in rows)


def test_runs_of_readings_have_separate_keys():
    runs = find_section(campaign_form(), "runs")
    assert "reading" in {f["key"] for f in runs["reading_fields"]}
    document = {"runs": [{"rate": "1 rad/s"}, {"reading": "1 g"}, {"motion": "arm"}, 7]}
    assert detect_run_types(document) == ["record", "reading", "reading", "record"]
    assert detect_run_types({"runs": "none"}) == detect_run_types({}) == []


def test_form_has_limits_of_all_terms_and_truth_of_all_tables():
    form = campaign_form()
    limits = find_section(form, "specification")
    assert [f["key"] for f in limits["name_fields"]] == list(TERMS)
    assert find_field(form, "specification", "K_II")["example"] == "abs <= … g/g^2"
    truth = find_section(form, "truth")
    assert {*truth["table_fields"], "machine"} == set(TRUTH_TABLES)
    assert set(TERMS) <= {f["key"] for f in truth["fields"]}
    assert "drift" in {f["key"] for f in truth["table_fields"]["spindle"]}
