"""Predictions of u for a given structure of a plan, timed within one process; prints JSON.

    python benchmarks/plan_predictions.py PLAN.toml RUNS BATCHES

`benchmarks/plan.py` starts it. Prints predictions a second: in batches, and one by one.
"""

from __future__ import annotations

import os

# The command line does the same: for matrices this small, more threads cost more than they bring.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from counterspin.planning.plan_file import read_plan
from counterspin.planning.search import Search

BATCH = 100


def predictions(file: Path, runs: int, batches: int) -> tuple[float, float]:
    """Return predictions a second: in batches, and one by one."""
    search = Search(read_plan(file))
    generator = np.random.default_rng(1)
    types = tuple(search.limits.types[i % 2] for i in range(runs))
    low, high = search.limits.rate_range
    rates = generator.uniform(low, high, (BATCH, runs))
    turns = generator.uniform(10.0, 60.0, rates.shape)

    def best(work: Callable[[], object], repeats: int) -> float:
        times = []
        for _ in range(repeats):
            begin = time.perf_counter()
            work()
            times.append(time.perf_counter() - begin)
        return min(times)

    together = best(lambda: search.predictor.covariance(types, rates, turns), batches)
    alone = best(lambda: search.predictor.covariance(types, rates[0], turns[0]), 50 * batches)
    return BATCH / together, 1.0 / alone


if __name__ == "__main__":
    print(json.dumps(predictions(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))))
