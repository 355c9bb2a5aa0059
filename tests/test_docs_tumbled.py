"""The table of tumbles is what is found, and nothing in it goes unsaid beyond 3 u."""

import math
import runpy
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"
STUDY = runpy.run_path(str(DOCS / "tumbled.py"))
TABLE, WAYS = STUDY["TABLE"], STUDY["TUMBLE_TESTS"]
ARCSEC = math.radians(1.0) / 3600.0


@pytest.fixture(scope="module")
def stored_results():
    return {(row.name, row.observable): row for row in TABLE.load()}


def test_page_shows_stored_results():
    page = TABLE.page.read_text("utf-8")
    assert TABLE.insert(TABLE.load(), page) == page


def test_table_contains_all_violations_and_tumbles(stored_results):
    assert set(stored_results) == {
        (v.name, way) for v in STUDY["list_violations"]() for way in WAYS
    }


def test_no_violation_is_silent(stored_results):
    assert not [key for key, row in stored_results.items() if row.silent]


def test_computed_row_matches_table(stored_results):
    for row in STUDY["calibrate_violations"]("12 positions"):
        known = stored_results[row.name, row.observable]
        assert (row.codes, row.said_weighed) == (known.codes, known.said_weighed)
        assert row.shifts == pytest.approx(known.shifts, abs=0.05)


@pytest.mark.parametrize("way", WAYS)
def test_findings_name_head(stored_results, way):
    usual = STUDY["describe_tumble"](*WAYS[way])
    for violation in STUDY["list_violations"]():
        if not stored_results[violation.name, way].codes:
            continue
        # Waves three and four times a turn are two columns each, and are noticed without a name.
        if violation.symbol.startswith(("head.harmonic.3", "head.harmonic.4")):
            continue
        assuming = next(STUDY["calibrate_world"](STUDY["describe_world"](violation, usual)))
        times = "once" if ".1." in violation.symbol else "twice"
        two = f"have the pattern of a head error {times} per revolution"
        text = "A head error that varies with the angle"
        assert (two if "mountings" in way else text) in assuming.findings[0].text


def test_head_waves_match_closed_form(stored_results):
    """Turned by d more, cos phi reads less by d sin phi; d = e sin phi is e (1 - cos 2 phi)/2 less.

    That is e sin^2 phi, so K_F less by e and K_II more by e: in one mounting to the last digit.
    """
    typical = 1e-5
    for way, (positions, mounted) in WAYS.items():
        row = stored_results["head.harmonic.1.sin", way]
        turns = positions * len(mounted)
        # Of a + b cos phi + c cos^2 phi + d sin phi by even angles: u(a) and u(c), over sigma,
        # are sqrt(3/n) and sqrt(8/n); K_PP and K_OO of 2 ug/g^2 act on both.
        u_f = math.hypot(2e-6 * math.sqrt(3.0 / turns), 2e-6)
        u_ii = math.hypot(2e-6 * math.sqrt(8.0 / turns), 2e-6)
        if mounted == (0,):
            assert abs(row.shifts["K_F"]) == pytest.approx(typical / u_f, rel=0.01)
            assert abs(row.shifts["K_II"]) == pytest.approx(typical / u_ii, rel=0.01)
            assert row.codes == []
        else:
            assert "lack-of-fit" in row.codes
