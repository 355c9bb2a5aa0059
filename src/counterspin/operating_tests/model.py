"""Operating tests: estimates from inputs and outputs in the order in which they were recorded."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array
from counterspin.frozen import frozen

#: Part of the expected change of the output that shows a step of the input (IEEE Std 528).
THRESHOLD_RATIO: Final = 0.5

#: Part of the expected change below which an input lies in the dead band.
DEAD_BAND_RATIO: Final = 0.1

#: Inputs that differ by less, relative to the largest, are the same.
_SAME_INPUT: Final = 1e-12

#: Fewest degrees of freedom of repeats by which they determine the noise of a point.
_MIN_DOF: Final = 3

#: A slope that is not this many times its standard uncertainty shows no response to the input.
_MIN_SLOPE_RATIO: Final = 3.0

#: Largest size of a number in a table, so that its square is finite.
_MAX_SIZE: Final = 1e150

_SQRT_12: Final = math.sqrt(12.0)


@frozen
class Line:
    """Least-squares line output = intercept + slope x input."""

    slope: float  #: Output per input unit.
    u_slope: float
    intercept: float
    u_intercept: float
    residuals: Array  #: Output minus line, shape (n,).
    leverages: Array  #: Of the points, shape (n,).
    noise: float  #: Standard deviation of a point.
    dof: float  #: Degrees of freedom of `noise`.
    from_repeats: bool  #: Whether repeats at the same input determine it.


@frozen
class OperatingEstimate:
    """A value with its standard uncertainty; None if the data do not determine it."""

    value: float
    u: float | None
    at: float | None = None  #: Input at which it was found.


def group_inputs(inputs: Array) -> npt.NDArray[np.intp]:
    """Return the number of the setting of each input, equal inputs alike, shape (n,)."""
    size = float(np.max(np.abs(inputs), initial=0.0)) or 1.0
    rounded = np.round(inputs / (size * _SAME_INPUT))
    return np.asarray(np.unique(rounded, return_inverse=True)[1].reshape(-1), dtype=np.intp)


def _require_finite_squares(*columns: Array) -> None:
    if any(np.max(np.abs(column), initial=0.0) > _MAX_SIZE for column in columns):
        raise ValueError(f"a number is larger than {_MAX_SIZE:g}")


def directions(inputs: Array) -> npt.NDArray[np.intp]:
    """Return 1 where an input was reached upwards, -1 downwards, 0 where it did not change."""
    settings = group_inputs(inputs)
    return np.asarray(np.sign(np.diff(settings, prepend=settings[:1])), dtype=np.intp)


def fit_line(inputs: Array, outputs: Array) -> Line:
    """Fit a line; the noise is that of repeats at an input reached alike, else of the residuals.

    Raises ValueError if there are fewer than three points or two inputs, or if the output does not
    depend on the input.
    """
    _require_finite_squares(inputs, outputs)
    settings = group_inputs(inputs)
    count = int(settings.max(initial=-1)) + 1
    if inputs.size < 3 or count < 2:
        raise ValueError("a straight line requires at least three points at two or more inputs")
    centred = inputs - inputs.mean()
    square = float(centred @ centred)
    slope = float(centred @ outputs) / square
    intercept = float(outputs.mean()) - slope * float(inputs.mean())
    residuals = outputs - intercept - slope * inputs
    repeated = np.unique(3 * settings + directions(inputs), return_inverse=True)[1].reshape(-1)
    means = np.bincount(repeated, outputs) / np.bincount(repeated)
    repeat_dof = inputs.size - means.size
    from_repeats = repeat_dof >= _MIN_DOF
    deviations = outputs - means[repeated] if from_repeats else residuals
    dof = float(repeat_dof if from_repeats else inputs.size - 2)
    noise = math.sqrt(float(deviations @ deviations) / dof)
    u_slope = noise / math.sqrt(square)
    if not abs(slope) > _MIN_SLOPE_RATIO * u_slope:
        raise ValueError("the output does not depend on the input; check the two columns")
    u_intercept = noise * math.sqrt(1.0 / inputs.size + float(inputs.mean()) ** 2 / square)
    leverages = 1.0 / inputs.size + centred**2 / square
    return Line(
        slope, u_slope, intercept, u_intercept, residuals, leverages, noise, dof, from_repeats
    )


def linearity_error(line: Line, inputs: Array) -> OperatingEstimate:
    """Return the largest deviation of a setting's mean from the line, in the input's unit."""
    settings = group_inputs(inputs)
    counts = np.bincount(settings)
    means = np.bincount(settings, line.residuals) / counts
    worst = int(np.argmax(np.abs(means)))
    leverage = float(line.leverages[settings == worst][0])
    u = line.noise * math.sqrt(max(1.0 / counts[worst] - leverage, 0.0)) / abs(line.slope)
    at = float(inputs[settings == worst][0])
    return OperatingEstimate(float(means[worst]) / line.slope, u, at)


def hysteresis(line: Line, inputs: Array, outputs: Array) -> OperatingEstimate | None:
    """Return the largest difference of outputs at an input reached upwards and downwards.

    In the input's unit, upwards minus downwards. None: no input was reached both ways.
    """
    settings, direction = group_inputs(inputs), directions(inputs)
    count = int(settings.max()) + 1
    up, down = (
        np.bincount(settings[chosen], minlength=count) for chosen in (direction > 0, direction < 0)
    )
    both = np.flatnonzero((up > 0) & (down > 0))
    if not both.size:
        return None
    up_mean, down_mean = (
        np.bincount(settings[chosen], outputs[chosen], minlength=count)[both] / size[both]
        for chosen, size in ((direction > 0, up), (direction < 0, down))
    )
    differences = (up_mean - down_mean) / line.slope
    worst = int(np.argmax(np.abs(differences)))
    setting = both[worst]
    u = line.noise * math.sqrt(1.0 / up[setting] + 1.0 / down[setting]) / abs(line.slope)
    at = float(inputs[np.argmax(settings == setting)])
    return OperatingEstimate(float(differences[worst]), u, at)


def smallest_step(
    line: Line, inputs: Array, outputs: Array, *, from_zero: bool
) -> OperatingEstimate | None:
    """Return the smallest step of the input that the output shows: threshold, or resolution.

    A step shows if the output changes by at least half of what the slope predicts, and so do all
    larger steps. The limit lies between this step and the next smaller one that was tried; it is
    their mean, with the uncertainty of a rectangular distribution between them.

    from_zero: Steps from zero input (threshold), else from inputs larger than the step.
    """
    step, start = np.diff(inputs), np.abs(inputs[:-1])
    same = _SAME_INPUT * float(np.max(np.abs(inputs), initial=0.0))
    at_start = start <= same if from_zero else start > np.abs(step) + same
    tried = at_start & (step != 0.0)
    size = np.abs(step[tried])
    if not size.size:
        return None
    shown = np.diff(outputs)[tried] / (line.slope * step[tried]) >= THRESHOLD_RATIO
    order = np.argsort(size, kind="stable")
    size, shown = size[order], shown[order]
    hidden = np.flatnonzero(~shown)
    if hidden.size and hidden[-1] == size.size - 1:
        return None
    largest_hidden = float(size[hidden[-1]]) if hidden.size else 0.0
    smallest_shown = float(size[size > largest_hidden][0])
    middle = 0.5 * (largest_hidden + smallest_shown)
    return OperatingEstimate(middle, (smallest_shown - largest_hidden) / _SQRT_12)


def dead_band(line: Line, inputs: Array, outputs: Array) -> OperatingEstimate | None:
    """Return the width of the inputs about zero that change the output by less than 10 %.

    Of what the slope predicts from the output at zero. None: no zero input was recorded, or no
    input on one of its sides is outside the band.
    """
    size = float(np.max(np.abs(inputs), initial=0.0))
    zero = np.abs(inputs) <= _SAME_INPUT * size
    if not zero.any():
        return None
    change = (outputs - outputs[zero].mean()) / line.slope
    limits, variance = [], 0.0
    for side in (-1.0, 1.0):
        on_side = side * inputs > _SAME_INPUT * size
        tried, seen = side * inputs[on_side], side * change[on_side]
        order = np.argsort(tried, kind="stable")
        tried, seen = tried[order], seen[order] >= DEAD_BAND_RATIO * tried[order]
        hidden = np.flatnonzero(~seen)
        if not seen.size or (hidden.size and hidden[-1] == seen.size - 1):
            return None
        inner = float(tried[hidden[-1]]) if hidden.size else 0.0
        outer = float(tried[tried > inner][0])
        limits.append(0.5 * (inner + outer))
        variance += ((outer - inner) / _SQRT_12) ** 2
    return OperatingEstimate(sum(limits), math.sqrt(variance))


@frozen
class WarmUp:
    """Exponential approach of the output after switching on: final + change exp(-t / tau)."""

    time_constant: OperatingEstimate  #: s.
    final: OperatingEstimate  #: Output.
    change: OperatingEstimate  #: Output at the start minus `final`.


def fit_warm_up(time: Array, outputs: Array) -> WarmUp:
    """Fit an exponential by least squares.

    time: s from switching on, shape (n,).

    Raises ValueError if the data do not determine a time constant.
    """
    from scipy.optimize import curve_fit

    if time.size < 6 or not np.all(np.diff(time) > 0.0):
        raise ValueError("a warm-up test requires at least six rows with increasing times")
    _require_finite_squares(time, outputs)
    if np.ptp(outputs) == 0.0:
        raise ValueError("the output does not change, so no warm-up can be determined")
    span = float(time[-1] - time[0])

    def approach(t: Array, final: float, change: float, rate: float) -> Array:
        return np.asarray(final + change * np.exp(-(t - time[0]) * rate / span))

    start = (float(outputs[-1]), float(outputs[0] - outputs[-1]), 4.0)
    try:
        estimate, covariance = curve_fit(approach, time, outputs, start, maxfev=2000)
    except RuntimeError as error:
        raise ValueError("no exponential function fits this warm-up") from error
    final, change, rate = (float(value) for value in estimate)
    u_final, u_change, u_rate = (float(u) for u in np.sqrt(np.diag(covariance)))
    if not math.isfinite(u_rate) or rate <= 2.0 * u_rate:
        raise ValueError("the record is too short or too noisy to determine a time constant")
    tau = span / rate
    # At the first row; the change at switching on is that extrapolated to t = 0.
    at_start = math.exp(float(time[0]) / tau)
    return WarmUp(
        OperatingEstimate(tau, tau * u_rate / rate),
        OperatingEstimate(final, u_final),
        OperatingEstimate(change * at_start, u_change * at_start),
    )
