"""Tests for patterns in the residuals of readings, which need neither repeats nor a stated noise.

Each is one further column beside the fit (`counterspin.inference.joint.alternatives`): a wave of
the dividing head's angle, its error where it has been mounted on in several ways, a term of the
accelerometer, a drift of bias, scale or angle, a swing of the room's temperature, a warm-up, a
step, an output that is another on either side of zero, the side of approach, the sense of rotation.
Of poses it is a term of one of the accelerometers, or what changes in time, with the columns that
are left once a pose's two angles are eliminated. Where the noise is estimated from the same
residuals it is an F test of the column (Draper and Smith, Applied Regression Analysis, 3rd ed.,
section 6.1), with the freedom that is left.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
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

#: Kinds of columns, the likelier first, for where the residuals cannot tell.
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

#: What hysteresis goes with: from where the head, or the rate, came; whether force rose or fell.
APPROACH: Final = "sense of approach"
FORCE: Final = "sense of force"

#: Waves a revolution of the head, up to this many.
_HARMONICS: Final = 4

#: How often a turn a head errs, in words.
_TIMES: Final = {1: "once", 2: "twice", 3: "three times", 4: "four times"}

#: rad, by which the head's angle is changed to see what that does.
_ANGLE_STEP: Final = 1e-4

#: At most so many steps are tried, evenly spread; readings on each side of one, at least.
_STEPS: Final = 24
_MIN_READINGS_PER_SIDE: Final = 2

#: Digits after the point, of g, to which two sizes of the force are one.
_DIGITS: Final = 3

#: Time constants of a warm-up, in parts of the whole series.
_WARM_UPS: Final = (0.1, 0.3)

#: Swings over the whole series that are tried, and how many readings each takes at least.
_OSCILLATION_PERIODS: Final = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0)
_MIN_READINGS_PER_PERIOD: Final = 4

#: What is another where the force along the input axis is negative (IEEE Std 1293, K0' and K1').
BIAS: Final = "bias"
SCALE_FACTOR: Final = "scale factor"

#: Columns are alike where what the fit leaves of them has a correlation above this.
_COLLINEAR: Final = 0.999

#: Chi-square by which one column must be better than another to exclude it.
_DECISIVE_CHI2: Final = 6.0


@frozen
class ResidualGroup:
    """Readings as they are tested."""

    readings: ReadingGroup  #: What was read.
    index: int  #: Among the observations of the fit.
    #: Standard uncertainty of each reading (g), and the part that noise has in its square, (n,).
    sigma: Array
    noise_fraction: Array
    chi2: float  #: Sum of the squares of their residuals over the uncertainties.
    residual_dof: (
        float  #: Of the residuals; where the noise was estimated, of that, repeats counted.
    )
    estimated: bool  #: Whether the noise was estimated.
    #: Of the squares, those of repeats at one setting about their mean, which follow no column.
    repeat_squares: float
    #: Places of readings that stand out by themselves, which the tests must not follow.
    left_out: tuple[int, ...] = ()


@frozen
class Pattern:
    """One column that the residuals of a group follow, with those that do as well."""

    group: int  #: Place of the group.
    alternatives: tuple[Alternative, ...]  #: The likeliest first: all that explain as much.
    p: float  #: Probability of as much by chance, for this column alone.
    tests: int  #: How many columns were tested, those that are alike counted once.


def head_angle(group: Readings) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Return the angle of the dividing head from where the input axis points up, and where it is.

    Returns: rad, shape (n,), and whether the reading was taken at an angle about the axis that most
        readings have in common, shape (n,). About an upright axis the angle is from north; of an
        input axis along the head's, it is that of the pendulous axis.
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
    zero_direction = up if abs(axis @ up) < 0.9 else np.array([0.0, 1.0, 0.0])
    zero_direction = zero_direction - (zero_direction @ axis) * axis
    zero_direction /= np.linalg.norm(zero_direction)
    quarter_direction = np.cross(axis, zero_direction)
    frames = group.stations.axes
    projections = np.abs(frames[on_axis] @ axis)
    pointer = frames[:, 0] if projections[:, 0].max() < 0.9 else frames[:, 1]
    angle[on_axis] = np.arctan2(
        pointer[on_axis] @ quarter_direction, pointer[on_axis] @ zero_direction
    )
    return angle, on_axis


def candidate_columns(
    readings: Readings,
    index: int,
    estimated_symbols: Collection[str],
    tested_symbols: Collection[str],
) -> Iterator[Alternative]:
    """Yield the columns that the residuals of readings may follow.

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
        *_reversed_rotation(readings, forces),
    ):
        yield Alternative(kind, readings.accelerometer, symbol, {index: column})


_Column = tuple[str, str, Array]


def _head_harmonics(readings: Readings) -> Iterator[_Column]:
    angle, on_axis = head_angle(readings)
    for order in range(1, _HARMONICS + 1) if on_axis.any() else ():
        multiple = f"{order} phi" if order > 1 else "phi"
        yield WAVE, f"cos {multiple}", on_axis.astype(float) * np.cos(order * angle)
        yield WAVE, f"sin {multiple}", on_axis.astype(float) * np.sin(order * angle)


def _head_errors(readings: Readings, estimated_symbols: Collection[str]) -> Iterator[_Column]:
    """Yield what waves of the head make where it shows another angle than that of the axes.

    In one mounting they are waves of the angle, and cannot be told from the accelerometer's terms.
    """
    angle, on_axis = head_angle(readings)
    nominal_angle = np.broadcast_to(readings.head_angle, readings.size)
    offsets = np.exp(1j * (angle - nominal_angle))[on_axis]
    if not offsets.size or np.abs(offsets - offsets[0]).max() < _ANGLE_STEP:
        return
    slope = _head_derivative(readings, on_axis)
    for order, multiple in _TIMES.items():
        for name, harmonic in (
            ("cos", np.cos(order * nominal_angle)),
            ("sin", np.sin(order * nominal_angle)),
        ):
            if f"head.harmonic.{order}.{name}" not in estimated_symbols:
                yield HEAD, f"{name} {multiple}", slope * harmonic


def _head_derivative(readings: Readings, on_axis: npt.NDArray[np.bool_]) -> Array:
    """Return the derivative of the force along the input axis with respect to head angle, (n,)."""
    index = [*TERMS].index("K_I")
    ahead, behind = (
        readings.products({"head.zero": step})[:, index] for step in (_ANGLE_STEP, -_ANGLE_STEP)
    )
    slope: Array = on_axis * (ahead - behind) / (2.0 * _ANGLE_STEP)
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
        # A slope with time that nobody has stated is the drift.
        if (
            symbol not in estimated_symbols
            and np.ptp(factor) > 0.0
            and row.effect.condition != "time"
        ):
            yield TERM, symbol, products[row.effect.coefficient] * factor


def time_patterns(readings: ReadingGroup, forces: Array) -> Iterator[_Column]:
    """Yield what changes with the time of reading, or with the order where no times are stated.

    forces: Along the input axis, g, shape (n,).
    """
    progress, basis = _series_progress(readings)
    yield DRIFT, basis, progress - 0.5
    for time_constant in _WARM_UPS:
        yield WARM_UP, basis, np.exp(-progress / time_constant)
    # A mirrored order cancels a line, and no parabola.
    yield BEND, basis, (progress - 0.5) ** 2
    yield SCALE, basis, (progress - 0.5) * forces
    for periods in _OSCILLATION_PERIODS:
        if readings.size >= _MIN_READINGS_PER_PERIOD * periods:
            yield SWING, f"cos {periods:g} {basis}", np.cos(2.0 * math.pi * periods * progress)
            yield SWING, f"sin {periods:g} {basis}", np.sin(2.0 * math.pi * periods * progress)
    order = np.argsort(progress, kind="stable")
    last_position = readings.size - _MIN_READINGS_PER_SIDE
    step_positions = (
        np.linspace(_MIN_READINGS_PER_SIDE, last_position, min(max(last_position - 1, 0), _STEPS))
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
    """Yield that the positions themselves drift: a floor that tilts, a scale of the head."""
    angle, on_axis = head_angle(readings)
    if on_axis.any():
        progress, basis = _series_progress(readings)
        slope = _head_derivative(readings, on_axis)
        yield TURN, basis, (progress - 0.5) * slope
        yield TURN, "angle", np.mod(angle - angle[on_axis][0], 2.0 * math.pi) * slope


def _asymmetries(forces: Array) -> Iterator[_Column]:
    """Yield that bias or scale factor is another where the force is negative; forces in g, (n,)."""
    sense = np.where(np.abs(forces) > 1e-9, np.sign(forces), 0.0)
    if (sense > 0.0).any() and (sense < 0.0).any():
        yield ASYMMETRY, BIAS, sense
        yield ASYMMETRY, SCALE_FACTOR, np.abs(forces)


def _gain_steps(forces: Array) -> Iterator[_Column]:
    """Yield that the gain changes above a size of the force, as between two ranges of a meter.

    forces: g, shape (n,).
    """
    levels = np.unique(np.round(np.abs(forces), _DIGITS))
    midpoints = 0.5 * (levels[1:] + levels[:-1])
    for level in midpoints[:: max(math.ceil(midpoints.size / _STEPS), 1)].tolist():
        yield RANGE, f"{level:.2g} g", forces * (np.abs(forces) > level)


def _hysteresis(readings: Readings) -> Iterator[_Column]:
    """Yield from which side each position was come to: that of the head, or of the rate's size.

    And at rest whether the force along the input axis had risen or fallen, which one turn shows.
    """
    angle, on_axis = head_angle(readings)
    if on_axis.all():
        # Half a turn may be made either way.
        steps = np.angle(np.exp(1j * np.diff(angle)))
        steps[np.abs(steps) > math.pi * (1.0 - 1e-6)] = 0.0
        force_signs = _step_signs(np.diff(readings.products({})[:, [*TERMS].index("K_I")]))
        # The first position may have been come to from either side.
        reversed_start = np.append(-force_signs[:1], force_signs[1:])
        columns = [(APPROACH, _step_signs(steps)), (FORCE, force_signs), (FORCE, reversed_start)]
    else:
        rates = np.diff(np.abs(readings.stations.rate))
        columns = [(APPROACH, _step_signs(rates))]
    for symbol, signs in columns:
        if (signs[1:] > 0.0).any() and (signs[1:] < 0.0).any():
            yield HYSTERESIS, symbol, signs


def _step_signs(steps: Array) -> Array:
    """Return the sign of the step that led to each reading, that of the last one that was none."""
    signs, sign = np.zeros(len(steps) + 1), 0.0
    for index, step in enumerate(steps.tolist(), start=1):
        sign = math.copysign(1.0, step) if abs(step) > 1e-9 else sign
        signs[index] = sign
    signs[0] = signs[1]
    return signs


def _rotation_senses(readings: Readings) -> Iterator[_Column]:
    """Yield which way the machine turned, where it turned both ways."""
    sense = np.sign(readings.stations.rate)
    if (sense > 0.0).any() and (sense < 0.0).any():
        yield SENSE, "sense of rotation", sense


def _reversed_rotation(readings: Readings, forces: Array) -> Iterator[_Column]:
    """Yield the change of the Coriolis force if the machine turned in the other sense than stated.

    forces: Along the input axis, g, shape (n,).
    """
    rate = (1.0 - 2.0 * np.asarray(readings.stated_sense)) * readings.stations.rate
    reversed_readings = replace(readings, stations=replace(readings.stations, rate=rate))
    change = reversed_readings.products({})[:, [*TERMS].index("K_I")] - forces
    if np.ptp(change) > 0.0:
        yield REVERSED, "other sense of rotation", change


# Which of them is followed ---------------------------------------------------------------------


def best_patterns(
    fit: JointFit, groups: Sequence[ResidualGroup], alternatives: Sequence[Sequence[Alternative]]
) -> list[Pattern]:
    """Return of each group the column that its residuals follow most, with those like it."""
    outlier_columns = [
        Alternative("left out", "", str(member), {group.index: np.eye(group.readings.size)[member]})
        for group in groups
        for member in group.left_out
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
    patterns, tests = [], 0
    start = len(outlier_columns)
    for index, (group, group_columns) in enumerate(zip(groups, alternatives, strict=True)):
        outlier_indices = [
            member
            for member, outlier_column in enumerate(outlier_columns)
            if group.index in outlier_column.columns
        ]
        block, usable = (
            columns[:, start : start + len(group_columns)],
            is_usable[start : start + len(group_columns)],
        )
        start += len(group_columns)
        basis = np.linalg.qr(columns[:, outlier_indices])[0]
        outlier_projection = basis.T @ residual
        if outlier_indices and usable.any():
            # Readings that a column explains better than each by itself stand out for its sake.
            norms = np.linalg.norm(block[:, usable], axis=0)
            if np.max(np.abs(block[:, usable].T @ residual) / norms) ** 2 > float(
                outlier_projection @ outlier_projection
            ):
                outlier_indices, basis, outlier_projection = (
                    [],
                    basis[:, :0],
                    outlier_projection[:0],
                )
        remainder = block - basis @ (basis.T @ block)
        residual_without_outliers = residual - basis @ outlier_projection
        norms = np.linalg.norm(remainder, axis=0)
        usable &= norms**2 > MIN_RESIDUAL_FRACTION
        if not usable.any():
            continue
        usable_columns = [
            column for column, flag in zip(group_columns, usable.tolist(), strict=True) if flag
        ]
        unit = remainder[:, usable] / norms[usable]
        collinear = np.abs(unit.T @ unit) > _COLLINEAR
        combinations = [
            *((member,) for member in range(len(usable_columns))),
            *_harmonic_pairs(usable_columns),
        ]
        tests += (
            int(np.sum(~np.any(np.triu(collinear, 1), axis=0)))
            + len(combinations)
            - len(usable_columns)
        )
        chi2 = group.chi2 - float(outlier_projection @ outlier_projection)
        residual_dof = group.residual_dof - len(outlier_indices)
        reductions, p_values, rows = [], [], projection.row_slices[group.index]
        for members in combinations:
            reductions.append(
                _chi2_reduction(np.linalg.qr(unit[:, members])[0], residual_without_outliers, rows)
            )
            noise_share = max(
                _noise_fraction(group, usable_columns[member], unit[rows, member])
                for member in members
            )
            reduced_group = replace(group, chi2=chi2, residual_dof=residual_dof)
            p_values.append(_p_value(reduced_group, reductions[-1], len(members), noise_share))
        best_index = min(range(len(combinations)), key=lambda member: p_values[member][0])
        p, scale = p_values[best_index]
        equivalent = [
            column
            for member, column in enumerate(usable_columns)
            if collinear[member, combinations[best_index]].all()
            or reductions[member] > reductions[best_index] - _DECISIVE_CHI2 * scale
        ]
        # Steps differ by where they are only, and so do ranges: the best one stands for all.
        for kind in (STEP, RANGE):
            same_kind = [
                member for member, column in enumerate(usable_columns) if column.kind == kind
            ]
            best_of_kind = max(same_kind, key=lambda member: reductions[member], default=None)
            equivalent = [
                candidate
                for candidate in equivalent
                if candidate.kind != kind
                or (best_of_kind is not None and candidate is usable_columns[best_of_kind])
            ]
        equivalent.sort(key=lambda column: KINDS.index(column.kind))
        patterns.append(
            Pattern(
                index,
                tuple(equivalent) or (_join_harmonics(usable_columns, combinations[best_index]),),
                p,
                0,
            )
        )
    return [Pattern(pattern.group, pattern.alternatives, pattern.p, tests) for pattern in patterns]


def _harmonic_pairs(columns: Sequence[Alternative]) -> Iterator[tuple[int, ...]]:
    """Yield the places of cosine and sine of one wave, where both are there.

    Those of the first two together as well: a head that errs once and twice a turn makes both.
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
    """Return the alternative that joins the cosine and sine of one wave, or of two."""
    column = columns[members[0]]
    names = " and ".join(dict.fromkeys(_harmonic_name(columns[member]) for member in members))
    label = {WAVE: "waves of", HEAD: "error", SWING: "wave"}[column.kind]
    return replace(column, symbol=f"{label} {names}")


def _chi2_reduction(basis: Array, residual: Array, rows: slice) -> float:
    """Return by how much columns, in a basis of theirs, lessen the squares of readings themselves.

    What lessens those of priors is a conflict with a prior, and no pattern of the readings.
    """
    own_residual = residual[rows]
    remainder = own_residual - basis[rows] @ (basis.T @ residual)
    return max(float(own_residual @ own_residual) - float(remainder @ remainder), 0.0)


def _noise_fraction(group: ResidualGroup, alternative: Alternative, combination: Array) -> float:
    """Return the part that noise has in the variance of what a column is weighed against.

    The head has another part, and priors have what is not in the readings' `own` rows.
    """
    column = (alternative.columns[group.index] / group.sigma) ** 2
    noise_part = float(column @ group.noise_fraction) / float(column.sum())
    return min(noise_part * float(combination @ combination), 1.0)


def _p_value(
    group: ResidualGroup, gain: float, columns: int, noise_share: float
) -> tuple[float, float]:
    """Return the probability of a gain in chi-square, and the scale of the residuals without it.

    columns: How many of them gain it, as in `_tail`.
    noise_share: Part of the combination that comes from the noise of the readings.
    """
    other_dof = max(group.residual_dof - columns, 0.5)
    p_without_scale = _tail_probability(columns, math.inf, gain)
    if not group.estimated:
        remaining_chi2 = max(group.chi2 - gain, 0.0)
        scale = max(remaining_chi2 / other_dof, 1e-12)
        # Where more is wrong than these columns, they must be more than the others.
        if chi_square_tail(other_dof, remaining_chi2) > SIGNIFICANCE:
            return p_without_scale, 1.0
        return max(p_without_scale, _tail_probability(columns, other_dof, gain / scale)), scale
    # The head's part of the variance is known, so that only the noise's has a scale to find. What
    # the head made has not gone into it, nor do the repeats at one setting follow a column.
    remaining_chi2 = max(group.chi2 - noise_share * gain, group.repeat_squares)
    scale = (1.0 - noise_share) + noise_share * max(remaining_chi2 / other_dof, 1e-12)
    return _tail_probability(columns, other_dof / max(noise_share, 1e-6) ** 2, gain / scale), scale


def _tail_probability(columns: int, dof: float, gain: float) -> float:
    """Return the probability of a larger gain: that of `columns` times Fisher's F.

    columns: 1, 2 or 4, for which it has a closed form (NIST DLMF 8.17.2).
    """
    if columns == 1:
        return 2.0 * student_cdf(dof, -math.sqrt(gain))
    half = 0.5 * gain
    log, more = (-half, half) if math.isinf(dof) else _beta_terms(0.5 * dof, half)
    return math.exp(log) * (1.0 if columns == 2 else 1.0 + more)


def _beta_terms(a: float, half: float) -> tuple[float, float]:
    """Return the logarithm of x^a and a (1 - x), x being a / (a + half)."""
    return -a * math.log1p(half / a), a * half / (a + half)
