"""Time whole studies: a million trials, and the speed-up by a second worker.

python benchmarks/workers.py          # a second or two of work
python benchmarks/workers.py --full   # 20 s of work
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from process import COUNTERSPIN, Measurement, measure_interleaved
from study_campaigns import STATED_SIGMA, VARIED_TRUTH, describe_study
from table import Cell, Table, run_script

MILLION = 1e6


def tables(full: bool = False, repeats: int | None = None) -> list[Table]:
    """Return the table of a million trials, and of about 20 s of work with one and two workers."""
    load_average = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as parent:
        folders = {}
        for study, text in (("paper", STATED_SIGMA), ("varied", VARIED_TRUTH)):
            folders[study] = Path(parent) / study
            folders[study].mkdir()
            (folders[study] / "campaign.toml").write_text(describe_study(text), encoding="utf-8")

        def command(study: str, n_trials: float, n_workers: int = 1) -> list[str]:
            options = ["--trials", str(int(n_trials)), "--workers", str(n_workers)]
            return [*COUNTERSPIN, "study", str(folders[study]), *options]

        n_varied_trials = 1.8e7 if full else 1e6
        measurements = measure_interleaved(
            {
                "paper": command("paper", MILLION),
                "one": command("varied", n_varied_trials),
                "two": command("varied", n_varied_trials, 2),
            },
            repeats or 3,
        )
    one_worker, two_workers = measurements["one"], measurements["two"]
    rows: list[list[Cell]] = [
        ["1e+06 trials of the paper's plan", *_time_cells(measurements["paper"]), None, None],
        [
            f"{n_varied_trials:.1e} trials with exact physics, one worker",
            *_time_cells(one_worker),
            None,
            None,
        ],
        [
            f"{n_varied_trials:.1e} trials with exact physics, two workers",
            *_time_cells(two_workers),
            one_worker.median / two_workers.median,
            1.7,
        ],
    ]
    return [
        Table(
            "Whole studies",
            "Times are for a whole process, which starts Python and the workers, "
            "prepares and performs the trials, and writes the report. Repetitions of different "
            "processes alternate. The processor time is the sum over all processes. Two workers "
            "cannot be faster than two cores at once (see the limits of the machine), and other "
            "work on the machine slows them down. The load average was "
            f"{load_average:.1f} before the measurement.",
            ["process", "median (s)", "fastest (s)", "processor (s)", "speed-up", "target"],
            rows,
        )
    ]


def _time_cells(measurement: Measurement) -> list[Cell]:
    return [measurement.median, measurement.fastest, measurement.cpu_time]


if __name__ == "__main__":
    run_script(__doc__.splitlines()[0], tables)
