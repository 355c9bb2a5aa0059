"""Read the numbers of a certificate from the XML that its file carries."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from counterspin.calibration.result_parts import Coefficient
from counterspin.certificates.conversion import OUTPUT_COEFFICIENTS, TRIAD_TITLE_PREFIX
from counterspin.certificates.schema import NAMESPACES, Element, parse
from counterspin.certificates.signature import PdfSignatureStatus, verify_pdf_signature
from counterspin.errors import (
    MAX_REASON_LENGTH,
    CounterspinError,
    DamagedFileError,
    MissingPackageError,
    RecordError,
    describe_read_error,
    install_command,
    read_error_code,
)
from counterspin.frozen import frozen
from counterspin.input import read_file
from counterspin.physics.terms import TERMS
from counterspin.records.isolation import run_isolated
from counterspin.units import from_si

_PYPDF_MISSING: Final = (
    "reading a PDF requires the package pypdf, which is not installed: "
    f"{install_command('signature')}"
)


def is_pdf(path: Path) -> bool:
    """Return whether a certificate's file is a PDF, by the ending of its name."""
    return path.suffix.lower() == ".pdf"


def read_document(path: Path) -> bytes:
    """Return the XML of a certificate: the file, or the attachment of a PDF.

    A PDF is read in an isolated process, as records of native formats are.
    """
    if is_pdf(path):
        return run_isolated(_attached_xml, path)
    return _read_xml(path)


def verify_pages(path: Path, public: bytes) -> PdfSignatureStatus:
    """Return the state of a PDF's signature, as `verify_pdf_signature` does."""
    return run_isolated(_pdf_signature_status, path, public)


def _read_xml(path: Path) -> bytes:
    try:
        return read_file(path)
    except OSError as error:
        raise RecordError(
            f"{path}: {describe_read_error(error)}; give the XML or PDF of a certificate",
            code=read_error_code(error),
        ) from error


def _attached_xml(path: Path) -> bytes:
    content = _read_xml(path)
    try:
        import pypdf
    except ImportError as error:
        raise MissingPackageError(_PYPDF_MISSING) from error
    try:
        attachments = _xml_files(pypdf.PdfReader(io.BytesIO(content)))
    except MemoryError:
        raise
    except Exception as error:  # any error of pypdf and zlib on a damaged file
        raise _damage_error(path, error) from error
    if len(attachments) != 1:
        own_data = "no XML file is" if not attachments else (f"{len(attachments)} XML files are")
        raise RecordError(
            (
                f"{path}: {own_data} attached to the PDF, but the PDF of a certificate must have "
                "exactly one"
            ),
            code="wrong-document",
        )
    return attachments[0]


def _pdf_signature_status(path: Path, public: bytes) -> PdfSignatureStatus:
    content = _read_xml(path)
    try:
        return verify_pdf_signature(content, public)
    except (CounterspinError, MemoryError):
        raise
    except Exception as error:  # any error of pyHanko on a damaged file
        raise _damage_error(path, error) from error


def _damage_error(path: Path, error: Exception) -> RecordError:
    reason = str(error)[:MAX_REASON_LENGTH] or type(error).__name__
    return DamagedFileError(f"{path} is not a PDF, or it is damaged ({reason})")


def _xml_files(reader: Any) -> list[bytes]:
    return [
        bytes(data)
        for name, versions in reader.attachments.items()
        if name.lower().endswith(".xml")
        for data in versions
    ]


_RESULT: Final = "dcc:measurementResults/dcc:measurementResult"
_GRAVITY: Final = (
    "dcc:measurementResults//dcc:influenceConditions/dcc:influenceCondition"
    "[dcc:name/dcc:content='Local gravity']/dcc:data/dcc:quantity/si:real/si:value"
)
_REPLACED: Final = (
    "dcc:administrativeData/dcc:coreData/dcc:reportAmendedSubstituted/dcc:replacedUniqueIdentifier"
)
_REASON: Final = (
    "dcc:administrativeData/dcc:coreData/dcc:previousReport/dcc:description/dcc:content"
)
#: Prefix of a line that names a certificate replaced before the amended one.
EARLIER_PREFIX: Final = "Earlier certificate: "
_QUANTITY: Final = "dcc:results/dcc:result/dcc:data/dcc:quantity"
_EXPANDED: Final = "si:measurementUncertaintyUnivariate/si:expandedMU"
_REGION: Final = "si:measurementUncertaintyMultivariateXMLList/si:ellipsoidalRegionMUXMLList"
_COLUMN: Final = f"{_REGION}/si:covarianceMatrixXMLList/si:columnXMLList"
_DOF: Final = "dcc:measurementMetaData/dcc:metaData/dcc:data/dcc:quantity/si:real/si:value"

#: XPath of a triad's result, and in it of the corrected output and of the parameters.
_NAME: Final = "dcc:name/dcc:content"
_TRIAD: Final = f"{_RESULT}[not(@refId)][starts-with({_NAME}, '{TRIAD_TITLE_PREFIX}')]"
_OUTPUT: Final = f"[{_NAME}='Corrected output']"
_PARAMETERS: Final = f"[not({_NAME}='Corrected output')]"
_DATA: Final = "dcc:data/dcc:quantity"
_EXPANDED_LIST: Final = "si:measurementUncertaintyUnivariateXMLList/si:expandedMUXMLList"

#: Type of a triad's parameter -> unit.
_KINDS: Final = {"offset": "g", "sensitivity": "g/g", "angle": "rad"}

#: Largest difference between a matrix and its parameters, which both have all digits.
_ROUNDING: Final = 1e-12


@frozen
class CertifiedAccelerometer:
    """One accelerometer in a certificate, in g-units of the certificate's g, taken as exact."""

    coefficients: dict[str, Coefficient]  #: Value, u = U/k, degrees of freedom.
    #: Terms and covariance of the coefficients, shape (n, n); empty if the certificate has none.
    terms: tuple[str, ...]
    covariance: npt.NDArray[np.float64]


@frozen
class CertifiedTriad:
    """Three accelerometers as one sensor in a certificate, in the same g-units."""

    accelerometers: tuple[str, ...]  #: Names of the three accelerometers.
    parameters: CertifiedAccelerometer  #: Parameters by name, such as ``angle.X.Y``.
    #: Corrected output, matrix (y - bias): matrix, shape (3, 3), expanded uncertainties, their
    #: coverage factor, and bias in g, shape (3,); None if the certificate has none.
    matrix: npt.NDArray[np.float64] | None = None
    expanded: npt.NDArray[np.float64] | None = None
    factor: float | None = None
    bias: npt.NDArray[np.float64] | None = None


@frozen
class CertificateNumbers:
    """The numbers of a certificate; gravity in m/s^2; `amends` identifies the one it replaces."""

    identifier: str
    gravity: float
    accelerometers: dict[str, CertifiedAccelerometer]
    amends: str | None = None
    triad: CertifiedTriad | None = None
    #: Identifiers of all certificates that this one and those before it replaced, newest first.
    replaced: tuple[str, ...] = ()


def read_certificate(document: bytes, source: str) -> CertificateNumbers:
    """Read the numbers of a certificate that counterspin wrote."""
    root = parse(document, source)
    try:
        gravity = _parse_number(_single_text(root, _GRAVITY))
        if gravity <= 0.0:
            raise ValueError(f"the local gravity is {gravity:g} m/s^2")
        return CertificateNumbers(
            identifier=_single_text(
                root, "dcc:administrativeData/dcc:coreData/dcc:uniqueIdentifier"
            ),
            gravity=gravity,
            accelerometers={
                _accelerometer_name(root, part): _read_values(_select(part, _QUANTITY), gravity)
                for part in _select(root, _RESULT)
                if part.get("refId")
            },
            amends=next((_text(element) for element in _select(root, _REPLACED)), None),
            triad=next((_read_triad(part, gravity) for part in _select(root, _TRIAD)), None),
            replaced=tuple(_replaced_identifiers(root)),
        )
    except (ArithmeticError, KeyError, ValueError) as error:
        raise RecordError(
            f"{source} is not a calibration certificate written by counterspin ({error})",
            code="wrong-document",
        ) from error


def _replaced_identifiers(root: Element) -> Iterator[str]:
    """Yield the identifiers of the certificates that a certificate and those before it replaced."""
    yield from (_text(element) for element in _select(root, _REPLACED))
    for element in _select(root, _REASON):
        lines = _text(element).splitlines()
        yield from (
            line.removeprefix(EARLIER_PREFIX) for line in lines if line.startswith(EARLIER_PREFIX)
        )


def _read_triad(part: Element, gravity: float) -> CertifiedTriad:
    """Return the parameters of a triad; ValueError if its matrix or bias contradicts them."""
    names = tuple(_single_text(part, _NAME).removeprefix(TRIAD_TITLE_PREFIX).split(", "))
    parameters = _read_values(
        _select(part, f"dcc:results/dcc:result{_PARAMETERS}/{_DATA}"), gravity
    )
    output = _select(part, f"dcc:results/dcc:result{_OUTPUT}/{_DATA}/si:realListXMLList")
    if not output:
        return CertifiedTriad(names, parameters)
    matrix_values, bias_values = output
    matrix = np.reshape(_parse_numbers(matrix_values, "si:valueXMLList"), (3, 3))
    bias = _parse_numbers(bias_values, "si:valueXMLList") * from_si(1.0, "g", gravity)
    from_outputs = _parameters(names, np.linalg.inv(matrix).astype(np.float64), bias)
    for name, c in parameters.coefficients.items():
        if name in from_outputs and abs((c.value or 0.0) - from_outputs[name]) > _ROUNDING:
            raise ValueError(
                f"matrix and offsets give {name} {from_outputs[name]:.9g}, not {c.value}"
            )
    return CertifiedTriad(
        names,
        parameters,
        matrix,
        np.reshape(
            _parse_numbers(matrix_values, f"{_EXPANDED_LIST}/si:valueExpandedMUXMLList"), (3, 3)
        ),
        _parse_number(_single_text(matrix_values, f"{_EXPANDED_LIST}/si:coverageFactorXMLList")),
        bias,
    )


def _parameters(
    names: Sequence[str], rows: npt.NDArray[np.float64], bias: npt.NDArray[np.float64]
) -> dict[str, float]:
    """Return a triad's nine parameters from the input axes of its accelerometers."""
    sizes = np.linalg.norm(rows, axis=1)
    cosine = (rows / sizes[:, None]) @ (rows / sizes[:, None]).T
    return {
        **{f"offset.{name}": float(value) for name, value in zip(names, bias, strict=True)},
        **{f"sensitivity.{name}": float(value) for name, value in zip(names, sizes, strict=True)},
        **{
            f"angle.{names[a]}.{names[b]}": math.acos(float(np.clip(cosine[a, b], -1.0, 1.0)))
            for a, b in combinations(range(len(names)), 2)
        },
    }


def _read_values(quantities: Sequence[Element], gravity: float) -> CertifiedAccelerometer:
    coefficients = {}
    terms: tuple[str, ...] = ()
    covariance = np.empty((0, 0))
    for quantity in quantities:
        for real in _select(quantity, "si:real"):
            if (label := _single_text(real, "si:label")) not in OUTPUT_COEFFICIENTS:
                coefficients[label] = _read_coefficient(quantity, real, gravity)
        for covariance_element in _select(quantity, "si:realListXMLList"):
            terms = tuple(_single_text(covariance_element, "si:labelXMLList").split())
            covariance = _read_covariance(covariance_element, terms, gravity)
    return CertifiedAccelerometer(coefficients, terms, covariance)


def _read_coefficient(quantity: Element, real: Element, gravity: float) -> Coefficient:
    unit = _unit(_single_text(real, "si:label"))
    u = None
    if _select(real, _EXPANDED):
        expanded = _parse_number(_single_text(real, f"{_EXPANDED}/si:valueExpandedMU"))
        k = _parse_number(_single_text(real, f"{_EXPANDED}/si:coverageFactor"))
        if expanded < 0.0 or k <= 0.0:
            raise ValueError("an expanded uncertainty or its coverage factor is negative")
        u = from_si(expanded / k, unit, gravity)
    dof = _select(quantity, _DOF)
    return Coefficient(
        value=from_si(_parse_number(_single_text(real, "si:value")), unit, gravity),
        u=u,
        dof=_parse_number(_text(dof[0])) if dof else None,
        unit=unit,
        estimated=True,
    )


def _read_covariance(
    covariance_element: Element, terms: tuple[str, ...], gravity: float
) -> npt.NDArray[np.float64]:
    in_si = np.array(
        [
            [
                _parse_number(_text(value))
                for value in _select(column, "si:covarianceXMLList/si:valueXMLList")
            ]
            for column in _select(covariance_element, _COLUMN)
        ]
    ).T
    scale = np.array([from_si(1.0, _unit(symbol), gravity) for symbol in terms])
    if in_si.shape != (len(terms), len(terms)):
        raise ValueError("the size of the covariance matrix does not match the length of the list")
    with np.errstate(over="ignore", invalid="ignore"):
        covariance: npt.NDArray[np.float64] = in_si * np.outer(scale, scale)
    if not np.all(np.isfinite(covariance)):
        raise ValueError("the covariance matrix contains implausibly large numbers")
    return covariance


def _unit(label: str) -> str:
    """Return the unit of a term, of a triad's parameter, or of a term of one of its sensors."""
    kind, _, symbol = label.partition(".")
    if kind in _KINDS and symbol:
        return _KINDS[kind]
    return TERMS[symbol if symbol in TERMS else label].unit


def _accelerometer_name(root: Element, part: Element) -> str:
    """Return the name of the accelerometer in the result, from its item."""
    item = ".//dcc:item[@id=$item]/dcc:identifications/dcc:identification"
    path = f"{item}[dcc:issuer='calibrationLaboratory']/dcc:value"
    return _single_text(root, path, item=part.get("refId", ""))


def _parse_number(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text} is not a finite number")
    return number


def _parse_numbers(element: Element, path: str) -> npt.NDArray[np.float64]:
    return np.array([_parse_number(word) for word in _single_text(element, path).split()])


def _select(element: Element, path: str, **variables: str) -> list[Any]:
    return list(element.xpath(path, namespaces=NAMESPACES, **variables))


def _single_text(element: Element, path: str, **variables: str) -> str:
    matches = _select(element, path, **variables)
    if not matches or not _text(matches[0]):
        raise ValueError(f"{path.rpartition('/')[2]} is missing")
    return _text(matches[0])


def _text(element: Element) -> str:
    if len(element):
        # `text` holds only the part before the child.
        raise ValueError(f"{element.tag.rpartition('}')[2]} contains elements other than text")
    return str(element.text or "")
