"""A campaign of long records, whole process: against reading it, and against a peer.

    python benchmarks/calibrate.py          # 1e6 rows of CSV, 1e7 of Parquet
    python benchmarks/calibrate.py --full   # 1e7 rows of CSV, 1e8 of Parquet

These things happen to the same files, each in a fresh process, in turn: polars sums their columns;
their SHA-256 is taken; polars decodes them while that goes on; where there is a C++ compiler, a
parser that checks nothing reads the CSV (`csv_limit.cpp`); counterspin reads, checks and reduces
them, and identifies the rotation; `counterspin calibrate` does all that it does (that, checksums,
joint fit, comparison with the two-stage method, report); the peer does what a laboratory's script
would.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import tempfile
from pathlib import Path

from process import COUNTERSPIN, PYTHON, interleaved, measure
from table import Cell, Table, script

TRUTH_K_II = 2e-5

READ = """
import sys, polars as pl
scan = pl.scan_csv if sys.argv[2] == ".csv" else pl.scan_parquet
files = [f"{sys.argv[1]}/run{n}{sys.argv[2]}" for n in range(3)]
scan(files).select(pl.all().sum()).collect(engine="streaming")
"""

# The least that decoding and checksums can take on all cores: nothing is checked, nothing kept.
LEAST = """
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

HASH = """
import hashlib, pathlib, sys
for file in pathlib.Path(sys.argv[1]).glob("run*"):
    with file.open("rb") as opened:
        hashlib.file_digest(opened, "sha256")
"""

# One thread for matrices, as the command has it.
REDUCE = """
import os, sys
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
from counterspin.campaign.description import read_campaign
from counterspin.calibration.observed_runs import observe_runs
for run in observe_runs(read_campaign(sys.argv[1])):
    pass
"""


def tables(full: bool = False, repeats: int | None = None) -> list[Table]:
    """Measure both formats."""
    sizes = {".csv": 1e7, ".parquet": 1e8} if full else {".csv": 1e6, ".parquet": 1e7}
    found = [_column(suffix, int(size), repeats or 5) for suffix, size in sizes.items()]
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
    columns = ["", *(f"{size:.0e} rows, {suffix[1:]}" for suffix, size in sizes.items())]
    rows = [[label, *(column[label] for column in found)] for label in found[0]]
    return [Table("Long records", remark, columns, rows)]


def _column(suffix: str, size: int, repeats: int) -> dict[str, Cell]:
    here = Path(__file__).parent
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # In a process of its own, so that this one stays small: see `process`.
        make = [*PYTHON, str(here / "make_campaign.py"), name, str(size), suffix]
        subprocess.run(make, check=True)
        megabytes = sum(file.stat().st_size for file in folder.glob(f"*{suffix}")) / 1e6
        result = folder / "result.json"
        jobs = {
            "read": [*PYTHON, "-c", READ, name, suffix],
            "reduce": [*PYTHON, "-c", REDUCE, name],
            "hash": [*PYTHON, "-c", HASH, name],
            "least": [*PYTHON, "-c", LEAST, name, suffix],
            "ours": [*COUNTERSPIN, "calibrate", name, "--json", str(result), "--overwrite"],
        }
        if suffix == ".csv" and (parser := _compiled(folder)):
            jobs["parser"] = [parser, *map(str, folder.glob("*.csv"))]
        found = interleaved(jobs, repeats)
        # By itself: what it leaves of memory and cache would slow down whoever comes next.
        peer = measure([*PYTHON, str(here / "peer.py"), name, suffix], 1)
        k_ii = json.loads(result.read_text("utf-8"))["accelerometers"]["Qx"]["coefficients"]["K_II"]
    read, ours, parser_cpu = found["read"], found["ours"], None
    if "parser" in found:
        parser_cpu = found["parser"].cpu
    their = json.loads(peer.output)
    return {
        "three files (MB)": megabytes,
        "polars reads and sums (s)": read.fastest,
        "counterspin reads and reduces (s)": found["reduce"].fastest,
        "counterspin calibrate (s)": ours.fastest,
        "peer (s)": peer.fastest,
        "calibrate / polars": ours.fastest / read.fastest,
        "polars decodes with concurrent SHA-256 / polars": found["least"].fastest / read.fastest,
        "calibrate / (polars decodes with concurrent SHA-256)": ours.fastest
        / found["least"].fastest,
        "calibrate / polars, processor time": ours.cpu / read.cpu,
        "calibrate / (polars decodes with concurrent SHA-256), processor time": (
            ours.cpu / found["least"].cpu
        ),
        "polars reads and sums, processor time (s)": read.cpu,
        "calibrate, processor time (s)": ours.cpu,
        "SHA-256 alone, processor time (s)": found["hash"].cpu,
        "C++ parser alone, processor time (s)": parser_cpu,
        "calibrate / (C++ parser + SHA-256), processor time": (
            None if parser_cpu is None else ours.cpu / (parser_cpu + found["hash"].cpu)
        ),
        "reads and reduces / polars": found["reduce"].fastest / read.fastest,
        "peer / calibrate": peer.fastest / ours.fastest,
        "calibrate, peak memory (MB)": ours.peak,
        "peer, peak memory (MB)": peer.peak,
        "calibrate: u of K_II (g/g²)": k_ii["u"],
        "calibrate: error of K_II / u": (k_ii["value"] - TRUTH_K_II) / k_ii["u"],
        "peer: u of K_II (g/g²)": their["u"],
        "peer: error of K_II / u": (their["K_II"] - TRUTH_K_II) / their["u"],
    }


def _compiled(folder: Path) -> str | None:
    """Return the parser in C++, or None where nothing compiles it."""
    compiler, parser = shutil.which("c++"), folder / "csv_limit"
    source = str(Path(__file__).with_name("csv_limit.cpp"))
    options = ["-O3", "-std=c++17", "-o", str(parser)]
    if compiler is None or subprocess.run([compiler, *options, source], check=False).returncode:
        return None
    return str(parser)


if __name__ == "__main__":
    script(__doc__.splitlines()[0], tables)
