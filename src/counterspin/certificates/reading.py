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
from counterspin.certificates.conversion import OUTPUT, TITLE
from counterspin.certificates.schema import NAMESPACES, Element, parse
from counterspin.certificates.signature import PagesSignature, pages_signature
from counterspin.errors import REASON_LENGTH, CounterspinError, RecordError, installing
from counterspin.frozen import frozen
from counterspin.input import read_file
from counterspin.physics.terms import TERMS
from counterspin.records.isolation import in_reader_process
from counterspin.units import from_si

_PYPDF_MISSING: Final = (
    f"reading a PDF needs the package pypdf, which is not installed: {installing('signature')}"
)


def is_pdf(path: Path) -> bool:
    """Return whether a certificate's file is a PDF, by the ending of its name."""
    return path.suffix.lower() == ".pdf"


def read_document(path: Path) -> bytes:
    """Return the XML of a certificate: the file, or the attachment of a PDF.

    A PDF is read in an isolated process, as records of native formats are.
    """
    if is_pdf(path):
        return in_reader_process(_attached, path)
    return _content(path)


def verify_pages(path: Path, public: bytes) -> PagesSignature:
    """Return the state of the signature of a PDF's pages, as `pages_signature` does."""
    return in_reader_process(_pages_signature, path, public)


def _content(path: Path) -> bytes:
    try:
        return read_file(path)
    except OSError as error:
        raise RecordError(
            f"{path}: cannot be read ({error.strerror}); give the XML or PDF of a certificate"
        ) from error


def _attached(path: Path) -> bytes:
    content = _content(path)
    try:
        import pypdf
    except ImportError as error:
        raise CounterspinError(_PYPDF_MISSING) from error
    try:
        found = _xml_files(pypdf.PdfReader(io.BytesIO(content)))
    except MemoryError:
        raise
    except Exception as error:  # whatever pypdf and zlib raise on a damaged file
        raise _damaged(path, error) from error
    if len(found) != 1:
        held = "no XML file is" if not found else f"{len(found)} XML files are"
        raise RecordError(f"{path}: {held} attached to it; the PDF of a certificate has one")
    return found[0]


def _pages_signature(path: Path, public: bytes) -> PagesSignature:
    content = _content(path)
    try:
        return pages_signature(content, public)
    except (CounterspinError, MemoryError):
        raise
    except Exception as error:  # whatever pyHanko raises on a damaged file
        raise _damaged(path, error) from error


def _damaged(path: Path, error: Exception) -> RecordError:
    reason = str(error)[:REASON_LENGTH] or type(error).__name__
    return RecordError(f"{path}: is not a PDF, or is damaged ({reason})")


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
#: How a line begins that names a certificate which an amended one replaced.
EARLIER: Final = "Earlier certificate: "
_QUANTITY: Final = "dcc:results/dcc:result/dcc:data/dcc:quantity"
_EXPANDED: Final = "si:measurementUncertaintyUnivariate/si:expandedMU"
_REGION: Final = "si:measurementUncertaintyMultivariateXMLList/si:ellipsoidalRegionMUXMLList"
_COLUMN: Final = f"{_REGION}/si:covarianceMatrixXMLList/si:columnXMLList"
_DOF: Final = "dcc:measurementMetaData/dcc:metaData/dcc:data/dcc:quantity/si:real/si:value"

#: The part of a triad, and in it the corrected output and what stands before that.
_NAME: Final = "dcc:name/dcc:content"
_TRIAD: Final = f"{_RESULT}[not(@refId)][starts-with({_NAME}, '{TITLE}')]"
_OUTPUT: Final = f"[{_NAME}='Corrected output']"
_PARAMETERS: Final = f"[not({_NAME}='Corrected output')]"
_DATA: Final = "dcc:data/dcc:quantity"
_EXPANDED_LIST: Final = "si:measurementUncertaintyUnivariateXMLList/si:expandedMUXMLList"

#: Units of a triad's parameters by their kind.
_KINDS: Final = {"offset": "g", "sensitivity": "g/g", "angle": "rad"}

#: A matrix and the parameters it is made of, all in every digit, differ by no more.
_ROUNDING: Final = 1e-12


@frozen
class CertifiedAccelerometer:
    """One accelerometer in a certificate, in g-units of the certificate's g, taken as exact."""

    coefficients: dict[str, Coefficient]  #: Value, u = U/k, degrees of freedom.
    #: Of the coefficients together, shape (n, n); empty where the certificate states none.
    terms: tuple[str, ...]
    covariance: npt.NDArray[np.float64]


@frozen
class CertifiedTriad:
    """Three accelerometers as one sensor in a certificate, in the same g-units."""

    accelerometers: tuple[str, ...]  #: Their names.
    parameters: CertifiedAccelerometer  #: By their names, such as ``angle.X.Y``.
    #: Of the corrected output matrix (y - bias): shape (3, 3), its expanded uncertainties, their
    #: coverage factor, and the bias, g, shape (3,); None where the certificate states none.
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
        gravity = _number(_one(root, _GRAVITY))
        if gravity <= 0.0:
            raise ValueError(f"the local gravity is {gravity:g} m/s^2")
        return CertificateNumbers(
            identifier=_one(root, "dcc:administrativeData/dcc:coreData/dcc:uniqueIdentifier"),
            gravity=gravity,
            accelerometers={
                _designation(root, part): _values(_all(part, _QUANTITY), gravity)
                for part in _all(root, _RESULT)
                if part.get("refId")
            },
            amends=next((_text(element) for element in _all(root, _REPLACED)), None),
            triad=next((_triad(part, gravity) for part in _all(root, _TRIAD)), None),
            replaced=tuple(_replaced(root)),
        )
    except (ArithmeticError, KeyError, ValueError) as error:
        raise RecordError(
            f"{source}: is not a calibration certificate written by counterspin ({error})"
        ) from error


def _replaced(root: Element) -> Iterator[str]:
    """Yield the identifiers of the certificates that a certificate and those before it replaced."""
    yield from (_text(element) for element in _all(root, _REPLACED))
    for element in _all(root, _REASON):
        lines = _text(element).splitlines()
        yield from (line.removeprefix(EARLIER) for line in lines if line.startswith(EARLIER))


def _triad(part: Element, gravity: float) -> CertifiedTriad:
    """Return the parameters of a triad; ValueError if its matrix or bias contradicts them."""
    names = tuple(_one(part, _NAME).removeprefix(TITLE).split(", "))
    parameters = _values(_all(part, f"dcc:results/dcc:result{_PARAMETERS}/{_DATA}"), gravity)
    output = _all(part, f"dcc:results/dcc:result{_OUTPUT}/{_DATA}/si:realListXMLList")
    if not output:
        return CertifiedTriad(names, parameters)
    of_matrix, of_bias = output
    matrix = np.reshape(_numbers(of_matrix, "si:valueXMLList"), (3, 3))
    bias = _numbers(of_bias, "si:valueXMLList") * from_si(1.0, "g", gravity)
    by_them = _parameters(names, np.linalg.inv(matrix).astype(np.float64), bias)
    for name, c in parameters.coefficients.items():
        if name in by_them and abs((c.value or 0.0) - by_them[name]) > _ROUNDING:
            raise ValueError(f"matrix and offsets make {name} {by_them[name]:.9g}, not {c.value}")
    return CertifiedTriad(
        names,
        parameters,
        matrix,
        np.reshape(_numbers(of_matrix, f"{_EXPANDED_LIST}/si:valueExpandedMUXMLList"), (3, 3)),
        _number(_one(of_matrix, f"{_EXPANDED_LIST}/si:coverageFactorXMLList")),
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


def _values(quantities: Sequence[Element], gravity: float) -> CertifiedAccelerometer:
    coefficients = {}
    terms: tuple[str, ...] = ()
    covariance = np.empty((0, 0))
    for quantity in quantities:
        for real in _all(quantity, "si:real"):
            if (label := _one(real, "si:label")) not in OUTPUT:  # which is of no other value
                coefficients[label] = _coefficient(quantity, real, gravity)
        for together in _all(quantity, "si:realListXMLList"):
            terms = tuple(_one(together, "si:labelXMLList").split())
            covariance = _covariance(together, terms, gravity)
    return CertifiedAccelerometer(coefficients, terms, covariance)


def _coefficient(quantity: Element, real: Element, gravity: float) -> Coefficient:
    unit = _unit(_one(real, "si:label"))
    u = None
    if _all(real, _EXPANDED):
        expanded = _number(_one(real, f"{_EXPANDED}/si:valueExpandedMU"))
        k = _number(_one(real, f"{_EXPANDED}/si:coverageFactor"))
        if expanded < 0.0 or k <= 0.0:
            raise ValueError("an expanded uncertainty is negative, or its coverage factor is")
        u = from_si(expanded / k, unit, gravity)
    dof = _all(quantity, _DOF)
    return Coefficient(
        value=from_si(_number(_one(real, "si:value")), unit, gravity),
        u=u,
        dof=_number(_text(dof[0])) if dof else None,
        unit=unit,
        estimated=True,
    )


def _covariance(
    together: Element, terms: tuple[str, ...], gravity: float
) -> npt.NDArray[np.float64]:
    in_si = np.array(
        [
            [
                _number(_text(value))
                for value in _all(column, "si:covarianceXMLList/si:valueXMLList")
            ]
            for column in _all(together, _COLUMN)
        ]
    ).T
    scale = np.array([from_si(1.0, _unit(symbol), gravity) for symbol in terms])
    if in_si.shape != (len(terms), len(terms)):
        raise ValueError("the covariance matrix has another size than the list")
    with np.errstate(over="ignore", invalid="ignore"):
        covariance: npt.NDArray[np.float64] = in_si * np.outer(scale, scale)
    if not np.all(np.isfinite(covariance)):
        raise ValueError("the covariance matrix contains excessive numbers")
    return covariance


def _unit(label: str) -> str:
    """Return the unit of a term, of a triad's parameter, or of a term of one of its sensors."""
    kind, _, rest = label.partition(".")
    if kind in _KINDS and rest:
        return _KINDS[kind]
    return TERMS[rest if rest in TERMS else label].unit


def _designation(root: Element, part: Element) -> str:
    """Return the accelerometer's name in the result, from its item."""
    item = ".//dcc:item[@id=$item]/dcc:identifications/dcc:identification"
    path = f"{item}[dcc:issuer='calibrationLaboratory']/dcc:value"
    return _one(root, path, item=part.get("refId", ""))


def _number(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text} is not a finite number")
    return number


def _numbers(element: Element, path: str) -> npt.NDArray[np.float64]:
    return np.array([_number(word) for word in _one(element, path).split()])


def _all(element: Element, path: str, **variables: str) -> list[Any]:
    return list(element.xpath(path, namespaces=NAMESPACES, **variables))


def _one(element: Element, path: str, **variables: str) -> str:
    matches = _all(element, path, **variables)
    if not matches or not _text(matches[0]):
        raise ValueError(f"there is no {path.rpartition('/')[2]}")
    return _text(matches[0])


def _text(element: Element) -> str:
    if len(element):
        # Only what stands before it would be read.
        raise ValueError(f"there is something other than text in {element.tag.rpartition('}')[2]}")
    return str(element.text or "")
