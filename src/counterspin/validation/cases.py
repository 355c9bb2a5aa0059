"""Reference cases: inputs, expected values, their sources, and limits.

They are data, in ``data/cases.json``; the project's tests use the same.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache, cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np

from counterspin.arrays import Array
from counterspin.errors import CounterspinError
from counterspin.frozen import frozen
from counterspin.physics.terms import PLATFORM_TERMS, TERMS

DATA: Final = Path(__file__).parent / "data"


@frozen
class Case:
    """A reference case of the validation."""

    name: str  #: Unique name.
    requirement: str  #: Subject, such as physics, spindle, least squares.
    kernel: str  #: The function under test, as ``module:name``.
    source: str  #: Where the expected values come from: document and place, closed form, or script.
    given: Mapping[str, Any]  #: Inputs of the function.
    #: Expected values by name; None: `given` names the file with them.
    stated: Mapping[str, Any] | None
    #: Tolerances, relative and absolute; they add up. `absolute` may be a number, or by name; None:
    #: it is in the file with the expected values.
    relative: float
    absolute: float | Mapping[str, Any] | None

    @cached_property
    def expected(self) -> Mapping[str, Array]:
        """Expected values, name -> values of any shape; CounterspinError if they are missing."""
        kernel = self.kernel.rpartition(":")[2]
        stated = _REFERENCES[kernel](self.given) if self.stated is None else self.stated
        return {name: np.array(values, np.float64) for name, values in stated.items()}

    def tolerance(self, name: str) -> Array:
        """Return the tolerance of each number of a name, in the shape of `expected`."""
        bound = _fit_entry(self.given)["limits"] if self.absolute is None else self.absolute
        size = bound if isinstance(bound, float | int) else bound[name]
        return np.asarray(size) + self.relative * np.abs(self.expected[name])


@cache
def document(name: str) -> Any:
    """Return a JSON document of the folder, which callers must not modify."""
    return json.loads((DATA / name).read_text(encoding="utf-8"))


@cache
def cases() -> tuple[Case, ...]:
    """Return all cases, in the order of their requirements."""
    return tuple(_parse_case(entry) for entry in document("cases.json")["cases"])


def case(name: str) -> Case:
    """Return a case by its name; raise KeyError if it does not exist."""
    return {candidate.name: candidate for candidate in cases()}[name]


def _parse_case(entry: Mapping[str, Any]) -> Case:
    return Case(
        name=entry["name"],
        requirement=entry["requirement"],
        kernel=entry["kernel"],
        source=entry["source"],
        given=entry["given"],
        stated=entry["expected"],
        relative=entry["limit"].get("relative", 0.0),
        absolute=entry["limit"].get("absolute", 0.0),
    )


# Expected values in separate files, computed by scripts in 40-digit arithmetic.


def select_motion(given: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the case of the file of integrals that a given label names."""
    motions = document(given["file"])["cases"]
    return next(motion for motion in motions if motion["label"] == given["label"])


def compared_integrals(given: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return mounting -> symbols of the compared integrals: `terms`, or all except `without`."""
    motion = select_motion(given)
    integrals = motion[given["observable"]]["QX"] if motion.get("platform") else ()
    platform = [symbol for symbol in PLATFORM_TERMS if symbol in integrals]
    symbols = [symbol for symbol, row in TERMS.items() if not row.effect.requires_rotation]
    compared = given.get("terms", [*symbols, *platform])
    compared = [symbol for symbol in compared if symbol not in given.get("without", ())]
    return dict.fromkeys(motion[given["observable"]], compared)


def compared_forces(given: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the positions on an arm, at one rate, whose force the file states."""
    return [
        position
        for position in document(given["file"])["cases"]
        if position["rate"] == given["rate"]
    ]


def _integrals(given: Mapping[str, Any]) -> dict[str, Any]:
    table = select_motion(given)[given["observable"]]
    expected = {}
    for mounting, symbols in compared_integrals(given).items():
        for symbol in symbols:
            key = TERMS[symbol].effect.text if symbol in TERMS else symbol
            if key not in table[mounting]:
                raise CounterspinError(
                    f"{given['file']} does not contain the integral of {symbol} along {mounting} "
                    f'for the motion "{given["label"]}"; generate it with the script in '
                    "tests/reference",
                    code="validation-failed",
                )
            sign = -1.0 if symbol == "delta_P" else 1.0
            values = np.array(table[mounting][key], np.float64)
            expected[f"{symbol} of {mounting}"] = sign * values
    return expected


def _angles(given: Mapping[str, Any]) -> dict[str, Any]:
    return {"angle": select_motion(given)["angle"]}


def _forces(given: Mapping[str, Any]) -> dict[str, Any]:
    key = "arm" if given["file"] == "axis_tilt.json" else "force"
    return {"force": [position[key] for position in compared_forces(given)]}


def _certified_values(given: Mapping[str, Any]) -> dict[str, Any]:
    accelerometer = document(given["file"])["result"]["accelerometers"][given["accelerometer"]]
    return {s: [c["value"], c["u"]] for s, c in accelerometer["coefficients"].items()}


def _fit_entry(given: Mapping[str, Any]) -> Any:
    """Return the entry of a campaign in the file of fits."""
    return document(given["file"])[given["fit"]]


def _fitted_values(given: Mapping[str, Any]) -> Any:
    return _fit_entry(given)["expected"]


def _noise_levels(given: Mapping[str, Any]) -> dict[str, Any]:
    return {key: document(given["file"])[key] for key in ("white", "random_walk", "gain")}


def _script_values(given: Mapping[str, Any]) -> Any:
    return document(given["expected"])[given["part"]]


_REFERENCES: Final = {
    "columns": _integrals,
    "Spindle.angle": _angles,
    "Stations.forces": _forces,
    "read_certificate": _certified_values,
    "calibrate": _fitted_values,
    "certificate": _script_values,
    "apply": _script_values,
    "estimate_noise": _noise_levels,
}
