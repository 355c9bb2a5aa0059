"""Planning: a whole `counterspin plan`, and predictions of u for a given structure of a plan.

    python benchmarks/plan.py

Eight runs in one attitude and either sense; K_F, K_I, K_II, K_III, tilts, drift and g-sensitivity
with their priors. The predictions are made in batches of 100 designs at random, rates and lengths
all different, on one core.
"""

from __future__ import annotations

import os

# The command line does the same: for matrices this small, more threads cost more than they bring.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import math
import tempfile
import time
from pathlib import Path

import numpy as np

from counterspin.campaign.plan_description import read_plan
from counterspin.commands.plan import write_example
from counterspin.commands.plan_search import Search
from process import COUNTERSPIN, interleaved
from table import Table, script

RUNS = 8
BATCH = 100


def tables(full: bool = False, repeats: int | None = None) -> list[Table]:
    """Time planning and predictions."""
    with tempfile.TemporaryDirectory() as name:
        file = write_example(Path(name) / "PLAN.toml")
        text = file.read_text(encoding="utf-8").replace("runs = 14", f"runs = {RUNS}")
        file.write_text(text.replace('senses = "one"', 'senses = "both"'), encoding="utf-8")
        command = [*COUNTERSPIN, "plan", str(file)]
        found = interleaved({"counterspin plan": command}, repeats or 5)["counterspin plan"]
        rate, single = _predictions(file, 20 if full else 8)
    return [
        Table(
            "A plan of eight runs",
            "Rates, lengths and senses free, all disturbances on. A whole process, start of Python "
            "included, with what limits the plan and other plans beside it.",
            ["process", "median (s)", "fastest (s)", "target (s)", "peak MB"],
            [["counterspin plan", found.median, found.fastest, 3.0, found.peak]],
        ),
        Table(
            "Predictions of u",
            f"For {RUNS} runs, rates and lengths at random; the best of several batches.",
            ["predictions", "a second", "target"],
            [[f"in batches of {BATCH}", rate, 10000.0], ["one by one", single, None]],
        ),
    ]


def _predictions(file: Path, batches: int) -> tuple[float, float]:
    """Return predictions a second: in batches, and one by one."""
    search = Search(read_plan(file))
    generator = np.random.default_rng(1)
    types = tuple(search.limits.types[i % 2] for i in range(RUNS))
    low, high = search.limits.rate
    rates = generator.uniform(low, high, (BATCH, RUNS))
    turns = generator.uniform(10.0, 60.0, rates.shape)

    def best(work: object, repeats: int) -> float:
        times = []
        for _ in range(repeats):
            begin = time.perf_counter()
            work()  # type: ignore[operator]
            times.append(time.perf_counter() - begin)
        return min(times)

    together = best(lambda: search.predictor.covariance(types, rates, turns), batches)
    alone = best(lambda: search.predictor.covariance(types, rates[0], turns[0]), 50 * batches)
    assert math.isfinite(together)
    return BATCH / together, 1.0 / alone


if __name__ == "__main__":
    script(__doc__.splitlines()[0], tables)
