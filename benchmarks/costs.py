"""What a calibration takes against the samples of its records; and the figure of all costs.

    python benchmarks/costs.py          # 1e4 to 1e6 rows
    python benchmarks/costs.py --full   # 1e4 to 1e7 rows

The same three jobs as in `calibrate.py`, each a whole process, on records in Parquet.
"""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

from calibrate import READ
from process import COUNTERSPIN, PYTHON, interleaved
from table import Table, script

HERE = Path(__file__).parent

TRIALS, SAMPLES = "Cost against trials", "Cost against samples"


def tables(full: bool = False, repeats: int | None = None) -> list[Table]:
    """Time whole calibrations of short and long records."""
    rows = []
    for power in range(4, 8 if full else 7):
        size = 10**power
        with tempfile.TemporaryDirectory() as name:
            make = [*PYTHON, str(HERE / "make_campaign.py"), name, str(size), ".parquet"]
            subprocess.run(make, check=True)
            found = interleaved(
                {
                    "counterspin calibrate": [*COUNTERSPIN, "calibrate", name],
                    "polars reads and sums": [*PYTHON, "-c", READ, name, ".parquet"],
                    "script with NumPy and pandas": [
                        *PYTHON,
                        str(HERE / "peer.py"),
                        name,
                        ".parquet",
                    ],
                },
                repeats or 3,
            )
        rows += [[way, size, measured.fastest] for way, measured in found.items()]
    remark = (
        "Times are for a whole process that reads Parquet files, including the start "
        "of Python. The table gives the fastest of three repetitions."
    )
    return [Table(SAMPLES, remark, ["process", "samples", "seconds"], rows)]


def draw(results: Sequence[Table], file: Path) -> None:
    """Draw both costs, log-log, as SVG."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context({"svg.hashsalt": "counterspin", "svg.fonttype": "none", "font.size": 9.0}):
        figure = Figure(figsize=(7.0, 6.6), layout="constrained")
        for axes, title in zip(figure.subplots(2, 1), (TRIALS, SAMPLES), strict=True):
            (table,) = [one for one in results if one.title == title]
            for way in dict.fromkeys(row[0] for row in table.rows):
                points = [(row[1], row[2]) for row in table.rows if row[0] == way]
                axes.loglog(*zip(*points, strict=True), "o-", markersize=3, label=way)
            axes.set_xlabel(table.columns[1])
            axes.set_ylabel("time / s")
            axes.grid(which="major", color="0.9")
            axes.spines[["top", "right"]].set_visible(False)
            axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
        file.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(file, metadata={"Creator": "counterspin", "Date": None})


if __name__ == "__main__":
    script(__doc__.splitlines()[0], tables)
