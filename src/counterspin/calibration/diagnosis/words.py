"""Text about the cause of a misfit."""

from __future__ import annotations

import math

from counterspin.calibration.checks.priors import PriorExplanation, Wording
from counterspin.campaign.settings import OBSERVABLES
from counterspin.frozen import frozen
from counterspin.inference.joint import mistakes
from counterspin.inference.joint.unknowns import unit_of
from counterspin.physics.terms import term
from counterspin.reports.numbers import field_unit, format_estimate, format_number


@frozen
class Explanation(PriorExplanation):
    """An alternative that explains the records."""

    def wording(self) -> Wording:
        """Return it in words."""
        words = {
            "term": self._term,
            mistakes.SCALE: self._scale,
            mistakes.RUN_SCALE: self._scale,
            mistakes.RESPONSE: self._response,
            mistakes.ANGLE: self._angle,
            mistakes.CORIOLIS: self._coriolis,
            mistakes.BIAS: self._bias,
            mistakes.BIAS_DRIFT: self._drift,
            mistakes.JUMP: self._step,
            mistakes.SLOPE: self._step,
            mistakes.BIAS_STEP: self._bias_step,
        }.get(self.other.kind, super().wording)
        return words()

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
        """Records to which the alternative applies."""
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

    def _response(self) -> Wording:
        rates = (
            abs(self.fit.prepared[i].series.trajectory.spindle.rate) for i in self.other.columns
        )
        fastest = max(rates)
        change, u = (0.5e6 * size * fastest**2 for size in (abs(self.value), self.u))
        way, cause = (
            ("fell", "a filter in the recorder, or means over a sample")
            if self.value > 0.0
            else ("rose", "a resonance of the sensor")
        )
        text = (
            f"The records of {self.other.owner} would fit if the gain {way} with the square of the "
            f"frequency, by {format_estimate(change, u, 'ppm')} at {fastest / (2.0 * math.pi):.3g} "
            f"Hz, as with {cause}. Check the frequency response of accelerometer and recorder."
        )
        return Wording(
            code="frequency-response",
            subject=self.other.owner,
            text=text,
            name=f"frequency response of {self.other.owner}",
        )

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
