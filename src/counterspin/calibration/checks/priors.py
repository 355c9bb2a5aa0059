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

#: Sizes of tests that differ by less are one: the first of them is named.
_TIE_TOLERANCE: Final = 1e-6

#: What a quantity is off by where its unit was mistaken, and the words.
_RATIO_MISTAKES: Final[Sequence[tuple[float, str]]] = (
    (-1.0, "the sign may be reversed"),
    (1e3, "the unit may be wrong by a factor of 1000"),
    (1e6, "the unit may be wrong by a factor of 1000000"),
    (9.80665, "g and m/s^2 may be confused"),
)

#: The same of what is measured in angles, or in times.
_ANGLE_MISTAKES: Final[Sequence[tuple[float, str]]] = (
    (3600.0, "degrees and arcsec, or hours and seconds, may be confused"),
    (60.0, "minutes and seconds may be confused"),
    (206264.806, "rad and arcsec may be confused"),
    (57.29578, "rad and deg may be confused"),
)
_ANGLE_UNITS: Final = ("rad", "s")  # begin or end the units of these

#: Relative distance up to which a ratio is one of these.
_RATIO_TOLERANCE: Final = 0.02


def find_prior_conflict(view: AccelerometerView) -> Iterator[Finding]:
    """Yield the finding on the prior that the data contradict most, beyond chance."""
    relaxed_fit = estimate_considered(view.fit)
    unknowns = relaxed_fit.model.unknowns
    priors = [
        alternative
        for alternative in prior_alternatives(relaxed_fit)
        # What is stated as exact is no prior that could give way.
        if all(unknowns[best_index].prior[1] > 0.0 for best_index in alternative.prior_shifts)
    ]
    if not priors:
        return
    noise_known = not view.estimate.estimated_noise and bool(np.isinf(view.estimate.dof).all())
    tests = run_score_tests(relaxed_fit, priors, noise_given=noise_known)
    scores = tests.z
    best_index = int(np.flatnonzero(scores >= (1.0 - _TIE_TOLERANCE) * scores.max())[0])
    z = normal_equivalent(float(scores[best_index]), None if noise_known else tests.dof)
    if z <= agreement_limit(tests.test_count):
        return
    value, u = float(tests.value[best_index]), float(tests.u[best_index])
    finding_text = PriorExplanation(
        view.campaign, relaxed_fit, priors[best_index], value, u
    ).describe()
    yield Finding(
        code=finding_text.code,
        subject=finding_text.subject,
        text=finding_text.text,
        size=z,
        contradicts=z > CONTRADICTION_SIGMAS,
    )


@frozen
class FindingText:
    """The words of an explanation."""

    #: As in `Finding`.
    code: str
    subject: str
    text: str
    name: str  #: What it is called in the list of those that explain the records as well.


@frozen
class PriorExplanation:
    """A prior or an input that explains the data with another value."""

    campaign: Campaign  #: The description.
    fit: JointFit  #: The relaxed fit that it was held against.
    alternative: Alternative  #: The alternative.
    #: The estimate of its parameter and its standard uncertainty, in SI or g-units.
    value: float
    u: float

    def describe(self) -> FindingText:
        """Return the explanation in words."""
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
        # The difference has the uncertainty of both.
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
            code="prior-conflict",
            subject=symbol,
            text=text,
            name=f"{symbol} (common to all runs)",
        )

    def _describe_input(self) -> FindingText:
        term_row = INPUTS[self.alternative.symbol]
        stated_value = stated_inputs(self.campaign)[self.alternative.name].value
        owner = f" {self.alternative.owner}" if self.alternative.owner else ""
        estimate, as_stated = (
            _format_degrees(value, u)
            if term_row.unit == "rad"
            else format_si(value, u, term_row.unit)
            for value, u in ((stated_value + self.value, self.u), (stated_value, 0.0))
        )
        article, stated_text = (
            ("an" if term_row.words[0] in "aeiou" else "a"),
            as_stated.split(" (exact)")[0],
        )
        text = (
            f"The records would fit with {article} {term_row.words}{owner} of {estimate} instead "
            f"of the {'stated' if stated_value else 'assumed'} {stated_text}. Check the value."
        )
        name = f"{term_row.words}{owner}"
        return FindingText(code="wrong-input", subject=self.alternative.name, text=text, name=name)


def describe_conflict(
    name: str, stated: tuple[float, float], estimate: tuple[float, float], size: float, unit: str
) -> str:
    """Return the sentence on a prior that the records contradict."""
    text = (
        f"{name} is stated as {format_si(*stated, unit)}, but the records and all other priors "
        f"give {format_si(*estimate, unit)}. The difference is {size:.1f} standard "
        "uncertainties of the difference"
    )
    if hint := _usual_mistake(estimate[0], stated[0], unit):
        text += f" ({hint})"
    return f"{text}. Check the stated value."


def format_si(value: float, u: float, unit: str) -> str:
    """Return an estimate in the unit of the field."""
    shown_unit, factor = find_display_unit(unit)
    return format_estimate(
        value * factor, u * factor, "" if shown_unit == "1" else shown_unit
    ).strip()


def _format_degrees(value: float, u: float) -> str:
    return format_estimate(math.degrees(value), math.degrees(u), "deg")


def _usual_mistake(estimate: float, stated: float, unit: str) -> str:
    """Name the usual mistake that would make a number this far off; empty if there is none."""
    if estimate == 0.0 or stated == 0.0:
        return ""
    angles = unit.startswith(_ANGLE_UNITS) or unit.endswith("/s")
    for factor, description in (*_RATIO_MISTAKES, *(_ANGLE_MISTAKES if angles else ())):
        for ratio in (factor, 1.0 / factor):
            if abs(stated / estimate / ratio - 1.0) < _RATIO_TOLERANCE:
                return description
    return ""
