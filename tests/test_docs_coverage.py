"""Uncertainties and intervals hold, by observable and noise, as the page on methods says."""

import math
import runpy
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"
STUDY = runpy.run_path(str(DOCS / "coverage.py"))
KEPT = STUDY["load"]()

every_row = pytest.mark.parametrize(
    "row", KEPT, ids=lambda row: f"{row.method}, {row.observable}, {row.words}"
)


def test_the_page_shows_what_was_found():
    page = STUDY["PAGE"].read_text("utf-8")
    assert STUDY["insert"](KEPT, page) == page


def test_every_case_is_in_the_table():
    assert [(row.method, row.observable, row.words) for row in KEPT] == [
        (case.method, case.observable, case.words) for case in STUDY["CASES"]
    ]


@every_row
def test_u_is_the_scatter(row):
    # Where noise is found, u counts what may not show: never too small, at most a fifth too large.
    least = 0.95 if row.words.endswith(", stated") else 0.8
    assert least < row.rms < 1.05 + 3.0 * row.se
    if least == 0.95:
        for symbol, size in row.z_rms.items():
            assert size == pytest.approx(1.0, abs=4.0 * row.se), symbol


@every_row
def test_intervals_cover(row):
    within = 3.5 * math.sqrt(0.05 * 0.95 / row.values)
    for symbol, covered in row.covered.items():
        assert covered > 0.95 - within, symbol
        assert covered < 0.95 + within or not row.words.endswith(", stated"), symbol


@pytest.mark.parametrize("index", [2, 11], ids=["joint", "two-stage"])
def test_a_few_trials_scatter_as_they_claim(index):
    case = STUDY["CASES"][index]
    assert case.words == "white and walk, stated"
    row = STUDY["row_of"](case, 8)
    count = row.values
    for symbol, size in row.z_rms.items():
        # chi-square of 16 errors: beyond 4 standard deviations once in 1e4
        assert abs(size**2 * count - count) < 5.0 * math.sqrt(2.0 * count), symbol
