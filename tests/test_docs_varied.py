"""Intervals have their coverage in all kinds of good campaigns, as the page on trust states."""

import runpy
from pathlib import Path

import numpy as np
import pytest

DOCS = Path(__file__).parents[1] / "docs"
STUDY = runpy.run_path(str(DOCS / "varied.py"))
TABLE, KINDS, Kind = STUDY["TABLE"], STUDY["KINDS"], STUDY["Kind"]
STORED_ROWS = TABLE.load() if TABLE.file.exists() else []

#: Tolerance of a count or an rms, in standard deviations.
TOLERANCE = 3.5

needs_stored_rows = pytest.mark.skipif(
    not STORED_ROWS, reason="docs/varied.json does not exist: run make coverage"
)


@needs_stored_rows
def test_page_shows_stored_results():
    page = TABLE.page.read_text("utf-8")
    assert TABLE.insert(STORED_ROWS, page) == page


@needs_stored_rows
def test_table_contains_all_kinds_and_campaign_counts():
    assert [row.label for row in STORED_ROWS] == [*KINDS]
    assert sum(row.n_campaigns for row in STORED_ROWS) == 1200
    assert "1200 random campaigns" in TABLE.page.read_text("utf-8")


@needs_stored_rows
def test_intervals_have_coverage():
    for row in STORED_ROWS:
        # Accelerometers of one campaign share the machine errors, so each campaign counts once.
        tolerance = TOLERANCE * np.sqrt(0.05 * 0.95 / row.n_campaigns)
        assert row.coverage > 0.95 - tolerance, row.label


@needs_stored_rows
def test_u_is_not_too_small():
    for row in STORED_ROWS:
        for symbol, rms in row.z_rms.items():
            n = min(row.n_errors[symbol], row.n_campaigns)
            assert rms < 1.0 + TOLERANCE / np.sqrt(2.0 * n), (row.label, symbol)


def test_invisible_noise_causes_no_finding():
    """The noise contributes two thirds of the variance of K_II."""
    errors, result = STUDY["run_trial"](40094, Kind(has_unstated_errors=False))
    assert result.state == "good"
    assert [
        remark for remark in result.warnings if "comes from accelerometer white noise" in remark
    ]
    assert all(is_covered for symbol, _, is_covered in errors if symbol == "K_II")


def test_drawn_values_are_plausible():
    """Four standard deviations of K_II, drawn once in 16,000, are beyond 1e-4 g/g^2."""
    drawn = STUDY["draw_campaign"](np.random.default_rng(40130), Kind(has_unstated_errors=False))
    assert all(
        abs(coefficients[symbol] - STUDY["term"](symbol).nominal) < STUDY["term"](symbol).limit
        for coefficients in drawn.truth.values()
        for symbol in STUDY["TERMS"]
    )


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
def test_drawn_campaign_matches_kind(kind):
    drawn = STUDY["draw_campaign"](np.random.default_rng(kind.first_seed), kind)
    assert ('assume = "all"' in drawn.description) is not kind.has_unstated_errors
    assert kind.noise is None or ("[noise]" in drawn.description) is (kind.noise != "found")
    assert ('"estimate"' in drawn.description) is (kind.noise == "estimate")
    assert "truth" not in drawn.description
    assert all(set(STUDY["TERMS"]) <= set(coefficients) for coefficients in drawn.truth.values())
    assert (
        any(set(coefficients) > set(STUDY["TERMS"]) for coefficients in drawn.truth.values())
        is kind.has_unstated_errors
    )
    row = STUDY["run_trials"]("few", kind, trials=2)
    assert row.n_campaigns == 2
    for symbol, rms in row.z_rms.items():
        # Of four normal variables at most: beyond 5 once in 1e6.
        assert rms < 5.0, symbol
