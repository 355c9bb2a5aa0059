"""The sentences of a certificate, the same in the XML and on its pages.

- `uncertainty_statement`, `unit_statement`, `scope_statement`: for the whole certificate
- `method_name`, `method_lines`: the method
- `output_lines`: bias and scale factor in the unit of the readings
- `coefficient_line`: one coefficient in g-units
- `not_determined`: coefficients that are not certified
- `is_determined`: whether a coefficient is certified
- `decision_rule`, `verdict`: conformity
"""

from __future__ import annotations

from typing import Final

from counterspin.calibration.pages.basis import model_blocks
from counterspin.calibration.pages.motions import lines_of_tests, readings_of
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import AccelerometerResult, Coefficient, Conformity
from counterspin.certificates.coverage import coverage_factor
from counterspin.certificates.elements import factor
from counterspin.inference.conformity import COVERAGE
from counterspin.physics.accelerometer import TERMS
from counterspin.physics.si_units import si_unit
from counterspin.reports.blocks import Paragraph
from counterspin.reports.numbers import format_estimate, format_number, format_share

_METHODS: Final = {
    "joint": "Joint weighted least squares",
    "two-stage": "Two-stage fit with the exact observation model",
}

_RULES: Final = {
    "simple": "simple acceptance: pass if the estimate lies within the tolerance limits, else fail",
    "guarded": "guarded acceptance: pass if the estimate lies within the tolerance limits by at "
    "least the guard band, fail if it lies outside by more than that, else undecided",
    "probability": "by probability: pass if the coefficient conforms with the probability needed, "
    "fail if it does not conform with that probability, else undecided",
}

#: Digits of a probability of conformity (JCGM 106).
_PROBABILITY_DIGITS: Final = 3


def is_determined(coefficient: Coefficient) -> bool:
    """Return whether the records determine a coefficient, so that it can be certified."""
    return coefficient.estimated and coefficient.value is not None and coefficient.u is not None


# Statements for the whole certificate


def uncertainty_statement() -> str:
    """Return how the expanded uncertainties are defined."""
    return (
        "The expanded uncertainty U stated is the combined standard uncertainty multiplied by the "
        "coverage factor k stated beside it, evaluated by the GUM (JCGM 100). k is that of "
        "Student's t-distribution for the effective degrees of freedom (Welch-Satterthwaite), or "
        "of the normal distribution where these are infinite, for a coverage probability of "
        f"{format_share(COVERAGE)}. In the XML, numbers have all digits of the computation; "
        "significantDigit is the power of ten of the last digit that the uncertainty supports. "
        "The ellipsoidal region is the set of all d with d' V^-1 d <= k^2 about the estimates, V "
        "being the covariance matrix of the standard uncertainties, for the same probability of "
        "all quantities together."
    )


def unit_statement(gravity: float) -> str:
    """Return the value of g, and the conversion between g-units and SI."""
    g = format_number(gravity, 12)
    return (
        f"g is the local gravity of the site, g = {g} m/s^2. A coefficient that multiplies the "
        "n-th power of specific force is g^(1-n) times as large in SI units as in g-units: K_F in "
        "m/s^2 is K_F in g times g, K_II in s^2/m is K_II in g/g^2 divided by g. Where the "
        "campaign states an uncertainty of g, it is part of the coefficients' uncertainties: of "
        "those in g-units by what g does to the estimates, of those in SI units by what remains "
        "of that after the conversion, most of which cancels."
    )


def scope_statement() -> str:
    """Return what the results relate to (ISO/IEC 17025 7.8.2.1 l)."""
    return "The results relate only to the items calibrated."


# The method


def method_name(result: Result) -> str:
    """Return the method's name."""
    return _METHODS.get(result.method, result.method)


def method_lines(result: Result) -> list[str]:
    """Return what was observed, how the coefficients follow, and the accelerometers' model."""
    done = (
        list(lines_of_tests(result))
        if readings_of(result)
        else ["The item was carried round by a double turntable centrifuge at the rates stated."]
    )
    return [
        *done,
        *(block.text for block in model_blocks(result) if isinstance(block, Paragraph)),
        "The model is not divided by K_I: IEEE Std 1293 divides by it, so that its K2 is K_II/K_I.",
    ]


# Coefficients


def output_lines(accelerometer: AccelerometerResult) -> list[str]:
    """Return bias and scale factor in the unit of the readings, with U and k."""
    lines = []
    for key, c in accelerometer.output.items():
        if not is_determined(c):
            continue
        assert c.u is not None
        k = coverage_factor(c.dof)
        shown = format_estimate(c.value, k * c.u, c.unit)
        name = {"bias": "bias (K0 times K1 of IEEE Std 1293)", "scale_factor": "scale factor K1"}[
            key
        ]
        lines.append(f"In the unit of the readings: {name}: {shown} (U, k = {factor(k)}).")
    return lines


def coefficient_line(symbol: str, coefficient: Coefficient) -> str:
    """Return a coefficient that is determined, with U and k, in g-units and its SI unit."""
    assert coefficient.value is not None
    assert coefficient.u is not None
    k = coverage_factor(coefficient.dof)
    row = TERMS.get(symbol)
    words = "" if row is None else f"{row.words[:1].upper()}{row.words[1:]}"
    what = "" if row is None else f"{words} ({row.ieee} in IEEE Std 1293); "
    shown = format_estimate(coefficient.value, k * coefficient.u, coefficient.unit)
    return (
        f"{what}{symbol} = {shown} (U, k = {factor(k)}); stated here in "
        f"{si_unit(coefficient.unit)[0].words}."
    )


def not_determined(name: str, accelerometer: AccelerometerResult) -> list[str]:
    """Return a sentence for each coefficient that is not certified, and why."""
    return [
        f"{symbol} of {name}: {_why(c)}; no value is certified."
        for symbol, c in accelerometer.coefficients.items()
        if not is_determined(c)
    ]


def _why(coefficient: Coefficient) -> str:
    if coefficient.value is None:
        return "not determined by the records"
    known = format_estimate(coefficient.value, coefficient.u, coefficient.unit)
    return f"not determined by the records; its prior, {known} (k = 1), was used"


# Conformity


def decision_rule(judged: Conformity) -> str:
    """Return the decision rule of a verdict."""
    text = f"Decision rule: {_RULES[judged.rule]}"
    if judged.guard_band:
        text += f"; guard band {format_number(judged.guard_band)} {judged.unit}"
    if judged.needed is not None:
        text += f"; probability needed {format_number(judged.needed)}"
    return f"{text}."


def verdict(symbol: str, name: str, judged: Conformity) -> str:
    """Return the verdict on a coefficient."""
    text = f"{symbol} of {name}, specified as {judged.specification}: {judged.verdict}"
    text += f" ({judged.reason})." if judged.reason else "."
    if judged.probability is not None:
        text += f" Probability to conform {format_number(judged.probability, _PROBABILITY_DIGITS)}"
        if judged.risk is not None:
            text += f", that the verdict is wrong {format_number(judged.risk, _PROBABILITY_DIGITS)}"
        text += "."
    return text
