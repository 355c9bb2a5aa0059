"""Priors and inputs that the data contradict, and the usual mistakes in stating them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from counterspin.calibration.findings import CONTRADICTION_SIGMAS
from counterspin.calibration.model import inputs_of
from counterspin.calibration.result_parts import Finding
from counterspin.calibration.view import AccelerometerView
from counterspin.campaign.description import Campaign
from counterspin.frozen import frozen
from counterspin.inference.diagnostics import agreement_of, normal_equivalent
from counterspin.inference.joint.alternatives import Alternative, of_priors, scores
from counterspin.inference.joint.fit import JointFit, relax
from counterspin.inference.joint.unknowns import unit_of
from counterspin.physics.terms import INPUTS
from counterspin.reports.numbers import field_unit, format_estimate

#: Sizes of tests that differ by less are one: the first of them is named.
_SAME_SIZE: Final = 1e-6

#: What a quantity is off by where its unit was mistaken, and the words.
_RATIO_MISTAKES: Final[Sequence[tuple[float, str]]] = (
    (-1.0, "its sign is reversed"),
    (1e3, "as between a unit and a thousandth of it"),
    (1e6, "as between a unit and a millionth of it"),
    (9.80665, "as between g and m/s^2"),
)

#: The same of what is measured in angles, or in times.
_OF_ANGLES: Final[Sequence[tuple[float, str]]] = (
    (3600.0, "as between degrees and arcsec, or hours and seconds"),
    (60.0, "as between minutes and seconds"),
    (206264.806, "as between rad and arcsec"),
    (57.29578, "as between rad and deg"),
)
_WITH_ANGLES: Final = ("rad", "s")  # begin or end the units of these

#: Relative distance up to which a ratio is one of these.
_RATIO_TOLERANCE: Final = 0.02


def contradicted_prior(view: AccelerometerView) -> Iterator[Finding]:
    """Yield the finding on the prior that the data contradict most, beyond chance."""
    relaxed = relax(view.fit)
    unknowns = relaxed.model.unknowns
    priors = [
        other
        for other in of_priors(relaxed)
        # What is stated as exact is no prior that could give way.
        if all(unknowns[place].prior[1] > 0.0 for place in other.priors)
    ]
    if not priors:
        return
    given = not view.estimate.components and bool(np.isinf(view.estimate.dof).all())
    held = scores(relaxed, priors, noise_given=given)
    sizes = held.size
    place = int(np.flatnonzero(sizes >= (1.0 - _SAME_SIZE) * sizes.max())[0])
    size = normal_equivalent(float(sizes[place]), None if given else held.dof)
    if size <= agreement_of(held.tested):
        return
    value, u = float(held.value[place]), float(held.u[place])
    wording = PriorExplanation(view.campaign, relaxed, priors[place], value, u).wording()
    yield Finding(
        code=wording.code,
        subject=wording.subject,
        text=wording.text,
        size=size,
        contradicts=size > CONTRADICTION_SIGMAS,
    )


@frozen
class Wording:
    """The words of an explanation."""

    #: As of a finding.
    code: str
    subject: str
    text: str
    name: str  #: What it is called in the list of those that explain the records as well.


@frozen
class PriorExplanation:
    """A prior or an input that explains the data with another value."""

    campaign: Campaign  #: The description.
    fit: JointFit  #: The relaxed fit that it was held against.
    other: Alternative  #: The alternative.
    #: The estimate of its parameter and its standard uncertainty, in SI or g-units.
    value: float
    u: float

    def wording(self) -> Wording:
        """Return the explanation in words."""
        return {"prior": self._prior, "priors": self._priors, "input": self._input}[
            self.other.kind
        ]()

    def _estimate(self, unit: str) -> str:
        return format_si(self.value, self.u, unit)

    def _prior(self) -> Wording:
        if self.other.symbol in INPUTS:
            return self._input()
        (index,) = self.other.priors
        stated, spread = self.fit.model.unknowns[index].prior
        name, unit = self.other.name, unit_of(self.other.symbol)
        found = stated + self.value
        # The difference has the uncertainty of both.
        own = math.sqrt(max(self.u**2 - spread**2, 0.0)) or self.u
        text = conflict(name, (stated, spread), (found, own), abs(self.value) / self.u, unit)
        return Wording(code="prior-conflict", subject=name, text=text, name=name)

    def _priors(self) -> Wording:
        symbol = self.other.symbol
        unit = unit_of(self.fit.model.unknowns[next(iter(self.other.priors))].symbol)
        text = (
            f"{symbol} differs from its stated value in the same way in all runs: the records "
            f"shift it by "
            f"{self._estimate(unit)}, {abs(self.value) / self.u:.1f} standard uncertainties of the "
            "difference. Check the stated value."
        )
        return Wording(
            code="prior-conflict", subject=symbol, text=text, name=f"{symbol} of all runs"
        )

    def _input(self) -> Wording:
        known = INPUTS[self.other.symbol]
        stated = inputs_of(self.campaign)[self.other.name].value
        whose = f" {self.other.owner}" if self.other.owner else ""
        found, as_stated = (
            _in_degrees(value, u) if known.unit == "rad" else format_si(value, u, known.unit)
            for value, u in ((stated + self.value, self.u), (stated, 0.0))
        )
        article, taken = (
            ("An" if known.words[0] in "aeiou" else "A"),
            as_stated.split(" (exact)")[0],
        )
        text = (
            f"{article} {known.words}{whose} of {found} would fit; {taken} is "
            f"{'stated' if stated else 'taken'}. Check it."
        )
        name = f"{known.words}{whose}"
        return Wording(code="wrong-input", subject=self.other.name, text=text, name=name)


def conflict(
    name: str, stated: tuple[float, float], found: tuple[float, float], size: float, unit: str
) -> str:
    """Return the sentence on a prior that the records contradict."""
    text = (
        f"{name} is stated as {format_si(*stated, unit)}; the records and all other priors give "
        f"{format_si(*found, unit)}, which differs by {size:.1f} standard uncertainties of the "
        f"difference"
    )
    if hint := _mistaken(found[0], stated[0], unit):
        text += f" ({hint})"
    return f"{text}. Check it."


def format_si(value: float, u: float, unit: str) -> str:
    """Return an estimate in the unit of the field."""
    shown, factor = field_unit(unit)
    return format_estimate(value * factor, u * factor, "" if shown == "1" else shown).strip()


def _in_degrees(value: float, u: float) -> str:
    return format_estimate(math.degrees(value), math.degrees(u), "deg")


def _mistaken(found: float, stated: float, unit: str) -> str:
    """Name the usual mistake that would make a number this far off; empty if there is none."""
    if found == 0.0 or stated == 0.0:
        return ""
    angles = unit.startswith(_WITH_ANGLES) or unit.endswith("/s")
    for factor, words in (*_RATIO_MISTAKES, *(_OF_ANGLES if angles else ())):
        for ratio in (factor, 1.0 / factor):
            if abs(stated / found / ratio - 1.0) < _RATIO_TOLERANCE:
                return words
    return ""
