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
from counterspin.physics.motion import Trajectory
from counterspin.physics.observation import columns
from counterspin.studies.choice import EngineName, prepare
from counterspin.studies.description import read_study
from counterspin.studies.draws import Draws, stream
from counterspin.studies.result import summarise
from counterspin.studies.shortcuts import TwoStageEngine
from counterspin.studies.work import Ledger, StudyEngine, run_batches
from study_campaigns import GIVEN, RESIDUALS, VARYING, campaign_of

Job = Callable[[], object]
Times = dict[str, tuple[float, float]]


def engine_of(text: str, engine: EngineName = "auto") -> StudyEngine:
    """Return the engine of a study of the paper's plan."""
    with tempfile.TemporaryDirectory() as name:
        file = Path(name) / "campaign.toml"
        file.write_text(campaign_of(text), encoding="utf-8")
        study = read_study(file)
    return prepare(study, 1, engine)


def trials(engine: StudyEngine, count: int) -> np.ndarray:
    """Do trials as `counterspin study` does, and return their sums."""
    ledger = Ledger(engine, count)
    run_batches(engine, ledger)
    return ledger.sums


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


def plan_of(engine: StudyEngine) -> peers.Plan:
    """Return the paper's plan as numbers."""
    (part,) = engine.parts
    two_stage = part.engine
    assert isinstance(two_stage, TwoStageEngine)
    request = two_stage.request
    times, readings, effects = [], [], []
    draws = engine.truth.draw(stream(1, 0, 0), 1)
    for run, motion in enumerate(two_stage.motions):
        spindle = engine.truth.spindles[run]
        strobes = spindle.time_at(motion.angles)
        path = Trajectory(spindle, motion.radius, motion.site)
        symbols = [symbol for _, symbol in two_stage.true]
        true = np.array([float(draws.values[key][0, 0]) for key in two_stage.true])
        true[symbols.index("K_I")] -= 1.0
        made = columns(path, motion.mounting, symbols, strobes, attitude=motion.attitude)
        times.append(strobes)
        readings.append(made @ true)
        assumed, _ = two_stage._effects(draws, run)
        effects.append(dict(zip(two_stage.symbols, assumed[:, 0], strict=True)))
    return peers.Plan(
        times=times,
        readings=readings,
        sigma=float(request.sigma or 0.0),
        columns=np.array([[one[symbol] for one in effects] for symbol in ("K_II", "K_F")]),
        known=np.array([(request.considered["K_I"][0] - 1.0) * one["K_I"] for one in effects]),
        prior=request.unknowns["K_F"],
        truth=float(draws.values["Qx", "K_II"][0, 0]),
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
    plan = plan_of(made["given"])
    jobs: dict[str, Job] = {
        "given": lambda: trials(made["given"], sizes["given"]),
        "residuals": lambda: trials(made["residuals"], sizes["residuals"]),
        "brute force": lambda: peers.brute_force(plan, sizes["brute force"]),
        "lstsq": lambda: peers.one_by_one(plan, sizes["lstsq"]),
        "uncertainties": lambda: peers.with_uncertainties(plan, sizes["uncertainties"]),
    }
    times = in_turn(jobs, repeats)
    ours = summarise(made["given"].tally, trials(made["given"], million)[:, 0])
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


def exact_physics(full: bool, repeats: int, made: dict[str, StudyEngine]) -> dict[str, Any]:
    """Time trials whose rotation, radius and coefficients vary, and check them trial by trial."""
    sizes = {
        "surrogate": 1_000_000 if full else 200_000,
        "quadrature": 2560 if full else 256,
        "ode": 1,
    }
    slow = made["quadrature"].parts[0].engine
    fast = made["varying"].parts[0].engine
    assert isinstance(slow, TwoStageEngine)
    assert isinstance(fast, TwoStageEngine)
    draws = made["varying"].truth.draw(stream(1, 0, 0), 64)
    jobs: dict[str, Job] = {
        "surrogate": lambda: trials(made["varying"], sizes["surrogate"]),
        "quadrature": lambda: trials(made["quadrature"], sizes["quadrature"]),
    }
    times = in_turn(jobs, repeats)
    times |= in_turn({"ode": lambda: _ode(slow, draws)}, repeats if full else 1)
    a, b = (one.trials(draws, stream(1, 0, 1)) for one in (fast, slow))
    error = float(np.abs((a.estimate - b.estimate) / b.u).max())
    assert error < 1e-5
    shown = [float(slow._shift(draws, run, slow._effects(draws, run)[0])[0]) for run in range(3)]
    ode_error = max(abs(x / y - 1.0) for x, y in zip(_ode(slow, draws), shown, strict=True))
    assert ode_error < 1e-8
    return {"sizes": sizes, "times": times, "error": error, "ode_error": ode_error}


def _ode(engine: TwoStageEngine, draws: Draws) -> list[float]:
    """Return b2 of the true errors in the runs of the first trial, by `solve_ivp`."""
    found = []
    one = draws.take(0)
    for run, motion in enumerate(engine.motions):
        spindle = one.spindle(motion.spindle, run)
        (ripple,) = spindle.ripples
        path = peers.Motion(
            rate=spindle.rate,
            drift=spindle.drift,
            ratio=ripple.amplitude / spindle.rate,
            phase=ripple.phase,
            radius=motion.radius + float(one.off("centrifuge.radius")[0]),
            gravity=motion.site.gravity,
            earth_up=float(motion.site.earth_rotation[2]),
            earth_north=float(motion.site.earth_rotation[1]),
            angles=motion.angles,
        )
        truth = [float(one.values["Qx", s][0, 0]) for s in ("K_F", "K_I", "K_II", "K_III", "K_IP")]
        truth[1] -= 1.0
        found.append(float(peers.by_ode(path) @ np.array(truth)))
    return found


def against_trials(full: bool, made: dict[str, StudyEngine]) -> list[dict[str, Any]]:
    """Return what numbers of trials take by each way, the fastest of three, s."""
    plan = plan_of(made["given"])
    largest = 7 if full else 5
    ways: dict[str, tuple[Callable[[int], object], int]] = {
        "sufficient statistics": (partial(trials, made["given"]), largest),
        "sigma from residuals": (partial(trials, made["residuals"]), largest),
        "exact physics, surrogate": (partial(trials, made["varying"]), largest),
        "exact physics, quadrature": (partial(trials, made["quadrature"]), largest - 3),
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
        "quadrature": engine_of(VARYING, "exact"),
    }
    plan = plan_of(made["given"])
    print(
        json.dumps(
            {
                "paper": paper_s_plan(chosen.full, chosen.repeats, made),
                "exact": exact_physics(chosen.full, chosen.repeats, made),
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
