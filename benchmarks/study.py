"""Studies: trials of the paper's plan and of the example, against other ways.

    python benchmarks/study.py          # small
    python benchmarks/study.py --full   # the sizes of the targets, and the figure

What is timed within a process is done by `study_jobs.py`, so that this one stays small: see
`process`. A Python that has suncal may be named in the environment as SUNCAL_PYTHON; see
`peer_suncal.py`.
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
from table import Cell, Table, script

HERE = Path(__file__).parent
MILLION = 1e6


def tables(full: bool = False, repeats: int | None = None) -> list[Table]:
    """Time trials by each way."""
    repeats = repeats or (7 if full else 3)
    command = [*PYTHON, str(HERE / "study_jobs.py"), "--repeats", str(repeats)]
    done = subprocess.run(
        [*command, *(["--full"] if full else [])], check=True, stdout=subprocess.PIPE, text=True
    )
    found = json.loads(done.stdout)
    return [
        _paper(found, full),
        _examples(found["examples"]),
        Table(
            "Cost against trials",
            "Times are for one method within a single process, and are the fastest of three "
            "repetitions.",
            ["method", "trials", "seconds"],
            [[row["way"], row["trials"], row["seconds"]] for row in found["against trials"]],
        ),
    ]


def _paper(found: dict[str, Any], full: bool) -> Table:
    paper = found["paper"]
    a_million = {
        way: [MILLION / paper["sizes"][way] * seconds for seconds in taken]
        for way, taken in paper["times"].items()
    }
    ours = a_million["given"][0]
    sizes = paper["sizes"]

    def row(name: str, way: str, target: Cell, ratio: Cell) -> list[Cell]:
        wall, cpu = a_million[way]
        note = "" if sizes[way] == MILLION else f", scaled from {sizes[way]:.0e} analyses"
        return [name + note, wall, cpu, target, None if way == "given" else wall / ours, ratio]

    rows = [
        row("counterspin study", "given", 0.25, None),
        row("counterspin study, sigma estimated from the residuals", "residuals", None, None),
        row("NumPy, all readings, chunks in cache", "brute force", None, 8.0),
        row("loop of numpy.linalg.lstsq", "lstsq", None, 100.0),
        row("uncertainties package, one analysis at a time", "uncertainties", None, None),
    ]
    samples = 100_000 if full else 10_000
    theirs = _suncal(found["linear"], samples, paper["u"])
    if theirs is None:
        remark = "suncal was not installed (SUNCAL_PYTHON), so the table does not contain it"
    else:
        wall = MILLION / samples * theirs["seconds"]
        name = f"suncal {theirs['version']}, Monte Carlo, scaled from {samples:.0e} trials"
        rows.append([name, wall, None, None, wall / ours, None])
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


def _suncal(linear: dict[str, Any], samples: int, u: float) -> dict[str, Any] | None:
    """Return what suncal takes and finds, or None if there is none."""
    python = os.environ.get("SUNCAL_PYTHON")
    if not python:
        return None
    with tempfile.TemporaryDirectory() as name:
        file = Path(name) / "linear.json"
        file.write_text(json.dumps(linear), encoding="utf-8")
        command = [python, str(HERE / "peer_suncal.py"), str(file), str(samples)]
        done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    theirs: dict[str, Any] = json.loads(done.stdout)
    # Five standard errors of a standard deviation.
    assert abs(theirs["u"] / u - 1.0) < 5.0 / (2.0 * samples) ** 0.5
    return theirs


#: Trials of the example -> the longest time that they may take, s.
_EXAMPLE_TARGETS = {1000: 5.0, 100_000: 30.0}


def _examples(rows: Sequence[dict[str, Any]]) -> Table:
    cells: list[list[Cell]] = []
    before: dict[str, Any] = {}
    for row in rows:
        linear = row["engine"] == "linear"
        order = None
        if linear and before.get("records") == row["records"]:
            order = math.log(row["cpu"] / before["cpu"], row["trials"] / before["trials"])
        target = _EXAMPLE_TARGETS.get(row["trials"])
        name = f"{row['records']}, {row['engine']} engine"
        cells.append([name, row["trials"], row["wall"], row["cpu"], target, order])
        before = row
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
    script(__doc__.splitlines()[0], tables)
