"""Reference cases: inputs, expected values with sources, and tolerances.

The cases are stored in ``data/cases.json``; the tests of the project use the same cases.
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

DATA_FOLDER: Final = Path(__file__).parent / "data"


@frozen
class Case:
    """A reference case of the validation."""

    name: str  #: Unique name.
    requirement: str  #: Subject, such as physics, spindle, least squares.
    kernel: str  #: The function under test, as ``module:name``.
    source: str  #: Where the expected values come from: document and place, closed form, or script.
    given: Mapping[str, Any]  #: Inputs of the function.
    #: Expected values by name; None: they are in the file that `given` names.
    inline_expected: Mapping[str, Any] | None
    #: Relative and absolute tolerance, which are added. The absolute tolerance is a number or a
    #: number for each name; None: it is in the file with the expected values.
    relative_tolerance: float
    absolute_tolerance: float | Mapping[str, Any] | None

    @cached_property
    def expected(self) -> Mapping[str, Array]:
        """Expected values, name -> values of any shape; CounterspinError if they are missing."""
        kernel = self.kernel.rpartition(":")[2]
        expected = self.inline_expected
        if expected is None:
            expected = _EXPECTED_VALUES[kernel](self.given)
        return {name: np.array(values, np.float64) for name, values in expected.items()}

    def tolerance(self, name: str) -> Array:
        """Return the tolerance of each number of a name, in the shape of `expected`."""
        limit = (
            _campaign_entry(self.given)["limits"]
            if self.absolute_tolerance is None
            else self.absolute_tolerance
        )
        tolerance = limit if isinstance(limit, float | int) else limit[name]
        return np.asarray(tolerance) + self.relative_tolerance * np.abs(self.expected[name])


@cache
def load_document(name: str) -> Any:
    """Load a JSON file of `DATA_FOLDER`; callers must not modify the document."""
    return json.loads((DATA_FOLDER / name).read_text(encoding="utf-8"))


@cache
def cases() -> tuple[Case, ...]:
    """Return all cases, in the order of their requirements."""
    return tuple(_parse_case(entry) for entry in load_document("cases.json")["cases"])


def case(name: str) -> Case:
    """Return a case by its name; raise KeyError if it does not exist."""
    return {entry.name: entry for entry in cases()}[name]


def _parse_case(entry: Mapping[str, Any]) -> Case:
    return Case(
        name=entry["name"],
        requirement=entry["requirement"],
        kernel=entry["kernel"],
        source=entry["source"],
        given=entry["given"],
        inline_expected=entry["expected"],
        relative_tolerance=entry["limit"].get("relative", 0.0),
        absolute_tolerance=entry["limit"].get("absolute", 0.0),
    )


# Expected values in separate files, computed by scripts in 40-digit arithmetic.


def find_motion(inputs: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the motion with the given label from the file of integrals."""
    motions = load_document(inputs["file"])["cases"]
    return next(motion for motion in motions if motion["label"] == inputs["label"])


def compared_symbols(inputs: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return mounting -> symbols of compared integrals: `terms` or all, except `without`."""
    motion = find_motion(inputs)
    integrals = motion[inputs["observable"]]["QX"] if motion.get("platform") else ()
    platform_symbols = [symbol for symbol in PLATFORM_TERMS if symbol in integrals]
    default_symbols = [symbol for symbol, row in TERMS.items() if not row.effect.requires_rotation]
    symbols = inputs.get("terms", [*default_symbols, *platform_symbols])
    symbols = [symbol for symbol in symbols if symbol not in inputs.get("without", ())]
    return dict.fromkeys(motion[inputs["observable"]], symbols)


def compared_positions(inputs: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the positions on an arm, at one rate, for which the file states forces."""
    positions = load_document(inputs["file"])["cases"]
    return [position for position in positions if position["rate"] == inputs["rate"]]


def _expected_integrals(inputs: Mapping[str, Any]) -> dict[str, Any]:
    table = find_motion(inputs)[inputs["observable"]]
    expected = {}
    for mounting, symbols in compared_symbols(inputs).items():
        for symbol in symbols:
            key = TERMS[symbol].effect.text if symbol in TERMS else symbol
            if key not in table[mounting]:
                raise CounterspinError(
                    f"{inputs['file']} does not contain the integral of {symbol} along {mounting} "
                    f'for the motion "{inputs["label"]}"; generate it with the script in '
                    "tests/reference",
                    code="validation-failed",
                )
            sign = -1.0 if symbol == "delta_P" else 1.0
            values = np.array(table[mounting][key], np.float64)
            expected[f"{symbol} of {mounting}"] = sign * values
    return expected


def _expected_angles(inputs: Mapping[str, Any]) -> dict[str, Any]:
    return {"angle": find_motion(inputs)["angle"]}


def _expected_forces(inputs: Mapping[str, Any]) -> dict[str, Any]:
    key = "arm" if inputs["file"] == "axis_tilt.json" else "force"
    return {"force": [position[key] for position in compared_positions(inputs)]}


def _expected_estimates(inputs: Mapping[str, Any]) -> dict[str, Any]:
    accelerometers = load_document(inputs["file"])["result"]["accelerometers"]
    coefficients = accelerometers[inputs["accelerometer"]]["coefficients"]
    return {
        symbol: [coefficient["value"], coefficient["u"]]
        for symbol, coefficient in coefficients.items()
    }


def _campaign_entry(inputs: Mapping[str, Any]) -> Any:
    """Return the campaign's entry in the file of fits."""
    return load_document(inputs["file"])[inputs["fit"]]


def _expected_fit(inputs: Mapping[str, Any]) -> Any:
    return _campaign_entry(inputs)["expected"]


def _expected_noise(inputs: Mapping[str, Any]) -> dict[str, Any]:
    return {key: load_document(inputs["file"])[key] for key in ("white", "random_walk", "gain")}


def _expected_script_values(inputs: Mapping[str, Any]) -> Any:
    return load_document(inputs["expected"])[inputs["part"]]


_EXPECTED_VALUES: Final = {
    "columns": _expected_integrals,
    "Spindle.angle": _expected_angles,
    "Stations.forces": _expected_forces,
    "read_certificate": _expected_estimates,
    "calibrate": _expected_fit,
    "certificate": _expected_script_values,
    "apply": _expected_script_values,
    "estimate_noise": _expected_noise,
}
