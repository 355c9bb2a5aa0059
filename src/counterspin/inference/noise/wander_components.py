"""Noise with a wandering bias estimated from records, by restricted maximum likelihood (REML).

White noise and random walk are found first, as where nothing wanders, to begin from. The wander
that is asked for is then part of the noise: what the records cannot tell from a walk of the
velocity may still be one, and moves a run's bias too. Its size is the mean over what the records
allow. The walk, and a second kind of wander, are kept if they gain as much as a component must
(`counterspin.inference.noise.variance_components.KEEPING_GAIN`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import Final, Protocol

import numpy as np
from numpy.typing import ArrayLike

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.noise.restricted_likelihood import (
    Ratios,
    RecordData,
    RestrictedLikelihood,
)
from counterspin.inference.noise.unseen_noise import POWER, Unseen, lengthened
from counterspin.inference.noise.variance_components import (
    COMPONENTS,
    KEEPING_GAIN,
    VarianceComponents,
    estimate,
)

_WANDER: Final = COMPONENTS[2:]

#: Steps of the search and of the curvature, in logarithms of a variance.
_FIRST_STEP: Final = 1.5
_CURVATURE_STEP: Final = 0.2

#: The search ends where variances are known to this part; their own u is ten times that and more.
_TOLERANCE: Final = 3e-2

#: Sizes over which a wander is averaged, about the largest of estimate and first guess: e-folds of
#: the variance.
_SIZES: Final = np.arange(-12.0, 9.1, 1.0)

#: A wander that begins to show is the other noise at this many times a record's lowest frequency.
_ONSET_RATIO: Final = 3.0


class Request(Protocol):
    """What is known of the noise, as `NoiseModel` has it; None asks for an estimate."""

    @property
    def white(self) -> float | None:
        """White noise."""

    @property
    def random_walk(self) -> float | None:
        """Of the accelerometer's white noise."""

    @property
    def quantisation(self) -> float:
        """Always known."""

    @property
    def flicker(self) -> float | None:
        """Bias instability."""

    @property
    def bias_walk(self) -> float | None:
        """Random walk of the bias."""


def estimate_wandering(
    records: Sequence[RecordData],
    request: Request,
    prior_rows: ArrayLike | None = None,
    prior_values: ArrayLike | None = None,
) -> VarianceComponents:
    """Estimate the noise that records share, a wandering bias included."""
    likelihood = RestrictedLikelihood.of(records, prior_rows, prior_values)
    search = _Search(likelihood, request)
    free = [name for name in COMPONENTS if getattr(request, name) is None]
    base = estimate(
        records,
        white=request.white,
        random_walk=request.random_walk,
        quantisation=request.quantisation,
        prior_rows=prior_rows,
        prior_values=prior_values,
    )
    maxima: dict[tuple[str, ...], tuple[dict[str, float], float]] = {}

    def best(names: Sequence[str]) -> float:
        """Return the restricted likelihood of a choice of components, less what each costs."""
        key = tuple(name for name in COMPONENTS if name in names)
        if key not in maxima:
            maxima[key] = search.maximum(key, base)
        return maxima[key][1] - 0.5 * KEEPING_GAIN * len(key)

    # White noise is there where the bias wanders, and the wander that was asked for is taken where
    # the records cannot tell it from a walk of the velocity: it leaves more open.
    always = [name for name in free if name == "white" or name in _WANDER[:1]]
    if not set(always) & set(_WANDER):
        always += [name for name in free if name in _WANDER]
    others = [name for name in free if name not in always]
    choices = [
        [*always, *some] for size in range(len(others) + 1) for some in combinations(others, size)
    ]
    chosen = tuple(name for name in COMPONENTS if name in max(choices, key=best))
    variances, _ = maxima[chosen]
    spreads = {}
    for name in [name for name in chosen if name in _WANDER]:
        variances, spreads[name] = search.averaged(name, variances, base)
    if not any(variances[name] > 0.0 for name in _WANDER):
        return base
    floor = request.quantisation**2 / 12.0
    white = math.sqrt(max(variances["white"] - floor, 0.0))
    covariance, converged = search.covariance(chosen, variances)
    for name, spread in spreads.items():
        place = COMPONENTS.index(name)
        covariance[place], covariance[:, place] = 0.0, 0.0
        covariance[place, place] = spread
    log_scale, ratios = search.point(variances)
    return VarianceComponents(
        white=white if request.white is None else request.white,
        random_walk=math.sqrt(variances["random_walk"]),
        quantisation=request.quantisation,
        covariance=covariance,
        estimated=chosen,
        dropped=tuple(name for name in free if name not in chosen),
        log_likelihoods={names: value for names, (_, value) in maxima.items()},
        degrees_of_freedom=likelihood.freedom(log_scale, ratios),
        evaluations=likelihood.evaluations,
        converged=converged,
        flicker=math.sqrt(variances["flicker"]),
        bias_walk=math.sqrt(variances["bias_walk"]),
    )


def _with(
    base: VarianceComponents,
    dropped: tuple[str, ...],
    maxima: dict[tuple[str, ...], tuple[dict[str, float], float]],
) -> VarianceComponents:
    values = {names: value for names, (_, value) in maxima.items()}
    return replace(base, dropped=dropped, log_likelihoods={**base.log_likelihoods, **values})


@frozen(eq=False)
class _Search:
    """The restricted likelihood of variances, some of which are known."""

    likelihood: RestrictedLikelihood
    request: Request

    @property
    def _known(self) -> dict[str, float]:
        """Known variances; those to be estimated are zero."""
        known = {name: (getattr(self.request, name) or 0.0) ** 2 for name in COMPONENTS}
        known["white"] += self.request.quantisation**2 / 12.0
        return known

    def point(self, variances: dict[str, float]) -> tuple[float, Ratios]:
        """Return log scale and ratios, as the likelihood takes them."""
        white = variances["white"]
        if white <= 0.0:
            raise ValueError("noise: a wandering bias needs white noise beside it; state its size")
        others = (variances[name] / white for name in COMPONENTS[1:])
        return math.log(white), Ratios(*others)

    def value(self, variances: dict[str, float]) -> float:
        return self.likelihood.value(*self.point(variances))

    def maximum(
        self, names: tuple[str, ...], base: VarianceComponents
    ) -> tuple[dict[str, float], float]:
        """Return the variances at which the likelihood is greatest, and its value there."""
        from scipy.optimize import minimize

        start, known = self._start(names, base), self._known
        floor = self.request.quantisation**2 / 12.0
        # If nothing else has a size of its own, the best white noise of given ratios is known.
        profiled = "white" in names and not any(known[name] for name in COMPONENTS[1:])
        searched = [name for name in names if not (profiled and name == "white")]

        def variances(logs: Array) -> dict[str, float]:
            estimated = dict(zip(searched, np.exp(logs).tolist(), strict=True))
            if profiled:
                scale = self.likelihood.best_scale(
                    self.point({**known, "white": 1.0, **estimated})[1]
                )
                white = max(math.exp(scale), floor)
                estimated = {
                    "white": white,
                    **{name: white * part for name, part in estimated.items()},
                }
            elif "white" in estimated:
                estimated["white"] = max(estimated["white"], floor)
            return {**known, **estimated}

        if not searched:
            only = variances(np.empty(0))
            return only, self.value(only)
        first = np.log([start[name] for name in searched])
        if profiled:
            first -= math.log(start["white"])
        simplex = np.vstack([first, first + _FIRST_STEP * np.eye(first.size)])
        search = minimize(
            lambda logs: -self.value(variances(logs)),
            first,
            method="Nelder-Mead",
            options={
                "initial_simplex": simplex,
                "xatol": _TOLERANCE,
                "fatol": 0.1 * _TOLERANCE,
                "maxfev": 60 * first.size,
            },
        )
        return variances(search.x), -float(search.fun)

    def _start(self, names: tuple[str, ...], base: VarianceComponents) -> dict[str, float]:
        """Return variances to begin with: wander as large as the other noise where it begins."""
        first = self.likelihood.differences[0]
        order = self.likelihood.orders[0]
        longest = max(float(d.blocks.time[-1]) for d in self.likelihood.differences)
        w = 2.0 * math.pi * _ONSET_RATIO / longest
        white = base.white**2 + self.request.quantisation**2 / 12.0
        white = max(white, self._known["white"], 1e-30)
        density = white * float(np.median(first.spacing)) * w ** (2 * order) + base.random_walk**2
        begins = {
            "white": white,
            "random_walk": base.random_walk**2 or 0.1 * density,
            "flicker": density * w,
            "bias_walk": density * w**2,
        }
        return {name: begins[name] for name in names}

    def averaged(
        self, name: str, variances: dict[str, float], base: VarianceComponents
    ) -> tuple[dict[str, float], float]:
        """Return variances with one averaged over what the records allow, and its own variance.

        A wander moves the runs' biases against each other, and few runs tell little of that: the
        most likely size is often none. It is averaged as a walk is that does not show
        (`counterspin.inference.noise.unseen_noise`): Student's distribution of this variance and
        of the degrees of freedom that its own variance says (Satterthwaite) has the quantiles of
        the mixture.
        """
        middle = max(variances[name], self._start((name,), base)[name])
        sizes = middle * np.exp(_SIZES)
        values = np.array([self.value({**variances, name: size}) for size in sizes.tolist()])
        # The sizes are even in the logarithm, and so is the density.
        weights = np.exp(values - values.max()) * (sizes / middle) ** POWER
        allowed = Unseen(sizes, weights / weights.sum())
        nothing = np.array([1e-9 * middle * math.exp(_SIZES[0])])
        level, dof = lengthened(allowed, nothing, np.ones(1))
        return {**variances, name: level}, 2.0 * level**2 / float(dof[0])

    def covariance(self, names: tuple[str, ...], variances: dict[str, float]) -> tuple[Array, bool]:
        """Return the variances' covariance, (4, 4): the inverse observed information."""
        logs = np.log([variances[name] for name in names])

        def at(*moves: tuple[int, float]) -> float:
            moved = logs.copy()
            for place, step in moves:
                moved[place] += step
            return self.value({**variances, **dict(zip(names, np.exp(moved), strict=True))})

        h, size = _CURVATURE_STEP, len(names)
        middle, hessian = at(), np.zeros((size, size))
        for i in range(size):
            hessian[i, i] = (at((i, h)) - 2.0 * middle + at((i, -h))) / h**2
            for j in range(i):
                corners = at((i, h), (j, h)) + at((i, -h), (j, -h))
                corners -= at((i, h), (j, -h)) + at((i, -h), (j, h))
                hessian[i, j] = hessian[j, i] = corners / (4.0 * h**2)
        covariance = np.zeros((len(COMPONENTS), len(COMPONENTS)))
        if size == 0:
            return covariance, True
        values, vectors = np.linalg.eigh(-hessian)
        regular = bool(values.min() > 0.0)
        # A direction in which nothing is known: a factor of e^2 either way.
        inverse = vectors / np.maximum(values, 0.25) @ vectors.T
        places = [COMPONENTS.index(name) for name in names]
        levels = np.exp(logs)
        covariance[np.ix_(places, places)] = inverse * np.outer(levels, levels)
        return covariance, regular
