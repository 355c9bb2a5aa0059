"""The commands on a campaign of usual size, whole processes.

    python benchmarks/commands.py

Three rates, 100 revolutions each at 50 Hz, two accelerometers: 35,000 rows with 70,000
displacements. In a second campaign the noise is of two kinds and not stated, so that it is
estimated by restricted maximum likelihood.
"""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

from header import EAST, NORTH, header
from process import COUNTERSPIN, PYTHON, interleaved
from table import Table, script

DESCRIPTION = (
    header("Three rates, two accelerometers", EAST, NORTH)
    + """
[simulation]
sampling_rate = "50 Hz"
revolutions = 100
seed = 1
[truth.Qx]
K_F = "0.0050312 g"
K_I = "1.0019732 g/g"
K_II = "2e-5 g/g^2"
K_III = "3e-6 g/g^3"
[truth.Qy]
K_F = "0.0037432 g"
K_I = "0.9988205 g/g"
K_II = "-1e-5 g/g^2"
K_III = "2e-6 g/g^3"
[truth.spindle]
drift = "1e-6 1/s"
ripple = [{ harmonic = 1, ratio = 5e-7, phase = "30 deg" }]
"""
)
RUNS = "".join(
    f'[[runs]]\nname = "run{n}"\nrate = "{rate} rev/s"\nrecord = "run{n}.csv"\n'
    for n, rate in enumerate((0.25, 0.5, 1))
)
GIVEN = """
[noise]
displacement = "0.01 m"
[truth.noise]
displacement = "0.01 m"
angle = "1e-6 rad"
"""
MIXED = """
[truth.noise]
displacement = "0.01 m"
acceleration = "3e-6 g/Hz^0.5"
angle = "1e-6 rad"
"""

IMPORTS = "import numpy, scipy.linalg, polars, pydantic"


def tables(full: bool = False, repeats: int | None = None) -> list[Table]:
    """Time the commands in turn."""
    del full
    with tempfile.TemporaryDirectory() as name:
        given, mixed = Path(name) / "given", Path(name) / "mixed"
        for folder, noise in ((given, GIVEN), (mixed, MIXED)):
            folder.mkdir()
            text = DESCRIPTION + noise + RUNS
            (folder / "campaign.toml").write_text(text, encoding="utf-8")
            simulate = [*COUNTERSPIN, "simulate", str(folder), "-o", str(folder)]
            subprocess.run(simulate, check=True, stdout=subprocess.DEVNULL)
        out = str(Path(name) / "again")
        jobs: dict[str, tuple[list[str], float | None]] = {
            "Python with NumPy, scipy.linalg, polars, Pydantic": ([*PYTHON, "-c", IMPORTS], None),
            "counterspin --help": ([*COUNTERSPIN, "--help"], 0.3),
            "counterspin simulate": (
                [*COUNTERSPIN, "simulate", str(given), "-o", out, "--overwrite"],
                1.0,
            ),
            "counterspin calibrate": ([*COUNTERSPIN, "calibrate", str(given)], 1.5),
            "counterspin calibrate --method two-stage": (
                [*COUNTERSPIN, "calibrate", str(given), "--method", "two-stage"],
                None,
            ),
            "counterspin calibrate, noise of two kinds estimated": (
                [*COUNTERSPIN, "calibrate", str(mixed)],
                3.0,
            ),
        }
        found = interleaved({job: command for job, (command, _) in jobs.items()}, repeats or 5)
    starting = found[next(iter(jobs))]
    rows = [
        [
            job,
            found[job].median,
            found[job].fastest,
            found[job].fastest / starting.fastest,
            found[job].cpu / starting.cpu,
            target,
            found[job].peak,
        ]
        for job, (_, target) in jobs.items()
    ]
    remark = (
        "Three rates, 100 revolutions each at 50 Hz, two accelerometers. Whole processes that take "
        "turns, start of Python included. The first line is what starting alone costs; the ratios "
        "are to it, of the fastest and of processor time. Target for calibrate: 1.6."
    )
    columns = [
        "process",
        "median (s)",
        "fastest (s)",
        "/ it",
        "/ it, processor",
        "target (s)",
        "peak MB",
    ]
    return [Table("A usual campaign", remark, columns, rows)]


if __name__ == "__main__":
    script(__doc__.splitlines()[0], tables)
