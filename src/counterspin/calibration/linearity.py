"""Test of the linear sensitivities of a fit: full fits with inputs and priors moved by 2 u.

The linear prediction of a shift is the sensitivity in the budget times the shift. If full fits at
-2 u and +2 u differ from it by more than the numerical tolerance of u (JCGM 101, 7.9), Monte Carlo
draws the coefficient from the parabola through the three fits. Full fits with all tested inputs
drawn together measure what the sum of these parabolas leaves out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Final, TypeVar

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.input_location import locate_nonlinear_inputs
from counterspin.calibration.joint import estimate_campaign
from counterspin.calibration.joint_problem import JointProblem
from counterspin.calibration.observed_runs import ObservedRun, observe_run
from counterspin.campaign.quantity import Quantity
from counterspin.errors import CounterspinError
from counterspin.frozen import frozen
from counterspin.inference.distributions import numerical_tolerance
from counterspin.inference.joint.series import TIMING
from counterspin.inference.joint.summary import DEFAULT_PRIOR, NOISE
from counterspin.inference.joint.unknowns import Unknown
from counterspin.physics.terms import INPUTS

if TYPE_CHECKING:
    from counterspin.calibration.result import Result
    from counterspin.campaign.description import Campaign

UnknownType = TypeVar("UnknownType", bound=Unknown)

#: Inputs at whose stated values the fit evaluates its model.
_RADIUS_NAME: Final = "centrifuge.radius"
_LATITUDE_NAME: Final = "site.latitude"

#: Shift of a tested source in standard uncertainties.
_SHIFT_SIGMAS: Final = 2.0

#: Largest number of tested sources, and their smallest share in the u^2 of any coefficient.
_MAX_SOURCES: Final = 8
_MIN_SHARE: Final = 1e-3

#: Number of full fits with all tested sources drawn together.
_JOINT_FIT_COUNT: Final = 4

_SEED: Final = 102


@frozen
class Response:
    """Non-linear response of a coefficient to one source."""

    #: Shift at -2 u and at +2 u minus the linear prediction, in the unit of the coefficient.
    lower_difference: float
    upper_difference: float

    @property
    def size(self) -> float:
        """Larger absolute difference from the linear prediction."""
        return max(abs(self.lower_difference), abs(self.upper_difference))

    def parabola(self, deviations: Array) -> Array:
        """Return the parabola through both differences and zero, shape as given.

        deviations: Deviations of the source, in standard uncertainties.
        """
        x = deviations / _SHIFT_SIGMAS
        odd_part = 0.5 * (self.upper_difference - self.lower_difference)
        even_part = 0.5 * (self.upper_difference + self.lower_difference)
        return np.asarray(odd_part * x + even_part * x**2)


@frozen
class Linearity:
    """Results of the test for a campaign."""

    sources: tuple[str, ...]  #: Full names of the tested sources.
    #: (accelerometer, term) -> full name of a source -> response.
    responses: Mapping[tuple[str, str], Mapping[str, Response]]
    #: (accelerometer, term) -> largest difference of the full fit from the sum of linear and
    #: parabolic responses, with all sources drawn together.
    joint_differences: Mapping[tuple[str, str], float]

    def second_order(self, owner: str, symbol: str, u: float) -> dict[str, Response]:
        """Return the responses that exceed the tolerance of u, by source as in the budget."""
        return {
            source.removeprefix(f"{owner}."): response
            for source, response in self.responses.get((owner, symbol), {}).items()
            if response.size > numerical_tolerance(u)
        }

    def describe(self, owner: str, symbol: str, u: float) -> dict[str, object]:
        """Return the fields of `MonteCarloInterval` about linearity."""
        responses = self.responses.get((owner, symbol), {})
        return {
            "linear_difference": max(
                (response.size for response in responses.values()), default=None
            ),
            "second_order": list(self.second_order(owner, symbol, u)),
            "joint_difference": self.joint_differences.get((owner, symbol)),
        }


def assess_linearity(
    result: Result, campaign: Campaign, observed_runs: Sequence[ObservedRun]
) -> Linearity:
    """Compare the linear sensitivities of a result with full fits.

    result: Result of the joint method, with its budgets.
    """
    model = JointProblem(campaign, observed_runs).model
    unknowns = {unknown.name: unknown for unknown in (*model.unknowns, *model.considered)}
    sources = _choose_sources(result, campaign, unknowns)
    estimates = {
        (name, symbol): (f"{name}.{symbol}", coefficient.value)
        for name, accelerometer in result.accelerometers.items()
        for symbol, coefficient in accelerometer.coefficients.items()
        if coefficient.estimated
        and coefficient.value is not None
        and f"{name}.{symbol}" in unknowns
    }
    sensitivities = _sensitivities(result, unknowns)
    responses: dict[tuple[str, str], dict[str, Response]] = {key: {} for key in estimates}
    tested_sources = []
    for source in sources:
        u = unknowns[source].prior[1]
        with suppress(CounterspinError):
            fits = [
                _fit_shifted_campaign(campaign, observed_runs, {source: sign * _SHIFT_SIGMAS * u})
                for sign in (-1.0, 1.0)
            ]
            tested_sources.append(source)
            for key, (name, value) in estimates.items():
                linear_shift = sensitivities[key].get(source, 0.0) * _SHIFT_SIGMAS * u
                lower, upper = (fitted_values[name] - value for fitted_values in fits)
                responses[key][source] = Response(lower + linear_shift, upper - linear_shift)
    joint_differences: dict[tuple[str, str], float] = {}
    generator = np.random.default_rng(_SEED)
    for _ in range(_JOINT_FIT_COUNT if len(tested_sources) > 1 else 0):
        draws = generator.uniform(-_SHIFT_SIGMAS, _SHIFT_SIGMAS, len(tested_sources))
        shifts = {
            source: float(x) * unknowns[source].prior[1]
            for source, x in zip(tested_sources, draws, strict=True)
        }
        with suppress(CounterspinError):
            fitted_values = _fit_shifted_campaign(campaign, observed_runs, shifts)
            for key, (name, value) in estimates.items():
                prediction = value + sum(
                    sensitivities[key].get(source, 0.0) * shifts[source]
                    + float(responses[key][source].parabola(x))
                    for source, x in zip(tested_sources, draws, strict=True)
                )
                joint_differences[key] = max(
                    joint_differences.get(key, 0.0), abs(fitted_values[name] - prediction)
                )
    return Linearity(tuple(tested_sources), responses, joint_differences)


def _full_name(source: str, owner: str, unknowns: Mapping[str, object]) -> str:
    """Return the full name of an unknown that a budget names without its accelerometer."""
    name = f"{owner}.{source}"
    return name if name in unknowns else source


def _choose_sources(
    result: Result, campaign: Campaign, unknowns: Mapping[str, Unknown]
) -> list[str]:
    """Return the full names of the sources to test, largest share first.

    In records, terms act linearly: only inputs are tested. Default priors of terms are not tested.
    """
    has_readings = bool(campaign.readings or campaign.triad)
    shares: dict[str, float] = {}
    for owner, accelerometer in result.accelerometers.items():
        for line in (line for lines in accelerometer.budget.values() for line in lines):
            name = _full_name(line.source, owner, unknowns)
            unknown = unknowns.get(name)
            if line.kind == NOISE or unknown is None or unknown.correlations:
                continue
            is_input = name in (_RADIUS_NAME, _LATITUDE_NAME, TIMING)
            is_term = has_readings and line.kind != DEFAULT_PRIOR and unknown.symbol not in INPUTS
            if is_input or is_term:
                shares[name] = max(shares.get(name, 0.0), line.share)
    ranked_sources = sorted(shares, key=lambda name: -shares[name])
    return [name for name in ranked_sources if shares[name] >= _MIN_SHARE][:_MAX_SOURCES]


def _sensitivities(
    result: Result, unknowns: Mapping[str, Unknown]
) -> dict[tuple[str, str], dict[str, float]]:
    """Return the sensitivity of each coefficient to each source, by the source's full name."""
    return {
        (owner, symbol): {
            _full_name(line.source, owner, unknowns): line.sensitivity
            for line in accelerometer.budget.get(symbol, ())
            if line.sensitivity is not None
        }
        for owner, accelerometer in result.accelerometers.items()
        for symbol in accelerometer.coefficients
    }


def _fit_shifted_campaign(
    campaign: Campaign, observed_runs: Sequence[ObservedRun], shifts: Mapping[str, float]
) -> dict[str, float]:
    """Return the estimates of a full fit with stated values and prior means shifted, by name.

    shifts: Full name of an input or term -> shift, SI or g-units.
    """
    shifted_campaign = _shift_inputs(campaign, shifts)
    if shifted_campaign is not campaign:
        observed_runs = [
            observe_run(shifted_campaign, run.run, run.record, run.trajectory.conditions)
            for run in observed_runs
        ]
    problem = locate_nonlinear_inputs(JointProblem(shifted_campaign, observed_runs))
    shifted_names = shifts.keys() - {_RADIUS_NAME, _LATITUDE_NAME, TIMING}
    model = problem.model
    if shifted_names:
        model = replace(
            model,
            unknowns=tuple(
                _shift_prior(unknown, shifts, shifted_names) for unknown in model.unknowns
            ),
            considered=tuple(
                _shift_prior(term, shifts, shifted_names) for term in model.considered
            ),
        )
        vars(problem)["model"] = model
    estimate, _ = estimate_campaign(problem)
    values = zip(estimate.fit.model.unknowns, estimate.fit.solution.estimate, strict=True)
    return {unknown.name: float(value) + unknown.nominal for unknown, value in values}


def _shift_prior(
    unknown: UnknownType, shifts: Mapping[str, float], shifted_names: set[str]
) -> UnknownType:
    """Return an unknown with a shifted prior mean, or the unknown itself if not in the names."""
    if unknown.name not in shifted_names:
        return unknown
    value, u = unknown.prior
    return replace(unknown, prior=(value + shifts[unknown.name], u))


def _shift_inputs(campaign: Campaign, shifts: Mapping[str, float]) -> Campaign:
    """Return a campaign with shifted inputs; the same campaign if no input is shifted."""

    def shift_quantity(quantity: Quantity, name: str) -> Quantity:
        return replace(quantity, value=quantity.value + shifts[name])

    if _RADIUS_NAME in shifts:
        campaign = replace(campaign, radius=shift_quantity(campaign.radius, _RADIUS_NAME))
    if _LATITUDE_NAME in shifts:
        latitude = shift_quantity(campaign.latitude, _LATITUDE_NAME)
        site = replace(campaign.site, latitude=latitude.value)
        campaign = replace(campaign, latitude=latitude, site=site)
    if TIMING in shifts:
        offset = shift_quantity(campaign.timing_offset or Quantity(0.0, 0.0, "s"), TIMING)
        campaign = replace(campaign, timing_offset=offset)
    return campaign
