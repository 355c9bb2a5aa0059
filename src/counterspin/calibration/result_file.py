"""Validation of result files: migration of earlier schemas, and plausibility of numbers.

In results of schema 1 what was not stated was no part of u. Such a result took as perfect what its
model left out; so it says that it assumed it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sized
from typing import TYPE_CHECKING, Any, Final

from counterspin.calibration.result_parts import AccelerometerResult, Correlation, Trace
from counterspin.physics.observation import ORDERS
from counterspin.physics.terms import TERMS

if TYPE_CHECKING:
    from counterspin.calibration.result import Result

_LINE: Final = re.compile(r"(?P<name>.+) \((?P<kind>prior|considered|input|encoder)\)")

#: What was considered, inputs among it, was not adjusted by the data.
_KINDS: Final = {"prior": "stated", "considered": "held", "input": "held", "encoder": "noise"}

#: No coefficient is larger in g-units; its powers would be beyond all numbers.
_LARGEST_COEFFICIENT: Final = 1e30
#: No quantile of the normal distribution lies farther out, however many samples there are.
_FARTHEST_QUANTILE: Final = 30.0
#: No estimate has fewer degrees of freedom.
_FEWEST_DOF: Final = 0.1


def upgrade(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return the document of a result of schema 1 as one of schema 2, with what it assumed.

    document: As it was read; what is not as schema 1 has it is left for the checks to find.
    """
    new = _migrate_coefficients(dict(document))
    assumed: dict[str, None] = {}
    accelerometers = new.get("accelerometers")
    for accelerometer in accelerometers.values() if isinstance(accelerometers, dict) else ():
        if isinstance(accelerometer, dict):
            left_out = accelerometer.pop("left_out", None)
            assumed |= dict.fromkeys(left_out if isinstance(left_out, dict) else ())
            if isinstance(accelerometer.get("budget"), dict):
                accelerometer["budget"] = {
                    symbol: _migrate_budget(lines)
                    for symbol, lines in accelerometer["budget"].items()
                }
    return {**new, "schema": 2, "assumed": list(assumed)}


def _migrate_coefficients(value: Any) -> Any:
    """Return a document with the parts of every coefficient's u under their new names."""
    if isinstance(value, list):
        return [_migrate_coefficients(item) for item in value] if _holds_tables(value) else value
    if not isinstance(value, dict):
        return value
    migrated = {key: _migrate_coefficients(item) for key, item in value.items()}
    if "u_prior" in migrated or "u_considered" in migrated or "u_typical" in migrated:
        migrated.pop("u_typical", None)
        parts = [migrated.pop("u_prior", None), migrated.pop("u_considered", None)]
        sizes = [part for part in parts if isinstance(part, int | float)]
        migrated["u_stated"] = math.hypot(*sizes) if sizes else None
        migrated["u_unstated"] = 0.0 if sizes else None
    return migrated


def _holds_tables(values: list[Any]) -> bool:
    # Rows of numbers, which are most of a document, have nothing to rename.
    return bool(values) and isinstance(values[0], dict)


def _migrate_budget(lines: Any) -> Any:
    if not isinstance(lines, list):
        return lines
    return [_migrate_line(line) if isinstance(line, dict) else line for line in lines]


def _migrate_line(line: dict[str, Any]) -> dict[str, Any]:
    source = line.get("source")
    match = _LINE.fullmatch(source) if isinstance(source, str) else None
    if match is None:
        return {**line, "kind": "noise"}
    return {**line, "source": match["name"], "kind": _KINDS[match["kind"]]}


# Numbers that would be applied or shown wrongly


def find_faults(result: Result) -> Iterator[str]:
    """Yield the contradictions between the parts of a result."""
    if not 0.0 < result.inputs.gravity < math.inf:
        yield f"the gravity is {result.inputs.gravity} m/s^2"
    if not result.accelerometers:
        yield "the result has no accelerometers"
    confounded_sets = [*result.confounded]
    for accelerometer in result.accelerometers.values():
        confounded_sets += accelerometer.confounded
    if any(len(confounded.terms) < 2 for confounded in confounded_sets):
        yield "a list of inseparable terms has fewer than two entries"
    for name, run in result.runs.items():
        if not 0.0 < abs(run.rate) < math.inf:
            yield f"the rate of {name} is {run.rate} rad/s"
    if result.correlation is not None:
        yield from matrix_faults("its correlation matrix", result.correlation)
    for name, accelerometer in result.accelerometers.items():
        yield from find_accelerometer_faults(name, accelerometer)


def find_accelerometer_faults(name: str, accelerometer: AccelerometerResult) -> Iterator[str]:
    """Yield numbers of an accelerometer that no calibration can have found."""
    if not accelerometer.coefficients:
        yield f"{name} has no coefficients"
    for symbol, coefficient in {
        **accelerometer.known,
        **accelerometer.coefficients,
        **accelerometer.second_unknown,
    }.items():
        if symbol in TERMS and coefficient.unit != TERMS[symbol].unit:
            yield f"{symbol} of {name} is in {coefficient.unit}, not in {TERMS[symbol].unit}"
        if not (
            abs(coefficient.value or 0.0) < _LARGEST_COEFFICIENT > (coefficient.u or 0.0) >= 0.0
        ):
            yield f"{symbol} of {name} is {coefficient.value} ± {coefficient.u}"
        if coefficient.dof is not None and not _FEWEST_DOF <= coefficient.dof < math.inf:
            yield f"{symbol} of {name} has {coefficient.dof} degrees of freedom"
    for jackknife_line in accelerometer.jackknife:
        if jackknife_line.dof is not None and not _FEWEST_DOF <= jackknife_line.dof < math.inf:
            yield f"{name} without {jackknife_line.run} has {jackknife_line.dof} degrees of freedom"
    if accelerometer.correlation:
        yield from matrix_faults(f"the correlation matrix of {name}", accelerometer.correlation)
    if accelerometer.what_if is not None and not accelerometer.what_if.is_whole:
        yield f"the matrices of what_if of {name} do not match its names"
    for run, trace in accelerometer.traces.items():
        yield from _trace_faults(f"{name} in {run}", trace)
    if accelerometer.observable not in (None, *ORDERS):
        yield f"the observable of {name} is {accelerometer.observable!r}"
    residual = accelerometer.residual
    if min(residual.chi2 or 0.0, residual.dof, residual.rms) < 0.0:
        yield f"a size of the residuals of {name} is negative"


def matrix_faults(words: str, correlation: Correlation) -> Iterator[str]:
    """Yield that a matrix is not as large as its terms are many."""
    size = len(correlation.terms)
    if [len(row) for row in correlation.matrix] != [size] * size:
        yield f"{words} is not one of {size} terms"


def _trace_faults(words: str, trace: Trace) -> Iterator[str]:
    quantiles = trace.quantiles.normal if trace.quantiles else []
    if (trace.rows or 1) < 1 or any(abs(z) > _FARTHEST_QUANTILE for z in quantiles):
        yield f"rows or quantiles in the trace of {words} are not valid"
    if any(len(set(map(len, lists))) > 1 for lists in _paired_lists(trace)):
        yield f"lists in the trace of {words} are of unequal length"


def _paired_lists(trace: Trace) -> Iterator[tuple[Sized, ...]]:
    yield trace.time, trace.low, trace.high
    if (spectrum := trace.spectrum) is not None:
        yield spectrum.frequency, spectrum.power
    if (quantiles := trace.quantiles) is not None:
        yield quantiles.normal, quantiles.found
