"""Planning: a whole `counterspin plan`, and predictions of u for a given structure of a plan.

    python benchmarks/plan.py

Eight runs in one attitude and either sense; K_F, K_I, K_II, K_III, tilts, drift and g-sensitivity
with their priors; whatever is not stated is perfect. The predictions are made in batches of 100
designs at random, rates and lengths all different, on one core, by `plan_predictions.py`.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
from pathlib import Path

from process import COUNTERSPIN, PYTHON, interleaved
from table import Table, script

HERE = Path(__file__).parent
RUNS = 8
BATCH = 100


def tables(full: bool = False, repeats: int | None = None) -> list[Table]:
    """Time planning and predictions."""
    with tempfile.TemporaryDirectory() as name:
        file = Path(name) / "PLAN.toml"
        init = [*COUNTERSPIN, "plan", "--init", str(file)]
        subprocess.run(init, check=True, stdout=subprocess.DEVNULL)
        text = file.read_text(encoding="utf-8").replace("runs = 14", f"runs = {RUNS}")
        for line in ('assume = "all"', "fewest_rates = 1"):
            text = text.replace(f"# {line}", line)
        file.write_text(text.replace('senses = "one"', 'senses = "both"'), encoding="utf-8")
        command = [*COUNTERSPIN, "plan", str(file)]
        found = interleaved({"counterspin plan": command}, repeats or 5)["counterspin plan"]
        rate, single = _predictions(file, 20 if full else 8)
    return [
        Table(
            "A plan of eight runs",
            "The plan optimises rates, durations and senses of rotation, with all disturbances "
            "enabled. Times are for a whole process, including the start of Python. "
            "The output includes the limits of the plan and alternative plans.",
            ["process", "median (s)", "fastest (s)", "target (s)", "peak MB"],
            [["counterspin plan", found.median, found.fastest, 3.0, found.peak]],
        ),
        Table(
            "Predictions of u",
            f"Each prediction is for {RUNS} runs with random rates and durations. Each value is "
            "the rate of the fastest of several batches.",
            ["predictions", "per second", "target"],
            [[f"in batches of {BATCH}", rate, 10000.0], ["one by one", single, None]],
        ),
    ]


def _predictions(file: Path, batches: int) -> tuple[float, float]:
    """Return predictions a second, in batches and one by one; in a process of their own."""
    command = [*PYTHON, str(HERE / "plan_predictions.py"), str(file), str(RUNS), str(batches)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    together, single = json.loads(done.stdout)
    return together, single


if __name__ == "__main__":
    script(__doc__.splitlines()[0], tables)
