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
from counterspin.inference.diagnostics import LEAST_PART_LEFT, SIGNIFICANCE
from counterspin.inference.distributions import chi_square_tail, student_cdf
from counterspin.inference.joint.alternatives import Alternative, beside_fit
from counterspin.inference.joint.fit import JointFit
from counterspin.physics.terms import CONDITION_TERMS, TERMS
from counterspin.readings.known_attitudes import Readings
from counterspin.readings.linear import Measured

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
_TURN: Final = 1e-4

#: At most so many steps are tried, evenly spread; readings on each side of one, at least.
_STEPS: Final = 24
_FEWEST_BESIDE: Final = 2

#: Digits after the point, of g, to which two sizes of the force are one.
_DIGITS: Final = 3

#: Time constants of a warm-up, in parts of the whole series.
_WARM_UPS: Final = (0.1, 0.3)

#: Swings over the whole series that are tried, and how many readings each takes at least.
_SWINGS: Final = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0)
_FEWEST_A_SWING: Final = 4

#: What is another where the force along the input axis is negative (IEEE Std 1293, K0' and K1').
BIAS: Final = "bias"
SCALE_FACTOR: Final = "scale factor"

#: Columns are alike where what the fit leaves of them has a correlation above this.
_ALIKE: Final = 0.999

#: Chi-square by which one column must be better than another to exclude it.
_DECISIVE_CHI2: Final = 6.0


@frozen
class Group:
    """Readings as they are tested."""

    readings: Measured  #: What was read.
    place: int  #: Among the observations of the fit.
    #: Standard uncertainty of each reading (g), and the part that noise has in its square, (n,).
    sigma: Array
    of_noise: Array
    squares: float  #: Sum of the squares of their residuals over the uncertainties.
    freedom: float  #: Of the residuals; where the noise was estimated, of that, repeats counted.
    estimated: bool  #: Whether the noise was estimated.
    #: Of the squares, those of repeats at one setting about their mean, which follow no column.
    of_repeats: float
    #: Places of readings that stand out by themselves, which the tests must not follow.
    left_out: tuple[int, ...] = ()


@frozen
class Followed:
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
    angle, there = np.zeros(n), np.zeros(n, dtype=bool)
    turned = np.linalg.norm(group.head, axis=1) > 0.0
    if not turned.any():
        return angle, there
    axes = np.round(group.head[turned], 9)
    kinds, counts = np.unique(axes, axis=0, return_counts=True)
    axis = kinds[np.argmax(counts)]
    there[turned] = (axes == axis).all(axis=1)
    axis = axis / np.linalg.norm(axis)
    up = np.array([0.0, 0.0, 1.0])
    start = up if abs(axis @ up) < 0.9 else np.array([0.0, 1.0, 0.0])
    start = start - (start @ axis) * axis
    start /= np.linalg.norm(start)
    aside = np.cross(axis, start)
    frames = np.array([station.mounting.matrix for station in group.stations])
    along = np.abs(frames[there] @ axis)
    pointer = frames[:, 0] if along[:, 0].max() < 0.9 else frames[:, 1]
    angle[there] = np.arctan2(pointer[there] @ aside, pointer[there] @ start)
    return angle, there


def candidates(
    readings: Readings, place: int, unknown: Collection[str], followed: Collection[str]
) -> Iterator[Alternative]:
    """Yield the columns that the residuals of readings may follow.

    place: Of the readings among the observations of the fit.
    unknown: Symbols of the accelerometer's terms, and the machine's, that the fit may choose.
    """
    forces = readings.products({})[:, [*TERMS].index("K_I")]
    for kind, symbol, column in (
        *_waves(readings),
        *_errors_of_the_head(readings, unknown),
        *_terms(readings, unknown, followed),
        *in_order(readings, forces),
        *_of_the_turning(readings),
        *_of_asymmetry(forces),
        *_of_ranges(forces),
        *_of_approach(readings),
        *_of_sense(readings),
        *_reversed_rotation(readings, forces),
    ):
        yield Alternative(kind, readings.accelerometer, symbol, {place: column})


_Column = tuple[str, str, Array]


def _waves(readings: Readings) -> Iterator[_Column]:
    angle, there = head_angle(readings)
    for n in range(1, _HARMONICS + 1) if there.any() else ():
        turns = f"{n} phi" if n > 1 else "phi"
        yield WAVE, f"cos {turns}", there.astype(float) * np.cos(n * angle)
        yield WAVE, f"sin {turns}", there.astype(float) * np.sin(n * angle)


def _errors_of_the_head(readings: Readings, unknown: Collection[str]) -> Iterator[_Column]:
    """Yield what waves of the head make where it shows another angle than that of the axes.

    In one mounting they are waves of the angle, and cannot be told from the accelerometer's terms.
    """
    angle, there = head_angle(readings)
    shown = np.broadcast_to(readings.head_angle, readings.size)
    apart = np.exp(1j * (angle - shown))[there]
    if not apart.size or np.abs(apart - apart[0]).max() < _TURN:
        return
    slope = _slope(readings, there)
    for n, times in _TIMES.items():
        for name, wave in (("cos", np.cos(n * shown)), ("sin", np.sin(n * shown))):
            if f"head.harmonic.{n}.{name}" not in unknown:
                yield HEAD, f"{name} {times}", slope * wave


def _slope(readings: Readings, there: npt.NDArray[np.bool_]) -> Array:
    """Return the derivative of the force along the input axis with respect to head angle, (n,)."""
    place = [*TERMS].index("K_I")
    more, less = (readings.products({"head.zero": by})[:, place] for by in (_TURN, -_TURN))
    slope: Array = there * (more - less) / (2.0 * _TURN)
    return slope


def _terms(
    readings: Readings, unknown: Collection[str], followed: Collection[str]
) -> Iterator[_Column]:
    products = dict(zip(TERMS, readings.products({}).T, strict=True))
    for symbol, product in products.items():
        if symbol not in unknown or symbol in followed:
            yield TERM, symbol, product
    for symbol, row in CONDITION_TERMS.items():
        lever = readings.lever(symbol)
        # A slope with time that nobody has stated is the drift.
        if symbol not in unknown and np.ptp(lever) > 0.0 and row.effect.condition != "time":
            yield TERM, symbol, products[row.effect.coefficient] * lever


def in_order(readings: Measured, forces: Array) -> Iterator[_Column]:
    """Yield what changes with the time of reading, or with the order where no times are stated.

    forces: Along the input axis, g, shape (n,).
    """
    x, when = _course(readings)
    yield DRIFT, when, x - 0.5
    for part in _WARM_UPS:
        yield WARM_UP, when, np.exp(-x / part)
    # A mirrored order cancels a line, and no parabola.
    yield BEND, when, (x - 0.5) ** 2
    yield SCALE, when, (x - 0.5) * forces
    for times in _SWINGS:
        if readings.size >= _FEWEST_A_SWING * times:
            yield SWING, f"cos {times:g} {when}", np.cos(2.0 * math.pi * times * x)
            yield SWING, f"sin {times:g} {when}", np.sin(2.0 * math.pi * times * x)
    order = np.argsort(x, kind="stable")
    last = readings.size - _FEWEST_BESIDE
    places = np.linspace(_FEWEST_BESIDE, last, min(max(last - 1, 0), _STEPS)).round().astype(int)
    for k in np.unique(places).tolist():
        later = x >= x[order[k]]
        if np.sum(~later) >= _FEWEST_BESIDE:
            yield STEP, readings.names[order[k]], later.astype(float)


def _course(readings: Measured) -> tuple[Array, str]:
    """Return the progress of the series, from 0 to 1, shape (n,), and its basis: time or order."""
    by_time = np.ptp(readings.time) > 0.0
    x = readings.time if by_time else np.arange(float(readings.size))
    return (x - x.min()) / np.ptp(x), "time" if by_time else "order"


def _of_the_turning(readings: Readings) -> Iterator[_Column]:
    """Yield that the positions themselves drift: a floor that tilts, a scale of the head."""
    angle, there = head_angle(readings)
    if there.any():
        x, when = _course(readings)
        slope = _slope(readings, there)
        yield TURN, when, (x - 0.5) * slope
        yield TURN, "angle", np.mod(angle - angle[there][0], 2.0 * math.pi) * slope


def _of_asymmetry(forces: Array) -> Iterator[_Column]:
    """Yield that bias or scale factor is another where the force is negative; forces in g, (n,)."""
    sense = np.where(np.abs(forces) > 1e-9, np.sign(forces), 0.0)
    if (sense > 0.0).any() and (sense < 0.0).any():
        yield ASYMMETRY, BIAS, sense
        yield ASYMMETRY, SCALE_FACTOR, np.abs(forces)


def _of_ranges(forces: Array) -> Iterator[_Column]:
    """Yield that the gain changes above a size of the force, as between two ranges of a meter.

    forces: g, shape (n,).
    """
    sizes = np.unique(np.round(np.abs(forces), _DIGITS))
    between = 0.5 * (sizes[1:] + sizes[:-1])
    for level in between[:: max(math.ceil(between.size / _STEPS), 1)].tolist():
        yield RANGE, f"{level:.2g} g", forces * (np.abs(forces) > level)


def _of_approach(readings: Readings) -> Iterator[_Column]:
    """Yield from which side each position was come to: that of the head, or of the rate's size.

    And at rest whether the force along the input axis had risen or fallen, which one turn shows.
    """
    angle, there = head_angle(readings)
    if there.all():
        # Half a turn may be made either way.
        steps = np.angle(np.exp(1j * np.diff(angle)))
        steps[np.abs(steps) > math.pi * (1.0 - 1e-6)] = 0.0
        force = _senses(np.diff(readings.products({})[:, [*TERMS].index("K_I")]))
        # The first position may have been come to from either side.
        other = np.append(-force[:1], force[1:])
        senses = [(APPROACH, _senses(steps)), (FORCE, force), (FORCE, other)]
    else:
        rates = np.diff([abs(station.rate) for station in readings.stations])
        senses = [(APPROACH, _senses(rates))]
    for symbol, sense in senses:
        if (sense[1:] > 0.0).any() and (sense[1:] < 0.0).any():
            yield HYSTERESIS, symbol, sense


def _senses(steps: Array) -> Array:
    """Return the sign of the step that led to each reading, that of the last one that was none."""
    sense, last = np.zeros(len(steps) + 1), 0.0
    for k, step in enumerate(steps.tolist(), start=1):
        last = math.copysign(1.0, step) if abs(step) > 1e-9 else last
        sense[k] = last
    sense[0] = sense[1]
    return sense


def _of_sense(readings: Readings) -> Iterator[_Column]:
    """Yield which way the machine turned, where it turned both ways."""
    sense = np.sign([station.rate for station in readings.stations])
    if (sense > 0.0).any() and (sense < 0.0).any():
        yield SENSE, "sense of rotation", sense


def _reversed_rotation(readings: Readings, forces: Array) -> Iterator[_Column]:
    """Yield the change of the Coriolis force if the machine turned in the other sense than stated.

    forces: Along the input axis, g, shape (n,).
    """
    signs = np.broadcast_to(1.0 - 2.0 * np.asarray(readings.stated_sense), readings.size)
    every = zip(readings.stations, signs.tolist(), strict=True)
    stations = tuple(replace(one, rate=sign * one.rate) for one, sign in every)
    other = replace(readings, stations=stations)
    change = other.products({})[:, [*TERMS].index("K_I")] - forces
    if np.ptp(change) > 0.0:
        yield REVERSED, "other sense of rotation", change


# Which of them is followed ---------------------------------------------------------------------


def most_followed(
    fit: JointFit, groups: Sequence[Group], alternatives: Sequence[Sequence[Alternative]]
) -> list[Followed]:
    """Return of each group the column that its residuals follow most, with those like it."""
    marks = [
        Alternative("left out", "", str(k), {group.place: np.eye(group.readings.size)[k]})
        for group in groups
        for k in group.left_out
    ]
    every = [*marks, *(other for own in alternatives for other in own)]
    if len(every) == len(marks):
        return []
    held = beside_fit(fit, every)
    columns, residual = held.columns, held.residual
    there = np.sum(columns**2, axis=0) > LEAST_PART_LEFT * held.before
    found, tests = [], 0
    start = len(marks)
    for place, (group, own) in enumerate(zip(groups, alternatives, strict=True)):
        out = [k for k, mark in enumerate(marks) if group.place in mark.columns]
        own_columns, usable = columns[:, start : start + len(own)], there[start : start + len(own)]
        start += len(own)
        basis = np.linalg.qr(columns[:, out])[0]
        apart = basis.T @ residual
        if out and usable.any():
            # Readings that a column explains better than each by itself stand out for its sake.
            norms = np.linalg.norm(own_columns[:, usable], axis=0)
            if np.max(np.abs(own_columns[:, usable].T @ residual) / norms) ** 2 > float(
                apart @ apart
            ):
                out, basis, apart = [], basis[:, :0], apart[:0]
        left = own_columns - basis @ (basis.T @ own_columns)
        alone = residual - basis @ apart
        norms = np.linalg.norm(left, axis=0)
        usable &= norms**2 > LEAST_PART_LEFT
        if not usable.any():
            continue
        kept = [other for other, use in zip(own, usable.tolist(), strict=True) if use]
        unit = left[:, usable] / norms[usable]
        alike = np.abs(unit.T @ unit) > _ALIKE
        tried = [*((k,) for k in range(len(kept))), *_waves_at_any_phase(kept)]
        tests += int(np.sum(~np.any(np.triu(alike, 1), axis=0))) + len(tried) - len(kept)
        squares = group.squares - float(apart @ apart)
        freedom = group.freedom - len(out)
        gains, chances, rows = [], [], held.places[group.place]
        for places in tried:
            gains.append(_own_gain(np.linalg.qr(unit[:, places])[0], alone, rows))
            share = max(_share(group, kept[k], unit[rows, k]) for k in places)
            left_over = replace(group, squares=squares, freedom=freedom)
            chances.append(_chance(left_over, gains[-1], len(places), share))
        best = min(range(len(tried)), key=lambda k: chances[k][0])
        p, scale = chances[best]
        as_good = [
            other
            for k, other in enumerate(kept)
            if alike[k, tried[best]].all() or gains[k] > gains[best] - _DECISIVE_CHI2 * scale
        ]
        # Steps differ by where they are only, and so do ranges: the best one stands for all.
        for kind in (STEP, RANGE):
            alike_of = [k for k, other in enumerate(kept) if other.kind == kind]
            first = max(alike_of, key=lambda k: gains[k], default=None)
            as_good = [
                o for o in as_good if o.kind != kind or (first is not None and o is kept[first])
            ]
        as_good.sort(key=lambda other: KINDS.index(other.kind))
        found.append(Followed(place, tuple(as_good) or (_wave(kept, tried[best]),), p, 0))
    return [Followed(each.group, each.alternatives, each.p, tests) for each in found]


def _waves_at_any_phase(columns: Sequence[Alternative]) -> Iterator[tuple[int, ...]]:
    """Yield the places of cosine and sine of one wave, where both are there.

    Those of the first two together as well: a head that errs once and twice a turn makes both.
    """
    for kind in (WAVE, HEAD, SWING):
        waves: dict[str, tuple[int, ...]] = {}
        for k, column in enumerate(columns):
            if column.kind == kind:
                turns = _turns(column)
                waves[turns] = (*waves.get(turns, ()), k)
        whole = [places for places in waves.values() if len(places) > 1]
        yield from whole
        if len(whole) > 1 and kind != SWING:
            yield whole[0] + whole[1]


def _turns(wave: Alternative) -> str:
    return wave.symbol.partition(" ")[2]


def _wave(columns: Sequence[Alternative], places: tuple[int, ...]) -> Alternative:
    """Return the alternative that joins the cosine and sine of one wave, or of two."""
    first = columns[places[0]]
    turns = " and ".join(dict.fromkeys(_turns(columns[k]) for k in places))
    words = {WAVE: "waves of", HEAD: "error", SWING: "wave"}[first.kind]
    return replace(first, symbol=f"{words} {turns}")


def _own_gain(basis: Array, residual: Array, rows: slice) -> float:
    """Return by how much columns, in a basis of theirs, lessen the squares of readings themselves.

    What lessens those of priors is a conflict with a prior, and no pattern of the readings.
    """
    before = residual[rows]
    after = before - basis[rows] @ (basis.T @ residual)
    return max(float(before @ before) - float(after @ after), 0.0)


def _share(group: Group, other: Alternative, own: Array) -> float:
    """Return the part that noise has in the variance of what a column is weighed against.

    The head has another part, and priors have what is not in the readings' `own` rows.
    """
    column = (other.columns[group.place] / group.sigma) ** 2
    by_noise = float(column @ group.of_noise) / float(column.sum())
    return min(by_noise * float(own @ own), 1.0)


def _chance(group: Group, gain: float, columns: int, share: float) -> tuple[float, float]:
    """Return the probability of a gain in chi-square, and the scale of the residuals without it.

    columns: How many of them gain it, as of `_tail`.
    share: As of `_share`.
    """
    others = max(group.freedom - columns, 0.5)
    by_noise = _tail(columns, math.inf, gain)
    if not group.estimated:
        rest = max(group.squares - gain, 0.0)
        scale = max(rest / others, 1e-12)
        # Where more is wrong than these columns, they must be more than the others.
        if chi_square_tail(others, rest) > SIGNIFICANCE:
            return by_noise, 1.0
        return max(by_noise, _tail(columns, others, gain / scale)), scale
    # The head's part of the variance is known, so that only the noise's has a scale to find. What
    # the head made has not gone into it, nor do the repeats at one setting follow a column.
    rest = max(group.squares - share * gain, group.of_repeats)
    scale = (1.0 - share) + share * max(rest / others, 1e-12)
    return _tail(columns, others / max(share, 1e-6) ** 2, gain / scale), scale


def _tail(columns: int, dof: float, gain: float) -> float:
    """Return the probability of a larger gain: that of `columns` times Fisher's F.

    columns: 1, 2 or 4, for which it has a closed form (NIST DLMF 8.17.2).
    """
    if columns == 1:
        return 2.0 * student_cdf(dof, -math.sqrt(gain))
    half = 0.5 * gain
    log, more = (-half, half) if math.isinf(dof) else _of_beta(0.5 * dof, half)
    return math.exp(log) * (1.0 if columns == 2 else 1.0 + more)


def _of_beta(a: float, half: float) -> tuple[float, float]:
    """Return the logarithm of x^a and a (1 - x), x being a / (a + half)."""
    return -a * math.log1p(half / a), a * half / (a + half)
