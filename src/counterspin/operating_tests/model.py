"""Estimates of operating tests from inputs and outputs in the order of recording."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array
from counterspin.frozen import frozen

#: Ratio of observed to expected change from which a step is visible (IEEE Std 528).
MIN_VISIBLE_RATIO: Final = 0.5

#: Ratio of observed to expected change below which an input is in the dead band.
DEAD_BAND_RATIO: Final = 0.1

#: Difference relative to the largest input below which inputs are equal.
_INPUT_TOLERANCE: Final = 1e-12

#: Smallest degrees of freedom of repeats for estimating the noise of a point from them.
_MIN_DOF: Final = 3

#: Smallest ratio of a slope to its standard uncertainty that proves a response to the input.
_MIN_SLOPE_RATIO: Final = 3.0

#: Largest magnitude of a number in a table, so that its square is finite.
_MAX_MAGNITUDE: Final = 1e150

_SQRT_12: Final = math.sqrt(12.0)


@frozen
class Line:
    """Least-squares line output = intercept + slope x input."""

    slope: float  #: Output per input unit.
    u_slope: float
    intercept: float
    u_intercept: float
    residuals: Array  #: Output minus line, shape (n,).
    leverages: Array  #: Leverages of the points, shape (n,).
    noise: float  #: Standard deviation of a point.
    dof: float  #: Degrees of freedom of `noise`.
    from_repeats: bool  #: Whether `noise` was estimated from repeats at the same input.


@frozen
class OperatingEstimate:
    """A value with its standard uncertainty; None if the data do not determine it."""

    value: float
    u: float | None
    input_value: float | None = None  #: Input at which the value was found.


def group_inputs(inputs: Array) -> npt.NDArray[np.intp]:
    """Return the index of the setting of each input, shape (n,); equal inputs share an index."""
    max_magnitude = float(np.max(np.abs(inputs), initial=0.0)) or 1.0
    rounded_inputs = np.round(inputs / (max_magnitude * _INPUT_TOLERANCE))
    return np.asarray(np.unique(rounded_inputs, return_inverse=True)[1].reshape(-1), dtype=np.intp)


def _require_finite_squares(*columns: Array) -> None:
    if any(np.max(np.abs(column), initial=0.0) > _MAX_MAGNITUDE for column in columns):
        raise ValueError(f"a number is larger than {_MAX_MAGNITUDE:g}")


def input_directions(inputs: Array) -> npt.NDArray[np.intp]:
    """Return 1 for an increased input, -1 for a decreased one, 0 for an unchanged one."""
    settings = group_inputs(inputs)
    return np.asarray(np.sign(np.diff(settings, prepend=settings[:1])), dtype=np.intp)


def fit_line(inputs: Array, outputs: Array) -> Line:
    """Fit a line and estimate the noise from repeats in the same direction, or from residuals.

    Raises ValueError if there are fewer than three points or two inputs, or if the output does not
    depend on the input.
    """
    _require_finite_squares(inputs, outputs)
    settings = group_inputs(inputs)
    n_settings = int(settings.max(initial=-1)) + 1
    if inputs.size < 3 or n_settings < 2:
        raise ValueError("a straight line requires at least three points at two or more inputs")
    centred_inputs = inputs - inputs.mean()
    square_sum = float(centred_inputs @ centred_inputs)
    slope = float(centred_inputs @ outputs) / square_sum
    intercept = float(outputs.mean()) - slope * float(inputs.mean())
    residuals = outputs - intercept - slope * inputs
    groups = np.unique(3 * settings + input_directions(inputs), return_inverse=True)[1].reshape(-1)
    means = np.bincount(groups, outputs) / np.bincount(groups)
    repeat_dof = inputs.size - means.size
    from_repeats = repeat_dof >= _MIN_DOF
    deviations = outputs - means[groups] if from_repeats else residuals
    dof = float(repeat_dof if from_repeats else inputs.size - 2)
    noise = math.sqrt(float(deviations @ deviations) / dof)
    u_slope = noise / math.sqrt(square_sum)
    if not abs(slope) > _MIN_SLOPE_RATIO * u_slope:
        raise ValueError("the output does not depend on the input; check the two columns")
    u_intercept = noise * math.sqrt(1.0 / inputs.size + float(inputs.mean()) ** 2 / square_sum)
    leverages = 1.0 / inputs.size + centred_inputs**2 / square_sum
    return Line(
        slope, u_slope, intercept, u_intercept, residuals, leverages, noise, dof, from_repeats
    )


def linearity_error(line: Line, inputs: Array) -> OperatingEstimate:
    """Return the largest deviation of the mean at a setting from the line, in input units."""
    settings = group_inputs(inputs)
    counts = np.bincount(settings)
    means = np.bincount(settings, line.residuals) / counts
    worst_setting = int(np.argmax(np.abs(means)))
    leverage = float(line.leverages[settings == worst_setting][0])
    u = line.noise * math.sqrt(max(1.0 / counts[worst_setting] - leverage, 0.0)) / abs(line.slope)
    worst_input = float(inputs[settings == worst_setting][0])
    return OperatingEstimate(float(means[worst_setting]) / line.slope, u, worst_input)


def hysteresis_error(line: Line, inputs: Array, outputs: Array) -> OperatingEstimate | None:
    """Return the largest difference of outputs at an input approached from both directions.

    In input units, upwards minus downwards. None: no input was approached from both directions.
    """
    settings, directions = group_inputs(inputs), input_directions(inputs)
    n_settings = int(settings.max()) + 1
    n_up, n_down = (
        np.bincount(settings[mask], minlength=n_settings)
        for mask in (directions > 0, directions < 0)
    )
    common_settings = np.flatnonzero((n_up > 0) & (n_down > 0))
    if not common_settings.size:
        return None
    up_mean, down_mean = (
        np.bincount(settings[mask], outputs[mask], minlength=n_settings)[common_settings]
        / counts[common_settings]
        for mask, counts in ((directions > 0, n_up), (directions < 0, n_down))
    )
    differences = (up_mean - down_mean) / line.slope
    worst_index = int(np.argmax(np.abs(differences)))
    setting = common_settings[worst_index]
    u = line.noise * math.sqrt(1.0 / n_up[setting] + 1.0 / n_down[setting]) / abs(line.slope)
    worst_input = float(inputs[np.argmax(settings == setting)])
    return OperatingEstimate(float(differences[worst_index]), u, worst_input)


def smallest_step(
    line: Line, inputs: Array, outputs: Array, *, is_from_zero: bool
) -> OperatingEstimate | None:
    """Return the smallest visible step of the input: threshold or resolution.

    A step is visible if the output changes by at least half of the predicted change, also for all
    larger steps. The limit lies between this step and the next smaller tested step. The estimate is
    their mean, with the uncertainty of a rectangular distribution.

    is_from_zero: True: steps from zero input (threshold); false: from inputs larger than the step.
    """
    steps, starts = np.diff(inputs), np.abs(inputs[:-1])
    tolerance = _INPUT_TOLERANCE * float(np.max(np.abs(inputs), initial=0.0))
    is_valid_start = starts <= tolerance if is_from_zero else starts > np.abs(steps) + tolerance
    is_tested = is_valid_start & (steps != 0.0)
    step_sizes = np.abs(steps[is_tested])
    if not step_sizes.size:
        return None
    is_visible = np.diff(outputs)[is_tested] / (line.slope * steps[is_tested]) >= MIN_VISIBLE_RATIO
    order = np.argsort(step_sizes, kind="stable")
    step_sizes, is_visible = step_sizes[order], is_visible[order]
    hidden_indices = np.flatnonzero(~is_visible)
    if hidden_indices.size and hidden_indices[-1] == step_sizes.size - 1:
        return None
    max_hidden_step = float(step_sizes[hidden_indices[-1]]) if hidden_indices.size else 0.0
    min_visible_step = float(step_sizes[step_sizes > max_hidden_step][0])
    midpoint = 0.5 * (max_hidden_step + min_visible_step)
    return OperatingEstimate(midpoint, (min_visible_step - max_hidden_step) / _SQRT_12)


def dead_band(line: Line, inputs: Array, outputs: Array) -> OperatingEstimate | None:
    """Return the width of the input range about zero with less than 10 % of the expected change.

    The change is relative to the output at zero. None: no zero input was recorded, or no
    input on one side is outside the dead band.
    """
    max_magnitude = float(np.max(np.abs(inputs), initial=0.0))
    is_zero = np.abs(inputs) <= _INPUT_TOLERANCE * max_magnitude
    if not is_zero.any():
        return None
    indicated_inputs = (outputs - outputs[is_zero].mean()) / line.slope
    limits, variance = [], 0.0
    for sign in (-1.0, 1.0):
        mask = sign * inputs > _INPUT_TOLERANCE * max_magnitude
        order = np.argsort(sign * inputs[mask], kind="stable")
        side_inputs = (sign * inputs[mask])[order]
        is_visible = (sign * indicated_inputs[mask])[order] >= DEAD_BAND_RATIO * side_inputs
        hidden_indices = np.flatnonzero(~is_visible)
        if not is_visible.size or (
            hidden_indices.size and hidden_indices[-1] == is_visible.size - 1
        ):
            return None
        inner_limit = float(side_inputs[hidden_indices[-1]]) if hidden_indices.size else 0.0
        outer_limit = float(side_inputs[side_inputs > inner_limit][0])
        limits.append(0.5 * (inner_limit + outer_limit))
        variance += ((outer_limit - inner_limit) / _SQRT_12) ** 2
    return OperatingEstimate(sum(limits), math.sqrt(variance))


@frozen
class WarmUp:
    """Exponential approach of the output after switching on: final + change exp(-t / tau)."""

    time_constant: OperatingEstimate  #: s.
    final: OperatingEstimate  #: Output.
    change: OperatingEstimate  #: Output at the start minus `final`.


def fit_warm_up(time: Array, outputs: Array) -> WarmUp:
    """Fit an exponential by least squares.

    time: Time since switching on, s, shape (n,).

    Raises ValueError if the data do not determine a time constant.
    """
    from scipy.optimize import curve_fit

    if time.size < 6 or not np.all(np.diff(time) > 0.0):
        raise ValueError("a warm-up test requires at least six rows with increasing times")
    _require_finite_squares(time, outputs)
    if np.ptp(outputs) == 0.0:
        raise ValueError("the output does not change, so no warm-up can be determined")
    duration = float(time[-1] - time[0])

    def exponential(t: Array, final_output: float, change: float, rate: float) -> Array:
        return np.asarray(final_output + change * np.exp(-(t - time[0]) * rate / duration))

    initial_guess = (float(outputs[-1]), float(outputs[0] - outputs[-1]), 4.0)
    try:
        estimate, covariance = curve_fit(exponential, time, outputs, initial_guess, maxfev=2000)
    except RuntimeError as error:
        raise ValueError("no exponential function fits this warm-up") from error
    final, change, rate = (float(value) for value in estimate)
    u_final, u_change, u_rate = (float(u) for u in np.sqrt(np.diag(covariance)))
    if not math.isfinite(u_rate) or rate <= 2.0 * u_rate:
        raise ValueError("the record is too short or too noisy to determine a time constant")
    tau = duration / rate
    # The change refers to the first row; extrapolate it to t = 0.
    extrapolation_factor = math.exp(float(time[0]) / tau)
    return WarmUp(
        OperatingEstimate(tau, tau * u_rate / rate),
        OperatingEstimate(final, u_final),
        OperatingEstimate(change * extrapolation_factor, u_change * extrapolation_factor),
    )
