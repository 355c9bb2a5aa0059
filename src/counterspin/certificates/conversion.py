"""Conversion of the numbers of a certificate to SI; U is at least the laboratory's CMC.

The calibration and measurement capability (CMC) is the smallest uncertainty that the laboratory
may state. In SI, most of the uncertainty of g cancels.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Final

from counterspin.calibration.pages.triad import (
    describe_parameter,
    nominal_outputs,
    parameter_description,
)
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
    find_display_unit,
    format_estimate,
    format_number,
    format_uncertainty,
)
from counterspin.units import si_unit, to_si


def coefficients_in_si(result: Result, name: str) -> dict[str, SiEstimate]:
    """Return the determined coefficients of an accelerometer in SI units."""
    estimates = {}
    for symbol, coefficient in result.accelerometers[name].coefficients.items():
        if certificate_text.is_determined(coefficient):
            assert coefficient.value is not None
            assert coefficient.u is not None
            gravity = result.gravity_of(name, symbol)
            estimates[symbol] = convert_to_si(
                coefficient.value, coefficient.u, coefficient.unit, coefficient.dof, gravity
            )
    return estimates


#: Output quantity in the unit of the readings -> proportional coefficient.
OUTPUT_COEFFICIENTS: Final = {"bias": "K_F", "scale_factor": "K_I"}


def output_coefficients_in_si(result: Result, name: str) -> dict[str, SiEstimate]:
    """Return bias and scale factor in the SI unit of an accelerometer's readings.

    Quantities whose unit cannot be expressed in SI are omitted.
    """
    accelerometer = result.accelerometers[name]
    estimates = {}
    for key, coefficient in accelerometer.output.items():
        symbol = OUTPUT_COEFFICIENTS[key]
        base_coefficient = accelerometer.coefficients.get(symbol)
        if base_coefficient is None or not certificate_text.is_determined(coefficient):
            continue
        assert coefficient.value is not None
        assert coefficient.u is not None
        gravity = result.gravity_of(name, symbol)
        # The output is the coefficient times the nominal sensitivity, which is exact.
        if accelerometer.nominal is not None:
            scale = accelerometer.nominal.sensitivity
        else:
            scale = (
                coefficient.value / base_coefficient.value
                if base_coefficient.value
                else coefficient.u / (base_coefficient.u or math.inf)
            )
        scaled_gravity = replace(gravity, sensitivity=gravity.sensitivity * scale)
        with suppress(ValueError):
            estimates[key] = convert_instrument_unit(
                coefficient.value, coefficient.u, coefficient.unit, coefficient.dof, scaled_gravity
            )
    return estimates


def to_si_with_exact_g(
    coefficients: Mapping[str, Coefficient], gravity: float
) -> dict[str, SiEstimate]:
    """Return coefficients in SI units, with g (m/s^2) taken as exact."""
    return {
        symbol: coefficient.to_si(gravity)
        for symbol, coefficient in coefficients.items()
        if certificate_text.is_determined(coefficient)
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
    """Return the displayed parameters by description, in g-units and in SI."""
    parameters_by_name = {
        name: describe_parameter(name, triad.parameters[name]) for name in triad.parameters
    }
    si_estimates = _parameters_in_si(
        result,
        triad,
        {name: parameter for name, (description, parameter) in parameters_by_name.items()},
    )
    return dict(parameters_by_name.values()), {
        parameters_by_name[name][0]: estimate for name, estimate in si_estimates.items()
    }


def _parameters_in_si(
    result: Result, triad: TriadResult, parameters: Mapping[str, Coefficient]
) -> dict[str, SiEstimate]:
    estimates, inputs = {}, result.inputs
    for name, parameter in parameters.items():
        if certificate_text.is_determined(parameter):
            assert parameter.value is not None
            assert parameter.u is not None
            gravity_sensitivity = triad.by_gravity.get(name, 0.0)
            gravity = StatedGravity(inputs.gravity, inputs.u_gravity, gravity_sensitivity)
            estimates[name] = convert_to_si(
                parameter.value, parameter.u, parameter.unit, parameter.dof, gravity
            )
    return estimates


def matrix_dof(triad: TriadResult) -> float | None:
    """Return the degrees of freedom of the matrix: the minimum of its parameters."""
    parameters = (
        parameter
        for name, parameter in triad.parameters.items()
        if name.startswith(("sensitivity", "angle"))
    )
    return min(
        (parameter.dof for parameter in parameters if parameter.dof is not None), default=None
    )


def triad_lines(triad: TriadResult) -> list[str]:
    """Return sentences on the method of the triad and on undetermined parameters."""
    names = ", ".join(triad.accelerometers)
    lines = [
        f"The accelerometers {names} form one sensor. In addition to their coefficients, the "
        "certificate gives parameters that do not depend on the frame of the sensor: offsets, "
        "sensitivities, and the angles between the sensitive axes (Geist, Gaitan et al., J. "
        "Res. NIST 122 (2017) 32)."
    ]
    if triad.poses:
        rms_text = ""
        if triad.rms_before is not None:
            rms_before_text = format_number(triad.rms_before, 3)
            rms_text = f" The rms difference between |f| and g is {rms_before_text} m/s^2"
            rms_after = triad.rms_after
            rms_text += (
                "."
                if rms_after is None
                else f" before and {format_number(rms_after, 3)} m/s^2 after correction."
            )
        lines.append(
            f"The sensor was at rest in {len(triad.poses)} poses of unknown attitude. The fit "
            "estimated the attitude in each pose together with the coefficients. Only the "
            f"magnitude of the specific force, the local gravity, was known.{rms_text}"
        )
    lines += [
        f'The parameter "{parameter_description(name)}" is not certified: '
        f"{certificate_text.undetermined_reason(parameter)}."
        for name, parameter in triad.parameters.items()
        if not certificate_text.is_determined(parameter)
    ]
    return lines


def matrix_table(
    names: Sequence[str],
    matrix: Sequence[Sequence[float]],
    expanded_matrix: Sequence[Sequence[float]],
    k: float,
) -> Table:
    """Return a table of the matrix of the corrected output with U and k."""
    rows = zip("xyz", matrix, expanded_matrix, strict=True)
    return Table(
        (Column("M ± U"), *(Column(name, "right") for name in names), Column("k", "right")),
        tuple(
            (f"f_{axis}", *map(_format_element, row, expanded_row), format_decimal(k))
            for axis, row, expanded_row in rows
        ),
    )


def _format_element(value: float, expanded_u: float) -> str:
    """Format an element of a matrix, with U unless the element is fixed."""
    return format_estimate(value, expanded_u, "") if expanded_u else format_number(value, 9)


def parameter_line(name: str, parameter: Coefficient) -> str:
    """Return a line on a determined parameter with U and k in g-units, and the SI unit."""
    description, displayed_parameter = describe_parameter(name, parameter)
    k = coverage_factor(displayed_parameter.dof)
    quantity = "value" if displayed_parameter.value == parameter.value else "angle"
    remark = certificate_text.unit_remark(si_unit(displayed_parameter.unit)[0], quantity)
    estimate_text = (
        f"{certificate_text.format_in_g_units(displayed_parameter, k)} (U, k = {format_decimal(k)})"
    )
    return f"{description} = {estimate_text}. {remark}"


def triad_output_lines(result: Result, triad: TriadResult) -> list[str]:
    """Return a paragraph on the corrected output; empty without a matrix."""
    if triad.matrix is None:
        return []
    nominal_text = nominal_outputs(result, triad)
    divisor_text = f" ({nominal_text})" if nominal_text else ""
    names = ", ".join(triad.accelerometers)
    other_terms = [name for name in triad.parameters if name.split(".")[0] in triad.accelerometers]
    minus_text = f", minus the contributions of {', '.join(other_terms)}" if other_terms else ""
    return [
        f"Corrected output: f = M (y - b). Here, y are the indications of {names} divided by "
        f"their nominal sensitivities{divisor_text}{minus_text}, and b are the offsets. "
        "The components of f are along the axes x, y, z in which the campaign states the "
        "directions of the accelerometers: east, north and up while the sensor is level. "
        "Misalignments that are not listed above have their stated values or, without a stated "
        "value, zero."
    ]


# Capability


def apply_cmc_floor(result: Result, lab: Lab) -> Result:
    """Increase the expanded uncertainties of a result to the laboratory's CMC if necessary.

    The added variance is independent (ILAC-P14:09/2020, 5.4): covariances do not change, and
    correlations become smaller. Degrees of freedom and k do not change.
    """
    if not lab.cmc:
        return result
    u_factors = {
        f"{name}.{symbol}": _cmc_factor(result, lab, name, symbol)
        for name, accelerometer in result.accelerometers.items()
        for symbol in accelerometer.coefficients
    }
    accelerometers = {
        name: accelerometer.model_copy(
            update={
                "coefficients": {
                    symbol: _scale_u(coefficient, u_factors[f"{name}.{symbol}"])
                    for symbol, coefficient in accelerometer.coefficients.items()
                },
                "output": {
                    key: _scale_u(
                        coefficient, u_factors.get(f"{name}.{COMMON_NAMES.get(key)}", 1.0)
                    )
                    for key, coefficient in accelerometer.output.items()
                },
                "correlation": _rescale_correlation(
                    accelerometer.correlation,
                    {
                        symbol: u_factors[f"{name}.{symbol}"]
                        for symbol in accelerometer.coefficients
                    },
                ),
            }
        )
        for name, accelerometer in result.accelerometers.items()
    }
    return result.model_copy(
        update={
            "accelerometers": accelerometers,
            "correlation": _rescale_correlation(result.correlation, u_factors),
            "triad": None
            if result.triad is None
            else _apply_cmc_floor_to_triad(result, result.triad, lab),
        }
    )


#: Type of a triad's parameter -> the terms whose CMC limits it.
_CMC_TERMS: Final = {"offset": ("K_F",), "sensitivity": ("K_I",), "angle": ("delta_O", "delta_P")}


def _apply_cmc_floor_to_triad(result: Result, triad: TriadResult, lab: Lab) -> TriadResult:
    """Increase the expanded uncertainties of a triad to the CMC of its terms if necessary."""
    gravity = StatedGravity(result.inputs.gravity, result.inputs.u_gravity)
    factors = {}
    for name, parameter in triad.parameters.items():
        parameter_type, _, symbol = name.partition(".")
        capabilities = [
            lab.capability(term_symbol, gravity.value)
            for term_symbol in _CMC_TERMS.get(parameter_type, (symbol,))
        ]
        min_expanded_u = max(
            (capability for capability in capabilities if capability is not None), default=None
        )
        factors[name] = _inflation_factor(
            parameter, min_expanded_u, replace(gravity, sensitivity=triad.by_gravity.get(name, 0.0))
        )
    # No CMC is stated for the matrix: its u grows by the largest factor of its parameters.
    matrix_factor = max(
        (factor for name, factor in factors.items() if not name.startswith("offset.")), default=1.0
    )
    u_matrix = triad.u_matrix and [[matrix_factor * u for u in row] for row in triad.u_matrix]
    return triad.model_copy(
        update={
            "u_matrix": u_matrix,
            "parameters": {
                name: _scale_u(parameter, factors[name])
                for name, parameter in triad.parameters.items()
            },
            "correlation": _rescale_correlation(triad.correlation, factors),
        }
    )


def cmc_lines(result: Result, certified_result: Result, lab: Lab) -> list[str]:
    """Return sentences on the coefficients whose uncertainty was increased to the CMC.

    certified_result: Result after `apply_cmc_floor`.
    """
    lines, names = [], lab.certified_names(result)
    compared_values = [
        (
            f"{symbol} of {name}",
            coefficient,
            certified_result.accelerometers[name].coefficients[symbol],
        )
        for name in names
        for symbol, coefficient in result.accelerometers[name].coefficients.items()
    ]
    triad = certified_triad(result, names)
    final_triad = certified_triad(certified_result, names)
    if triad is not None and final_triad is not None:
        compared_values += [
            (parameter_description(name), coefficient, final_triad.parameters[name])
            for name, coefficient in triad.parameters.items()
        ]
    for description, coefficient, certified_coefficient in compared_values:
        if coefficient.u and certified_coefficient.u and certified_coefficient.u > coefficient.u:
            unit, factor = find_display_unit(coefficient.unit)
            u_text = format_uncertainty(coverage_factor(coefficient.dof) * coefficient.u * factor)
            lines.append(
                f"{description}: the evaluated uncertainty is U = {u_text} {unit}. The "
                "certificate states the calibration and measurement capability instead, "
                "because this is the smallest uncertainty that the laboratory may state."
            )
    return lines


def _cmc_factor(result: Result, lab: Lab, name: str, symbol: str) -> float:
    """Return the factor by which u of a coefficient must increase to reach the CMC, at least 1."""
    coefficient = result.accelerometers[name].coefficients[symbol]
    min_expanded_u = lab.capability(symbol, result.inputs.gravity) if symbol in TERMS else None
    return _inflation_factor(coefficient, min_expanded_u, result.gravity_of(name, symbol))


def _inflation_factor(
    coefficient: Coefficient, min_expanded_u: float | None, gravity: StatedGravity
) -> float:
    """Return the factor by which u must increase to reach a minimum U, at least 1.

    min_expanded_u: Minimum U in the unit of the coefficient; None: no limit.
    """
    if min_expanded_u is None or not coefficient.u or coefficient.value is None:
        return 1.0
    estimate = convert_to_si(
        coefficient.value, coefficient.u, coefficient.unit, coefficient.dof, gravity
    )
    # In SI, the uncertainty of g may contribute less; U must reach the limit there too.
    missing_variance = max(
        (min_expanded_u / coverage_factor(dof)) ** 2 - u**2
        for u, dof in (
            (coefficient.u, coefficient.dof),
            (estimate.u / to_si(1.0, coefficient.unit, gravity.value), estimate.dof),
        )
    )
    return math.sqrt(1.0 + max(missing_variance, 0.0) / coefficient.u**2)


def _scale_u(coefficient: Coefficient, factor: float) -> Coefficient:
    if factor == 1.0 or coefficient.u is None:
        return coefficient
    return coefficient.model_copy(update={"u": coefficient.u * factor})


def _rescale_correlation(
    correlation: Correlation | None, factors: Mapping[str, float]
) -> Correlation | None:
    if correlation is None:
        return None
    scale = [factors.get(term, 1.0) for term in correlation.terms]
    matrix = [
        [value if i == j else value / (scale[i] * scale[j]) for j, value in enumerate(row)]
        for i, row in enumerate(correlation.matrix)
    ]
    return correlation.model_copy(update={"matrix": matrix})
