"""Estimation of noise from records by restricted maximum likelihood (REML).

For white noise, the restricted likelihood has its maximum at s^2 = rss/(n - p). If several
variances are estimated, only their ratios require a search: the best scale for given ratios has
this closed form (a short iteration if unknowns have priors).

A component is kept if twice its gain in restricted log-likelihood reaches `MIN_LIKELIHOOD_GAIN`. At
the boundary zero, this statistic is 0 in half of the cases and chi-square with one degree of
freedom otherwise (Self and Liang, JASA 82 (1987) 605), so that 2.706 keeps an absent component in
at most 5 of 100 cases.

Requested bias noise is always part of the noise, together with white noise, because the records can
hardly separate it from a walk of the velocity, and it also shifts the bias of a run. Its variance
is the mean of its posterior.
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

#: Smallest gain in 2 log L that keeps a component: the upper 5 % point of its null distribution.
MIN_LIKELIHOOD_GAIN: Final = 2.705543454095404

#: Logarithmic distance above the smallest ratio at which a walk becomes detectable.
_DETECTION_LOG_RATIO: Final = 4.0

#: Step of a scan of the walk's log variance. With a misfit, the likelihood may have a maximum both
#: without a walk and with a walk.
_SCAN_STEP: Final = 6.0

# In logarithms of variances: largest step of Newton's method, tolerance of a step (a tenth of the
# standard uncertainty or less), and steps of derivatives by ratios and by scale.
_MAX_NEWTON_STEP: Final = 3.0
_STEP_TOLERANCE: Final = 0.02
_LOG_RATIO_STEP: Final = 0.05
_LOG_SCALE_STEP: Final = 1e-4

#: Largest number of steps of Newton's method, and smallest gain in log-likelihood of a step.
_MAX_NEWTON_STEPS: Final = 20
_GAIN_TOLERANCE: Final = 1e-3

#: Smallest curvature: with less, a variance is known to a factor of e^2.
_MIN_CURVATURE: Final = 0.25

#: Grid of the log variance of bias noise, relative to the larger of estimate and initial value.
_LOG_VARIANCE_OFFSETS: Final = np.arange(-12.0, 9.1, 1.0)

#: Initial bias noise equals the other noise at this multiple of the lowest frequency of a record.
_ONSET_RATIO: Final = 3.0


@frozen
class NoiseEstimate:
    """Estimated noise and its covariance."""

    noise: Noise  #: Noise with estimated and given components.
    #: Covariance of the variances of `COMPONENTS`, (4, 4): inverse observed information; zero for
    #: given or dropped components.
    covariance: Array
    estimated: tuple[str, ...]  #: Components that were estimated and kept.
    dropped: tuple[str, ...]  #: Requested components that the records do not support.
    #: Set of components -> restricted log-likelihood.
    log_likelihoods: dict[tuple[str, ...], float]
    #: n - p: number of rows minus number of unknowns, including start errors.
    degrees_of_freedom: float
    evaluations: int  #: Number of times that all rows were whitened.
    #: Posterior of a dropped random walk; else None.
    undetected_walk: UndetectedWalk | None = None


def estimate_noise(
    records: Sequence[RecordData],
    noise: Noise,
    prior_rows: ArrayLike | None = None,
    prior_values: ArrayLike | None = None,
) -> NoiseEstimate:
    """Estimate the requested components of the common noise of records.

    prior_rows, prior_values: Prior information in rows of unit variance, (m, p) and (m,).
    """
    likelihood = RestrictedLikelihood.from_records(records, prior_rows, prior_values)
    requested, white_maximum = noise.to_estimate, None
    if noise.has_bias_instability:
        white_maximum, _ = _select_components(likelihood, noise.without_bias_instability, None)
    best_maximum, log_likelihoods = _select_components(likelihood, noise, white_maximum)
    variances, covariance = _average_bias_noise(
        likelihood, best_maximum, _initial_variances(likelihood, noise, white_maximum)
    )
    walk = None
    if (
        "random_walk" in requested
        and "random_walk" not in best_maximum.names
        and not noise.has_bias_instability
    ):
        walk = _walk_posterior(likelihood, noise, best_maximum)
    return NoiseEstimate(
        noise=noise.with_variances(variances),
        covariance=covariance,
        estimated=best_maximum.names,
        dropped=tuple(name for name in requested if name not in best_maximum.names),
        log_likelihoods=log_likelihoods,
        degrees_of_freedom=likelihood.dof(best_maximum.log_scale, best_maximum.ratios),
        evaluations=likelihood.evaluations,
        undetected_walk=walk,
    )


def effective_dof(variance: ArrayLike, gradient: ArrayLike, covariance: ArrayLike) -> Array:
    """Return Satterthwaite's degrees of freedom, 2 (u^2)^2/Var(u^2), of each coefficient.

    variance: (p,) u^2 of each coefficient.
    gradient: (p, m) derivative of u^2 with respect to each estimated noise variance.
    covariance: (m, m) covariance of those variances.
    """
    gradients = np.asarray(gradient, float)
    variance_of_variance = np.einsum(
        "pi,ij,pj->p", gradients, np.asarray(covariance, float), gradients
    )
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        dof = 2 * np.square(np.asarray(variance, float)) / variance_of_variance
    return np.where(variance_of_variance > 0, dof, np.inf)


@frozen(eq=False)
class Maximum:
    """A maximum of the restricted likelihood."""

    names: tuple[str, ...]  #: Components that were varied.
    log_scale: float
    ratios: Variances
    value: float
    covariance: Array  #: Covariance of the variances, (4, 4).

    @property
    def variances(self) -> Variances:
        """Variances at the maximum."""
        return _scale_variances(math.exp(self.log_scale), self.ratios)


def _select_components(
    likelihood: RestrictedLikelihood, noise: Noise, white_maximum: Maximum | None
) -> tuple[Maximum, dict[tuple[str, ...], float]]:
    """Return the best set of components, and the likelihoods of all sets.

    white_maximum: Maximum without bias noise; None if the noise contains no bias noise.
    """
    requested = noise.to_estimate
    required_names = [name for name in requested if white_maximum is not None and name == "white"]
    required_names += [name for name in requested if name in BIAS_COMPONENTS][:1]
    optional = [name for name in requested if name not in required_names]
    candidates = [
        NoiseModelCandidate(
            likelihood, noise, tuple(n for n in COMPONENTS if n in (*required_names, *subset))
        )
        for n_components in range(len(optional), -1, -1)
        for subset in combinations(optional, n_components)
    ]
    maxima = [candidate.maximum(white_maximum) for candidate in candidates if candidate.is_possible]
    if not maxima:
        raise ValueError("noise: all components are stated as zero, so the rows cannot be weighted")
    best_maximum = max(
        maxima, key=lambda maximum: maximum.value - MIN_LIKELIHOOD_GAIN / 2 * len(maximum.names)
    )
    return best_maximum, {maximum.names: maximum.value for maximum in maxima}


@frozen(eq=False)
class NoiseModelCandidate:
    """Restricted likelihood of some variances; the other requested variances are zero."""

    likelihood: RestrictedLikelihood
    noise: Noise
    names: tuple[str, ...]

    @property
    def is_possible(self) -> bool:
        """True if every record has noise."""
        has_added_variance = all(np.all(variance) for variance in self.likelihood.added_variances)
        return has_added_variance or bool(self.names) or any(self.noise.known.variances)

    @cached_property
    def has_free_scale(self) -> bool:
        """True if all variances are unknown, so that the first is the scale of the others."""
        known_variances = dict(zip(COMPONENTS, self.noise.known.variances, strict=True))
        fixed_variances = [size for name, size in known_variances.items() if name not in self.names]
        return (
            bool(self.names)
            and not any(fixed_variances)
            and not _mean_added_variance(self.likelihood)
        )

    def scale_and_ratios(self, x: Array) -> tuple[float, Variances]:
        """Return log scale and ratios for the logarithms x of the search."""
        variances = list(self.noise.known.variances)
        min_white = variances[0]
        logs = [0.0, *x] if self.has_free_scale else x
        for name, variance in zip(self.names, np.exp(logs).tolist(), strict=True):
            variances[COMPONENTS.index(name)] = variance
        if not self.has_free_scale:
            return _normalise(self.likelihood, (max(variances[0], min_white), *variances[1:]))
        ratios = tuple(variances)
        scale = self.likelihood.best_scale(ratios)
        return max(scale, math.log(min_white)) if min_white > 0.0 else scale, ratios

    def value(self, x: Array) -> float:
        """Return the likelihood at the logarithms x."""
        return self.likelihood.value(*self.scale_and_ratios(x))

    def maximize(self, start: Variances) -> tuple[float, Variances]:
        """Return the maximum of the likelihood from a start, and the variances at the maximum."""
        x = self._ascend(self._logs(start))
        log_scale, ratios = self.scale_and_ratios(x)
        variances = _scale_variances(math.exp(log_scale), ratios)
        return self.likelihood.value(log_scale, ratios), variances

    def maximum(self, white_maximum: Maximum | None, start: Variances | None = None) -> Maximum:
        """Return the maximum of the likelihood.

        start: Start of the search; None: initial values are computed.
        """
        x = self._ascend(self._initial_logs(white_maximum) if start is None else self._logs(start))
        covariance = self._covariance(x)
        if x.size:
            x = _refine(self.value, x)
        log_scale, ratios = self.scale_and_ratios(x)
        value = self.likelihood.value(log_scale, ratios)
        return Maximum(self.names, log_scale, ratios, value, covariance)

    def _initial_logs(self, white_maximum: Maximum | None) -> Array:
        """Return the start of the search; without a base, from a scan of the random walk."""
        initial_variances = _initial_variances(self.likelihood, self.noise, white_maximum)
        initial_log_variances = self._logs(initial_variances)
        if (
            "random_walk" not in self.names
            or white_maximum is not None
            or not initial_log_variances.size
        ):
            return initial_log_variances
        # From undetectable walks to walks that hide all white noise.
        log_steps = np.arange(-_SCAN_STEP, self.likelihood.walk_range, _SCAN_STEP)
        points = [
            (initial_variances[0], size, *initial_variances[2:])
            for size in (initial_variances[1] * np.exp(log_steps)).tolist()
        ]
        if "white" not in self.names:
            return max(map(self._logs, points), key=self.value)
        # With the best scale for each walk, and all white noise combined.
        likelihood, added_variance = (
            self.likelihood.without_added_variance(),
            _mean_added_variance(self.likelihood),
        )
        likelihoods_and_points = []
        for white, walk, *bias_variances in points:
            ratios = (1.0, walk / (white + added_variance), *WHITE[2:])
            scale = likelihood.best_scale(ratios)
            total_variance = math.exp(scale)
            point = (
                max(total_variance - added_variance, 0.1 * total_variance),
                total_variance * ratios[1],
                *bias_variances,
            )
            likelihoods_and_points.append((likelihood.value(scale, ratios), point))
        return self._logs(max(likelihoods_and_points)[1])

    def _logs(self, variances: Variances) -> Array:
        """Return the logarithms of the search for given variances."""
        x = np.log([variances[COMPONENTS.index(name)] for name in self.names])
        return x[1:] - x[0] if self.has_free_scale else x

    def _ascend(self, x: Array) -> Array:
        """Return the end point of Newton's method."""
        for _ in range(_MAX_NEWTON_STEPS if x.size else 0):
            previous, (x, gain) = x, _newton_step(self.value, x)
            if np.abs(x - previous).max() < _STEP_TOLERANCE or gain < _GAIN_TOLERANCE:
                break
        return x

    def _covariance(self, x: Array) -> Array:
        """Return the covariance of the variances, (4, 4): the inverse observed information."""
        log_scale, ratios = self.scale_and_ratios(x)
        covariance = np.zeros((len(COMPONENTS), len(COMPONENTS)))
        if not self.names:
            return covariance
        if self.has_free_scale:
            hessian = np.zeros((len(self.names), len(self.names)))
            slope_above, slope_below = (
                self.likelihood.slope(log_scale + d, ratios)
                for d in (_LOG_SCALE_STEP, -_LOG_SCALE_STEP)
            )
            hessian[0, 0] = (slope_above - slope_below) / (2.0 * _LOG_SCALE_STEP)
            hessian[0, 1:] = hessian[1:, 0] = self._partial_derivatives(
                self.likelihood.slope, log_scale, x
            )[1]
            hessian[1:, 1:] = self._partial_derivatives(self.likelihood.value, log_scale, x)[2]
            # Transform from scale and ratios to the variances.
            transform = np.eye(len(self.names))
            transform[1:, 0] = -1.0
            hessian = transform.T @ hessian @ transform
        else:
            hessian = _derivatives(self.value, x)[2]
        values, vectors = np.linalg.eigh(-hessian)
        inverse = vectors / np.maximum(values, _MIN_CURVATURE) @ vectors.T
        indices = [COMPONENTS.index(name) for name in self.names]
        variances = np.array(_scale_variances(math.exp(log_scale), ratios))[indices]
        covariance[np.ix_(indices, indices)] = inverse * np.outer(variances, variances)
        return covariance

    def _partial_derivatives(
        self, function: Callable[[float, Variances], float], log_scale: float, x: Array
    ) -> tuple[float, Array, Array]:
        """Return the derivatives of a function of scale and ratios at a fixed scale."""
        return _derivatives(lambda point: function(log_scale, self.scale_and_ratios(point)[1]), x)


def _mean_added_variance(likelihood: RestrictedLikelihood) -> float:
    """Return the mean of the known additional variances of the records."""
    return float(np.mean([np.mean(variance) for variance in likelihood.added_variances]))


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


def _initial_variances(
    likelihood: RestrictedLikelihood, noise: Noise, white_maximum: Maximum | None
) -> Variances:
    """Return initial variances, with slow noise at the detection limit."""
    added_variance, (white, walk, *_) = _mean_added_variance(likelihood), noise.known.variances
    if white_maximum is not None:
        white, walk, *_ = white_maximum.variances
    elif "white" in noise.to_estimate:
        total_variance = math.exp(likelihood.best_scale(WHITE))
        white = max(total_variance - added_variance, 0.1 * total_variance)
    if white_maximum is None and "random_walk" in noise.to_estimate:
        walk = (white + added_variance) * math.exp(likelihood.log_walk_floor + _DETECTION_LOG_RATIO)
    order, spacing = likelihood.order, likelihood.records[0].spacing
    w = 2.0 * math.pi * _ONSET_RATIO / likelihood.length
    density = max(white + added_variance, 1e-30) * spacing * w ** (2 * order) + walk
    bias = (density * component.inverse_density(w) for component in BIAS_COMPONENTS.values())
    return white, walk or 0.1 * density, *bias


def _average_bias_noise(
    likelihood: RestrictedLikelihood, best_maximum: Maximum, initial_variances: Variances
) -> tuple[Variances, Array]:
    """Return variances, with the posterior means of the bias components, and their covariance.

    Few runs contain little information on changes of the bias between runs, so that the most likely
    variance of the bias noise is often zero. It is therefore averaged like an undetected walk
    (`counterspin.inference.noise.undetected_walk`): Student's distribution with this variance and
    Satterthwaite's degrees of freedom has the quantiles of the mixture.
    """
    variances, covariance = list(best_maximum.variances), best_maximum.covariance.copy()
    for name in best_maximum.names:
        if name not in BIAS_COMPONENTS:
            continue
        index = COMPONENTS.index(name)
        central_variance = max(variances[index], initial_variances[index])
        walk_variances = central_variance * np.exp(_LOG_VARIANCE_OFFSETS)
        log_likelihoods = []
        for variance in walk_variances.tolist():
            variances[index] = variance
            log_likelihoods.append(likelihood.value(*_normalise(likelihood, tuple(variances))))
        # Grid and density are uniform in the logarithm.
        weights = (
            np.exp(np.array(log_likelihoods) - max(log_likelihoods))
            * (walk_variances / central_variance) ** PRIOR_EXPONENT
        )
        posterior = UndetectedWalk(walk_variances, weights / weights.sum())
        negligible_variance = np.array(
            [1e-9 * central_variance * math.exp(_LOG_VARIANCE_OFFSETS[0])]
        )
        variances[index], inverse_dof = marginal_walk(posterior, negligible_variance, np.ones(1))
        covariance[index], covariance[:, index] = 0.0, 0.0
        covariance[index, index] = 2.0 * variances[index] ** 2 * float(inverse_dof[0])
    return tuple(variances), covariance


def _walk_posterior(
    likelihood: RestrictedLikelihood, noise: Noise, best_maximum: Maximum
) -> UndetectedWalk:
    """Return the posterior of a dropped random walk, with the best white noise for each size."""
    candidate = NoiseModelCandidate(likelihood, noise, (*best_maximum.names, "random_walk"))
    white = best_maximum.variances[0]

    def profile(log_ratio: float) -> tuple[float, float]:
        if candidate.has_free_scale:
            log_scale, ratios = candidate.scale_and_ratios(np.array([log_ratio]))
            return likelihood.value(log_scale, ratios), log_scale + log_ratio
        log_variance = math.log(white + _mean_added_variance(likelihood)) + log_ratio
        log_white = [math.log(white)] if best_maximum.names else []
        return candidate.value(np.array([*log_white, log_variance])), log_variance

    return walk_posterior(
        profile, likelihood.log_walk_floor + _DETECTION_LOG_RATIO, best_maximum.value
    )


def _newton_step(function: Callable[[Array], float], x: Array) -> tuple[Array, float]:
    """Return x after a step of Newton's method, and the gain expected from the derivatives.

    Small curvatures are not modified: near zero, the effect of a variance is proportional to e^x,
    with equal slope and curvature, so that a step reduces it by a factor of e.
    """
    value, gradient, hessian = _derivatives(function, x)
    curvatures, vectors = np.linalg.eigh(-hessian)
    slopes = vectors.T @ gradient
    is_concave = curvatures * _MAX_NEWTON_STEP > np.abs(slopes)
    steps = np.sign(slopes) * _MAX_NEWTON_STEP
    steps[is_concave] = slopes[is_concave] / curvatures[is_concave]
    step, gain = vectors @ steps, float(slopes @ steps) / 2.0
    while np.abs(step).max() >= _STEP_TOLERANCE and function(x + step) < value:
        step = step / 4.0
    return np.asarray(x + step), gain


def _refine(function: Callable[[Array], float], x: Array) -> Array:
    """Return x after a last step, with gradients from two neighbours on either side."""
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
    return np.asarray(x + step) if np.abs(step).max() < _STEP_TOLERANCE else x


def _derivatives(function: Callable[[Array], float], x: Array) -> tuple[float, Array, Array]:
    """Return value, gradient and Hessian of a function, by central differences."""
    value, offsets = function(x), _LOG_RATIO_STEP * np.eye(x.size)
    upper, lower = (
        np.array([function(x + sign * offset) for offset in offsets]) for sign in (1.0, -1.0)
    )
    hessian = np.diag(upper + lower - 2.0 * value)
    for i, j in combinations(range(x.size), 2):
        cross_sum = (
            function(x + offsets[i] + offsets[j])
            + function(x - offsets[i] - offsets[j])
            - 2.0 * value
        )
        hessian[i, j] = hessian[j, i] = (cross_sum - hessian[i, i] - hessian[j, j]) / 2.0
    return value, (upper - lower) / (2.0 * _LOG_RATIO_STEP), hessian / _LOG_RATIO_STEP**2
