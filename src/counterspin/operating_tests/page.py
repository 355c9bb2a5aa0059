"""Report of operating tests."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from counterspin.operating_tests.result import OperatingQuantity, OperatingTests
from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Plot, PlotSeries, Table
from counterspin.reports.numbers import NOT_DETERMINED, format_estimate, format_number

#: Description in the file of a figure.
FILE_DESCRIPTION: Final = "a figure of operating tests"

#: Name of a test -> its words, and the test of IEEE Std 1293 that it belongs to.
_TEST_NAMES: Final = {
    "scale-factor": ("scale factor", "scale factor and bias"),
    "bias": ("bias", "scale factor and bias"),
    "linearity-error": ("linearity error", "linearity"),
    "hysteresis-error": ("hysteresis error", "hysteresis"),
    "threshold": ("threshold", "threshold and resolution"),
    "resolution": ("resolution", "threshold and resolution"),
    "dead-band": ("dead band", "threshold and resolution"),
    "time-constant": ("time constant", "warm-up and turn-on"),
    "final-output": ("final output", "warm-up and turn-on"),
    "change": ("change during warm-up", "warm-up and turn-on"),
    "warm-up-time": ("warm-up time", "warm-up and turn-on"),
}


def operating_blocks(result: OperatingTests) -> Iterator[Block]:
    """Yield the results of the tests, their figure and definitions."""
    yield Heading(f"Operating tests: {result.file}", 1)
    yield Table(
        (
            Column("Quantity"),
            Column("Value", "right"),
            Column("% of full scale", "right"),
            Column("At input", "right"),
            Column("Definition", wraps=True, min_width=24),
            Column("Test in IEEE Std 1293", wraps=True, min_width=12),
        ),
        tuple(_quantity_row(result, quantity) for quantity in result.quantities),
    ).without_empty_columns()
    yield operating_plot(result)
    basis_text = "repeats at the same input" if result.noise_from_repeats else "the residuals"
    noise_text = f"{format_number(result.noise)} {result.output_unit}".strip()
    full_scale_text = (
        f" The full scale is {format_number(result.full_scale, 6)} {result.input_unit}."
        if result.full_scale
        else ""
    )
    yield Paragraph(
        "The number after ± is the standard uncertainty (k = 1). The noise of a point is "
        f"{noise_text} with {format_number(result.noise_dof, 4)} degrees of freedom, estimated "
        f"from {basis_text}.{full_scale_text}",
        "quiet",
    )


def _quantity_row(result: OperatingTests, quantity: OperatingQuantity) -> tuple[str, ...]:
    test_name, standard_test = _TEST_NAMES[quantity.name]
    if quantity.value is None:
        return test_name, NOT_DETERMINED, "", "", quantity.note, standard_test
    percent_text = (
        ""
        if quantity.percent is None
        else format_estimate(quantity.percent, quantity.u_percent or 0.0, "")
    )
    input_text = (
        "" if quantity.at is None else f"{format_number(quantity.at, 6)} {result.input_unit}"
    )
    unit = "" if quantity.unit == "1" else quantity.unit
    value_text = format_estimate(quantity.value, quantity.u or 0.0, unit)
    return test_name, value_text, percent_text, input_text, quantity.note, standard_test


def operating_plot(result: OperatingTests) -> Plot:
    """Return the deviations from the line against the input, or the warm-up."""
    output_label = f"output, {result.output_unit}" if result.output_unit else "output"
    if not result.inputs:
        time = tuple(result.time)
        tau, final, change = (
            result.quantity(name).value or 0.0
            for name in ("time-constant", "final-output", "change")
        )
        fitted_outputs = final + change * np.exp(-np.array(time) / tau)
        return Plot(
            "Warm-up",
            "time since switch-on, s",
            output_label,
            (
                PlotSeries("recorded", time, tuple(result.outputs), kind="points"),
                PlotSeries("exponential", time, tuple(fitted_outputs.tolist()), kind="line"),
            ),
        )
    slope, bias = (result.quantity(name).value or 0.0 for name in ("scale-factor", "bias"))
    inputs = np.array(result.inputs)
    deviations = np.array(result.outputs) / slope - bias - inputs
    is_rising = np.diff(inputs, prepend=inputs[0]) >= 0.0
    series = tuple(
        PlotSeries(
            label, tuple(inputs[mask].tolist()), tuple(deviations[mask].tolist()), kind="points"
        )
        for label, mask in (("input rising", is_rising), ("input falling", ~is_rising))
        if mask.any()
    )
    unit = result.input_unit
    return Plot("Deviation from the line", f"input, {unit}", f"deviation, {unit}", series, (0.0,))
