"""Limits of the machine, to hold the other figures against.

python benchmarks/machine.py
"""

from __future__ import annotations

import os
import platform
from pathlib import Path

from process import PYTHON, interleaved
from table import Cell, Table, script

TRIAD = """
import time, numpy as np
n = 20_000_000
a, b, c = np.zeros(n), np.ones(n), np.ones(n)
best = 1e9
for _ in range(5):
    begin = time.perf_counter()
    np.multiply(c, 3.0, out=a)
    np.add(a, b, out=a)
    best = min(best, time.perf_counter() - begin)
print(5 * 8 * n / best / 1e9)  # two arrays pass in the product, three in the sum
"""

NORMALS = """
import time, numpy as np
generator, n, best = np.random.default_rng(1), 10_000_000, 1e9
out = np.empty(n)
for _ in range(3):
    begin = time.perf_counter()
    generator.standard_normal(n, out=out)
    best = min(best, time.perf_counter() - begin)
print(n / best / 1e6)
"""

TWO_CORES = """
import time, numpy as np
from concurrent.futures import ThreadPoolExecutor
outs = [np.empty(16384), np.empty(16384)]
generators = [np.random.default_rng(n) for n in range(2)]
def work(place):  # NumPy lets the other thread run meanwhile
    for _ in range(2000):
        generators[place].standard_normal(out=outs[place])
def seconds(count):
    with ThreadPoolExecutor(count) as pool:
        begin = time.perf_counter()
        list(pool.map(work, range(count)))
        return time.perf_counter() - begin
print(max(2 * seconds(1) / seconds(2) for _ in range(5)))
"""

CHECKSUM = """
import hashlib, time
data, best = bytes(1 << 26), 1e9
for _ in range(5):
    begin = time.perf_counter()
    hashlib.sha256(data).digest()
    best = min(best, time.perf_counter() - begin)
print(len(data) / best / 1e9)
"""


def tables(full: bool = False, repeats: int | None = None) -> list[Table]:
    """Measure memory, random numbers and checksums, each in a process of its own."""
    del full
    limits = {
        "memory, NumPy triad a = b + 3 c, one core (GB/s)": TRIAD,
        "standard normals, one core (million/s)": NORMALS,
        "standard normals, ratio of two cores at once to one core": TWO_CORES,
        "SHA-256, one core (GB/s)": CHECKSUM,
    }
    commands = {name: [*PYTHON, "-c", code] for name, code in limits.items()}
    found = interleaved(commands, repeats or 1)
    rows: list[list[Cell]] = [[name, float(measured.output)] for name, measured in found.items()]
    return [Table("Limits of the machine", _machine(), ["limit", "measured"], rows)]


def _machine() -> str:
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
    script(__doc__.splitlines()[0], tables)
