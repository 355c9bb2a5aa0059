"""With nothing assumed no violation moves a coefficient by more than 3 u and goes unsaid."""

import runpy
from functools import cache
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"
STUDY = runpy.run_path(str(DOCS / "violations.py"))
TABLE, UNITS = STUDY["TABLE"], STUDY["UNITS"]
VIOLATIONS = [*STUDY["term_violations"](), *STUDY["input_violations"]()]

#: The same study with fewer rows.
SMALL = STUDY["Size"](10.0, 20)


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
    silent = [f"{row.name} ({row.observable})" for row in TABLE.load() if row.silent]
    assert silent == []


def test_correct_cause_is_among_first_two():
    """A random guess among 60 alternatives has a probability of 1/30; 80 % is required."""
    rows = [row for row in TABLE.load() if row.codes]
    wrong = [f"{row.name} ({row.observable}): {row.named}" for row in rows if not row.right(2)]
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
    stated = STUDY["describe_campaign"](observable, SMALL)
    (outcome,) = STUDY["calibrate_world"](stated, stated)
    return outcome


@pytest.mark.parametrize(
    ("observable", "violation"),
    [
        (observable, violation)
        for observable in UNITS
        for violation in VIOLATIONS
        # What the accelerometer adds is much the same in every record.
        if observable == "displacement" or violation.symbol.startswith(("centri", "enc", "rec"))
    ],
    ids=lambda part: getattr(part, "name", part),
)
def test_no_violation_is_silent(observable, violation):
    """Assume nothing; the table has the results with all terms assumed."""
    stated, world = violation.of(STUDY["describe_campaign"](observable, SMALL))
    (outcome,) = STUDY["calibrate_world"](world, stated)
    shifts = STUDY["normalised_shifts"](violation, calibrate_without_violation(observable), outcome)
    assert not STUDY["is_silent"](shifts, outcome.findings), f"{shifts}, in u"


def test_row_has_shifts_with_and_without_assumptions():
    (violation,) = (v for v in VIOLATIONS if v.name == "platform.compliance.zy")
    stated = STUDY["describe_campaign"]("displacement", SMALL)
    both = STUDY["calibrate_world"](stated, *STUDY["variants"](stated))
    row = STUDY["calibrate_violation"](violation, "displacement", both, SMALL)
    # What is assumed to be perfect is in no u, and K_II is off by many; weighed, it is in u.
    assert abs(row.shifts["K_II"]) > 10.0 * abs(row.weighed["K_II"]) > 0.0
    assert row.held < 3.0


def test_silent_violation_is_detected():
    moved = {"K_F": 0.0, "K_II": -30.1}
    row = STUDY["Row"]("x", "1", "displacement", moved, "good", [], {"K_II": -3.1}, [])
    assert row.silent
    assert row.cell == "K_II 30 u: no finding; 3.1 u"
