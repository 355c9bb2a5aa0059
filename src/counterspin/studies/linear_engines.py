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

`engine_selection` compares some trials with full records before it uses these engines.
`lower_bounds` is the lowest uncertainty that any analysis of all samples and readings can have.
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
from counterspin.studies.batch_runner import JointRequest, TrialResults
from counterspin.studies.draws import (
    NOISE_FREE,
    OTHER_QUANTITIES,
    Draws,
    Key,
    StudyTruth,
    curvature_noise,
    estimate_noise,
    nominal_value,
    residual_variances,
)
from counterspin.studies.full_simulation import TrialRecords
from counterspin.studies.simulation_setup import SimulationSetup


@frozen
class JointEngine:
    """Trials of one joint analysis."""

    rows: tuple[int, ...]  #: Places in the model of the unknowns that are reported.
    #: Estimate at the mean true values without noise, nominal value added, shape (c,).
    constant: Array
    keys: tuple[Key, ...]  #: The true values that are drawn, t of them.
    response: Array  #: d(estimate)/d(true value), shape (c, t).
    mean_truth: Array  #: The mean true values, shape (t, 1).
    sqrt_covariance: Array  #: Square root of the covariance of the noise, shape (c, c).
    u: Array  #: Combined standard uncertainty, shape (c,).
    white: float  #: The assumed white noise of the first accelerometer's samples, SI.

    @classmethod
    def prepare(
        cls, setup: SimulationSetup, request: JointRequest, truth: StudyTruth
    ) -> tuple[JointEngine, tuple[str, ...]]:
        """Fit noise-free records of the mean true values.

        Returns: the engine, and the names of coefficients that the records do not determine.
        """
        model, mean_draw = request.model, truth.mean_draw()
        keys = _varied_keys(truth, len(setup.runs))
        records = TrialRecords(
            replace(setup, noise=NOISE_FREE), mean_draw, np.random.default_rng(0)
        )
        solution = fit_records(records, request, truth, keys)
        assessment = assess(solution, [unknown.name for unknown in model.of_interest])
        rows = [
            i for i in request.reported_indices if assessment.determined[model.unknowns[i].name]
        ]
        undetermined = tuple(
            model.unknowns[i].name for i in request.reported_indices if i not in rows
        )
        values, vectors = np.linalg.eigh(solution.covariance_noise[np.ix_(rows, rows)])
        covariance = (
            solution.covariance_noise + solution.covariance_prior + solution.covariance_considered
        )
        assumed_noise = request.noise[next(iter(setup.mountings))]
        engine = cls(
            rows=tuple(rows),
            constant=solution.estimate[rows] + np.array([model.unknowns[i].nominal for i in rows]),
            keys=keys,
            response=-solution.sensitivity_considered[:, len(model.considered) :][rows],
            mean_truth=np.array([mean_draw.deviation(key) for key in keys]).reshape(-1, 1),
            sqrt_covariance=vectors * np.sqrt(np.maximum(values, 0.0)),
            u=np.sqrt(np.diag(covariance)[rows]),
            white=math.sqrt(assumed_noise.sample_variance),
        )
        return engine, undetermined

    def run_trials(self, draws: Draws, generator: np.random.Generator) -> TrialResults:
        """Return the results of the analysis for n trials; see `TrialEngine`."""
        n = draws.trials
        noise_ratio = draws.white / self.white if self.white > 0.0 else 1.0
        estimate = estimate_noise(generator, self.sqrt_covariance, noise_ratio, n)
        estimate += self.constant[:, None]
        estimate += self.response @ _deviations(draws, self.keys, self.mean_truth)
        u = np.broadcast_to(self.u[:, None], estimate.shape)
        return TrialResults(estimate, u, np.full(u.shape, math.inf))


def fit_records(
    records: TrialRecords, request: JointRequest, truth: StudyTruth, keys: Sequence[Key] = ()
) -> Solution:
    """Fit the records of a trial once, weighted by the assumed noise.

    keys: True values whose columns are considered terms without uncertainty, after the model's.
    """
    model, series = request.model, records.series()
    expected = np.array([truth.mean(u.owner, u.symbol) - u.nominal for u in model.unknowns])
    blocks = build_design_blocks(series, model, scale_factors(series, model, truth), expected)
    offset = len(model.considered)
    truth_terms = [Considered(owner, symbol, (0.0, 0.0), 1.0) for owner, symbol, _ in keys]
    indices = range(offset, offset + len(keys))
    if keys:
        runs = records.setup.runs
        columns = [_truth_columns(block.series, keys, runs, truth) for block in blocks]
        blocks = tuple(
            replace(
                block,
                considered=(*block.considered, *indices),
                fixed=np.column_stack([block.fixed, added_columns]),
            )
            for block, added_columns in zip(blocks, columns, strict=True)
        )
    extended = replace(model, considered=(*model.considered, *truth_terms))
    return solve_joint(blocks, extended, request.noise).solution


def scale_factors(
    series: Sequence[ResidualSeries], model: Unknowns, truth: StudyTruth
) -> dict[str, float]:
    """Return the K_I with which each accelerometer sees the platform's errors.

    `calibrate` takes it from the estimate; a study takes the mean true value.
    """
    factors = {}
    for name in dict.fromkeys(record.accelerometer for record in series):
        considered_values = [
            c.prior[0] for c in model.considered if c.owner == name and c.symbol == "K_I"
        ]
        factors[name] = considered_values[0] if considered_values else truth.mean(name, "K_I")
    return factors


def _varied_keys(truth: StudyTruth, runs: int) -> tuple[Key, ...]:
    """Return a key for each term and each input that is drawn, per run where runs differ."""
    return tuple(
        (quantity.owner, quantity.symbol, run)
        for quantity in truth.varying
        if quantity.distribution != "fixed"
        and (quantity.symbol in INPUTS or quantity.symbol not in OTHER_QUANTITIES)
        for run in (range(runs) if quantity.per_run else (None,))
    )


def _deviations(draws: Draws, keys: Sequence[Key], mean_truth: Array) -> Array:
    """Return the true values of n trials minus their means, shape (keys, n)."""
    values = [np.broadcast_to(draws.deviation(key), draws.trials) for key in keys]
    return np.array(values).reshape(len(keys), draws.trials) - mean_truth


def _truth_columns(
    series: ResidualSeries, keys: Sequence[Key], runs: Sequence[str], truth: StudyTruth
) -> Array:
    """Return the column of each true value in a series, shape (n, keys); zero without effect."""
    name = series.accelerometer
    owners = {symbol: owner for owner in ("", name) for symbol in truth.symbols.get(owner, ())}
    k_i = truth.mean(name, "K_I")
    table = dict(zip(owners, series.columns(list(owners), k_i).T, strict=True))
    mean_deviations = {
        s: truth.mean(owner, s) - nominal_value(owner, s) for s, owner in owners.items()
    }
    expected = expected_output(series, mean_deviations, table)
    columns = np.zeros((series.time.size, len(keys)))
    for index, (owner, symbol, run) in enumerate(keys):
        if run is not None and runs[run] != series.run:
            continue
        if symbol not in INPUTS:
            if owner in ("", name):
                columns[:, index] = table[symbol]
        elif input_affects(series, symbol, owner):
            columns[:, index] = input_column(series, symbol, k_i, mean_deviations, expected)
    return columns


def lower_bounds(
    truth: StudyTruth,
    model: Unknowns,
    setup: SimulationSetup | None,
    readings: Sequence[ReadingGroup] = (),
) -> dict[str, float]:
    """Return the lowest standard uncertainty that all samples and readings permit, by unknown.

    The bound holds for the true noise and for the unknowns of the analysis with their priors (the
    posterior bound of van Trees); all other quantities are known. An unknown that the data do not
    determine has no bound.

    setup: The set-up of the records; None: the campaign has no records.
    readings: The readings, with their true noise.
    """
    model = Unknowns(model.unknowns)
    blocks = [] if setup is None else _record_blocks(setup, truth, model)
    if readings:
        mean_deviations = np.array(
            [truth.mean(u.owner, u.symbol) - u.nominal for u in model.unknowns]
        )
        blocks += blocks_at(readings, model, mean_deviations)
    if not blocks:
        return {}
    solution = solve_blocks(blocks, model)
    determined = assess(solution, [u.name for u in model.of_interest]).determined
    standard_uncertainties = np.sqrt(
        np.diag(solution.covariance_noise + solution.covariance_prior)
    ).tolist()
    u_by_name = dict(zip((u.name for u in model.unknowns), standard_uncertainties, strict=True))
    return {name: u_by_name[name] for name in determined if determined[name]}


def _record_blocks(setup: SimulationSetup, truth: StudyTruth, model: Unknowns) -> list[Block]:
    """Return the blocks of the records with their true noise; none without noise."""
    draws = truth.draw(np.random.default_rng(0), 256)
    setup = replace(setup, noise=draws.noise_sizes(setup.noise))
    names = {u.owner for u in model.unknowns if u.symbol in TERMS} or set(setup.mountings)
    noises = {name: setup.true_noise(name) for name in setup.mountings if name in names}
    if not all(noise.sample_variance or noise.random_walk for noise in noises.values()):
        return []
    series = [
        setup.series(run, name, truth.spindles[run])
        for run in range(len(setup.runs))
        for name in setup.mountings
        if name in names
    ]
    prepared = build_design_blocks(series, model, scale_factors(series, model, truth))
    return [block.expand_block(model, noises) for block in prepared]


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
    #: For each unknown: prior mean minus `estimate`, and standard uncertainty, shape (2, p).
    prior: Array
    residual_b2: Array  #: b2 at the mean true values minus that of the model, m/s^2, shape (runs,).
    keys: tuple[Key, ...]  #: The true values that are drawn, t of them.
    #: d(b2)/d(true value), and its derivatives by drift and by cosine and sine of the ripple, shape
    #: (4, t, runs).
    response: Array
    mean_truth: Array  #: The mean true values, shape (t, 1).
    rotation_response: Array  #: Derivatives of `residual_b2` by the same three, shape (3, runs).
    mean_rotation: Array  #: Their mean values, shape (3, runs).
    curvature_scale: Array  #: sigma/u(b2) of each run, s^2, shape (runs,).
    dof: Array  #: Degrees of freedom of each run's residuals, shape (runs,).

    @classmethod
    def prepare(
        cls, setup: SimulationSetup, truth: StudyTruth, request: TwoStageRequest, owner: str
    ) -> TwoStageEngine:
        """Analyse the mean true values without noise, and differentiate the result."""
        mean_draw, runs = truth.mean_draw(), range(len(setup.runs))
        second_stage_result = noise_free_second_stage(setup, truth, request, owner, mean_draw)
        fit, sigma_b2 = (
            second_stage_result.fit,
            np.array([p.u_b2 for p in second_stage_result.parabolas]),
        )
        estimate = fit.solution.estimate
        rows = [(block.factor, block.considered) for block in fit.blocks]
        design, considered = (
            np.vstack(column) * sigma_b2[:, None] for column in zip(*rows, strict=True)
        )
        unknowns = fit.model.unknowns
        sd = [
            u.prior[1] if math.isfinite(u.prior[1]) else REGULARISATION * u.limit for u in unknowns
        ]
        bounds_of_runs = np.array([truth.rotation_bounds(run) for run in runs])
        half_ranges = 0.5 * (bounds_of_runs[..., 1] - bounds_of_runs[..., 0]).T
        rotation_response = np.zeros((3, len(runs)))
        varied_parameters = [q for q in range(3) if half_ranges[q].any()]
        for q in varied_parameters:
            low, high = (
                _residual_b2(
                    noise_free_second_stage(
                        setup,
                        truth,
                        request,
                        owner,
                        mean_draw.shift_rotation(q, sign * half_ranges[q]),
                    ),
                    estimate,
                )
                for sign in (-1.0, 1.0)
            )
            rotation_response[q] = (high - low) / (
                2.0 * np.where(half_ranges[q] > 0.0, half_ranges[q], np.inf)
            )
        keys = _varied_keys(truth, len(runs))
        responses_at = partial(_b2_responses, setup, truth, owner, keys)
        response = np.zeros((4, len(keys), len(runs)))
        response[0] = responses_at(mean_draw)
        estimated_symbols = {u.symbol for u in unknowns} if request.model == "exact" else set()
        estimated = np.array([symbol in estimated_symbols for _, symbol, _ in keys], dtype=bool)
        for q in varied_parameters:
            change = responses_at(mean_draw.shift_rotation(q, half_ranges[q])) - responses_at(
                mean_draw.shift_rotation(q, -half_ranges[q])
            )
            response[1 + q] = change / (
                2.0 * np.where(half_ranges[q] > 0.0, half_ranges[q], np.inf)
            )
            # The column of an unknown changes with the rotation as its effect does.
            response[1 + q, estimated] = 0.0
        parabolas = second_stage_result.parabolas
        return cls(
            sigma=request.sigma,
            weighted=request.weighted,
            estimate=estimate,
            design=design,
            considered=considered * np.asarray(fit.model.considered_sds),
            prior=np.array([[u.prior_mean for u in unknowns] - estimate, sd]),
            residual_b2=_residual_b2(second_stage_result, estimate),
            keys=keys,
            response=response,
            mean_truth=np.array([mean_draw.deviation(key) for key in keys]).reshape(-1, 1),
            rotation_response=rotation_response,
            mean_rotation=np.array(
                [[mean_draw.rotation_parameters(run)[q][0] for run in runs] for q in range(3)]
            ),
            curvature_scale=(request.sigma or truth.white) / sigma_b2,
            dof=np.array([p.strobes.time.size - 3.0 for p in parabolas]),
        )

    def run_trials(self, draws: Draws, generator: np.random.Generator) -> TrialResults:
        """Return the results of the analysis; see `TrialEngine`."""
        n = draws.trials
        b2 = curvature_noise(generator, draws.white, self.curvature_scale[:, None], n)
        b2 += self.residual_b2[:, None]
        deviations = _deviations(draws, self.keys, self.mean_truth)
        b2 += self.response[0].T @ deviations
        for q, values in enumerate((draws.drift, draws.ripple_cos, draws.ripple_sin)):
            if self.rotation_response[q].any() or self.response[1 + q].any():
                change = self.rotation_response[q][:, None] + self.response[1 + q].T @ deviations
                b2 += change * (values - self.mean_rotation[q][:, None])
        if self.sigma is None:
            variance = residual_variances(generator, draws.white, self.dof, n)
        else:
            variance = np.full((1, 1), self.sigma**2)
        return self._solve_second_stage(b2, variance / self.curvature_scale[:, None] ** 2)

    def _solve_second_stage(self, b2: Array, noise: Array) -> TrialResults:
        """Apply the second stage to all trials.

        With columns x_r, weights w_r and a prior P the inverse information is
        C = (sum_r w_r x_r x_r' + P)^-1, and the gain, d(estimate)/d(b2), is C x_r w_r.

        noise: Variance of b2, shape (runs, n or 1).
        """
        x, (prior_mean, prior_sd) = self.design, self.prior
        mean_variance = np.broadcast_to(noise.mean(axis=0, keepdims=True), noise.shape)
        weight = 1.0 / (noise if self.weighted else mean_variance)
        scale = 1.0 / np.sqrt(np.sum(x**2 * weight[:, :1], axis=0) + prior_sd**-2.0)
        scaled = x * scale
        information = np.einsum("rp,rn,rq->npq", scaled, weight, scaled)
        information += np.diag((scale / prior_sd) ** 2)
        inverse = np.linalg.inv(information) * scale[:, None] * scale
        gain = np.einsum("npq,rq,rn->prn", inverse, x, weight)
        estimate = _sum_over_runs(gain, b2) + self.estimate[:, None]
        estimate += np.einsum("npq,q->pn", inverse, prior_mean / prior_sd**2)
        contributions = gain**2 * noise
        variance = contributions.sum(axis=1) + np.einsum("npq,q->pn", inverse**2, prior_sd**-2.0)
        variance = variance + np.sum(np.einsum("prn,rk->pkn", gain, self.considered) ** 2, axis=1)
        dof = np.full((1, 1), math.inf)
        if self.sigma is None:
            # Welch and Satterthwaite.
            dof = variance**2 / _sum_over_runs(contributions**2, 1.0 / self.dof[:, None])
        u = np.sqrt(variance)
        return TrialResults(
            estimate,
            np.broadcast_to(u, estimate.shape),
            np.broadcast_to(dof, estimate.shape),
        )


def noise_free_second_stage(
    setup: SimulationSetup, truth: StudyTruth, request: TwoStageRequest, owner: str, draws: Draws
) -> SecondStage:
    """Analyse the first trial without noise, with the weights of the stated noise."""
    noise_free_setup = replace(setup, noise=NOISE_FREE)
    records = TrialRecords(noise_free_setup, draws, np.random.default_rng(0))
    request = replace(request, sigma=request.sigma or truth.white)
    runs = [records.strobed_run(run, owner, request) for run in range(len(setup.runs))]
    return second_stage(runs, setup.mountings[owner], request, ignored=())


def _residual_b2(second_stage_result: SecondStage, estimate: Array) -> Array:
    """Return b2 minus the b2 that the estimate predicts, m/s^2, shape (runs,)."""
    means = second_stage_result.fit.model.considered_means
    residuals = [
        block.target - block.factor @ estimate - block.considered @ means
        for block in second_stage_result.fit.blocks
    ]
    return np.concatenate(residuals) * [parabola.u_b2 for parabola in second_stage_result.parabolas]


def _b2_responses(
    setup: SimulationSetup, truth: StudyTruth, owner: str, keys: Sequence[Key], draws: Draws
) -> Array:
    """Return d(b2)/d(true value) for each key that is drawn, shape (keys, runs)."""
    gains = []
    for run in range(len(setup.runs)):
        spindle = draws.true_spindle(setup.spindles[run], run)
        times = spindle.time_at(setup.strobes(run, owner))
        series = setup.series(run, owner, spindle, times)
        gains.append(curvature_gain(times) @ _truth_columns(series, keys, setup.runs, truth))
    return np.array(gains).T


def curvature_gain(times: Array) -> Array:
    """Return d(b2)/d(strobe) of an unweighted parabola, shape (m,)."""
    t = times - times.mean()
    square = t * t
    shape = square - square.mean() - (np.sum(square * t) / np.sum(square)) * t
    return np.asarray(shape / np.sum(shape * shape))


def _sum_over_runs(factors: Array, values: Array) -> Array:
    """Sum factors (p, r, n or 1) times values (r, n or 1) over the runs, shape (p, n)."""
    if factors.shape[-1] == 1:
        return np.asarray(factors[:, :, 0] @ values)
    return np.asarray(np.einsum("prn,rn->pn", factors, values))
