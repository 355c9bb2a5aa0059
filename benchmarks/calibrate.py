"""Time the calibration of long records, and compare it with reading alone and with a peer.

    python benchmarks/calibrate.py          # 1e6 rows of CSV, 1e7 of Parquet
    python benchmarks/calibrate.py --full   # 1e7 rows of CSV, 1e8 of Parquet

Each command runs in a new process on the same files, and the commands alternate:

- polars sums the columns
- SHA-256 of the files
- polars decodes the files, with concurrent SHA-256
- a parser without checks reads the CSV (`csv_limit.cpp`), if there is a C++ compiler
- counterspin reads, checks and reduces the records, and identifies the rotation
- `counterspin calibrate`: in addition, checksums, joint fit, two-stage method and report
- the peer: a typical script of a laboratory
"""

from __future__ import annotations

import json
import shutil
import subprocess
import tempfile
from pathlib import Path

from process import COUNTERSPIN, PYTHON, measure, measure_interleaved
from table import Cell, Table, run_script

HERE = Path(__file__).parent

TRUTH_K_II = 2e-5

READ_SCRIPT = """
import sys, polars as pl
scan = pl.scan_csv if sys.argv[2] == ".csv" else pl.scan_parquet
files = [f"{sys.argv[1]}/run{n}{sys.argv[2]}" for n in range(3)]
scan(files).select(pl.all().sum()).collect(engine="streaming")
"""

# Lower limit for decoding and checksums on all cores: without checks, the data is discarded.
DECODE_SCRIPT = """
import sys, threading, hashlib
files = [f"{sys.argv[1]}/run{n}{sys.argv[2]}" for n in range(3)]
def checksum(file):
    with open(file, "rb") as opened:
        hashlib.file_digest(opened, "sha256")
threads = [threading.Thread(target=checksum, args=(file,)) for file in files]
for thread in threads:
    thread.start()
import polars as pl
scan = pl.scan_csv if sys.argv[2] == ".csv" else pl.scan_parquet
for file in files:
    for batch in scan(file).collect_batches():
        pass
for thread in threads:
    thread.join()
"""

HASH_SCRIPT = """
import hashlib, pathlib, sys
for file in pathlib.Path(sys.argv[1]).glob("run*"):
    with file.open("rb") as opened:
        hashlib.file_digest(opened, "sha256")
"""

# One thread for linear algebra, as in the command.
REDUCE_SCRIPT = """
import os, sys
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
from counterspin.campaign.description import read_campaign
from counterspin.calibration.observed_runs import observe_runs
for run in observe_runs(read_campaign(sys.argv[1])):
    pass
"""


def tables(full: bool = False, repeats: int | None = None) -> list[Table]:
    """Return the table of both formats."""
    sizes = {".csv": 1e7, ".parquet": 1e8} if full else {".csv": 1e6, ".parquet": 1e7}
    format_columns = [
        _measure_format(suffix, int(size), repeats or 5) for suffix, size in sizes.items()
    ]
    remark = (
        "The records contain time, angle and displacement for 400 s at each of three rates, "
        "with 0.01 m of noise. Times are for a whole process, with the files in the "
        "system cache. Repetitions of different processes alternate, and the table gives "
        "the fastest repetition. The peer, `benchmarks/peer.py`, is a one-off script based on "
        "NumPy and pandas. The C++ parser, `benchmarks/csv_limit.cpp`, together with SHA-256 gives "
        "a lower limit for the processing time of these files on one core without checks. The "
        "targets for calibrate are at most 1.7 times the time of polars, and less than 1000 MB of "
        "memory."
    )
    headings = ["", *(f"{size:.0e} rows, {suffix[1:]}" for suffix, size in sizes.items())]
    rows = [[label, *(column[label] for column in format_columns)] for label in format_columns[0]]
    return [Table("Long records", remark, headings, rows)]


def make_campaign(folder: str, n_rows: int, suffix: str) -> None:
    """Write a campaign in a separate process, so that this one stays small (see `process`)."""
    script = str(HERE / "make_campaign.py")
    subprocess.run([*PYTHON, script, folder, str(n_rows), suffix], check=True)


def _measure_format(suffix: str, n_rows: int, repeats: int) -> dict[str, Cell]:
    with tempfile.TemporaryDirectory() as folder_name:
        folder = Path(folder_name)
        make_campaign(folder_name, n_rows, suffix)
        megabytes = sum(file.stat().st_size for file in folder.glob(f"*{suffix}")) / 1e6
        result_file = folder / "result.json"
        commands = {
            "sum": [*PYTHON, "-c", READ_SCRIPT, folder_name, suffix],
            "reduce": [*PYTHON, "-c", REDUCE_SCRIPT, folder_name],
            "hash": [*PYTHON, "-c", HASH_SCRIPT, folder_name],
            "decode": [*PYTHON, "-c", DECODE_SCRIPT, folder_name, suffix],
            "calibrate": [
                *COUNTERSPIN,
                "calibrate",
                folder_name,
                "--json",
                str(result_file),
                "--overwrite",
            ],
        }
        if suffix == ".csv" and (parser := _compile_parser(folder)):
            commands["parser"] = [parser, *map(str, folder.glob("*.csv"))]
        measurements = measure_interleaved(commands, repeats)
        # Not interleaved: its use of memory and cache would slow down the next process.
        peer_measurement = measure([*PYTHON, str(HERE / "peer.py"), folder_name, suffix], 1)
        k_ii = json.loads(result_file.read_text("utf-8"))["accelerometers"]["Qx"]["coefficients"][
            "K_II"
        ]
    reading, calibration, parser_cpu = measurements["sum"], measurements["calibrate"], None
    if "parser" in measurements:
        parser_cpu = measurements["parser"].cpu_time
    peer_result = json.loads(peer_measurement.output)
    return {
        "three files (MB)": megabytes,
        "polars reads and sums (s)": reading.fastest,
        "counterspin reads and reduces (s)": measurements["reduce"].fastest,
        "counterspin calibrate (s)": calibration.fastest,
        "peer (s)": peer_measurement.fastest,
        "calibrate / polars": calibration.fastest / reading.fastest,
        "polars decodes with concurrent SHA-256 / polars": measurements["decode"].fastest
        / reading.fastest,
        "calibrate / (polars decodes with concurrent SHA-256)": calibration.fastest
        / measurements["decode"].fastest,
        "calibrate / polars, processor time": calibration.cpu_time / reading.cpu_time,
        "calibrate / (polars decodes with concurrent SHA-256), processor time": (
            calibration.cpu_time / measurements["decode"].cpu_time
        ),
        "polars reads and sums, processor time (s)": reading.cpu_time,
        "calibrate, processor time (s)": calibration.cpu_time,
        "SHA-256 alone, processor time (s)": measurements["hash"].cpu_time,
        "C++ parser alone, processor time (s)": parser_cpu,
        "calibrate / (C++ parser + SHA-256), processor time": (
            None
            if parser_cpu is None
            else calibration.cpu_time / (parser_cpu + measurements["hash"].cpu_time)
        ),
        "reads and reduces / polars": measurements["reduce"].fastest / reading.fastest,
        "peer / calibrate": peer_measurement.fastest / calibration.fastest,
        "calibrate, peak memory (MB)": calibration.peak_memory,
        "peer, peak memory (MB)": peer_measurement.peak_memory,
        "calibrate: u of K_II (g/g²)": k_ii["u"],
        "calibrate: error of K_II / u": (k_ii["value"] - TRUTH_K_II) / k_ii["u"],
        "peer: u of K_II (g/g²)": peer_result["u"],
        "peer: error of K_II / u": (peer_result["K_II"] - TRUTH_K_II) / peer_result["u"],
    }


def _compile_parser(folder: Path) -> str | None:
    """Compile the C++ parser; return its path, or None without a working compiler."""
    compiler, parser = shutil.which("c++"), folder / "csv_limit"
    source = str(Path(__file__).with_name("csv_limit.cpp"))
    options = ["-O3", "-std=c++17", "-o", str(parser)]
    if compiler is None or subprocess.run([compiler, *options, source], check=False).returncode:
        return None
    return str(parser)


if __name__ == "__main__":
    run_script(__doc__.splitlines()[0], tables)
