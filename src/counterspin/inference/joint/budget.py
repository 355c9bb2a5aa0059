"""Uncertainty budget of a coefficient."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.inference.joint import encoder
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.series import RATE
from counterspin.inference.joint.summary import (
    CONSIDERED,
    DEFAULT_PRIOR,
    NOISE,
    STATED,
    BudgetLine,
    Kind,
)
from counterspin.inference.joint.unknowns import Considered, Unknown, unit_of
from counterspin.inference.noise.components import NOISE_COMPONENTS
from counterspin.inference.priors import conditional_priors, prior_root

#: Lines below this share of u^2 are omitted.
_NEGLIGIBLE_SHARE: Final = 1e-12

#: Units of the components of a rotation; the unit of a ripple is rad/s.
_ENCODER_UNITS: Final = {"angle": "rad", "rate": "rad/s", "drift": "1/s"}


def budget(fit: JointFit, index: int, name: str = "") -> list[BudgetLine]:
    """Return the budget of an unknown; see `combination_budget`."""
    return combination_budget(fit, np.eye(len(fit.model.unknowns))[index], name)


def combination_budget(fit: JointFit, weights: Array, name: str = "") -> list[BudgetLine]:
    """Return the budget of a combination of the unknowns, largest contribution first.

    name: Accelerometer whose name is omitted from the names of its terms.
    """
    solution, model = fit.solution, fit.model
    contributions = solution.combine(weights)
    rate_variances = [
        observation.rate_variances(fit.solution, weights) for observation in fit.observations
    ]
    lines = [
        BudgetLine(f"noise of {source}", NOISE, None, "", None, share, 0.0)
        for source, share in _noise_by_source(fit, contributions.noise_rows, rate_variances).items()
    ]
    lines += _rate_lines(fit, rate_variances)
    for source, (walk, covariance) in fit.undetected_walks.items():
        source_name = f"undetected noise of {source}"
        unit = NOISE_COMPONENTS["random_walk"].unit
        effect = math.sqrt(float(weights @ covariance @ weights))
        slope = effect / walk if walk else 0.0
        lines.append(BudgetLine(source_name, NOISE, walk, unit, slope, effect, 0.0))
    terms = (*model.unknowns, *model.considered)
    sensitivity = (solution.sensitivity_prior, solution.sensitivity_considered)
    slopes = np.concatenate([weights @ matrix for matrix in sensitivity])
    effects = (*contributions.prior, *contributions.considered)
    encoder_effects: dict[tuple[str, str], list[float]] = {}
    conditional_sources = conditional_priors(model.unknowns, name)
    for term, slope, effect in zip(terms, map(float, slopes), map(float, effects), strict=True):
        if term.symbol in encoder.SYMBOLS:
            component = term.owner, encoder.rotation_component(term.symbol)
            encoder_effects.setdefault(component, []).append(effect)
        elif term.name in conditional_sources:
            source, u = conditional_sources[term.name]
            lines.append(BudgetLine(source, STATED, u, term.unit, effect / u, abs(effect), 0.0))
        elif math.isfinite(u := term.prior[1]):
            source = term.name.removeprefix(f"{name}.")
            lines.append(
                BudgetLine(source, prior_kind(term), u, term.unit, slope, abs(effect), 0.0)
            )
    lines += _encoder_lines(fit, encoder_effects)
    variance = sum(line.contribution**2 for line in lines)
    if variance == 0.0:
        return []
    lines = [replace(line, share=line.contribution**2 / variance) for line in lines]
    significant_lines = [line for line in lines if line.share > _NEGLIGIBLE_SHARE]
    return sorted(significant_lines, key=lambda line: -line.contribution)


def prior_kind(term: Unknown) -> Kind:
    """Return the category of a term in a budget."""
    if isinstance(term, Considered):
        return CONSIDERED
    return DEFAULT_PRIOR if term.has_default_prior else STATED


def _encoder_lines(
    fit: JointFit, encoder_effects: Mapping[tuple[str, str], Sequence[float]]
) -> Iterator[BudgetLine]:
    """Yield a line for each component of the rotation of each run."""
    angle_errors = {block.run: block.series.angle_error for block in fit.design_blocks}
    for (run, component), contributions in encoder_effects.items():
        error = angle_errors[run]
        u = error.u[component] if error else 0.0
        effect = math.hypot(*contributions) if len(contributions) > 1 else contributions[0]
        slope, unit = effect / u if u else 0.0, _ENCODER_UNITS.get(component, "rad/s")
        yield BudgetLine(f"{run}.{component}", NOISE, u, unit, slope, abs(effect), 0.0)


def _rate_lines(
    fit: JointFit, rate_variances: Sequence[tuple[float, float]]
) -> Iterator[BudgetLine]:
    """Yield a line each for stated and default random errors of rates."""
    kinds: tuple[Kind, ...] = (STATED, DEFAULT_PRIOR)
    for i, (kind, variances) in enumerate(
        zip(kinds, zip(*rate_variances, strict=True), strict=True)
    ):
        effect = math.sqrt(sum(variances))
        if effect > 0.0:
            u = np.concatenate(
                [observation.rate_uncertainties[i] for observation in fit.observations]
            )
            rms_u = math.sqrt(float(np.mean(u[u > 0.0] ** 2)))
            yield BudgetLine(RATE, kind, rms_u, unit_of(RATE), effect / rms_u, effect, 0.0)


def _noise_by_source(
    fit: JointFit, rows: Array, rate_variances: Sequence[tuple[float, float]]
) -> dict[str, float]:
    """Return the noise contribution of each source, without the errors of rates."""
    variances: dict[str, float] = {}
    start = 0
    for block, observation, rate_variance in zip(
        fit.blocks, fit.observations, rate_variances, strict=True
    ):
        end = start + block.factor.shape[0]
        variance = max(float(np.sum(rows[start:end] ** 2)) - sum(rate_variance), 0.0)
        variances[observation.source] = variances.get(observation.source, 0.0) + variance
        start = end
    return {name: math.sqrt(variance_sum) for name, variance_sum in variances.items()}


def u_by_category(fit: JointFit, weights: Array) -> tuple[float, float, float]:
    """Return u of a combination by category; see `unknown_u_by_category`."""
    effects = fit.solution.combine(weights)
    variances = _variances_by_category(fit, weights, effects.noise**2 + effects.undetected**2)
    terms = (*fit.model.unknowns, *fit.model.considered)
    for unknown, effect in zip(terms, (*effects.prior, *effects.considered), strict=True):
        variances[_u_category(unknown)] += float(effect) ** 2
    u_noise, u_stated, u_default = (math.sqrt(variance) for variance in variances.values())
    return u_noise, u_stated, u_default


def _u_category(unknown: Unknown) -> Kind:
    if unknown.symbol in encoder.SYMBOLS:
        return NOISE
    return DEFAULT_PRIOR if unknown.has_default_prior else STATED


def _variances_by_category(fit: JointFit, weights: Array, variance: float) -> dict[str, float]:
    """Split the variance of observations by category: rate errors are not noise."""
    rate_variances = [
        observation.rate_variances(fit.solution, weights) for observation in fit.observations
    ]
    stated_variance, default_variance = (
        sum(observation_variances) for observation_variances in zip(*rate_variances, strict=True)
    )
    return {
        NOISE: max(variance - stated_variance - default_variance, 0.0),
        STATED: stated_variance,
        DEFAULT_PRIOR: default_variance,
    }


def unknown_u_by_category(fit: JointFit, index: int) -> tuple[float, float, float]:
    """Return u of an unknown due to noise, stated priors and default priors."""
    solution, model = fit.solution, fit.model
    weights = np.eye(len(model.unknowns))[index]
    noise = float(solution.covariance_noise[index, index])
    variances = _variances_by_category(fit, weights, noise)
    if solution.covariance_undetected is not None:
        variances[NOISE] += float(solution.covariance_undetected[index, index])
    sensitivity = (solution.sensitivity_prior[index], solution.sensitivity_considered[index])
    for unknowns, slopes in zip((model.unknowns, model.considered), sensitivity, strict=True):
        prior_sds = [u.prior[1] if math.isfinite(u.prior[1]) else 0.0 for u in unknowns]
        effects = slopes * prior_sds
        if (root := prior_root(unknowns)) is not None:
            effects = root.T @ effects
        for unknown, effect in zip(unknowns, effects.tolist(), strict=True):
            variances[_u_category(unknown)] += effect**2
    u_noise, u_stated, u_default = (math.sqrt(max(s, 0.0)) for s in variances.values())
    return u_noise, u_stated, u_default
