"""What is said of the cause of a misfit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from counterspin.calibration.model import inputs_of
from counterspin.campaign.description import Campaign
from counterspin.campaign.settings import OBSERVABLES
from counterspin.frozen import frozen
from counterspin.inference.joint import mistakes
from counterspin.inference.joint.alternatives import Alternative
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.unknowns import unit_of
from counterspin.physics.terms import INPUTS, term
from counterspin.reports.numbers import field_unit, format_estimate, format_number

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


@frozen
class Wording:
    """An alternative in words."""

    #: As of a finding.
    code: str
    subject: str
    text: str
    name: str  #: What it is called in the list of those that explain the records as well.


@frozen
class Explanation:
    """An alternative that explains the records."""

    campaign: Campaign  #: The description.
    fit: JointFit  #: The relaxed fit that it was held against.
    other: Alternative  #: The alternative.
    #: The estimate of its parameter and its standard uncertainty, in SI or g-units.
    value: float
    u: float

    def wording(self) -> Wording:
        """Return it in words."""
        return {
            "prior": self._prior,
            "priors": self._priors,
            "input": self._input,
            "term": self._term,
            mistakes.SCALE: self._scale,
            mistakes.RUN_SCALE: self._scale,
            mistakes.ANGLE: self._angle,
            mistakes.CORIOLIS: self._coriolis,
            mistakes.BIAS: self._bias,
            mistakes.BIAS_DRIFT: self._drift,
            mistakes.JUMP: self._step,
            mistakes.SLOPE: self._step,
            mistakes.BIAS_STEP: self._bias_step,
        }[self.other.kind]()

    def _estimate(self, unit: str) -> str:
        return _shown(self.value, self.u, unit)

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
            _in_degrees(value, u) if known.unit == "rad" else _shown(value, u, known.unit)
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

    def _term(self) -> Wording:
        name, limit = self.other.name, self.other.between[1]
        if not self.other.owner and term(self.other.symbol).per_run:
            name += " in all runs"
        text = (
            f"{name} of {self._estimate(unit_of(self.other.symbol))} would explain the records; "
            "the model leaves it out. "
        )
        called = f"{name}, which is left out"
        if abs(self.value) > limit:
            shown, factor = field_unit(unit_of(self.other.symbol))
            most = f"{format_number(limit * factor, 3)} {shown}"
            text += (
                f"That exceeds the largest credible size, {most}, but nothing credible explains "
                f"as much. If it can be so large, add it to the terms and state its limit; "
                "otherwise look for a mistake that has the same effect."
            )
            called += " and would be larger than is credible"
        else:
            text += "Add it to the terms, or state what is known of it."
        return Wording(code="term-missing", subject=self.other.name, text=text, name=called)

    @property
    def _place(self) -> str:
        """Which records the alternative is of."""
        parts = [self.fit.prepared[i] for i in self.other.columns]
        if len(parts) == 1:
            return f"{parts[0].accelerometer} in {parts[0].run}"
        return self.other.owner

    def _scale(self) -> Wording:
        text = (
            f"The record of {self._place} would fit if it were {format_number(1 - self.value, 6)} "
            f"times as large (u {format_number(self.u, 2)}): check its scale, its "
            "unit and the stated scale factor."
        )
        name = f"scale of the record of {self._place}"
        return Wording(code="wrong-scale", subject=self.other.owner, text=text, name=name)

    def _angle(self) -> Wording:
        run = self.other.owner
        where = f" of {run}" if run else ""
        size = f"{math.degrees(abs(self.value)):.4g} deg (u {math.degrees(self.u):.1g} deg)"
        way = "larger" if self.value > 0.0 else "smaller"
        text = (
            f"The records would fit if the angle{where} were {size} {way}: check its zero, and "
            "the time at which it is sampled."
        )
        return Wording(
            code="wrong-angle",
            subject=run or self.other.symbol,
            text=text,
            name=f"zero of the angle{where}",
        )

    def _coriolis(self) -> Wording:
        own = self.campaign.own_velocity
        whose, stated = ("the platform's", "platform") if own else ("its own", "own velocity")
        text = (
            f"The records look like those of a computer that uses {whose} velocity for the "
            f"Coriolis acceleration: {format_number(self.value, 4)} times that effect "
            f"is in them (u {format_number(self.u, 2)}). If it does, state reference = "
            f'"{stated}" in [records].'
        )
        name = f"velocity in the Coriolis acceleration, {whose}"
        return Wording(code="own-velocity", subject=self.other.symbol, text=text, name=name)

    def _bias(self) -> Wording:
        text = (
            f"{self._place} would fit with a bias of its own, {self._estimate('g')} more than in "
            "the other runs: the bias has changed, or the record has a slow error. "
            "Inspect the record."
        )
        return Wording(
            code="run-differs", subject=self.other.owner, text=text, name=f"bias of {self._place}"
        )

    def _drift(self) -> Wording:
        alone = len(self.other.columns) == 1
        when = "" if alone else " from the start of every run"
        text = (
            f"{self._place} would fit with a bias that drifts by {self._estimate('g/s')}{when}: "
            "warm-up, creep or another slow error. Inspect the records."
        )
        return Wording(
            code="bias-drifts",
            subject=self.other.owner,
            text=text,
            name=f"drift of the bias of {self._place}",
        )

    def _bias_step(self) -> Wording:
        text = (
            f"{self._place} would fit with a bias that changes by {self._estimate('g')} at about "
            f"{self.other.at:.4g} s: switching on, warm-up or another slow "
            "error. Leave out the part before that time, or the whole run."
        )
        return Wording(
            code="bias-drifts",
            subject=self.other.owner,
            text=text,
            name=f"change of the bias of {self._place}",
        )

    def _step(self) -> Wording:
        (i,) = self.other.columns
        unit = OBSERVABLES[self.fit.prepared[i].series.observable]
        at = f"about {self.other.at:.4g} s"
        if self.other.kind == mistakes.JUMP:
            what, how = "level", f"jumps by {self._estimate(unit)} at {at}"
        else:
            change = format_estimate(self.value, self.u, f"{unit} a second")
            what, how = "slope", f"drifts from {at} on: its slope changes by {change}"
        return Wording(
            code="jump",
            subject=self.other.owner,
            text=f"The record of {self._place} {how}. Leave the run out, or record it again.",
            name=f"{what} of {self._place}",
        )


def conflict(
    name: str, stated: tuple[float, float], found: tuple[float, float], size: float, unit: str
) -> str:
    """Return what is said of a prior that the records contradict."""
    text = (
        f"{name} is stated as {_shown(*stated, unit)}; the records and all other priors give "
        f"{_shown(*found, unit)}, which differs by {size:.1f} standard uncertainties of the "
        f"difference"
    )
    if hint := _mistaken(found[0], stated[0], unit):
        text += f" ({hint})"
    return f"{text}. Check it."


def _shown(value: float, u: float, unit: str) -> str:
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
