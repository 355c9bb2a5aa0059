"""What is read from files: records of every format, and a certificate's numbers.

- `read_record`: rows of a record; `read_back`: a result through its certificate
- `NotAvailableError`: a package is not installed
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import date
from importlib.util import find_spec
from typing import Any, Final

from counterspin.calibration.result import Result
from counterspin.certificates.issuing import certificate
from counterspin.errors import CounterspinError
from counterspin.records.amplitude import Swing
from counterspin.records.record import ColumnSpec, RecordColumns, StatedMotion
from counterspin.validation.cases import DATA, document

#: Ending -> the package without which it is not read.
_NEEDED: Final = {".xlsx": "fastexcel", ".tdms": "nptdms"}

_RATE, _RADIUS = math.pi, 2.5  #: of the records of the cases, rad/s and m


class NotAvailableError(CounterspinError):
    """A case cannot be run: an optional package is not installed."""


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


def read_back(module: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return estimate and u of each term that a result's certificate states."""
    both = document(given["file"])
    dates = {key: date.fromisoformat(both["lab"]["certificate"][key]) for key in ("begin", "end")}
    lab = both["lab"] | {"certificate": both["lab"]["certificate"] | dates}
    made = certificate(Result.model_validate(both["result"]), lab)
    read = module.read_certificate(made.xml, "the certificate of the case")
    found = read.accelerometers[given["accelerometer"]].coefficients
    return {symbol: [c.value, c.u] for symbol, c in found.items()}
