"""How much of a core `counterspin watch` takes beside a recorder that writes 1000 rows a second.

    python benchmarks/watching.py [--seconds 100]   # what is printed is in build/benchmarks too
    python benchmarks/watching.py --keep            # for a release: in benchmarks, for the docs

Two runs are there, the third is written by a second process, line by line in small parts, as a
recorder does. Printed: processor time of the watch over the time it ran, start included; how far
it was behind at its end; and its u of K_II beside that of `calibrate`.
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

ROWS_A_SECOND = 1000


def campaign(folder, seconds):
    """Return the folder of a simulated campaign whose last run lasts so many seconds."""
    description = cs.init(folder / "made")
    starter = cs.read_campaign(description)
    assert starter.source is not None
    runs = [run | {"duration": f"{seconds} s"} for run in starter.source.document["runs"]]
    sampling = {"sampling_rate": f"{ROWS_A_SECOND} Hz", "revolutions": None}
    changed = starter.change({"simulation": sampling, "runs": runs})
    cs.simulate(changed).write(folder / "records")
    return folder / "records"


def write_slowly(source, target):
    """Append a file's lines to another at the rate of the recorder, in parts of any length."""
    content = source.read_bytes()
    begin = content.index(b"\n") + 1
    a_second = (len(content) - begin) * ROWS_A_SECOND / content.count(b"\n")
    with target.open("wb", buffering=0) as file:
        file.write(content[:begin])
        done, start = begin, time.monotonic()
        while done < len(content):
            time.sleep(0.02)
            due = min(begin + int((time.monotonic() - start) * a_second), len(content))
            file.write(content[done:due])
            done = due
    print(time.time())


def main(seconds, keep):
    """Run both and print what was measured."""
    with tempfile.TemporaryDirectory() as place:
        folder = campaign(Path(place), seconds)
        whole, growing = folder / "whole", max(folder.glob("run3.*"))
        growing.rename(whole)
        writer = subprocess.Popen(
            [sys.executable, __file__, "--write", str(whole), str(growing)], stdout=subprocess.PIPE
        )
        begin = time.monotonic()
        watch = subprocess.Popen(
            [sys.executable, "-m", "counterspin", "watch", str(folder), "--json-lines"],
            stdout=subprocess.PIPE,
        )
        assert watch.stdout is not None
        states = [(time.time(), json.loads(line)) for line in watch.stdout]
        _, status, used = os.wait4(watch.pid, 0)
        wall = time.monotonic() - begin
        written = float(writer.communicate()[0])
        assert status == 0
        result = cs.calibrate(folder).coefficient("Qx.K_II")
        (found,) = states[-1][1]["coefficients"]
        cpu = used.ru_utime + used.ru_stime
        figures = {
            "rows a second": ROWS_A_SECOND,
            "states": len(states),
            "processor time, s": round(cpu, 2),
            "time, s": round(wall, 1),
            "share of a core, %": round(100.0 * cpu / wall, 1),
            "time from the last row to the last state, s": round(states[-1][0] - written, 1),
            "relative difference of u(K_II) from that of calibrate": found["u"] / result.u - 1.0,
            "memory, MB": round(used.ru_maxrss / 1024),
        }
        measured = Table(
            "Watched campaign",
            "The script `benchmarks/watching.py` measures `counterspin watch` while a second "
            "process writes the third run of the campaign.",
            ["", "measured"],
            [[name, figure] for name, figure in figures.items()],
        )
        print(render([measured]))
        save([measured], keep)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--write"]:
        write_slowly(*map(Path, sys.argv[2:4]))
    else:
        parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
        parser.add_argument("--seconds", type=int, default=100)
        parser.add_argument("--keep", action="store_true", help="renew what docs quote")
        chosen = parser.parse_args()
        main(chosen.seconds, chosen.keep)
