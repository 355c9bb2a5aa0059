"""The numbers that a certificate states: in SI, and U not below the laboratory's capability.

The capability (CMC) is the smallest uncertainty that the laboratory may state. In SI the
uncertainty of g contributes only the part that remains after the conversion.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Final

from counterspin.calibration.pages.triad import nominal_outputs, parameter_words, shown_parameter
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import Coefficient, Correlation, TriadResult
from counterspin.calibration.si_estimates import (
    SiEstimate,
    StatedGravity,
    own_estimate,
    si_estimate,
)
from counterspin.certificates import wording
from counterspin.certificates.lab import Lab
from counterspin.certificates.schema import factor
from counterspin.certificates.wording import coverage_factor
from counterspin.physics.terms import COMMON_NAMES, TERMS
from counterspin.reports.blocks import Column, Table
from counterspin.reports.numbers import (
    field_unit,
    format_estimate,
    format_number,
    format_uncertainty,
)
from counterspin.units import si_unit, to_si


def in_si(result: Result, name: str) -> dict[str, SiEstimate]:
    """Return the determined coefficients of an accelerometer in SI units."""
    estimates = {}
    for symbol, c in result.accelerometers[name].coefficients.items():
        if wording.is_determined(c):
            assert c.value is not None
            assert c.u is not None
            gravity = result.gravity_of(name, symbol)
            estimates[symbol] = si_estimate(c.value, c.u, c.unit, c.dof, gravity)
    return estimates


#: What is stated in the unit of the readings too -> the coefficient that it is a multiple of.
OUTPUT: Final = {"bias": "K_F", "scale_factor": "K_I"}


def output_in_si(result: Result, name: str) -> dict[str, SiEstimate]:
    """Return bias and scale factor in the SI unit of an accelerometer's readings.

    Omit those whose unit has no expression in SI.
    """
    accelerometer = result.accelerometers[name]
    estimates = {}
    for key, c in accelerometer.output.items():
        symbol = OUTPUT[key]
        own = accelerometer.coefficients.get(symbol)
        if own is None or not wording.is_determined(c):
            continue
        assert c.value is not None
        assert c.u is not None
        gravity = result.gravity_of(name, symbol)
        # Both moved by g alike: one is the other times the nominal sensitivity, which is exact.
        if accelerometer.nominal is not None:
            times = accelerometer.nominal.sensitivity
        else:
            times = c.value / own.value if own.value else c.u / (own.u or math.inf)
        moved = replace(gravity, sensitivity=gravity.sensitivity * times)
        with suppress(ValueError):
            estimates[key] = own_estimate(c.value, c.u, c.unit, c.dof, moved)
    return estimates


def with_exact_g(coefficients: Mapping[str, Coefficient], gravity: float) -> dict[str, SiEstimate]:
    """Return coefficients in SI units, with g (m/s^2) taken as exact."""
    return {
        symbol: c.to_si(gravity) for symbol, c in coefficients.items() if wording.is_determined(c)
    }


def covariance(
    correlation: Correlation, estimates: Mapping[str, SiEstimate], one: str, other: str
) -> float:
    """Return the covariance of two coefficients in SI units.

    correlation: Of the two in g-units.
    """
    first, second = estimates[one], estimates[other]
    if one == other:
        # The correlation is 1, but perhaps not in its last digit.
        return first.u * first.u
    terms, matrix = correlation.terms, correlation.matrix
    # The product must not depend on the order: the matrix is symmetric to the last digit.
    places = sorted((terms.index(one), terms.index(other)))
    u = [math.hypot(estimate.u_without_g, estimate.shift_kept) for estimate in (first, second)]
    together = matrix[places[1]][places[0]] * (u[0] * u[1])
    return together + first.shift * second.shift - first.shift_kept * second.shift_kept


#: How the whole certificate begins what a triad is called.
TITLE: Final = "Triad "


def certified_triad(result: Result, names: Sequence[str]) -> TriadResult | None:
    """Return the triad, if all three of its accelerometers are certified."""
    triad = result.triad
    return None if triad is None or not set(triad.accelerometers) <= set(names) else triad


def title(triad: TriadResult) -> str:
    """Return the triad's title in the whole certificate."""
    return TITLE + ", ".join(triad.accelerometers)


def triad_in_si(result: Result, triad: TriadResult) -> dict[str, SiEstimate]:
    """Return the determined parameters in SI units."""
    return _in_si(result, triad, triad.parameters)


def shown_in_si(
    result: Result, triad: TriadResult
) -> tuple[dict[str, Coefficient], dict[str, SiEstimate]]:
    """Return the determined parameters by their words, in g-units and in SI, as pages show them."""
    shown = {name: shown_parameter(name, triad.parameters[name]) for name in triad.parameters}
    in_si = _in_si(result, triad, {name: c for name, (_, c) in shown.items()})
    return dict(shown.values()), {shown[name][0]: estimate for name, estimate in in_si.items()}


def _in_si(
    result: Result, triad: TriadResult, parameters: Mapping[str, Coefficient]
) -> dict[str, SiEstimate]:
    found, inputs = {}, result.inputs
    for name, c in parameters.items():
        if wording.is_determined(c):
            assert c.value is not None
            assert c.u is not None
            by_g = triad.by_gravity.get(name, 0.0)
            gravity = StatedGravity(inputs.gravity, inputs.u_gravity, by_g)
            found[name] = si_estimate(c.value, c.u, c.unit, c.dof, gravity)
    return found


def matrix_dof(triad: TriadResult) -> float | None:
    """Return the degrees of freedom of the matrix: the fewest of its parameters."""
    made = (c for name, c in triad.parameters.items() if name.startswith(("sensitivity", "angle")))
    return min((c.dof for c in made if c.dof is not None), default=None)


def triad_lines(triad: TriadResult) -> list[str]:
    """Return sentences on the triad: the method, its parameters, and those without a value."""
    names = ", ".join(triad.accelerometers)
    lines = [
        f"{names} are one sensor. In addition to their coefficients, parameters are given that "
        f"do not depend on its frame: offsets, sensitivities, "
        "and the angles between the sensitive axes (Geist, Gaitan et al., J. Res. NIST 122 "
        "(2017) 32)."
    ]
    if triad.poses:
        rms = ""
        if triad.rms_before is not None:
            rms = f" The size of f less g has an rms of {format_number(triad.rms_before, 3)} m/s^2"
            after = triad.rms_after
            rms += "." if after is None else f", corrected {format_number(after, 3)} m/s^2."
        lines.append(
            f"The sensor was at rest in {len(triad.poses)} poses whose attitudes were unknown: "
            f"the direction of each was estimated with the coefficients; only the magnitude of "
            f"the specific force, the local gravity, was taken as known.{rms}"
        )
    lines += [
        f"{parameter_words(name)}: {wording.why_not_determined(c)}; no value is certified."
        for name, c in triad.parameters.items()
        if not wording.is_determined(c)
    ]
    return lines


def output_table(
    names: Sequence[str],
    matrix: Sequence[Sequence[float]],
    expanded: Sequence[Sequence[float]],
    k: float,
) -> Table:
    """Return the matrix of the corrected output with U and k."""
    rows = zip("xyz", matrix, expanded, strict=True)
    return Table(
        (Column("M ± U"), *(Column(name, "right") for name in names), Column("k", "right")),
        tuple((f"f_{axis}", *map(_element, row, own), factor(k)) for axis, row, own in rows),
    )


def _element(value: float, expanded: float) -> str:
    """Return an element of a matrix, with U if it has one; zeros by choice have none."""
    return format_estimate(value, expanded, "") if expanded else format_number(value, 9)


def parameter_line(name: str, parameter: Coefficient) -> str:
    """Return a determined parameter, with U and k, in g-units and its SI unit."""
    words, c = shown_parameter(name, parameter)
    k = coverage_factor(c.dof)
    whole = "the whole angle is " if c.value != parameter.value else ""
    stated = wording.stated_in(si_unit(c.unit)[0])
    return f"{words} = {wording.shown_in_g(c, k)} (U, k = {factor(k)}); {whole}{stated}"


def output_lines(result: Result, triad: TriadResult) -> list[str]:
    """Return sentences on the corrected output from the indications; none without a matrix."""
    if triad.matrix is None:
        return []
    outputs = nominal_outputs(result, triad)
    by = f" ({outputs})" if outputs else ""
    names = ", ".join(triad.accelerometers)
    beside = [name for name in triad.parameters if name.split(".")[0] in triad.accelerometers]
    less = f", less what {', '.join(beside)} add to them" if beside else ""
    return [
        f"Corrected output: f = M (y - b), y being the indications of {names} by their nominal "
        f"sensitivities{by}{less}, and b their offsets. f lies along the axes x, y, z in which the "
        "campaign states their directions: east, north and up while the sensor is level. "
        "Misalignments that are no coefficients above are there as stated, or zero."
    ]


# Capability


def with_capability(result: Result, lab: Lab) -> Result:
    """Return the result with each expanded uncertainty at least the laboratory's CMC.

    The added variance is independent of all others (ILAC-P14:09/2020, 5.4): covariances stay, and
    correlations become smaller. Degrees of freedom and k stay, which does not reduce U.
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
    """Return a triad with U not below the values that the laboratory states for its terms."""
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
    """Return the factor by which u must grow, in g-units: 1 if it is large enough."""
    c = result.accelerometers[name].coefficients[symbol]
    least = lab.capability(symbol, result.inputs.gravity) if symbol in TERMS else None
    return _factor(c, least, result.gravity_of(name, symbol))


def _factor(c: Coefficient, least: float | None, g: StatedGravity) -> float:
    """Return the factor of an estimate, with the least U in its unit; None: none is stated."""
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
