"""Build the Digital Calibration Certificate (DCC 3.3.0) of a result from a template.

Numbers have all digits of a double, so that a machine reads back the computed values.
`significantDigit` gives the digit to round to; numbers in the accompanying text are rounded.
"""

from __future__ import annotations

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
from counterspin.calibration.pages.methods import readings_of
from counterspin.calibration.pages.triad import parameter_words
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
    output_lines,
    parameter_line,
    triad_parameters_in_si,
    triad_title,
)
from counterspin.certificates.lab import ITEM_STATES, Lab
from counterspin.certificates.schema import (
    DCC,
    NAMESPACES,
    Element,
    clean_text,
    format_decimal,
    format_exact,
)
from counterspin.certificates.statements import Issue, Verdicts, item_id, statements
from counterspin.errors import RecordError
from counterspin.inference.distributions import COVERAGE
from counterspin.physics.terms import SHARED_TERMS
from counterspin.reports.numbers import round_to_uncertainty
from counterspin.units import SiUnit, si_unit, to_si

SCHEMA_VERSION: Final = "3.3.0"


def check_certifiable(result: Result, names: Sequence[str]) -> None:
    """Raise RecordError if a result must not be certified; judge it if necessary."""
    if result.model == "as-printed":
        raise RecordError(
            "this result was computed with the paper's equations as printed, which yield half "
            "the true K_II; calibrate again with the exact model",
            code="as-printed",
        )
    if (refused := refusal_reason(judge_result(result), names)) is not None:
        raise RecordError(refused, code="contradicted")
    by_accelerometer = (result.accelerometers[name].coefficients.values() for name in names)
    if not any(
        certificate_text.is_determined(c) for coefficients in by_accelerometer for c in coefficients
    ):
        raise RecordError(
            f"the records do not determine any coefficient of {', '.join(names)}, so nothing "
            "can be certified",
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
    """Return the root element of the certificate of a result that `check_certifiable` accepts.

    verdicts: Conformity of the certified coefficients.
    pages: The certificate as PDF, or None.
    original: The unmodified result of the file, if it differs from `result`.
    """
    names, stated = lab.certified(result), apply_cmc_floor(result, lab)
    written = _template().render(
        version=__version__,
        schema_version=SCHEMA_VERSION,
        namespaces=NAMESPACES,
        lab=lab,
        settings=lab.certificate,
        issue=issue,
        result=stated,
        file=(original or result).content,
        names=names,
        statements=statements(lab, result, stated, issue, verdicts),
        inputs=[f"{file} {checksum}" for file, checksum in result.provenance.shown],
        rates=_reading_rates(stated),
        platform={
            symbol: c
            for symbol, c in stated.platform.items()
            if symbol in SHARED_TERMS and certificate_text.is_determined(c)
        },
        joint_covariance=_joint_covariance(stated, names),
        triad=certified_triad(stated, names),
        warnings=_warnings(result, names),
        pages=pages,
    )
    return _parse_rendered(written)


def render_extension(template: str, **context: Any) -> Element:
    """Return the root element of a document whose template extends that of certificates.

    template: Text of a template that extends `base`.
    context: Variables of the template, and those of the administrative data.
    """
    base = _template()
    extension = base.environment.from_string(template)
    shared = {"version": __version__, "schema_version": SCHEMA_VERSION, "namespaces": NAMESPACES}
    return _parse_rendered(extension.render(base=base, **shared, **context))


def _parse_rendered(written: str) -> Element:
    """Return the root element of a rendered template, without superfluous attributes."""
    parser = etree.XMLParser(remove_blank_text=True, huge_tree=True, resolve_entities=False)
    root = etree.fromstring(written.encode(), parser)
    _remove_unreferenced_ids(root)
    _remove_single_languages(root)
    etree.indent(root, " ")
    return root


def to_bytes(root: Element) -> bytes:
    """Return the document as bytes for a file."""
    written: bytes = etree.tostring(root, encoding="UTF-8", xml_declaration=True)
    return written + b"\n"


@cache
def _template() -> Template:
    # `finalize` cleans plain strings; the output of macros is Markup, which is clean already.
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
        "times": lambda values, by: [value * by for value in values],
        "plainly": certificate_text.replace_plus_minus,
        "base64": lambda data: b64encode(data).decode("ascii"),
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
        "covariance_data": _covariance_data,
        "triad_title": triad_title,
        "triad_parameters_in_si": triad_parameters_in_si,
        "triad_output": output_lines,
        "matrix_dof": matrix_dof,
        "parameter_line": parameter_line,
        "parameter_words": parameter_words,
        "item_id": item_id,
    }
    assets = resources.files("counterspin.certificates") / "assets"
    return environment.from_string((assets / "certificate.xml.jinja").read_text(encoding="utf-8"))


def _dcc_version(version: str) -> str:
    """Return a version's release in the form that the DCC requires, such as v1.2.3."""
    match = re.match(r"\d{1,3}(\.\d{1,3}){0,3}", version)
    return f"v{match[0] if match else version}"


def _significant_digit(value: float, u: float) -> int | None:
    rounded = round_to_uncertainty(value, u)
    return None if rounded is None else rounded.place


def _reading_rates(result: Result) -> list[tuple[str, float]]:
    """Return name and rate in rad/s of each reading that was taken during rotation."""
    all_readings = (
        motion_readings for readings in readings_of(result).values() for motion_readings in readings
    )
    return list(
        dict.fromkeys((reading.name, reading.rate) for reading in all_readings if reading.rate)
    )


def _joint_covariance(result: Result, names: Sequence[str]) -> dict[str, Any] | None:
    """Return the covariance across accelerometers, caused by g, radius and platform."""
    if len(names) < 2:
        return None
    return _covariance_data(
        result.correlation,
        {
            f"{name}.{symbol}": estimate
            for name in names
            for symbol, estimate in coefficients_in_si(result, name).items()
        },
    )


def _covariance_data(
    correlation: Correlation | None, estimates: Mapping[str, SiEstimate]
) -> dict[str, Any] | None:
    """Return the covariance of the certified coefficients, if there are two or more."""
    symbols = [s for s in (correlation.terms if correlation else ()) if s in estimates]
    if correlation is None or len(symbols) < 2:
        return None
    # Use the smallest degrees of freedom: the region is then too large rather than too small.
    dof = min((d for s in symbols if (d := estimates[s].dof) is not None), default=None)
    return {
        "symbols": symbols,
        "values": [estimates[s].value for s in symbols],
        "units": [estimates[s].unit.dsi_text for s in symbols],
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


def _warnings(result: Result, names: Sequence[str]) -> list[str]:
    """Return all warnings of the calibration, which the certificate must state."""
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
    """Remove each id without a reference, as PTB's rules require."""
    named = {name for element in root.iter() for name in element.get("refId", "").split()}
    for element in root.iter():
        if element.get("id") not in {None, *named}:
            del element.attrib["id"]


def _remove_single_languages(root: Element) -> None:
    """Remove the language of text that exists in only one of two languages.

    PTB's rules require text in every language that is used, or text without a language.
    """
    used = len(list(root.iter(f"{{{DCC}}}usedLangCodeISO639_1")))
    for content in root.iter(f"{{{DCC}}}content"):
        if used > 1:
            content.attrib.pop("lang", None)
