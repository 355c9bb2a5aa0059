"""Evaluate operating tests of an accelerometer from a table of inputs, or of a warm-up."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

import numpy as np

from counterspin._version import __version__
from counterspin.arrays import Array
from counterspin.errors import CampaignError, RecordError, UsageError
from counterspin.input import read_file, to_path
from counterspin.operating_tests import model
from counterspin.operating_tests.model import Line, OperatingEstimate
from counterspin.operating_tests.result import OperatingQuantity, OperatingTests
from counterspin.records.formats import read_numbers

#: Largest number of rows of a table.
_MAX_ROWS: Final = 1_000_000

#: Largest number of rows that a result stores for its figure.
_MAX_FIGURE_ROWS: Final = 2_000


def operating(
    file: Path | str,
    *,
    output: str,
    input: str | None = None,
    time: str | None = None,
    input_unit: str = "g",
    output_unit: str = "",
    full_scale: float | None = None,
) -> OperatingTests:
    """Evaluate the operating tests of IEEE Std 1293 from a table.

    With `input`: linearity, hysteresis, threshold, resolution and dead band. With `time`: warm-up.

    Parameters
    ----------
    file
        Table in any record format, with rows in the order of recording.
    output
        Column of the outputs.
    input
        Column of the applied inputs.
    time
        Column of the times since switching on, s.
    input_unit, output_unit
        Units, for tables and figures.
    full_scale
        Full scale of the input, in its unit; default: the largest input of the table.

    Returns
    -------
    OperatingTests
        Each test with its standard uncertainty.

    Raises
    ------
    CampaignError
        If the arguments contradict each other, or the table does not suit the tests.
    RecordError
        If the file or a column cannot be read.
    """
    path = to_path(file, "a table, or the path of its file")
    if (input is None) == (time is None):
        problem = "give an input column, or a time column for a warm-up test, but not both"
        raise UsageError("operating", [problem])
    if output in (input, time):
        problem = f'"{output}" was given for both columns; give two different columns'
        raise UsageError("operating", [problem])
    if full_scale is not None and not 0.0 < full_scale < math.inf:
        raise UsageError("operating", ["`full_scale`: must be greater than zero"])
    x, outputs, digest = _read_columns(path, str(input or time), output)
    try:
        if input is not None:
            scale = full_scale or float(np.max(np.abs(x)))
            line = model.fit_line(x, outputs)
            quantities = list(_static_quantities(line, x, outputs, scale, input_unit, output_unit))
            noise = line.noise, line.dof, line.from_repeats
        else:
            scale = full_scale or 0.0
            warm_up = model.fit_warm_up(x, outputs)
            quantities = list(_warm_up_quantities(warm_up, output_unit))
            residuals = outputs - _warm_up_curve(warm_up, x)
            dof = float(outputs.size - 3)
            noise = math.sqrt(float(residuals @ residuals) / dof), dof, False
    except ValueError as error:
        raise CampaignError(path.name, [str(error)], code="not-evaluable") from error
    plotted_rows = np.unique(np.linspace(0, x.size - 1, min(x.size, _MAX_FIGURE_ROWS)).astype(int))
    plotted_x = x[plotted_rows].tolist()
    return OperatingTests(
        file=path.name,
        sha256=digest,
        version=__version__,
        input_unit=input_unit if input is not None else "s",
        output_unit=output_unit,
        full_scale=scale,
        noise=noise[0],
        noise_dof=noise[1],
        noise_from_repeats=noise[2],
        quantities=quantities,
        time=[] if input is not None else plotted_x,
        inputs=plotted_x if input is not None else [],
        outputs=outputs[plotted_rows].tolist(),
    )


def _read_columns(path: Path, x_column: str, output: str) -> tuple[Array, Array, str]:
    """Return two columns without incomplete rows, and the SHA-256 of the file."""
    content = read_file(path)
    names = [x_column, output]
    columns = read_numbers(path, names)
    table = np.column_stack([np.asarray(columns[name], dtype=np.float64) for name in names])
    table = table[np.isfinite(table).all(axis=1)]
    if not 0 < len(table) <= _MAX_ROWS:
        raise RecordError(
            f"{path}: {len(table)} rows contain numbers; 1 to {_MAX_ROWS} are allowed",
            code="no-rows",
        )
    return table[:, 0].copy(), table[:, 1].copy(), hashlib.sha256(content).hexdigest()


def _static_quantities(
    line: Line, inputs: Array, outputs: Array, full_scale: float, input_unit: str, output_unit: str
) -> Iterator[OperatingQuantity]:
    """Yield the results of the tests with inputs."""
    slope_unit = f"{output_unit or '1'}/{input_unit}"
    yield _make_quantity(
        "scale-factor",
        OperatingEstimate(line.slope, line.u_slope),
        slope_unit,
        "slope of the fitted line",
    )
    yield _make_quantity(
        "bias",
        OperatingEstimate(line.intercept / line.slope, line.u_intercept / abs(line.slope)),
        input_unit,
        "intercept of the fitted line divided by the slope",
    )
    linearity_definition = "largest deviation of a setting from the least-squares line"
    yield _make_quantity(
        "linearity-error",
        model.linearity_error(line, inputs),
        input_unit,
        linearity_definition,
        full_scale,
    )
    tests: tuple[tuple[str, Callable[[], OperatingEstimate | None], str, str], ...] = (
        (
            "hysteresis-error",
            lambda: model.hysteresis_error(line, inputs, outputs),
            (
                "largest difference between the outputs at the same input, approached from below "
                "and from above"
            ),
            "no input was approached both from below and from above",
        ),
        (
            "threshold",
            lambda: model.smallest_step(line, inputs, outputs, is_from_zero=True),
            (
                "smallest step from zero input that changes the output by at least 50 % of the "
                "expected change"
            ),
            "no step from zero input changes the output by at least 50 % of the expected change",
        ),
        (
            "resolution",
            lambda: model.smallest_step(line, inputs, outputs, is_from_zero=False),
            (
                "smallest input step, starting above the threshold, that changes the output by at "
                "least 50 % of the expected change"
            ),
            (
                "no step above the threshold changes the output by at least 50 % of the expected "
                "change"
            ),
        ),
        (
            "dead-band",
            lambda: model.dead_band(line, inputs, outputs),
            "width of the dead band, the input range about zero in which the output changes by "
            "less than 10 % of the expected change",
            "the zero input, or an input outside the dead band on each side, is missing",
        ),
    )
    for name, run_test, definition, missing_reason in tests:
        estimate = run_test()
        yield _make_quantity(
            name,
            estimate,
            input_unit,
            missing_reason if estimate is None else definition,
            full_scale,
        )


def _warm_up_quantities(warm_up: model.WarmUp, output_unit: str) -> Iterator[OperatingQuantity]:
    """Yield the results of a warm-up."""
    definition = "output = final + change exp(-t/tau) after switching on"
    yield _make_quantity("time-constant", warm_up.time_constant, "s", definition)
    yield _make_quantity("final-output", warm_up.final, output_unit, "output after the warm-up")
    yield _make_quantity(
        "change", warm_up.change, output_unit, "output at switch-on minus final output"
    )
    abs_change, u = abs(warm_up.change.value), warm_up.final.u or 0.0
    if abs_change > u > 0.0:
        tau = warm_up.time_constant
        factor = math.log(abs_change / u)
        time = OperatingEstimate(tau.value * factor, (tau.u or 0.0) * factor)
        note = "time until the remaining change is less than u of the final output"
        yield _make_quantity("warm-up-time", time, "s", note)


def _warm_up_curve(warm_up: model.WarmUp, time: Array) -> Array:
    decay = np.exp(-time / warm_up.time_constant.value)
    return np.asarray(warm_up.final.value + warm_up.change.value * decay)


def _make_quantity(
    name: str,
    estimate: OperatingEstimate | None,
    unit: str,
    note: str,
    full_scale: float | None = None,
) -> OperatingQuantity:
    """Return a result; full_scale: of the input, if a percentage is meaningful."""
    value, u = (None, None) if estimate is None else (estimate.value, estimate.u)
    factor = 100.0 / full_scale if full_scale else None
    return OperatingQuantity(
        name=name,
        value=value,
        u=u,
        unit=unit,
        percent=None if value is None or factor is None else value * factor,
        u_percent=None if u is None or factor is None else u * factor,
        at=None if estimate is None else estimate.input_value,
        note=note,
    )
