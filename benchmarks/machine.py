"""Measure the limits of the machine, for comparison with the other benchmarks.

python benchmarks/machine.py
"""

from __future__ import annotations

import os
import platform
from pathlib import Path

from process import PYTHON, measure_interleaved
from table import Cell, Table, run_script

TRIAD_SCRIPT = """
import time, numpy as np
n = 20_000_000
a, b, c = np.zeros(n), np.ones(n), np.ones(n)
best = 1e9
for _ in range(5):
    begin = time.perf_counter()
    np.multiply(c, 3.0, out=a)
    np.add(a, b, out=a)
    best = min(best, time.perf_counter() - begin)
print(5 * 8 * n / best / 1e9)  # the product accesses two arrays, the sum three
"""

NORMALS_SCRIPT = """
import time, numpy as np
generator, n, best = np.random.default_rng(1), 10_000_000, 1e9
out = np.empty(n)
for _ in range(3):
    begin = time.perf_counter()
    generator.standard_normal(n, out=out)
    best = min(best, time.perf_counter() - begin)
print(n / best / 1e6)
"""

TWO_CORES_SCRIPT = """
import time, numpy as np
from concurrent.futures import ThreadPoolExecutor
outs = [np.empty(16384), np.empty(16384)]
generators = [np.random.default_rng(n) for n in range(2)]
def draw(k):  # NumPy releases the GIL
    for _ in range(2000):
        generators[k].standard_normal(out=outs[k])
def seconds(n_threads):
    with ThreadPoolExecutor(n_threads) as pool:
        begin = time.perf_counter()
        list(pool.map(draw, range(n_threads)))
        return time.perf_counter() - begin
print(max(2 * seconds(1) / seconds(2) for _ in range(5)))
"""

CHECKSUM_SCRIPT = """
import hashlib, time
data, best = bytes(1 << 26), 1e9
for _ in range(5):
    begin = time.perf_counter()
    hashlib.sha256(data).digest()
    best = min(best, time.perf_counter() - begin)
print(len(data) / best / 1e9)
"""


def tables(full: bool = False, repeats: int | None = None) -> list[Table]:
    """Return the table of memory, random number and checksum rates."""
    del full
    scripts = {
        "memory, NumPy triad a = b + 3 c, one core (GB/s)": TRIAD_SCRIPT,
        "standard normals, one core (million/s)": NORMALS_SCRIPT,
        "standard normals, ratio of two cores at once to one core": TWO_CORES_SCRIPT,
        "SHA-256, one core (GB/s)": CHECKSUM_SCRIPT,
    }
    commands = {name: [*PYTHON, "-c", code] for name, code in scripts.items()}
    measurements = measure_interleaved(commands, repeats or 1)
    rows: list[list[Cell]] = [
        [name, float(measurement.output)] for name, measurement in measurements.items()
    ]
    return [Table("Limits of the machine", _describe_machine(), ["limit", "measured"], rows)]


def _describe_machine() -> str:
    name = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        models = [line for line in cpuinfo.read_text().splitlines() if "model name" in line]
        name = models[0].partition(":")[2].strip() if models else name
    return (
        f"{name}, {os.cpu_count()} cores, Python {platform.python_version()}, "
        f"{platform.system()}. The load average was {os.getloadavg()[0]:.1f} when the benchmarks "
        "began. "
        "Each value is the best of several passes."
    )


if __name__ == "__main__":
    run_script(__doc__.splitlines()[0], tables)
