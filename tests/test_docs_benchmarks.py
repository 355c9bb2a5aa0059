"""The results in docs/benchmarks.md and other pages are those of the stored full run."""

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
    """Return title -> row name -> other cells of the row, for the stored tables."""
    return {
        stored.title: {name: cells for name, *cells in stored.rows}
        for stored in table["load"](ROOT / "benchmarks")
    }


def test_page_shows_stored_results(table):
    page = (ROOT / "docs" / "benchmarks.md").read_text("utf-8")
    stored_tables = table["load"](ROOT / "benchmarks")
    assert table["insert_tables"](stored_tables, page) == page


def test_stored_results_are_from_full_run(table):
    columns = [stored.columns for stored in table["load"](ROOT / "benchmarks")]
    assert ["", "1e+07 rows, csv", "1e+08 rows, parquet"] in columns


def test_numbers_have_three_digits(table):
    markdown = table["render"]([table["Table"]("T", "R", ["a", "b"], [["x", 1.23456], [2, None]])])
    assert markdown == "## T\n\nR\n\n| a | b |\n|---|---:|\n| x | 1.23 |\n| 2 | – |\n"


def test_readme_states_measured_times(rows):
    text = " ".join((ROOT / "README.md").read_text("utf-8").split())
    claim = (
        "less than a second. Calibrating with a hundred million rows in a Parquet file takes four "
        "seconds and 150 MB of memory"
    )
    assert claim in text
    assert rows["A typical campaign"]["counterspin calibrate"][0] < 1.0
    long_records = {name: cells[1] for name, cells in rows["Long records"].items()}
    assert long_records["counterspin calibrate (s)"] == pytest.approx(4.0, abs=0.5)
    assert long_records["calibrate, peak memory (MB)"] == pytest.approx(150.0, abs=25.0)
    assert long_records["calibrate / polars"] == pytest.approx(2.0, abs=0.2)


def test_plan_page_states_measured_prediction_rate(rows):
    text = " ".join((ROOT / "docs" / "plan.md").read_text("utf-8").split())
    assert "computes more than a thousand predictions per second" in text
    cells = rows["Predictions of u"].values()
    assert cells
    assert all(per_second > 1000.0 for per_second, _ in cells)


def test_watch_page_states_stored_results(rows):
    stored = {name: value for name, (value,) in rows["Watched campaign"].items()}
    cpu_time, duration = find_numbers("monitoring", "took {} s of CPU time in {} s, including")
    (share,) = find_numbers("monitoring", "start of the program: **{} % of a core**")
    rows_per_second, delay = (
        *find_numbers("monitoring", "a second process writes {} rows per second"),
        *find_numbers("monitoring", "The last state appeared {} s after the last row"),
    )
    assert [
        parse_number(number) for number in (rows_per_second, cpu_time, duration, share, delay)
    ] == [
        stored["rows a second"],
        stored["processor time, s"],
        stored["time, s"],
        stored["share of a core, %"],
        stored["time from the last row to the last state, s"],
    ]
    assert stored["relative difference of u(K_II) from that of calibrate"] == 0.0


def test_application_page_states_stored_results(rows):
    for n_rows, seconds in rows["Records in the application"].items():
        numbers = find_numbers("application", f"| {n_rows} | {{}} s | {{}} s | {{}} s |")
        assert [parse_number(number) for number in numbers] == seconds
