"""Time predictions of u for given run types, within one process; prints JSON.

    python benchmarks/plan_predictions.py PLAN.toml RUNS BATCHES

`benchmarks/plan.py` starts this script. It prints predictions per second: in batches, and one by
one.
"""

from __future__ import annotations

import os

# As in the command line: for small matrices, more threads are slower.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from counterspin.planning.plan_file import read_plan
from counterspin.planning.search import Search

BATCH_SIZE = 100


def time_predictions(plan_file: Path, n_runs: int, n_batches: int) -> tuple[float, float]:
    """Return predictions per second: in batches, and one by one."""
    search = Search(read_plan(plan_file))
    rng = np.random.default_rng(1)
    types = tuple(search.limits.types[i % 2] for i in range(n_runs))
    low, high = search.limits.rate_range
    rates = rng.uniform(low, high, (BATCH_SIZE, n_runs))
    revolutions = rng.uniform(10.0, 60.0, rates.shape)

    def time_fastest(function: Callable[[], object], n_repeats: int) -> float:
        times = []
        for _ in range(n_repeats):
            start = time.perf_counter()
            function()
            times.append(time.perf_counter() - start)
        return min(times)

    batch_time = time_fastest(
        lambda: search.predictor.covariance(types, rates, revolutions), n_batches
    )
    single_time = time_fastest(
        lambda: search.predictor.covariance(types, rates[0], revolutions[0]), 50 * n_batches
    )
    return BATCH_SIZE / batch_time, 1.0 / single_time


if __name__ == "__main__":
    print(json.dumps(time_predictions(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))))
