"""What is made of a result: corrected forces, and the numbers of a certificate."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from datetime import date
from typing import Any, Final
from xml.etree import ElementTree as ET

import numpy as np

from counterspin.calibration.result import Result
from counterspin.certificates.issuing import certificate
from counterspin.validation.cases import document

_UNITS: Final = {"K_F": "g", "delta_O": "rad", "delta_P": "rad"}
_SI: Final = "{https://ptb.de/si}"

#: Of an accelerometer of the made-up result: axes on the level platform, rows I, P, O.
_AXES: Final = {
    "Qx": [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]],
    "Qy": [[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]],
}


def xml_of(file: str, changes: Mapping[str, Any] | None = None) -> bytes:
    """Return the certificate of a result and a laboratory, as XML.

    changes: What is another in the result's accelerometer and inputs.
    """
    both = deepcopy(document(file))
    for part, keys in (changes or {}).items():
        both["result"][part] |= keys
    dates = {key: date.fromisoformat(both["lab"]["certificate"][key]) for key in ("begin", "end")}
    lab = both["lab"] | {"certificate": both["lab"]["certificate"] | dates}
    return certificate(Result.model_validate(both["result"]), lab).xml


def numbers(_: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a certificate states: value, U and k of each coefficient, and all together."""
    own = document(given["file"])["result"]["accelerometers"]["Qx"]
    own = {
        **own,
        "coefficients": {s: {**c, "estimated": True} for s, c in given["coefficients"].items()},
        "budget": {s: [line] for s, line in given["budget"].items()},
    }
    changes = {"accelerometers": {"Qx": own}, "inputs": given["inputs"]}
    root = ET.fromstring(xml_of(given["file"], changes))
    keys = ("value", "valueExpandedMU", "coverageFactor")
    answer: dict[str, Any] = {}
    for real in root.iter(f"{_SI}real"):
        label = real.findtext(f"{_SI}label")
        if label is not None:
            answer[label] = [float(real.findtext(f".//{_SI}{key}") or "nan") for key in keys]
    region = next(root.iter(f"{_SI}ellipsoidalRegionMUXMLList"))
    cells = region.iter(f"{_SI}covarianceXMLList")
    answer["covariance"] = [float(c.findtext(f"{_SI}valueXMLList") or "nan") for c in cells]
    answer["k of the region"] = [float(region.findtext(f"{_SI}coverageFactorXMLList") or "nan")]
    return answer


def corrected(module: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return forces corrected for given coefficients, and their u."""
    stated, result = document(given["file"]), deepcopy(document("certified.json")["result"])
    plain = result["accelerometers"]["Qx"] | {"known": {}, "budget": {}}
    made = {}
    for name, table in stated["coefficients"].items():
        symbols = list(table)
        related = np.eye(len(symbols))
        for one, other, r in stated["correlation"]:
            if {one, other} <= set(symbols):
                i, j = symbols.index(one), symbols.index(other)
                related[i, j] = related[j, i] = float(r)
        coefficients = {
            s: {"value": float(v), "u": float(u), "unit": _unit(s), "estimated": True}
            for s, (v, u) in table.items()
        }
        correlation = {"terms": symbols, "matrix": related.tolist()}
        made[name] = plain | {
            "coefficients": coefficients,
            "correlation": correlation,
            "axes": _AXES[name],
        }
    result = Result.model_validate(result | {"accelerometers": made})
    answer = module.apply(result, "Qx", given["indicated"], module.ApplyOptions(**given["options"]))
    return {"corrected": answer.corrected, "u": answer.u}


def _unit(symbol: str) -> str:
    degree = {"K_I": 1, "K_III": 3}.get(symbol, 2)
    return _UNITS.get(symbol, "g/g" if degree == 1 else f"g/g^{degree}")
