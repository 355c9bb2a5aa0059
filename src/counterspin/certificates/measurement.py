"""Measurement results of a certificate: methods, conditions, coefficients (DCC, second ring)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final

from counterspin.calibration.notebook.si_estimate import SiEstimate
from counterspin.calibration.pages.motions import readings_of
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import AccelerometerResult, Coefficient, Correlation
from counterspin.certificates import wording
from counterspin.certificates.administrative import item_id, software
from counterspin.certificates.conversion import covariance, in_si, output_in_si
from counterspin.certificates.coverage import region_factor
from counterspin.certificates.elements import (
    Element,
    attached,
    dcc,
    distribution,
    factor,
    number,
    real,
    rich,
    si,
    text,
)
from counterspin.certificates.lab import ITEM_STATES, Lab
from counterspin.certificates.statements import quantity_id
from counterspin.inference.conformity import COVERAGE
from counterspin.physics.si_units import SiUnit, si_unit, to_si
from counterspin.physics.terms import SHARED_TERMS

#: What the measurement result across accelerometers is called.
TOGETHER: Final = "All accelerometers together"


def measurement_results(lab: Lab, result: Result, original: Result) -> Element:
    """Return ``dcc:measurementResults``; the result file itself is among the meta data.

    lab: The laboratory's data.
    """
    return dcc(
        "measurementResults",
        dcc("measurementMetaData", _result_file(original), _input_files(result)),
        *(_accelerometer(lab, result, name) for name in lab.certified(result)),
        _all_together(lab, result),
    )


def _circumstances(lab: Lab, result: Result) -> Iterator[Element]:
    """Yield methods, software and conditions, which each measurement result has of its own."""
    yield dcc("usedMethods", *_methods(lab, result))
    yield dcc("usedSoftware", software(result.provenance.version))
    yield dcc("influenceConditions", *_conditions(lab, result))


# Methods and conditions


def _methods(lab: Lab, result: Result) -> Iterator[Element]:
    procedure = lab.certificate.procedure
    yield dcc(
        "usedMethod",
        text("name", wording.method_name(result)),
        rich(
            "description",
            wording.BASED_ON,
            *wording.method_lines(result),
            *wording.deviation_lines(lab.certificate),
        ),
        # Not dcc:norm: the standard is departed from.
        None if procedure is None else dcc("reference", procedure),
    )
    yield dcc(
        "usedMethod",
        text("name", "Measurement uncertainty"),
        rich("description", wording.uncertainty_statement()),
        dcc("norm", "JCGM 100:2008"),
        dcc("norm", "JCGM 102:2011"),
        refType="basic_methodMeasurementUncertainty",
    )


def _conditions(lab: Lab, result: Result) -> Iterator[Element]:
    inputs = result.inputs
    if (state := lab.item.state) is not None:
        yield dcc(
            "influenceCondition",
            text("name", "State of the item"),
            dcc("status", ITEM_STATES[state]),
            dcc("data", rich("text", f"The item was calibrated {state}.")),
        )
    for name, value, u, unit in (
        ("Local gravity", inputs.gravity, inputs.u_gravity, inputs.gravity_unit),
        ("Geographic latitude", inputs.latitude, inputs.u_latitude, inputs.latitude_unit),
        ("Radius of the centrifuge", inputs.radius, inputs.u_radius, inputs.radius_unit),
    ):
        if name.startswith("Radius") and not value:
            continue  # of a campaign at rest
        yield _condition(name, _quantity(real(value, si_unit(unit)[0], u=u)))
    if result.runs:
        yield _condition(
            "Rotation rate of each run",
            *(
                _quantity(real(run.rate, si_unit(run.rate_unit)[0], u=run.u_rate), name)
                for name, run in result.runs.items()
            ),
        )
    rates = {
        (reading.name, reading.rate): None
        for readings in readings_of(result).values()
        for reading in readings
        if reading.rate
    }
    if rates:
        yield _condition(
            "Rotation rate of each reading",
            *(_quantity(real(rate, si_unit("rad/s")[0]), name) for name, rate in rates),
        )
    platform = {
        symbol: c
        for symbol, c in result.platform.items()
        if symbol in SHARED_TERMS and wording.is_determined(c)
    }
    if platform:
        yield _condition(
            "Platform, as estimated with the coefficients",
            *(_platform_term(symbol, c, inputs.gravity) for symbol, c in platform.items()),
        )
    temperature = lab.conditions.temperature
    if temperature is not None:
        quantity = real(temperature.value, r"\degreecelsius", u=temperature.u)
        yield _condition("Temperature", _quantity(quantity), ref_type="basic_temperature")


def _condition(name: str, *quantities: Element, ref_type: str | None = None) -> Element:
    return dcc(
        "influenceCondition",
        text("name", name),
        dcc("data", *quantities),
        refType=ref_type,
    )


def _quantity(value: Element, name: str | None = None) -> Element:
    return dcc("quantity", None if name is None else text("name", name), value)


def _platform_term(symbol: str, coefficient: Coefficient, gravity: float) -> Element:
    assert coefficient.value is not None
    assert coefficient.u is not None
    return dcc(
        "quantity",
        text("name", symbol),
        rich("description", SHARED_TERMS[symbol].words),
        real(
            to_si(coefficient.value, coefficient.unit, gravity),
            si_unit(coefficient.unit)[0],
            label=symbol,
            u=to_si(coefficient.u, coefficient.unit, gravity),
            dof=coefficient.dof,
        ),
    )


# The result file and the input files


def _result_file(result: Result) -> Element:
    return dcc(
        "metaData",
        text("name", "Complete result"),
        dcc(
            "data",
            attached(
                "byteData",
                "result.json",
                "application/json",
                result.content,
                "The calibration's result with budget, noise and residuals, which counterspin and "
                "other programs read.",
            ),
        ),
    )


def _input_files(result: Result) -> Element:
    lines = [f"{file} {checksum}" for file, checksum in result.provenance.shown]
    return dcc(
        "metaData",
        text("name", "Input files and their checksums"),
        rich("declaration", *lines) if lines else None,
    )


# One accelerometer


def _accelerometer(lab: Lab, result: Result, name: str) -> Element:
    accelerometer = result.accelerometers[name]
    estimates = in_si(result, name)
    item = item_id(lab, result, name)
    return dcc(
        "measurementResult",
        text("name", f"Accelerometer {name}"),
        *_circumstances(lab, result),
        dcc(
            "results",
            _coefficients(lab, result, name, estimates),
            _covariance(accelerometer.correlation, estimates),
            _in_output(result, name),
        ),
        _warnings(accelerometer),
        refId=item,
    )


def _in_output(result: Result, name: str) -> Element | None:
    """Return bias and scale factor in the unit of the readings, as words where SI has none."""
    if not (lines := wording.output_lines(result.accelerometers[name])):
        return None
    estimates = output_in_si(result, name)
    words = [line for key, line in lines.items() if key not in estimates]
    return dcc(
        "result",
        text("name", "In the unit of the readings"),
        dcc(
            "data",
            rich("text", *words) if words else None,
            *(
                dcc(
                    "quantity",
                    text("name", key.replace("_", " ").capitalize()),
                    rich("description", lines[key], wording.stated_in(estimate.unit)),
                    _real(key, estimate),
                    _degrees_of_freedom(estimate),
                    refType="basic_measuredValue",
                )
                for key, estimate in estimates.items()
            ),
        ),
    )


def _coefficients(
    lab: Lab, result: Result, name: str, estimates: Mapping[str, SiEstimate]
) -> Element:
    if not estimates:
        return dcc(
            "result",
            text("name", "Coefficients"),
            dcc("data", rich("text", "The records determine none of the coefficients.")),
        )
    coefficients = result.accelerometers[name].coefficients
    return dcc(
        "result",
        text("name", "Coefficients"),
        dcc(
            "data",
            *(
                dcc(
                    "quantity",
                    text("name", symbol),
                    rich("description", wording.coefficient_line(symbol, coefficients[symbol])),
                    _real(symbol, estimate),
                    _degrees_of_freedom(estimate),
                    id=quantity_id(lab, result, name, symbol),
                    refType="basic_measuredValue",
                )
                for symbol, estimate in estimates.items()
            ),
        ),
    )


def _real(symbol: str, estimate: SiEstimate) -> Element:
    return real(estimate.value, estimate.unit, label=symbol, u=estimate.u, dof=estimate.dof)


def _degrees_of_freedom(estimate: SiEstimate) -> Element:
    name = text("name", "Effective degrees of freedom")
    if estimate.dof is None:
        data = dcc("metaData", name, rich("declaration", "Infinite."))
    else:
        data = dcc("metaData", name, dcc("data", _quantity(real(estimate.dof, SiUnit()))))
    return dcc("measurementMetaData", data)


def _all_together(lab: Lab, result: Result) -> Element | None:
    """Return the covariance across accelerometers, which g, radius and platform make."""
    names = lab.certified(result)
    estimates = {
        f"{name}.{symbol}": estimate
        for name in names
        for symbol, estimate in in_si(result, name).items()
    }
    if len(names) < 2 or (together := _covariance(result.correlation, estimates)) is None:
        return None
    return dcc(
        "measurementResult",
        text("name", TOGETHER),
        *_circumstances(lab, result),
        dcc("results", together),
    )


def _covariance(
    correlation: Correlation | None, estimates: Mapping[str, SiEstimate]
) -> Element | None:
    """Return the covariance of the certified coefficients, where there are two or more."""
    if correlation is None:
        return None
    symbols = [symbol for symbol in correlation.terms if symbol in estimates]
    if len(symbols) < 2:
        return None
    columns = [
        si(
            "columnXMLList",
            *(
                si(
                    "covarianceXMLList",
                    si(
                        "valueXMLList",
                        number(covariance(correlation, estimates, row, column)),
                    ),
                    si("unitXMLList", (estimates[row].unit * estimates[column].unit).text),
                )
                for row in symbols
            ),
        )
        for column in symbols
    ]
    # The fewest of several degrees of freedom: the region is then rather too large.
    dof = min((d for s in symbols if (d := estimates[s].dof) is not None), default=None)
    return dcc(
        "result",
        text("name", "Coefficients together"),
        rich(
            "description",
            "The same estimates as a list, with their covariance matrix: of the standard "
            "uncertainties, in the order of the labels.",
        ),
        dcc(
            "data",
            dcc(
                "quantity",
                si(
                    "realListXMLList",
                    si("labelXMLList", " ".join(symbols)),
                    si("valueXMLList", " ".join(number(estimates[s].value) for s in symbols)),
                    si("unitXMLList", " ".join(estimates[s].unit.text for s in symbols)),
                    si(
                        "measurementUncertaintyMultivariateXMLList",
                        si(
                            "ellipsoidalRegionMUXMLList",
                            si("covarianceMatrixXMLList", *columns),
                            si("coverageFactorXMLList", factor(region_factor(len(symbols), dof))),
                            si("coverageProbabilityXMLList", factor(COVERAGE)),
                            si("distributionXMLList", distribution(dof)),
                        ),
                    ),
                ),
            ),
        ),
    )


def _warnings(accelerometer: AccelerometerResult) -> Element | None:
    if not accelerometer.warnings:
        return None
    return dcc(
        "measurementMetaData",
        dcc(
            "metaData",
            text("name", "Warnings"),
            rich("declaration", *map(wording.plainly, accelerometer.warnings)),
        ),
    )
