"""Tests for patterns in the residuals of readings, without repeats or stated noise.

Each pattern is an additional column of the fit (`counterspin.inference.joint.alternatives`):
harmonics of the head angle, errors of the dividing head with several mountings, terms of the
accelerometer, drifts of bias, scale factor or angle, oscillations with the room temperature,
warm-up, steps, asymmetry, hysteresis, sense of rotation. For poses, the candidates are terms of the
accelerometers and changes with time, after elimination of the two angles of each pose. If the noise
is estimated from the same residuals, the test is an F test (Draper and Smith, Applied Regression
Analysis, 3rd ed., section 6.1).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from itertools import compress
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.diagnostics import MIN_RESIDUAL_FRACTION, SIGNIFICANCE
from counterspin.inference.distributions import chi_square_tail, student_cdf
from counterspin.inference.joint.alternatives import Alternative, project_columns
from counterspin.inference.joint.fit import JointFit
from counterspin.physics.terms import CONDITION_TERMS, TERMS
from counterspin.readings.known_attitudes import Readings
from counterspin.readings.linear import ReadingGroup

#: Kinds of patterns, the most likely first, for patterns that the residuals cannot separate.
(
    WAVE,
    HEAD,
    TERM,
    DRIFT,
    WARM_UP,
    BEND,
    SCALE,
    TURN,
    SWING,
    ASYMMETRY,
    HYSTERESIS,
    SENSE,
    REVERSED,
    RANGE,
    STEP,
) = KINDS = (
    "wave",
    "head",
    "term",
    "drift",
    "warm-up",
    "bend",
    "scale",
    "turn",
    "swing",
    "asymmetry",
    "hysteresis",
    "sense",
    "reversed",
    "range",
    "step",
)

#: Symbols of hysteresis: sense of approach of head or rate, and sense of change of the force.
APPROACH: Final = "sense of approach"
FORCE: Final = "sense of force"

#: Number of harmonics of the head angle.
_N_HARMONICS: Final = 4

#: Order of a harmonic of the head -> its name.
_FREQUENCY_NAMES: Final = {1: "once", 2: "twice", 3: "three times", 4: "four times"}

#: Step of derivatives by the head angle, rad.
_ANGLE_STEP: Final = 1e-4

#: Largest number of steps to test, and smallest number of readings on each side of a step.
_MAX_STEPS: Final = 24
_MIN_READINGS_PER_SIDE: Final = 2

#: Decimal places, in g, to which magnitudes of the force are rounded.
_FORCE_DIGITS: Final = 3

#: Time constants of a warm-up, relative to the duration of the series.
_WARM_UP_TIME_CONSTANTS: Final = (0.1, 0.3)

#: Numbers of oscillation periods in a series, and smallest number of readings per period.
_OSCILLATION_PERIODS: Final = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0)
_MIN_READINGS_PER_PERIOD: Final = 4

#: Quantities with an asymmetry for negative forces (IEEE Std 1293, K0' and K1').
BIAS_LABEL: Final = "bias"
SCALE_FACTOR_LABEL: Final = "scale factor"

#: Mistakes that reverse the Coriolis force along the arm.
_OTHER_SENSE: Final = "a rotation opposite to the stated sense"
_OTHER_HEMISPHERE: Final = "a latitude of the opposite sign"

#: Correlation of projected columns above which they are equivalent.
_COLLINEAR: Final = 0.999

#: Difference in chi-square by which a column excludes another.
_DECISIVE_CHI2: Final = 6.0


@frozen
class ResidualGroup:
    """Residuals of a group of readings for pattern tests."""

    readings: ReadingGroup  #: Readings or poses.
    index: int  #: Index among the observations of the fit.
    sigma: Array  #: Standard uncertainty of each reading, g, shape (n,).
    noise_fraction: Array  #: Fraction of the noise in the variance of each reading, shape (n,).
    chi2: float  #: Sum of the squared residuals over the squared uncertainties.
    residual_dof: float  #: Degrees of freedom of the residuals, or of an estimated noise.
    is_noise_estimated: bool  #: True if the noise was estimated.
    repeat_squares: float  #: Contribution of repeats at one setting to `chi2`.
    #: Indices of outliers, which the tests ignore.
    outlier_indices: tuple[int, ...] = ()


@frozen
class Pattern:
    """Best pattern of the residuals of a group, with equivalent patterns."""

    group: int  #: Index of the group.
    alternatives: tuple[Alternative, ...]  #: Equivalent patterns, the most likely first.
    p: float  #: Probability of this gain by chance, for this pattern alone.
    tests: int  #: Number of tested patterns; equivalent patterns count once.


def head_angle(group: Readings) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Return the angle of the dividing head relative to the position with the input axis up.

    Returns: rad, shape (n,), and the mask of the readings about the most common head axis, shape
        (n,). For a vertical head axis, the angle is relative to north. For an input axis along the
        head axis, it is the angle of the pendulous axis.
    """
    n = group.size
    angle, on_axis = np.zeros(n), np.zeros(n, dtype=bool)
    has_head = np.linalg.norm(group.head, axis=1) > 0.0
    if not has_head.any():
        return angle, on_axis
    axes = np.round(group.head[has_head], 9)
    distinct_axes, counts = np.unique(axes, axis=0, return_counts=True)
    axis = distinct_axes[np.argmax(counts)]
    on_axis[has_head] = (axes == axis).all(axis=1)
    axis = axis / np.linalg.norm(axis)
    up = np.array([0.0, 0.0, 1.0])
    zero = up if abs(axis @ up) < 0.9 else np.array([0.0, 1.0, 0.0])
    zero = zero - (zero @ axis) * axis
    zero /= np.linalg.norm(zero)
    quarter = np.cross(axis, zero)
    frames = group.stations.axes
    projections = np.abs(frames[on_axis] @ axis)
    pointer = frames[:, 0] if projections[:, 0].max() < 0.9 else frames[:, 1]
    angle[on_axis] = np.arctan2(pointer[on_axis] @ quarter, pointer[on_axis] @ zero)
    return angle, on_axis


def candidate_columns(
    readings: Readings,
    index: int,
    estimated_symbols: Collection[str],
    tested_symbols: Collection[str],
) -> Iterator[Alternative]:
    """Yield the candidate patterns of the residuals of readings.

    index: Index of the readings among the observations of the fit.
    estimated_symbols: Symbols of the accelerometer's and the machine's terms that are estimated.
    tested_symbols: Symbols of the accelerometer's terms with a prior; their columns test the prior.
    """
    forces = readings.products({})[:, [*TERMS].index("K_I")]
    for kind, symbol, column in (
        *_head_harmonics(readings),
        *_head_errors(readings, estimated_symbols),
        *_missing_terms(readings, estimated_symbols, tested_symbols),
        *time_patterns(readings, forces),
        *_tilt_drifts(readings),
        *_asymmetries(forces),
        *_gain_steps(forces),
        *_hysteresis(readings),
        *_rotation_senses(readings),
        *_reversed_coriolis(readings, forces),
    ):
        yield Alternative(kind, readings.accelerometer, symbol, {index: column})


_Column = tuple[str, str, Array]


def _head_harmonics(readings: Readings) -> Iterator[_Column]:
    angle, on_axis = head_angle(readings)
    for order in range(1, _N_HARMONICS + 1) if on_axis.any() else ():
        multiple = f"{order} phi" if order > 1 else "phi"
        yield WAVE, f"cos {multiple}", on_axis.astype(float) * np.cos(order * angle)
        yield WAVE, f"sin {multiple}", on_axis.astype(float) * np.sin(order * angle)


def _head_errors(readings: Readings, estimated_symbols: Collection[str]) -> Iterator[_Column]:
    """Yield errors of the dividing head if its indicated angle differs from that of the axes.

    With a single mounting, they are harmonics of the angle, like terms of the accelerometer.
    """
    angle, on_axis = head_angle(readings)
    nominal_angle = np.broadcast_to(readings.head_angle, readings.size)
    offsets = np.exp(1j * (angle - nominal_angle))[on_axis]
    if not offsets.size or np.abs(offsets - offsets[0]).max() < _ANGLE_STEP:
        return
    slope = _head_derivative(readings, on_axis)
    for order, multiple in _FREQUENCY_NAMES.items():
        for name, harmonic in (
            ("cos", np.cos(order * nominal_angle)),
            ("sin", np.sin(order * nominal_angle)),
        ):
            if f"head.harmonic.{order}.{name}" not in estimated_symbols:
                yield HEAD, f"{name} {multiple}", slope * harmonic


def _head_derivative(readings: Readings, on_axis: npt.NDArray[np.bool_]) -> Array:
    """Return the derivative of the force along the input axis with respect to head angle, (n,)."""
    index = [*TERMS].index("K_I")
    upper, lower = (
        readings.products({"head.zero": step})[:, index] for step in (_ANGLE_STEP, -_ANGLE_STEP)
    )
    slope: Array = on_axis * (upper - lower) / (2.0 * _ANGLE_STEP)
    return slope


def _missing_terms(
    readings: Readings, estimated_symbols: Collection[str], tested_symbols: Collection[str]
) -> Iterator[_Column]:
    products = dict(zip(TERMS, readings.products({}).T, strict=True))
    for symbol, product in products.items():
        if symbol not in estimated_symbols or symbol in tested_symbols:
            yield TERM, symbol, product
    for symbol, row in CONDITION_TERMS.items():
        factor = readings.design_factor(symbol)
        # A slope with time without a stated value is the drift.
        if (
            symbol not in estimated_symbols
            and np.ptp(factor) > 0.0
            and row.effect.condition != "time"
        ):
            yield TERM, symbol, products[row.effect.coefficient] * factor


def time_patterns(readings: ReadingGroup, forces: Array) -> Iterator[_Column]:
    """Yield changes with the time of reading, or with the order if no times are stated.

    forces: Specific force along the input axis, g, shape (n,).
    """
    progress, basis = _series_progress(readings)
    yield DRIFT, basis, progress - 0.5
    for time_constant in _WARM_UP_TIME_CONSTANTS:
        yield WARM_UP, basis, np.exp(-progress / time_constant)
    # A symmetric order cancels a linear drift, but not a parabola.
    yield BEND, basis, (progress - 0.5) ** 2
    yield SCALE, basis, (progress - 0.5) * forces
    for periods in _OSCILLATION_PERIODS:
        if readings.size >= _MIN_READINGS_PER_PERIOD * periods:
            yield SWING, f"cos {periods:g} {basis}", np.cos(2.0 * math.pi * periods * progress)
            yield SWING, f"sin {periods:g} {basis}", np.sin(2.0 * math.pi * periods * progress)
    order = np.argsort(progress, kind="stable")
    last_position = readings.size - _MIN_READINGS_PER_SIDE
    step_positions = (
        np.linspace(
            _MIN_READINGS_PER_SIDE, last_position, min(max(last_position - 1, 0), _MAX_STEPS)
        )
        .round()
        .astype(int)
    )
    for position in np.unique(step_positions).tolist():
        is_later = progress >= progress[order[position]]
        if np.sum(~is_later) >= _MIN_READINGS_PER_SIDE:
            yield STEP, readings.names[order[position]], is_later.astype(float)


def _series_progress(readings: ReadingGroup) -> tuple[Array, str]:
    """Return the progress of the series, from 0 to 1, shape (n,), and its basis: time or order."""
    has_times = np.ptp(readings.time) > 0.0
    values = readings.time if has_times else np.arange(float(readings.size))
    return (values - values.min()) / np.ptp(values), "time" if has_times else "order"


def _tilt_drifts(readings: Readings) -> Iterator[_Column]:
    """Yield drifts of the positions: tilt of the floor, scale error of the head."""
    angle, on_axis = head_angle(readings)
    if on_axis.any():
        progress, basis = _series_progress(readings)
        slope = _head_derivative(readings, on_axis)
        yield TURN, basis, (progress - 0.5) * slope
        yield TURN, "angle", np.mod(angle - angle[on_axis][0], 2.0 * math.pi) * slope


def _asymmetries(forces: Array) -> Iterator[_Column]:
    """Yield asymmetries of bias and scale factor; forces in g, shape (n,)."""
    sense = np.where(np.abs(forces) > 1e-9, np.sign(forces), 0.0)
    if (sense > 0.0).any() and (sense < 0.0).any():
        yield ASYMMETRY, BIAS_LABEL, sense
        yield ASYMMETRY, SCALE_FACTOR_LABEL, np.abs(forces)


def _gain_steps(forces: Array) -> Iterator[_Column]:
    """Yield changes of the gain above a magnitude of the force, as between ranges of a meter.

    forces: g, shape (n,).
    """
    magnitudes = np.unique(np.round(np.abs(forces), _FORCE_DIGITS))
    midpoints = 0.5 * (magnitudes[1:] + magnitudes[:-1])
    for magnitude in midpoints[:: max(math.ceil(midpoints.size / _MAX_STEPS), 1)].tolist():
        yield RANGE, f"{magnitude:.2g} g", forces * (np.abs(forces) > magnitude)


def _hysteresis(readings: Readings) -> Iterator[_Column]:
    """Yield hysteresis with the sense of approach of the head angle or of the rate.

    At rest, also with the sense in which the force along the input axis changed.
    """
    angle, on_axis = head_angle(readings)
    if on_axis.all():
        # Half a turn has no defined sense.
        steps = np.angle(np.exp(1j * np.diff(angle)))
        steps[np.abs(steps) > math.pi * (1.0 - 1e-6)] = 0.0
        force_signs = _step_signs(np.diff(readings.products({})[:, [*TERMS].index("K_I")]))
        # The first position may have been approached from either side.
        reversed_start = np.append(-force_signs[:1], force_signs[1:])
        columns = [(APPROACH, _step_signs(steps)), (FORCE, force_signs), (FORCE, reversed_start)]
    else:
        rates = np.diff(np.abs(readings.stations.rate))
        columns = [(APPROACH, _step_signs(rates))]
    for symbol, signs in columns:
        if (signs[1:] > 0.0).any() and (signs[1:] < 0.0).any():
            yield HYSTERESIS, symbol, signs


def _step_signs(steps: Array) -> Array:
    """Return the sign of the step to each reading; without a step, that of the previous step."""
    signs, sign = np.zeros(len(steps) + 1), 0.0
    for index, step in enumerate(steps.tolist(), start=1):
        sign = math.copysign(1.0, step) if abs(step) > 1e-9 else sign
        signs[index] = sign
    signs[0] = signs[1]
    return signs


def _rotation_senses(readings: Readings) -> Iterator[_Column]:
    """Yield the sense of rotation, if the machine rotated in both senses."""
    sense = np.sign(readings.stations.rate)
    if (sense > 0.0).any() and (sense < 0.0).any():
        yield SENSE, "sense of rotation", sense


def _reversed_coriolis(readings: Readings, forces: Array) -> Iterator[_Column]:
    """Yield the changes of the Coriolis force for the other sense and the other hemisphere.

    forces: Specific force along the input axis, g, shape (n,).
    """
    rate = (1.0 - 2.0 * np.asarray(readings.stated_sense)) * readings.stations.rate
    other_sense = replace(readings, stations=replace(readings.stations, rate=rate))
    site = replace(readings.site, latitude=-readings.site.latitude)
    sense_change, site_change = (
        changed.products({})[:, [*TERMS].index("K_I")] - forces
        for changed in (other_sense, replace(readings, site=site))
    )
    if np.allclose(sense_change, site_change, rtol=0.0, atol=1e-12):
        name = f"{_OTHER_SENSE} or {_OTHER_HEMISPHERE}"
        columns = [(name, sense_change)]
    else:
        columns = [(_OTHER_SENSE, sense_change), (_OTHER_HEMISPHERE, site_change)]
    for name, change in columns:
        if np.ptp(change) > 0.0:
            yield REVERSED, name, change


# Selection of the best pattern -----------------------------------------------------------------


def best_patterns(
    fit: JointFit, groups: Sequence[ResidualGroup], alternatives: Sequence[Sequence[Alternative]]
) -> list[Pattern]:
    """Return the best pattern of each group, with equivalent patterns."""
    outlier_columns = [
        Alternative("left out", "", str(member), {group.index: np.eye(group.readings.size)[member]})
        for group in groups
        for member in group.outlier_indices
    ]
    all_columns = [
        *outlier_columns,
        *(column for group_columns in alternatives for column in group_columns),
    ]
    if len(all_columns) == len(outlier_columns):
        return []
    projection = project_columns(fit, all_columns)
    columns, residual = projection.columns, projection.residual
    is_usable = np.sum(columns**2, axis=0) > MIN_RESIDUAL_FRACTION * projection.squared_norms
    patterns, n_tests = [], 0
    start = len(outlier_columns)
    for index, (group, group_columns) in enumerate(zip(groups, alternatives, strict=True)):
        outlier_indices = [
            member
            for member, outlier_column in enumerate(outlier_columns)
            if group.index in outlier_column.columns
        ]
        end = start + len(group_columns)
        group_block, is_usable_in_group = columns[:, start:end], is_usable[start:end]
        start = end
        basis = np.linalg.qr(columns[:, outlier_indices])[0]
        outlier_projection = basis.T @ residual
        if outlier_indices and is_usable_in_group.any():
            # If a pattern explains more than the individual outliers, it explains them too.
            norms = np.linalg.norm(group_block[:, is_usable_in_group], axis=0)
            if np.max(np.abs(group_block[:, is_usable_in_group].T @ residual) / norms) ** 2 > float(
                outlier_projection @ outlier_projection
            ):
                outlier_indices, basis = [], basis[:, :0]
                outlier_projection = outlier_projection[:0]
        remainder = group_block - basis @ (basis.T @ group_block)
        residual_without_outliers = residual - basis @ outlier_projection
        norms = np.linalg.norm(remainder, axis=0)
        is_usable_in_group &= norms**2 > MIN_RESIDUAL_FRACTION
        if not is_usable_in_group.any():
            continue
        usable_columns = list(compress(group_columns, is_usable_in_group.tolist()))
        unit_columns = remainder[:, is_usable_in_group] / norms[is_usable_in_group]
        is_collinear = np.abs(unit_columns.T @ unit_columns) > _COLLINEAR
        combinations = [
            *((member,) for member in range(len(usable_columns))),
            *_harmonic_pairs(usable_columns),
        ]
        n_tests += (
            int(np.sum(~np.any(np.triu(is_collinear, 1), axis=0)))
            + len(combinations)
            - len(usable_columns)
        )
        chi2 = group.chi2 - float(outlier_projection @ outlier_projection)
        residual_dof = group.residual_dof - len(outlier_indices)
        reductions, p_values, rows = [], [], projection.row_slices[group.index]
        for members in combinations:
            member_basis = np.linalg.qr(unit_columns[:, members])[0]
            reductions.append(_chi2_reduction(member_basis, residual_without_outliers, rows))
            noise_share = max(
                _noise_fraction(group, usable_columns[member], unit_columns[rows, member])
                for member in members
            )
            reduced_group = replace(group, chi2=chi2, residual_dof=residual_dof)
            p_values.append(_p_value(reduced_group, reductions[-1], len(members), noise_share))
        best_index = min(range(len(combinations)), key=lambda member: p_values[member][0])
        p, scale = p_values[best_index]
        equivalent_columns = [
            column
            for member, column in enumerate(usable_columns)
            if is_collinear[member, combinations[best_index]].all()
            or reductions[member] > reductions[best_index] - _DECISIVE_CHI2 * scale
        ]
        # Steps, and ranges, differ only in position: only the best one is kept.
        for kind in (STEP, RANGE):
            indices_of_kind = [
                member for member, column in enumerate(usable_columns) if column.kind == kind
            ]
            best_of_kind = max(indices_of_kind, key=lambda member: reductions[member], default=None)
            equivalent_columns = [
                candidate
                for candidate in equivalent_columns
                if candidate.kind != kind
                or (best_of_kind is not None and candidate is usable_columns[best_of_kind])
            ]
        equivalent_columns.sort(key=lambda column: KINDS.index(column.kind))
        patterns.append(
            Pattern(
                index,
                tuple(equivalent_columns)
                or (_join_harmonics(usable_columns, combinations[best_index]),),
                p,
                0,
            )
        )
    return [replace(pattern, tests=n_tests) for pattern in patterns]


def _harmonic_pairs(columns: Sequence[Alternative]) -> Iterator[tuple[int, ...]]:
    """Yield the indices of cosine and sine of each harmonic that has both.

    Those of the first two harmonics are also combined, for a head with both errors.
    """
    for kind in (WAVE, HEAD, SWING):
        members_by_name: dict[str, tuple[int, ...]] = {}
        for index, column in enumerate(columns):
            if column.kind == kind:
                name = _harmonic_name(column)
                members_by_name[name] = (*members_by_name.get(name, ()), index)
        pairs = [members for members in members_by_name.values() if len(members) > 1]
        yield from pairs
        if len(pairs) > 1 and kind != SWING:
            yield pairs[0] + pairs[1]


def _harmonic_name(wave: Alternative) -> str:
    return wave.symbol.partition(" ")[2]


def _join_harmonics(columns: Sequence[Alternative], members: tuple[int, ...]) -> Alternative:
    """Return the alternative that joins cosine and sine of one or two harmonics."""
    column = columns[members[0]]
    names = " and ".join(dict.fromkeys(_harmonic_name(columns[member]) for member in members))
    label = {WAVE: "waves of", HEAD: "error", SWING: "wave"}[column.kind]
    return replace(column, symbol=f"{label} {names}")


def _chi2_reduction(basis: Array, residual: Array, rows: slice) -> float:
    """Return the reduction of the sum of squares of the readings by columns with a given basis.

    A reduction of the squares of priors is a conflict with a prior, not a pattern of the readings.
    """
    group_residual = residual[rows]
    remainder = group_residual - basis[rows] @ (basis.T @ residual)
    return max(float(group_residual @ group_residual) - float(remainder @ remainder), 0.0)


def _noise_fraction(group: ResidualGroup, alternative: Alternative, combination: Array) -> float:
    """Return the fraction of the noise in the variance of the estimate of a column.

    The remaining variance is that of the head, and of priors outside the rows of the readings.
    """
    column = (alternative.columns[group.index] / group.sigma) ** 2
    noise_fraction = float(column @ group.noise_fraction) / float(column.sum())
    return min(noise_fraction * float(combination @ combination), 1.0)


def _p_value(
    group: ResidualGroup, chi2_gain: float, n_columns: int, noise_share: float
) -> tuple[float, float]:
    """Return the probability of a gain in chi-square, and the scale of the residuals without it.

    n_columns: Number of columns of the pattern, as in `_tail_probability`.
    noise_share: Fraction of the variance due to the noise of the readings.
    """
    other_dof = max(group.residual_dof - n_columns, 0.5)
    p_without_scale = _tail_probability(n_columns, math.inf, chi2_gain)
    if not group.is_noise_estimated:
        remaining_chi2 = max(group.chi2 - chi2_gain, 0.0)
        scale = max(remaining_chi2 / other_dof, 1e-12)
        # If there are other errors, the gain must exceed their scale.
        if chi_square_tail(other_dof, remaining_chi2) > SIGNIFICANCE:
            return p_without_scale, 1.0
        p = _tail_probability(n_columns, other_dof, chi2_gain / scale)
        return max(p_without_scale, p), scale
    # The variance of the head is known, so only the noise has an estimated scale. Repeats at one
    # setting contain no pattern.
    remaining_chi2 = max(group.chi2 - noise_share * chi2_gain, group.repeat_squares)
    scale = (1.0 - noise_share) + noise_share * max(remaining_chi2 / other_dof, 1e-12)
    scale_dof = other_dof / max(noise_share, 1e-6) ** 2
    return _tail_probability(n_columns, scale_dof, chi2_gain / scale), scale


def _tail_probability(n_columns: int, dof: float, chi2_gain: float) -> float:
    """Return the probability of a larger gain, distributed as `n_columns` times Fisher's F.

    n_columns: 1, 2 or 4, for which there is a closed form (NIST DLMF 8.17.2).
    """
    if n_columns == 1:
        return 2.0 * student_cdf(dof, -math.sqrt(chi2_gain))
    half_gain = 0.5 * chi2_gain
    log_factor, second_term = (
        (-half_gain, half_gain) if math.isinf(dof) else _beta_terms(0.5 * dof, half_gain)
    )
    return math.exp(log_factor) * (1.0 if n_columns == 2 else 1.0 + second_term)


def _beta_terms(a: float, half_gain: float) -> tuple[float, float]:
    """Return the logarithm of x^a, and a (1 - x), for x = a / (a + half_gain)."""
    return -a * math.log1p(half_gain / a), a * half_gain / (a + half_gain)
