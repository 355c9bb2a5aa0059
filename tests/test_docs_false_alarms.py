"""The rate of false alarms is that of the page on diagnosis."""

import runpy
from pathlib import Path

import pytest

STUDY = runpy.run_path(str(Path(__file__).parents[1] / "docs" / "false_alarms.py"))
TABLE = STUDY["TABLE"]
STORED_ROWS = TABLE.load()


def test_page_shows_stored_results():
    page = TABLE.page.read_text("utf-8")
    assert TABLE.insert(STORED_ROWS, page) == page


def test_table_contains_all_cases():
    assert [(row.label, row.runs, row.trials) for row in STORED_ROWS] == [
        (case.label, len(case.rates), case.trials) for case in STUDY["CASES"]
    ]


@pytest.mark.parametrize("row", STORED_ROWS, ids=lambda row: f"{row.label}, {row.runs}")
def test_false_alarm_rate_is_below_1_percent(row):
    low, _ = STUDY["proportion_interval"](row.counts["`run-disagrees`"], row.trials)
    assert low < 0.005
    assert row.counts["`run-disagrees`"] < 0.01 * row.trials
    assert row.counts["contradicted"] == 0


def test_proportion_interval_matches_clopper_pearson():
    # No success: (1 - p)^n = 0.025.
    assert STUDY["proportion_interval"](0, 100) == (0.0, pytest.approx(1.0 - 0.025**0.01))
    low, high = STUDY["proportion_interval"](100, 100)
    assert (low, high) == (pytest.approx(0.025**0.01), 1.0)


def test_campaign_is_drawn_from_stated_priors():
    first, second = (STUDY["CASES"][0].description(seed) for seed in (0, 1))
    assert first != second
    row = STUDY["run_trials"](STUDY["CASES"][0], 2)
    assert row.counts["contradicted"] == 0
    assert row.trials == 2
