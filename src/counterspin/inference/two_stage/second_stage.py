"""The paper's two-stage identification (Eq. 19-27, 33-34), for one accelerometer.

First stage: b0 + b1 t + b2 t^2 is fitted to the strobed displacement error of each run
(`first_stage`). Second stage: K_II and other unknowns are estimated from the b2 of all runs at
their different rates, by the solver of the joint fit with one row per run (`model`). Budgets,
sensitivities and tests of priors are therefore those of any fit.

Two observation models:
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import field, replace
from functools import cached_property
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.errors import NotIdentifiableError
from counterspin.frozen import frozen
from counterspin.inference.identifiability import COLLINEAR_CORRELATION, NEAR_COLLINEAR
from counterspin.inference.joint.design_blocks import DesignBlock
from counterspin.inference.joint.estimated_noise import inflate_covariance
from counterspin.inference.joint.fit import JointFit, solve_blocks, solve_joint
from counterspin.inference.joint.series import ResidualSeries
from counterspin.inference.joint.unknowns import RIPPLE, Considered, Unknowns
from counterspin.inference.noise.components import COMPONENTS
from counterspin.inference.noise.model import Noise
from counterspin.inference.noise.search import NoiseEstimate
from counterspin.inference.two_stage.first_stage import Parabola
from counterspin.inference.two_stage.model import (
    DRIFT,
    MIN_SIGMA,
    Curvature,
    TwoStageRequest,
    exact_columns,
    printed_columns,
    two_stage_model,
)
from counterspin.physics import observation
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.motion import Trajectory
from counterspin.physics.spindle import TURN
from counterspin.physics.terms import term

#: Relative difference below which rates do not separate unknowns.
_RATE_TOLERANCE: Final = 1e-3

#: Smallest effect of a term at its largest credible size, in sigma(b2), to be reported.
_MIN_VISIBLE_EFFECT: Final = 0.5


@frozen
class StrobedRun:
    """Inputs of the second stage from one run.

    Attributes
    ----------
    name
        The run's name.
    trajectory
        The rotation for the exact columns.
    parabola
        The run's first stage.
    attitude
        The platform's attitude, as for `counterspin.columns`.
    """

    name: str
    trajectory: Trajectory
    parabola: Parabola
    attitude: Array = field(default_factory=lambda: observation.LEVEL)


@frozen
class SecondStage:
    """The second stage (Eq. 20-27, 33-34) of one accelerometer.

    Attributes
    ----------
    fit
        The joint fit of the curvatures: one row per run, with unit variance. Its unknowns are
        K_II, then K_F (exact) and the second unknown of the spindle, if any. For runs without
        weights, the solution has equal weights and the uncertainty of the actual b2 (Eq. 34).
    parabolas
        The first stages, in the order of the runs.
    dof
        Effective degrees of freedom of each unknown's u (Welch-Satterthwaite over the runs),
        shape (p,); infinite where sigma is given.
    weighted
        Whether the runs were weighted by 1/sigma(b2)^2.
    """

    fit: JointFit
    parabolas: tuple[Parabola, ...]
    dof: Array
    weighted: bool

    @property
    def symbols(self) -> tuple[str, ...]:
        """Symbols of the unknowns."""
        return tuple(unknown.symbol for unknown in self.fit.model.unknowns)

    @property
    def runs(self) -> tuple[StrobedRun, ...]:
        """The runs, with the estimated rotation."""
        return tuple(
            StrobedRun(block.run, block.series.trajectory, parabola, block.series.attitude)
            for block, parabola in zip(self.fit.design_blocks, self.parabolas, strict=True)
        )

    def estimate(self, symbol: str) -> tuple[float, float]:
        """Return value and combined standard uncertainty of an unknown."""
        index = self.symbols.index(symbol)
        return float(self.fit.solution.estimate[index]), float(self.fit.solution.u[index])

    @cached_property
    def contributions(self) -> Array:
        """Effect of each run's noise on each unknown, one standard deviation, shape (p, runs)."""
        return _contributions(self.fit)

    @property
    def gain(self) -> Array:
        """d(estimate)/d(b2), shape (p, runs)."""
        return self.contributions / _sigma(self.parabolas)

    @property
    def misfit(self) -> Array:
        """Residual of b2 of each run, in its standard uncertainties, shape (runs,)."""
        return np.concatenate(
            [
                block.target
                - block.factor @ self.fit.solution.estimate
                - block.considered @ self.fit.model.considered_means
                for block in self.fit.blocks
            ]
        )

    @property
    def near_collinear(self) -> tuple[tuple[str, str, float], ...]:
        """Pairs of columns whose correlation exceeds `NEAR_COLLINEAR`, and their correlation."""
        information, symbols = self.fit.solution.information, self.symbols
        unit_columns = information / np.linalg.norm(information, axis=0)
        cosines = unit_columns.T @ unit_columns
        return tuple(
            (symbols[i], symbols[j], float(cosines[i, j]))
            for i in range(len(symbols))
            for j in range(i + 1, len(symbols))
            if abs(cosines[i, j]) > NEAR_COLLINEAR
        )

    def alike(self, symbol: str, other_symbols: Iterable[str]) -> dict[str, float]:
        """Return the considered terms with the same effect as an unknown.

        The estimate of the unknown then includes these terms.

        Parameters
        ----------
        symbol
            The unknown.
        other_symbols
            The terms to compare with.

        Returns
        -------
        dict
            Term -> equivalent value of the unknown per unit of the term. Terms without a visible
            effect at their largest credible size are omitted.
        """
        rows = np.vstack([block.factor for block in self.fit.blocks])
        considered = np.vstack([block.considered for block in self.fit.blocks])
        column = rows[:, self.symbols.index(symbol)]
        weights = {}
        for considered_symbol in other_symbols:
            indices = self._considered_indices(considered_symbol)
            effect = considered[:, indices].sum(axis=1)
            norm, inner_product = float(np.linalg.norm(effect)), float(column @ effect)
            limit = max((self.fit.model.considered[k].limit for k in indices), default=0.0)
            is_visible = norm * limit > _MIN_VISIBLE_EFFECT
            if is_visible and abs(inner_product) > COLLINEAR_CORRELATION * norm * float(
                np.linalg.norm(column)
            ):
                weights[considered_symbol] = inner_product / float(column @ column)
        return weights

    def shift(self, symbol: str) -> Array:
        """Return the effect of one unit of an uncorrected considered term on the unknowns, (p,).

        For a term of each run, the effects of the runs are combined as independent.
        """
        sensitivities = -self.fit.solution.sensitivity_considered[
            :, self._considered_indices(symbol)
        ]
        return np.asarray(
            sensitivities[:, 0]
            if sensitivities.shape[1] == 1
            else np.linalg.norm(sensitivities, axis=1)
        )

    def _considered_indices(self, symbol: str) -> list[int]:
        considered = self.fit.model.considered
        return [index for index, term in enumerate(considered) if term.symbol == symbol]


def resolve(
    series: Sequence[ResidualSeries],
    parabolas: Sequence[Parabola],
    model: Unknowns,
    request: TwoStageRequest,
) -> SecondStage:
    """Estimate the unknowns from the curvatures of the runs of an accelerometer.

    The model is `model.two_stage_model`'s; errors are those of `second_stage`.
    """
    _check_rates(series, model, {DRIFT, RIPPLE} if request.ripple == "amplitude" else {DRIFT})
    noise = {series[0].accelerometer: Noise(parabolas[0].sigma, request.random_walk or 0.0)}

    def solve(blocks: Sequence[DesignBlock], model: Unknowns) -> JointFit:
        rows = map(Curvature.from_block, blocks, parabolas)
        fit = solve_joint(tuple(rows), model, noise)
        if request.weighted:
            return fit
        # Rows with a common variance, and then the uncertainty of the actual b2.
        sigma = _sigma(parabolas)
        ratios = sigma / math.sqrt(np.mean(sigma**2))
        equal_weights = [
            block.scaled(ratio) for block, ratio in zip(fit.blocks, ratios, strict=True)
        ]
        solution = solve_blocks(equal_weights, model).replace_row_noise(ratios)
        return replace(fit, solution=replace(solution, information=fit.solution.information))

    def columns(fit: JointFit | None, model: Unknowns) -> Sequence[DesignBlock]:
        if request.model == "as-printed":
            return [printed_columns(record, model, request.ripple, fit) for record in series]
        return exact_columns(series, model, fit)

    # Some columns depend on the estimate, so there are two iterations; inputs enter the second.
    reduced_model = model.without_inputs()
    fit = solve(columns(solve(columns(None, reduced_model), reduced_model), model), model)
    return SecondStage(fit, tuple(parabolas), _effective_dof(fit, parabolas), request.weighted)


def apply_noise_uncertainty(
    second_stage: SecondStage, noise: Noise, noise_estimate: NoiseEstimate | None
) -> SecondStage:
    """Return the second stage with the uncertainty of the accelerometer's noise.

    noise_estimate: Estimate of the noise, if it was estimated.
    """
    gain, noise_sensitivities = (
        second_stage.gain,
        np.array([parabola.by_noise for parabola in second_stage.parabolas]),
    )
    if second_stage.parabolas[0].sigma_from_residuals:
        # The white noise has the degrees of freedom of the strobes' own residuals.
        noise_sensitivities[:, 0] = 0.0
    covariance_sensitivities = np.zeros((len(COMPONENTS), len(gain), len(gain)))
    covariance_sensitivities[: noise_sensitivities.shape[1]] = [
        (gain * variances) @ gain.T for variances in noise_sensitivities.T
    ]
    name = second_stage.fit.design_blocks[0].accelerometer
    estimates = {} if noise_estimate is None else {name: noise_estimate}
    fit, dof = inflate_covariance(
        second_stage.fit,
        {name: covariance_sensitivities},
        {name: noise},
        estimates,
        second_stage.dof,
    )
    return replace(second_stage, fit=fit, dof=dof)


def second_stage(
    runs: Sequence[StrobedRun],
    mounting: Mounting,
    request: TwoStageRequest | None = None,
    *,
    ignored: Sequence[str] = ("K_III",),
) -> SecondStage:
    """Estimate K_II and the other unknowns from the b2 of several runs.

    Parameters
    ----------
    runs
        At least as many different rates as unknowns without a prior.
    mounting
        The accelerometer's axes in the level attitude.
    request
        Model, priors and weights; None: the exact model without priors. The noise is that of the
        first stage.
    ignored
        Terms without a prior whose effect on the estimates is computed, without estimating them.

    Returns
    -------
    SecondStage

    Raises
    ------
    NotIdentifiableError
        If there are fewer different rates than unknowns; both senses of one rate count once
        where no unknown changes its sign with the sense.
    """
    request = request or TwoStageRequest()
    names = [run.name for run in runs]
    names = [n if names.count(n) == 1 else f"{n} ({i + 1})" for i, n in enumerate(names)]
    series = [
        ResidualSeries(
            accelerometer="",
            run=name,
            trajectory=run.trajectory,
            mounting=mounting,
            observable="displacement",
            attitude=run.attitude,
            time=run.parabola.strobes.time,
            time_sd=np.zeros_like(run.parabola.strobes.time),
            count=run.parabola.strobes.noise_factor**-2.0,
            spacing=TURN / abs(run.trajectory.spindle.rate),
            error=run.parabola.strobes.error,
        )
        for name, run in zip(names, runs, strict=True)
    ]
    ignored_priors = {symbol: (term(symbol).nominal, 0.0) for symbol in ignored}
    considered = tuple(
        Considered(owner, symbol, prior, term(symbol).limit)
        for symbol, prior in {**ignored_priors, **request.considered}.items()
        for owner in (names if term(symbol).per_run else [""])
    )
    inputs = tuple(
        Considered("", symbol, (0.0, u), term(symbol).limit)
        for symbol, u in request.inputs(runs[0].trajectory).items()
    )
    prior_model = Unknowns((), (*considered, *inputs))
    model = two_stage_model(prior_model, request, series)
    return resolve(series, [run.parabola for run in runs], model, request)


def _check_rates(
    series: Sequence[ResidualSeries], model: Unknowns, sense_dependent: Collection[str]
) -> None:
    """Raise if the rates do not determine the unknowns.

    sense_dependent: Unknowns that change sign with the sense.
    """
    free_symbols = [u.symbol for u in model.unknowns if math.isinf(u.prior[1])]
    even_symbols = [symbol for symbol in free_symbols if symbol not in sense_dependent]
    rates = [record.trajectory.spindle.rate for record in series]
    for n_required, n_rates, description in (
        (
            even_symbols,
            _count_distinct_rates([abs(rate) for rate in rates]),
            "rates, in either sense",
        ),
        (free_symbols, _count_distinct_rates(rates), "rates"),
    ):
        if n_rates < len(n_required):
            raise NotIdentifiableError(
                f"{len(n_required)} unknowns without a prior ({', '.join(n_required)}) require at "
                f"least {len(n_required)} different {description}, but the campaign has only "
                f"{n_rates}. Add runs at other rates, or state priors"
            )


def _count_distinct_rates(rates: Sequence[float]) -> int:
    distinct_rates: list[float] = []
    for rate in rates:
        if all(
            abs(rate - distinct_rate) > _RATE_TOLERANCE * abs(distinct_rate)
            for distinct_rate in distinct_rates
        ):
            distinct_rates.append(rate)
    return len(distinct_rates)


def _sigma(parabolas: Sequence[Parabola]) -> Array:
    """Return sigma(b2) of each run, m/s^2, shape (runs,)."""
    return np.array([max(parabola.u_b2, MIN_SIGMA) for parabola in parabolas])


def _contributions(fit: JointFit) -> Array:
    identity = np.eye(len(fit.model.unknowns))
    return np.array([fit.solution.combine(row).noise_rows for row in identity])


def _effective_dof(fit: JointFit, parabolas: Sequence[Parabola]) -> Array:
    """Return Welch-Satterthwaite degrees of freedom (GUM G.4.1), shape (p,)."""
    if not parabolas[0].sigma_from_residuals:
        return np.full(len(fit.model.unknowns), math.inf)
    variances = _contributions(fit) ** 2
    dof = np.array([parabola.dof for parabola in parabolas])
    inverse_dof = np.sum(variances**2 / dof, axis=1)
    is_known = inverse_dof == 0.0  # exactly, beforehand
    return np.where(is_known, np.inf, fit.solution.u**4 / np.where(is_known, 1.0, inverse_dof))
