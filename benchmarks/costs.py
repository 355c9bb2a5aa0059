"""Time calibrations against the number of samples, and draw the figure of all costs.

    python benchmarks/costs.py          # 1e4 to 1e6 rows
    python benchmarks/costs.py --full   # 1e4 to 1e7 rows

Three of the processes of `calibrate.py`, on Parquet records.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

from calibrate import HERE, READ_SCRIPT, make_campaign
from process import COUNTERSPIN, PYTHON, measure_interleaved
from table import Table, run_script

TRIALS, SAMPLES = "Cost against trials", "Cost against samples"


def tables(full: bool = False, repeats: int | None = None) -> list[Table]:
    """Return the table of calibrations of short and long records."""
    rows = []
    for power in range(4, 8 if full else 7):
        n_rows = 10**power
        with tempfile.TemporaryDirectory() as folder_name:
            make_campaign(folder_name, n_rows, ".parquet")
            measurements = measure_interleaved(
                {
                    "counterspin calibrate": [*COUNTERSPIN, "calibrate", folder_name],
                    "polars reads and sums": [*PYTHON, "-c", READ_SCRIPT, folder_name, ".parquet"],
                    "script with NumPy and pandas": [
                        *PYTHON,
                        str(HERE / "peer.py"),
                        folder_name,
                        ".parquet",
                    ],
                },
                repeats or 3,
            )
        rows += [
            [process, n_rows, measurement.fastest] for process, measurement in measurements.items()
        ]
    remark = (
        "Times are for a whole process that reads Parquet files, including the start "
        "of Python. The table gives the fastest of three repetitions."
    )
    return [Table(SAMPLES, remark, ["process", "samples", "seconds"], rows)]


def draw(tables: Sequence[Table], file: Path) -> None:
    """Draw both cost tables on logarithmic axes, as SVG."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context({"svg.hashsalt": "counterspin", "svg.fonttype": "none", "font.size": 9.0}):
        figure = Figure(figsize=(7.0, 6.6), layout="constrained")
        for axes, title in zip(figure.subplots(2, 1), (TRIALS, SAMPLES), strict=True):
            (table,) = [table for table in tables if table.title == title]
            for process in dict.fromkeys(row[0] for row in table.rows):
                points = [(row[1], row[2]) for row in table.rows if row[0] == process]
                axes.loglog(*zip(*points, strict=True), "o-", markersize=3, label=process)
            axes.set_xlabel(table.columns[1])
            axes.set_ylabel("time / s")
            axes.grid(which="major", color="0.9")
            axes.spines[["top", "right"]].set_visible(False)
            axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
        file.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(file, metadata={"Creator": "counterspin", "Date": None})


if __name__ == "__main__":
    run_script(__doc__.splitlines()[0], tables)
