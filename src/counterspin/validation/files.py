"""Case inputs from files and results: records, campaigns, corrected forces, certificates."""

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
from counterspin.validation.cases import DATA, document

_RATE, _RADIUS = math.pi, 2.5  #: rate and radius of the cases' records, rad/s and m


#: Alterations that the schema must refuse: a decimal comma, a missing and an unknown element.
_ALTERATIONS: Final = (
    (rb"<si:value>(\d+)\.(\d+)</si:value>", rb"<si:value>\1,\2</si:value>"),
    (rb"<dcc:uniqueIdentifier>.*?</dcc:uniqueIdentifier>", b""),
    (rb"<(/?)dcc:uniqueIdentifier>", rb"<\1dcc:uniqueName>"),
)


class NotAvailableError(CounterspinError):
    """Error of a case that needs a missing optional package or third-party file."""

    code = "missing-package"


def read_record(module: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return rows of a record's time, angle and signal."""
    path = DATA / given["file"]
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
        path, columns, NominalMotion(_RATE, {"Qx": FirstHarmonic(_RADIUS, "m")})
    )
    rows = given["rows"]
    return {
        "time": record.time[rows],
        "angle": record.angle[rows],
        "signal": record.signals["Qx"][rows],
    }


def fitted_numbers(module: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return all numbers of a campaign's result, by name."""
    result = module.calibrate(DATA / given["folder"])
    values: dict[str, Any] = {
        symbol: _coefficient_values(c) for symbol, c in result.platform.items()
    }
    for row in result.rests_on:
        if row.found is not None:
            values[f"what {row.name} is"] = [row.found - row.value, row.u_found]
    for name, accelerometer in result.accelerometers.items():
        coefficients = {f"{name}.{symbol}": c for symbol, c in accelerometer.coefficients.items()}
        values |= {symbol: _coefficient_values(c) for symbol, c in coefficients.items()}
        values |= {f"degrees of freedom of {symbol}": [c.dof] for symbol, c in coefficients.items()}
        values |= {f"{key} of {name}": [c.value, c.u] for key, c in accelerometer.output.items()}
        values |= {
            f"{component} noise of {name}": [line.value]
            for component, line in accelerometer.noise.items()
        }
        residual = accelerometer.residual
        values[f"misfit of {name}"] = [residual.chi2, residual.dof, residual.lack_of_fit_p]
        for symbol, lines in accelerometer.budget.items():
            for line in lines:
                source = (
                    f"{name}.{line.source}" if line.source in ACCELEROMETER_TERMS else line.source
                )
                values[f"{name}.{symbol} by {source}"] = [line.contribution]
        if accelerometer.correlation is not None:
            indices = [
                accelerometer.correlation.terms.index(s) for s in sorted(accelerometer.coefficients)
            ]
            matrix = np.array(accelerometer.correlation.matrix)[np.ix_(indices, indices)]
            values[f"correlation of {name}"] = matrix.ravel()
    return {name: np.array(values, np.float64) for name, values in values.items()}


def _coefficient_values(c: Coefficient) -> list[float | None]:
    return [c.value, c.u, c.u_noise, c.u_stated, c.u_unstated]


def check_schema(module: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    """Check a certificate, and altered ones, against the schema."""
    if "schema" not in given:
        raise NotAvailableError(
            "the DCC schema is not part of the package; name its folder (`schema`)"
        )
    certificate_xml = make_certificate(given["file"])

    def conforms(document: bytes) -> float:
        try:
            module.check_schema(document, Path(given["schema"]), "the certificate of the case")
        except RecordError:
            return 0.0
        return 1.0

    altered_versions = [
        re.sub(old, new, certificate_xml, flags=re.DOTALL) for old, new in _ALTERATIONS
    ]
    return {
        "as made": conforms(certificate_xml),
        "altered": [conforms(altered) for altered in altered_versions],
    }


def verify(module: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    """Verify the signature of a document, of an altered one, and of another signer."""
    if find_spec("signxml") is None:
        raise NotAvailableError("signxml is not installed, but it is required to verify signatures")
    folder = DATA / given["folder"]
    signed = (folder / "signed.xml").read_bytes()

    def is_valid(document: bytes, signer: str) -> float:
        try:
            module.verify(document, folder / signer, "the document of the case")
        except RecordError:
            return 0.0
        return 1.0

    altered = signed.replace(b"K-2026-0117", b"K-2026-0118")
    return {
        "as signed": is_valid(signed, "signer.pem"),
        "altered": is_valid(altered, "signer.pem"),
        "of another signer": is_valid(signed, "other.pem"),
    }


def read_estimates(module: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return estimate and u of each term that a result's certificate states."""
    certificate_data = module.read_certificate(
        make_certificate(given["file"]), "the certificate of the case"
    )
    coefficients = certificate_data.accelerometers[given["accelerometer"]].coefficients
    return {symbol: [c.value, c.u] for symbol, c in coefficients.items()}


_UNITS: Final = {"K_F": "g", "delta_O": "rad", "delta_P": "rad"}
_SI: Final = "{https://ptb.de/si}"

#: Axes of the artificial result's accelerometers on the level platform, rows I, P, O.
_AXES: Final = {
    "Qx": [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]],
    "Qy": [[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]],
}


def make_certificate(file: str, changes: Mapping[str, Any] | None = None) -> bytes:
    """Return the certificate of a result and a laboratory, as XML.

    changes: Changed fields of the result's accelerometer and inputs.
    """
    data = deepcopy(document(file))
    for section, keys in (changes or {}).items():
        data["result"][section] |= keys
    dates = {key: date.fromisoformat(data["lab"]["certificate"][key]) for key in ("begin", "end")}
    lab = data["lab"] | {"certificate": data["lab"]["certificate"] | dates}
    return certificate(Result.model_validate(data["result"]), lab).xml


def certificate_numbers(_: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a certificate: value, U and k of each coefficient, and the region."""
    accelerometer = document(given["file"])["result"]["accelerometers"]["Qx"]
    accelerometer = {
        **accelerometer,
        "coefficients": {s: {**c, "estimated": True} for s, c in given["coefficients"].items()},
        "budget": {s: [line] for s, line in given["budget"].items()},
    }
    changes = {"accelerometers": {"Qx": accelerometer}, "inputs": given["inputs"]}
    root = ET.fromstring(make_certificate(given["file"], changes))
    keys = ("value", "valueExpandedMU", "coverageFactor")
    values: dict[str, Any] = {}
    for real in root.iter(f"{_SI}real"):
        label = real.findtext(f"{_SI}label")
        if label is not None:
            values[label] = [float(real.findtext(f".//{_SI}{key}") or "nan") for key in keys]
    region = next(root.iter(f"{_SI}ellipsoidalRegionMUXMLList"))
    cells = region.iter(f"{_SI}covarianceXMLList")
    values["covariance"] = [float(c.findtext(f"{_SI}valueXMLList") or "nan") for c in cells]
    values["k of the region"] = [float(region.findtext(f"{_SI}coverageFactorXMLList") or "nan")]
    return values


def corrected_forces(module: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return forces corrected for given coefficients, and their u."""
    case_data, result = document(given["file"]), deepcopy(document("certified.json")["result"])
    template = result["accelerometers"]["Qx"] | {"known": {}, "budget": {}}
    accelerometers = {}
    for name, table in case_data["coefficients"].items():
        symbols = list(table)
        correlation_matrix = np.eye(len(symbols))
        for first, second, r in case_data["correlation"]:
            if {first, second} <= set(symbols):
                i, j = symbols.index(first), symbols.index(second)
                correlation_matrix[i, j] = correlation_matrix[j, i] = float(r)
        coefficients = {
            s: {"value": float(v), "u": float(u), "unit": _coefficient_unit(s), "estimated": True}
            for s, (v, u) in table.items()
        }
        correlation = {"terms": symbols, "matrix": correlation_matrix.tolist()}
        accelerometers[name] = template | {
            "coefficients": coefficients,
            "correlation": correlation,
            "axes": _AXES[name],
        }
    result = Result.model_validate(result | {"accelerometers": accelerometers})
    answer = module.apply(result, "Qx", given["indicated"], module.ApplyOptions(**given["options"]))
    return {"corrected": answer.corrected, "u": answer.u}


def _coefficient_unit(symbol: str) -> str:
    degree = {"K_I": 1, "K_III": 3}.get(symbol, 2)
    return _UNITS.get(symbol, "g/g" if degree == 1 else f"g/g^{degree}")
