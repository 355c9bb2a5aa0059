"""Trials of the two-stage method without records: b2 of every run, straight from its distribution.

With white Gaussian noise the first stage of a run is summed up by b2, which is normal about what
the errors add to it, and by the sum of squared residuals, a chi-square. Neither needs the strobes
themselves. The second stage then is a small least-squares problem, solved for all trials of a
batch at once. One reading is taken at each strobe, as the paper's plan has it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.joint.inputs import concerns, with_input
from counterspin.inference.joint.unknowns import RIPPLE
from counterspin.inference.least_squares import REGULARISATION
from counterspin.inference.two_stage.request import TwoStageRequest
from counterspin.physics import as_printed
from counterspin.physics.terms import SHARED_TERMS, TERMS, term
from counterspin.studies.draws import Draws, StudyTruth, of_run
from counterspin.studies.engine import Trials
from counterspin.studies.noise import curvature_noise, residual_variances
from counterspin.studies.strobed_effects import StrobedMotion, curvature_gain, effects
from counterspin.studies.surrogate import Surrogate
from counterspin.studies.world import World


@frozen
class TwoStageEngine:
    """Trials of one accelerometer's two-stage analysis."""

    request: TwoStageRequest  #: What the analysis estimates and takes as known.
    owner: str  #: The accelerometer.
    motions: tuple[StrobedMotion, ...]  #: The runs.
    #: The terms whose effects are computed: what is true, and what the analysis knows of.
    symbols: tuple[str, ...]
    true: tuple[tuple[str, str], ...]  #: Those that are true: (owner, symbol).
    surrogates: tuple[Surrogate, ...] | None  #: Of each run; None: quadrature for every trial.
    #: (recorder of a clock, else empty; symbol) of an input that is not as stated -> by how much it
    #: changes each effect in each run, and b2 of a perfect system, per unit, shape (q + 1, runs).
    inputs: Mapping[tuple[str, str], Array]

    def trials(self, draws: Draws, generator: np.random.Generator) -> Trials:
        """Return what the analysis says; see `Engine`."""
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
        found, size = (
            np.array(np.broadcast_to(part, (*part.shape[:-1], n))) for part in surrogate(everywhere)
        )
        exact = effects(self.motions[run], self.symbols, *(part[outside] for part in everywhere))
        found[:, outside], size[outside] = exact
        return found, size

    def _shift(self, draws: Draws, run: int, effect: Array) -> Array:
        """Return what the true errors add to a run's b2, shape (n or 1,)."""
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
        held = np.where(np.isinf(sd), REGULARISATION * np.array(limits), sd)
        inverse = _inverse(_information(design, weight, held))
        gain = sum(inverse[:, q, None] * design[q] for q in range(len(mean))) * weight
        explained = np.einsum("p,prn->rn", mean, design)
        for symbol, (value, _) in considered.items():
            explained = explained + (value - term(symbol).nominal) * fixed[symbol]
        estimate = _over_runs(gain, b2 - explained)
        estimate += mean[:, None]
        parts = gain**2 * noise
        scatter = np.sum(parts, axis=1)
        total = scatter + np.einsum("pqn,q->pn", inverse**2, 1.0 / held**2)
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
    """Return what each input that is not as stated changes; see `TwoStageEngine.inputs`.

    To first order, and as it is where the rotation is that which does not vary.
    """
    changes = {key: np.zeros((len(symbols) + 1, len(world.runs))) for key in truth.moving_inputs}
    for run, spindle in enumerate(world.spindles):
        times = spindle.time_at(world.strobed(run, owner).angles)
        series = world.series(run, owner, spindle, times)
        gain = curvature_gain(times[:, None])[0][:, 0]
        before = gain @ np.column_stack([series.columns(symbols, 1.0), series.reference()])
        for (recorder, name), change in changes.items():
            if not concerns(series, name, recorder):
                continue
            reference, columns, step = with_input(series, name, symbols, 1.0)
            change[:, run] = (gain @ np.column_stack([columns, reference]) - before) / step
    return changes


def _stacked(parts: Sequence[Array], axis: int) -> Array:
    """Return the runs' arrays as one; their last axis is n, or 1 where nothing varies."""
    n = max(part.shape[-1] for part in parts)
    return np.stack([np.broadcast_to(part, (*part.shape[:-1], n)) for part in parts], axis=axis)


def _over_runs(each: Array, values: Array) -> Array:
    """Return the sums over the runs of each (p, r, n or 1) times values (r, n or 1), (p, n)."""
    if each.shape[-1] == 1:
        return np.asarray(each[:, :, 0] @ values)
    return np.asarray(np.einsum("prn,rn->pn", each, values))


def _information(design: Array, weight: Array, held: Array) -> Array:
    """Return the information on the unknowns, (p, p, n): weighted products and priors."""
    p, runs, _ = design.shape
    products = (design[:, None] * design).reshape(p * p, runs, -1)
    information = _over_runs(products, np.broadcast_to(weight, (runs, weight.shape[-1])))
    information[:: p + 1] += 1.0 / held[:, None] ** 2
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
