"""With nothing assumed no violation moves a coefficient by more than 3 u and goes unsaid."""

import runpy
from functools import cache
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"
STUDY = runpy.run_path(str(DOCS / "violations.py"))
TABLE, UNITS = STUDY["TABLE"], STUDY["UNITS"]
VIOLATIONS = [*STUDY["of_table"](), *STUDY["of_inputs"]()]

#: The same study with fewer rows.
SMALL = STUDY["Size"](10.0, 20)


def test_the_page_shows_what_was_found():
    page = TABLE.page.read_text("utf-8")
    assert TABLE.insert(TABLE.load(), page) == page


def test_every_violation_is_in_the_table_with_every_record():
    found = {(row.name, row.size, row.observable) for row in TABLE.load()}
    assert found == {
        (violation.name, violation.size, observable)
        for violation in VIOLATIONS
        for observable in UNITS
    }


def test_none_of_the_table_is_silent():
    silent = [f"{row.name} ({row.observable})" for row in TABLE.load() if row.silent]
    assert silent == []


def test_the_right_cause_is_among_the_first_two():
    """Guessing among 60 alternatives would be right once in 30; 80 % is what is asked for."""
    found = [row for row in TABLE.load() if row.codes]
    wrong = [f"{row.name} ({row.observable}): {row.named}" for row in found if not row.right(2)]
    assert len(found) > 60
    assert len(wrong) < 0.2 * len(found), wrong


def test_the_worst_one_is_what_the_theory_says():
    # Compliance in azimuth has the t^2 of K_II itself (physics.md): 0.1 arcsec/g is 4.85e-7 g/g^2.
    (row,) = (
        row
        for row in TABLE.load()
        if (row.name, row.observable) == ("platform.compliance.zy", "displacement")
    )
    assert row.shifts["K_II"] == pytest.approx(4.85e-7 / 7.48e-10, rel=0.02)


@cache
def clean(observable):
    stated = STUDY["description"](observable, SMALL)
    (found,) = STUDY["calibrated"](stated, stated)
    return found


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
def test_none_is_silent(observable, violation):
    """With nothing assumed; what is said where all is assumed stands in the table."""
    stated, world = violation.of(STUDY["description"](observable, SMALL))
    (found,) = STUDY["calibrated"](world, stated)
    shifts = STUDY["shifts_of"](violation, clean(observable), found)
    assert not STUDY["is_silent"](shifts, found.findings), f"{shifts}, in u"


def test_a_row_says_what_happens_with_all_assumed_and_with_nothing():
    (violation,) = (v for v in VIOLATIONS if v.name == "platform.compliance.zy")
    stated = STUDY["description"]("displacement", SMALL)
    both = STUDY["calibrated"](stated, *STUDY["ways"](stated))
    row = STUDY["row_of"](violation, "displacement", both, SMALL)
    # What is assumed to be perfect is in no u, and K_II is off by many; weighed, it is in u.
    assert abs(row.shifts["K_II"]) > 10.0 * abs(row.weighed["K_II"]) > 0.0
    assert row.held < 3.0


def test_a_silent_one_would_be_found():
    moved = {"K_F": 0.0, "K_II": -30.1}
    row = STUDY["Row"]("x", "1", "displacement", moved, "good", [], {"K_II": -3.1}, [])
    assert row.silent
    assert row.cell == "K_II 30 u: no finding; 3.1 u"
