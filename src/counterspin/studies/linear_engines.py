"""Trials of analyses that are linear in the true values and in the noise.

Joint fit. For a given rotation, it is linear. With Gaussian noise of known standard deviation, its
estimate is normal about a linear function of the true values. The constant is the fit of
noise-free full records of the mean true values. The columns of the varied true values are
considered terms of that fit, and their sensitivities are the responses. A trial needs one normal
number per unknown. The columns of inputs are computed at the mean true coefficients.

Two-stage method. With white Gaussian noise, the sufficient statistics of the first stage of a run
are b2, which is normal about a linear function of the true values, and the residual sum of squares,
which has a chi-square distribution. So strobes are not simulated. The second stage is a small
least-squares problem, solved for all trials of a batch at once. Each strobe has one reading, as in
the plan of the paper.

`engine_selection` compares some trials with full records before it uses these engines.
`lower_bounds` returns the lowest uncertainty of any analysis of all samples and readings.
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
    OTHER_QUANTITY_UNITS,
    ZERO_NOISE,
    Draws,
    StudyTruth,
    TruthKey,
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

    rows: tuple[int, ...]  #: Indices of the reported unknowns in the model.
    #: Estimate at the mean true values without noise, including nominal values, shape (c,).
    mean_estimate: Array
    keys: tuple[TruthKey, ...]  #: Keys of the t varied true values.
    response: Array  #: d(estimate)/d(true value), shape (c, t).
    mean_truth: Array  #: The mean true values, shape (t, 1).
    sqrt_covariance: Array  #: Square root of the covariance of the noise, shape (c, c).
    u: Array  #: Combined standard uncertainty, shape (c,).
    assumed_white_noise: float  #: White noise of a sample of the first accelerometer, SI.

    @classmethod
    def prepare(
        cls, setup: SimulationSetup, request: JointRequest, truth: StudyTruth
    ) -> tuple[JointEngine, tuple[str, ...]]:
        """Fit noise-free records of the mean true values.

        Returns: the engine, and the names of coefficients that the records do not determine.
        """
        model, draws = request.model, truth.mean_draw()
        keys = _varied_keys(truth, len(setup.runs))
        records = TrialRecords(replace(setup, noise=ZERO_NOISE), draws, np.random.default_rng(0))
        solution = fit_records(records, request, truth, keys)
        assessment = assess(solution, [unknown.name for unknown in model.of_interest])
        rows = [
            index
            for index in request.reported_indices
            if assessment.determined[model.unknowns[index].name]
        ]
        undetermined_names = tuple(
            model.unknowns[index].name for index in request.reported_indices if index not in rows
        )
        eigenvalues, eigenvectors = np.linalg.eigh(solution.covariance_noise[np.ix_(rows, rows)])
        covariance = (
            solution.covariance_noise + solution.covariance_prior + solution.covariance_considered
        )
        assumed_noise = request.noise[next(iter(setup.mountings))]
        engine = cls(
            rows=tuple(rows),
            mean_estimate=solution.estimate[rows]
            + np.array([model.unknowns[index].nominal for index in rows]),
            keys=keys,
            response=-solution.sensitivity_considered[:, len(model.considered) :][rows],
            mean_truth=np.array([draws.deviation(key) for key in keys]).reshape(-1, 1),
            sqrt_covariance=eigenvectors * np.sqrt(np.maximum(eigenvalues, 0.0)),
            u=np.sqrt(np.diag(covariance)[rows]),
            assumed_white_noise=math.sqrt(assumed_noise.sample_variance),
        )
        return engine, undetermined_names

    def run_trials(self, draws: Draws, generator: np.random.Generator) -> TrialResults:
        """Return the results of the analysis for n trials; see `TrialEngine`."""
        n_trials = draws.n_trials
        noise_ratio = (
            draws.white_noise / self.assumed_white_noise if self.assumed_white_noise > 0.0 else 1.0
        )
        estimate = estimate_noise(generator, self.sqrt_covariance, noise_ratio, n_trials)
        estimate += self.mean_estimate[:, None]
        estimate += self.response @ _deviations(draws, self.keys, self.mean_truth)
        u = np.broadcast_to(self.u[:, None], estimate.shape)
        return TrialResults(estimate, u, np.full(u.shape, math.inf))


def fit_records(
    records: TrialRecords, request: JointRequest, truth: StudyTruth, keys: Sequence[TruthKey] = ()
) -> Solution:
    """Fit the records of a trial once, weighted by the assumed noise.

    keys: True values whose columns become additional considered terms without uncertainty.
    """
    model, series = request.model, records.series()
    deviations = np.array(
        [truth.mean(unknown.owner, unknown.symbol) - unknown.nominal for unknown in model.unknowns]
    )
    blocks = build_design_blocks(series, model, scale_factors(series, model, truth), deviations)
    n_considered = len(model.considered)
    considered_terms = [Considered(owner, symbol, (0.0, 0.0), 1.0) for owner, symbol, _ in keys]
    indices = range(n_considered, n_considered + len(keys))
    if keys:
        runs = records.setup.runs
        columns = [_truth_columns(block.series, keys, runs, truth) for block in blocks]
        blocks = tuple(
            replace(
                block,
                considered=(*block.considered, *indices),
                considered_design=np.column_stack([block.considered_design, added_columns]),
            )
            for block, added_columns in zip(blocks, columns, strict=True)
        )
    extended_model = replace(model, considered=(*model.considered, *considered_terms))
    return solve_joint(blocks, extended_model, request.noise).solution


def scale_factors(
    series: Sequence[ResidualSeries], model: Unknowns, truth: StudyTruth
) -> dict[str, float]:
    """Return the K_I that multiplies the errors of the platform, by accelerometer.

    `calibrate` uses the estimate; a study uses the mean true value.
    """
    factors = {}
    for name in dict.fromkeys(record.accelerometer for record in series):
        considered_values = [
            considered.prior[0]
            for considered in model.considered
            if considered.owner == name and considered.symbol == "K_I"
        ]
        factors[name] = considered_values[0] if considered_values else truth.mean(name, "K_I")
    return factors


def _varied_keys(truth: StudyTruth, n_runs: int) -> tuple[TruthKey, ...]:
    """Return the keys of the varied terms and inputs, one for each run if the runs differ."""
    return tuple(
        (quantity.owner, quantity.symbol, run)
        for quantity in truth.varied_quantities
        if quantity.distribution != "fixed"
        and (quantity.symbol in INPUTS or quantity.symbol not in OTHER_QUANTITY_UNITS)
        for run in (range(n_runs) if quantity.is_per_run else (None,))
    )


def _deviations(draws: Draws, keys: Sequence[TruthKey], mean_truth: Array) -> Array:
    """Return the true values of n trials minus their means, shape (keys, n)."""
    values = [np.broadcast_to(draws.deviation(key), draws.n_trials) for key in keys]
    return np.array(values).reshape(len(keys), draws.n_trials) - mean_truth


def _truth_columns(
    series: ResidualSeries, keys: Sequence[TruthKey], runs: Sequence[str], truth: StudyTruth
) -> Array:
    """Return the columns of true values in a series, shape (n, keys); zero without effect."""
    name = series.accelerometer
    owners = {symbol: owner for owner in ("", name) for symbol in truth.symbols.get(owner, ())}
    k_i = truth.mean(name, "K_I")
    columns_by_symbol = dict(zip(owners, series.columns(list(owners), k_i).T, strict=True))
    mean_deviations = {
        symbol: truth.mean(owner, symbol) - nominal_value(owner, symbol)
        for symbol, owner in owners.items()
    }
    expected_series = expected_output(series, mean_deviations, columns_by_symbol)
    columns = np.zeros((series.time.size, len(keys)))
    for index, (owner, symbol, run) in enumerate(keys):
        if run is not None and runs[run] != series.run:
            continue
        if symbol not in INPUTS:
            if owner in ("", name):
                columns[:, index] = columns_by_symbol[symbol]
        elif input_affects(series, symbol, owner):
            columns[:, index] = input_column(series, symbol, k_i, mean_deviations, expected_series)
    return columns


def lower_bounds(
    truth: StudyTruth,
    model: Unknowns,
    setup: SimulationSetup | None,
    readings: Sequence[ReadingGroup] = (),
) -> dict[str, float]:
    """Return the lower bound of the standard uncertainty from all samples and readings, by unknown.

    The bound holds for the true noise and for the unknowns of the analysis with their priors (the
    posterior bound of van Trees); all other quantities are known. Unknowns that the data do not
    determine are omitted.

    setup: Setup of the records; None: no records.
    readings: Readings with their true noise.
    """
    model = Unknowns(model.unknowns)
    blocks = [] if setup is None else _record_blocks(setup, truth, model)
    if readings:
        deviations = np.array(
            [
                truth.mean(unknown.owner, unknown.symbol) - unknown.nominal
                for unknown in model.unknowns
            ]
        )
        blocks += blocks_at(readings, model, deviations)
    if not blocks:
        return {}
    solution = solve_blocks(blocks, model)
    is_determined = assess(solution, [unknown.name for unknown in model.of_interest]).determined
    u = np.sqrt(np.diag(solution.covariance_noise + solution.covariance_prior)).tolist()
    u_by_name = dict(zip((unknown.name for unknown in model.unknowns), u, strict=True))
    return {name: u_by_name[name] for name in is_determined if is_determined[name]}


def _record_blocks(setup: SimulationSetup, truth: StudyTruth, model: Unknowns) -> list[Block]:
    """Return the blocks of the records with their true noise; none without noise."""
    draws = truth.draw(np.random.default_rng(0), 256)
    setup = replace(setup, noise=draws.noise_sizes(setup.noise))
    names = {unknown.owner for unknown in model.unknowns if unknown.symbol in TERMS} or set(
        setup.mountings
    )
    noise_by_name = {name: setup.true_noise(name) for name in setup.mountings if name in names}
    if not all(noise.sample_variance or noise.random_walk for noise in noise_by_name.values()):
        return []
    series = [
        setup.series(run, name, truth.spindles[run])
        for run in range(len(setup.runs))
        for name in setup.mountings
        if name in names
    ]
    design_blocks = build_design_blocks(series, model, scale_factors(series, model, truth))
    return [block.expand_block(model, noise_by_name) for block in design_blocks]


@frozen(eq=False)
class TwoStageEngine:
    """Trials of the two-stage analysis of one accelerometer.

    b2 of each run is linear in the deviations of the true values from their means, in the
    deviations of the rotation, and in their products. The second stage is linear in b2.
    """

    sigma: float | None  #: Standard deviation of a strobe, m; None: from the residuals of each run.
    weighted: bool  #: True: the runs have weights 1/sigma(b2)^2.
    estimate: Array  #: Estimate at the mean true values without noise, shape (p,).
    design: Array  #: d(b2)/d(unknown), shape (runs, p).
    #: d(b2)/d(considered parameter) times its standard uncertainty, shape (runs, k).
    considered: Array
    #: For each unknown: prior mean minus `estimate`, and standard uncertainty, shape (2, p).
    prior: Array
    residual_b2: Array  #: b2 at the mean true values minus b2 of the model, m/s^2, shape (runs,).
    keys: tuple[TruthKey, ...]  #: Keys of the t varied true values.
    #: d(b2)/d(true value), and its derivatives with respect to the drift and the cosine and sine of
    #: the ripple, shape (4, t, runs).
    response: Array
    mean_truth: Array  #: Mean true values, shape (t, 1).
    rotation_response: Array  #: The same derivatives of `residual_b2`, shape (3, runs).
    mean_rotation: Array  #: Mean drift, and cosine and sine of the ripple, shape (3, runs).
    curvature_scale: Array  #: sigma/u(b2) of each run, s^2, shape (runs,).
    dof: Array  #: Residual degrees of freedom of each run, shape (runs,).

    @classmethod
    def prepare(
        cls, setup: SimulationSetup, truth: StudyTruth, request: TwoStageRequest, owner: str
    ) -> TwoStageEngine:
        """Analyse the mean true values without noise, and differentiate the result."""
        mean_draw, runs = truth.mean_draw(), range(len(setup.runs))
        result = noise_free_second_stage(setup, truth, request, owner, mean_draw)
        fit = result.fit
        sigma_b2 = np.array([parabola.u_b2 for parabola in result.parabolas])
        estimate = fit.solution.estimate
        rows = [(block.factor, block.considered) for block in fit.blocks]
        design, considered = (
            np.vstack(column) * sigma_b2[:, None] for column in zip(*rows, strict=True)
        )
        unknowns = fit.model.unknowns
        prior_sds = [
            unknown.prior[1] if math.isfinite(unknown.prior[1]) else REGULARISATION * unknown.limit
            for unknown in unknowns
        ]
        rotation_bounds = np.array([truth.rotation_bounds(run) for run in runs])
        half_ranges = 0.5 * (rotation_bounds[..., 1] - rotation_bounds[..., 0]).T
        rotation_response = np.zeros((3, len(runs)))
        varied_parameters = [parameter for parameter in range(3) if half_ranges[parameter].any()]
        for parameter in varied_parameters:
            lower_b2, upper_b2 = (
                _residual_b2(
                    noise_free_second_stage(
                        setup,
                        truth,
                        request,
                        owner,
                        mean_draw.shift_rotation(parameter, sign * half_ranges[parameter]),
                    ),
                    estimate,
                )
                for sign in (-1.0, 1.0)
            )
            rotation_response[parameter] = (upper_b2 - lower_b2) / (
                2.0 * np.where(half_ranges[parameter] > 0.0, half_ranges[parameter], np.inf)
            )
        keys = _varied_keys(truth, len(runs))
        compute_responses = partial(_b2_responses, setup, truth, owner, keys)
        response = np.zeros((4, len(keys), len(runs)))
        response[0] = compute_responses(mean_draw)
        estimated_symbols = (
            {unknown.symbol for unknown in unknowns} if request.model == "exact" else set()
        )
        is_estimated = np.array([symbol in estimated_symbols for _, symbol, _ in keys], dtype=bool)
        for parameter in varied_parameters:
            response_change = compute_responses(
                mean_draw.shift_rotation(parameter, half_ranges[parameter])
            ) - compute_responses(mean_draw.shift_rotation(parameter, -half_ranges[parameter]))
            response[1 + parameter] = response_change / (
                2.0 * np.where(half_ranges[parameter] > 0.0, half_ranges[parameter], np.inf)
            )
            # The column of an unknown follows the change of its effect with the rotation.
            response[1 + parameter, is_estimated] = 0.0
        parabolas = result.parabolas
        return cls(
            sigma=request.sigma,
            weighted=request.weighted,
            estimate=estimate,
            design=design,
            considered=considered * np.asarray(fit.model.considered_sds),
            prior=np.array([[unknown.prior_mean for unknown in unknowns] - estimate, prior_sds]),
            residual_b2=_residual_b2(result, estimate),
            keys=keys,
            response=response,
            mean_truth=np.array([mean_draw.deviation(key) for key in keys]).reshape(-1, 1),
            rotation_response=rotation_response,
            mean_rotation=np.array(
                [
                    [mean_draw.rotation_parameters(run)[parameter][0] for run in runs]
                    for parameter in range(3)
                ]
            ),
            curvature_scale=(request.sigma or truth.white_noise) / sigma_b2,
            dof=np.array([parabola.strobes.time.size - 3.0 for parabola in parabolas]),
        )

    def run_trials(self, draws: Draws, generator: np.random.Generator) -> TrialResults:
        """Return the results of the analysis; see `TrialEngine`."""
        n_trials = draws.n_trials
        b2 = curvature_noise(generator, draws.white_noise, self.curvature_scale[:, None], n_trials)
        b2 += self.residual_b2[:, None]
        deviations = _deviations(draws, self.keys, self.mean_truth)
        b2 += self.response[0].T @ deviations
        for parameter, values in enumerate((draws.drift, draws.ripple_cos, draws.ripple_sin)):
            if self.rotation_response[parameter].any() or self.response[1 + parameter].any():
                derivative = (
                    self.rotation_response[parameter][:, None]
                    + self.response[1 + parameter].T @ deviations
                )
                b2 += derivative * (values - self.mean_rotation[parameter][:, None])
        if self.sigma is None:
            variance = residual_variances(generator, draws.white_noise, self.dof, n_trials)
        else:
            variance = np.full((1, 1), self.sigma**2)
        return self._solve_second_stage(b2, variance / self.curvature_scale[:, None] ** 2)

    def _solve_second_stage(self, b2: Array, b2_variance: Array) -> TrialResults:
        """Apply the second stage to all trials.

        With columns x_r, weights w_r and a prior P, the covariance is
        C = (sum_r w_r x_r x_r' + P)^-1, and the gain d(estimate)/d(b2) is C x_r w_r.

        b2_variance: Variance of b2, shape (runs, n or 1).
        """
        x, (prior_mean, prior_sd) = self.design, self.prior
        mean_variance = np.broadcast_to(b2_variance.mean(axis=0, keepdims=True), b2_variance.shape)
        weights = 1.0 / (b2_variance if self.weighted else mean_variance)
        scale = 1.0 / np.sqrt(np.sum(x**2 * weights[:, :1], axis=0) + prior_sd**-2.0)
        scaled_design = x * scale
        information = np.einsum("rp,rn,rq->npq", scaled_design, weights, scaled_design)
        information += np.diag((scale / prior_sd) ** 2)
        covariance = np.linalg.inv(information) * scale[:, None] * scale
        gain = np.einsum("npq,rq,rn->prn", covariance, x, weights)
        estimate = _sum_over_runs(gain, b2) + self.estimate[:, None]
        estimate += np.einsum("npq,q->pn", covariance, prior_mean / prior_sd**2)
        contributions = gain**2 * b2_variance
        variance = contributions.sum(axis=1) + np.einsum("npq,q->pn", covariance**2, prior_sd**-2.0)
        variance = variance + np.sum(np.einsum("prn,rk->pkn", gain, self.considered) ** 2, axis=1)
        dof = np.full((1, 1), math.inf)
        if self.sigma is None:
            # Welch and Satterthwaite.
            dof = variance**2 / _sum_over_runs(contributions**2, 1.0 / self.dof[:, None])
        u = np.sqrt(variance)
        return TrialResults(
            estimate, np.broadcast_to(u, estimate.shape), np.broadcast_to(dof, estimate.shape)
        )


def noise_free_second_stage(
    setup: SimulationSetup, truth: StudyTruth, request: TwoStageRequest, owner: str, draws: Draws
) -> SecondStage:
    """Analyse the first trial without noise, using the weights for the stated noise."""
    noise_free_setup = replace(setup, noise=ZERO_NOISE)
    records = TrialRecords(noise_free_setup, draws, np.random.default_rng(0))
    request = replace(request, sigma=request.sigma or truth.white_noise)
    runs = [records.strobed_run(run, owner, request) for run in range(len(setup.runs))]
    return second_stage(runs, setup.mountings[owner], request, ignored=())


def _residual_b2(result: SecondStage, estimate: Array) -> Array:
    """Return b2 minus the prediction of the estimate, m/s^2, shape (runs,)."""
    considered_means = result.fit.model.considered_means
    residuals = [
        block.target - block.factor @ estimate - block.considered @ considered_means
        for block in result.fit.blocks
    ]
    return np.concatenate(residuals) * [parabola.u_b2 for parabola in result.parabolas]


def _b2_responses(
    setup: SimulationSetup, truth: StudyTruth, owner: str, keys: Sequence[TruthKey], draws: Draws
) -> Array:
    """Return d(b2)/d(true value) for each key, shape (keys, runs)."""
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
    orthogonal_square = square - square.mean() - (np.sum(square * t) / np.sum(square)) * t
    return np.asarray(orthogonal_square / np.sum(orthogonal_square * orthogonal_square))


def _sum_over_runs(factors: Array, values: Array) -> Array:
    """Sum factors (p, r, n or 1) times values (r, n or 1) over the runs, shape (p, n)."""
    if factors.shape[-1] == 1:
        return np.asarray(factors[:, :, 0] @ values)
    return np.asarray(np.einsum("prn,rn->pn", factors, values))
