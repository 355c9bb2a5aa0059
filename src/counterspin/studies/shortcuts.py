"""Shortcuts: trials drawn from the distribution of an analysis' sufficient statistics.

Joint fit. Given the rotation it is linear, so that with Gaussian noise of known size its estimate
is normal about a linear function of the true values. Each series is whitened and reduced once, with
the columns of the true values as considered terms; a trial then costs as many normals as
there are unknowns. An input that deviates from its stated value acts through the column
of the fit, evaluated at the mean true coefficients.

Two-stage method. With white Gaussian noise the first stage of a run is summed up by b2, which is
normal about the effect of the errors (`counterspin.studies.strobed_effects`), and by the sum of
squared residuals, a chi-square. Neither needs the strobes themselves. The second stage then is a
small least-squares problem, solved for all trials of a batch at once. One reading is taken at each
strobe, as the paper's plan has it.

`bounds` is the least uncertainty that any analysis of all samples and readings can have.
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
from counterspin.inference.joint.design_blocks import build_design_blocks
from counterspin.inference.joint.fit import solve_blocks
from counterspin.inference.joint.series import (
    ResidualSeries,
    expected_output,
    input_affects,
    input_column,
    with_input,
)
from counterspin.inference.joint.unknowns import RIPPLE, Unknowns
from counterspin.inference.least_squares import REGULARISATION, Block, Solution, reduce_block
from counterspin.inference.noise.model import Noise
from counterspin.inference.two_stage.model import TwoStageRequest
from counterspin.physics import as_printed
from counterspin.physics.terms import INPUTS, SHARED_TERMS, TERMS, term
from counterspin.readings.linear import ReadingGroup, blocks_at
from counterspin.studies.draws import (
    NOISE_LEVELS,
    Draws,
    StudyTruth,
    curvature_noise,
    estimate_noise,
    nominal,
    of_run,
    residual_variances,
)
from counterspin.studies.strobed_effects import StrobedMotion, Surrogate, curvature_gain, effects
from counterspin.studies.work import JointRequest, Trials
from counterspin.studies.world import World

#: (owner, symbol, run) of a term or an input that is true; run is None where the runs share one.
Key = tuple[str, str, int | None]


@frozen
class JointEngine:
    """Trials of one joint analysis."""

    rows: tuple[int, ...]  #: Places in the model of the unknowns that are reported.
    #: Estimate, nominal value added, where all that is true is nominal, shape (c,).
    constant: Array
    response: Mapping[Key, Array]  #: d(estimate)/d(value) of the true values, shape (c,).
    spread: Array  #: What independent normals are multiplied with, shape (c, c).
    u: Array  #: Combined standard uncertainty, shape (c,).
    white: float  #: The white noise assumed, m.

    @classmethod
    def prepare(
        cls, series: Sequence[ResidualSeries], request: JointRequest, truth: StudyTruth
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
        """Return the results of the analysis for n trials; see `Engine`."""
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


def scale_factors(
    series: Sequence[ResidualSeries], model: Unknowns, truth: StudyTruth
) -> dict[str, float]:
    """Return the K_I with which each accelerometer sees the platform's errors.

    `calibrate` takes it from the estimate; a study takes the mean true value.
    """
    factors = {}
    for name in dict.fromkeys(record.accelerometer for record in series):
        known = [c.prior[0] for c in model.considered if c.owner == name and c.symbol == "K_I"]
        factors[name] = known[0] if known else truth.mean(name, "K_I")
    return factors


def _truth_keys(
    series: Sequence[ResidualSeries], truth: StudyTruth, runs: Sequence[str]
) -> list[Key]:
    """Return a key for each column of the true values, terms before inputs."""
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
    series: ResidualSeries,
    model: Unknowns,
    noise: Noise,
    keys: Sequence[Key],
    runs: Sequence[str],
    truth: StudyTruth,
) -> Block:
    """Whiten and reduce one series: unknowns, considered terms, columns of the true values."""
    factors = scale_factors([series], model, truth)
    expected = np.array([truth.mean(u.owner, u.symbol) - u.nominal for u in model.unknowns])
    (prepared,) = build_design_blocks([series], model, factors, expected)
    true = _columns_of_truth(series, keys, runs, truth)
    whiten = series.whitener(noise)
    polynomials = series.polynomials(whiten.polynomials)
    rows = whiten.apply(np.column_stack([polynomials, prepared.design, prepared.fixed, true]))
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
    series: ResidualSeries, keys: Sequence[Key], runs: Sequence[str], truth: StudyTruth
) -> Array:
    """Return the columns of the true values in a series, shape (n, keys); zero for other series."""
    name = series.accelerometer
    indices = {
        (owner, symbol): index
        for index, (owner, symbol, run) in enumerate(keys)
        if run in (None, runs.index(series.run))
        and (owner in ("", name) if symbol not in INPUTS else input_affects(series, symbol, owner))
    }
    terms = [key for key in indices if key[1] not in INPUTS]
    k_i = truth.mean(name, "K_I")
    shown = series.columns([symbol for _, symbol in terms], k_i).T
    table = {symbol: column for (_, symbol), column in zip(terms, shown, strict=True)}
    mean = {symbol: truth.mean(owner, symbol) - nominal(owner, symbol) for owner, symbol in terms}
    now = expected_output(series, mean, table)
    true = np.zeros((series.time.size, len(keys)))
    for (_, symbol), index in indices.items():
        if symbol not in INPUTS:
            true[:, index] = table[symbol]
        else:
            true[:, index] = input_column(series, symbol, k_i, mean, now)
    return true


def _solve(blocks: Sequence[Block], model: Unknowns, true: int) -> Solution:
    """Solve with the columns of the true values as considered terms without uncertainty."""
    return least_squares.solve(
        blocks,
        prior_mean=[u.prior_mean for u in model.unknowns],
        prior_sd=[u.prior[1] for u in model.unknowns],
        considered_mean=[*model.considered_means, *(0.0 for _ in range(true))],
        considered_sd=[*model.considered_sds, *(0.0 for _ in range(true))],
        limits=[u.limit for u in model.unknowns],
    )


def bounds(
    truth: StudyTruth, model: Unknowns, world: World | None, readings: Sequence[ReadingGroup] = ()
) -> dict[str, float]:
    """Return the least standard uncertainty from all samples and readings, by unknown.

    The bound holds for the true noise and for the unknowns of the analysis with their priors (the
    posterior bound of van Trees); all other quantities are known. An unknown that the data do not
    determine has no bound.

    world: The set-up of the records; None: the campaign has no records.
    readings: The readings, with their true noise.
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
    prepared = build_design_blocks(series, model, scale_factors(series, model, truth))
    noises = dict.fromkeys(names, noise)
    return [part.block_in(model, noises) for part in prepared]


@frozen
class TwoStageEngine:
    """Trials of one accelerometer's two-stage analysis."""

    request: TwoStageRequest  #: What the analysis estimates and takes as known.
    owner: str  #: The accelerometer.
    motions: tuple[StrobedMotion, ...]  #: The runs.
    #: The terms whose effects are computed: the true ones and those of the analysis.
    symbols: tuple[str, ...]
    true: tuple[tuple[str, str], ...]  #: Those that are true: (owner, symbol).
    surrogates: tuple[Surrogate, ...] | None  #: Of each run; None: quadrature for every trial.
    #: (recorder of a clock, else empty; symbol) of an input that is not as stated -> by how much it
    #: changes each effect in each run, and b2 of a perfect system, per unit, shape (q + 1, runs).
    inputs: Mapping[tuple[str, str], Array]

    def trials(self, draws: Draws, generator: np.random.Generator) -> Trials:
        """Return the results of the analysis; see `Engine`."""
        n, runs = draws.trials, len(self.motions)
        seen = [self._effects(draws, run) for run in range(runs)]
        assumed = _stacked([part for part, _ in seen], 1)  # (q, runs, n or 1)
        sizes = _stacked([size for _, size in seen], 0)  # sigma/u(b2)
        b2 = curvature_noise(generator, draws.white, sizes, n)
        b2 += _stacked([self._shift(draws, run, part) for run, (part, _) in enumerate(seen)], 0)
        variance = np.ones((1, 1))
        if self.request.sigma is None:
            variance = residual_variances(generator, draws.white, self._residual_dof, n)
        return self._analyse(b2, assumed, sizes, variance)

    @property
    def _residual_dof(self) -> Array:
        return np.array([motion.angles.size - 3.0 for motion in self.motions])

    def _effects(self, draws: Draws, run: int) -> tuple[Array, Array]:
        """Return the run's effects with the inputs as they are stated, and sigma/u(b2)."""
        small = draws.small(run)
        if self.surrogates is None:
            return effects(self.motions[run], self.symbols, *np.broadcast_arrays(*small))
        surrogate = self.surrogates[run]
        inside = surrogate.holds(small)
        if inside.all():
            return surrogate(small)
        n = draws.trials
        everywhere = [np.broadcast_to(part, n) for part in small]
        outside = ~np.broadcast_to(inside, n)
        b2, size = (
            np.array(np.broadcast_to(part, (*part.shape[:-1], n))) for part in surrogate(everywhere)
        )
        exact = effects(self.motions[run], self.symbols, *(part[outside] for part in everywhere))
        b2[:, outside], size[outside] = exact
        return b2, size

    def _shift(self, draws: Draws, run: int, effect: Array) -> Array:
        """Return the shift of a run's b2 by the true errors, shape (n or 1,)."""
        total = np.zeros(1)
        for key, changes in self.inputs.items():
            effect = effect + changes[:-1, run, None] * draws.inputs[key]
            total = total + changes[-1, run] * draws.inputs[key]
        scale = draws.values.get((self.owner, "K_I"), np.ones((1, 1)))
        k_i = of_run(scale, run)
        for owner, symbol in self.true:
            size = of_run(draws.values[owner, symbol], run)
            size = size * k_i if symbol in SHARED_TERMS else size - term(symbol).nominal
            total = total + size * effect[self.symbols.index(symbol)]
        return total

    def _analyse(self, b2: Array, assumed: Array, sizes: Array, variance: Array) -> Trials:
        """Apply the second stage to all trials.

        With columns x_r, weights w_r and a prior P the inverse information is
        C = (sum_r w_r x_r x_r' + P)^-1, and the gain, d(estimate)/d(b2), is C x_r w_r.
        """
        request, unknowns, considered = self.request, self.request.unknowns, self.request.considered
        noise = (variance if request.sigma is None else request.sigma**2) / sizes**2
        weight = 1.0 / (noise if request.weighted else np.mean(noise, axis=0, keepdims=True))
        design = np.stack([self._column(symbol, assumed) for symbol in unknowns])
        fixed = {symbol: self._column(symbol, assumed) for symbol in considered}
        mean = np.array([m for m, _ in unknowns.values()])
        sd = np.array([s for _, s in unknowns.values()])
        limits = [request.limit_of(symbol) for symbol in unknowns]
        prior_sd = np.where(np.isinf(sd), REGULARISATION * np.array(limits), sd)
        inverse = _inverse(_information(design, weight, prior_sd))
        gain = sum(inverse[:, q, None] * design[q] for q in range(len(mean))) * weight
        explained = np.einsum("p,prn->rn", mean, design)
        for symbol, (value, _) in considered.items():
            explained = explained + (value - term(symbol).nominal) * fixed[symbol]
        estimate = _over_runs(gain, b2 - explained)
        estimate += mean[:, None]
        parts = gain**2 * noise
        scatter = np.sum(parts, axis=1)
        total = scatter + np.einsum("pqn,q->pn", inverse**2, 1.0 / prior_sd**2)
        for symbol, (_, spread) in considered.items():
            if spread == 0.0:
                continue
            if term(symbol).per_run:
                total = total + spread**2 * np.sum((gain * fixed[symbol]) ** 2, axis=1)
            else:
                total = total + (spread * _over_runs(gain, fixed[symbol])) ** 2
        # The b2 of a coefficient of degree n goes as R^n g^(1-n), that of a ripple as R.
        degree = [len(TERMS[s].effect.factors) if s in TERMS else 1 for s in unknowns]
        for u, powers in ((request.u_radius, degree), (request.u_gravity, [1 - n for n in degree])):
            if u > 0.0:
                sizes = u * np.array(powers)[:, None] * estimate
                total = total + _over_runs(gain, np.einsum("pn,prn->rn", sizes, design)) ** 2
        dof = np.full((1, 1), math.inf)
        if request.sigma is None:
            # Welch and Satterthwaite.
            dof = total**2 / _over_runs(parts**2, 1.0 / self._residual_dof[:, None])
        u = np.sqrt(total)
        return Trials(
            estimate,
            np.broadcast_to(u, estimate.shape),
            np.broadcast_to(dof, estimate.shape),
        )

    def _column(self, symbol: str, assumed: Array) -> Array:
        """Return d(b2)/d(unknown) of every run, shape (runs, n or 1)."""
        request = self.request
        if request.model == "exact":
            effect: Array = assumed[self.symbols.index(symbol)]
            return effect * request.scale_factor if symbol in SHARED_TERMS else effect
        rates = np.array([motion.spindle.rate for motion in self.motions])
        g = self.motions[0].site.gravity
        if symbol in ("K_II", RIPPLE):
            printed = as_printed.second_stage_columns(
                rates, self.motions[0].radius, g, request.scale_factor, request.ripple
            )
            return np.asarray(printed[:, [0 if symbol == "K_II" else 1]])
        return np.full((rates.size, 1), 0.5 * g if symbol == "K_F" else 0.0)


def changes_by_inputs(
    world: World, truth: StudyTruth, owner: str, symbols: Sequence[str]
) -> dict[tuple[str, str], Array]:
    """Return the changes by each input that deviates from its stated value.

    The changes, as `TwoStageEngine.inputs`, are of first order, at the rotation without variation.
    """
    changes = {key: np.zeros((len(symbols) + 1, len(world.runs))) for key in truth.moving_inputs}
    for run, spindle in enumerate(world.spindles):
        times = spindle.time_at(world.strobed(run, owner).angles)
        series = world.series(run, owner, spindle, times)
        gain = curvature_gain(times[:, None])[0][:, 0]
        before = gain @ np.column_stack([series.columns(symbols, 1.0), series.reference()])
        for (recorder, name), change in changes.items():
            if not input_affects(series, name, recorder):
                continue
            reference, columns, step = with_input(series, name, symbols, 1.0)
            change[:, run] = (gain @ np.column_stack([columns, reference]) - before) / step
    return changes


def _stacked(parts: Sequence[Array], axis: int) -> Array:
    """Return the runs' arrays as one; their last axis is n, or 1 where nothing varies."""
    n = max(part.shape[-1] for part in parts)
    return np.stack([np.broadcast_to(part, (*part.shape[:-1], n)) for part in parts], axis=axis)


def _over_runs(factors: Array, values: Array) -> Array:
    """Return the sums over the runs of each (p, r, n or 1) times values (r, n or 1), (p, n)."""
    if factors.shape[-1] == 1:
        return np.asarray(factors[:, :, 0] @ values)
    return np.asarray(np.einsum("prn,rn->pn", factors, values))


def _information(design: Array, weight: Array, prior_sd: Array) -> Array:
    """Return the information on the unknowns, (p, p, n): weighted products and priors."""
    p, runs, _ = design.shape
    products = (design[:, None] * design).reshape(p * p, runs, -1)
    information = _over_runs(products, np.broadcast_to(weight, (runs, weight.shape[-1])))
    information[:: p + 1] += 1.0 / prior_sd[:, None] ** 2
    return information.reshape(p, p, -1)


def _inverse(matrices: Array) -> Array:
    """Return the inverses of many symmetric matrices, shape (p, p, n).

    A second stage has one unknown or two, and written out they are many times faster than one by
    one. The scale of the unknowns does not matter to it: it is a factor of each product.
    """
    if matrices.shape[0] == 1:
        return np.asarray(1.0 / matrices)
    (a, b), (_, c) = matrices
    return np.asarray(np.array([[c, -b], [-b, a]]) / (a * c - b * b))
