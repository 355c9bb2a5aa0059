"""The numbers of a certificate, read back from its XML."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from counterspin.calibration.result_parts import Coefficient
from counterspin.certificates.conversion import OUTPUT
from counterspin.certificates.elements import NAMESPACES, Element
from counterspin.certificates.schema import parse
from counterspin.errors import RecordError
from counterspin.frozen import frozen
from counterspin.physics.si_units import from_si
from counterspin.physics.terms import TERMS

_RESULT: Final = "dcc:measurementResults/dcc:measurementResult"
_GRAVITY: Final = (
    "dcc:measurementResults//dcc:influenceConditions/dcc:influenceCondition"
    "[dcc:name/dcc:content='Local gravity']/dcc:data/dcc:quantity/si:real/si:value"
)
_REPLACED: Final = (
    "dcc:administrativeData/dcc:coreData/dcc:reportAmendedSubstituted/dcc:replacedUniqueIdentifier"
)
_QUANTITY: Final = "dcc:results/dcc:result/dcc:data/dcc:quantity"
_EXPANDED: Final = "si:measurementUncertaintyUnivariate/si:expandedMU"
_REGION: Final = "si:measurementUncertaintyMultivariateXMLList/si:ellipsoidalRegionMUXMLList"
_COLUMN: Final = f"{_REGION}/si:covarianceMatrixXMLList/si:columnXMLList"
_DOF: Final = "dcc:measurementMetaData/dcc:metaData/dcc:data/dcc:quantity/si:real/si:value"


@frozen
class CertifiedAccelerometer:
    """One accelerometer in a certificate, in g-units of the certificate's g, taken as exact."""

    coefficients: dict[str, Coefficient]  #: Value, u = U/k, degrees of freedom.
    #: Of the coefficients together, shape (n, n); empty where the certificate states none.
    terms: tuple[str, ...]
    covariance: npt.NDArray[np.float64]


@frozen
class Certified:
    """The numbers of a certificate; gravity in m/s^2; `amends` identifies the one it replaces."""

    identifier: str
    gravity: float
    accelerometers: dict[str, CertifiedAccelerometer]
    amends: str | None = None


def read_certificate(document: bytes, source: str) -> Certified:
    """Read the numbers of a certificate that counterspin wrote."""
    root = parse(document, source)
    try:
        gravity = _number(_one(root, _GRAVITY))
        if gravity <= 0.0:
            raise ValueError(f"the local gravity is {gravity:g} m/s^2")
        return Certified(
            identifier=_one(root, "dcc:administrativeData/dcc:coreData/dcc:uniqueIdentifier"),
            gravity=gravity,
            accelerometers={
                _designation(root, part): _accelerometer(part, gravity)
                for part in _all(root, _RESULT)
                if part.get("refId")
            },
            amends=next((_text(element) for element in _all(root, _REPLACED)), None),
        )
    except (ArithmeticError, KeyError, ValueError) as error:
        raise RecordError(
            f"{source}: is not a calibration certificate written by counterspin ({error})"
        ) from error


def _accelerometer(part: Element, gravity: float) -> CertifiedAccelerometer:
    coefficients = {}
    terms: tuple[str, ...] = ()
    covariance = np.empty((0, 0))
    for quantity in _all(part, _QUANTITY):
        for real in _all(quantity, "si:real"):
            if (label := _one(real, "si:label")) not in OUTPUT:  # which is of no other value
                coefficients[label] = _coefficient(quantity, real, gravity)
        for together in _all(quantity, "si:realListXMLList"):
            terms = tuple(_one(together, "si:labelXMLList").split())
            covariance = _covariance(together, terms, gravity)
    return CertifiedAccelerometer(coefficients, terms, covariance)


def _coefficient(quantity: Element, real: Element, gravity: float) -> Coefficient:
    unit = TERMS[_one(real, "si:label")].unit
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
    scale = np.array([from_si(1.0, TERMS[symbol].unit, gravity) for symbol in terms])
    if in_si.shape != (len(terms), len(terms)):
        raise ValueError("the covariance matrix has another size than the list")
    with np.errstate(over="ignore", invalid="ignore"):
        covariance: npt.NDArray[np.float64] = in_si * np.outer(scale, scale)
    if not np.all(np.isfinite(covariance)):
        raise ValueError("the covariance matrix holds numbers beyond measure")
    return covariance


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
        raise ValueError(f"something else than text stands in {element.tag.rpartition('}')[2]}")
    return str(element.text or "")
