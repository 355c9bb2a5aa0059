"""Coverage factors and sentences of a certificate, for the XML and the pages."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Final

from counterspin.calibration.pages.accelerometer import confounded_sentences
from counterspin.calibration.pages.methods import (
    describe_tests,
    group_readings,
    model_blocks,
    unknown_poses,
)
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import AccelerometerResult, Coefficient
from counterspin.certificates.evidence import describe_source
from counterspin.certificates.lab import CertificateSettings, Equipment
from counterspin.certificates.schema import format_decimal
from counterspin.inference.distributions import COVERAGE, expanded_uncertainty
from counterspin.inference.verdicts import Conformity
from counterspin.physics.grades import GRADES
from counterspin.physics.terms import TABLE, TERMS, find_symbol
from counterspin.reports.blocks import Paragraph
from counterspin.reports.numbers import (
    find_display_unit,
    format_estimate,
    format_number,
    format_probability,
    format_share,
    format_uncertainty,
)
from counterspin.units import SiUnit, si_unit

#: Decimals of a coverage factor, so that U/k gives the standard uncertainty to the last digit.
#: Rounding changes the coverage by less than 1e-5.
_FACTOR_DECIMALS: Final = 4


def coverage_factor(dof: float | None) -> float:
    """Return k of the interval value ± k u for degrees of freedom (None: infinite)."""
    return round(expanded_uncertainty(1.0, dof, COVERAGE), _FACTOR_DECIMALS)


def region_factor(n_quantities: int, dof: float | None) -> float:
    """Return k of the region d' V^-1 d <= k^2 of quantities with covariance V.

    dof: Degrees of freedom of the common scale of V; None: infinite.
    """
    from scipy.special import chdtri, fdtri

    squared_factor = (
        chdtri(n_quantities, 1.0 - COVERAGE)
        if dof is None
        else n_quantities * fdtri(n_quantities, dof, COVERAGE)
    )
    return round(math.sqrt(float(squared_factor)), _FACTOR_DECIMALS)


#: ``(a ± b) x 1e4``: value, uncertainty, power.
_ESTIMATE_PATTERN: Final = re.compile(r"\((\S+) ± (\S+)\) (x 1e-?\d+)")

#: Smallest share of u^2 for which a source is named separately.
MIN_NAMED_SHARE: Final = 0.01

_METHOD_NAMES: Final = {
    "joint": "Joint weighted least squares",
    "two-stage": "Two-stage fit with the exact observation model",
}

_RULE_DESCRIPTIONS: Final = {
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

#: Statement of a draft.
DRAFT_STATEMENT: Final = (
    "DRAFT. The laboratory data are incomplete. This document is not a certificate and "
    "certifies nothing."
)

#: Relation of the method to the standard.
STANDARD_STATEMENT: Final = (
    "The coefficients are based on the terms of IEEE Std 1293, but they do not follow this "
    "standard, because they are not normalised by K_I (IEEE Std 1293: K2 = K_II/K_I)."
)

#: Disclaimer required by ISO/IEC 17025:2017, 7.8.2.2.
CUSTOMER_DISCLAIMER: Final = (
    "These data were supplied by the customer and can affect the validity of the results. The "
    "laboratory is not responsible for these data."
)

# Headings of the statements, in the XML and on the pages.
UNCERTAINTY_HEADING: Final = "Measurement uncertainty"
UNITS_HEADING: Final = "Units"
TRACEABILITY_HEADING: Final = "Metrological traceability"
EQUIPMENT_HEADING: Final = "Equipment and traceability"
CAPABILITY_HEADING: Final = "Calibration and measurement capability"
BASIS_HEADING: Final = "Basis of the result"
PRIOR_INFORMATION_HEADING: Final = "Prior information"
FIXED_TERMS_HEADING: Final = "Terms fixed at nominal values, with evidence"
DEFAULT_EVIDENCE_HEADING: Final = "Evidence for default uncertainties"
CUSTOMER_DATA_HEADING: Final = "Data supplied by the customer"
CONFORMITY_HEADING: Final = "Conformity"
REMARKS_HEADING: Final = "Remarks"
SCOPE_HEADING: Final = "Scope"

#: DCC verdict -> plain English.
_CONDITIONAL_VERDICTS: Final = {
    "conditionalPass": "conditional pass",
    "conditionalFail": "conditional fail",
}
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
    """Return the definition of the expanded uncertainty."""
    return (
        "The number after ± is the expanded uncertainty U. U is the combined standard uncertainty, "
        "evaluated according to the GUM (JCGM 100), multiplied by the stated coverage factor k. "
        f"The coverage probability is {format_share(COVERAGE)}. The factor k is the quantile of "
        "Student's t-distribution for the effective degrees of freedom (Welch-Satterthwaite), or "
        "of the normal distribution if the degrees of freedom are infinite. Quantities without a "
        "value in the campaign contribute to U, and to probabilities of conformity, with their "
        "default standard uncertainties. Terms fixed at nominal values contribute to neither; they "
        f'are listed under "{FIXED_TERMS_HEADING}". The XML gives the numbers to full computed '
        "precision."
    )


def unit_statement(gravity: float) -> str:
    """Return a statement on the value of g and the conversion between g-units and SI."""
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
    """Return the statement on the calibrated items and on reproduction (ISO/IEC 17025 7.8.2.1)."""
    return (
        "The results relate only to the items calibrated, in the state and under the conditions "
        "stated. This certificate must not be reproduced except in full without the written "
        "approval of the laboratory."
    )


def replace_plus_minus(sentence: str) -> str:
    """Replace "±" by "u =" in a sentence; in a certificate, "±" precedes only U."""
    edited_sentence = _ESTIMATE_PATTERN.sub(r"\1 \3, u = \2 \3", sentence)
    return edited_sentence.replace(" ± ", ", u = ")


# The method


def method_name(result: Result) -> str:
    """Return the method's name."""
    return _METHOD_NAMES.get(result.method, result.method)


def test_lines(result: Result) -> list[str]:
    """Return a sentence for each test type of the item."""
    if group_readings(result) or unknown_poses(result):
        return list(describe_tests(result))
    return [
        "The item was mounted on a double-turntable centrifuge and rotated at the stated rates."
    ]


def method_lines(result: Result) -> list[str]:
    """Return sentences on the tests and on the model of the accelerometers."""
    return [
        *test_lines(result),
        *(block.text for block in model_blocks(result) if isinstance(block, Paragraph)),
    ]


def deviation_lines(settings: CertificateSettings) -> list[str]:
    """Return the deviations from the procedure (ISO/IEC 17025 7.8.2.1 n)."""
    return [f"Deviation: {deviation}" for deviation in settings.deviations]


def equipment_lines(equipment: Equipment) -> list[str]:
    """Return the stated quantity, calibration and due date of measuring equipment."""
    value_by_label = {
        "Quantity": equipment.quantity,
        "Calibration certificate": equipment.certificate,
        "Calibrated by": equipment.calibrated_by,
        "Next calibration due": equipment.due,
    }
    return [f"{label}: {value}." for label, value in value_by_label.items() if value is not None]


def customer_lines(settings: CertificateSettings) -> list[str]:
    """Return the data from the customer with the disclaimer; empty without data."""
    return [*settings.customer_data, CUSTOMER_DISCLAIMER] if settings.customer_data else []


def prior_lines(name: str, result: Result, settings: CertificateSettings) -> list[str]:
    """Return sentences on the prior information in the budgets of an accelerometer.

    settings: Table [certificate] of the laboratory file; quantities in `customer_data` are marked.
    """
    lines = {
        line.source: line
        for lines in result.accelerometers[name].budget.values()
        for line in lines
        if line.kind in ("stated", "held")
    }
    words = {word for entry in settings.customer_data for word in re.findall(r"[\w.]+", entry)}
    sentences = []
    for symbol, line in lines.items():
        unit, scale = find_display_unit(line.unit)
        u_text = ""
        if line.u:
            u_text = f", standard uncertainty {format_uncertainty(line.u * scale)} {unit}"
        supplier_text = ", supplied by the customer" if symbol.rpartition(" ")[2] in words else ""
        sentences.append(f"Prior for {name}: {describe_source(symbol)}{u_text}{supplier_text}.")
    return sentences


def assumption_lines(name: str, result: Result) -> list[str]:
    """Return sentences on confounded terms and on terms with a default uncertainty.

    Advice on a smaller uncertainty is left to the report.
    """
    accelerometer = result.accelerometers[name]
    sentences = list(map(replace_plus_minus, confounded_sentences(accelerometer)))
    sentence_by_source = dict[str, str]()
    budget = [line for lines in accelerometer.budget.values() for line in lines]
    for line in sorted(budget, key=lambda line: line.share):
        if line.kind == "unstated" and line.u and line.share >= MIN_NAMED_SHARE:
            sentence_by_source.pop(line.source, None)
            unit, scale = find_display_unit(line.unit)
            uncertainty_text = f"{format_uncertainty(line.u * scale)} {unit}"
            sentence_by_source[line.source] = (
                f"Default prior: {describe_source(line.source)}, standard uncertainty "
                f"{uncertainty_text}{_default_reference(line.source, line.u)}; contribution to the "
                f"variance at most {format_share(line.share)}."
            )
    return [*sentences, *reversed(sentence_by_source.values())]


def _default_reference(source: str, u: float) -> str:
    """Return the reference of a default uncertainty; empty if the campaign states it."""
    table_row = TABLE.get(find_symbol(source))
    priors = [] if table_row is None else [table_row.sizes(grade) for grade in GRADES]
    return next((f" ({prior.source})" for prior in priors if math.isclose(prior.typical, u)), "")


def seal_lines(result: Result, acceptance_reason: str | None) -> list[str]:
    """Return the statement on a result without a seal; empty for a sealed result.

    acceptance_reason: Reason for certifying the result without a seal.
    """
    if result.sealed:
        return []
    return [
        "The result file has no seal, so later changes to the file cannot be excluded. "
        "counterspin re-evaluated the state of the result from the numbers in the file.",
        *(
            []
            if acceptance_reason is None
            else [f"The missing seal was accepted for this reason: {acceptance_reason}"]
        ),
    ]


def misfit_lines(result: Result, names: Sequence[str]) -> list[str]:
    """Return the contradictions between result and records, and the reason for acceptance."""
    if result.accepted_misfit is None:
        return []
    contradictions = [
        replace_plus_minus(f"{name}: {result.accelerometers[name].findings[0].text}")
        for name in names
        if result.accelerometers[name].state == "contradicted"
    ]
    return [
        *(f"The result failed the quality checks. {line}" for line in contradictions),
        f"The misfit was accepted for this reason: {result.accepted_misfit}",
    ]


# Coefficients


def output_lines(accelerometer: AccelerometerResult) -> dict[str, str]:
    """Return key -> sentence on bias or scale factor in the unit of the readings."""
    lines = {}
    for key, coefficient in accelerometer.output.items():
        if not is_determined(coefficient):
            continue
        assert coefficient.u is not None
        k = coverage_factor(coefficient.dof)
        estimate_text = format_estimate(coefficient.value, k * coefficient.u, coefficient.unit)
        quantity_text = {
            "bias": "bias (K0 times K1 of IEEE Std 1293)",
            "scale_factor": "scale factor K1",
        }[key]
        lines[key] = (
            f"In the unit of the readings, the {quantity_text} is {estimate_text} (U, k = "
            f"{format_decimal(k)})."
        )
    return lines


def unit_remark(unit: SiUnit, quantity: str = "value") -> str:
    """Return a remark on the unit of a quantity."""
    unit_text = "a dimensionless number" if unit == SiUnit() else f"in {unit.plain_text}"
    return f"The {quantity} in this element is {unit_text}."


def coefficient_line(symbol: str, coefficient: Coefficient) -> str:
    """Return a line on a determined coefficient with U and k in g-units, and the SI unit."""
    assert coefficient.value is not None
    assert coefficient.u is not None
    k = coverage_factor(coefficient.dof)
    term_row = TERMS.get(symbol)
    term_words = "" if term_row is None else f"{term_row.words[:1].upper()}{term_row.words[1:]}"
    description = (
        ""
        if term_row is None
        else f"{term_words} ({term_row.effect.ieee_symbol} in IEEE Std 1293); "
    )
    remark = unit_remark(si_unit(coefficient.unit)[0])
    estimate_text = f"{format_in_g_units(coefficient, k)} (U, k = {format_decimal(k)})"
    return f"{description}{symbol} = {estimate_text}. {remark}"


def format_in_g_units(coefficient: Coefficient, k: float) -> str:
    """Format a determined coefficient with k u, in the usual unit of the field."""
    assert coefficient.value is not None
    assert coefficient.u is not None
    unit, scale = find_display_unit(coefficient.unit)
    return format_estimate(coefficient.value * scale, k * coefficient.u * scale, unit)


def undetermined_lines(name: str, accelerometer: AccelerometerResult) -> list[str]:
    """Return a sentence for each coefficient that is not certified, with the reason."""
    return [
        f"{symbol} of {name} is not certified: {undetermined_reason(coefficient)}."
        for symbol, coefficient in accelerometer.coefficients.items()
        if not is_determined(coefficient)
    ]


def undetermined_reason(coefficient: Coefficient) -> str:
    """Return the reason why a coefficient is not certified."""
    if coefficient.value is None:
        return "the records do not determine this coefficient"
    assert coefficient.u is not None
    k = coverage_factor(None)
    prior_text = f"{format_in_g_units(coefficient, k)} (U, k = {format_decimal(k)})"
    return f"the records do not determine this coefficient, and the fit used the prior {prior_text}"


# Conformity


def decision_rule_sentence(conformity: Conformity) -> str:
    """Return a sentence with the decision rule of a verdict."""
    text = f"Decision rule: {_RULE_DESCRIPTIONS[conformity.rule]}"
    if conformity.guard_band:
        unit, scale = find_display_unit(conformity.unit)
        text += f"; guard band {format_uncertainty(conformity.guard_band * scale)} {unit}"
    if conformity.needed is not None:
        text += f"; required probability {format_number(conformity.needed)}"
    return f"{text}."


def dcc_verdict(conformity: Conformity, coefficient: Coefficient | None) -> str | None:
    """Return the verdict as a DCC keyword; None if the DCC has no keyword for it.

    An undecided verdict has a keyword only with a guard band: conditional pass inside the
    tolerance limits, conditional fail outside (ILAC-G8:09/2019, 4.2.3).
    """
    if conformity.verdict != "undecided":
        return conformity.verdict
    if conformity.guard_band is None or conformity.rule != "guarded":
        return None
    assert coefficient is not None
    assert coefficient.value is not None
    low, high = conformity.low, conformity.high
    value = coefficient.value
    is_within_limits = (low is None or value >= low) and (high is None or value <= high)
    return "conditionalPass" if is_within_limits else "conditionalFail"


def verdict_sentence(
    symbol: str, name: str, conformity: Conformity, coefficient: Coefficient | None = None
) -> str:
    """Return sentences with the verdict on a coefficient and its probabilities."""
    keyword = dcc_verdict(conformity, coefficient)
    verdict_text = _CONDITIONAL_VERDICTS.get(keyword or "", keyword) or conformity.verdict
    text = f"{symbol} of {name}, specified as {conformity.specification}: {verdict_text}"
    text += f" ({conformity.reason})." if conformity.reason else "."
    if conformity.probability is not None:
        text += f" Probability of conformity: {format_probability(conformity.probability)}"
        if conformity.risk is not None:
            wrong_decision = _WRONG_DECISIONS[conformity.verdict]
            text += f"; probability of {wrong_decision}: {format_probability(conformity.risk)}"
        text += "."
    return text
