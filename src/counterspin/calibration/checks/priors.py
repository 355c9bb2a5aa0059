"""Priors and inputs that the data contradict, and the usual mistakes in stating them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from counterspin.calibration.accelerometer_view import AccelerometerView
from counterspin.calibration.findings import CONTRADICTION_SIGMAS
from counterspin.calibration.model import stated_inputs
from counterspin.calibration.result_parts import Finding
from counterspin.campaign.description import Campaign
from counterspin.characters import with_article
from counterspin.frozen import frozen
from counterspin.inference.diagnostics import agreement_limit, normal_equivalent
from counterspin.inference.joint.alternatives import (
    Alternative,
    prior_alternatives,
    run_score_tests,
)
from counterspin.inference.joint.fit import JointFit, estimate_considered
from counterspin.inference.joint.unknowns import unit_of
from counterspin.physics.terms import INPUTS
from counterspin.reports.numbers import find_display_unit, format_estimate

#: Relative difference below which scores are equal; the first of them is reported.
_TIE_TOLERANCE: Final = 1e-6

#: Ratio of the stated to the true value -> description of the usual mistake.
_RATIO_MISTAKES: Final[Sequence[tuple[float, str]]] = (
    (-1.0, "the sign may be reversed"),
    (1e3, "the unit may be wrong by a factor of 1000"),
    (1e6, "the unit may be wrong by a factor of 1000000"),
    (9.80665, "g and m/s^2 may be confused"),
)

#: Further mistakes with angles and times.
_ANGLE_MISTAKES: Final[Sequence[tuple[float, str]]] = (
    (3600.0, "degrees and arcsec, or hours and seconds, may be confused"),
    (60.0, "minutes and seconds may be confused"),
    (206264.806, "rad and arcsec may be confused"),
    (57.29578, "rad and deg may be confused"),
)
_ANGLE_UNITS: Final = ("rad", "s")  # prefixes of their units

#: Relative tolerance for recognising one of these ratios.
_RATIO_TOLERANCE: Final = 0.02


def find_prior_conflict(view: AccelerometerView) -> Iterator[Finding]:
    """Yield the finding on the prior that the data contradict most, beyond chance."""
    fit = estimate_considered(view.fit)
    unknowns = fit.model.unknowns
    priors = [
        alternative
        for alternative in prior_alternatives(fit)
        # A value stated as exact has no prior to relax.
        if all(unknowns[index].prior[1] > 0.0 for index in alternative.prior_shifts)
    ]
    if not priors:
        return
    is_noise_known = not view.estimate.estimated_noise and bool(np.isinf(view.estimate.dof).all())
    tests = run_score_tests(fit, priors, noise_given=is_noise_known)
    scores = tests.z
    best_index = int(np.flatnonzero(scores >= (1.0 - _TIE_TOLERANCE) * scores.max())[0])
    z = normal_equivalent(float(scores[best_index]), None if is_noise_known else tests.dof)
    if z <= agreement_limit(tests.n_tests):
        return
    value, u = float(tests.value[best_index]), float(tests.u[best_index])
    finding_text = PriorExplanation(view.campaign, fit, priors[best_index], value, u).describe()
    yield Finding(
        code=finding_text.code,
        subject=finding_text.subject,
        text=finding_text.text,
        size=z,
        contradicts=z > CONTRADICTION_SIGMAS,
    )


@frozen
class FindingText:
    """Text of an explanation."""

    #: As in `Finding`.
    code: str
    subject: str
    text: str
    name: str  #: Label in the list of explanations that fit equally well.


@frozen
class PriorExplanation:
    """A prior or an input that would explain the data with another value."""

    campaign: Campaign  #: The description.
    fit: JointFit  #: The relaxed fit in which the alternative was tested.
    alternative: Alternative
    #: Estimate of the parameter and its standard uncertainty, in SI or g-units.
    value: float
    u: float

    def describe(self) -> FindingText:
        """Return the explanation as text."""
        return {
            "prior": self._describe_prior,
            "priors": self._describe_common_prior,
            "input": self._describe_input,
        }[self.alternative.kind]()

    def _format_estimate(self, unit: str) -> str:
        return format_si(self.value, self.u, unit)

    def _describe_prior(self) -> FindingText:
        if self.alternative.symbol in INPUTS:
            return self._describe_input()
        (index,) = self.alternative.prior_shifts
        prior_mean, prior_sd = self.fit.model.unknowns[index].prior
        name, unit = self.alternative.name, unit_of(self.alternative.symbol)
        estimate = prior_mean + self.value
        # self.u is the uncertainty of the difference.
        u_estimate = math.sqrt(max(self.u**2 - prior_sd**2, 0.0)) or self.u
        text = describe_conflict(
            name, (prior_mean, prior_sd), (estimate, u_estimate), abs(self.value) / self.u, unit
        )
        return FindingText(code="prior-conflict", subject=name, text=text, name=name)

    def _describe_common_prior(self) -> FindingText:
        symbol = self.alternative.symbol
        unit = unit_of(self.fit.model.unknowns[next(iter(self.alternative.prior_shifts))].symbol)
        text = (
            f"In all runs, {symbol} differs from the stated value by the same amount, "
            f"{self._format_estimate(unit)}. This is {abs(self.value) / self.u:.1f} standard "
            "uncertainties of the difference. Check the stated value."
        )
        return FindingText(
            code="prior-conflict", subject=symbol, text=text, name=f"{symbol} (common to all runs)"
        )

    def _describe_input(self) -> FindingText:
        term_row = INPUTS[self.alternative.symbol]
        stated_value = stated_inputs(self.campaign)[self.alternative.name].value
        owner_text = f" {self.alternative.owner}" if self.alternative.owner else ""
        estimate_text, stated_text = (
            _format_degrees(value, u)
            if term_row.unit == "rad"
            else format_si(value, u, term_row.unit)
            for value, u in ((stated_value + self.value, self.u), (stated_value, 0.0))
        )
        stated_text = stated_text.split(" (exact)")[0]
        text = (
            f"The records would fit with {with_article(term_row.words)}{owner_text} of "
            f"{estimate_text} instead of the {'stated' if stated_value else 'assumed'} "
            f"{stated_text}. Check the value."
        )
        name = f"{term_row.words}{owner_text}"
        return FindingText(code="wrong-input", subject=self.alternative.name, text=text, name=name)


def describe_conflict(
    name: str, prior: tuple[float, float], posterior: tuple[float, float], sigmas: float, unit: str
) -> str:
    """Return the text on a prior that the records contradict; sigmas: size of the difference."""
    text = (
        f"{name} is stated as {format_si(*prior, unit)}, but the records and all other priors "
        f"give {format_si(*posterior, unit)}. The difference is {sigmas:.1f} standard "
        "uncertainties of the difference"
    )
    if hint := _usual_mistake(posterior[0], prior[0], unit):
        text += f" ({hint})"
    return f"{text}. Check the stated value."


def format_si(value: float, u: float, unit: str) -> str:
    """Return an estimate in the unit of the field."""
    display_unit, factor = find_display_unit(unit)
    return format_estimate(
        value * factor, u * factor, "" if display_unit == "1" else display_unit
    ).strip()


def _format_degrees(value: float, u: float) -> str:
    return format_estimate(math.degrees(value), math.degrees(u), "deg")


def _usual_mistake(estimate: float, stated_value: float, unit: str) -> str:
    """Return the usual mistake that explains the ratio of two values; empty if there is none."""
    if estimate == 0.0 or stated_value == 0.0:
        return ""
    is_angle = unit.startswith(_ANGLE_UNITS) or unit.endswith("/s")
    for factor, description in (*_RATIO_MISTAKES, *(_ANGLE_MISTAKES if is_angle else ())):
        for ratio in (factor, 1.0 / factor):
            if abs(stated_value / estimate / ratio - 1.0) < _RATIO_TOLERANCE:
                return description
    return ""
