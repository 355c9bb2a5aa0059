"""Time `counterspin plan` as a whole process, and predictions of u for given run types.

    python benchmarks/plan.py

The plan has eight runs in one attitude and both senses, with priors of K_F, K_I, K_II, K_III,
tilts, drift and g-sensitivity; unstated terms are fixed at nominal. `plan_predictions.py` predicts
u on one core, in batches of 100 designs with random rates and durations.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
from pathlib import Path

from process import COUNTERSPIN, PYTHON, measure_interleaved
from table import Table, run_script

HERE = Path(__file__).parent
N_RUNS = 8
BATCH_SIZE = 100


def tables(full: bool = False, repeats: int | None = None) -> list[Table]:
    """Return the tables of planning and predictions."""
    with tempfile.TemporaryDirectory() as folder:
        plan_file = Path(folder) / "PLAN.toml"
        init_command = [*COUNTERSPIN, "plan", "--init", str(plan_file)]
        subprocess.run(init_command, check=True, stdout=subprocess.DEVNULL)
        text = plan_file.read_text(encoding="utf-8").replace("runs = 14", f"runs = {N_RUNS}")
        for line in ('assume = "all"', "fewest_rates = 1"):
            text = text.replace(f"# {line}", line)
        plan_file.write_text(text.replace('senses = "one"', 'senses = "both"'), encoding="utf-8")
        command = [*COUNTERSPIN, "plan", str(plan_file)]
        planning = measure_interleaved({"counterspin plan": command}, repeats or 5)[
            "counterspin plan"
        ]
        batch_rate, single_rate = _time_predictions(plan_file, 20 if full else 8)
    return [
        Table(
            "A plan of eight runs",
            "The plan optimises rates, durations and senses of rotation, with all disturbances "
            "enabled. Times are for a whole process, including the start of Python. "
            "The output includes the limits of the plan and alternative plans.",
            ["process", "median (s)", "fastest (s)", "target (s)", "peak MB"],
            [["counterspin plan", planning.median, planning.fastest, 3.0, planning.peak_memory]],
        ),
        Table(
            "Predictions of u",
            f"Each prediction is for {N_RUNS} runs with random rates and durations. Each value is "
            "the rate of the fastest of several batches.",
            ["predictions", "per second", "target"],
            [
                [f"in batches of {BATCH_SIZE}", batch_rate, 10000.0],
                ["one by one", single_rate, None],
            ],
        ),
    ]


def _time_predictions(plan_file: Path, n_batches: int) -> tuple[float, float]:
    """Return predictions per second, in batches and one by one, timed in a separate process."""
    command = [
        *PYTHON,
        str(HERE / "plan_predictions.py"),
        str(plan_file),
        str(N_RUNS),
        str(n_batches),
    ]
    process = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    batch_rate, single_rate = json.loads(process.stdout)
    return batch_rate, single_rate


if __name__ == "__main__":
    run_script(__doc__.splitlines()[0], tables)
