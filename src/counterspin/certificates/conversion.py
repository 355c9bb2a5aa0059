"""Conversion of a certificate's numbers to SI, with U not below the laboratory's capability.

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
    convert_instrument_unit,
    convert_to_si,
)
from counterspin.certificates import certificate_text
from counterspin.certificates.certificate_text import coverage_factor
from counterspin.certificates.lab import Lab
from counterspin.certificates.schema import format_decimal
from counterspin.physics.terms import COMMON_NAMES, TERMS
from counterspin.reports.blocks import Column, Table
from counterspin.reports.numbers import (
    field_unit,
    format_estimate,
    format_number,
    format_uncertainty,
)
from counterspin.units import si_unit, to_si


def coefficients_in_si(result: Result, name: str) -> dict[str, SiEstimate]:
    """Return the determined coefficients of an accelerometer in SI units."""
    estimates = {}
    for symbol, c in result.accelerometers[name].coefficients.items():
        if certificate_text.is_determined(c):
            assert c.value is not None
            assert c.u is not None
            gravity = result.gravity_of(name, symbol)
            estimates[symbol] = convert_to_si(c.value, c.u, c.unit, c.dof, gravity)
    return estimates


#: Output quantity in the unit of the readings -> the coefficient that it is a multiple of.
OUTPUT_COEFFICIENTS: Final = {"bias": "K_F", "scale_factor": "K_I"}


def output_coefficients_in_si(result: Result, name: str) -> dict[str, SiEstimate]:
    """Return bias and scale factor in the SI unit of an accelerometer's readings.

    Omit those whose unit has no expression in SI.
    """
    accelerometer = result.accelerometers[name]
    estimates = {}
    for key, c in accelerometer.output.items():
        symbol = OUTPUT_COEFFICIENTS[key]
        unit = accelerometer.coefficients.get(symbol)
        if unit is None or not certificate_text.is_determined(c):
            continue
        assert c.value is not None
        assert c.u is not None
        gravity = result.gravity_of(name, symbol)
        # g shifts both equally: one equals the other times the nominal sensitivity, which is exact.
        if accelerometer.nominal is not None:
            scale = accelerometer.nominal.sensitivity
        else:
            scale = c.value / unit.value if unit.value else c.u / (unit.u or math.inf)
        value = replace(gravity, sensitivity=gravity.sensitivity * scale)
        with suppress(ValueError):
            estimates[key] = convert_instrument_unit(c.value, c.u, c.unit, c.dof, value)
    return estimates


def to_si_with_exact_g(
    coefficients: Mapping[str, Coefficient], gravity: float
) -> dict[str, SiEstimate]:
    """Return coefficients in SI units, with g (m/s^2) taken as exact."""
    return {
        symbol: c.to_si(gravity)
        for symbol, c in coefficients.items()
        if certificate_text.is_determined(c)
    }


def covariance(
    correlation: Correlation, estimates: Mapping[str, SiEstimate], symbol: str, other_symbol: str
) -> float:
    """Return the covariance of two coefficients in SI units.

    correlation: Correlation of the coefficients in g-units.
    """
    first, second = estimates[symbol], estimates[other_symbol]
    if symbol == other_symbol:
        # A stored correlation of 1 may be inexact in its last digit.
        return first.u * first.u
    terms, matrix = correlation.terms, correlation.matrix
    # The product must not depend on the order: the matrix is symmetric to the last digit.
    indices = sorted((terms.index(symbol), terms.index(other_symbol)))
    u = [math.hypot(estimate.u_without_g, estimate.shift_kept) for estimate in (first, second)]
    matrix_element = matrix[indices[1]][indices[0]] * (u[0] * u[1])
    return matrix_element + first.shift * second.shift - first.shift_kept * second.shift_kept


#: Prefix of a triad's title in the certificate.
TRIAD_TITLE_PREFIX: Final = "Triad "


def certified_triad(result: Result, names: Sequence[str]) -> TriadResult | None:
    """Return the triad, if all three of its accelerometers are certified."""
    triad = result.triad
    return None if triad is None or not set(triad.accelerometers) <= set(names) else triad


def triad_title(triad: TriadResult) -> str:
    """Return the triad's title in the certificate."""
    return TRIAD_TITLE_PREFIX + ", ".join(triad.accelerometers)


def triad_parameters_in_si(result: Result, triad: TriadResult) -> dict[str, SiEstimate]:
    """Return the determined parameters in SI units."""
    return _parameters_in_si(result, triad, triad.parameters)


def displayed_parameters(
    result: Result, triad: TriadResult
) -> tuple[dict[str, Coefficient], dict[str, SiEstimate]]:
    """Return the determined parameters by description, in g-units and in SI, as shown."""
    shown = {name: shown_parameter(name, triad.parameters[name]) for name in triad.parameters}
    in_si = _parameters_in_si(result, triad, {name: c for name, (_, c) in shown.items()})
    return dict(shown.values()), {shown[name][0]: estimate for name, estimate in in_si.items()}


def _parameters_in_si(
    result: Result, triad: TriadResult, parameters: Mapping[str, Coefficient]
) -> dict[str, SiEstimate]:
    estimates, inputs = {}, result.inputs
    for name, c in parameters.items():
        if certificate_text.is_determined(c):
            assert c.value is not None
            assert c.u is not None
            by_g = triad.by_gravity.get(name, 0.0)
            gravity = StatedGravity(inputs.gravity, inputs.u_gravity, by_g)
            estimates[name] = convert_to_si(c.value, c.u, c.unit, c.dof, gravity)
    return estimates


def matrix_dof(triad: TriadResult) -> float | None:
    """Return the degrees of freedom of the matrix: the smallest of its parameters."""
    dofs = (c for name, c in triad.parameters.items() if name.startswith(("sensitivity", "angle")))
    return min((c.dof for c in dofs if c.dof is not None), default=None)


def triad_lines(triad: TriadResult) -> list[str]:
    """Return sentences on the triad: the method, its parameters, and those without a value."""
    names = ", ".join(triad.accelerometers)
    lines = [
        f"The accelerometers {names} form one sensor. In addition to their coefficients, the "
        "certificate gives parameters that do not depend on the frame of the sensor: offsets, "
        "sensitivities, and the angles between the sensitive axes (Geist, Gaitan et al., J. "
        "Res. NIST 122 (2017) 32)."
    ]
    if triad.poses:
        rms = ""
        if triad.rms_before is not None:
            before = format_number(triad.rms_before, 3)
            rms = f" The rms difference between |f| and g is {before} m/s^2"
            after = triad.rms_after
            rms += (
                "."
                if after is None
                else (f"before and {format_number(after, 3)} m/s^2 after correction.")
            )
        lines.append(
            f"The sensor was at rest in {len(triad.poses)} poses of unknown attitude. The fit "
            "estimated the attitude in each pose together with the coefficients. Only the "
            f"magnitude of the specific force, the local gravity, was known.{rms}"
        )
    lines += [
        f'The parameter "{parameter_words(name)}" is not certified: '
        f"{certificate_text.undetermined_reason(c)}."
        for name, c in triad.parameters.items()
        if not certificate_text.is_determined(c)
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
        tuple(
            (f"f_{axis}", *map(_format_element, row, expanded_row), format_decimal(k))
            for axis, row, expanded_row in rows
        ),
    )


def _format_element(value: float, expanded: float) -> str:
    """Return an element of a matrix, with U if it has one; fixed zeros have none."""
    return format_estimate(value, expanded, "") if expanded else format_number(value, 9)


def parameter_line(name: str, parameter: Coefficient) -> str:
    """Return a determined parameter, with U and k, in g-units and its SI unit."""
    words, c = shown_parameter(name, parameter)
    k = coverage_factor(c.dof)
    quantity = "value" if c.value == parameter.value else "angle"
    value_text = certificate_text.unit_remark(si_unit(c.unit)[0], quantity)
    estimate = f"{certificate_text.format_in_g_units(c, k)} (U, k = {format_decimal(k)})"
    return f"{words} = {estimate}. {value_text}"


def output_lines(result: Result, triad: TriadResult) -> list[str]:
    """Return sentences on the corrected output from the indications; none without a matrix."""
    if triad.matrix is None:
        return []
    outputs = nominal_outputs(result, triad)
    by = f" ({outputs})" if outputs else ""
    names = ", ".join(triad.accelerometers)
    other_terms = [name for name in triad.parameters if name.split(".")[0] in triad.accelerometers]
    reduced = f", minus the contributions of {', '.join(other_terms)}" if other_terms else ""
    return [
        f"Corrected output: f = M (y - b). Here, y are the indications of {names} divided by "
        f"their nominal sensitivities{by}{reduced}, and b are the offsets. The components of f "
        "are along the axes x, y, z in which the campaign states the directions of the "
        "accelerometers: east, north and up while the sensor is level. Misalignments that are "
        "not listed above have their stated values or, without a stated value, zero."
    ]


# Capability


def apply_cmc_floor(result: Result, lab: Lab) -> Result:
    """Return the result with each expanded uncertainty at least the laboratory's CMC.

    The added variance is independent of all others (ILAC-P14:09/2020, 5.4): covariances stay, and
    correlations become smaller. Degrees of freedom and k stay, which does not reduce U.
    """
    if not lab.cmc:
        return result
    factors = {
        f"{name}.{symbol}": _cmc_factor(result, lab, name, symbol)
        for name, accelerometer in result.accelerometers.items()
        for symbol in accelerometer.coefficients
    }
    accelerometers = {
        name: accelerometer.model_copy(
            update={
                "coefficients": {
                    symbol: _scale_u(c, factors[f"{name}.{symbol}"])
                    for symbol, c in accelerometer.coefficients.items()
                },
                "output": {
                    key: _scale_u(c, factors.get(f"{name}.{COMMON_NAMES.get(key)}", 1.0))
                    for key, c in accelerometer.output.items()
                },
                "correlation": _rescale_correlation(
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
            "correlation": _rescale_correlation(result.correlation, factors),
            "triad": None
            if result.triad is None
            else _apply_cmc_floor_to_triad(result, result.triad, lab),
        }
    )


#: Type of a triad's parameter -> the terms whose CMC limits it.
_CMC_TERMS: Final = {
    "offset": ("K_F",),
    "sensitivity": ("K_I",),
    "angle": ("delta_O", "delta_P"),
}


def _apply_cmc_floor_to_triad(result: Result, triad: TriadResult, lab: Lab) -> TriadResult:
    """Return a triad with U not below the values that the laboratory states for its terms."""
    g = StatedGravity(result.inputs.gravity, result.inputs.u_gravity)
    factors = {}
    for name, c in triad.parameters.items():
        kind, _, symbol = name.partition(".")
        capabilities = [lab.capability(s, g.value) for s in _CMC_TERMS.get(kind, (symbol,))]
        smallest_u = max(
            (capability for capability in capabilities if capability is not None), default=None
        )
        factors[name] = _estimate_factor(
            c, smallest_u, replace(g, sensitivity=triad.by_gravity.get(name, 0.0))
        )
    # No CMC is stated for the matrix: its u grows by the largest factor of its parameters.
    matrix_factor = max(
        (f for name, f in factors.items() if not name.startswith("offset.")), default=1.0
    )
    matrix = triad.u_matrix and [[matrix_factor * u for u in row] for row in triad.u_matrix]
    return triad.model_copy(
        update={
            "u_matrix": matrix,
            "parameters": {
                name: _scale_u(c, factors[name]) for name, c in triad.parameters.items()
            },
            "correlation": _rescale_correlation(triad.correlation, factors),
        }
    )


def cmc_lines(result: Result, certified: Result, lab: Lab) -> list[str]:
    """Return a sentence for each coefficient whose uncertainty the CMC made larger.

    lab: The laboratory's data.
    """
    lines = []
    pairs = [
        (f"{symbol} of {name}", c, certified.accelerometers[name].coefficients[symbol])
        for name in lab.certified(result)
        for symbol, c in result.accelerometers[name].coefficients.items()
    ]
    evaluated_triad, certified_triad_result = (
        certified_triad(source, lab.certified(result)) for source in (result, certified)
    )
    if evaluated_triad is not None and certified_triad_result is not None:
        pairs += [
            (parameter_words(name), c, certified_triad_result.parameters[name])
            for name, c in evaluated_triad.parameters.items()
        ]
    for words, c, certified_coefficient in pairs:
        if c.u and certified_coefficient.u and certified_coefficient.u > c.u:
            unit, factor = field_unit(c.unit)
            evaluated = format_uncertainty(coverage_factor(c.dof) * c.u * factor)
            lines.append(
                f"{words}: the evaluated uncertainty is U = {evaluated} {unit}. The "
                "certificate states the calibration and measurement capability instead, "
                "because this is the smallest uncertainty that the laboratory may state."
            )
    return lines


def _cmc_factor(result: Result, lab: Lab, name: str, symbol: str) -> float:
    """Return the factor by which u must grow, in g-units: 1 if it is large enough."""
    c = result.accelerometers[name].coefficients[symbol]
    smallest_u = lab.capability(symbol, result.inputs.gravity) if symbol in TERMS else None
    return _estimate_factor(c, smallest_u, result.gravity_of(name, symbol))


def _estimate_factor(c: Coefficient, smallest_u: float | None, g: StatedGravity) -> float:
    """Return the factor by which u of an estimate must grow to reach the smallest U.

    smallest_u: Smallest U, in the unit of the estimate; None: not stated.
    """
    if smallest_u is None or not c.u or c.value is None:
        return 1.0
    estimate = convert_to_si(c.value, c.u, c.unit, c.dof, g)
    # In SI the uncertainty of g may contribute less; U must not fall below the limit there either.
    missing_variance = max(
        (smallest_u / coverage_factor(dof)) ** 2 - u**2
        for u, dof in (
            (c.u, c.dof),
            (estimate.u / to_si(1.0, c.unit, g.value), estimate.dof),
        )
    )
    return math.sqrt(1.0 + max(missing_variance, 0.0) / c.u**2)


def _scale_u(coefficient: Coefficient, factor: float) -> Coefficient:
    if factor == 1.0 or coefficient.u is None:
        return coefficient
    return coefficient.model_copy(update={"u": coefficient.u * factor})


def _rescale_correlation(
    correlation: Correlation | None, factors: Mapping[str, float]
) -> Correlation | None:
    if correlation is None:
        return None
    row_factors = [factors.get(term, 1.0) for term in correlation.terms]
    matrix = [
        [r if i == j else r / (row_factors[i] * row_factors[j]) for j, r in enumerate(row)]
        for i, row in enumerate(correlation.matrix)
    ]
    return correlation.model_copy(update={"matrix": matrix})
