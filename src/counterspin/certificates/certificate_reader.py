"""Read the numbers of a certificate from the XML in its file."""

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
from counterspin.certificates.schema import NAMESPACES, Element, parse_xml
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
    """Return whether the file name of a certificate ends in .pdf."""
    return path.suffix.lower() == ".pdf"


def read_document(path: Path) -> bytes:
    """Return the XML of a certificate: the file itself, or the attachment of a PDF.

    A PDF is read in an isolated process.
    """
    if is_pdf(path):
        return run_isolated(_read_attached_xml, path)
    return _read_xml(path)


def verify_pages(path: Path, signer_certificate: bytes) -> PdfSignatureStatus:
    """Verify the signature of a PDF in an isolated process, see `verify_pdf_signature`."""
    return run_isolated(_read_pdf_signature_status, path, signer_certificate)


def _read_xml(path: Path) -> bytes:
    try:
        return read_file(path)
    except OSError as error:
        raise RecordError(
            f"{path}: {describe_read_error(error)}; give the XML or PDF of a certificate",
            code=read_error_code(error),
        ) from error


def _read_attached_xml(path: Path) -> bytes:
    content = _read_xml(path)
    try:
        import pypdf
    except ImportError as error:
        raise MissingPackageError(_PYPDF_MISSING) from error
    try:
        attachments = _xml_attachments(pypdf.PdfReader(io.BytesIO(content)))
    except MemoryError:
        raise
    except Exception as error:  # any error of pypdf and zlib on a damaged file
        raise _damaged_file_error(path, error) from error
    if len(attachments) != 1:
        count_text = "no XML file is" if not attachments else f"{len(attachments)} XML files are"
        raise RecordError(
            f"{path}: {count_text} attached to the PDF, but the PDF of a certificate must have "
            "exactly one",
            code="wrong-document",
        )
    return attachments[0]


def _read_pdf_signature_status(path: Path, signer_certificate: bytes) -> PdfSignatureStatus:
    content = _read_xml(path)
    try:
        return verify_pdf_signature(content, signer_certificate)
    except (CounterspinError, MemoryError):
        raise
    except Exception as error:  # any error of pyHanko on a damaged file
        raise _damaged_file_error(path, error) from error


def _damaged_file_error(path: Path, error: Exception) -> RecordError:
    reason = str(error)[:MAX_REASON_LENGTH] or type(error).__name__
    return DamagedFileError(f"{path} is not a PDF, or it is damaged ({reason})")


def _xml_attachments(reader: Any) -> list[bytes]:
    return [
        bytes(content)
        for name, contents in reader.attachments.items()
        if name.lower().endswith(".xml")
        for content in contents
    ]


_RESULT_PATH: Final = "dcc:measurementResults/dcc:measurementResult"
_GRAVITY_PATH: Final = (
    "dcc:measurementResults//dcc:influenceConditions/dcc:influenceCondition"
    "[dcc:name/dcc:content='Local gravity']/dcc:data/dcc:quantity/si:real/si:value"
)
_REPLACED_ID_PATH: Final = (
    "dcc:administrativeData/dcc:coreData/dcc:reportAmendedSubstituted/dcc:replacedUniqueIdentifier"
)
_AMENDMENT_REASON_PATH: Final = (
    "dcc:administrativeData/dcc:coreData/dcc:previousReport/dcc:description/dcc:content"
)
#: Prefix of a line that names a certificate replaced before the amended one.
EARLIER_PREFIX: Final = "Earlier certificate: "
_QUANTITY_PATH: Final = "dcc:results/dcc:result/dcc:data/dcc:quantity"
_EXPANDED_U_PATH: Final = "si:measurementUncertaintyUnivariate/si:expandedMU"
_COVERAGE_REGION_PATH: Final = (
    "si:measurementUncertaintyMultivariateXMLList/si:ellipsoidalRegionMUXMLList"
)
_COLUMN_PATH: Final = f"{_COVERAGE_REGION_PATH}/si:covarianceMatrixXMLList/si:columnXMLList"
_DOF_PATH: Final = "dcc:measurementMetaData/dcc:metaData/dcc:data/dcc:quantity/si:real/si:value"

#: XPaths of the result of a triad, the corrected output and the parameters.
_NAME_PATH: Final = "dcc:name/dcc:content"
_TRIAD_PATH: Final = (
    f"{_RESULT_PATH}[not(@refId)][starts-with({_NAME_PATH}, '{TRIAD_TITLE_PREFIX}')]"
)
_OUTPUT_FILTER: Final = f"[{_NAME_PATH}='Corrected output']"
_PARAMETER_FILTER: Final = f"[not({_NAME_PATH}='Corrected output')]"
_DATA_PATH: Final = "dcc:data/dcc:quantity"
_EXPANDED_U_LIST_PATH: Final = "si:measurementUncertaintyUnivariateXMLList/si:expandedMUXMLList"

#: Type of a triad's parameter -> unit.
_PARAMETER_UNITS: Final = {"offset": "g", "sensitivity": "g/g", "angle": "rad"}

#: Largest difference between a matrix and its parameters.
_ROUNDING_TOLERANCE: Final = 1e-12


@frozen
class CertifiedAccelerometer:
    """An accelerometer in a certificate, in g-units; the g of the certificate is exact."""

    coefficients: dict[str, Coefficient]  #: Value, u = U/k, degrees of freedom.
    #: Terms and covariance of the coefficients, shape (n, n); empty without a covariance.
    terms: tuple[str, ...]
    covariance: npt.NDArray[np.float64]


@frozen
class CertifiedTriad:
    """Three accelerometers of a certificate that form one sensor, in the same g-units."""

    accelerometers: tuple[str, ...]  #: Names of the three accelerometers.
    parameters: CertifiedAccelerometer  #: Parameters by name, such as ``angle.X.Y``.
    #: Corrected output, matrix (y - bias): matrix, shape (3, 3), expanded uncertainties, coverage
    #: factor, and bias in g, shape (3,); None without a corrected output.
    matrix: npt.NDArray[np.float64] | None = None
    expanded_matrix: npt.NDArray[np.float64] | None = None
    coverage_factor: float | None = None
    bias: npt.NDArray[np.float64] | None = None


@frozen
class CertificateNumbers:
    """The numbers of a certificate; gravity in m/s^2."""

    identifier: str
    gravity: float
    accelerometers: dict[str, CertifiedAccelerometer]
    amended_identifier: str | None = None  #: Identifier of the replaced certificate.
    triad: CertifiedTriad | None = None
    #: Identifiers of all replaced certificates, newest first.
    replaced_identifiers: tuple[str, ...] = ()


def read_certificate(document: bytes, source: str) -> CertificateNumbers:
    """Read the numbers of a certificate that counterspin wrote."""
    root = parse_xml(document, source)
    try:
        gravity = _parse_number(_single_text(root, _GRAVITY_PATH))
        if gravity <= 0.0:
            raise ValueError(f"the local gravity is {gravity:g} m/s^2")
        return CertificateNumbers(
            identifier=_single_text(
                root, "dcc:administrativeData/dcc:coreData/dcc:uniqueIdentifier"
            ),
            gravity=gravity,
            accelerometers={
                _accelerometer_name(root, element): _read_quantities(
                    _select_elements(element, _QUANTITY_PATH), gravity
                )
                for element in _select_elements(root, _RESULT_PATH)
                if element.get("refId")
            },
            amended_identifier=next(
                (_element_text(element) for element in _select_elements(root, _REPLACED_ID_PATH)),
                None,
            ),
            triad=next(
                (_read_triad(element, gravity) for element in _select_elements(root, _TRIAD_PATH)),
                None,
            ),
            replaced_identifiers=tuple(_replaced_identifiers(root)),
        )
    except (ArithmeticError, KeyError, ValueError) as error:
        raise RecordError(
            f"{source} is not a calibration certificate written by counterspin ({error})",
            code="wrong-document",
        ) from error


def _replaced_identifiers(root: Element) -> Iterator[str]:
    """Yield the identifiers of the replaced certificate and of earlier ones, newest first."""
    yield from (_element_text(element) for element in _select_elements(root, _REPLACED_ID_PATH))
    for element in _select_elements(root, _AMENDMENT_REASON_PATH):
        lines = _element_text(element).splitlines()
        yield from (
            line.removeprefix(EARLIER_PREFIX) for line in lines if line.startswith(EARLIER_PREFIX)
        )


def _read_triad(element: Element, gravity: float) -> CertifiedTriad:
    """Read a triad; ValueError if matrix or bias contradict the parameters."""
    names = tuple(_single_text(element, _NAME_PATH).removeprefix(TRIAD_TITLE_PREFIX).split(", "))
    parameters = _read_quantities(
        _select_elements(element, f"dcc:results/dcc:result{_PARAMETER_FILTER}/{_DATA_PATH}"),
        gravity,
    )
    output_elements = _select_elements(
        element, f"dcc:results/dcc:result{_OUTPUT_FILTER}/{_DATA_PATH}/si:realListXMLList"
    )
    if not output_elements:
        return CertifiedTriad(names, parameters)
    matrix_element, bias_element = output_elements
    matrix = np.reshape(_parse_numbers(matrix_element, "si:valueXMLList"), (3, 3))
    bias = _parse_numbers(bias_element, "si:valueXMLList") * from_si(1.0, "g", gravity)
    derived_parameters = _triad_parameters(names, np.linalg.inv(matrix).astype(np.float64), bias)
    for name, coefficient in parameters.coefficients.items():
        if (
            name in derived_parameters
            and abs((coefficient.value or 0.0) - derived_parameters[name]) > _ROUNDING_TOLERANCE
        ):
            raise ValueError(
                f"matrix and offsets give {name} {derived_parameters[name]:.9g}, not "
                f"{coefficient.value}"
            )
    return CertifiedTriad(
        names,
        parameters,
        matrix,
        np.reshape(
            _parse_numbers(matrix_element, f"{_EXPANDED_U_LIST_PATH}/si:valueExpandedMUXMLList"),
            (3, 3),
        ),
        _parse_number(
            _single_text(matrix_element, f"{_EXPANDED_U_LIST_PATH}/si:coverageFactorXMLList")
        ),
        bias,
    )


def _triad_parameters(
    names: Sequence[str], input_axes: npt.NDArray[np.float64], bias: npt.NDArray[np.float64]
) -> dict[str, float]:
    """Return the nine parameters of a triad from its biases and input axes."""
    sensitivities = np.linalg.norm(input_axes, axis=1)
    cosines = (input_axes / sensitivities[:, None]) @ (input_axes / sensitivities[:, None]).T
    return {
        **{f"offset.{name}": float(value) for name, value in zip(names, bias, strict=True)},
        **{
            f"sensitivity.{name}": float(value)
            for name, value in zip(names, sensitivities, strict=True)
        },
        **{
            f"angle.{names[i]}.{names[j]}": math.acos(float(np.clip(cosines[i, j], -1.0, 1.0)))
            for i, j in combinations(range(len(names)), 2)
        },
    }


def _read_quantities(quantities: Sequence[Element], gravity: float) -> CertifiedAccelerometer:
    coefficients = {}
    terms: tuple[str, ...] = ()
    covariance = np.empty((0, 0))
    for quantity in quantities:
        for real_element in _select_elements(quantity, "si:real"):
            if (label := _single_text(real_element, "si:label")) not in OUTPUT_COEFFICIENTS:
                coefficients[label] = _read_coefficient(quantity, real_element, gravity)
        for covariance_element in _select_elements(quantity, "si:realListXMLList"):
            terms = tuple(_single_text(covariance_element, "si:labelXMLList").split())
            covariance = _read_covariance(covariance_element, terms, gravity)
    return CertifiedAccelerometer(coefficients, terms, covariance)


def _read_coefficient(quantity: Element, element: Element, gravity: float) -> Coefficient:
    unit = _label_unit(_single_text(element, "si:label"))
    u = None
    if _select_elements(element, _EXPANDED_U_PATH):
        expanded_u = _parse_number(_single_text(element, f"{_EXPANDED_U_PATH}/si:valueExpandedMU"))
        k = _parse_number(_single_text(element, f"{_EXPANDED_U_PATH}/si:coverageFactor"))
        if expanded_u < 0.0 or k <= 0.0:
            raise ValueError("an expanded uncertainty or its coverage factor is negative")
        u = from_si(expanded_u / k, unit, gravity)
    dof_elements = _select_elements(quantity, _DOF_PATH)
    return Coefficient(
        value=from_si(_parse_number(_single_text(element, "si:value")), unit, gravity),
        u=u,
        dof=_parse_number(_element_text(dof_elements[0])) if dof_elements else None,
        unit=unit,
        estimated=True,
    )


def _read_covariance(
    covariance_element: Element, terms: tuple[str, ...], gravity: float
) -> npt.NDArray[np.float64]:
    si_covariance = np.array(
        [
            [
                _parse_number(_element_text(value))
                for value in _select_elements(column, "si:covarianceXMLList/si:valueXMLList")
            ]
            for column in _select_elements(covariance_element, _COLUMN_PATH)
        ]
    ).T
    unit_factors = np.array([from_si(1.0, _label_unit(symbol), gravity) for symbol in terms])
    if si_covariance.shape != (len(terms), len(terms)):
        raise ValueError("the size of the covariance matrix does not match the length of the list")
    with np.errstate(over="ignore", invalid="ignore"):
        covariance: npt.NDArray[np.float64] = si_covariance * np.outer(unit_factors, unit_factors)
    if not np.all(np.isfinite(covariance)):
        raise ValueError("the covariance matrix contains implausibly large numbers")
    return covariance


def _label_unit(label: str) -> str:
    """Return the unit of a term, of a parameter of a triad, or of a term of a sensor."""
    parameter_type, _, symbol = label.partition(".")
    if parameter_type in _PARAMETER_UNITS and symbol:
        return _PARAMETER_UNITS[parameter_type]
    return TERMS[symbol if symbol in TERMS else label].unit


def _accelerometer_name(root: Element, result_element: Element) -> str:
    """Return the name of the accelerometer in the result, from its item."""
    identification_path = ".//dcc:item[@id=$item]/dcc:identifications/dcc:identification"
    path = f"{identification_path}[dcc:issuer='calibrationLaboratory']/dcc:value"
    return _single_text(root, path, item=result_element.get("refId", ""))


def _parse_number(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text} is not a finite number")
    return number


def _parse_numbers(element: Element, path: str) -> npt.NDArray[np.float64]:
    return np.array([_parse_number(text) for text in _single_text(element, path).split()])


def _select_elements(element: Element, path: str, **variables: str) -> list[Any]:
    return list(element.xpath(path, namespaces=NAMESPACES, **variables))


def _single_text(element: Element, path: str, **variables: str) -> str:
    elements = _select_elements(element, path, **variables)
    if not elements or not _element_text(elements[0]):
        raise ValueError(f"{path.rpartition('/')[2]} is missing")
    return _element_text(elements[0])


def _element_text(element: Element) -> str:
    if len(element):
        # `text` holds only the part before the child.
        raise ValueError(f"{element.tag.rpartition('}')[2]} contains elements other than text")
    return str(element.text or "")
