"""Which engine each analysis of a study gets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, Literal

import numpy as np

from counterspin.campaign.description import Campaign
from counterspin.errors import NotIdentifiableError
from counterspin.inference.joint.unknowns import RIPPLE, Unknown, Unknowns
from counterspin.inference.two_stage.model import TwoStageRequest
from counterspin.studies.description import StudyDescription
from counterspin.studies.draws import DRIFT, RIPPLE_AMPLITUDE, RIPPLE_RATIO, StudyTruth
from counterspin.studies.joint_engine import JointEngine, bounds
from counterspin.studies.tally import Driver, Tally
from counterspin.studies.two_stage_engine import (
    Surrogate,
    TwoStageEngine,
    box_of,
    changes_by_inputs,
)
from counterspin.studies.validity import (
    Analysis,
    JointRequest,
    against_joint,
    against_strobes,
    analyses_of,
)
from counterspin.studies.whole_trials import FullEngine, TrialReadings
from counterspin.studies.work import Cost, EnginePart, ReportedCoefficient, StudyEngine
from counterspin.studies.world import World, world_of

EngineName = Literal["auto", "surrogate", "exact", "full"]

#: Largest share of draws outside its box with which a surrogate is worth having.
_LARGEST_SHARE_OUTSIDE: Final = 0.5


def prepare(study: StudyDescription, seed: int, engine: EngineName = "auto") -> StudyEngine:
    """Choose and prepare an engine for each analysis of a study."""
    campaign = study.campaign
    truth = StudyTruth.of(campaign, study.varying)
    # Readings alone need no records, and so no world of them.
    read = campaign.readings or campaign.posed
    world = world_of(campaign) if campaign.runs or not read else None
    parts = []
    for analysis in analyses_of(study):
        if read:
            parts.append(_with_readings(campaign, world, truth, analysis, engine))
        else:
            assert world is not None
            parts.append(choose_engine(world, truth, analysis, engine))
        if not parts[-1].reported:
            raise NotIdentifiableError(f"{analysis.name}: the records determine no coefficient")
    return StudyEngine(truth, seed, tuple(parts), Tally(_drivers(truth)))


def _drivers(truth: StudyTruth) -> tuple[Driver, ...]:
    """Return the quantities against which the bias is shown: drift and ripple, if they vary."""
    drivers = []
    if truth.varies(DRIFT):
        drivers.append(Driver(DRIFT, *truth.bounds(DRIFT, 0)))
    if truth.varies(RIPPLE_RATIO, RIPPLE_AMPLITUDE):
        largest = max(map(abs, truth.bounds(RIPPLE_RATIO, 0)))
        drivers.append(Driver(RIPPLE_RATIO, 0.0, largest))
    return tuple(drivers)


def choose_engine(
    world: World, truth: StudyTruth, analysis: Analysis, engine: EngineName
) -> EnginePart:
    """Return the fastest engine that is valid for an analysis, or the one asked for."""
    request = analysis.request
    against = (
        against_joint(world, truth, request)
        if isinstance(request, JointRequest)
        else against_strobes(world, truth, request, analysis.owner)
    )
    if against and engine in ("surrogate", "exact"):
        raise NotIdentifiableError(
            f'{analysis.name}: `engine="{engine}"` is not valid here: {"; ".join(against)}; '
            'use `engine="full"`, or omit `engine`'
        )
    if against and engine == "auto":
        return _full(world, truth, analysis, f"full records ({against[0]})")
    if engine == "full":
        return _full(world, truth, analysis, "full records")
    if isinstance(request, JointRequest):
        return _joint(world, truth, analysis, request)
    return _two_stage(world, truth, analysis, request, engine)


def _with_readings(
    campaign: Campaign,
    world: World | None,
    truth: StudyTruth,
    analysis: Analysis,
    engine: EngineName,
) -> EnginePart:
    """Return the engine of a campaign with readings, records beside them or not."""
    if engine in ("surrogate", "exact"):
        raise NotIdentifiableError(
            f'{analysis.name}: `engine="{engine}"` is not valid here: there are readings; '
            'use `engine="full"`, or omit `engine`'
        )
    try:
        readings = TrialReadings.of(campaign)
    except ValueError as error:
        raise NotIdentifiableError(f"{analysis.name}: {error}") from error
    words = "readings" if world is None else "full records and readings"
    return _full_joint(world, truth, analysis, analysis.joint, words, readings)


def _two_stage(
    world: World,
    truth: StudyTruth,
    analysis: Analysis,
    request: TwoStageRequest,
    engine: EngineName,
) -> EnginePart:
    motions = tuple(world.strobed(run, analysis.owner) for run in range(len(world.runs)))
    true = tuple(
        (owner, symbol)
        for owner, symbols in truth.symbols.items()
        if owner in ("", analysis.owner)
        for symbol in symbols
    )
    asked = [s for s in (*request.unknowns, *request.considered) if s != RIPPLE]
    symbols = tuple(dict.fromkeys([*(symbol for _, symbol in true), *asked]))
    surrogates: tuple[Surrogate, ...] | None = None
    cost: Cost
    cost, words = "exact", "sufficient statistics, exact quadrature"
    if engine != "exact":
        boxes = [box_of(motion, truth.small_bounds(run)) for run, motion in enumerate(motions)]
        fitted = tuple(
            Surrogate.fit(motion, symbols, box) for motion, box in zip(motions, boxes, strict=True)
        )
        outside = _share_outside(truth, fitted)
        if engine == "surrogate" or outside < _LARGEST_SHARE_OUTSIDE:
            surrogates = fitted
            cost, words = (
                "sampled" if request.sigma is None else "constant",
                "sufficient statistics",
            )
            if any(box.varies.size for box in boxes):
                error = max(surrogate.error for surrogate in fitted)
                cost = "surrogate"
                words += f", surrogate of degree 4 (error {error:.0e})"
            if outside:
                cost = "exact" if outside > 0.05 else cost
                words += f", exact quadrature for the {100.0 * outside:.2g} % outside its box"
    inputs = changes_by_inputs(world, truth, analysis.owner, symbols)
    made = TwoStageEngine(request, analysis.owner, motions, symbols, true, surrogates, inputs)
    rows, reported = _of_two_stage(world, truth, analysis, request)
    return EnginePart(made, cost, _stream(world, analysis), words, rows, reported)


def _stream(world: World, analysis: Analysis) -> int:
    """Return a stream that two-stage analyses of one accelerometer share, and joint ones too."""
    names = list(world.mountings)
    return names.index(analysis.owner) if analysis.owner else len(names)


def _share_outside(truth: StudyTruth, surrogates: Sequence[Surrogate]) -> float:
    """Return the share of trials in which some run lies outside its surrogate's box."""
    draws = truth.draw(np.random.default_rng(1), 2000)
    inside = np.ones(draws.trials, dtype=bool)
    for run, surrogate in enumerate(surrogates):
        inside &= surrogate.holds(draws.small(run))
    return 1.0 - float(inside.mean())


def _joint(
    world: World, truth: StudyTruth, analysis: Analysis, request: JointRequest
) -> EnginePart:
    series = [
        world.series(run, name, truth.spindles[run])
        for run in range(len(world.runs))
        for name in world.mountings
    ]
    made, lost = JointEngine.prepare(series, request, truth)
    least = bounds(truth, request.model, world)
    reported = _reported(analysis, [request.model.unknowns[place] for place in made.rows], least)
    rows, noise = tuple(range(len(reported))), _stream(world, analysis)
    return EnginePart(made, "constant", noise, "sufficient statistics", rows, reported, lost)


def _full(world: World, truth: StudyTruth, analysis: Analysis, words: str) -> EnginePart:
    request = analysis.request
    if isinstance(request, JointRequest):
        return _full_joint(world, truth, analysis, request, words)
    rows, reported = _of_two_stage(world, truth, analysis, request)
    made = FullEngine(world, request, analysis.joint, analysis.owner)
    return EnginePart(made, "full", _stream(world, analysis), words, rows, reported)


def _full_joint(
    world: World | None,
    truth: StudyTruth,
    analysis: Analysis,
    request: JointRequest,
    words: str,
    readings: TrialReadings | None = None,
) -> EnginePart:
    known = () if readings is None else readings.with_true_noise
    least = bounds(truth, request.model, world, known)
    unknowns = request.model.unknowns
    kept = tuple(place for place in request.reported if unknowns[place].name in least)
    lost = tuple(unknowns[place].name for place in request.reported if place not in kept)
    return EnginePart(
        engine=FullEngine(world, request, request, rows=kept, readings=readings),
        cost="readings" if world is None else "full",
        noise=0 if world is None or readings is not None else _stream(world, analysis),
        words=words,
        rows=tuple(range(len(kept))),
        reported=_reported(analysis, [unknowns[place] for place in kept], least),
        lost=lost,
    )


def _of_two_stage(
    world: World, truth: StudyTruth, analysis: Analysis, request: TwoStageRequest
) -> tuple[tuple[int, ...], tuple[ReportedCoefficient, ...]]:
    """Return which of a two-stage analysis' unknowns are reported: all but the printed ripple."""
    symbols = list(request.unknowns)
    rows = tuple(row for row, symbol in enumerate(symbols) if symbol != RIPPLE)
    unknowns = [
        Unknown(analysis.owner, symbol, request.unknowns[symbol], request.limit_of(symbol))
        for symbol in (symbols[row] for row in rows)
    ]
    return rows, _reported(analysis, unknowns, bounds(truth, Unknowns(tuple(unknowns)), world))


def _reported(
    analysis: Analysis, unknowns: Sequence[Unknown], least: Mapping[str, float]
) -> tuple[ReportedCoefficient, ...]:
    return tuple(
        ReportedCoefficient(analysis.name, unknown.owner, unknown.symbol, least.get(unknown.name))
        for unknown in unknowns
    )
