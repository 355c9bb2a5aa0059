"""Time studies of the paper's plan and of the example, and compare them with other methods.

    python benchmarks/study.py          # small
    python benchmarks/study.py --full   # full sizes, to which the targets apply

`study_jobs.py` does the work in a separate process, so that this one stays small (see `process`).
The environment variable SUNCAL_PYTHON may name a Python that has suncal (see `peer_suncal.py`).
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from process import PYTHON
from table import Cell, Table, run_script

HERE = Path(__file__).parent
MILLION = 1e6


def tables(full: bool = False, repeats: int | None = None) -> list[Table]:
    """Return the tables of the trials."""
    repeats = repeats or (7 if full else 3)
    command = [*PYTHON, str(HERE / "study_jobs.py"), "--repeats", str(repeats)]
    process = subprocess.run(
        [*command, *(["--full"] if full else [])], check=True, stdout=subprocess.PIPE, text=True
    )
    timings = json.loads(process.stdout)
    return [
        _tabulate_paper(timings, full),
        _tabulate_examples(timings["examples"]),
        Table(
            "Cost against trials",
            "Times are for one method within a single process, and are the fastest of three "
            "repetitions.",
            ["method", "trials", "seconds"],
            [[row["method"], row["trials"], row["seconds"]] for row in timings["against trials"]],
        ),
    ]


def _tabulate_paper(timings: dict[str, Any], full: bool) -> Table:
    paper = timings["paper"]
    seconds_per_million = {
        method: [MILLION / paper["sizes"][method] * seconds for seconds in times]
        for method, times in paper["times"].items()
    }
    reference_time = seconds_per_million["stated sigma"][0]
    sizes = paper["sizes"]

    def make_row(label: str, method: str, target: Cell, target_ratio: Cell) -> list[Cell]:
        wall, cpu = seconds_per_million[method]
        remark = "" if sizes[method] == MILLION else f", scaled from {sizes[method]:.0e} analyses"
        ratio = None if method == "stated sigma" else wall / reference_time
        return [label + remark, wall, cpu, target, ratio, target_ratio]

    rows = [
        make_row("counterspin study", "stated sigma", 0.25, None),
        make_row(
            "counterspin study, sigma estimated from the residuals", "estimated sigma", None, None
        ),
        make_row("NumPy, all readings, chunks in cache", "brute force", None, 8.0),
        make_row("loop of numpy.linalg.lstsq", "lstsq", None, 100.0),
        make_row("uncertainties package, one analysis at a time", "uncertainties", None, None),
    ]
    n_samples = 100_000 if full else 10_000
    suncal = _run_suncal(timings["linear"], n_samples, paper["u"])
    if suncal is None:
        remark = "suncal was not installed (SUNCAL_PYTHON), so the table does not contain it"
    else:
        wall = MILLION / n_samples * suncal["seconds"]
        name = f"suncal {suncal['version']}, Monte Carlo, scaled from {n_samples:.0e} trials"
        rows.append([name, wall, None, None, wall / reference_time, None])
        remark = (
            "suncal draws the 300 readings of one analysis; "
            "its time does not include the model and the start"
        )
    return Table(
        "A million trials of the paper's plan",
        "The plan has three rates of 100 strobes each, and is analysed by the two-stage method "
        "on one core, within a single process. Each time is the median of several repetitions "
        "that alternate between the methods. All methods yield the same K_II and u. The "
        "`uncertainties` package propagates uncertainties to first order without trials, so its "
        f"time is that for the same number of analyses. {remark}.",
        [
            "method",
            "median (s)",
            "processor (s)",
            "target (s)",
            "ratio to counterspin study",
            "target",
        ],
        rows,
    )


def _run_suncal(linear: dict[str, Any], n_samples: int, u: float) -> dict[str, Any] | None:
    """Return time, u and version of suncal, or None without suncal."""
    python = os.environ.get("SUNCAL_PYTHON")
    if not python:
        return None
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "linear.json"
        file.write_text(json.dumps(linear), encoding="utf-8")
        command = [python, str(HERE / "peer_suncal.py"), str(file), str(n_samples)]
        process = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    result: dict[str, Any] = json.loads(process.stdout)
    # Five standard errors of a standard deviation.
    assert abs(result["u"] / u - 1.0) < 5.0 / (2.0 * n_samples) ** 0.5
    return result


#: Trials of the example -> target of their time, s.
_EXAMPLE_TARGETS = {1000: 5.0, 100_000: 30.0}


def _tabulate_examples(rows: Sequence[dict[str, Any]]) -> Table:
    cells: list[list[Cell]] = []
    previous: dict[str, Any] = {}
    for row in rows:
        is_linear = row["engine"] == "linear"
        order = None
        if is_linear and previous.get("records") == row["records"]:
            order = math.log(row["cpu"] / previous["cpu"], row["trials"] / previous["trials"])
        target = _EXAMPLE_TARGETS.get(row["trials"])
        name = f"{row['records']}, {row['engine']} engine"
        cells.append([name, row["trials"], row["wall"], row["cpu"], target, order])
        previous = row
    return Table(
        "The study of the example",
        "The first study uses the campaign that `counterspin init` writes, with its three "
        "analyses. The second study uses the same campaign with velocity records, which only the "
        "joint fit can analyse. Each time includes the preparation, and is the median within a "
        "single process on one core. The growth order describes the growth of the processor time "
        "relative to the row above.",
        ["study", "trials", "median (s)", "processor (s)", "target (s)", "growth order"],
        cells,
    )


if __name__ == "__main__":
    run_script(__doc__.splitlines()[0], tables)
