"""Compute K_II from 300 readings with the Monte Carlo method of suncal; prints JSON.

    python benchmarks/peer_suncal.py FILE SAMPLES

suncal (Sandia's uncertainty calculator) is licensed under the GPL. It is not part of this project
or of the requirements of its benchmarks: `benchmarks/study.py` starts this script, which does not
use counterspin, with a Python that has suncal, if one is named. FILE is the "linear" object of
`study_jobs.py`: K_II of the two-stage method as a linear function of all readings.
"""

from __future__ import annotations

import json
import sys
import time
from importlib.metadata import version
from pathlib import Path

import suncal

linear = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
n_samples = int(sys.argv[2])

weights = [w for run in linear["weights"] for w in run]
readings = [r for run in linear["readings"] for r in run]
terms = [f"({w!r})*x{i}" for i, w in enumerate(weights)]
model = suncal.Model("K_II = " + " + ".join([*terms, f"({linear['prior_weight']!r})*K_F"]))
for i, reading in enumerate(readings):
    model.var(f"x{i}").measure(reading).typeb(std=linear["sigma"])
mean, u = linear["prior"]
model.var("K_F").measure(mean).typeb(std=u)
start = time.perf_counter()
result = model.monte_carlo(samples=n_samples)
seconds = time.perf_counter() - start
print(
    json.dumps(
        {"seconds": seconds, "u": float(result.uncertainty["K_II"]), "version": version("suncal")}
    )
)
