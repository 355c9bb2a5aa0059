"""Trials of the joint fit straight from its distribution, and the Cramer-Rao bound of a study.

Given the rotation, the joint fit is linear, so that with Gaussian noise of known size its estimate
is normal about a linear function of what is true. Each series is whitened and reduced once, the
columns of what is true carried along as considered terms; a trial then costs as many normals as
there are unknowns. An input that is not what is stated of it counts by the column that the fit
itself has of it, taken where the coefficients are what is true on average.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference import least_squares
from counterspin.inference.identifiability import assess
from counterspin.inference.joint.fit import solve_blocks
from counterspin.inference.joint.prepared import prepare_columns
from counterspin.inference.joint.series import Series, concerns, input_column
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.least_squares import Block, Solution, reduce_block
from counterspin.inference.linear_readings import Measured, blocks_at
from counterspin.inference.noise.model import Noise
from counterspin.physics.terms import INPUTS, TERMS
from counterspin.studies.draws import (
    NOISE_LEVELS,
    Draws,
    StudyTruth,
    estimate_noise,
    nominal,
    of_run,
)
from counterspin.studies.validity import JointRequest
from counterspin.studies.work import Trials
from counterspin.studies.world import World

#: (owner, symbol, run) of a term or an input that is true; run is None where the runs share one.
Key = tuple[str, str, int | None]


@frozen
class JointEngine:
    """Trials of one joint analysis."""

    rows: tuple[int, ...]  #: Places in the model of the unknowns that are reported.
    #: Estimate, nominal value added, where all that is true is nominal, shape (c,).
    constant: Array
    response: Mapping[Key, Array]  #: d(estimate)/d(value) of what is true, shape (c,).
    spread: Array  #: What independent normals are multiplied with, shape (c, c).
    u: Array  #: Combined standard uncertainty, shape (c,).
    white: float  #: The white noise assumed, m.

    @classmethod
    def prepare(
        cls, series: Sequence[Series], request: JointRequest, truth: StudyTruth
    ) -> tuple[JointEngine, tuple[str, ...]]:
        """Reduce all series and solve once."""
        noise = request.noise
        model = request.model
        names = list(dict.fromkeys(record.run for record in series))
        keys = _truth_keys(series, truth, names)
        blocks = []
        for record in series:
            given = noise[record.accelerometer]
            blocks.append(_block(record, model, given, keys, names, truth))
        solution = _solve(blocks, model, len(keys))
        assessment = assess(solution, [u.name for u in model.unknowns])
        rows = [i for i in request.reported if assessment.determined[model.unknowns[i].name]]
        lost = tuple(model.unknowns[i].name for i in request.reported if i not in rows)
        c = len(model.considered)
        moved = -solution.sensitivity_considered[:, c:][rows]
        values, vectors = np.linalg.eigh(solution.covariance_noise[np.ix_(rows, rows)])
        covariance = (
            solution.covariance_noise + solution.covariance_prior + solution.covariance_considered
        )
        first = noise[series[0].accelerometer]
        engine = cls(
            rows=tuple(rows),
            constant=solution.estimate[rows] + np.array([model.unknowns[i].nominal for i in rows]),
            response={key: moved[:, index] for index, key in enumerate(keys)},
            spread=vectors * np.sqrt(np.maximum(values, 0.0)),
            u=np.sqrt(np.diag(covariance)[rows]),
            white=math.sqrt(first.sample_variance),
        )
        return engine, lost

    def trials(self, draws: Draws, generator: np.random.Generator) -> Trials:
        """Return what the analysis says of n trials; see `Engine`."""
        n = draws.trials
        scale = draws.white / self.white if self.white > 0.0 else 1.0
        estimate = estimate_noise(generator, self.spread, scale, n)
        estimate += self.constant[:, None]
        for (owner, symbol, run), response in self.response.items():
            if symbol in INPUTS:
                estimate += np.outer(response, draws.off(symbol, owner))
                continue
            size = of_run(draws.values[owner, symbol], run or 0) - nominal(owner, symbol)
            estimate += np.outer(response, size)
        u = np.broadcast_to(self.u[:, None], estimate.shape)
        return Trials(estimate, u, np.full((1, 1), math.inf) * np.ones((len(self.u), 1)))


def scale_factors(series: Sequence[Series], model: Unknowns, truth: StudyTruth) -> dict[str, float]:
    """Return the K_I with which each accelerometer sees the platform's errors.

    `calibrate` takes it from the estimate; here what is true on average stands for that.
    """
    factors = {}
    for name in dict.fromkeys(record.accelerometer for record in series):
        known = [c.prior[0] for c in model.considered if c.owner == name and c.symbol == "K_I"]
        factors[name] = known[0] if known else truth.mean(name, "K_I")
    return factors


def _truth_keys(series: Sequence[Series], truth: StudyTruth, runs: Sequence[str]) -> list[Key]:
    """Return a key for each column of what is true, terms before inputs."""
    accelerometers = {record.accelerometer for record in series}
    keys: list[Key] = []
    for owner, symbols in truth.symbols.items():
        if owner and owner not in accelerometers:
            continue
        for symbol in symbols:
            fixed = truth.fixed.get((owner, symbol))
            several = fixed is not None and fixed.size > 1
            several |= any(
                (varying.owner, varying.symbol) == (owner, symbol) and varying.per_run
                for varying in truth.varying
            )
            places: list[int | None] = list(range(len(runs))) if several else [None]
            keys += [(owner, symbol, place) for place in places]
    return [*keys, *((recorder, symbol, None) for recorder, symbol in truth.moving_inputs)]


def _block(
    series: Series,
    model: Unknowns,
    noise: Noise,
    keys: Sequence[Key],
    runs: Sequence[str],
    truth: StudyTruth,
) -> Block:
    """Whiten and reduce one series: unknowns, considered terms, columns of what is true."""
    factors = scale_factors([series], model, truth)
    expected = np.array([truth.mean(u.owner, u.symbol) - u.nominal for u in model.unknowns])
    (prepared,) = prepare_columns([series], model, factors, expected)
    true = _columns_of_truth(series, keys, runs, truth)
    whiten = series.whitener(noise)
    own = series.polynomials(whiten.polynomials)
    rows = whiten.apply(np.column_stack([own, prepared.design, prepared.fixed, true]))
    m, p = whiten.polynomials, prepared.design.shape[1]
    block = reduce_block(rows[:, m : m + p], np.zeros(rows.shape[0]), rows[:, :m], rows[:, m + p :])
    factor = np.zeros((block.factor.shape[0], len(model.unknowns)))
    factor[:, list(prepared.unknowns)] = block.factor
    c = len(model.considered)
    fixed = np.zeros((block.factor.shape[0], c + true.shape[1]))
    places = [*prepared.considered, *range(c, c + true.shape[1])]
    fixed[:, places] = block.considered
    return replace(block, factor=factor, considered=fixed)


def _columns_of_truth(
    series: Series, keys: Sequence[Key], runs: Sequence[str], truth: StudyTruth
) -> Array:
    """Return what a series shows of each that is true, shape (n, keys); of others' zero."""
    name = series.accelerometer
    here = {
        (owner, symbol): index
        for index, (owner, symbol, run) in enumerate(keys)
        if run in (None, runs.index(series.run))
        and (owner in ("", name) if symbol not in INPUTS else concerns(series, symbol, owner))
    }
    terms = [key for key in here if key[1] not in INPUTS]
    k_i = truth.mean(name, "K_I")
    shown = series.columns([symbol for _, symbol in terms], k_i).T
    table = {symbol: column for (_, symbol), column in zip(terms, shown, strict=True)}
    mean = {symbol: truth.mean(owner, symbol) - nominal(owner, symbol) for owner, symbol in terms}
    base = series.reference()
    true = np.zeros((series.time.size, len(keys)))
    for (_, symbol), index in here.items():
        if symbol not in INPUTS:
            true[:, index] = table[symbol]
        else:
            true[:, index] = input_column(series, symbol, k_i, mean, table, base)
    return true


def _solve(blocks: Sequence[Block], model: Unknowns, true: int) -> Solution:
    """Solve with the columns of what is true as considered terms without uncertainty."""
    return least_squares.solve(
        blocks,
        prior_mean=[u.prior_mean for u in model.unknowns],
        prior_sd=[u.prior[1] for u in model.unknowns],
        considered_mean=[*model.considered_means, *(0.0 for _ in range(true))],
        considered_sd=[*model.considered_sizes, *(0.0 for _ in range(true))],
        limits=[u.limit for u in model.unknowns],
    )


def bounds(
    truth: StudyTruth, model: Unknowns, world: World | None, readings: Sequence[Measured] = ()
) -> dict[str, float]:
    """Return the least standard uncertainty from all samples and readings, by unknown.

    The bound is that of the true noise, of the unknowns of the analysis with what is known of them
    beforehand (the posterior bound of van Trees), everything else being known. An unknown that the
    data do not determine has none.

    world: Of the records; None: there are none.
    readings: With their true noise.
    """
    model = Unknowns(model.unknowns)
    blocks = [] if world is None else _blocks_of_records(world, truth, model)
    if readings:
        at = np.array([truth.mean(u.owner, u.symbol) - u.nominal for u in model.unknowns])
        blocks += blocks_at(readings, model, at)
    if not blocks:
        return {}
    solution = solve_blocks(blocks, model)
    determined = assess(solution, [u.name for u in model.unknowns]).determined
    variance = np.diag(solution.covariance_noise + solution.covariance_prior)
    return {
        u.name: float(np.sqrt(v))
        for u, v in zip(model.unknowns, variance, strict=True)
        if determined[u.name]
    }


def _blocks_of_records(world: World, truth: StudyTruth, model: Unknowns) -> list[Block]:
    """Return the blocks of the records with their true noise; none without noise."""
    draws = truth.draw(np.random.default_rng(0), 256)
    levels = {NOISE_LEVELS[symbol][1]: float(level.mean()) for symbol, level in draws.noise.items()}
    world = replace(world, noise=replace(world.noise, white=float(draws.white.mean()), **levels))
    level = world.noise
    noise = Noise(
        level.white, level.random_walk, level.quantisation, level.flicker, level.bias_walk
    )
    if noise.sample_variance == 0.0 and noise.random_walk == 0.0:
        return []
    names = {u.owner for u in model.unknowns if u.symbol in TERMS} or set(world.mountings)
    series = [
        world.series(run, name, truth.spindles[run])
        for run in range(len(world.runs))
        for name in world.mountings
        if name in names
    ]
    prepared = prepare_columns(series, model, scale_factors(series, model, truth))
    noises = dict.fromkeys(names, noise)
    return [part.block_in(model, noises) for part in prepared]
