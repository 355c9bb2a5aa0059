"""A laboratory's calibration and measurement capability (CMC): no smaller uncertainty is stated."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Final

from counterspin.calibration.notebook.forms import StatedGravity, si_estimate
from counterspin.calibration.pages.triad import parameter_words
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import Coefficient, Correlation, TriadResult
from counterspin.certificates.conversion import certified_triad
from counterspin.certificates.lab import Lab
from counterspin.certificates.wording import coverage_factor
from counterspin.physics.terms import COMMON_NAMES, TERMS
from counterspin.reports.numbers import field_unit, format_uncertainty
from counterspin.units import to_si


def with_capability(result: Result, lab: Lab) -> Result:
    """Return the result with each expanded uncertainty at least that of the laboratory's CMC.

    What is added is independent of all else (ILAC-P14:09/2020, 5.4): covariances stay, and
    correlations become smaller. Degrees of freedom and k stay, which makes U no smaller.
    """
    if not lab.cmc:
        return result
    factors = {
        f"{name}.{symbol}": _enlarged(result, lab, name, symbol)
        for name, accelerometer in result.accelerometers.items()
        for symbol in accelerometer.coefficients
    }
    accelerometers = {
        name: accelerometer.model_copy(
            update={
                "coefficients": {
                    symbol: _times(c, factors[f"{name}.{symbol}"])
                    for symbol, c in accelerometer.coefficients.items()
                },
                "output": {
                    key: _times(c, factors.get(f"{name}.{COMMON_NAMES.get(key)}", 1.0))
                    for key, c in accelerometer.output.items()
                },
                "correlation": _weaker(
                    accelerometer.correlation,
                    {s: factors[f"{name}.{s}"] for s in accelerometer.coefficients},
                ),
            }
        )
        for name, accelerometer in result.accelerometers.items()
    }
    return result.model_copy(
        update={
            "accelerometers": accelerometers,
            "correlation": _weaker(result.correlation, factors),
            "triad": None if result.triad is None else _triad(result, result.triad, lab),
        }
    )


#: Kind of a triad's parameter -> the terms by whose capability it is raised.
_RAISED_BY: Final = {
    "offset": ("K_F",),
    "sensitivity": ("K_I",),
    "angle": ("delta_O", "delta_P"),
}


def _triad(result: Result, triad: TriadResult, lab: Lab) -> TriadResult:
    """Return a triad with no smaller U than the laboratory states of the terms that make it."""
    g = StatedGravity(result.inputs.gravity, result.inputs.u_gravity)
    factors = {}
    for name, c in triad.parameters.items():
        kind, _, symbol = name.partition(".")
        every = [lab.capability(s, g.value) for s in _RAISED_BY.get(kind, (symbol,))]
        least = max((one for one in every if one is not None), default=None)
        factors[name] = _factor(c, least, replace(g, sensitivity=triad.by_gravity.get(name, 0.0)))
    # Of the matrix no capability is stated: it grows as what makes it grows most.
    most = max((f for name, f in factors.items() if not name.startswith("offset.")), default=1.0)
    matrix = triad.u_matrix and [[most * u for u in row] for row in triad.u_matrix]
    return triad.model_copy(
        update={
            "u_matrix": matrix,
            "parameters": {name: _times(c, factors[name]) for name, c in triad.parameters.items()},
            "correlation": _weaker(triad.correlation, factors),
        }
    )


def capability_lines(result: Result, certified: Result, lab: Lab) -> list[str]:
    """Return a sentence for each coefficient whose uncertainty the CMC made larger.

    lab: The laboratory's data.
    """
    lines = []
    pairs = [
        (f"{symbol} of {name}", c, certified.accelerometers[name].coefficients[symbol])
        for name in lab.certified(result)
        for symbol, c in result.accelerometers[name].coefficients.items()
    ]
    was, is_ = (certified_triad(one, lab.certified(result)) for one in (result, certified))
    if was is not None and is_ is not None:
        pairs += [
            (parameter_words(name), c, is_.parameters[name]) for name, c in was.parameters.items()
        ]
    for words, c, raised in pairs:
        if c.u and raised.u and raised.u > c.u:
            unit, factor = field_unit(c.unit)
            evaluated = format_uncertainty(coverage_factor(c.dof) * c.u * factor)
            lines.append(
                f"{words}: the evaluated uncertainty is U = {evaluated} {unit}; the certificate "
                f"states the laboratory's calibration and measurement capability, the smallest "
                "uncertainty that it may state."
            )
    return lines


def _enlarged(result: Result, lab: Lab, name: str, symbol: str) -> float:
    """Return by how much u is to be multiplied, in g-units: 1 where it is large enough."""
    c = result.accelerometers[name].coefficients[symbol]
    least = lab.capability(symbol, result.inputs.gravity) if symbol in TERMS else None
    return _factor(c, least, result.gravity_of(name, symbol))


def _factor(c: Coefficient, least: float | None, g: StatedGravity) -> float:
    """Return the same of an estimate, the least U being in its unit; None: none is stated."""
    if least is None or not c.u or c.value is None:
        return 1.0
    estimate = si_estimate(c.value, c.u, c.unit, c.dof, g)
    # In SI the uncertainty of g may count for less: there too U must not fall below.
    lacking = max(
        (least / coverage_factor(dof)) ** 2 - u**2
        for u, dof in (
            (c.u, c.dof),
            (estimate.u / to_si(1.0, c.unit, g.value), estimate.dof),
        )
    )
    return math.sqrt(1.0 + max(lacking, 0.0) / c.u**2)


def _times(coefficient: Coefficient, factor: float) -> Coefficient:
    if factor == 1.0 or coefficient.u is None:
        return coefficient
    return coefficient.model_copy(update={"u": coefficient.u * factor})


def _weaker(correlation: Correlation | None, factors: Mapping[str, float]) -> Correlation | None:
    if correlation is None:
        return None
    by = [factors.get(term, 1.0) for term in correlation.terms]
    matrix = [
        [r if i == j else r / (by[i] * by[j]) for j, r in enumerate(row)]
        for i, row in enumerate(correlation.matrix)
    ]
    return correlation.model_copy(update={"matrix": matrix})
