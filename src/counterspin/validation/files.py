"""What is read from files: records of every format, a campaign, and a certificate's numbers."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import numpy as np

from counterspin.calibration.result_parts import Coefficient
from counterspin.errors import CounterspinError, RecordError
from counterspin.physics.terms import OWN_TERMS
from counterspin.records.amplitude import Swing
from counterspin.records.record import ColumnSpec, RecordColumns, StatedMotion
from counterspin.validation.cases import DATA
from counterspin.validation.stated import xml_of

#: Ending -> the package without which it is not read.
_NEEDED: Final = {".xlsx": "fastexcel", ".tdms": "nptdms"}

_RATE, _RADIUS = math.pi, 2.5  #: of the records of the cases, rad/s and m


#: What the schema must refuse: a decimal comma, an element that is missing, one that there is not.
_FAULTS: Final = (
    (rb"<si:value>(\d+)\.(\d+)</si:value>", rb"<si:value>\1,\2</si:value>"),
    (rb"<dcc:uniqueIdentifier>.*?</dcc:uniqueIdentifier>", b""),
    (rb"<(/?)dcc:uniqueIdentifier>", rb"<\1dcc:uniqueName>"),
)


class NotAvailableError(CounterspinError):
    """A case cannot be run: an optional package, or a file of others, is not there."""


def read_record(module: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return rows of a record's time, angle and signal."""
    path = DATA / given["file"]
    package = _NEEDED.get(path.suffix)
    if package is not None and find_spec(package) is None:
        raise NotAvailableError(f"{package} is not installed, which reads {path.suffix}")
    columns = RecordColumns(
        time=ColumnSpec("time_s"),
        angle=ColumnSpec("angle_rad"),
        signals={"Qx": ColumnSpec("east_m")},
    )
    record = module.read_record(path, columns, StatedMotion(_RATE, {"Qx": Swing(_RADIUS, "m")}))
    rows = given["rows"]
    return {
        "time": record.time[rows],
        "angle": record.angle[rows],
        "signal": record.signals["Qx"][rows],
    }


def fitted(module: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a campaign's result says of everything, by name."""
    found = module.calibrate(DATA / given["folder"])
    answer: dict[str, Any] = {symbol: _line(c) for symbol, c in found.platform.items()}
    for row in found.rests_on:
        if row.found is not None:
            answer[f"what {row.name} is"] = [row.found - row.value, row.u_found]
    for name, own in found.accelerometers.items():
        asked = {f"{name}.{symbol}": c for symbol, c in own.coefficients.items()}
        answer |= {symbol: _line(c) for symbol, c in asked.items()}
        answer |= {f"degrees of freedom of {symbol}": [c.dof] for symbol, c in asked.items()}
        answer |= {f"{key} of {name}": [c.value, c.u] for key, c in own.output.items()}
        answer |= {f"{part} noise of {name}": [line.value] for part, line in own.noise.items()}
        left = own.residual
        answer[f"misfit of {name}"] = [left.chi2, left.dof, left.lack_of_fit_p]
        for symbol, lines in own.budget.items():
            for line in lines:
                source = f"{name}.{line.source}" if line.source in OWN_TERMS else line.source
                answer[f"{name}.{symbol} by {source}"] = [line.contribution]
        if own.correlation is not None:
            places = [own.correlation.terms.index(s) for s in sorted(own.coefficients)]
            matrix = np.array(own.correlation.matrix)[np.ix_(places, places)]
            answer[f"correlation of {name}"] = matrix.ravel()
    return {name: np.array(values, np.float64) for name, values in answer.items()}


def _line(c: Coefficient) -> list[float | None]:
    return [c.value, c.u, c.u_noise, c.u_stated, c.u_unstated]


def check_schema(module: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return whether a certificate conforms to the schema, and whether altered ones do."""
    if "schema" not in given:
        raise NotAvailableError(
            "the schema of DCC is not part of the package; name its folder (`schema`)"
        )
    made = xml_of(given["file"])

    def conforms(document: bytes) -> float:
        try:
            module.check_schema(document, Path(given["schema"]), "the certificate of the case")
        except RecordError:
            return 0.0
        return 1.0

    wrong = [re.sub(old, new, made, flags=re.DOTALL) for old, new in _FAULTS]
    return {"as made": conforms(made), "altered": [conforms(one) for one in wrong]}


def verify(module: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return whether a signature counts, of the document as it is, altered, and of another."""
    if find_spec("signxml") is None:
        raise NotAvailableError("signxml is not installed, which verifies signatures")
    folder = DATA / given["folder"]
    signed = (folder / "signed.xml").read_bytes()

    def counts(document: bytes, signer: str) -> float:
        try:
            module.verify(document, folder / signer, "the document of the case")
        except RecordError:
            return 0.0
        return 1.0

    altered = signed.replace(b"K-2026-0117", b"K-2026-0118")
    return {
        "as signed": counts(signed, "signer.pem"),
        "altered": counts(altered, "signer.pem"),
        "of another signer": counts(signed, "other.pem"),
    }


def read_back(module: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return estimate and u of each term that a result's certificate states."""
    read = module.read_certificate(xml_of(given["file"]), "the certificate of the case")
    found = read.accelerometers[given["accelerometer"]].coefficients
    return {symbol: [c.value, c.u] for symbol, c in found.items()}
