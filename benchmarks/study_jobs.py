"""Time the work of studies and their peers within one process; prints JSON.

    python benchmarks/study_jobs.py [--full] [--repeats N]

`benchmarks/study.py` starts this script. The jobs of one comparison alternate, on one core: linear
algebra uses one thread. The results of the compared jobs must agree.
"""

from __future__ import annotations

import os

# Before NumPy is loaded.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import argparse
import json
import math
import statistics
import tempfile
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import study_peers as peers
from counterspin.arrays import Array
from counterspin.inference.two_stage.model import TwoStageRequest
from counterspin.ingest.starter import init
from counterspin.physics.motion import Trajectory
from counterspin.physics.observation import columns
from counterspin.physics.terms import term
from counterspin.studies.batch_runner import BatchResults, StudyEngine, run_batches
from counterspin.studies.description import StudyDescription, read_study
from counterspin.studies.draws import StudyTruth
from counterspin.studies.engine_selection import list_analyses, prepare_study
from counterspin.studies.linear_engines import curvature_gain
from counterspin.studies.result import summarise
from counterspin.studies.simulation_setup import make_setup
from counterspin.studies.study import study
from study_campaigns import ESTIMATED_SIGMA, STATED_SIGMA, VARIED_TRUTH, describe_study

Job = Callable[[], object]
Times = dict[str, tuple[float, float]]


def read_paper_study(text: str) -> StudyDescription:
    """Return a study of the paper's plan."""
    with tempfile.TemporaryDirectory() as name:
        file = Path(name) / "campaign.toml"
        file.write_text(describe_study(text), encoding="utf-8")
        return read_study(file)


def prepare_engine(text: str) -> StudyEngine:
    """Return the engine of a study of the paper's plan."""
    return prepare_study(read_paper_study(text), 1)


def run_trials(engine: StudyEngine, n_trials: int) -> np.ndarray:
    """Run trials as `counterspin study` does; return their sums."""
    batch_results = BatchResults(engine, n_trials)
    run_batches(engine, batch_results)
    return batch_results.sums


def time_interleaved(jobs: Mapping[str, Job], n_repeats: int) -> Times:
    """Return the median elapsed and processor times by job, s; a first round is not counted."""
    times_by_job: dict[str, list[tuple[float, float]]] = {name: [] for name in jobs}
    for repeat in range(n_repeats + 1):
        for name, job in jobs.items():
            wall, cpu = time.perf_counter(), time.process_time()
            job()
            times = time.perf_counter() - wall, time.process_time() - cpu
            if repeat:
                times_by_job[name].append(times)
    return {
        name: (statistics.median(w for w, _ in pairs), statistics.median(c for _, c in pairs))
        for name, pairs in times_by_job.items()
    }


def make_peer_plan(text: str) -> peers.Plan:
    """Return the paper's plan for the peers."""
    study = read_paper_study(text)
    (analysis,) = list_analyses(study)
    request = analysis.request
    assert isinstance(request, TwoStageRequest)
    setup, draws = (
        make_setup(study.campaign),
        StudyTruth.from_campaign(study.campaign, study.varied_quantities).mean_draw(),
    )
    coefficients = {symbol: value for (owner, symbol), value in draws.values.items() if owner}
    deviations = np.array(
        [float(v[0, 0]) - term(symbol).nominal for symbol, v in coefficients.items()]
    )
    times, readings, curvatures = [], [], []
    for run, spindle in enumerate(setup.spindles):
        strobes = spindle.time_at(setup.strobes(run, "Qx"))
        trajectory = Trajectory(spindle, setup.radius, setup.site)

        def columns_of(
            symbols: list[str], trajectory: Trajectory = trajectory, strobes: Array = strobes
        ) -> Array:
            return columns(trajectory, setup.mountings["Qx"], symbols, strobes)

        times.append(strobes)
        readings.append(columns_of(list(coefficients)) @ deviations)
        curvatures.append(curvature_gain(strobes) @ columns_of(["K_II", "K_F", "K_I"]))
    curvature_by_run = np.array(curvatures)
    return peers.Plan(
        times=times,
        readings=readings,
        sigma=float(request.sigma or 0.0),
        curvature_columns=curvature_by_run[:, :2].T,
        known_curvatures=(request.considered["K_I"][0] - 1.0) * curvature_by_run[:, 2],
        prior=request.unknowns["K_F"],
        truth=float(coefficients["K_II"][0, 0]),
    )


def time_paper_plan(full: bool, n_repeats: int, engines: dict[str, StudyEngine]) -> dict[str, Any]:
    """Time a million trials of the paper's plan; check that all peers agree."""
    million = 1_000_000
    sizes = {
        "stated sigma": million,
        "estimated sigma": million,
        "brute force": million if full else 100_000,
        "lstsq": 10_000 if full else 1000,
        "uncertainties": 100 if full else 20,
    }
    plan = make_peer_plan(STATED_SIGMA)
    jobs: dict[str, Job] = {
        "stated sigma": lambda: run_trials(engines["stated sigma"], sizes["stated sigma"]),
        "estimated sigma": lambda: run_trials(engines["estimated sigma"], sizes["estimated sigma"]),
        "brute force": lambda: peers.fit_chunks(plan, sizes["brute force"]),
        "lstsq": lambda: peers.fit_with_lstsq(plan, sizes["lstsq"]),
        "uncertainties": lambda: peers.propagate_uncertainties(plan, sizes["uncertainties"]),
    }
    times = time_interleaved(jobs, n_repeats)
    engine = engines["stated sigma"]
    summary = summarise(engine.accumulator, run_trials(engine, million)[:, 0])
    mean, sd, n_covered = peers.fit_chunks(plan, sizes["brute force"])
    n = sizes["brute force"]
    # Five standard errors.
    assert abs(mean - summary.truth - summary.bias) < 5.0 * sd / math.sqrt(n)
    assert abs(sd / summary.sd - 1.0) < 5.0 / math.sqrt(2 * n)
    assert abs(n_covered[1] / n - summary.covered[1]) < 5.0 * math.sqrt(0.05 / n)
    mean, sd = peers.fit_with_lstsq(plan, sizes["lstsq"])
    assert abs(mean - summary.truth - summary.bias) < 5.0 * sd / math.sqrt(sizes["lstsq"])
    assert abs(peers.propagate_uncertainties(plan, 1) / summary.u - 1.0) < 1e-6
    return {"sizes": sizes, "times": times, "u": summary.u}


def read_example_study(observable: str) -> StudyDescription:
    """Return a study of the campaign that `init` writes, with records of an observable."""
    unit = {"displacement": "m", "velocity": "m/s"}[observable]
    with tempfile.TemporaryDirectory() as name:
        file = init(Path(name) / "example")
        text = file.read_text(encoding="utf-8")
        column = f'{observable} = {{ column = "output", unit = "{unit}" }}'
        text = text.replace('displacement = { column = "east_m", unit = "m" }', column)
        text = text.replace('displacement = "0.01 m"', f'{observable} = "0.01 {unit}"')
        assert text.count(f"{observable} = ") >= 3
        file.write_text(text, encoding="utf-8")
        return read_study(file)


def time_examples(full: bool, n_repeats: int) -> list[dict[str, Any]]:
    """Time the studies of the example, including preparation."""
    rows: dict[str, dict[str, Any]] = {}
    jobs: dict[str, Job] = {}
    for observable in ("displacement", "velocity"):
        description = read_example_study(observable)
        for n_trials in (1000, 10_000, 100_000) if full else (1000, 10_000):
            name = f"{observable} {n_trials}"
            rows[name] = {"records": observable, "trials": n_trials, "engine": "linear"}
            jobs[name] = partial(study, description, trials=n_trials)
        n_full_trials = 4
        name = f"{observable} {n_full_trials}"
        rows[name] = {"records": observable, "trials": n_full_trials, "engine": "full"}
        jobs[name] = partial(study, description, trials=n_full_trials, engine="full")
    times = time_interleaved(jobs, min(n_repeats, 3))
    return [
        row | dict(zip(("wall", "cpu"), times[name], strict=True)) for name, row in rows.items()
    ]


def time_trial_counts(full: bool, engines: dict[str, StudyEngine]) -> list[dict[str, Any]]:
    """Return the time of each method by number of trials, the fastest of three, s."""
    plan = make_peer_plan(STATED_SIGMA)
    engine_max_power = 7 if full else 5
    methods: dict[str, tuple[Callable[[int], object], int]] = {
        "sufficient statistics": (partial(run_trials, engines["stated sigma"]), engine_max_power),
        "sigma from residuals": (partial(run_trials, engines["estimated sigma"]), engine_max_power),
        "rotation that varies": (partial(run_trials, engines["varied truth"]), engine_max_power),
        "NumPy, all readings": (partial(peers.fit_chunks, plan), engine_max_power - 1),
        "loop of lstsq": (partial(peers.fit_with_lstsq, plan), engine_max_power - 3),
    }
    rows = []
    for method, (function, max_power) in methods.items():
        for power in range(2, max_power + 1):
            n_trials = 10**power
            rows.append(
                {
                    "method": method,
                    "trials": n_trials,
                    "seconds": _time_fastest(partial(function, n_trials)),
                }
            )
    return rows


def _time_fastest(job: Job) -> float:
    times = []
    for _ in range(3):
        start = time.perf_counter()
        job()
        times.append(time.perf_counter() - start)
    return min(times)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    engines = {
        "stated sigma": prepare_engine(STATED_SIGMA),
        "estimated sigma": prepare_engine(ESTIMATED_SIGMA),
        "varied truth": prepare_engine(VARIED_TRUTH),
    }
    plan = make_peer_plan(STATED_SIGMA)
    print(
        json.dumps(
            {
                "paper": time_paper_plan(options.full, options.repeats, engines),
                "examples": time_examples(options.full, options.repeats),
                "against trials": time_trial_counts(options.full, engines),
                "linear": {
                    "weights": [list(w) for w in plan.k_ii_weights()],
                    "readings": [list(r) for r in plan.readings],
                    "sigma": plan.sigma,
                    "prior": list(plan.prior),
                    "prior_weight": float(plan.second_stage_gains()[0][0, -1]),
                },
            }
        )
    )


if __name__ == "__main__":
    main()
