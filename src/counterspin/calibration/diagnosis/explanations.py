"""Text on the cause of a misfit."""

from __future__ import annotations

import math

from counterspin.calibration.checks.priors import FindingText, PriorExplanation
from counterspin.campaign.conditions import DEFAULT_WARMING, assumed_temperatures
from counterspin.campaign.settings import OBSERVABLES
from counterspin.frozen import frozen
from counterspin.inference.joint import mistakes
from counterspin.inference.joint.unknowns import unit_of
from counterspin.physics.terms import term
from counterspin.reports.numbers import find_display_unit, format_estimate, format_number


@frozen
class Explanation(PriorExplanation):
    """An alternative that explains the records."""

    def describe(self) -> FindingText:
        """Return the explanation as text."""
        describe_method = {
            "term": self._describe_term,
            mistakes.SCALE: self._describe_scale,
            mistakes.RUN_SCALE: self._describe_scale,
            mistakes.RESPONSE: self._describe_response,
            mistakes.ANGLE: self._describe_angle,
            mistakes.CORIOLIS: self._describe_coriolis,
            mistakes.HEMISPHERE: self._describe_hemisphere,
            mistakes.BIAS: self._describe_bias,
            mistakes.BIAS_DRIFT: self._describe_drift,
            mistakes.JUMP: self._describe_step,
            mistakes.SLOPE: self._describe_step,
            mistakes.BIAS_STEP: self._describe_bias_step,
        }.get(self.alternative.kind, super().describe)
        return describe_method()

    def _describe_term(self) -> FindingText:
        name, limit = self.alternative.name, self.alternative.credible_range[1]
        if not self.alternative.owner and term(self.alternative.symbol).per_run:
            name += " in all runs"
        estimate_text = self._format_estimate(unit_of(self.alternative.symbol))
        text = f"The model omits {name}. A value of {estimate_text} would explain the records. "
        label = f"{name}, which the model omits"
        if abs(self.value) > limit:
            display_unit, factor = find_display_unit(unit_of(self.alternative.symbol))
            limit_text = f"{format_number(limit * factor, 3)} {display_unit}"
            text += (
                f"This value exceeds the largest credible value, {limit_text}, but no cause of a "
                "credible size explains the misfit equally well. If the true value can be this "
                "large, add the term to the model and state a limit. Otherwise, look for a "
                "mistake with the same effect."
            )
            label += " and whose value would not be credible"
        elif self._has_assumed_temperatures:
            text = (
                f"{name} = {estimate_text} would explain the readings. Because no temperature is "
                f"stated, counterspin assumes a rise of {DEFAULT_WARMING:g} K from the first to "
                "the last reading. Look for a drift or a step in the order of the readings, or "
                "state their temperatures."
            )
            label = f"a drift with the effect of {name}"
        else:
            text += "Add the term to the model, or state a prior for it."
        return FindingText(
            code="term-missing", subject=self.alternative.name, text=text, name=label
        )

    @property
    def _has_assumed_temperatures(self) -> bool:
        """Whether the alternative is a temperature slope of readings without temperatures."""
        owner, readings = self.alternative.owner, self.campaign.readings
        series = [reading for reading in readings if reading.accelerometer == owner]
        is_slope = ".temperature" in self.alternative.symbol and not self.fit.design_blocks
        return is_slope and bool(assumed_temperatures(series))

    @property
    def _record_names(self) -> str:
        """Name of the record, or of the owner of the records, to which the alternative applies."""
        blocks = [self.fit.design_blocks[index] for index in self.alternative.columns]
        if len(blocks) == 1:
            return f"{blocks[0].accelerometer} in {blocks[0].run}"
        return self.alternative.owner

    def _describe_scale(self) -> FindingText:
        text = (
            f"The record of {self._record_names} would fit if the signal were "
            f"{format_number(1 - self.value, 6)} times as large (u "
            f"{format_number(self.u, 2)}). Check the scale and unit of the record, and the "
            "stated scale factor."
        )
        name = f"scale of the record of {self._record_names}"
        return FindingText(code="wrong-scale", subject=self.alternative.owner, text=text, name=name)

    def _describe_response(self) -> FindingText:
        rates = (
            abs(self.fit.design_blocks[index].series.trajectory.spindle.rate)
            for index in self.alternative.columns
        )
        max_rate = max(rates)
        change, u = (0.5e6 * coefficient * max_rate**2 for coefficient in (abs(self.value), self.u))
        direction, cause_text = (
            ("fell", "a low-pass filter in the recorder, or averaging over the sampling interval")
            if self.value > 0.0
            else ("rose", "a resonance of the accelerometer")
        )
        text = (
            f"The records of {self.alternative.owner} would fit if the gain {direction} with "
            "the square of the frequency, reaching a change of "
            f"{format_estimate(change, u, 'ppm')} at {max_rate / (2.0 * math.pi):.3g} Hz. A "
            f"likely cause is {cause_text}. Check the frequency response of the accelerometer and "
            "of the recorder."
        )
        return FindingText(
            code="frequency-response",
            subject=self.alternative.owner,
            text=text,
            name=f"frequency response of {self.alternative.owner}",
        )

    def _describe_angle(self) -> FindingText:
        run = self.alternative.owner
        run_clause = f" of {run}" if run else ""
        angle_text = f"{math.degrees(abs(self.value)):.4g} deg (u {math.degrees(self.u):.1g} deg)"
        direction = "larger" if self.value > 0.0 else "smaller"
        text = (
            f"The records would fit if the angle{run_clause} were {angle_text} {direction}. Check "
            "the zero of the angle and the time at which the angle is sampled."
        )
        return FindingText(
            code="wrong-angle",
            subject=run or self.alternative.symbol,
            text=text,
            name=f"zero of the angle{run_clause}",
        )

    def _describe_coriolis(self) -> FindingText:
        uses_platform = self.campaign.own_velocity
        owner_text, reference_key = (
            ("the platform's", "platform") if uses_platform else ("its own", "own velocity")
        )
        text = (
            f"The records fit best if the computer uses {owner_text} velocity for the Coriolis "
            f"acceleration (estimated fraction of this effect {format_number(self.value, 4)}, "
            f"u {format_number(self.u, 2)}). If the computer does so, enter reference = "
            f'"{reference_key}" in [records].'
        )
        name = f"velocity used for the Coriolis acceleration: {owner_text}"
        return FindingText(
            code="own-velocity", subject=self.alternative.symbol, text=text, name=name
        )

    def _describe_hemisphere(self) -> FindingText:
        latitude = math.degrees(self.campaign.latitude.value)
        other_text, stated_text = (format_number(value, 6) for value in (-latitude, latitude))
        text = (
            f"The records would fit with a latitude of {other_text} deg instead of the stated "
            f"{stated_text} deg. A southern latitude is negative. Check the sign."
        )
        return FindingText(
            code="wrong-input", subject="site.latitude", text=text, name="sign of the latitude"
        )

    def _describe_bias(self) -> FindingText:
        text = (
            f"{self._record_names} would fit with a separate bias that differs by "
            f"{self._format_estimate('g')} from the bias in the other runs. Either the bias "
            "changed, or the record has a slow error. Inspect the record."
        )
        return FindingText(
            code="run-differs",
            subject=self.alternative.owner,
            text=text,
            name=f"bias of {self._record_names}",
        )

    def _describe_drift(self) -> FindingText:
        is_single_record = len(self.alternative.columns) == 1
        start_clause = "" if is_single_record else " from the start of every run"
        text = (
            f"{self._record_names} would fit with a bias that drifts by "
            f"{self._format_estimate('g/s')}{start_clause}. Possible causes are warm-up, creep or "
            "another slow error. Inspect the records."
        )
        return FindingText(
            code="bias-drifts",
            subject=self.alternative.owner,
            text=text,
            name=f"bias drift of {self._record_names}",
        )

    def _describe_bias_step(self) -> FindingText:
        text = (
            f"{self._record_names} would fit if the bias changed by "
            f"{self._format_estimate('g')} at about {self.alternative.time:.4g} s. Possible "
            "causes are a switch-on transient, warm-up or another slow error. Omit the part "
            "before that time, or omit the whole run."
        )
        return FindingText(
            code="bias-drifts",
            subject=self.alternative.owner,
            text=text,
            name=f"bias change in {self._record_names}",
        )

    def _describe_step(self) -> FindingText:
        (index,) = self.alternative.columns
        unit = OBSERVABLES[self.fit.design_blocks[index].series.observable]
        time_text = f"about {self.alternative.time:.4g} s"
        if self.alternative.kind == mistakes.JUMP:
            quantity_name, change_text = (
                "level",
                f"jumps by {self._format_estimate(unit)} at {time_text}",
            )
        else:
            change = format_estimate(self.value, self.u, f"{unit} per second")
            quantity_name, change_text = "slope", f"changes slope at {time_text}, by {change}"
        return FindingText(
            code="jump",
            subject=self.alternative.owner,
            text=f"The record of {self._record_names} {change_text}. Omit the run, or record it "
            "again.",
            name=f"{quantity_name} of {self._record_names}",
        )
