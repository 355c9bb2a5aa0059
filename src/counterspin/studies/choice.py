"""Which engine each analysis of a study gets.

- `Analysis`: one competitor
- `prepare`: the engine of a study
- `choose_engine`: the fastest engine that is valid for an analysis, or the one asked for
- `cramer_rao`: the bound that no unbiased estimate from the records beats
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from counterspin.errors import NotIdentifiableError
from counterspin.inference.identifiability import assess
from counterspin.inference.joint.fit import solve_joint
from counterspin.inference.joint.prepared import prepare_columns
from counterspin.inference.joint.unknowns import ROTATION, Unknown, Unknowns
from counterspin.inference.noise.model import NoiseModel
from counterspin.inference.two_stage.request import RIPPLE, TwoStageRequest
from counterspin.physics.accelerometer import TERMS, term
from counterspin.studies.draws import (
    DRIFT,
    OTHER_NOISE,
    RADIUS,
    RIPPLE_AMPLITUDE,
    RIPPLE_PHASE,
    RIPPLE_RATIO,
    StudyTruth,
)
from counterspin.studies.engine import EnginePart, Reported, StudyEngine
from counterspin.studies.full import FullEngine, Instrumented
from counterspin.studies.joint import JointAnalysis, JointEngine, scale_factors
from counterspin.studies.surrogate import Surrogate, box_of
from counterspin.studies.tally import Driver, Tally
from counterspin.studies.two_stage import TwoStageEngine
from counterspin.studies.validity import against_joint, against_strobes

EngineName = Literal["auto", "surrogate", "exact", "full"]

#: Above this share of draws outside its box a surrogate is not worth having.
_OUTSIDE: Final = 0.5


@dataclass(frozen=True)
class Analysis:
    """One competitor.

    Attributes
    ----------
    name
        As the study calls it.
    owner
        The accelerometer of a two-stage analysis; empty for the joint fit of all.
    what
        The analysis itself.
    """

    name: str
    owner: str
    what: TwoStageRequest | JointAnalysis


def drivers_of(truth: StudyTruth) -> tuple[Driver, ...]:
    """Return the quantities against which the bias is shown: drift and ripple, if they vary."""
    found = []
    for symbol, causes in ((DRIFT, (DRIFT,)), (RIPPLE_RATIO, (RIPPLE_RATIO, RIPPLE_AMPLITUDE))):
        if truth.varies(*causes):
            low, high = truth.largest(symbol, 0)
            if symbol == RIPPLE_RATIO:
                low, high = (0.0, max(abs(low), abs(high)))
            found.append(Driver(symbol, low, high))
    return tuple(found)


def prepare(
    world: Instrumented,
    truth: StudyTruth,
    analyses: Sequence[Analysis],
    seed: int,
    engine: EngineName = "auto",
) -> StudyEngine:
    """Choose and prepare an engine for each analysis.

    Raises
    ------
    NotIdentifiableError
        If the engine asked for is not valid for an analysis, or an analysis cannot determine
        anything.
    """
    parts = tuple(choose_engine(world, truth, one, engine) for one in analyses)
    for part, one in zip(parts, analyses, strict=True):
        if not part.reported:
            raise NotIdentifiableError(f"{one.name}: the records determine no coefficient")
    return StudyEngine(truth, seed, parts, Tally(drivers_of(truth)))


def choose_engine(
    world: Instrumented, truth: StudyTruth, analysis: Analysis, engine: EngineName
) -> EnginePart:
    """Return the fastest engine that is valid for an analysis, or the one asked for.

    Raises
    ------
    NotIdentifiableError
        If the engine asked for is not valid, with the reason.
    """
    joint_ = isinstance(analysis.what, JointAnalysis)
    against = (
        against_joint(world, truth, analysis.what)
        if isinstance(analysis.what, JointAnalysis)
        else against_strobes(world, truth, analysis.what, analysis.owner)
    )
    if against and engine in ("surrogate", "exact"):
        raise NotIdentifiableError(
            f'{analysis.name}: `engine="{engine}"` is not valid here: {"; ".join(against)}; '
            'use `engine="full"`, or leave the choice to the program'
        )
    if against or engine == "full":
        words = "full records" + (f" ({against[0]})" if against and engine == "auto" else "")
        return (
            _joint_full(world, truth, analysis, words)
            if joint_
            else _strobed_full(world, truth, analysis, words)
        )
    return _joint(world, truth, analysis) if joint_ else _strobed(world, truth, analysis, engine)


def _strobed(
    world: Instrumented, truth: StudyTruth, analysis: Analysis, engine: EngineName
) -> EnginePart:
    what = analysis.what
    assert isinstance(what, TwoStageRequest)
    motions = tuple(world.strobed(run, analysis.owner) for run in range(len(world.runs)))
    true = tuple(
        (owner, symbol)
        for owner, symbols in truth.symbols.items()
        if owner in ("", analysis.owner)
        for symbol in symbols
    )
    symbols = [symbol for _, symbol in true]
    symbols += [s for s in (*what.unknowns, *what.considered) if s != RIPPLE]
    symbols = list(dict.fromkeys(symbols))
    surrogates: tuple[Surrogate, ...] | None = None
    kind, words = "exact", "sufficient statistics, exact quadrature"
    if engine != "exact":
        boxes = []
        for run, motion in enumerate(motions):
            low, high = truth.largest(RIPPLE_RATIO, run)
            size = max(abs(low), abs(high))
            rippling = truth.varies(RIPPLE_RATIO, RIPPLE_AMPLITUDE, RIPPLE_PHASE)
            sample = truth.draw(np.random.default_rng(0), 1)
            row = min(run, sample.ripple_cos.shape[0] - 1)
            cos, sin = float(sample.ripple_cos[row, 0]), float(sample.ripple_sin[row, 0])
            boxes.append(
                box_of(
                    motion,
                    truth.largest(DRIFT, run),
                    (-size, size) if rippling else (cos, cos),
                    (-size, size) if rippling else (sin, sin),
                    truth.largest(RADIUS, run),
                )
            )
        fitted = tuple(
            Surrogate.fit(motion, symbols, box, world.radius)
            for motion, box in zip(motions, boxes, strict=True)
        )
        outside = _outside(truth, fitted)
        if engine == "surrogate" or outside < _OUTSIDE:
            surrogates = fitted
            varies = any(box.varies.size for box in boxes)
            kind = "sampled" if what.sigma is None else "constant"
            kind = "surrogate" if varies else kind
            words = "sufficient statistics"
            if varies:
                error = max(one.error for one in fitted)
                words += f", surrogate of degree 4 (error {error:.0e})"
            if outside:
                kind = "exact" if outside > 0.05 else kind
                words += f", exact quadrature for the {100.0 * outside:.2g} % outside its box"
    made = TwoStageEngine(
        what, analysis.owner, motions, tuple(symbols), true, surrogates, world.radius
    )
    rows = [i for i, symbol in enumerate(what.unknowns) if symbol != RIPPLE]
    return EnginePart(
        made,
        kind,
        _stream(world, analysis),
        words,
        tuple(rows),
        _reported_strobes(world, truth, analysis),
    )


def _stream(world: Instrumented, analysis: Analysis) -> int:
    """Return a stream that two-stage analyses of one accelerometer share, and joint ones too."""
    names = list(world.mountings)
    return names.index(analysis.owner) if analysis.owner else len(names)


def _outside(truth: StudyTruth, surrogates: Sequence[Surrogate]) -> float:
    """Return the share of trials in which some run lies outside its surrogate's box."""
    draws = truth.draw(np.random.default_rng(1), 2000)
    inside = np.ones(draws.trials, dtype=bool)
    for run, surrogate in enumerate(surrogates):
        parts = (draws.drift, draws.ripple_cos, draws.ripple_sin)
        small = [part[min(run, part.shape[0] - 1)] for part in parts]
        inside &= surrogate.holds([*small, draws.radius])
    return 1.0 - float(inside.mean())


def _strobed_full(
    world: Instrumented, truth: StudyTruth, analysis: Analysis, words: str
) -> EnginePart:
    what = analysis.what
    assert isinstance(what, TwoStageRequest)
    rows = [i for i, symbol in enumerate(what.unknowns) if symbol != RIPPLE]
    made = FullEngine(world, what, analysis.owner)
    return EnginePart(
        made,
        "full",
        _stream(world, analysis),
        words,
        tuple(rows),
        _reported_strobes(world, truth, analysis),
    )


def _reported_strobes(
    world: Instrumented, truth: StudyTruth, analysis: Analysis
) -> tuple[Reported, ...]:
    what = analysis.what
    assert isinstance(what, TwoStageRequest)
    unknowns = tuple(
        Unknown(analysis.owner, symbol, prior, term(symbol).limit)
        for symbol, prior in what.unknowns.items()
        if symbol != RIPPLE
    )
    bounds = cramer_rao(world, truth, Unknowns(unknowns))
    return tuple(
        Reported(analysis.name, one.owner, one.symbol, bounds.get(one.name)) for one in unknowns
    )


def _joint(world: Instrumented, truth: StudyTruth, analysis: Analysis) -> EnginePart:
    what = analysis.what
    assert isinstance(what, JointAnalysis)
    series = [
        world.series(run, name, truth.spindles[run])
        for run in range(len(world.runs))
        for name in world.mountings
    ]
    made, lost = JointEngine.prepare(series, what, truth)
    bounds = cramer_rao(world, truth, what.model)
    reported = tuple(
        Reported(analysis.name, u.owner, u.symbol, bounds.get(u.name))
        for u in (what.model.unknowns[i] for i in made.rows)
    )
    return EnginePart(
        made,
        "constant",
        _stream(world, analysis),
        "sufficient statistics",
        tuple(range(len(reported))),
        reported,
        lost,
    )


def _joint_full(
    world: Instrumented, truth: StudyTruth, analysis: Analysis, words: str
) -> EnginePart:
    what = analysis.what
    assert isinstance(what, JointAnalysis)
    bounds = cramer_rao(world, truth, what.model)
    rows = [
        i
        for i, u in enumerate(what.model.unknowns)
        if (u.symbol in TERMS or (not u.owner and u.symbol not in ROTATION))
    ]
    kept = [i for i in rows if bounds.get(what.model.unknowns[i].name) is not None]
    lost = tuple(what.model.unknowns[i].name for i in rows if i not in kept)
    made = FullEngine(world, what, rows=tuple(kept))
    reported = tuple(
        Reported(analysis.name, u.owner, u.symbol, bounds[u.name])
        for u in (what.model.unknowns[i] for i in kept)
    )
    return EnginePart(
        made, "full", _stream(world, analysis), words, tuple(range(len(kept))), reported, lost
    )


def cramer_rao(world: Instrumented, truth: StudyTruth, model: Unknowns) -> dict[str, float]:
    """Return the least standard uncertainty from all samples of the records, by unknown.

    The bound is that of the records' true noise, of the unknowns of the analysis with what is
    known of them beforehand (the posterior bound of van Trees), everything else being known. An
    unknown that the records do not determine has none.
    """
    draws = truth.draw(np.random.default_rng(0), 256)
    levels = {OTHER_NOISE[key]: float(value.mean()) for key, value in draws.noise.items()}
    world = replace(world, **levels)  # type: ignore[arg-type]
    noise = NoiseModel(float(draws.white.mean()), world.random_walk, world.quantisation)
    if noise.sample_variance == 0.0 and noise.random_walk == 0.0:
        return {}
    names = {u.owner for u in model.unknowns if u.symbol in TERMS} or set(world.mountings)
    series = [
        world.series(run, name, truth.spindles[run])
        for run in range(len(world.runs))
        for name in world.mountings
        if name in names
    ]
    plain = Unknowns(model.unknowns)
    prepared = prepare_columns(series, plain, scale_factors(series, plain, truth))
    fit = solve_joint(prepared, plain, dict.fromkeys(names, noise))
    determined = assess(fit.solution, [u.name for u in model.unknowns]).determined
    variance = np.diag(fit.solution.covariance_noise + fit.solution.covariance_prior)
    return {
        u.name: float(np.sqrt(v))
        for u, v in zip(model.unknowns, variance, strict=True)
        if determined[u.name]
    }
