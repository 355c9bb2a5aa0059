"""Measure time and peak memory of whole processes.

- `measure`: run a command several times, each in a new process
- `measure_interleaved`: alternate several commands, so that all have the same load of the machine

This module imports only the standard library, because the peak memory of a child is at least that
of its parent.
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

#: macOS reports peak memory in bytes, Linux in kilobytes.
_MEGABYTES_PER_MAXRSS = 1e-6 if sys.platform == "darwin" else 1e-3

#: The installed command, of the environment that runs the benchmarks.
COUNTERSPIN = [str(Path(sys.executable).with_name("counterspin"))]
PYTHON = [sys.executable]

#: Environment that caches bytecode, as usual; copied before any benchmark limits its threads.
_ENVIRONMENT = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}


@dataclass(frozen=True)
class Measurement:
    """Repetitions of one command.

    Attributes
    ----------
    wall_times, cpu_times
        Elapsed and processor time of each repetition, s.
    peak_memory
        Largest resident memory of all repetitions, MB.
    output
        Standard output of the last repetition.
    """

    wall_times: tuple[float, ...]
    cpu_times: tuple[float, ...]
    peak_memory: float
    output: str

    @property
    def fastest(self) -> float:
        """Shortest elapsed time, which is least affected by other load, s."""
        return min(self.wall_times)

    @property
    def median(self) -> float:
        return statistics.median(self.wall_times)

    @property
    def cpu_time(self) -> float:
        return min(self.cpu_times)


def measure_interleaved(
    commands: Mapping[str, Sequence[str]], n_repeats: int
) -> dict[str, Measurement]:
    """Run the commands in rounds, `n_repeats` times each; return their measurements.

    A first round is not counted: it fills the file cache and compiles modules.

    Raises
    ------
    SystemExit
        If a command fails; contains its error output.
    """
    runs_by_name: dict[str, list[tuple[float, float, float, str]]] = {name: [] for name in commands}
    for repeat in range(n_repeats + 1):
        for name, command in commands.items():
            run = _run_once(command)
            if repeat:
                runs_by_name[name].append(run)
    return {
        name: Measurement(
            tuple(wall for wall, _, _, _ in runs),
            tuple(cpu for _, cpu, _, _ in runs),
            max(peak for _, _, peak, _ in runs),
            runs[-1][3],
        )
        for name, runs in runs_by_name.items()
    }


def measure(command: Sequence[str], n_repeats: int) -> Measurement:
    """Run one command `n_repeats` times, in addition to an uncounted first time."""
    return measure_interleaved({"": command}, n_repeats)[""]


def _run_once(command: Sequence[str]) -> tuple[float, float, float, str]:
    with tempfile.TemporaryFile("w+") as output, tempfile.TemporaryFile("w+") as error_output:
        start = time.perf_counter()
        process = subprocess.Popen(command, stdout=output, stderr=error_output, env=_ENVIRONMENT)
        _, status, usage = os.wait4(process.pid, 0)
        wall_time = time.perf_counter() - start
        process.returncode = os.waitstatus_to_exitcode(status)
        output.seek(0)
        error_output.seek(0)
        if process.returncode:
            raise SystemExit(f"{' '.join(command)} failed:\n{error_output.read()}")
        cpu_time = usage.ru_utime + usage.ru_stime
        return wall_time, cpu_time, usage.ru_maxrss * _MEGABYTES_PER_MAXRSS, output.read()
