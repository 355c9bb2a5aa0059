"""The table of tumble tests is reproducible, and shifts of more than 3 u cause a finding."""

import math
import runpy
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"
STUDY = runpy.run_path(str(DOCS / "tumbled.py"))
TABLE, TUMBLE_TESTS = STUDY["TABLE"], STUDY["TUMBLE_TESTS"]
ARCSEC = math.radians(1.0) / 3600.0


@pytest.fixture(scope="module")
def stored_results():
    return {(row.name, row.observable): row for row in TABLE.load()}


def test_page_shows_stored_results():
    page = TABLE.page.read_text("utf-8")
    assert TABLE.insert(TABLE.load(), page) == page


def test_table_contains_all_violations_and_tumbles(stored_results):
    assert set(stored_results) == {
        (v.name, tumble) for v in STUDY["list_violations"]() for tumble in TUMBLE_TESTS
    }


def test_no_violation_is_silent(stored_results):
    assert not [key for key, row in stored_results.items() if row.is_silent]


def test_computed_row_matches_table(stored_results):
    for row in STUDY["calibrate_violations"]("12 positions"):
        stored_row = stored_results[row.name, row.observable]
        assert (row.codes, row.free_codes) == (stored_row.codes, stored_row.free_codes)
        assert row.shifts == pytest.approx(stored_row.shifts, abs=0.05)


@pytest.mark.parametrize("tumble", TUMBLE_TESTS)
def test_findings_name_head(stored_results, tumble):
    reference = STUDY["describe_tumble"](*TUMBLE_TESTS[tumble])
    for violation in STUDY["list_violations"]():
        if not stored_results[violation.name, tumble].codes:
            continue
        # The third and fourth harmonics have two columns each, and are detected but not named.
        if violation.symbol.startswith(("head.harmonic.3", "head.harmonic.4")):
            continue
        simulation = STUDY["describe_simulation"](violation, reference)
        fixed_result = next(STUDY["calibrate_simulation"](simulation))
        times = "once" if ".1." in violation.symbol else "twice"
        two_mountings_text = f"have the pattern of a head error {times} per revolution"
        text = "A head error that varies with the angle"
        assert (two_mountings_text if "mountings" in tumble else text) in fixed_result.findings[
            0
        ].text


def test_head_waves_match_closed_form(stored_results):
    """A head error d = e sin(phi) changes cos(phi) by -d sin(phi) = -e sin^2(phi).

    In one mounting, K_F therefore decreases by e and K_II increases by e.
    """
    typical = 1e-5
    for tumble, (positions, mounting_angles) in TUMBLE_TESTS.items():
        row = stored_results["head.harmonic.1.sin", tumble]
        n = positions * len(mounting_angles)
        # Of a + b cos phi + c cos^2 phi + d sin phi by even angles: u(a) and u(c), over sigma,
        # are sqrt(3/n) and sqrt(8/n); K_PP and K_OO of 2 ug/g^2 act on both.
        u_f = math.hypot(2e-6 * math.sqrt(3.0 / n), 2e-6)
        u_ii = math.hypot(2e-6 * math.sqrt(8.0 / n), 2e-6)
        if mounting_angles == (0,):
            assert abs(row.shifts["K_F"]) == pytest.approx(typical / u_f, rel=0.01)
            assert abs(row.shifts["K_II"]) == pytest.approx(typical / u_ii, rel=0.01)
            assert row.codes == []
        else:
            assert "lack-of-fit" in row.codes
