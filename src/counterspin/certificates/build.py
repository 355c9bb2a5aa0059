"""Build the Digital Calibration Certificate (DCC 3.3.0) of a result from a template.

Numbers have all digits of a double, so that software reads exactly the computed values.
`significantDigit` gives the digit for rounding; numbers in the text are rounded.
"""

from __future__ import annotations

import math
import re
from base64 import b64encode
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources
from typing import Any, Final

from jinja2 import Environment, StrictUndefined, Template
from lxml import etree
from markupsafe import Markup

from counterspin._version import __version__
from counterspin.calibration.findings import judge_result, refusal_reason
from counterspin.calibration.pages.methods import group_readings
from counterspin.calibration.pages.triad import parameter_description
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import Correlation
from counterspin.calibration.si_estimates import SiEstimate
from counterspin.certificates import certificate_text
from counterspin.certificates.amendment import HASH_ALGORITHM, amendment_reasons
from counterspin.certificates.certificate_text import coverage_factor, region_factor
from counterspin.certificates.conversion import (
    apply_cmc_floor,
    certified_triad,
    coefficients_in_si,
    covariance,
    matrix_dof,
    output_coefficients_in_si,
    parameter_line,
    triad_output_lines,
    triad_parameters_in_si,
    triad_title,
)
from counterspin.certificates.lab import ITEM_STATES, Lab
from counterspin.certificates.schema import (
    DCC_NAMESPACE,
    NAMESPACES,
    Element,
    clean_text,
    format_decimal,
    format_exact,
)
from counterspin.certificates.statements import (
    Issue,
    Verdicts,
    accelerometer_item_id,
    certificate_statements,
)
from counterspin.errors import RecordError
from counterspin.inference.distributions import COVERAGE, MIN_INTERVAL_DOF
from counterspin.physics.terms import SHARED_TERMS
from counterspin.reports.numbers import round_to_uncertainty
from counterspin.units import SiUnit, si_unit, to_si

SCHEMA_VERSION: Final = "3.3.0"


def check_certifiable(result: Result, names: Sequence[str]) -> None:
    """Raise RecordError if a result must not be certified."""
    if result.model == "as-printed":
        raise RecordError(
            "this result was computed with the paper's equations as printed, which yield half "
            "the true K_II; calibrate again with the exact model",
            code="as-printed",
        )
    if (refusal_text := refusal_reason(judge_result(result), names)) is not None:
        raise RecordError(refusal_text, code="contradicted")
    coefficient_sets = (result.accelerometers[name].coefficients.values() for name in names)
    if not any(
        certificate_text.is_determined(coefficient)
        for coefficients in coefficient_sets
        for coefficient in coefficients
    ):
        raise RecordError(
            f"the records do not determine any coefficient of {', '.join(names)}, so nothing "
            "can be certified",
            code="not-determined",
        )
    for name in names:
        for symbol, coefficient in result.accelerometers[name].coefficients.items():
            dof = math.inf if coefficient.dof is None else coefficient.dof
            if coefficient.estimated and dof < MIN_INTERVAL_DOF:
                raise RecordError(
                    f"{name}.{symbol} has less than one degree of freedom, so its expanded "
                    "uncertainty cannot be certified; state the uncertainty of the readings, or "
                    "take more readings",
                    code="not-determined",
                )


def build_document(
    result: Result,
    lab: Lab,
    issue: Issue,
    verdicts: Verdicts,
    pages: bytes | None,
    original: Result | None = None,
) -> Element:
    """Build the certificate of a result that `check_certifiable` accepts; return the root element.

    verdicts: Conformity of the certified coefficients.
    pages: Certificate as PDF, or None.
    original: Unmodified result of the file, if it differs from `result`.
    """
    names, certified_result = lab.certified_names(result), apply_cmc_floor(result, lab)
    xml_text = _load_template().render(
        version=__version__,
        schema_version=SCHEMA_VERSION,
        namespaces=NAMESPACES,
        lab=lab,
        settings=lab.certificate,
        issue=issue,
        result=certified_result,
        file=(original or result).content,
        names=names,
        statements=certificate_statements(lab, result, certified_result, issue, verdicts),
        inputs=[f"{file} {checksum}" for file, checksum in result.provenance.shown],
        rates=_reading_rates(certified_result),
        platform={
            symbol: coefficient
            for symbol, coefficient in certified_result.platform.items()
            if symbol in SHARED_TERMS and certificate_text.is_determined(coefficient)
        },
        joint_covariance=_joint_covariance(certified_result, names),
        triad=certified_triad(certified_result, names),
        warnings=_warning_lines(result, names),
        pages=pages,
    )
    return _parse_rendered(xml_text)


def render_extension(template: str, **context: Any) -> Element:
    """Render a template that extends the template of certificates; return the root element.

    template: Text of a template that extends `base`.
    context: Variables of the template and of the administrative data.
    """
    base_template = _load_template()
    extension = base_template.environment.from_string(template)
    constants = {"version": __version__, "schema_version": SCHEMA_VERSION, "namespaces": NAMESPACES}
    return _parse_rendered(extension.render(base=base_template, **constants, **context))


def _parse_rendered(xml_text: str) -> Element:
    """Parse a rendered template; return the root element without superfluous attributes."""
    parser = etree.XMLParser(remove_blank_text=True, huge_tree=True, resolve_entities=False)
    root = etree.fromstring(xml_text.encode(), parser)
    _remove_unreferenced_ids(root)
    _remove_single_languages(root)
    etree.indent(root, " ")
    return root


def serialize_document(root: Element) -> bytes:
    """Serialize a document to XML."""
    xml: bytes = etree.tostring(root, encoding="UTF-8", xml_declaration=True)
    return xml + b"\n"


@cache
def _load_template() -> Template:
    # `finalize` cleans plain strings; macros return Markup, which is already clean.
    environment = Environment(
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=lambda value: clean_text(value) if type(value) is str else value,
    )
    environment.filters |= {
        "paragraphs": lambda lines: Markup("\n").join(map(clean_text, lines)),
        "number": format_exact,
        "factor": format_decimal,
        "times": lambda values, factor: [value * factor for value in values],
        "plainly": certificate_text.replace_plus_minus,
        "base64": lambda content: b64encode(content).decode("ascii"),
    }
    environment.globals |= {
        "certificate_text": certificate_text,
        "HASH_ALGORITHM": HASH_ALGORITHM,
        "amendment_reasons": amendment_reasons,
        "COVERAGE": COVERAGE,
        "ITEM_STATES": ITEM_STATES,
        "SHARED_TERMS": SHARED_TERMS,
        "ONE": SiUnit().dsi_text,
        "coverage_factor": coverage_factor,
        "significant_digit": _significant_digit,
        "dcc_version": _dcc_version,
        "si": lambda unit: si_unit(unit)[0].dsi_text,
        "to_si": to_si,
        "coefficients_in_si": coefficients_in_si,
        "output_coefficients_in_si": output_coefficients_in_si,
        "covariance_data": _covariance_context,
        "triad_title": triad_title,
        "triad_parameters_in_si": triad_parameters_in_si,
        "triad_output": triad_output_lines,
        "matrix_dof": matrix_dof,
        "parameter_line": parameter_line,
        "parameter_words": parameter_description,
        "item_id": accelerometer_item_id,
    }
    assets = resources.files("counterspin.certificates") / "assets"
    return environment.from_string((assets / "certificate.xml.jinja").read_text(encoding="utf-8"))


def _dcc_version(version: str) -> str:
    """Return the release of a version in the form required by the DCC, such as v1.2.3."""
    match = re.match(r"\d{1,3}(\.\d{1,3}){0,3}", version)
    return f"v{match[0] if match else version}"


def _significant_digit(value: float, u: float) -> int | None:
    rounded_value = round_to_uncertainty(value, u)
    return None if rounded_value is None else rounded_value.last_digit


def _reading_rates(result: Result) -> list[tuple[str, float]]:
    """Return name and rate, rad/s, of each reading during rotation."""
    readings = (reading for group in group_readings(result).values() for reading in group)
    return list(dict.fromkeys((reading.name, reading.rate) for reading in readings if reading.rate))


def _joint_covariance(result: Result, names: Sequence[str]) -> dict[str, Any] | None:
    """Return the covariance between accelerometers due to g, radius and platform."""
    if len(names) < 2:
        return None
    return _covariance_context(
        result.correlation,
        {
            f"{name}.{symbol}": estimate
            for name in names
            for symbol, estimate in coefficients_in_si(result, name).items()
        },
    )


def _covariance_context(
    correlation: Correlation | None, estimates: Mapping[str, SiEstimate]
) -> dict[str, Any] | None:
    """Return template data of the covariance of the coefficients; None for fewer than two."""
    symbols = [
        symbol for symbol in (correlation.terms if correlation else ()) if symbol in estimates
    ]
    if correlation is None or len(symbols) < 2:
        return None
    # The smallest degrees of freedom give a conservative region.
    dof = min(
        (finite_dof for symbol in symbols if (finite_dof := estimates[symbol].dof) is not None),
        default=None,
    )
    return {
        "symbols": symbols,
        "values": [estimates[symbol].value for symbol in symbols],
        "units": [estimates[symbol].unit.dsi_text for symbol in symbols],
        "columns": [
            [
                (
                    covariance(correlation, estimates, row, column),
                    (estimates[row].unit * estimates[column].unit).dsi_text,
                )
                for row in symbols
            ]
            for column in symbols
        ],
        "dof": dof,
        "factor": region_factor(len(symbols), dof),
    }


def _warning_lines(result: Result, names: Sequence[str]) -> list[str]:
    """Return all warnings of the calibration for the certificate."""
    lines = list(result.warnings)
    if result.accepted_misfit is not None:
        lines.append(f"The misfit was accepted for this reason: {result.accepted_misfit}")
    for name in names:
        lines += [
            warning if warning.startswith(name) else f"{name}: {warning}"
            for warning in result.accelerometers[name].warnings
        ]
    return [f"Warning: {certificate_text.replace_plus_minus(line)}" for line in lines]


def _remove_unreferenced_ids(root: Element) -> None:
    """Remove each id without a reference, as required by the rules of PTB."""
    referenced_ids = {name for element in root.iter() for name in element.get("refId", "").split()}
    for element in root.iter():
        if element.get("id") not in {None, *referenced_ids}:
            del element.attrib["id"]


def _remove_single_languages(root: Element) -> None:
    """Remove the language of texts if the document uses two languages.

    The rules of PTB require text in every used language, or text without a language.
    """
    n_languages = len(list(root.iter(f"{{{DCC_NAMESPACE}}}usedLangCodeISO639_1")))
    for content in root.iter(f"{{{DCC_NAMESPACE}}}content"):
        if n_languages > 1:
            content.attrib.pop("lang", None)
