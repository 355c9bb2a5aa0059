"""The commands on a campaign of usual size, whole processes.

    python benchmarks/commands.py

Three rates, 100 revolutions each at 50 Hz, two accelerometers: 35,000 rows with 70,000
displacements. What the description does not state is assumed to be perfect (`assume = "all"`), and
in a second campaign of the same records nothing is. In two others the records have noise of two
kinds: one states it, the other leaves it to be estimated by restricted maximum likelihood.
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
STATED = """
[noise]
displacement = "0.01 m"
acceleration = "3e-6 g/Hz^0.5"
"""
MIXED = """
[truth.noise]
displacement = "0.01 m"
acceleration = "3e-6 g/Hz^0.5"
angle = "1e-6 rad"
"""

ASSUMED = 'assume = "all"\n'
STARTING = "Python with NumPy, scipy.linalg, polars, Pydantic"
TWO_KINDS = "counterspin calibrate, two noise types, stated"
#: counterspin sets the number of threads too; without it, idle threads of BLAS use processor time.
IMPORTS = (
    "import os; os.environ.setdefault('OPENBLAS_NUM_THREADS', '1'); "
    "import numpy, scipy.linalg, polars, pydantic"
)


def tables(full: bool = False, repeats: int | None = None) -> list[Table]:
    """Time the commands in turn."""
    del full
    with tempfile.TemporaryDirectory() as name:
        campaigns = {
            "given": DESCRIPTION + GIVEN,
            "nothing": DESCRIPTION.replace(ASSUMED, "") + GIVEN,
            "stated": DESCRIPTION + STATED + MIXED,
            "mixed": DESCRIPTION + MIXED,
        }
        folders = {key: str(Path(name) / key) for key in campaigns}
        for folder, text in zip(folders.values(), campaigns.values(), strict=True):
            Path(folder).mkdir()
            (Path(folder) / "campaign.toml").write_text(text + RUNS, encoding="utf-8")
            simulate = [*COUNTERSPIN, "simulate", folder, "-o", folder]
            subprocess.run(simulate, check=True, stdout=subprocess.DEVNULL)
        out = str(Path(name) / "again")
        calibrate = [*COUNTERSPIN, "calibrate"]
        # The command, target of the time in s, target of its ratio, and to what that is.
        jobs: dict[str, tuple[list[str], float | None, float | None, str]] = {
            STARTING: ([*PYTHON, "-c", IMPORTS], None, None, STARTING),
            "counterspin --help": ([*COUNTERSPIN, "--help"], 0.3, None, STARTING),
            "counterspin simulate": (
                [*COUNTERSPIN, "simulate", folders["given"], "-o", out, "--overwrite"],
                1.0,
                None,
                STARTING,
            ),
            "counterspin calibrate": ([*calibrate, folders["given"]], 1.5, 1.35, STARTING),
            "counterspin calibrate, nothing assumed": (
                [*calibrate, folders["nothing"]],
                None,
                1.6,
                STARTING,
            ),
            "counterspin calibrate --method two-stage": (
                [*calibrate, folders["given"], "--method", "two-stage"],
                None,
                None,
                STARTING,
            ),
            TWO_KINDS: ([*calibrate, folders["stated"]], None, None, STARTING),
            "counterspin calibrate, two noise types, estimated": (
                [*calibrate, folders["mixed"]],
                3.0,
                1.5,
                TWO_KINDS,
            ),
        }
        found = interleaved({job: command for job, (command, *_) in jobs.items()}, repeats or 5)
    rows = [
        [
            job,
            found[job].median,
            found[job].fastest,
            found[job].fastest / found[other].fastest,
            found[job].cpu / found[other].cpu,
            target,
            ratio,
            found[job].peak,
        ]
        for job, (_, target, ratio, other) in jobs.items()
    ]
    remark = (
        "The campaign has three rates of 100 revolutions each at 50 Hz, and two "
        "accelerometers. Times are for a whole process, including the start of "
        "Python. Repetitions of different processes alternate. The first row gives the "
        "start-up time alone. The two ratios are the fastest time and the processor time, "
        "divided by the values in the first row. For the row with estimated noise, the "
        "reference is the same campaign with stated noise. `assume` is `all` unless the row "
        "states otherwise."
    )
    columns = [
        "process",
        "median (s)",
        "fastest (s)",
        "ratio",
        "ratio, processor",
        "target (s)",
        "target of the ratio",
        "peak MB",
    ]
    return [Table("A typical campaign", remark, columns, rows)]


if __name__ == "__main__":
    script(__doc__.splitlines()[0], tables)
