"""Measure the load of `counterspin watch` while a recorder writes 1000 rows a second.

    python benchmarks/watching.py [--seconds 100]   # also writes to build/benchmarks
    python benchmarks/watching.py --keep            # for a release: updates the documentation

Two runs are complete; a second process writes the third run in small pieces, as a recorder does.
The table shows the processor time as a share of the elapsed time, including the start, the delay
of the last state, and u of K_II relative to that of `calibrate`.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import counterspin as cs
from table import Table, render, save

ROWS_PER_SECOND = 1000


def simulate_campaign(folder, duration):
    """Return the folder of a simulated campaign with runs of `duration` seconds."""
    description = cs.init(folder / "starter")
    starter = cs.read_campaign(description)
    assert starter.source is not None
    runs = [run | {"duration": f"{duration} s"} for run in starter.source.document["runs"]]
    sampling = {"sampling_rate": f"{ROWS_PER_SECOND} Hz", "revolutions": None}
    changed_campaign = starter.change({"simulation": sampling, "runs": runs})
    cs.simulate(changed_campaign).write(folder / "records")
    return folder / "records"


def write_slowly(source_path, target_path):
    """Copy a record at the rate of the recorder, in pieces of any length."""
    content = source_path.read_bytes()
    header_length = content.index(b"\n") + 1
    bytes_per_second = (len(content) - header_length) * ROWS_PER_SECOND / content.count(b"\n")
    with target_path.open("wb", buffering=0) as file:
        file.write(content[:header_length])
        n_written, start = header_length, time.monotonic()
        while n_written < len(content):
            time.sleep(0.02)
            n_due = min(
                header_length + int((time.monotonic() - start) * bytes_per_second), len(content)
            )
            file.write(content[n_written:n_due])
            n_written = n_due
    print(time.time())


def main(seconds, keep):
    """Run recorder and watch; print and store the table."""
    with tempfile.TemporaryDirectory() as parent:
        folder = simulate_campaign(Path(parent), seconds)
        complete_record, growing_record = folder / "whole", max(folder.glob("run3.*"))
        growing_record.rename(complete_record)
        writer = subprocess.Popen(
            [sys.executable, __file__, "--write", str(complete_record), str(growing_record)],
            stdout=subprocess.PIPE,
        )
        start = time.monotonic()
        watch = subprocess.Popen(
            [sys.executable, "-m", "counterspin", "watch", str(folder), "--json-lines"],
            stdout=subprocess.PIPE,
        )
        assert watch.stdout is not None
        states = [(time.time(), json.loads(line)) for line in watch.stdout]
        _, status, usage = os.wait4(watch.pid, 0)
        wall_time = time.monotonic() - start
        last_write_time = float(writer.communicate()[0])
        assert status == 0
        result = cs.calibrate(folder).coefficient("Qx.K_II")
        (last_coefficient,) = states[-1][1]["coefficients"]
        cpu_time = usage.ru_utime + usage.ru_stime
        figures = {
            "rows a second": ROWS_PER_SECOND,
            "states": len(states),
            "processor time, s": round(cpu_time, 2),
            "time, s": round(wall_time, 1),
            "share of a core, %": round(100.0 * cpu_time / wall_time, 1),
            "time from the last row to the last state, s": round(
                states[-1][0] - last_write_time, 1
            ),
            "relative difference of u(K_II) from that of calibrate": last_coefficient["u"]
            / result.u
            - 1.0,
            "memory, MB": round(usage.ru_maxrss / 1024),
        }
        table = Table(
            "Watched campaign",
            "The script `benchmarks/watching.py` measures `counterspin watch` while a second "
            "process writes the third run of the campaign.",
            ["", "measured"],
            [[name, figure] for name, figure in figures.items()],
        )
        print(render([table]))
        save([table], keep)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--write"]:
        write_slowly(*map(Path, sys.argv[2:4]))
    else:
        parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
        parser.add_argument("--seconds", type=int, default=100)
        parser.add_argument("--keep", action="store_true", help="update the documentation")
        options = parser.parse_args()
        main(options.seconds, options.keep)
