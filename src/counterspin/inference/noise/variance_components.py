"""Noise components estimated from the records by restricted maximum likelihood (REML).

For white noise the restricted likelihood is greatest at s^2 = rss/(n - p). With white noise and a
random walk only their ratio N^2/(white variance) needs a search: the best level for a ratio has
that closed form (a short iteration where unknowns have priors).

A component is kept only if the records ask for it: twice the gain in restricted log-likelihood must
reach `KEEPING_GAIN`. At its boundary, zero, that statistic is 0 half of the time and chi-square
with one degree of freedom otherwise (Self and Liang, JASA 82 (1987) 605), so that 2.706 keeps a
component which is not there at most 5 times in 100.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.noise.model import NoiseModel
from counterspin.inference.noise.restricted_likelihood import RecordData, RestrictedLikelihood
from counterspin.inference.noise.unseen_noise import Unseen, unseen_walk

__all__ = [
    "COMPONENTS",
    "KEEPING_GAIN",
    "RecordData",
    "VarianceComponents",
    "effective_dof",
    "effective_dof_of",
    "estimate",
]


#: Least gain in 2 log L that keeps a component: the upper 5 % point of its law at zero.
KEEPING_GAIN: Final = 2.705543454095404

#: Distance above the least ratio of a search, in logarithms, at which a walk begins to show.
_DETECTION_LOG_RATIO: Final = 4.0

_WHITE: Final = "white"
_WALK: Final = "random_walk"

#: Relative step of a noise variance: central differences of logarithms err by its square.
_STEP: Final = 1e-2

#: What noise may consist of, in the order of `VarianceComponents.covariance`.
COMPONENTS: Final = (_WHITE, _WALK, "flicker", "bias_walk")


@frozen
class VarianceComponents:
    """Estimated noise, and how well it is known."""

    #: As in `NoiseModel`; quantisation is always as given.
    white: float
    random_walk: float
    quantisation: float
    #: (2, 2) of (white^2, random_walk^2), or (4, 4) of the squares of `COMPONENTS` where the bias
    #: wanders: inverse observed information; zero for a component that was given or dropped.
    covariance: Array
    estimated: tuple[str, ...]  #: Which of `COMPONENTS` were estimated and kept.
    dropped: tuple[str, ...]  #: Which were to be estimated and are not supported by the records.
    #: Restricted log-likelihood of each set of components tried.
    log_likelihoods: dict[tuple[str, ...], float]
    #: Rows less unknowns: n - p, start errors counted among the unknowns.
    degrees_of_freedom: float
    evaluations: int  #: How often all rows were whitened.
    #: False where the search ended at the limit of what the records' sampling can show.
    converged: bool
    #: Of a dropped random walk, the sizes that the records allow; else None.
    unseen: Unseen | None = None
    #: As in `NoiseModel`.
    flicker: float = 0.0
    bias_walk: float = 0.0

    @property
    def noise(self) -> NoiseModel:
        """The estimate as a noise model."""
        return NoiseModel(
            self.white, self.random_walk, self.quantisation, self.flicker, self.bias_walk
        )


def estimate(
    records: Sequence[RecordData],
    *,
    white: float | None = None,
    random_walk: float | None = None,
    quantisation: float = 0.0,
    prior_rows: ArrayLike | None = None,
    prior_values: ArrayLike | None = None,
) -> VarianceComponents:
    """Estimate the noise that records share.

    white, random_walk: Known components; None asks for an estimate.
    prior_rows, prior_values: (m, p) and (m,): what is known of the unknowns, in rows of unit
        variance.
    """
    likelihood = RestrictedLikelihood.of(records, prior_rows, prior_values)
    floor = quantisation**2 / 12
    wanted = tuple(name for name, given in ((_WHITE, white), (_WALK, random_walk)) if given is None)
    maxima: dict[tuple[str, ...], _Maximum] = {}
    for chosen in _subsets(wanted):
        rules = _Rules(
            floor=floor,
            white=None if _WHITE in chosen else floor + (white or 0.0) ** 2,
            walk=None if _WALK in chosen else (random_walk or 0.0) ** 2,
        )
        if rules.possible:
            maxima[chosen] = _maximise(likelihood, rules)
    if not maxima:
        raise ValueError("noise: all components are given as zero, so rows cannot be weighted")

    kept = max(maxima, key=lambda names: maxima[names].value - KEEPING_GAIN / 2 * len(names))
    best = maxima[kept]
    unseen = None
    if _WALK in wanted and _WALK not in kept and best.rules.walk == 0:
        unseen = _unseen(likelihood, maxima[kept], maxima[(*kept, _WALK)].rules)
    return VarianceComponents(
        white=math.sqrt(max(best.white - floor, 0.0)) if white is None else white,
        random_walk=math.sqrt(best.walk) if random_walk is None else random_walk,
        quantisation=quantisation,
        covariance=_covariance(likelihood, best),
        estimated=kept,
        dropped=tuple(name for name in wanted if name not in kept),
        log_likelihoods={names: maximum.value for names, maximum in maxima.items()},
        degrees_of_freedom=likelihood.freedom(best.log_scale, best.ratio),
        evaluations=likelihood.evaluations,
        converged=best.converged,
        unseen=unseen,
    )


def _unseen(likelihood: RestrictedLikelihood, best: _Maximum, rules: _Rules) -> Unseen:
    """Return the sizes of the walk that was dropped, the white noise as it would be beside it."""

    def at(log_ratio: float) -> tuple[float, float]:
        ratio = math.exp(log_ratio)
        log_scale = rules.log_scale(likelihood, ratio)
        return likelihood.value(log_scale, ratio), log_scale + log_ratio

    return unseen_walk(at, float(likelihood.log_ratios[0]) + _DETECTION_LOG_RATIO, best.value)


def effective_dof(variance: ArrayLike, gradient: ArrayLike, covariance: ArrayLike) -> Array:
    """Satterthwaite's degrees of freedom, 2 (u^2)^2/Var(u^2), of each coefficient.

    variance: (p,) u^2 of each coefficient.
    gradient: (p, m) derivative of u^2 with respect to each estimated noise variance.
    covariance: (m, m) covariance of those variances.
    """
    slope = np.asarray(gradient, float)
    spread = np.einsum("pi,ij,pj->p", slope, np.asarray(covariance, float), slope)
    with np.errstate(divide="ignore", invalid="ignore"):
        dof = 2 * np.square(np.asarray(variance, float)) / spread
    return np.where(spread > 0, dof, np.inf)


def effective_dof_of(
    coefficient_variances: Callable[[NoiseModel], ArrayLike],
    components: VarianceComponents,
) -> Array:
    """Satterthwaite's degrees of freedom, from the coefficients' variances at other noise levels.

    coefficient_variances: Noise -> (p,) u^2 of each coefficient when the records have that noise;
        called once at the estimate and twice for each estimated component.
    """
    noise = components.noise
    variance = np.asarray(coefficient_variances(noise), float)
    gradient = np.zeros((len(variance), len(components.covariance)))
    for k, name in enumerate(COMPONENTS[: len(components.covariance)]):
        if name not in components.estimated:
            continue
        level = getattr(noise, name)
        up, down = (
            np.asarray(
                coefficient_variances(replace(noise, **{name: level * math.exp(sign * _STEP / 2)})),
                float,
            )
            for sign in (1, -1)
        )
        slope = np.zeros_like(variance)
        known = (up > 0) & (down > 0)
        slope[known] = np.log(up[known] / down[known]) / (2 * _STEP)
        gradient[:, k] = slope * variance / level**2
    return effective_dof(variance, gradient, components.covariance)


@frozen
class _Rules:
    """What a search may vary: variances that are None. White ones include quantisation."""

    floor: float
    white: float | None
    walk: float | None

    @property
    def possible(self) -> bool:
        return self.white is None or self.walk is None or self.white + self.walk > 0

    @property
    def ratio(self) -> float | None:
        """The ratio walk/white where the rules leave no choice."""
        if self.white == 0:
            return math.inf
        if self.walk == 0:
            return 0.0
        return None if self.white is None or self.walk is None else self.walk / self.white

    def log_scale(self, likelihood: RestrictedLikelihood, ratio: float) -> float:
        """Log of the white variance (of the walk's, at an infinite ratio) for this ratio."""
        if math.isinf(ratio):
            return likelihood.best_scale(ratio) if self.walk is None else math.log(self.walk)
        if self.white is not None:
            return math.log(self.white)
        if self.walk:
            return max(math.log(self.walk / ratio), self._log_floor)
        return max(likelihood.best_scale(ratio), self._log_floor)

    @property
    def _log_floor(self) -> float:
        return math.log(self.floor) if self.floor > 0 else -math.inf

    @property
    def directions(self) -> Array:
        """Columns: how (log scale, log ratio) move with each free log variance."""
        white_only = [[1.0], [-1.0 if self.walk else 0.0]]
        walk_only = [[1.0], [0.0]] if self.white == 0 else [[0.0], [1.0]]
        if self.white is None:
            return np.array([[1.0, 0.0], [-1.0, 1.0]] if self.walk is None else white_only)
        return np.array(walk_only) if self.walk is None else np.zeros((2, 0))


@frozen
class _Maximum:
    """A maximum of the restricted likelihood under its rules."""

    rules: _Rules
    ratio: float
    log_scale: float
    value: float
    converged: bool

    @property
    def white(self) -> float:
        return 0.0 if math.isinf(self.ratio) else math.exp(self.log_scale)

    @property
    def walk(self) -> float:
        scale = math.exp(self.log_scale)
        return scale if math.isinf(self.ratio) else scale * self.ratio


def _maximise(likelihood: RestrictedLikelihood, rules: _Rules) -> _Maximum:
    """Search the ratio, each time at its best scale: a coarse grid, then Brent's method."""

    def at(log_ratio: float) -> float:
        ratio = math.exp(log_ratio)
        return likelihood.value(rules.log_scale(likelihood, ratio), ratio)

    ratio, converged = rules.ratio, True
    if ratio is None:
        from scipy.optimize import minimize_scalar

        grid = likelihood.log_ratios
        peak = int(np.argmax([at(point) for point in grid]))
        converged = 0 < peak < len(grid) - 1
        search = minimize_scalar(
            lambda point: -at(point),
            bounds=(grid[max(peak - 1, 0)], grid[min(peak + 1, len(grid) - 1)]),
            method="bounded",
            options={"xatol": 3e-3},
        )
        ratio, converged = math.exp(search.x), converged and bool(search.success)
    log_scale = rules.log_scale(likelihood, ratio)
    return _Maximum(rules, ratio, log_scale, likelihood.value(log_scale, ratio), converged)


def _covariance(likelihood: RestrictedLikelihood, best: _Maximum) -> Array:
    """(2, 2) covariance of (white^2, N^2): the inverse observed information."""
    directions = best.rules.directions
    a, ratio = best.log_scale, best.ratio
    small, step = 1e-4, 0.1
    hessian = np.zeros((2, 2))
    hessian[0, 0] = (likelihood.slope(a + small, ratio) - likelihood.slope(a - small, ratio)) / (
        2 * small
    )
    if directions[1].any():
        up, down = ratio * math.exp(step), ratio * math.exp(-step)
        hessian[0, 1] = hessian[1, 0] = (likelihood.slope(a, up) - likelihood.slope(a, down)) / (
            2 * step
        )
        hessian[1, 1] = (
            likelihood.value(a, up) - 2 * likelihood.value(a, ratio) + likelihood.value(a, down)
        ) / step**2
    free = np.linalg.inv(-directions.T @ hessian @ directions)
    levels = [
        level
        for level, given in ((best.white, best.rules.white), (best.walk, best.rules.walk))
        if given is None
    ]
    where = [k for k, given in enumerate((best.rules.white, best.rules.walk)) if given is None]
    covariance = np.zeros((2, 2))
    covariance[np.ix_(where, where)] = free * np.outer(levels, levels)
    return covariance


def _subsets(names: tuple[str, ...]) -> list[tuple[str, ...]]:
    """Every selection, the fullest first."""
    return [chosen for size in range(len(names), -1, -1) for chosen in combinations(names, size)]
