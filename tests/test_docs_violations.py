"""With no term fixed, every violation that shifts a coefficient by 3 u causes a finding."""

import runpy
from functools import cache
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"
STUDY = runpy.run_path(str(DOCS / "violations.py"))
TABLE, UNITS = STUDY["TABLE"], STUDY["UNITS"]
VIOLATIONS = [*STUDY["term_violations"](), *STUDY["input_violations"]()]

#: Size of a shorter campaign.
SMALL_SIZE = STUDY["Size"](10.0, 20)


def test_page_shows_stored_results():
    page = TABLE.page.read_text("utf-8")
    assert TABLE.insert(TABLE.load(), page) == page


def test_table_contains_all_violations_and_observables():
    table_keys = {(row.name, row.size, row.observable) for row in TABLE.load()}
    assert table_keys == {
        (violation.name, violation.size, observable)
        for violation in VIOLATIONS
        for observable in UNITS
    }


def test_no_row_of_table_is_silent():
    silent = [f"{row.name} ({row.observable})" for row in TABLE.load() if row.is_silent]
    assert silent == []


def test_correct_cause_is_among_first_two():
    """A random guess among 60 alternatives has a probability of 1/30; 80 % is required."""
    rows = [row for row in TABLE.load() if row.codes]
    wrong = [
        f"{row.name} ({row.observable}): {row.named_causes}"
        for row in rows
        if not row.names_true_cause(2)
    ]
    assert len(rows) > 60
    assert len(wrong) < 0.2 * len(rows), wrong


def test_largest_shift_matches_theory():
    # Compliance in azimuth has the t^2 of K_II itself (physics.md): 0.1 arcsec/g is 4.85e-7 g/g^2.
    (row,) = (
        row
        for row in TABLE.load()
        if (row.name, row.observable) == ("platform.compliance.zy", "displacement")
    )
    assert row.shifts["K_II"] == pytest.approx(4.85e-7 / 7.48e-10, rel=0.02)


@cache
def calibrate_without_violation(observable):
    reference = STUDY["describe_campaign"](observable, SMALL_SIZE)
    (result,) = STUDY["calibrate_simulation"](reference, reference)
    return result


@pytest.mark.parametrize(
    ("observable", "violation"),
    [
        (observable, violation)
        for observable in UNITS
        for violation in VIOLATIONS
        # Violations of the accelerometer have similar effects in every observable.
        if observable == "displacement" or violation.symbol.startswith(("centri", "enc", "rec"))
    ],
    ids=lambda value: getattr(value, "name", value),
)
def test_no_violation_is_silent(observable, violation):
    """Calibrate with no term fixed; the table contains the results with all terms fixed."""
    description, simulation = violation.describe(STUDY["describe_campaign"](observable, SMALL_SIZE))
    (result,) = STUDY["calibrate_simulation"](simulation, description)
    shifts = STUDY["normalised_shifts"](violation, calibrate_without_violation(observable), result)
    assert not STUDY["is_shift_silent"](shifts, result.findings), f"{shifts}, in u"


def test_row_has_shifts_with_and_without_assumptions():
    (violation,) = (v for v in VIOLATIONS if v.name == "platform.compliance.zy")
    reference = STUDY["describe_campaign"]("displacement", SMALL_SIZE)
    clean = STUDY["calibrate_simulation"](reference, *STUDY["fixed_and_free"](reference))
    row = STUDY["calibrate_violation"](violation, "displacement", clean, SMALL_SIZE)
    # u does not include fixed terms, so K_II is wrong by many u; without fixed terms, it is not.
    assert abs(row.shifts["K_II"]) > 10.0 * abs(row.free_shifts["K_II"]) > 0.0
    assert row.largest_free_shift < 3.0


def test_silent_violation_is_detected():
    shifts = {"K_F": 0.0, "K_II": -30.1}
    row = STUDY["Row"]("x", "1", "displacement", shifts, "good", [], {"K_II": -3.1}, [])
    assert row.is_silent
    assert row.cell == "K_II 30 u: no finding; 3.1 u"
