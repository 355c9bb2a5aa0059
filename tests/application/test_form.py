"""A form made of the models: every key of every section, and none besides."""

import re

from prose import sentences

from counterspin.application.form import SECTIONS, campaign_form, lab_form, run_kinds
from counterspin.campaign.settings import DocumentSettings
from counterspin.campaign.truth import TRUTH_TABLES
from counterspin.certificates.lab import Lab
from counterspin.physics.terms import TERMS


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
    keys = {f.alias or name for name, f in DocumentSettings.model_fields.items()}
    (laboratory,) = re.findall(r"edited in its text: (.*?) of `LAB.toml`", sentences("application"))
    of_laboratory = set(re.findall(r"\[(\w+)\]", laboratory))
    assert keys - {"schema"} == set(SECTIONS)
    assert [one["key"] for one in campaign_form()] == list(SECTIONS)
    sections = {one["key"] for one in lab_form()}
    assert set(Lab.model_fields) - {"schema_version"} - of_laboratory == sections


def test_quantities_say_their_unit_and_coefficients_are_all_there():
    form = campaign_form()
    assert field(form, "site", "latitude") == {
        "key": "latitude",
        "required": True,
        "kind": "text",
        "unit": "rad",
    }
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
        ("model", "terms"): "list",
        ("model", "priors"): "table",
        ("accelerometers", "input_axis"): "text",
    }
    kinds |= {
        ("specification", "decision_rule"): "choice",
        ("specification", "guard_factor"): "number",
        ("simulation", "sampling_rate"): "text",
        ("study", "trials"): "number",
        ("study", "vary"): "table",
    }
    assert {path: field(form, *path)["kind"] for path in kinds} == kinds
    assert field(form, "records", "reference")["choices"] == ["platform", "own velocity"]
    assert field(lab_form(), "certificate", "begin")["kind"] == "date"
    assert section(form, "accelerometers")["repeat"] == "names"
    assert section(lab_form(), "persons")["repeat"] == "list"


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
