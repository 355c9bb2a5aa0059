"""Uncertainties and intervals have the coverage that the page on methods states."""

import math
import runpy
from pathlib import Path

import numpy as np
import pytest

DOCS = Path(__file__).parents[1] / "docs"
STUDY = runpy.run_path(str(DOCS / "coverage.py"))
TABLE = STUDY["TABLE"]
STORED_ROWS = TABLE.load()

every_row = pytest.mark.parametrize(
    "row", STORED_ROWS, ids=lambda row: f"{row.method}, {row.observable}, {row.label}"
)


def test_page_shows_stored_results():
    page = TABLE.page.read_text("utf-8")
    assert TABLE.insert(STORED_ROWS, page) == page


def test_table_contains_all_cases():
    assert [(row.method, row.observable, row.label) for row in STORED_ROWS] == [
        (case.method, case.observable, case.label) for case in STUDY["CASES"]
    ]


@every_row
def test_u_matches_scatter(row):
    # All coefficients: within 5 % plus the band; each coefficient: within its standard error.
    assert row.normal < 1.05 + row.normal_band
    if row.has_hidden_noise:
        return  # u includes noise that may be absent
    assert row.normal > 0.95 - row.normal_band
    for symbol, rms in row.normal_rms.items():
        assert rms == pytest.approx(1.0, abs=4.0 * row.se), symbol


@every_row
def test_intervals_have_coverage(row):
    tolerance = 3.5 * math.sqrt(0.05 * 0.95 / row.n_errors)
    for symbol, coverage in row.covered.items():
        assert coverage > 0.95 - tolerance, symbol
        assert coverage < 0.95 + tolerance or row.has_hidden_noise, symbol


def test_normal_equivalent_has_same_probability():
    # Student's distribution with 2 degrees of freedom: 97.5 % at 4.302653.
    z = STUDY["normal_equivalent"](np.array([4.302653, -4.302653, 1.5]), np.array([2, 2, 1e9]))
    np.testing.assert_allclose(z, [1.959964, -1.959964, 1.5], rtol=1e-6)


def test_trials_and_errors_are_counted():
    case = STUDY["CASES"][0]
    pairs = {"K_F": [(1.0, 1e9), (2.0, 1e9), (0.0, 1e9), (3.0, 1e9)]}
    row = STUDY["summarise_errors"](case, pairs)
    assert row.trials == 2
    assert row.n_errors == 4
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
        if (case.method, case.label) == (method, "white noise and random walk, stated")
    )
    row = STUDY["run_trials"](case, 8)
    n = row.n_errors
    for symbol, rms in row.z_rms.items():
        # chi-square of 16 errors: beyond 4 standard deviations once in 1e4
        assert abs(rms**2 * n - n) < 5.0 * math.sqrt(2.0 * n), symbol
