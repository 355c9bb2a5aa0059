"""Trials of analyses that are linear in the true values and in the noise.

Joint fit. Given the rotation it is linear, so that with Gaussian noise of known size its estimate
is normal about a linear function of the true values. The base value is the fit of noise-free
records of the mean true values, simulated sample by sample. The columns of the drawn true values
are considered terms of that fit, and their sensitivities are the responses. A trial costs as many
normal numbers as there are unknowns. The column of an input is taken at the mean true coefficients.

Two-stage method. With white Gaussian noise the first stage of a run is summed up by b2, which is
normal about a linear function of the true values, and by the sum of squared residuals, a
chi-square. Neither needs the strobes themselves. The second stage then is a small least-squares
problem, solved for all trials of a batch at once. One reading is taken at each strobe, as the
paper's plan has it.

`counterspin.studies.choice` compares some trials with whole records before it uses these engines.
`bounds` is the least uncertainty that any analysis of all samples and readings can have.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.identifiability import assess
from counterspin.inference.joint.design_blocks import build_design_blocks
from counterspin.inference.joint.fit import solve_blocks, solve_joint
from counterspin.inference.joint.series import (
    ResidualSeries,
    expected_output,
    input_affects,
    input_column,
)
from counterspin.inference.joint.unknowns import Considered, Unknowns
from counterspin.inference.least_squares import REGULARISATION, Block, Solution
from counterspin.inference.two_stage.model import TwoStageRequest
from counterspin.inference.two_stage.second_stage import SecondStage, second_stage
from counterspin.physics.terms import INPUTS, TERMS
from counterspin.readings.linear import ReadingGroup, blocks_at
from counterspin.studies.draws import (
    NOISE_LEVELS,
    OTHERS,
    Draws,
    Key,
    RecordNoise,
    StudyTruth,
    curvature_noise,
    estimate_noise,
    nominal,
    residual_variances,
)
from counterspin.studies.whole_trials import TrialRecords
from counterspin.studies.work import JointRequest, Trials
from counterspin.studies.world import World


@frozen
class JointEngine:
    """Trials of one joint analysis."""

    rows: tuple[int, ...]  #: Places in the model of the unknowns that are reported.
    #: Estimate at the mean true values without noise, nominal value added, shape (c,).
    constant: Array
    keys: tuple[Key, ...]  #: The true values that are drawn, t of them.
    response: Array  #: d(estimate)/d(true value), shape (c, t).
    middle: Array  #: The mean true values, shape (t, 1).
    spread: Array  #: Square root of the covariance of the noise, shape (c, c).
    u: Array  #: Combined standard uncertainty, shape (c,).
    white: float  #: The assumed white noise of the first accelerometer's samples, SI.

    @classmethod
    def prepare(
        cls, world: World, request: JointRequest, truth: StudyTruth
    ) -> tuple[JointEngine, tuple[str, ...]]:
        """Fit noise-free records of the mean true values; return what they do not determine too."""
        model, middle = request.model, truth.middle()
        keys = _drawn_keys(truth, len(world.runs))
        records = TrialRecords(
            replace(world, noise=RecordNoise()), middle, np.random.default_rng(0)
        )
        solution = fit_records(records, request, truth, keys)
        assessment = assess(solution, [unknown.name for unknown in model.of_interest])
        rows = [i for i in request.reported if assessment.determined[model.unknowns[i].name]]
        lost = tuple(model.unknowns[i].name for i in request.reported if i not in rows)
        values, vectors = np.linalg.eigh(solution.covariance_noise[np.ix_(rows, rows)])
        covariance = (
            solution.covariance_noise + solution.covariance_prior + solution.covariance_considered
        )
        assumed = request.noise[next(iter(world.mountings))]
        engine = cls(
            rows=tuple(rows),
            constant=solution.estimate[rows] + np.array([model.unknowns[i].nominal for i in rows]),
            keys=keys,
            response=-solution.sensitivity_considered[:, len(model.considered) :][rows],
            middle=np.array([middle.deviation(key) for key in keys]).reshape(-1, 1),
            spread=vectors * np.sqrt(np.maximum(values, 0.0)),
            u=np.sqrt(np.diag(covariance)[rows]),
            white=math.sqrt(assumed.sample_variance),
        )
        return engine, lost

    def trials(self, draws: Draws, generator: np.random.Generator) -> Trials:
        """Return the results of the analysis for n trials; see `Engine`."""
        n = draws.trials
        scale = draws.white / self.white if self.white > 0.0 else 1.0
        estimate = estimate_noise(generator, self.spread, scale, n)
        estimate += self.constant[:, None]
        estimate += self.response @ _deviations(draws, self.keys, self.middle)
        u = np.broadcast_to(self.u[:, None], estimate.shape)
        return Trials(estimate, u, np.full(u.shape, math.inf))


def fit_records(
    records: TrialRecords, request: JointRequest, truth: StudyTruth, keys: Sequence[Key] = ()
) -> Solution:
    """Fit the records of a trial once, weighted by the assumed noise.

    keys: True values whose columns are considered terms without uncertainty, after the model's.
    """
    model, series = request.model, records.series()
    expected = np.array([truth.mean(u.owner, u.symbol) - u.nominal for u in model.unknowns])
    blocks = build_design_blocks(series, model, scale_factors(series, model, truth), expected)
    first = len(model.considered)
    added = [Considered(owner, symbol, (0.0, 0.0), 1.0) for owner, symbol, _ in keys]
    places = range(first, first + len(keys))
    if keys:
        runs = records.world.runs
        columns = [_columns_of_truth(block.series, keys, runs, truth) for block in blocks]
        blocks = tuple(
            replace(
                block,
                considered=(*block.considered, *places),
                fixed=np.column_stack([block.fixed, added_columns]),
            )
            for block, added_columns in zip(blocks, columns, strict=True)
        )
    extended = replace(model, considered=(*model.considered, *added))
    return solve_joint(blocks, extended, request.noise).solution


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


def _drawn_keys(truth: StudyTruth, runs: int) -> tuple[Key, ...]:
    """Return a key for each term and each input that is drawn, per run where runs differ."""
    return tuple(
        (quantity.owner, quantity.symbol, run)
        for quantity in truth.varying
        if quantity.distribution != "fixed"
        and (quantity.symbol in INPUTS or quantity.symbol not in OTHERS)
        for run in (range(runs) if quantity.per_run else (None,))
    )


def _deviations(draws: Draws, keys: Sequence[Key], middle: Array) -> Array:
    """Return the true values of n trials minus their means, shape (keys, n)."""
    values = [np.broadcast_to(draws.deviation(key), draws.trials) for key in keys]
    return np.array(values).reshape(len(keys), draws.trials) - middle


def _columns_of_truth(
    series: ResidualSeries, keys: Sequence[Key], runs: Sequence[str], truth: StudyTruth
) -> Array:
    """Return the columns of true values in a series, shape (n, keys); zero if it shows none."""
    name = series.accelerometer
    owners = {symbol: owner for owner in ("", name) for symbol in truth.symbols.get(owner, ())}
    k_i = truth.mean(name, "K_I")
    table = dict(zip(owners, series.columns(list(owners), k_i).T, strict=True))
    mean = {s: truth.mean(owner, s) - nominal(owner, s) for s, owner in owners.items()}
    expected = expected_output(series, mean, table)
    columns = np.zeros((series.time.size, len(keys)))
    for place, (owner, symbol, run) in enumerate(keys):
        if run is not None and runs[run] != series.run:
            continue
        if symbol not in INPUTS:
            if owner in ("", name):
                columns[:, place] = table[symbol]
        elif input_affects(series, symbol, owner):
            columns[:, place] = input_column(series, symbol, k_i, mean, expected)
    return columns


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
    determined = assess(solution, [u.name for u in model.of_interest]).determined
    sizes = np.sqrt(np.diag(solution.covariance_noise + solution.covariance_prior)).tolist()
    by_name = dict(zip((u.name for u in model.unknowns), sizes, strict=True))
    return {name: by_name[name] for name in determined if determined[name]}


def _blocks_of_records(world: World, truth: StudyTruth, model: Unknowns) -> list[Block]:
    """Return the blocks of the records with their true noise; none without noise."""
    draws = truth.draw(np.random.default_rng(0), 256)
    levels = {NOISE_LEVELS[symbol][1]: float(level.mean()) for symbol, level in draws.noise.items()}
    world = replace(world, noise=replace(world.noise, white=float(draws.white.mean()), **levels))
    names = {u.owner for u in model.unknowns if u.symbol in TERMS} or set(world.mountings)
    noises = {name: world.noise_of(name) for name in world.mountings if name in names}
    if not all(noise.sample_variance or noise.random_walk for noise in noises.values()):
        return []
    series = [
        world.series(run, name, truth.spindles[run])
        for run in range(len(world.runs))
        for name in world.mountings
        if name in names
    ]
    prepared = build_design_blocks(series, model, scale_factors(series, model, truth))
    return [part.block_in(model, noises) for part in prepared]


@frozen(eq=False)
class TwoStageEngine:
    """Trials of one accelerometer's two-stage analysis.

    b2 of each run is linear in the deviations of the true values from their means, in those of the
    rotation, and in their products. The second stage is linear in b2.
    """

    sigma: float | None  #: Standard deviation of a strobe, m; None: from each run's residuals.
    weighted: bool  #: Whether the runs are weighted by 1/sigma(b2)^2.
    estimate: Array  #: At the mean true values without noise, shape (p,).
    design: Array  #: d(b2)/d(unknown), shape (runs, p).
    #: d(b2)/d(considered parameter) times its standard uncertainty, shape (runs, k).
    considered: Array
    #: Of each unknown: prior mean minus `estimate`, and standard uncertainty, shape (2, p).
    prior: Array
    remainder: Array  #: b2 at the mean true values minus that of the model, m/s^2, shape (runs,).
    keys: tuple[Key, ...]  #: The true values that are drawn, t of them.
    #: d(b2)/d(true value), and its derivatives by drift and by cosine and sine of the ripple, shape
    #: (4, t, runs).
    response: Array
    middle: Array  #: The mean true values, shape (t, 1).
    rotation: Array  #: Derivatives of `remainder` by the same three, shape (3, runs).
    centre: Array  #: Their mean values, shape (3, runs).
    sizes: Array  #: sigma/u(b2) of each run, s^2, shape (runs,).
    dof: Array  #: Degrees of freedom of each run's residuals, shape (runs,).

    @classmethod
    def prepare(
        cls, world: World, truth: StudyTruth, request: TwoStageRequest, owner: str
    ) -> TwoStageEngine:
        """Analyse the mean true values without noise, and differentiate."""
        middle, runs = truth.middle(), range(len(world.runs))
        second = second_stage_without_noise(world, truth, request, owner, middle)
        fit, sigma_b2 = second.fit, np.array([p.u_b2 for p in second.parabolas])
        estimate = fit.solution.estimate
        rows = [(block.factor, block.considered) for block in fit.blocks]
        design, considered = (
            np.vstack(part) * sigma_b2[:, None] for part in zip(*rows, strict=True)
        )
        unknowns = fit.model.unknowns
        sd = [
            u.prior[1] if math.isfinite(u.prior[1]) else REGULARISATION * u.limit for u in unknowns
        ]
        bounds_of_runs = np.array([truth.small_bounds(run) for run in runs])
        half = 0.5 * (bounds_of_runs[..., 1] - bounds_of_runs[..., 0]).T
        rotation = np.zeros((3, len(runs)))
        displaced = [q for q in range(3) if half[q].any()]
        for q in displaced:
            low, high = (
                _remainder(
                    second_stage_without_noise(
                        world, truth, request, owner, middle.displaced(q, sign * half[q])
                    ),
                    estimate,
                )
                for sign in (-1.0, 1.0)
            )
            rotation[q] = (high - low) / (2.0 * np.where(half[q] > 0.0, half[q], np.inf))
        keys = _drawn_keys(truth, len(runs))
        at = partial(_responses, world, truth, owner, keys)
        response = np.zeros((4, len(keys), len(runs)))
        response[0] = at(middle)
        own = {u.symbol for u in unknowns} if request.model == "exact" else set()
        estimated = np.array([symbol in own for _, symbol, _ in keys], dtype=bool)
        for q in displaced:
            change = at(middle.displaced(q, half[q])) - at(middle.displaced(q, -half[q]))
            response[1 + q] = change / (2.0 * np.where(half[q] > 0.0, half[q], np.inf))
            # The column of an unknown changes with the rotation as its effect does.
            response[1 + q, estimated] = 0.0
        parabolas = second.parabolas
        return cls(
            sigma=request.sigma,
            weighted=request.weighted,
            estimate=estimate,
            design=design,
            considered=considered * np.asarray(fit.model.considered_sds),
            prior=np.array([[u.prior_mean for u in unknowns] - estimate, sd]),
            remainder=_remainder(second, estimate),
            keys=keys,
            response=response,
            middle=np.array([middle.deviation(key) for key in keys]).reshape(-1, 1),
            rotation=rotation,
            centre=np.array([[middle.small(run)[q][0] for run in runs] for q in range(3)]),
            sizes=(request.sigma or truth.white) / sigma_b2,
            dof=np.array([p.strobes.time.size - 3.0 for p in parabolas]),
        )

    def trials(self, draws: Draws, generator: np.random.Generator) -> Trials:
        """Return the results of the analysis; see `Engine`."""
        n = draws.trials
        b2 = curvature_noise(generator, draws.white, self.sizes[:, None], n)
        b2 += self.remainder[:, None]
        true = _deviations(draws, self.keys, self.middle)
        b2 += self.response[0].T @ true
        for q, part in enumerate((draws.drift, draws.ripple_cos, draws.ripple_sin)):
            if self.rotation[q].any() or self.response[1 + q].any():
                change = self.rotation[q][:, None] + self.response[1 + q].T @ true
                b2 += change * (part - self.centre[q][:, None])
        if self.sigma is None:
            variance = residual_variances(generator, draws.white, self.dof, n)
        else:
            variance = np.full((1, 1), self.sigma**2)
        return self._resolve(b2, variance / self.sizes[:, None] ** 2)

    def _resolve(self, b2: Array, noise: Array) -> Trials:
        """Apply the second stage to all trials.

        With columns x_r, weights w_r and a prior P the inverse information is
        C = (sum_r w_r x_r x_r' + P)^-1, and the gain, d(estimate)/d(b2), is C x_r w_r.

        noise: Variance of b2, shape (runs, n or 1).
        """
        x, (prior_mean, prior_sd) = self.design, self.prior
        even = np.broadcast_to(noise.mean(axis=0, keepdims=True), noise.shape)
        weight = 1.0 / (noise if self.weighted else even)
        unit = 1.0 / np.sqrt(np.sum(x**2 * weight[:, :1], axis=0) + prior_sd**-2.0)
        scaled = x * unit
        information = np.einsum("rp,rn,rq->npq", scaled, weight, scaled)
        information += np.diag((unit / prior_sd) ** 2)
        inverse = np.linalg.inv(information) * unit[:, None] * unit
        gain = np.einsum("npq,rq,rn->prn", inverse, x, weight)
        estimate = _over_runs(gain, b2) + self.estimate[:, None]
        estimate += np.einsum("npq,q->pn", inverse, prior_mean / prior_sd**2)
        parts = gain**2 * noise
        total = parts.sum(axis=1) + np.einsum("npq,q->pn", inverse**2, prior_sd**-2.0)
        total = total + np.sum(np.einsum("prn,rk->pkn", gain, self.considered) ** 2, axis=1)
        dof = np.full((1, 1), math.inf)
        if self.sigma is None:
            # Welch and Satterthwaite.
            dof = total**2 / _over_runs(parts**2, 1.0 / self.dof[:, None])
        u = np.sqrt(total)
        return Trials(
            estimate,
            np.broadcast_to(u, estimate.shape),
            np.broadcast_to(dof, estimate.shape),
        )


def second_stage_without_noise(
    world: World, truth: StudyTruth, request: TwoStageRequest, owner: str, draws: Draws
) -> SecondStage:
    """Analyse the first of some trials without noise, with the weights of the stated noise."""
    quiet = replace(world, noise=RecordNoise())
    records = TrialRecords(quiet, draws, np.random.default_rng(0))
    request = replace(request, sigma=request.sigma or truth.white)
    runs = [records.strobed_run(run, owner, request) for run in range(len(world.runs))]
    return second_stage(runs, world.mountings[owner], request, ignored=())


def _remainder(second: SecondStage, estimate: Array) -> Array:
    """Return b2 minus that of the model with an estimate, m/s^2, shape (runs,)."""
    means = second.fit.model.considered_means
    left = [
        block.target - block.factor @ estimate - block.considered @ means
        for block in second.fit.blocks
    ]
    return np.concatenate(left) * [parabola.u_b2 for parabola in second.parabolas]


def _responses(
    world: World, truth: StudyTruth, owner: str, keys: Sequence[Key], draws: Draws
) -> Array:
    """Return d(b2)/d(true value) for each key that is drawn, shape (keys, runs)."""
    gains = []
    for run in range(len(world.runs)):
        spindle = draws.spindle(world.spindles[run], run)
        times = spindle.time_at(world.strobes(run, owner))
        series = world.series(run, owner, spindle, times)
        gains.append(curvature_gain(times) @ _columns_of_truth(series, keys, world.runs, truth))
    return np.array(gains).T


def curvature_gain(times: Array) -> Array:
    """Return d(b2)/d(strobe) of an unweighted parabola, shape (m,)."""
    t = times - times.mean()
    square = t * t
    shape = square - square.mean() - (np.sum(square * t) / np.sum(square)) * t
    return np.asarray(shape / np.sum(shape * shape))


def _over_runs(factors: Array, values: Array) -> Array:
    """Return the sums over the runs of each (p, r, n or 1) times values (r, n or 1), (p, n)."""
    if factors.shape[-1] == 1:
        return np.asarray(factors[:, :, 0] @ values)
    return np.asarray(np.einsum("prn,rn->pn", factors, values))
