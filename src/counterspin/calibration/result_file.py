"""Validation of result files: migration of earlier schemas, and plausibility of numbers.

Results of schema 1 did not include unstated terms in u. The upgraded result lists them as assumed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence, Sized
from typing import TYPE_CHECKING, Any, Final

from counterspin.calibration.result_parts import (
    AccelerometerResult,
    Correlation,
    Finding,
    State,
    Trace,
)
from counterspin.inference.distributions import MIN_DOF
from counterspin.physics.observation import ORDERS
from counterspin.physics.terms import TERMS

if TYPE_CHECKING:
    from counterspin.calibration.result import Result

_SOURCE_PATTERN: Final = re.compile(r"(?P<name>.+) \((?P<kind>prior|considered|input|encoder)\)")

#: Kind in a budget of schema 1 -> kind in schema 2.
_NEW_KINDS: Final = {"prior": "stated", "considered": "held", "input": "held", "encoder": "noise"}

#: Largest valid coefficient in g-units; its powers must not overflow.
_MAX_COEFFICIENT: Final = 1e30
#: Largest valid quantile of the normal distribution.
_MAX_QUANTILE: Final = 30.0
#: Largest valid correlation, with rounding errors.
_MAX_CORRELATION: Final = 1.0 + 1e-6
#: States that follow from a finding.
_EXPLAINED_STATES: Final = ("not-determined", "contradicted")


def upgrade_document(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return the document of a result of schema 1 in schema 2.

    document: Document as read; invalid entries stay for the validation.
    """
    upgraded_document = _migrate_coefficients(dict(document))
    assumed_terms: dict[str, None] = {}
    accelerometers = upgraded_document.get("accelerometers")
    for accelerometer in accelerometers.values() if isinstance(accelerometers, dict) else ():
        if isinstance(accelerometer, dict):
            omitted_terms = accelerometer.pop("left_out", None)
            assumed_terms |= dict.fromkeys(omitted_terms if isinstance(omitted_terms, dict) else ())
            if isinstance(accelerometer.get("budget"), dict):
                accelerometer["budget"] = {
                    symbol: _migrate_budget(lines)
                    for symbol, lines in accelerometer["budget"].items()
                }
    return {**upgraded_document, "schema": 2, "assumed": list(assumed_terms)}


def _migrate_coefficients(value: Any) -> Any:
    """Return a document with the contributions to the u of coefficients under their new names."""
    if isinstance(value, list):
        return (
            [_migrate_coefficients(element) for element in value]
            if _contains_tables(value)
            else value
        )
    if not isinstance(value, dict):
        return value
    table = {key: _migrate_coefficients(element) for key, element in value.items()}
    if "u_prior" in table or "u_considered" in table or "u_typical" in table:
        table.pop("u_typical", None)
        components = [table.pop("u_prior", None), table.pop("u_considered", None)]
        numbers = [component for component in components if isinstance(component, int | float)]
        table["u_stated"] = math.hypot(*numbers) if numbers else None
        table["u_unstated"] = 0.0 if numbers else None
    return table


def _contains_tables(values: list[Any]) -> bool:
    # Rows of numbers, which make up most of a document, contain no keys.
    return bool(values) and isinstance(values[0], dict)


def _migrate_budget(lines: Any) -> Any:
    if not isinstance(lines, list):
        return lines
    return [_migrate_budget_line(line) if isinstance(line, dict) else line for line in lines]


def _migrate_budget_line(line: dict[str, Any]) -> dict[str, Any]:
    source = line.get("source")
    match = _SOURCE_PATTERN.fullmatch(source) if isinstance(source, str) else None
    if match is None:
        return {**line, "kind": "noise"}
    return {**line, "source": match["name"], "kind": _NEW_KINDS[match["kind"]]}


# Validation


def find_faults(result: Result) -> Iterator[str]:
    """Yield the contradictions between the parts of a result."""
    if not 0.0 < result.inputs.gravity < math.inf:
        yield f"the gravity is {result.inputs.gravity} m/s^2"
    if not result.accelerometers:
        yield "the result has no accelerometers"
    if result.accepted_misfit is None:
        yield from _state_faults("the state", result.state, result.findings)
        for name, accelerometer in result.accelerometers.items():
            subject = f"the state of {name}"
            yield from _state_faults(subject, accelerometer.state, accelerometer.findings)
    confounded_sets = [*result.confounded]
    for accelerometer in result.accelerometers.values():
        confounded_sets += accelerometer.confounded
    if any(len(confounded_set.terms) < 2 for confounded_set in confounded_sets):
        yield "a list of inseparable terms has fewer than two entries"
    for name, run in result.runs.items():
        if not 0.0 < abs(run.rate) < math.inf:
            yield f"the rate of {name} is {run.rate} rad/s"
    if result.correlation is not None:
        yield from matrix_faults("its correlation matrix", result.correlation)
    for name, accelerometer in result.accelerometers.items():
        yield from find_accelerometer_faults(name, accelerometer)


def _state_faults(subject: str, state: State | None, findings: Sequence[Finding]) -> Iterator[str]:
    if state in _EXPLAINED_STATES and not findings:
        yield f"{subject} is {state}, but no finding gives the reason"


def find_accelerometer_faults(name: str, accelerometer: AccelerometerResult) -> Iterator[str]:
    """Yield the contradictions in the result of one accelerometer."""
    if not accelerometer.coefficients:
        yield f"{name} has no coefficients"
    yield from _coefficient_faults(name, accelerometer)
    for jackknife_line in accelerometer.jackknife:
        if jackknife_line.dof is not None and not MIN_DOF <= jackknife_line.dof < math.inf:
            yield f"{name} without {jackknife_line.run} has {jackknife_line.dof} degrees of freedom"
    if accelerometer.correlation:
        yield from matrix_faults(f"the correlation matrix of {name}", accelerometer.correlation)
    if accelerometer.what_if is not None and not accelerometer.what_if.is_whole:
        yield f"the matrices of what_if of {name} do not match the names in it"
    for run, trace in accelerometer.traces.items():
        yield from _trace_faults(f"{name} in {run}", trace)
    if accelerometer.observable not in (None, *ORDERS):
        yield f"the observable of {name} is {accelerometer.observable!r}"
    residual = accelerometer.residual
    if min(residual.chi2 or 0.0, residual.dof, residual.rms) < 0.0:
        yield f"a size of the residuals of {name} is negative"


def _coefficient_faults(name: str, accelerometer: AccelerometerResult) -> Iterator[str]:
    for symbol, coefficient in {
        **accelerometer.known,
        **accelerometer.coefficients,
        **accelerometer.second_unknown,
    }.items():
        if symbol in TERMS and coefficient.unit != TERMS[symbol].unit:
            yield f"{symbol} of {name} is in {coefficient.unit}, not in {TERMS[symbol].unit}"
        if not (abs(coefficient.value or 0.0) < _MAX_COEFFICIENT > (coefficient.u or 0.0) >= 0.0):
            yield f"{symbol} of {name} is {coefficient.value} ± {coefficient.u}"
        if coefficient.estimated and (coefficient.value is None) is not (coefficient.u is None):
            yield f"{symbol} of {name} has a value without u, or u without a value"
        if coefficient.dof is not None and not MIN_DOF <= coefficient.dof < math.inf:
            yield f"{symbol} of {name} has {coefficient.dof} degrees of freedom"


def matrix_faults(description: str, correlation: Correlation) -> Iterator[str]:
    """Yield a message if a matrix is not a correlation matrix of its terms."""
    n_terms = len(correlation.terms)
    if [len(row) for row in correlation.matrix] != [n_terms] * n_terms:
        yield f"{description} is not one of {n_terms} terms"
    elif any(
        abs(correlation.matrix[i][j]) > _MAX_CORRELATION
        or not math.isclose(correlation.matrix[i][j], correlation.matrix[j][i], abs_tol=1e-6)
        for i in range(n_terms)
        for j in range(i + 1)
    ):
        yield f"{description} is not symmetric, or has an element beyond 1"


def _trace_faults(description: str, trace: Trace) -> Iterator[str]:
    quantiles = trace.quantiles.normal if trace.quantiles else []
    if (trace.rows or 1) < 1 or any(abs(z) > _MAX_QUANTILE for z in quantiles):
        yield f"rows or quantiles in the trace of {description} are not valid"
    if any(len(set(map(len, lists))) > 1 for lists in _paired_lists(trace)):
        yield f"lists in the trace of {description} are of unequal length"


def _paired_lists(trace: Trace) -> Iterator[tuple[Sized, ...]]:
    yield trace.time, trace.low, trace.high
    if (spectrum := trace.spectrum) is not None:
        yield spectrum.frequency, spectrum.power
    if (quantiles := trace.quantiles) is not None:
        yield quantiles.normal, quantiles.found
