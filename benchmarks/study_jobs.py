"""The work of a study and of its peers, timed within one process; prints JSON.

    python benchmarks/study_jobs.py [--full] [--repeats N]

`benchmarks/study.py` starts it. The jobs of one comparison take turns. One core: the linear algebra
is kept to one thread. What a job is compared by is checked too: all must find the same.
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
from study_campaigns import GIVEN, RESIDUALS, VARYING, campaign_of

Job = Callable[[], object]
Times = dict[str, tuple[float, float]]


def study_of(text: str) -> StudyDescription:
    """Return a study of the paper's plan."""
    with tempfile.TemporaryDirectory() as name:
        file = Path(name) / "campaign.toml"
        file.write_text(campaign_of(text), encoding="utf-8")
        return read_study(file)


def engine_of(text: str) -> StudyEngine:
    """Return the engine of a study of the paper's plan."""
    return prepare_study(study_of(text), 1)


def trials(engine: StudyEngine, count: int) -> np.ndarray:
    """Do trials as `counterspin study` does, and return their sums."""
    batch_results = BatchResults(engine, count)
    run_batches(engine, batch_results)
    return batch_results.sums


def in_turn(jobs: Mapping[str, Job], repeats: int) -> Times:
    """Return the medians of elapsed and processor time of each, s; a first round is not counted."""
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in jobs}
    for repeat in range(repeats + 1):
        for name, job in jobs.items():
            wall, cpu = time.perf_counter(), time.process_time()
            job()
            taken = time.perf_counter() - wall, time.process_time() - cpu
            if repeat:
                found[name].append(taken)
    return {
        name: (statistics.median(w for w, _ in taken), statistics.median(c for _, c in taken))
        for name, taken in found.items()
    }


def plan_of(text: str) -> peers.Plan:
    """Return a study of the paper's plan as numbers."""
    study = study_of(text)
    (analysis,) = list_analyses(study)
    request = analysis.request
    assert isinstance(request, TwoStageRequest)
    setup, draws = (
        make_setup(study.campaign),
        StudyTruth.from_campaign(study.campaign, study.varied_quantities).mean_draw(),
    )
    own = {symbol: value for (owner, symbol), value in draws.values.items() if owner}
    true = np.array([float(v[0, 0]) - term(symbol).nominal for symbol, v in own.items()])
    times, readings, effects = [], [], []
    for run, spindle in enumerate(setup.spindles):
        strobes = spindle.time_at(setup.strobes(run, "Qx"))
        path = Trajectory(spindle, setup.radius, setup.site)

        def shown(symbols: list[str], path: Trajectory = path, strobes: Array = strobes) -> Array:
            return columns(path, setup.mountings["Qx"], symbols, strobes)

        times.append(strobes)
        readings.append(shown(list(own)) @ true)
        effects.append(curvature_gain(strobes) @ shown(["K_II", "K_F", "K_I"]))
    by_run = np.array(effects)
    return peers.Plan(
        times=times,
        readings=readings,
        sigma=float(request.sigma or 0.0),
        columns=by_run[:, :2].T,
        known=(request.considered["K_I"][0] - 1.0) * by_run[:, 2],
        prior=request.unknowns["K_F"],
        truth=float(own["K_II"][0, 0]),
    )


def paper_s_plan(full: bool, repeats: int, made: dict[str, StudyEngine]) -> dict[str, Any]:
    """Time a million trials of the paper's plan, and check that all peers find the same."""
    million = 1_000_000
    sizes = {
        "given": million,
        "residuals": million,
        "brute force": million if full else 100_000,
        "lstsq": 10_000 if full else 1000,
        "uncertainties": 100 if full else 20,
    }
    plan = plan_of(GIVEN)
    jobs: dict[str, Job] = {
        "given": lambda: trials(made["given"], sizes["given"]),
        "residuals": lambda: trials(made["residuals"], sizes["residuals"]),
        "brute force": lambda: peers.brute_force(plan, sizes["brute force"]),
        "lstsq": lambda: peers.one_by_one(plan, sizes["lstsq"]),
        "uncertainties": lambda: peers.with_uncertainties(plan, sizes["uncertainties"]),
    }
    times = in_turn(jobs, repeats)
    ours = summarise(made["given"].accumulator, trials(made["given"], million)[:, 0])
    mean, sd, covered = peers.brute_force(plan, sizes["brute force"])
    n = sizes["brute force"]
    # Five standard errors.
    assert abs(mean - ours.truth - ours.bias) < 5.0 * sd / math.sqrt(n)
    assert abs(sd / ours.sd - 1.0) < 5.0 / math.sqrt(2 * n)
    assert abs(covered[1] / n - ours.covered[1]) < 5.0 * math.sqrt(0.05 / n)
    mean, sd = peers.one_by_one(plan, sizes["lstsq"])
    assert abs(mean - ours.truth - ours.bias) < 5.0 * sd / math.sqrt(sizes["lstsq"])
    assert abs(peers.with_uncertainties(plan, 1) / ours.u - 1.0) < 1e-6
    return {"sizes": sizes, "times": times, "u": ours.u}


def example_of(observable: str) -> StudyDescription:
    """Return the study of the example that `init` writes, with records of an observable."""
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


def example_studies(full: bool, repeats: int) -> list[dict[str, Any]]:
    """Time the studies of the example, preparation included."""
    rows: dict[str, dict[str, Any]] = {}
    jobs: dict[str, Job] = {}
    for observable in ("displacement", "velocity"):
        description = example_of(observable)
        for count in (1000, 10_000, 100_000) if full else (1000, 10_000):
            name = f"{observable} {count}"
            rows[name] = {"records": observable, "trials": count, "engine": "linear"}
            jobs[name] = partial(study, description, trials=count)
        few = 4
        name = f"{observable} {few}"
        rows[name] = {"records": observable, "trials": few, "engine": "full"}
        jobs[name] = partial(study, description, trials=few, engine="full")
    times = in_turn(jobs, min(repeats, 3))
    return [
        row | dict(zip(("wall", "cpu"), times[name], strict=True)) for name, row in rows.items()
    ]


def against_trials(full: bool, made: dict[str, StudyEngine]) -> list[dict[str, Any]]:
    """Return what numbers of trials take by each way, the fastest of three, s."""
    plan = plan_of(GIVEN)
    largest = 7 if full else 5
    ways: dict[str, tuple[Callable[[int], object], int]] = {
        "sufficient statistics": (partial(trials, made["given"]), largest),
        "sigma from residuals": (partial(trials, made["residuals"]), largest),
        "rotation that varies": (partial(trials, made["varying"]), largest),
        "NumPy, all readings": (partial(peers.brute_force, plan), largest - 1),
        "loop of lstsq": (partial(peers.one_by_one, plan), largest - 3),
    }
    rows = []
    for way, (work, last) in ways.items():
        for power in range(2, last + 1):
            count = 10**power
            rows.append({"way": way, "trials": count, "seconds": _fastest(partial(work, count))})
    return rows


def _fastest(work: Job) -> float:
    times = []
    for _ in range(3):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return min(times)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--repeats", type=int, default=5)
    chosen = parser.parse_args()
    made = {
        "given": engine_of(GIVEN),
        "residuals": engine_of(RESIDUALS),
        "varying": engine_of(VARYING),
    }
    plan = plan_of(GIVEN)
    print(
        json.dumps(
            {
                "paper": paper_s_plan(chosen.full, chosen.repeats, made),
                "examples": example_studies(chosen.full, chosen.repeats),
                "against trials": against_trials(chosen.full, made),
                "linear": {
                    "weights": [list(w) for w in plan.readings_to_k_ii()],
                    "readings": [list(r) for r in plan.readings],
                    "sigma": plan.sigma,
                    "prior": list(plan.prior),
                    "prior_weight": float(plan.second_stage()[0][0, -1]),
                },
            }
        )
    )


if __name__ == "__main__":
    main()
