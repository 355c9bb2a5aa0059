"""Every implausible value causes a finding, in all types of measurement."""

import runpy
from dataclasses import replace
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"
STUDY = runpy.run_path(str(DOCS / "incredible.py"))
TABLE, MISTAKES, MEASUREMENTS = STUDY["TABLE"], STUDY["MISTAKES"], STUDY["COLUMN_BY_MEASUREMENT"]

#: Mistake -> subject of the first finding.
SUBJECTS = {
    "wrong sign of all readings": "K_I",
    "K_I = 1.3 g/g": "K_I",
    "K_F = 0.3 g": "K_F",
    "K_II = 500 ug/g^2": "K_II",
    "m/s^2 instead of g": "K_I",
    "head zero wrong by 1 deg": "delta_O",
    "attitude angles in the opposite sense, input axis east at angle zero": "K_I",
    "attitude angles in the opposite sense, delta_O stated": "A",
}


def test_page_shows_stored_results():
    page = TABLE.page.read_text("utf-8")
    assert TABLE.insert(TABLE.load(), page) == page


@pytest.mark.parametrize(
    ("mistake", "measurement"),
    [(m, measurement) for m in MISTAKES for measurement in m.measurements],
    ids=lambda value: getattr(value, "name", value),
)
def test_finding_matches_table(mistake, measurement):
    row = STUDY["check_mistake"](mistake, measurement)
    key = (row.name, row.measurement)
    (stored,) = (r for r in TABLE.load() if (r.name, r.measurement) == key)
    assert (row.state, row.code, row.subject) == (stored.state, stored.code, stored.subject)
    if row.state == "refused":
        assert "check the " in row.text
        return
    assert row.subject.endswith(SUBJECTS[mistake.name])
    assert "heck " in row.text
    assert row.state == "contradicted"


def test_likely_cause_is_named():
    texts = {row.name: row.text for row in TABLE.load() if row.measurement == "tumble"}
    sign = "Check the sign of the output, and the senses of the input axis and of the attitudes."
    assert sign in texts["wrong sign of all readings"]
    assert sign in texts["attitude angles in the opposite sense, input axis east at angle zero"]
    assert "may be in m/s^2 instead of g." in texts["m/s^2 instead of g"]
    assert "the zero and the sense of the attitude angles" in texts["head zero wrong by 1 deg"]
    assert (
        "the sense of rotation of the attitudes"
        in texts["attitude angles in the opposite sense, delta_O stated"]
    )


@pytest.mark.parametrize("measurement", MEASUREMENTS)
def test_correct_data_have_no_finding(measurement):
    correct = replace(MISTAKES[1], truth={}, simulation_changes={}, transform=float)
    row = STUDY["check_mistake"](correct, measurement)
    # Twelve readings on an arm, with few stated inputs, leave 4.1 degrees of freedom.
    assert row.code == ("unjudged-readings" if measurement == "arm" else "")


@pytest.mark.parametrize("is_axis_up", [True, False])
def test_correct_attitudes_have_no_finding(is_axis_up):
    stated_values = 'delta_O = "1e-3 ± 1e-6 rad"\n'
    mistake = replace(MISTAKES[-1], sense=1, is_axis_up=is_axis_up, stated_values=stated_values)
    assert STUDY["check_mistake"](mistake, "tumble").code == ""


def test_implausible_default_prior_follows_cause():
    """Mirrored attitudes resemble an error of the head zero of 80 typical sizes."""
    (finding,) = STUDY["calibrate_mistake"](MISTAKES[-1], "tumble").findings
    explained = finding.explains[0]
    assert (finding.code, explained.code, explained.subject) == (
        "wrong-mounting",
        "beyond-typical",
        "head.zero",
    )
