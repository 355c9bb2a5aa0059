"""Uncertainties and intervals hold, by observable and noise, as the page on methods says."""

import math
import runpy
from pathlib import Path

import numpy as np
import pytest

DOCS = Path(__file__).parents[1] / "docs"
STUDY = runpy.run_path(str(DOCS / "coverage.py"))
TABLE = STUDY["TABLE"]
KEPT = TABLE.load()

every_row = pytest.mark.parametrize(
    "row", KEPT, ids=lambda row: f"{row.method}, {row.observable}, {row.words}"
)


def test_page_shows_stored_results():
    page = TABLE.page.read_text("utf-8")
    assert TABLE.insert(KEPT, page) == page


def test_table_contains_all_cases():
    assert [(row.method, row.observable, row.words) for row in KEPT] == [
        (case.method, case.observable, case.words) for case in STUDY["CASES"]
    ]


@every_row
def test_u_matches_scatter(row):
    # Together within 5 %, and within what so few trials leave open; by coefficient within that.
    assert row.normal < 1.05 + row.normal_band
    if row.hidden:
        return  # u has noise that need not be there
    assert row.normal > 0.95 - row.normal_band
    for symbol, size in row.normal_rms.items():
        assert size == pytest.approx(1.0, abs=4.0 * row.se), symbol


@every_row
def test_intervals_have_coverage(row):
    within = 3.5 * math.sqrt(0.05 * 0.95 / row.values)
    for symbol, covered in row.covered.items():
        assert covered > 0.95 - within, symbol
        assert covered < 0.95 + within or row.hidden, symbol


def test_normal_equivalent_has_same_probability():
    # Student's distribution with 2 degrees of freedom: 97.5 % at 4.302653.
    z = STUDY["normal_equivalent"](np.array([4.302653, -4.302653, 1.5]), np.array([2, 2, 1e9]))
    np.testing.assert_allclose(z, [1.959964, -1.959964, 1.5], rtol=1e-6)


def test_trials_and_values_are_counted():
    case = STUDY["CASES"][0]
    pairs = {"K_F": [(1.0, 1e9), (2.0, 1e9), (0.0, 1e9), (3.0, 1e9)]}
    row = STUDY["summarise_errors"](case, pairs)
    assert row.trials == 2
    assert row.values == 4
    assert row.z_rms["K_F"] == pytest.approx(math.sqrt(14 / 4))
    assert row.normal == pytest.approx(row.rms)
    assert row.coverage == 0.5
    # Trials have mean squares of 2.5 and 4.5: their standard deviation is 2^0.5.
    assert row.normal_band == pytest.approx(1.96 / 2.0 / math.sqrt(3.5))


@pytest.mark.parametrize("method", ["joint", "two-stage"])
def test_few_trials_scatter_by_u(method):
    case = next(
        case
        for case in STUDY["CASES"]
        if (case.method, case.words) == (method, "white noise and random walk, stated")
    )
    row = STUDY["run_trials"](case, 8)
    count = row.values
    for symbol, size in row.z_rms.items():
        # chi-square of 16 errors: beyond 4 standard deviations once in 1e4
        assert abs(size**2 * count - count) < 5.0 * math.sqrt(2.0 * count), symbol
