"""K_II from 300 readings by suncal's Monte Carlo; prints JSON.

    python benchmarks/peer_suncal.py FILE SAMPLES

suncal (Sandia's uncertainty calculator) is under the GPL. It is no part of this project, not even
of its benchmarks' requirements: `benchmarks/study.py` starts this script, which uses nothing of
counterspin, with a Python that has suncal, if there is one. FILE holds what `study_jobs.py` calls
"linear": K_II as the linear function of all readings that the two stages amount to.
"""

from __future__ import annotations

import json
import sys
import time
from importlib.metadata import version
from pathlib import Path

import suncal

linear = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
samples = int(sys.argv[2])

weights = [w for run in linear["weights"] for w in run]
readings = [r for run in linear["readings"] for r in run]
terms = [f"({w!r})*x{i}" for i, w in enumerate(weights)]
model = suncal.Model("K_II = " + " + ".join([*terms, f"({linear['prior_weight']!r})*K_F"]))
for i, reading in enumerate(readings):
    model.var(f"x{i}").measure(reading).typeb(std=linear["sigma"])
mean, u = linear["prior"]
model.var("K_F").measure(mean).typeb(std=u)
begin = time.perf_counter()
found = model.monte_carlo(samples=samples)
seconds = time.perf_counter() - begin
print(
    json.dumps(
        {"seconds": seconds, "u": float(found.uncertainty["K_II"]), "version": version("suncal")}
    )
)
