"""Cases with files: records, campaigns, corrected forces and certificates."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from copy import deepcopy
from datetime import date
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree as ET

import numpy as np

from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import Coefficient
from counterspin.certificates.issuing import certificate
from counterspin.errors import CounterspinError, RecordError
from counterspin.physics.terms import ACCELEROMETER_TERMS
from counterspin.records.format_registry import RECORD_FORMATS
from counterspin.records.record import ColumnSpec, NominalMotion, RecordColumns
from counterspin.records.signals import FirstHarmonic
from counterspin.validation.cases import DATA_FOLDER, load_document

_RECORD_RATE, _RECORD_RADIUS = math.pi, 2.5  #: rate, rad/s, and radius, m, of the records


#: Edits (pattern, replacement) that make a certificate invalid: a decimal comma, a missing and an
#: unknown element.
_INVALID_EDITS: Final = (
    (rb"<si:value>(\d+)\.(\d+)</si:value>", rb"<si:value>\1,\2</si:value>"),
    (rb"<dcc:uniqueIdentifier>.*?</dcc:uniqueIdentifier>", b""),
    (rb"<(/?)dcc:uniqueIdentifier>", rb"<\1dcc:uniqueName>"),
)


class NotAvailableError(CounterspinError):
    """Error of a case that needs a missing optional package or third-party file."""

    code = "missing-package"


def read_record(module: Any, inputs: Mapping[str, Any]) -> dict[str, Any]:
    """Return time, angle and signal of some rows of a record."""
    path = DATA_FOLDER / inputs["file"]
    for package in RECORD_FORMATS[path.suffix].libraries:
        if find_spec(package) is None:
            raise NotAvailableError(
                f"{package} is not installed, but it is required to read {path.suffix}"
            )
    columns = RecordColumns(
        time=ColumnSpec("time_s"),
        angle=ColumnSpec("angle_rad"),
        signals={"Qx": ColumnSpec("east_m")},
    )
    record = module.read_record(
        path, columns, NominalMotion(_RECORD_RATE, {"Qx": FirstHarmonic(_RECORD_RADIUS, "m")})
    )
    rows = inputs["rows"]
    return {
        "time": record.time[rows],
        "angle": record.angle[rows],
        "signal": record.signals["Qx"][rows],
    }


def fitted_values(module: Any, inputs: Mapping[str, Any]) -> dict[str, Any]:
    """Return all numbers of a campaign's result, by name."""
    result = module.calibrate(DATA_FOLDER / inputs["folder"])
    values: dict[str, Any] = {
        symbol: _coefficient_values(coefficient) for symbol, coefficient in result.platform.items()
    }
    for row in result.rests_on:
        if row.found is not None:
            values[f"posterior of {row.name}"] = [row.found - row.value, row.u_found]
    for name, accelerometer in result.accelerometers.items():
        coefficients = {
            f"{name}.{symbol}": coefficient
            for symbol, coefficient in accelerometer.coefficients.items()
        }
        values |= {
            symbol: _coefficient_values(coefficient) for symbol, coefficient in coefficients.items()
        }
        values |= {
            f"degrees of freedom of {symbol}": [coefficient.dof]
            for symbol, coefficient in coefficients.items()
        }
        values |= {
            f"{key} of {name}": [coefficient.value, coefficient.u]
            for key, coefficient in accelerometer.output.items()
        }
        values |= {
            f"{component} noise of {name}": [line.value]
            for component, line in accelerometer.noise.items()
        }
        residual = accelerometer.residual
        values[f"chi-square test of {name}"] = [residual.chi2, residual.dof, residual.lack_of_fit_p]
        for symbol, lines in accelerometer.budget.items():
            for line in lines:
                source = (
                    f"{name}.{line.source}" if line.source in ACCELEROMETER_TERMS else line.source
                )
                values[f"contribution of {source} to {name}.{symbol}"] = [line.contribution]
        if accelerometer.correlation is not None:
            indices = [
                accelerometer.correlation.terms.index(symbol)
                for symbol in sorted(accelerometer.coefficients)
            ]
            matrix = np.array(accelerometer.correlation.matrix)[np.ix_(indices, indices)]
            values[f"correlation of {name}"] = matrix.ravel()
    return {name: np.array(numbers, np.float64) for name, numbers in values.items()}


def _coefficient_values(coefficient: Coefficient) -> list[float | None]:
    return [
        coefficient.value,
        coefficient.u,
        coefficient.u_noise,
        coefficient.u_stated,
        coefficient.u_unstated,
    ]


def check_schema(module: Any, inputs: Mapping[str, Any]) -> dict[str, Any]:
    """Check a certificate and altered certificates against the schema; 1 means valid."""
    if "schema" not in inputs:
        raise NotAvailableError(
            "the DCC schema is not part of the package; name its folder (`schema`)"
        )
    certificate_xml = make_certificate(inputs["file"])

    def conforms(altered_xml: bytes) -> float:
        try:
            module.check_schema(altered_xml, Path(inputs["schema"]), "the certificate of the case")
        except RecordError:
            return 0.0
        return 1.0

    altered_documents = [
        re.sub(pattern, replacement, certificate_xml, flags=re.DOTALL)
        for pattern, replacement in _INVALID_EDITS
    ]
    return {
        "original": conforms(certificate_xml),
        "altered": [conforms(altered_document) for altered_document in altered_documents],
    }


def verify_signatures(module: Any, inputs: Mapping[str, Any]) -> dict[str, Any]:
    """Verify a signature, also with an altered document and another signer; 1 means valid."""
    if find_spec("signxml") is None:
        raise NotAvailableError("signxml is not installed, but it is required to verify signatures")
    folder = DATA_FOLDER / inputs["folder"]
    signed_document = (folder / "signed.xml").read_bytes()

    def is_valid(document: bytes, signer: str) -> float:
        try:
            module.verify(document, folder / signer, "the document of the case")
        except RecordError:
            return 0.0
        return 1.0

    altered_document = signed_document.replace(b"K-2026-0117", b"K-2026-0118")
    return {
        "original": is_valid(signed_document, "signer.pem"),
        "altered": is_valid(altered_document, "signer.pem"),
        "other signer": is_valid(signed_document, "other.pem"),
    }


def certified_estimates(module: Any, inputs: Mapping[str, Any]) -> dict[str, Any]:
    """Return value and u of each term in the certificate of a result."""
    xml = make_certificate(inputs["file"])
    document = module.read_certificate(xml, "the certificate of the case")
    estimates = document.accelerometers[inputs["accelerometer"]].coefficients
    return {symbol: [coefficient.value, coefficient.u] for symbol, coefficient in estimates.items()}


_COEFFICIENT_UNITS: Final = {"K_F": "g", "delta_O": "rad", "delta_P": "rad"}
_SI_NAMESPACE: Final = "{https://ptb.de/si}"

#: Axes of the artificial result's accelerometers on the level platform, rows I, P, O.
_ACCELEROMETER_AXES: Final = {
    "Qx": [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]],
    "Qy": [[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]],
}


def make_certificate(file: str, changes: Mapping[str, Any] | None = None) -> bytes:
    """Return the certificate of a result and a laboratory, as XML.

    changes: Changed fields of the result's accelerometer and inputs.
    """
    document = deepcopy(load_document(file))
    for section, fields in (changes or {}).items():
        document["result"][section] |= fields
    calibration_dates = {
        key: date.fromisoformat(document["lab"]["certificate"][key]) for key in ("begin", "end")
    }
    lab = document["lab"] | {"certificate": document["lab"]["certificate"] | calibration_dates}
    return certificate(Result.model_validate(document["result"]), lab).xml


def certificate_values(_: Any, inputs: Mapping[str, Any]) -> dict[str, Any]:
    """Return value, U and k of each coefficient in a certificate, and the coverage region."""
    accelerometer = load_document(inputs["file"])["result"]["accelerometers"]["Qx"]
    accelerometer = {
        **accelerometer,
        "coefficients": {
            symbol: {**coefficient, "estimated": True}
            for symbol, coefficient in inputs["coefficients"].items()
        },
        "budget": {symbol: [line] for symbol, line in inputs["budget"].items()},
    }
    changes = {"accelerometers": {"Qx": accelerometer}, "inputs": inputs["inputs"]}
    root = ET.fromstring(make_certificate(inputs["file"], changes))
    keys = ("value", "valueExpandedMU", "coverageFactor")
    values: dict[str, Any] = {}
    for real_element in root.iter(f"{_SI_NAMESPACE}real"):
        label = real_element.findtext(f"{_SI_NAMESPACE}label")
        if label is not None:
            values[label] = [
                float(real_element.findtext(f".//{_SI_NAMESPACE}{key}") or "nan") for key in keys
            ]
    region_element = next(root.iter(f"{_SI_NAMESPACE}ellipsoidalRegionMUXMLList"))
    covariance_elements = region_element.iter(f"{_SI_NAMESPACE}covarianceXMLList")
    values["covariance"] = [
        float(element.findtext(f"{_SI_NAMESPACE}valueXMLList") or "nan")
        for element in covariance_elements
    ]
    values["k of the region"] = [
        float(region_element.findtext(f"{_SI_NAMESPACE}coverageFactorXMLList") or "nan")
    ]
    return values


def corrected_forces(module: Any, inputs: Mapping[str, Any]) -> dict[str, Any]:
    """Return corrected specific forces and their standard uncertainties."""
    document = load_document(inputs["file"])
    result = deepcopy(load_document("certified.json")["result"])
    template = result["accelerometers"]["Qx"] | {"known": {}, "budget": {}}
    accelerometers = {}
    for name, table in document["coefficients"].items():
        symbols = list(table)
        correlation_matrix = np.eye(len(symbols))
        for first, second, r in document["correlation"]:
            if {first, second} <= set(symbols):
                i, j = symbols.index(first), symbols.index(second)
                correlation_matrix[i, j] = correlation_matrix[j, i] = float(r)
        coefficients = {
            symbol: {
                "value": float(value),
                "u": float(u),
                "unit": _coefficient_unit(symbol),
                "estimated": True,
            }
            for symbol, (value, u) in table.items()
        }
        correlation = {"terms": symbols, "matrix": correlation_matrix.tolist()}
        accelerometers[name] = template | {
            "coefficients": coefficients,
            "correlation": correlation,
            "axes": _ACCELEROMETER_AXES[name],
        }
    result = Result.model_validate(result | {"accelerometers": accelerometers})
    options = module.ApplyOptions(**inputs["options"])
    correction = module.apply(result, "Qx", inputs["indicated"], options)
    return {"corrected": correction.corrected, "u": correction.u}


def _coefficient_unit(symbol: str) -> str:
    degree = {"K_I": 1, "K_III": 3}.get(symbol, 2)
    return _COEFFICIENT_UNITS.get(symbol, "g/g" if degree == 1 else f"g/g^{degree}")
