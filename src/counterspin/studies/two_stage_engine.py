"""Trials of the two-stage method: b2 of every run, by polynomials of the small errors.

With white Gaussian noise the first stage of a run is summed up by b2, which is normal about what
the errors add to it, and by the sum of squared residuals, a chi-square. Neither needs the strobes
themselves. The second stage then is a small least-squares problem, solved for all trials of a
batch at once. One reading is taken at each strobe, as the paper's plan has it.

What each error adds to a run's b2 (`counterspin.studies.strobed_effects`) is a smooth function of
the drift and of the first harmonic's cosine and sine parts. A polynomial of the fourth degree
through points computed by quadrature stands for it inside a box, whose corners and inside are
checked when it is made. Quantities that do not vary take no part; where none varies the polynomial
is a constant.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array
from counterspin.errors import ConvergenceError
from counterspin.frozen import frozen
from counterspin.inference.joint.series import concerns, with_input
from counterspin.inference.joint.unknowns import RIPPLE
from counterspin.inference.least_squares import REGULARISATION
from counterspin.inference.two_stage.model import TwoStageRequest
from counterspin.physics import as_printed
from counterspin.physics.terms import SHARED_TERMS, TERMS, term
from counterspin.studies.draws import Draws, StudyTruth, curvature_noise, of_run, residual_variances
from counterspin.studies.strobed_effects import StrobedMotion, curvature_gain, effects
from counterspin.studies.work import Trials
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


DEGREE: Final = 4

#: The box: angle that drift adds in a run (rad), ripple ratio.
_DRIFT_ANGLE: Final = 0.076
_RIPPLE_RATIO: Final = 6e-4

#: The largest error that the polynomial may have, in parts of the largest value in the box.
_TOLERANCE: Final = 1e-9

#: Smallest effect held to the tolerance, in parts of the largest, both at credible sizes.
_SMALLEST_EFFECT: Final = 1e-4

#: Points of the fit for each coefficient of the polynomial, and points of the check.
_POINTS_PER_COEFFICIENT: Final = 3
_CHECK_POINTS: Final = 60


@frozen
class Box:
    """Where a surrogate holds: centre and half width of drift and ripple parts, (3,)."""

    centre: Array
    half: Array

    @property
    def varies(self) -> npt.NDArray[np.intp]:
        """Which of the three quantities vary."""
        return np.flatnonzero(self.half > 0.0)


def box_of(motion: StrobedMotion, bounds: Array) -> Box:
    """Return the box that holds what a study draws, or as much of it as a surrogate may hold.

    bounds: Least and greatest drift and ripple's cosine and sine parts, shape (3, 2).
    """
    turned = float(np.max(np.abs(motion.angles - motion.spindle.start_angle)))
    duration = turned / abs(motion.spindle.rate)
    allowed = np.array([2.0 * _DRIFT_ANGLE / (turned * duration), _RIPPLE_RATIO, _RIPPLE_RATIO])
    low, high = bounds.T
    centre = 0.5 * (low + high)
    low, high = np.clip(low, -allowed, allowed), np.clip(high, -allowed, allowed)
    varying = high > low
    centre = np.where(varying, 0.5 * (low + high), centre)
    half = np.where(varying, 0.5 * (high - low) * (1.0 + 1e-9), 0.0)
    return Box(centre, half)


@frozen
class Surrogate:
    """The effects of a run's terms as polynomials."""

    box: Box  #: Where they hold.
    #: Of the varying quantities, one row for each monomial.
    powers: tuple[tuple[int, ...], ...]
    #: Of the effects, with sigma/u(b2) as last row, shape (q + 1, monomials).
    coefficients: Array
    error: float  #: The largest error found in the check, in parts of each one's largest value.

    @classmethod
    def fit(cls, motion: StrobedMotion, symbols: Sequence[str], box: Box) -> Surrogate:
        """Make the polynomials of a run and check them."""
        places = box.varies
        powers = sorted(_powers(places.size), key=sum)
        generator = np.random.default_rng(4)
        points = _POINTS_PER_COEFFICIENT * len(powers) if places.size else 1
        # Points that crowd towards the faces, as Chebyshev's do, keep the error even.
        scaled = np.cos(math.pi * generator.random((places.size, points)))
        checked = generator.uniform(-1.0, 1.0, (places.size, _CHECK_POINTS if places.size else 1))
        corners = np.array(list(itertools.product((-1.0, 1.0), repeat=places.size))).T
        if places.size:
            checked = np.hstack([checked, corners])
        exact, check = (_exact(motion, symbols, box, points) for points in (scaled, checked))
        size = np.maximum(np.abs(exact).max(axis=1), 1e-30)[:, None]
        basis, basis_check = _monomials(scaled, powers), _monomials(checked, powers)
        coefficients = _fitted(basis, exact / size) * size
        # A term that acts very little is compared with the effect of others at credible sizes.
        limits = np.array([term(symbol).limit for symbol in symbols])[:, None]
        floor = _SMALLEST_EFFECT * np.max(size[:-1] * limits) / limits
        scale = np.vstack([np.maximum(size[:-1], floor), size[-1:]])
        error = float(np.max(np.abs(coefficients @ basis_check - check) / scale))
        if error > _TOLERANCE:
            raise ConvergenceError(
                f'the polynomial surrogate errs by {error:.1e} in its box; use `engine="exact"`'
            )
        return cls(box, tuple(powers), coefficients, error)

    def holds(self, small: Sequence[Array]) -> npt.NDArray[np.bool_]:
        """Return for which rotations (drift, cos, sin; each (n,)) the surrogate holds."""
        inside = np.ones(np.broadcast_shapes(*(part.shape for part in small)), dtype=bool)
        for value, centre, half in zip(small, self.box.centre, self.box.half, strict=True):
            slack = half if half > 0.0 else 1e-12 * abs(centre)
            inside &= np.abs(value - centre) <= slack
        return inside

    def __call__(self, small: Sequence[Array]) -> tuple[Array, Array]:
        """Return the effects, shape (q, n), and sigma/u(b2), (n,); n is 1 where nothing varies."""
        scaled = [(small[i] - self.box.centre[i]) / self.box.half[i] for i in self.box.varies]
        found = self.coefficients @ _monomials(scaled, self.powers)
        return found[:-1], found[-1]


def _powers(count: int) -> list[tuple[int, ...]]:
    ranges = itertools.product(range(DEGREE + 1), repeat=count)
    return [powers for powers in ranges if sum(powers) <= DEGREE]


def _monomials(scaled: Sequence[Array] | Array, powers: Sequence[tuple[int, ...]]) -> Array:
    """Return all monomials, shape (monomials, n), each by one product of an earlier one."""
    n = scaled[0].size if len(scaled) else 1
    basis = np.empty((len(powers), n))
    basis[0] = 1.0
    for index, lower, factor in _products(tuple(powers)):
        np.multiply(basis[lower], scaled[factor], out=basis[index])
    return basis


@lru_cache(maxsize=16)
def _products(powers: tuple[tuple[int, ...], ...]) -> tuple[tuple[int, int, int], ...]:
    """Return for each monomial beside the first its place, an earlier one's, and the factor."""
    place = {power: index for index, power in enumerate(powers)}
    products = []
    for power in sorted(powers, key=sum)[1:]:
        lead = next(i for i, p in enumerate(power) if p)
        lower = tuple(p - (i == lead) for i, p in enumerate(power))
        products.append((place[power], place[lower], lead))
    return tuple(products)


def _exact(motion: StrobedMotion, symbols: Sequence[str], box: Box, scaled: Array) -> Array:
    values = np.repeat(box.centre[:, None], scaled.shape[1], axis=1)
    values[box.varies] += box.half[box.varies, None] * scaled
    found, size = effects(motion, symbols, *values)
    return np.vstack([found, size])


def _fitted(basis: Array, values: Array) -> Array:
    return np.asarray(np.linalg.lstsq(basis.T, values.T, rcond=None)[0].T)
