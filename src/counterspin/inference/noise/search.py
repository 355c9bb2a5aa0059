"""Noise estimated from records by restricted maximum likelihood (REML).

For white noise the restricted likelihood is greatest at s^2 = rss/(n - p). Of several variances
that are all to be estimated only the ratios need a search: the best scale for given ratios has that
closed form (a short iteration where unknowns have priors).

A component is kept only if the records ask for it: twice the gain in restricted log-likelihood must
reach `KEEPING_GAIN`. At its boundary, zero, that statistic is 0 half of the time and chi-square
with one degree of freedom otherwise (Self and Liang, JASA 82 (1987) 605), so that 2.706 keeps a
component which is not there at most 5 times in 100.

Wander of the bias that is asked for is part of the noise in any case, and white noise with it: what
the records cannot tell from a walk of the velocity may still be one, and moves a run's bias too.
Its size is the mean over what the records allow.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cached_property
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.noise.bias_instability import Variances
from counterspin.inference.noise.components import BIAS_COMPONENTS, COMPONENTS
from counterspin.inference.noise.likelihood import WHITE, RecordData, RestrictedLikelihood
from counterspin.inference.noise.model import Noise
from counterspin.inference.noise.undetected_walk import (
    PRIOR_EXPONENT,
    UndetectedWalk,
    marginal_walk,
    walk_posterior,
)

#: Least gain in 2 log L that keeps a component: the upper 5 % point of its law at zero.
KEEPING_GAIN: Final = 2.705543454095404

#: Distance above the least ratio of a search, in logarithms, at which a walk begins to show.
_DETECTION_LOG_RATIO: Final = 4.0

#: Steps in which a walk's size is looked for, in logarithms of the variance: what a frequency makes
#: of the likelihood changes over as much. A misfit may be likeliest both without a walk and as one.
_SCAN_STEP: Final = 6.0

# Logarithms of variances: the largest of Newton's steps and the least, at which a search ends (a
# variance's own standard uncertainty is ten times that and more), and the steps of derivatives by
# ratios and by scale.
_LARGEST_STEP: Final = 3.0
_LAST_STEP: Final = 0.02
_LOG_RATIO_STEP: Final = 0.05
_LOG_SCALE_STEP: Final = 1e-4

#: Most of Newton's steps, and the gain in log-likelihood of the last: what is next to nothing could
#: go on towards zero.
_MAX_STEPS: Final = 20
_LAST_GAIN: Final = 1e-3

#: Least curvature that counts: in a direction of less a variance is known to a factor of e^2.
_MIN_CURVATURE: Final = 0.25

#: Sizes over which a wander is averaged, about the largest of estimate and first guess: e-folds of
#: the variance.
_LOG_VARIANCE_OFFSETS: Final = np.arange(-12.0, 9.1, 1.0)

#: A wander that begins to show is the other noise at this many times a record's lowest frequency.
_ONSET_RATIO: Final = 3.0


@frozen
class NoiseEstimate:
    """Estimated noise and its covariance."""

    noise: Noise  #: The estimate, beside what was given.
    #: Of the squares of `COMPONENTS`, (4, 4): inverse observed information; zero for a component
    #: that was given or dropped.
    covariance: Array
    estimated: tuple[str, ...]  #: Which of `COMPONENTS` were estimated and kept.
    dropped: tuple[str, ...]  #: Which were to be estimated and are not supported by the records.
    #: Restricted log-likelihood of each set of components tried.
    log_likelihoods: dict[tuple[str, ...], float]
    #: Rows less unknowns: n - p, start errors counted among the unknowns.
    degrees_of_freedom: float
    evaluations: int  #: How often all rows were whitened.
    #: Of a dropped random walk, the sizes that the records allow; else None.
    undetected_walk: UndetectedWalk | None = None


def estimate_noise(
    records: Sequence[RecordData],
    noise: Noise,
    prior_rows: ArrayLike | None = None,
    prior_values: ArrayLike | None = None,
) -> NoiseEstimate:
    """Estimate the requested components of the noise that records share.

    prior_rows, prior_values: (m, p) and (m,): prior information in rows of unit variance.
    """
    likelihood = RestrictedLikelihood.of(records, prior_rows, prior_values)
    wanted, base = noise.to_estimate, None
    if noise.has_bias_instability:
        base, _ = _select_components(likelihood, noise.without_bias_instability, None)
    best, log_likelihoods = _select_components(likelihood, noise, base)
    variances, covariance = _average_bias_noise(
        likelihood, best, _first_guess(likelihood, noise, base)
    )
    unseen = None
    if (
        "random_walk" in wanted
        and "random_walk" not in best.names
        and not noise.has_bias_instability
    ):
        unseen = _dropped_walk(likelihood, noise, best)
    return NoiseEstimate(
        noise=noise.with_variances(variances),
        covariance=covariance,
        estimated=best.names,
        dropped=tuple(name for name in wanted if name not in best.names),
        log_likelihoods=log_likelihoods,
        degrees_of_freedom=likelihood.dof(best.log_scale, best.ratios),
        evaluations=likelihood.evaluations,
        undetected_walk=unseen,
    )


def effective_dof(variance: ArrayLike, gradient: ArrayLike, covariance: ArrayLike) -> Array:
    """Return Satterthwaite's degrees of freedom, 2 (u^2)^2/Var(u^2), of each coefficient.

    variance: (p,) u^2 of each coefficient.
    gradient: (p, m) derivative of u^2 with respect to each estimated noise variance.
    covariance: (m, m) covariance of those variances.
    """
    slope = np.asarray(gradient, float)
    spread = np.einsum("pi,ij,pj->p", slope, np.asarray(covariance, float), slope)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        dof = 2 * np.square(np.asarray(variance, float)) / spread
    return np.where(spread > 0, dof, np.inf)


@frozen(eq=False)
class Maximum:
    """A maximum of the restricted likelihood."""

    names: tuple[str, ...]  #: What was varied.
    log_scale: float
    ratios: Variances
    value: float
    covariance: Array  #: Of the variances, (4, 4).

    @property
    def variances(self) -> Variances:
        """Variances at the maximum."""
        return _scale_variances(math.exp(self.log_scale), self.ratios)


def _select_components(
    likelihood: RestrictedLikelihood, noise: Noise, base: Maximum | None
) -> tuple[Maximum, dict[tuple[str, ...], float]]:
    """Return the best set of components, and the likelihoods of all sets.

    base: The best without a wander; None where nothing wanders.
    """
    wanted = noise.to_estimate
    required = [name for name in wanted if base is not None and name == "white"]
    required += [name for name in wanted if name in BIAS_COMPONENTS][:1]
    optional = [name for name in wanted if name not in required]
    candidates = [
        NoiseModelCandidate(
            likelihood, noise, tuple(n for n in COMPONENTS if n in (*required, *subset))
        )
        for size in range(len(optional), -1, -1)
        for subset in combinations(optional, size)
    ]
    maxima = [choice.maximum(base) for choice in candidates if choice.is_possible]
    if not maxima:
        raise ValueError("noise: all components are stated as zero, so the rows cannot be weighted")
    best = max(maxima, key=lambda maximum: maximum.value - KEEPING_GAIN / 2 * len(maximum.names))
    return best, {maximum.names: maximum.value for maximum in maxima}


@frozen(eq=False)
class NoiseModelCandidate:
    """The restricted likelihood of some variances; the other requested variances are zero."""

    likelihood: RestrictedLikelihood
    noise: Noise
    names: tuple[str, ...]

    @property
    def is_possible(self) -> bool:
        """True if every record has noise."""
        added = all(np.all(part) for part in self.likelihood.added_variances)
        return added or bool(self.names) or any(self.noise.known.variances)

    @cached_property
    def has_free_scale(self) -> bool:
        """True if all variances are unknown: the first is the scale of the others."""
        known = dict(zip(COMPONENTS, self.noise.known.variances, strict=True))
        rest = [size for name, size in known.items() if name not in self.names]
        return bool(self.names) and not any(rest) and not _mean_added_variance(self.likelihood)

    def scale_and_ratios(self, x: Array) -> tuple[float, Variances]:
        """Return log scale and ratios for the logarithms x of the search."""
        sizes = list(self.noise.known.variances)
        least = sizes[0]
        logs = [0.0, *x] if self.has_free_scale else x
        for name, size in zip(self.names, np.exp(logs).tolist(), strict=True):
            sizes[COMPONENTS.index(name)] = size
        if not self.has_free_scale:
            return _normalise(self.likelihood, (max(sizes[0], least), *sizes[1:]))
        ratios = tuple(sizes)
        scale = self.likelihood.best_scale(ratios)
        return max(scale, math.log(least)) if least > 0.0 else scale, ratios

    def value(self, x: Array) -> float:
        """Return the likelihood at the logarithms x."""
        return self.likelihood.value(*self.scale_and_ratios(x))

    def maximize(self, start: Variances) -> tuple[float, Variances]:
        """Return the maximum of the likelihood from a start, and the variances at the maximum."""
        x = self._ascend(self._logs(start))
        log_scale, ratios = self.scale_and_ratios(x)
        return self.likelihood.value(log_scale, ratios), _scale_variances(
            math.exp(log_scale), ratios
        )

    def maximum(self, base: Maximum | None, start: Variances | None = None) -> Maximum:
        """Return the maximum of the likelihood.

        start: Start of the search, if it is known.
        """
        x = self._ascend(self._initial_logs(base) if start is None else self._logs(start))
        covariance = self._covariance(x)
        if x.size:
            x = _refine(self.value, x)
        log_scale, ratios = self.scale_and_ratios(x)
        value = self.likelihood.value(log_scale, ratios)
        return Maximum(self.names, log_scale, ratios, value, covariance)

    def _initial_logs(self, base: Maximum | None) -> Array:
        """Return the start of the search; without a base, from a scan of the random walk."""
        first = _first_guess(self.likelihood, self.noise, base)
        guess = self._logs(first)
        if "random_walk" not in self.names or base is not None or not guess.size:
            return guess
        # From what cannot show, at which none is as likely, to what hides all white noise.
        steps = np.arange(-_SCAN_STEP, self.likelihood.walk_range, _SCAN_STEP)
        points = [(first[0], size, *first[2:]) for size in (first[1] * np.exp(steps)).tolist()]
        if "white" not in self.names:
            return max(map(self._logs, points), key=self.value)
        # Each with the scale that is best for it, all white noise being of one kind.
        likelihood, added = (
            self.likelihood.without_added_variance(),
            _mean_added_variance(self.likelihood),
        )
        scanned = []
        for white, walk, *rest in points:
            ratios = (1.0, walk / (white + added), *WHITE[2:])
            scale = likelihood.best_scale(ratios)
            total = math.exp(scale)
            point = (max(total - added, 0.1 * total), total * ratios[1], *rest)
            scanned.append((likelihood.value(scale, ratios), point))
        return self._logs(max(scanned)[1])

    def _logs(self, sizes: Variances) -> Array:
        """Return the logarithms of the search for given variances."""
        x = np.log([sizes[COMPONENTS.index(name)] for name in self.names])
        return x[1:] - x[0] if self.has_free_scale else x

    def _ascend(self, x: Array) -> Array:
        """Return the end point of Newton's method."""
        for _ in range(_MAX_STEPS if x.size else 0):
            before, (x, gain) = x, _newton_step(self.value, x)
            if np.abs(x - before).max() < _LAST_STEP or gain < _LAST_GAIN:
                break
        return x

    def _covariance(self, x: Array) -> Array:
        """Return the covariance of the variances, (4, 4): the inverse observed information."""
        log_scale, variance_ratios = self.scale_and_ratios(x)
        covariance = np.zeros((len(COMPONENTS), len(COMPONENTS)))
        if not self.names:
            return covariance
        if self.has_free_scale:
            hessian = np.zeros((len(self.names), len(self.names)))
            slope_above, slope_below = (
                self.likelihood.slope(log_scale + d, variance_ratios)
                for d in (_LOG_SCALE_STEP, -_LOG_SCALE_STEP)
            )
            hessian[0, 0] = (slope_above - slope_below) / (2.0 * _LOG_SCALE_STEP)
            hessian[0, 1:] = hessian[1:, 0] = self._partial_derivatives(
                self.likelihood.slope, log_scale, x
            )[1]
            hessian[1:, 1:] = self._partial_derivatives(self.likelihood.value, log_scale, x)[2]
            # From the first and the ratios to it to all of them.
            ratios = np.eye(len(self.names))
            ratios[1:, 0] = -1.0
            hessian = ratios.T @ hessian @ ratios
        else:
            hessian = _derivatives(self.value, x)[2]
        values, vectors = np.linalg.eigh(-hessian)
        inverse = vectors / np.maximum(values, _MIN_CURVATURE) @ vectors.T
        places = [COMPONENTS.index(name) for name in self.names]
        levels = np.array(_scale_variances(math.exp(log_scale), variance_ratios))[places]
        covariance[np.ix_(places, places)] = inverse * np.outer(levels, levels)
        return covariance

    def _partial_derivatives(
        self, function: Callable[[float, Variances], float], log_scale: float, x: Array
    ) -> tuple[float, Array, Array]:
        """Return the derivatives of a function of scale and ratios at a fixed scale."""
        return _derivatives(lambda near: function(log_scale, self.scale_and_ratios(near)[1]), x)


def _mean_added_variance(likelihood: RestrictedLikelihood) -> float:
    """Return the mean of the known additional variances of the records."""
    return float(np.mean([np.mean(added) for added in likelihood.added_variances]))


def _scale_variances(factor: float, variances: Variances) -> Variances:
    return tuple(factor * size for size in variances)


def _normalise(likelihood: RestrictedLikelihood, variances: Variances) -> tuple[float, Variances]:
    """Return the log scale and the ratios of variances."""
    if _mean_added_variance(likelihood):
        return 0.0, variances
    scale = variances[0] or variances[1]
    if scale <= 0.0:
        raise ValueError("noise: a drifting bias also requires white noise; state the white noise")
    return math.log(scale), _scale_variances(1.0 / scale, variances)


def _first_guess(likelihood: RestrictedLikelihood, noise: Noise, base: Maximum | None) -> Variances:
    """Return start variances: slow noise at the level at which it begins to show."""
    added, (white, walk, *_) = _mean_added_variance(likelihood), noise.known.variances
    if base is not None:
        white, walk, *_ = base.variances
    elif "white" in noise.to_estimate:
        total = math.exp(likelihood.best_scale(WHITE))
        white = max(total - added, 0.1 * total)
    if base is None and "random_walk" in noise.to_estimate:
        walk = (white + added) * math.exp(likelihood.log_walk_floor + _DETECTION_LOG_RATIO)
    order, spacing = likelihood.order, likelihood.records[0].spacing
    w = 2.0 * math.pi * _ONSET_RATIO / likelihood.length
    density = max(white + added, 1e-30) * spacing * w ** (2 * order) + walk
    bias = (density * component.inverse_density(w) for component in BIAS_COMPONENTS.values())
    return white, walk or 0.1 * density, *bias


def _average_bias_noise(
    likelihood: RestrictedLikelihood, best: Maximum, first: Variances
) -> tuple[Variances, Array]:
    """Return variances, with the posterior means of the bias components, and their covariance.

    A wander moves the runs' biases against each other, and few runs tell little of that: the
    most likely size is often none. It is averaged as a walk is that does not show
    (`counterspin.inference.noise.undetected_walk`): Student's distribution of this variance and
    of the degrees of freedom that its own variance says (Satterthwaite) has the quantiles of
    the mixture.
    """
    variances, covariance = list(best.variances), best.covariance.copy()
    for name in best.names:
        if name not in BIAS_COMPONENTS:
            continue
        place = COMPONENTS.index(name)
        middle = max(variances[place], first[place])
        sizes = middle * np.exp(_LOG_VARIANCE_OFFSETS)
        values = []
        for size in sizes.tolist():
            variances[place] = size
            values.append(likelihood.value(*_normalise(likelihood, tuple(variances))))
        # The sizes are even in the logarithm, and so is the density.
        weights = np.exp(np.array(values) - max(values)) * (sizes / middle) ** PRIOR_EXPONENT
        allowed = UndetectedWalk(sizes, weights / weights.sum())
        negligible = np.array([1e-9 * middle * math.exp(_LOG_VARIANCE_OFFSETS[0])])
        variances[place], inverse = marginal_walk(allowed, negligible, np.ones(1))
        covariance[place], covariance[:, place] = 0.0, 0.0
        covariance[place, place] = 2.0 * variances[place] ** 2 * float(inverse[0])
    return tuple(variances), covariance


def _dropped_walk(likelihood: RestrictedLikelihood, noise: Noise, best: Maximum) -> UndetectedWalk:
    """Return the posterior of a dropped random walk, with the best white noise for each size."""
    candidate = NoiseModelCandidate(likelihood, noise, (*best.names, "random_walk"))
    white = best.variances[0]

    def profile(log_ratio: float) -> tuple[float, float]:
        if candidate.has_free_scale:
            log_scale, ratios = candidate.scale_and_ratios(np.array([log_ratio]))
            return likelihood.value(log_scale, ratios), log_scale + log_ratio
        log_level = math.log(white + _mean_added_variance(likelihood)) + log_ratio
        log_white = [math.log(white)] if best.names else []
        return candidate.value(np.array([*log_white, log_level])), log_level

    return walk_posterior(profile, likelihood.log_walk_floor + _DETECTION_LOG_RATIO, best.value)


def _newton_step(function: Callable[[Array], float], x: Array) -> tuple[Array, float]:
    """Return x after a step of Newton's method, and the gain expected from the derivatives.

    Curvatures are taken as they are, however small: near zero a variance's effect goes with e^x,
    whose slope and curvature are the same, so that a step takes it down by a factor of e.
    """
    middle, gradient, hessian = _derivatives(function, x)
    curvatures, vectors = np.linalg.eigh(-hessian)
    slopes = vectors.T @ gradient
    is_concave = curvatures * _LARGEST_STEP > np.abs(slopes)
    steps = np.sign(slopes) * _LARGEST_STEP
    steps[is_concave] = slopes[is_concave] / curvatures[is_concave]
    step, gain = vectors @ steps, float(slopes @ steps) / 2.0
    while np.abs(step).max() >= _LAST_STEP and function(x + step) < middle:
        step = step / 4.0
    return np.asarray(x + step), gain


def _refine(function: Callable[[Array], float], x: Array) -> Array:
    """Return x after a last step, with slopes from two neighbours on either side."""
    _, inner_gradient, hessian = _derivatives(function, x)
    outer_values = [
        function(x + sign * offset)
        for sign in (2.0, -2.0)
        for offset in _LOG_RATIO_STEP * np.eye(x.size)
    ]
    outer_gradient = (np.array(outer_values[: x.size]) - np.array(outer_values[x.size :])) / (
        4.0 * _LOG_RATIO_STEP
    )
    if np.linalg.eigvalsh(-hessian)[0] < _MIN_CURVATURE:
        return x
    step = np.linalg.solve(-hessian, (4.0 * inner_gradient - outer_gradient) / 3.0)
    return np.asarray(x + step) if np.abs(step).max() < _LAST_STEP else x


def _derivatives(function: Callable[[Array], float], x: Array) -> tuple[float, Array, Array]:
    """Return a function's value, gradient and second derivatives, by central differences."""
    middle, offsets = function(x), _LOG_RATIO_STEP * np.eye(x.size)
    upper, lower = (
        np.array([function(x + sign * offset) for offset in offsets]) for sign in (1.0, -1.0)
    )
    hessian = np.diag(upper + lower - 2.0 * middle)
    for i, j in combinations(range(x.size), 2):
        cross_sum = (
            function(x + offsets[i] + offsets[j])
            + function(x - offsets[i] - offsets[j])
            - 2.0 * middle
        )
        hessian[i, j] = hessian[j, i] = (cross_sum - hessian[i, i] - hessian[j, j]) / 2.0
    return middle, (upper - lower) / (2.0 * _LOG_RATIO_STEP), hessian / _LOG_RATIO_STEP**2
