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

U = TypeVar("U", bound=Unknown)

#: Inputs at whose stated values the fit evaluates its model.
_RADIUS: Final = "centrifuge.radius"
_LATITUDE: Final = "site.latitude"

#: Shift of a tested source in standard uncertainties.
_SHIFT: Final = 2.0

#: Largest number of tested sources, and their smallest share in the u^2 of any coefficient.
_MAX_SOURCES: Final = 8
_MIN_SHARE: Final = 1e-3

#: Number of full fits with all tested sources drawn together.
_JOINT_FITS: Final = 4

_SEED: Final = 102


@frozen
class Response:
    """Response of a coefficient to one source, beyond the linear one."""

    #: Change at -2 u and at +2 u minus the linear prediction, in the coefficient's unit.
    below: float
    above: float

    @property
    def size(self) -> float:
        """Larger absolute difference from the linear prediction."""
        return max(abs(self.below), abs(self.above))

    def excess(self, deviations: Array) -> Array:
        """Return the parabola through both differences and zero, shape as given.

        deviations: Of the source, in its standard uncertainty.
        """
        x = deviations / _SHIFT
        odd, even = 0.5 * (self.above - self.below), 0.5 * (self.above + self.below)
        return np.asarray(odd * x + even * x**2)


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
        """Return the responses that matter for the u of a coefficient, by names of its budget."""
        return {
            source.removeprefix(f"{owner}."): response
            for source, response in self.responses.get((owner, symbol), {}).items()
            if response.size > numerical_tolerance(u)
        }

    def describe(self, owner: str, symbol: str, u: float) -> dict[str, object]:
        """Return the fields of a coefficient's interval on the linearity of the fit."""
        responses = self.responses.get((owner, symbol), {})
        return {
            "linear_difference": max((r.size for r in responses.values()), default=None),
            "second_order": list(self.second_order(owner, symbol, u)),
            "joint_difference": self.joint_differences.get((owner, symbol)),
        }


def assess_linearity(
    result: Result, campaign: Campaign, observed_runs: Sequence[ObservedRun]
) -> Linearity:
    """Compare the linear sensitivities of a result with full fits.

    result: Of the joint method, with its budgets.
    """
    model = JointProblem(campaign, observed_runs).model
    unknowns = {unknown.name: unknown for unknown in (*model.unknowns, *model.considered)}
    sources = _choose_sources(result, campaign, unknowns)
    estimated_symbols = {
        (name, symbol): (f"{name}.{symbol}", coefficient.value)
        for name, accelerometer in result.accelerometers.items()
        for symbol, coefficient in accelerometer.coefficients.items()
        if coefficient.estimated
        and coefficient.value is not None
        and f"{name}.{symbol}" in unknowns
    }
    slopes = _slopes(result, unknowns)
    responses: dict[tuple[str, str], dict[str, Response]] = {key: {} for key in estimated_symbols}
    tested_sources = []
    for source in sources:
        u = unknowns[source].prior[1]
        with suppress(CounterspinError):
            fits = [
                _fit_values(campaign, observed_runs, {source: sign * _SHIFT * u})
                for sign in (-1.0, 1.0)
            ]
            tested_sources.append(source)
            for key, (name, value) in estimated_symbols.items():
                linear = slopes[key].get(source, 0.0) * _SHIFT * u
                below, above = (fit[name] - value for fit in fits)
                responses[key][source] = Response(below + linear, above - linear)
    joint: dict[tuple[str, str], float] = {}
    generator = np.random.default_rng(_SEED)
    for _ in range(_JOINT_FITS if len(tested_sources) > 1 else 0):
        draws = generator.uniform(-_SHIFT, _SHIFT, len(tested_sources))
        shifts = {
            s: float(x) * unknowns[s].prior[1] for s, x in zip(tested_sources, draws, strict=True)
        }
        with suppress(CounterspinError):
            fit = _fit_values(campaign, observed_runs, shifts)
            for key, (name, value) in estimated_symbols.items():
                prediction = value + sum(
                    slopes[key].get(source, 0.0) * shifts[source]
                    + float(responses[key][source].excess(x))
                    for source, x in zip(tested_sources, draws, strict=True)
                )
                joint[key] = max(joint.get(key, 0.0), abs(fit[name] - prediction))
    return Linearity(tuple(tested_sources), responses, joint)


def _full_name(source: str, owner: str, unknowns: Mapping[str, object]) -> str:
    """Return the name of the unknown that a budget names without its accelerometer."""
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
            is_input = name in (_RADIUS, _LATITUDE, TIMING)
            is_term = has_readings and line.kind != DEFAULT_PRIOR and unknown.symbol not in INPUTS
            if is_input or is_term:
                shares[name] = max(shares.get(name, 0.0), line.share)
    ranked_sources = sorted(shares, key=lambda name: -shares[name])
    return [name for name in ranked_sources if shares[name] >= _MIN_SHARE][:_MAX_SOURCES]


def _slopes(
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


def _fit_values(
    campaign: Campaign, observed_runs: Sequence[ObservedRun], shifts: Mapping[str, float]
) -> dict[str, float]:
    """Return the estimates of a full fit with stated values and prior means shifted, by name.

    shifts: Full name of an input or term -> shift, SI or g-units.
    """
    changed_campaign = _with_inputs(campaign, shifts)
    if changed_campaign is not campaign:
        observed_runs = [
            observe_run(changed_campaign, run.run, run.record, run.trajectory.conditions)
            for run in observed_runs
        ]
    problem = locate_nonlinear_inputs(JointProblem(changed_campaign, observed_runs))
    shifted_symbols = shifts.keys() - {_RADIUS, _LATITUDE, TIMING}
    model = problem.model
    if shifted_symbols:
        model = replace(
            model,
            unknowns=tuple(
                _shift_prior(unknown, shifts, shifted_symbols) for unknown in model.unknowns
            ),
            considered=tuple(
                _shift_prior(term, shifts, shifted_symbols) for term in model.considered
            ),
        )
        vars(problem)["model"] = model
    estimate, _ = estimate_campaign(problem)
    values = zip(estimate.fit.model.unknowns, estimate.fit.solution.estimate, strict=True)
    return {unknown.name: float(value) + unknown.nominal for unknown, value in values}


def _shift_prior(unknown: U, shifts: Mapping[str, float], shifted_symbols: set[str]) -> U:
    """Return an unknown whose prior mean is shifted, if it is one of those moved."""
    if unknown.name not in shifted_symbols:
        return unknown
    value, u = unknown.prior
    return replace(unknown, prior=(value + shifts[unknown.name], u))


def _with_inputs(campaign: Campaign, shifts: Mapping[str, float]) -> Campaign:
    """Return a campaign whose stated inputs are shifted; the same one without any."""

    def shifted(quantity: Quantity, name: str) -> Quantity:
        return replace(quantity, value=quantity.value + shifts[name])

    if _RADIUS in shifts:
        campaign = replace(campaign, radius=shifted(campaign.radius, _RADIUS))
    if _LATITUDE in shifts:
        latitude = shifted(campaign.latitude, _LATITUDE)
        site = replace(campaign.site, latitude=latitude.value)
        campaign = replace(campaign, latitude=latitude, site=site)
    if TIMING in shifts:
        offset = shifted(campaign.timing_offset or Quantity(0.0, 0.0, "s"), TIMING)
        campaign = replace(campaign, timing_offset=offset)
    return campaign
