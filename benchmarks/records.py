"""Reading a long record, against what polars needs merely to read the file and sum its columns.

Writes the records to a temporary folder, times both in fresh processes in turn (the fastest of
some repetitions of each, so that both meet a warm file cache), and prints a Markdown table.

    python benchmarks/records.py                       # 1e6 rows of CSV, 1e7 of Parquet
    python benchmarks/records.py --full -o records.md  # 1e7 rows of CSV, 1e8 of Parquet
"""

import argparse
import json
import math
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import polars as pl

RATE = math.pi / 2
RADIUS = 2.5
DURATION = 400.0  # s, a hundred revolutions
COLUMNS = ("time_s", "angle_rad", "east_m")

TIMED = """
import json, resource, sys, time
begin = time.perf_counter()
{work}
wall = time.perf_counter() - begin
unit = 1e6 if sys.platform == "darwin" else 1e3  # macOS gives bytes, Linux kilobytes
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
print(json.dumps(dict(wall=wall, cpu=time.process_time(), peak=peak, samples=samples)))
"""

PEER = TIMED.format(
    work="""
import polars as pl
path = sys.argv[1]
frame = pl.scan_parquet(path) if path.endswith("parquet") else pl.scan_csv(path)
frame.select(pl.all().sum()).collect(engine="streaming")
samples = 0
"""
)

OURS = TIMED.format(
    work=f"""
import numpy as np
from counterspin.campaign.records import ColumnSpec, read_record
record = read_record(
    sys.argv[1], ColumnSpec("time_s"), ColumnSpec("angle_rad"), {{"Qx": ColumnSpec("east_m")}},
    nominal_rate={RATE!r}, radius={RADIUS!r}, input_axes={{"Qx": np.array([1.0, 0.0, 0.0])}},
)
samples = len(record.time)
"""
)


def write_record(path: Path, rows: int) -> None:
    """Write a record of `rows` rows, a part at a time."""
    rng = np.random.default_rng(1)
    part = 2_000_000
    names = []
    for start in range(0, rows, part):
        time = np.arange(start, min(start + part, rows)) * (DURATION / rows)
        angle = RATE * time + 1e-6 * rng.standard_normal(len(time))
        east = RADIUS * np.cos(RATE * time) + 0.01 * rng.standard_normal(len(time))
        frame = pl.DataFrame(dict(zip(COLUMNS, (time, angle, east), strict=True)))
        if path.suffix == ".csv":
            with path.open("ab") as file:
                frame.write_csv(file, float_precision=9, include_header=start == 0)
        else:
            names.append(path.with_name(f"part{start}.parquet"))
            frame.write_parquet(names[-1])
    if names:
        pl.scan_parquet(names).sink_parquet(path)
        for name in names:
            name.unlink()


def measure(script: str, path: Path) -> dict[str, float]:
    """Run a script in a fresh process and return what it measured of itself."""
    done = subprocess.run(
        [sys.executable, "-c", script, str(path)], check=True, capture_output=True, text=True
    )
    return json.loads(done.stdout)


def compare(path: Path, repeats: int) -> str:
    """Return a row of the table for one file."""
    pairs = [(measure(PEER, path), measure(OURS, path)) for _ in range(repeats)]
    peer, ours = (min(runs, key=lambda run: run["wall"]) for runs in zip(*pairs, strict=True))
    rows = pl.scan_parquet(path) if path.suffix == ".parquet" else pl.scan_csv(path)
    count = rows.select(pl.len()).collect().item()
    return (
        f"| {path.suffix[1:]} | {count:.0e} | {path.stat().st_size / 1e6:.0f} "
        f"| {peer['wall']:.2f} | {ours['wall']:.2f} | {ours['wall'] / peer['wall']:.2f} "
        f"| {ours['cpu'] / peer['cpu']:.2f} | {peer['peak']:.0f} | {ours['peak']:.0f} "
        f"| {ours['samples']} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--full", action="store_true", help="1e7 rows of CSV, 1e8 of Parquet")
    parser.add_argument("--csv", type=float, help="rows of CSV")
    parser.add_argument("--parquet", type=float, help="rows of Parquet")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("-o", "--output", type=Path, help="file for the table")
    chosen = parser.parse_args()
    sizes = {
        ".csv": int(chosen.csv or (1e7 if chosen.full else 1e6)),
        ".parquet": int(chosen.parquet or (1e8 if chosen.full else 1e7)),
    }
    table = [
        "| file | rows | MB | sum (s) | record (s) | ratio | CPU ratio "
        "| sum, peak MB | record, peak MB | samples out |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    with tempfile.TemporaryDirectory() as folder:
        for suffix, rows in sizes.items():
            path = Path(folder) / f"record{suffix}"
            write_record(path, rows)
            table.append(compare(path, chosen.repeats))
            path.unlink()
    text = "\n".join(table) + "\n"
    print(text)
    if chosen.output:
        chosen.output.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
