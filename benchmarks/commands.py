"""Time the commands on a typical campaign, as whole processes.

    python benchmarks/commands.py

The campaign has three rates of 100 revolutions each at 50 Hz, and two accelerometers: 35,000 rows
with 70,000 displacements. Unstated terms are fixed at nominal (`assume = "all"`), except in a
second campaign with the same records. Two more campaigns have white noise and a random walk:
stated in one, and estimated by restricted maximum likelihood in the other.
"""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

from header import EAST, NORTH, header
from process import COUNTERSPIN, PYTHON, measure_interleaved
from table import Table, run_script

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
WHITE_NOISE = """
[noise]
displacement = "0.01 m"
[truth.noise]
displacement = "0.01 m"
angle = "1e-6 rad"
"""
STATED_NOISE = """
[noise]
displacement = "0.01 m"
acceleration = "3e-6 g/Hz^0.5"
"""
TRUE_NOISE = """
[truth.noise]
displacement = "0.01 m"
acceleration = "3e-6 g/Hz^0.5"
angle = "1e-6 rad"
"""

ASSUME_ALL = 'assume = "all"\n'
START_UP = "Python with NumPy, scipy.linalg, polars, Pydantic"
STATED_NOISE_JOB = "counterspin calibrate, two noise types, stated"
#: One thread, as in counterspin: idle BLAS threads use processor time.
IMPORTS = (
    "import os; os.environ.setdefault('OPENBLAS_NUM_THREADS', '1'); "
    "import numpy, scipy.linalg, polars, pydantic"
)


def tables(full: bool = False, repeats: int | None = None) -> list[Table]:
    """Return the table of the commands."""
    del full
    with tempfile.TemporaryDirectory() as parent:
        campaigns = {
            "typical": DESCRIPTION + WHITE_NOISE,
            "no assumptions": DESCRIPTION.replace(ASSUME_ALL, "") + WHITE_NOISE,
            "stated noise": DESCRIPTION + STATED_NOISE + TRUE_NOISE,
            "estimated noise": DESCRIPTION + TRUE_NOISE,
        }
        folders = {name: str(Path(parent) / name) for name in campaigns}
        for folder, text in zip(folders.values(), campaigns.values(), strict=True):
            Path(folder).mkdir()
            (Path(folder) / "campaign.toml").write_text(text + RUNS, encoding="utf-8")
            simulate = [*COUNTERSPIN, "simulate", folder, "-o", folder]
            subprocess.run(simulate, check=True, stdout=subprocess.DEVNULL)
        output_folder = str(Path(parent) / "again")
        calibrate = [*COUNTERSPIN, "calibrate"]
        # Label -> command, target of the time in s, target of the ratio, label of the reference.
        jobs: dict[str, tuple[list[str], float | None, float | None, str]] = {
            START_UP: ([*PYTHON, "-c", IMPORTS], None, None, START_UP),
            "counterspin --help": ([*COUNTERSPIN, "--help"], 0.3, None, START_UP),
            "counterspin simulate": (
                [*COUNTERSPIN, "simulate", folders["typical"], "-o", output_folder, "--overwrite"],
                1.0,
                None,
                START_UP,
            ),
            "counterspin calibrate": ([*calibrate, folders["typical"]], 1.5, 1.35, START_UP),
            "counterspin calibrate, nothing assumed": (
                [*calibrate, folders["no assumptions"]],
                None,
                1.6,
                START_UP,
            ),
            "counterspin calibrate --method two-stage": (
                [*calibrate, folders["typical"], "--method", "two-stage"],
                None,
                None,
                START_UP,
            ),
            STATED_NOISE_JOB: ([*calibrate, folders["stated noise"]], None, None, START_UP),
            "counterspin calibrate, two noise types, estimated": (
                [*calibrate, folders["estimated noise"]],
                3.0,
                1.5,
                STATED_NOISE_JOB,
            ),
        }
        measurements = measure_interleaved(
            {job: command for job, (command, *_) in jobs.items()}, repeats or 5
        )
    rows = [
        [
            job,
            measurements[job].median,
            measurements[job].fastest,
            measurements[job].fastest / measurements[reference].fastest,
            measurements[job].cpu_time / measurements[reference].cpu_time,
            target_time,
            target_ratio,
            measurements[job].peak_memory,
        ]
        for job, (_, target_time, target_ratio, reference) in jobs.items()
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
    run_script(__doc__.splitlines()[0], tables)
