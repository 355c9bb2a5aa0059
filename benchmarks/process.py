"""Times and peak memory of whole processes, taken from outside.

- `measure`: runs a command some times, each in a fresh process
- `interleaved`: several commands in turn, so that all meet the same load of the machine

This module imports nothing beside the standard library: a child's peak memory is at least that of
the process that started it.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

#: macOS gives peak memory in bytes, Linux in kilobytes.
_PEAK_UNIT = 1e-6 if sys.platform == "darwin" else 1e-3

#: The command line as a user has it, from the environment that runs the benchmarks.
COUNTERSPIN = [str(Path(sys.executable).with_name("counterspin"))]
PYTHON = [sys.executable]

#: As a user has it: modules are compiled once, not every time. Taken before any benchmark sets its
#: own threads.
_ENVIRONMENT = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}


@dataclass(frozen=True)
class Measured:
    """Repetitions of one command.

    Attributes
    ----------
    walls, cpus
        Elapsed and processor time of each, s.
    peak
        Largest resident memory of any, MB.
    output
        Standard output of the last.
    """

    walls: tuple[float, ...]
    cpus: tuple[float, ...]
    peak: float
    output: str

    @property
    def fastest(self) -> float:
        """Least elapsed time: that of the run which other work disturbed least."""
        return min(self.walls)

    @property
    def median(self) -> float:
        return statistics.median(self.walls)

    @property
    def cpu(self) -> float:
        return min(self.cpus)


def interleaved(commands: Mapping[str, Sequence[str]], repeats: int) -> dict[str, Measured]:
    """Run each command once, then each again, and so on; return what each took.

    A first round is not counted: it brings files into the system's cache and compiles modules.

    Raises
    ------
    SystemExit
        A command failed; its message is shown.
    """
    found: dict[str, list[tuple[float, float, float, str]]] = {name: [] for name in commands}
    for repeat in range(repeats + 1):
        for name, command in commands.items():
            run = _once(command)
            if repeat:
                found[name].append(run)
    return {
        name: Measured(
            tuple(wall for wall, _, _, _ in runs),
            tuple(cpu for _, cpu, _, _ in runs),
            max(peak for _, _, peak, _ in runs),
            runs[-1][3],
        )
        for name, runs in found.items()
    }


def measure(command: Sequence[str], repeats: int) -> Measured:
    """Run one command `repeats` times; as `interleaved`."""
    return interleaved({"": command}, repeats)[""]


def _once(command: Sequence[str]) -> tuple[float, float, float, str]:
    with tempfile.TemporaryFile("w+") as output, tempfile.TemporaryFile("w+") as errors:
        begin = time.perf_counter()
        child = subprocess.Popen(command, stdout=output, stderr=errors, env=_ENVIRONMENT)
        _, status, usage = os.wait4(child.pid, 0)
        wall = time.perf_counter() - begin
        child.returncode = os.waitstatus_to_exitcode(status)
        output.seek(0)
        errors.seek(0)
        if child.returncode:
            raise SystemExit(f"{' '.join(command)} failed:\n{errors.read()}")
        cpu = usage.ru_utime + usage.ru_stime
        return wall, cpu, usage.ru_maxrss * _PEAK_UNIT, output.read()
