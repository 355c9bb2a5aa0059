"""The figures of docs/benchmarks.md are those of the run that is kept."""

import runpy
from pathlib import Path

import pytest
from prose import find_numbers, parse_number

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def table():
    return runpy.run_path(str(ROOT / "benchmarks" / "table.py"))


@pytest.fixture(scope="module")
def rows(table):
    """Return the figures by title and row name."""
    return {
        one.title: {name: figures for name, *figures in one.rows}
        for one in table["load"](ROOT / "benchmarks")
    }


def test_page_shows_stored_results(table):
    page = (ROOT / "docs" / "benchmarks.md").read_text("utf-8")
    kept = table["load"](ROOT / "benchmarks")
    assert table["insert"](kept, page) == page


def test_stored_results_are_from_full_run(table):
    columns = [one.columns for one in table["load"](ROOT / "benchmarks")]
    assert ["", "1e+07 rows, csv", "1e+08 rows, parquet"] in columns


def test_numbers_have_three_digits(table):
    shown = table["render"]([table["Table"]("T", "R", ["a", "b"], [["x", 1.23456], [2, None]])])
    assert shown == "## T\n\nR\n\n| a | b |\n|---|---:|\n| x | 1.23 |\n| 2 | – |\n"


def test_readme_states_measured_times(rows):
    words = " ".join((ROOT / "README.md").read_text("utf-8").split())
    promised = (
        "less than a second. Calibrating with a hundred million rows in a Parquet file takes four "
        "seconds and 150 MB of memory"
    )
    assert promised in words
    assert rows["A typical campaign"]["counterspin calibrate"][0] < 1.0
    long = {name: cells[1] for name, cells in rows["Long records"].items()}
    assert long["counterspin calibrate (s)"] == pytest.approx(4.0, abs=0.5)
    assert long["calibrate, peak memory (MB)"] == pytest.approx(150.0, abs=25.0)
    assert long["calibrate / polars"] == pytest.approx(2.0, abs=0.2)


def test_plan_page_states_measured_prediction_rate(rows):
    words = " ".join((ROOT / "docs" / "plan.md").read_text("utf-8").split())
    assert "computes more than a thousand predictions per second" in words
    row = rows["Predictions of u"].values()
    assert row
    assert all(a_second > 1000.0 for a_second, _ in row)


def test_watch_page_states_stored_results(rows):
    kept = {name: figure for name, (figure,) in rows["Watched campaign"].items()}
    used, lasted = find_numbers("monitoring", "took {} s of CPU time in {} s, including")
    (share,) = find_numbers("monitoring", "start of the program: **{} % of a core**")
    a_second, late = (
        *find_numbers("monitoring", "a second process writes {} rows per second"),
        *find_numbers("monitoring", "The last state appeared {} s after the last row"),
    )
    assert [parse_number(number) for number in (a_second, used, lasted, share, late)] == [
        kept["rows a second"],
        kept["processor time, s"],
        kept["time, s"],
        kept["share of a core, %"],
        kept["time from the last row to the last state, s"],
    ]
    assert kept["relative difference of u(K_II) from that of calibrate"] == 0.0


def test_application_page_states_stored_results(rows):
    for count, seconds in rows["Records in the application"].items():
        shown = find_numbers("application", f"| {count} | {{}} s | {{}} s | {{}} s |")
        assert [parse_number(number) for number in shown] == seconds
