"""The paper's two-stage identification (Eq. 19-27, 33-34), for one accelerometer.

First stage, per run: the strobed displacement error is fitted with b0 + b1 t + b2 t^2
(`first_stage` beside this module). Second stage, here: the b2 of all runs, at their different
rates, are resolved into K_II and the unknowns beside it.

Two observation models:

- ``exact``: each coefficient's b2 is the first stage applied to its own displacement column
  along the identified rotation, so that drift and ripple are accounted for; at constant rate
  K_II enters with R^2 w^4/(4 g). K_F is estimated beside it, with its prior. Only where the
  nominal angle is the reference does the drift C show, as -(1/2) K_I R w C.
- ``as-printed``: Eq. 26, with 1/2 for K_II and a ripple column that exact physics does not have.

- `second_stage`, `SecondStage`
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import field, replace
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.errors import NotIdentifiableError
from counterspin.frozen import frozen
from counterspin.inference import least_squares
from counterspin.inference.blocks import reduce_block
from counterspin.inference.identifiability import NEAR_COLLINEAR, TWIN_AGREEMENT
from counterspin.inference.two_stage.first_stage import Parabola
from counterspin.inference.two_stage.request import DRIFT, RIPPLE, TwoStageRequest
from counterspin.physics import as_printed, observation
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.motion import Trajectory
from counterspin.physics.terms import term

#: Rates closer than this (relative) do not help to tell unknowns apart.
_SAME_RATE_WITHIN: Final = 1e-3

#: An effect below this many sigma(b2), at the term's largest credible size, is nothing to name.
_SMALLEST_VISIBLE: Final = 0.5


@frozen
class StrobedRun:
    """What the second stage needs of one run.

    Attributes
    ----------
    name
        The run's name.
    trajectory
        The rotation along which the exact columns are taken.
    parabola
        The run's first stage.
    attitude
        The platform's attitude, as for `observation.columns`.
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
    symbols
        The unknowns: K_II first, then K_F (exact) and the spindle's second unknown, if any.
    design
        d(b2)/d(unknown), m/s^2 per unit, shape (runs, p).
    gain
        d(estimate)/d(b2), shape (p, runs).
    sigma
        sigma(b2) of each run, m/s^2, shape (runs,).
    solution
        Values, covariance by source and sensitivities in the order of `symbols`.
    considered
        The terms that were considered, in the order of the solution's considered columns: (run,
        symbol), where the run is empty for what all runs share.
    fixed
        d(b2)/d(considered term), m/s^2 per unit, shape (runs, q), in this order.
    assumed
        What is known of them, less what they ideally are, shape (q,).
    dof
        Effective degrees of freedom of each unknown's noise part (Welch-Satterthwaite over the
        runs), shape (p,); infinite where sigma is given.
    near_collinear
        Pairs of columns whose correlation in the data exceeds `NEAR_COLLINEAR`, with it.
    misfit
        Each run's b2 less the model's, in units of its standard uncertainty, shape (runs,).
    ignored
        Term -> d(b2)/d(coefficient), shape (runs,), of terms that are neither estimated nor
        considered. Ripple makes a parabola of K_III, for example.
    request
        What was asked.
    """

    symbols: tuple[str, ...]
    design: Array
    gain: Array
    sigma: Array
    solution: least_squares.Solution
    considered: tuple[tuple[str, str], ...]
    fixed: Array
    assumed: Array
    dof: Array
    near_collinear: tuple[tuple[str, str, float], ...]
    misfit: Array
    ignored: Mapping[str, Array]
    request: TwoStageRequest

    def estimate(self, symbol: str) -> tuple[float, float]:
        """Return value and combined standard uncertainty of an unknown."""
        index = self.symbols.index(symbol)
        return float(self.solution.estimate[index]), float(self.solution.u[index])

    @property
    def u_noise(self) -> Array:
        """What noise contributes to each unknown's standard uncertainty, shape (p,)."""
        solution = self.solution
        variance = np.diag(solution.covariance_noise)
        if solution.covariance_unseen is not None:
            variance = variance + np.diag(solution.covariance_unseen)
        return np.sqrt(variance)

    def with_inputs(self, symbol: str, request: TwoStageRequest) -> tuple[float, float]:
        """Return u and its degrees of freedom, uncertain radius and gravity included.

        What does not come from the residuals has no degrees of freedom to lose (GUM G.4.1).
        """
        value, u = self.estimate(symbol)
        index = self.symbols.index(symbol)
        noise = float(self.u_noise[index])
        u = math.hypot(u, *request.from_inputs(symbol, value))
        return u, float(self.dof[index]) * (u / noise) ** 4 if noise > 0.0 else math.inf

    def shift(self, symbol: str) -> Array:
        """Return what one unit of an ignored term moves each unknown by, shape (p,).

        Of a term that every run has anew, the runs' effects are combined as independent ones.
        """
        shifts = self.gain * self.ignored[symbol]
        if term(symbol).per_run:
            together: Array = np.linalg.norm(shifts, axis=1)
            return together
        return np.asarray(shifts.sum(axis=1))

    def exact_shifts(self) -> dict[str, Array]:
        """Return what one unit of each exactly known term moves each unknown by, shape (p,).

        What is held at a value is off by the whole of its error. Signs as of `shift`.
        """
        solution = self.solution
        shifts: dict[str, list[Array]] = {}
        for place, (_, symbol) in enumerate(self.considered):
            if solution.considered_sd[place] == 0.0:
                moved = -solution.sensitivity_considered[:, place]
                shifts.setdefault(symbol, []).append(moved)
        for place in np.flatnonzero(solution.prior_sd == 0.0).tolist():
            moved = self.gain @ self.design[:, place]
            moved[place] = -1.0
            shifts[self.symbols[place]] = [moved]
        return {
            symbol: parts[0] if len(parts) == 1 else np.linalg.norm(parts, axis=0)
            for symbol, parts in shifts.items()
        }

    def alike(self, symbol: str) -> dict[str, float]:
        """Return the ignored terms that act on every run exactly as an unknown does.

        The estimate of the unknown is then one of the sum of all of them.

        Parameters
        ----------
        symbol
            The unknown.

        Returns
        -------
        dict
            Term -> how much of the unknown one unit of it is like. Terms that cannot be seen at
            their largest credible size are left out.
        """
        column = self.design[:, self.symbols.index(symbol)] / self.sigma
        alike = {}
        for other, effect in self.ignored.items():
            whitened = effect / self.sigma
            size = float(np.linalg.norm(whitened))
            along = float(column @ whitened)
            seen = size * self.request.limit_of(other) > _SMALLEST_VISIBLE
            if seen and abs(along) > TWIN_AGREEMENT * size * float(np.linalg.norm(column)):
                alike[other] = along / float(column @ column)
        return alike


def second_stage(
    runs: Sequence[StrobedRun],
    mounting: Mounting,
    request: TwoStageRequest | None = None,
    *,
    ignored: Sequence[str] = ("K_III",),
) -> SecondStage:
    """Resolve the b2 of several runs into K_II and the unknowns beside it.

    Parameters
    ----------
    runs
        At least as many different rates as unknowns without a prior.
    mounting
        The accelerometer's axes in the level attitude.
    request
        Model, priors and weights; None: the exact model, and nothing known beforehand. Its noise
        is the first stage's.
    ignored
        Terms of which only the effect is wanted that they would have; those that turn out to be
        unknowns are passed over.

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
    unknowns, known = request.unknowns, request.considered
    symbols = tuple(unknowns)
    odd = {DRIFT, RIPPLE} if request.ripple == "amplitude" else {DRIFT}
    _check_rates(runs, unknowns, odd)

    observed = _ObservationModel(runs, mounting, request)
    ignored = [symbol for symbol in ignored if symbol not in symbols]
    shown = observed.effects(list(dict.fromkeys([*symbols, *known, *ignored])))
    design = np.column_stack([shown[symbol] for symbol in symbols])
    names, effects, means, spreads = [], [], [], []
    for symbol, (value, sd) in known.items():
        effect = shown[symbol]
        # A term that every run has anew is as many independent sources as there are runs.
        each = np.diag(effect) if term(symbol).per_run else effect[:, None]
        effects.append(each)
        means += [value - term(symbol).nominal] * each.shape[1]
        spreads += [sd] * each.shape[1]
        names += [(run.name, symbol) for run in runs] if term(symbol).per_run else [("", symbol)]
    fixed = np.column_stack(effects)
    b2 = np.array([run.parabola.b2 for run in runs])
    sigma = np.array([run.parabola.u_b2 for run in runs])
    # Where residuals vanish (a noise-free demonstration) any common weight serves.
    sigma = np.where(sigma > 0.0, sigma, np.finfo(float).tiny ** 0.25)
    mean_sigma = np.full_like(sigma, math.sqrt(np.mean(sigma**2)))
    whitening = sigma if request.weighted else mean_sigma

    block = reduce_block(
        design / whitening[:, None], b2 / whitening, None, fixed / whitening[:, None]
    )
    solution = least_squares.solve(
        [block],
        prior_mean=[mean for mean, _ in unknowns.values()],
        prior_sd=[sd for _, sd in unknowns.values()],
        considered_mean=means,
        considered_sd=spreads,
        limits=[request.limit_of(symbol) for symbol in symbols],
    )
    gain = _gain(design / whitening[:, None], unknowns) / whitening
    if not request.weighted:
        # Eq. 34: the estimate is unweighted, its uncertainty is that of the actual b2.
        spread = gain * sigma
        solution = replace(solution, covariance_noise=spread @ spread.T)
    predicted = design @ solution.estimate + fixed @ np.array(means)
    return SecondStage(
        symbols=symbols,
        design=design,
        gain=gain,
        sigma=sigma,
        solution=solution,
        considered=tuple(names),
        fixed=fixed,
        assumed=np.array(means),
        dof=_effective_dof(gain, sigma, [run.parabola for run in runs]),
        near_collinear=_near_collinear(symbols, design / whitening[:, None]),
        misfit=(b2 - predicted) / sigma,
        ignored={symbol: shown[symbol] for symbol in ignored},
        request=request,
    )


def _check_rates(
    runs: Sequence[StrobedRun],
    unknowns: Mapping[str, tuple[float, float]],
    odd: Collection[str],
) -> None:
    """Refuse what cannot be solved; `odd` are the unknowns that change sign with the sense."""
    free = [symbol for symbol, (_, sd) in unknowns.items() if math.isinf(sd)]
    even = [symbol for symbol in free if symbol not in odd]
    rates = [run.trajectory.spindle.rate for run in runs]
    for needed, different, words in (
        (even, _different([abs(rate) for rate in rates]), "rates, whatever their sense"),
        (free, _different(rates), "rates"),
    ):
        if different < len(needed):
            raise NotIdentifiableError(
                f"{len(needed)} unknowns without a prior ({', '.join(needed)}) need at least "
                f"{len(needed)} different {words}; the campaign has {different}: add runs at other "
                "rates, or give priors"
            )


def _different(rates: Sequence[float]) -> int:
    kept: list[float] = []
    for rate in rates:
        if all(abs(rate - other) > _SAME_RATE_WITHIN * abs(other) for other in kept):
            kept.append(rate)
    return len(kept)


@frozen
class _ObservationModel:
    """What one unit of a coefficient adds to each run's b2, under one of the two models."""

    runs: Sequence[StrobedRun]
    mounting: Mounting
    request: TwoStageRequest

    def effects(self, symbols: Sequence[str]) -> dict[str, Array]:
        """Return d(b2)/d(coefficient), m/s^2 per unit, shape (runs,), of every symbol."""
        if self.request.model == "as-printed":
            return {symbol: self._printed(symbol) for symbol in symbols}
        terms = [symbol for symbol in symbols if symbol != DRIFT]
        shown = np.array([self._exact(run, terms) for run in self.runs])
        effects = dict(zip(terms, shown.T, strict=True))
        if DRIFT in symbols:
            rates = np.array([run.trajectory.spindle.rate for run in self.runs])
            radii = np.array([run.trajectory.radius for run in self.runs])
            effects[DRIFT] = -0.5 * self.request.scale_factor * radii * rates
        return effects

    def _exact(self, run: StrobedRun, terms: Sequence[str]) -> Array:
        """Return the first stage of each term's own column, shape (terms,)."""
        columns = observation.columns(
            run.trajectory,
            self.mounting,
            terms,
            run.parabola.strobes.time,
            attitude=run.attitude,
            scale_factor=self.request.scale_factor,
        )
        effect: Array = run.parabola.gain[2] @ columns
        return effect

    def _printed(self, symbol: str) -> Array:
        """Return a column of Eq. 26, or the K_F of Eq. 19; all else has no t^2 there."""
        motion = self.runs[0].trajectory
        rates = np.array([run.trajectory.spindle.rate for run in self.runs])
        if symbol in ("K_II", RIPPLE):
            printed = as_printed.second_stage_columns(
                rates,
                motion.radius,
                motion.site.gravity,
                self.request.scale_factor,
                self.request.ripple,
            )
            column: Array = printed[:, 0 if symbol == "K_II" else 1]
            return column
        return np.full(rates.size, 0.5 * motion.site.gravity if symbol == "K_F" else 0.0)


def _gain(design: Array, unknowns: Mapping[str, tuple[float, float]]) -> Array:
    """Return d(estimate)/d(whitened b2), shape (p, runs), priors included."""
    sd = np.array([sd for _, sd in unknowns.values()])
    free = sd > 0.0  # what is known exactly does not move
    scale = np.linalg.norm(design[:, free], axis=0)
    with_priors = np.vstack([design[:, free], np.diag(1.0 / sd[free])])
    gain = np.zeros(design.T.shape)
    inverse = np.linalg.pinv(with_priors / scale) / scale[:, None]
    gain[free] = inverse[:, : design.shape[0]]
    return gain


def _effective_dof(gain: Array, sigma: Array, parabolas: Sequence[Parabola]) -> Array:
    """Return Welch-Satterthwaite degrees of freedom (GUM G.4.1), shape (p,)."""
    if not parabolas[0].sigma_from_residuals:
        return np.full(gain.shape[0], math.inf)
    parts = (gain * sigma) ** 2
    dof = np.array([parabola.dof for parabola in parabolas])
    effective: Array = parts.sum(axis=1) ** 2 / np.sum(parts**2 / dof, axis=1)
    return effective


def _near_collinear(symbols: Sequence[str], design: Array) -> tuple[tuple[str, str, float], ...]:
    unit = design / np.linalg.norm(design, axis=0)
    cosine = unit.T @ unit
    return tuple(
        (symbols[i], symbols[j], float(cosine[i, j]))
        for i in range(len(symbols))
        for j in range(i + 1, len(symbols))
        if abs(cosine[i, j]) > NEAR_COLLINEAR
    )
