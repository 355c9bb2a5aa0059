"""Intervals hold in good campaigns of any kind, as the page on trust says."""

import runpy
from pathlib import Path

import numpy as np
import pytest

DOCS = Path(__file__).parents[1] / "docs"
STUDY = runpy.run_path(str(DOCS / "varied.py"))
TABLE, KINDS, Kind = STUDY["TABLE"], STUDY["KINDS"], STUDY["Kind"]
KEPT = TABLE.load() if TABLE.file.exists() else []

#: Binomial and Gaussian standard deviations that a count, or an rms, may be off by.
ALLOWED = 3.5

kept = pytest.mark.skipif(not KEPT, reason="docs/varied.json is not made yet: make coverage")


@kept
def test_page_shows_stored_results():
    page = TABLE.page.read_text("utf-8")
    assert TABLE.insert(KEPT, page) == page


@kept
def test_table_contains_all_kinds_and_campaign_counts():
    assert [row.words for row in KEPT] == [*KINDS]
    assert sum(row.campaigns for row in KEPT) == 1200
    assert "1200 random campaigns" in TABLE.page.read_text("utf-8")


@kept
def test_intervals_have_coverage():
    for row in KEPT:
        # Two accelerometers of a campaign share its machine: each campaign counts once.
        within = ALLOWED * np.sqrt(0.05 * 0.95 / row.campaigns)
        assert row.covered > 0.95 - within, row.words


@kept
def test_u_is_not_too_small():
    for row in KEPT:
        for symbol, size in row.z_rms.items():
            count = min(row.values[symbol], row.campaigns)
            assert size < 1.0 + ALLOWED / np.sqrt(2.0 * count), (row.words, symbol)


def test_invisible_noise_causes_no_finding():
    """The noise contributes two thirds of the variance of K_II."""
    errors, result = STUDY["run_trial"](40094, Kind(unstated=False))
    assert result.state == "good"
    assert [
        remark for remark in result.warnings if "comes from accelerometer white noise" in remark
    ]
    assert all(covered for symbol, _, covered in errors if symbol == "K_II")


def test_drawn_values_are_plausible():
    """Four standard deviations of K_II, drawn once in 16,000, are beyond 1e-4 g/g^2."""
    drawn = STUDY["draw_campaign"](np.random.default_rng(40130), Kind(unstated=False))
    assert all(
        abs(own[symbol] - STUDY["term"](symbol).nominal) < STUDY["term"](symbol).limit
        for own in drawn.truth.values()
        for symbol in STUDY["TERMS"]
    )


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
def test_drawn_campaign_matches_kind(kind):
    drawn = STUDY["draw_campaign"](np.random.default_rng(kind.first), kind)
    assert ('assume = "all"' in drawn.described) is not kind.unstated
    assert kind.noise is None or ("[noise]" in drawn.described) is (kind.noise != "found")
    assert ('"estimate"' in drawn.described) is (kind.noise == "estimate")
    assert "truth" not in drawn.described
    assert all(set(STUDY["TERMS"]) <= set(own) for own in drawn.truth.values())
    assert any(set(own) > set(STUDY["TERMS"]) for own in drawn.truth.values()) is kind.unstated
    row = STUDY["run_trials"]("few", kind, trials=2)
    assert row.campaigns == 2
    for symbol, size in row.z_rms.items():
        # Of four normal variables at most: beyond 5 once in 1e6.
        assert size < 5.0, symbol
