"""Whole studies: what one waits for a million trials, and what a second worker brings.

python benchmarks/workers.py          # a second or two of work
python benchmarks/workers.py --full   # 20 s of work
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from process import COUNTERSPIN, Measured, interleaved
from study_campaigns import GIVEN, VARYING, campaign_of
from table import Cell, Table, script

MILLION = 1e6


def tables(full: bool = False, repeats: int | None = None) -> list[Table]:
    """Time a million trials, and some 20 s of work by one worker and by two."""
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as name:
        folders = {}
        for study, text in (("given", GIVEN), ("varying", VARYING)):
            folders[study] = Path(name) / study
            folders[study].mkdir()
            (folders[study] / "campaign.toml").write_text(campaign_of(text), encoding="utf-8")

        def command(study: str, count: float, workers: int = 1) -> list[str]:
            few = ["--trials", str(int(count)), "--workers", str(workers)]
            return [*COUNTERSPIN, "study", str(folders[study]), *few]

        many = 1.8e7 if full else 1e6
        found = interleaved(
            {
                "paper": command("given", MILLION),
                "one": command("varying", many),
                "two": command("varying", many, 2),
            },
            repeats or 3,
        )
    one, two = found["one"], found["two"]
    rows: list[list[Cell]] = [
        ["1e+06 trials of the paper's plan", *_times(found["paper"]), None, None],
        [f"{many:.1e} trials with exact physics, one worker", *_times(one), None, None],
        [
            f"{many:.1e} trials with exact physics, two workers",
            *_times(two),
            one.median / two.median,
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
            f"work on the machine slows them down. The load average was {load:.1f} before the "
            "measurement.",
            ["process", "median (s)", "fastest (s)", "processor (s)", "speed-up", "target"],
            rows,
        )
    ]


def _times(found: Measured) -> list[Cell]:
    return [found.median, found.fastest, found.cpu]


if __name__ == "__main__":
    script(__doc__.splitlines()[0], tables)
