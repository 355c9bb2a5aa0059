"""The sentences of a certificate, the same in the XML and on its pages; its coverage factors."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Final

from counterspin.calibration.pages.accelerometer import confounded_sentences
from counterspin.calibration.pages.methods import (
    describe_tests,
    model_blocks,
    poses_of,
    readings_of,
)
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import AccelerometerResult, Coefficient
from counterspin.certificates.evidence import name_with_words
from counterspin.certificates.lab import CertificateSettings, Equipment
from counterspin.certificates.schema import format_decimal
from counterspin.inference.distributions import COVERAGE, expanded_uncertainty
from counterspin.inference.verdicts import Conformity
from counterspin.physics.grades import GRADES
from counterspin.physics.terms import TABLE, TERMS, find_symbol
from counterspin.reports.blocks import Paragraph
from counterspin.reports.numbers import (
    field_unit,
    format_estimate,
    format_number,
    format_probability,
    format_share,
    format_uncertainty,
)
from counterspin.units import SiUnit, si_unit

#: Decimals of a factor as stated and used, so that U/k is the standard uncertainty to the last
#: digit; rounding changes the coverage by less than 1e-5.
_FACTOR_DECIMALS: Final = 4


def coverage_factor(dof: float | None) -> float:
    """Return k of the interval value ± k u for degrees of freedom, None being infinite."""
    return round(expanded_uncertainty(1.0, dof, COVERAGE), _FACTOR_DECIMALS)


def region_factor(size: int, dof: float | None) -> float:
    """Return k of the region d' V^-1 d <= k^2 of a number of quantities with covariance V.

    dof: Degrees of freedom of the common scale of V; None is infinite.
    """
    from scipy.special import chdtri, fdtri

    squared = chdtri(size, 1.0 - COVERAGE) if dof is None else size * fdtri(size, dof, COVERAGE)
    return round(math.sqrt(float(squared)), _FACTOR_DECIMALS)


#: ``(a ± b) x 1e4``: value, uncertainty, power.
_TIMES_POWER: Final = re.compile(r"\((\S+) ± (\S+)\) (x 1e-?\d+)")

#: Smallest share of u^2 for which a source is named.
MIN_SHARE: Final = 0.01

_METHODS: Final = {
    "joint": "Joint weighted least squares",
    "two-stage": "Two-stage fit with the exact observation model",
}

_RULES: Final = {
    "simple": (
        "simple acceptance: the verdict is pass if the estimate lies within the tolerance "
        "limits, and fail otherwise"
    ),
    "guarded": "guarded acceptance: the verdict is pass if the estimate lies inside the "
    "tolerance limits by at least the guard band, fail if it lies outside by more "
    "than the guard band, and undecided otherwise",
    "probability": "acceptance by probability: the verdict is pass if the probability of "
    "conformity is at least the required value, fail if the probability of "
    "non-conformity is at least this value, and undecided otherwise",
}

#: Statement of a certificate that lacks data of the laboratory, or is not issued yet.
DRAFT: Final = (
    "DRAFT. The laboratory data are incomplete. This document is not a certificate and "
    "certifies nothing."
)

#: Relation of the method to the standard.
BASED_ON: Final = (
    "The coefficients are based on the terms of IEEE Std 1293, but they do not follow this "
    "standard, because they are not normalised by K_I (IEEE Std 1293: K2 = K_II/K_I)."
)

#: Disclaimer required by ISO/IEC 17025:2017, 7.8.2.2.
CUSTOMER_DISCLAIMER: Final = (
    "These data were supplied by the customer and can affect the validity of the results. The "
    "laboratory is not responsible for them."
)

# Headings of the statements, in the XML and on the pages.
UNCERTAINTY: Final = "Measurement uncertainty"
UNITS: Final = "Units"
TRACEABILITY: Final = "Metrological traceability"
EQUIPMENT: Final = "Equipment and traceability"
CAPABILITY: Final = "Calibration and measurement capability"
BASIS: Final = "Basis of the result"
PRIOR_KNOWLEDGE: Final = "Prior information"
ASSUMED: Final = "Terms fixed at nominal values, with evidence"
DEFAULTS: Final = "Evidence for default uncertainties"
SUPPLIED: Final = "Data supplied by the customer"
CONFORMITY: Final = "Conformity"
REMARKS: Final = "Remarks"
SCOPE: Final = "Scope"

#: DCC verdict -> plain English.
_CONDITIONAL: Final = {"conditionalPass": "conditional pass", "conditionalFail": "conditional fail"}
#: Wrong decision for a verdict, with its risk (JCGM 106).
_WRONG_DECISIONS: Final = {
    "pass": "false acceptance (specific consumer's risk)",
    "fail": "false rejection (specific producer's risk)",
}


def is_determined(coefficient: Coefficient) -> bool:
    """Return whether the records determine a coefficient, so that it can be certified."""
    return coefficient.estimated and coefficient.value is not None and coefficient.u is not None


# Statements for the whole certificate


def uncertainty_statement() -> str:
    """Return the definition of the expanded uncertainties."""
    return (
        "The number after ± is the expanded uncertainty U. U is the combined standard uncertainty, "
        "evaluated according to the GUM (JCGM 100), multiplied by the stated coverage factor k. "
        f"The coverage probability is {format_share(COVERAGE)}. The factor k is the quantile of "
        "Student's t-distribution for the effective degrees of freedom (Welch-Satterthwaite), or "
        "of the normal distribution if the degrees of freedom are infinite. Quantities without a "
        "value in the campaign contribute to U, and to probabilities of conformity, with their "
        "default standard uncertainties. Terms fixed at nominal values contribute to neither; they "
        f'are listed under "{ASSUMED}". The XML gives the numbers to full computed precision.'
    )


def unit_statement(gravity: float) -> str:
    """Return the value of g, and the conversion between g-units and SI."""
    g = format_number(gravity, 12)
    return (
        f"g is the local gravity of the calibration site, g = {g} m/s^2. A coefficient that "
        "multiplies the n-th power of the specific force is g^(1-n) times as large in SI units "
        "as in g-units. To convert coefficients to SI units, multiply K_F by g (result in "
        "m/s^2), and divide K_II by g (result in s^2/m). If the campaign states an uncertainty "
        "of g, the uncertainties of the coefficients include this contribution. In SI units, "
        "most of this contribution cancels."
    )


def scope_statement() -> str:
    """Return the items that the results concern, and a note on parts (ISO/IEC 17025 7.8.2.1)."""
    return (
        "The results relate only to the items calibrated, in the state and under the conditions "
        "stated. This certificate must not be reproduced except in full without the written "
        "approval of the laboratory."
    )


def replace_plus_minus(sentence: str) -> str:
    """Return a sentence with "u =" for "±", which precedes only U in a certificate."""
    separated = _TIMES_POWER.sub(r"\1 \3, u = \2 \3", sentence)
    return separated.replace(" ± ", ", u = ")


# The method


def method_name(result: Result) -> str:
    """Return the method's name."""
    return _METHODS.get(result.method, result.method)


def test_lines(result: Result) -> list[str]:
    """Return sentences on the tests of the item, one for each kind of test."""
    if readings_of(result) or poses_of(result):
        return list(describe_tests(result))
    return [
        "The item was mounted on a double-turntable centrifuge and rotated at the stated rates."
    ]


def method_lines(result: Result) -> list[str]:
    """Return sentences on the observations, the estimation, and the accelerometers' model."""
    return [
        *test_lines(result),
        *(block.text for block in model_blocks(result) if isinstance(block, Paragraph)),
    ]


def deviation_lines(settings: CertificateSettings) -> list[str]:
    """Return the deviations from the procedure (ISO/IEC 17025 7.8.2.1 n)."""
    return [f"Deviation: {deviation}" for deviation in settings.deviations]


def equipment_lines(equipment: Equipment) -> list[str]:
    """Return quantity, calibration and its next date of measuring equipment, as far as stated."""
    entries = {
        "Quantity": equipment.quantity,
        "Calibration certificate": equipment.certificate,
        "Calibrated by": equipment.calibrated_by,
        "Next calibration due": equipment.due,
    }
    return [f"{words}: {value}." for words, value in entries.items() if value is not None]


def customer_lines(settings: CertificateSettings) -> list[str]:
    """Return the customer's data, with the disclaimer; nothing without any."""
    return [*settings.customer_data, CUSTOMER_DISCLAIMER] if settings.customer_data else []


def prior_lines(name: str, result: Result, settings: CertificateSettings) -> list[str]:
    """Return the prior information in an accelerometer's result, by its budget.

    settings: [certificate] of the laboratory's file; quantities in its `customer_data` are marked.
    """
    lines = {
        line.source: line
        for lines in result.accelerometers[name].budget.values()
        for line in lines
        if line.kind in ("stated", "held")
    }
    supplied = {word for entry in settings.customer_data for word in re.findall(r"[\w.]+", entry)}
    sentences = []
    for symbol, line in lines.items():
        unit, scale = field_unit(line.unit)
        size = ""
        if line.u:
            size = f", standard uncertainty {format_uncertainty(line.u * scale)} {unit}"
        supplier = ", supplied by the customer" if symbol.rpartition(" ")[2] in supplied else ""
        sentences.append(f"Prior for {name}: {name_with_words(symbol)}{size}{supplier}.")
    return sentences


def assumption_lines(name: str, result: Result) -> list[str]:
    """Return the unmeasured assumptions behind u of an accelerometer's coefficients.

    They are confounded terms, and terms with a default uncertainty, each with its source. Advice
    on a smaller uncertainty is left to the report.
    """
    accelerometer = result.accelerometers[name]
    sentences = list(map(replace_plus_minus, confounded_sentences(accelerometer)))
    sizes = dict[str, str]()
    budget = [line for lines in accelerometer.budget.values() for line in lines]
    for line in sorted(budget, key=lambda line: line.share):
        if line.kind == "unstated" and line.u and line.share >= MIN_SHARE:
            sizes.pop(line.source, None)
            unit, scale = field_unit(line.unit)
            size = f"{format_uncertainty(line.u * scale)} {unit}"
            sizes[line.source] = (
                f"Default prior: {name_with_words(line.source)}, standard uncertainty "
                f"{size}{_source_of_default(line.source, line.u)}; contribution to the "
                f"variance at most {format_share(line.share)}."
            )
    return [*sentences, *reversed(sizes.values())]


def _source_of_default(source: str, u: float) -> str:
    """Return the document behind a default uncertainty; empty for one that a campaign states."""
    row = TABLE.get(find_symbol(source))
    sizes = [] if row is None else [row.sizes(grade) for grade in GRADES]
    return next((f" ({s.source})" for s in sizes if math.isclose(s.typical, u)), "")


def seal_lines(result: Result, accepted: str | None) -> list[str]:
    """Return the statement on a result whose file has no seal; nothing for a sealed result.

    accepted: The reason for certifying it without a seal.
    """
    if result.sealed:
        return []
    return [
        "The result file has no seal, so later changes to the file cannot be excluded. "
        "counterspin re-evaluated the state of the result from the numbers in the file.",
        *(
            []
            if accepted is None
            else [f"The missing seal was accepted for this reason: {accepted}"]
        ),
    ]


def misfit_lines(result: Result, names: Sequence[str]) -> list[str]:
    """Return the contradictions between a result and its records, and the reason to certify it."""
    if result.accepted_misfit is None:
        return []
    failed = [
        replace_plus_minus(f"{name}: {result.accelerometers[name].findings[0].text}")
        for name in names
        if result.accelerometers[name].state == "contradicted"
    ]
    return [
        *(f"The result failed the quality checks. {line}" for line in failed),
        f"The misfit was accepted for this reason: {result.accepted_misfit}",
    ]


# Coefficients


def output_lines(accelerometer: AccelerometerResult) -> dict[str, str]:
    """Return bias and scale factor in the unit of the readings, with U and k, by key."""
    lines = {}
    for key, c in accelerometer.output.items():
        if not is_determined(c):
            continue
        assert c.u is not None
        k = coverage_factor(c.dof)
        label = format_estimate(c.value, k * c.u, c.unit)
        name = {"bias": "bias (K0 times K1 of IEEE Std 1293)", "scale_factor": "scale factor K1"}[
            key
        ]
        lines[key] = (
            f"In the unit of the readings, the {name} is {label} (U, k = {format_decimal(k)})."
        )
    return lines


def unit_remark(unit: SiUnit, quantity: str = "value") -> str:
    """Return a remark on the unit of a quantity, for the end of its description."""
    unit_text = "a dimensionless number" if unit == SiUnit() else f"in {unit.plain_text}"
    return f"The {quantity} in this element is {unit_text}."


def coefficient_line(symbol: str, coefficient: Coefficient) -> str:
    """Return a determined coefficient, with U and k, in g-units and its SI unit."""
    assert coefficient.value is not None
    assert coefficient.u is not None
    k = coverage_factor(coefficient.dof)
    row = TERMS.get(symbol)
    words = "" if row is None else f"{row.words[:1].upper()}{row.words[1:]}"
    description = "" if row is None else f"{words} ({row.effect.ieee_symbol} in IEEE Std 1293); "
    value_text = unit_remark(si_unit(coefficient.unit)[0])
    estimate = f"{format_in_g_units(coefficient, k)} (U, k = {format_decimal(k)})"
    return f"{description}{symbol} = {estimate}. {value_text}"


def format_in_g_units(coefficient: Coefficient, k: float) -> str:
    """Return a determined coefficient with k u, in the usual unit of the field."""
    assert coefficient.value is not None
    assert coefficient.u is not None
    unit, scale = field_unit(coefficient.unit)
    return format_estimate(coefficient.value * scale, k * coefficient.u * scale, unit)


def undetermined_lines(name: str, accelerometer: AccelerometerResult) -> list[str]:
    """Return a sentence for each coefficient that is not certified, with the reason."""
    return [
        f"{symbol} of {name} is not certified: {undetermined_reason(c)}."
        for symbol, c in accelerometer.coefficients.items()
        if not is_determined(c)
    ]


def undetermined_reason(coefficient: Coefficient) -> str:
    """Return the reason why a coefficient is not certified."""
    if coefficient.value is None:
        return "the records do not determine this coefficient"
    assert coefficient.u is not None
    k = coverage_factor(None)
    known = f"{format_in_g_units(coefficient, k)} (U, k = {format_decimal(k)})"
    return f"the records do not determine this coefficient, and the fit used the prior {known}"


# Conformity


def decision_rule(judged: Conformity) -> str:
    """Return the decision rule of a verdict."""
    text = f"Decision rule: {_RULES[judged.rule]}"
    if judged.guard_band:
        unit, scale = field_unit(judged.unit)
        text += f"; guard band {format_uncertainty(judged.guard_band * scale)} {unit}"
    if judged.needed is not None:
        text += f"; required probability {format_number(judged.needed)}"
    return f"{text}."


def dcc_verdict(judged: Conformity, coefficient: Coefficient | None) -> str | None:
    """Return the verdict as a DCC keyword; None if the DCC has no keyword for it.

    An undecided verdict has a keyword only with a guard band: conditional pass inside the
    tolerance limits, conditional fail outside (ILAC-G8:09/2019, 4.2.3).
    """
    if judged.verdict != "undecided":
        return judged.verdict
    if judged.guard_band is None or judged.rule != "guarded":
        return None
    assert coefficient is not None
    assert coefficient.value is not None
    low, high = judged.low, judged.high
    value = coefficient.value
    within = (low is None or value >= low) and (high is None or value <= high)
    return "conditionalPass" if within else "conditionalFail"


def verdict_sentence(
    symbol: str, name: str, judged: Conformity, coefficient: Coefficient | None = None
) -> str:
    """Return a sentence with the verdict on a coefficient, as the XML states it."""
    word = dcc_verdict(judged, coefficient)
    label = _CONDITIONAL.get(word or "", word) or judged.verdict
    text = f"{symbol} of {name}, specified as {judged.specification}: {label}"
    text += f" ({judged.reason})." if judged.reason else "."
    if judged.probability is not None:
        text += f" Probability of conformity: {format_probability(judged.probability)}"
        if judged.risk is not None:
            wrong = _WRONG_DECISIONS[judged.verdict]
            text += f"; probability of {wrong}: {format_probability(judged.risk)}"
        text += "."
    return text
