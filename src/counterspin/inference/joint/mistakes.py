"""Mistakes that are likely in a campaign, as alternatives to be held against its records.

What a mistake does to a record is its column to first order; a mistake that is large is refused
when the record is read. An accelerometer turned about its input axis, which its records may not
show, is a fit of its own: half a turn reverses the sign of K_IP, K_IO, delta_O and delta_P, a
quarter exchanges K_PP and K_OO.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.inference.distributions import normal_cdf
from counterspin.inference.joint.alternatives import Alternative
from counterspin.inference.joint.design_blocks import DesignBlock
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.series import (
    TIMING,
    expected_output,
    input_affects,
    input_column,
    input_owner,
    rotation_column,
)
from counterspin.inference.joint.unknowns import ROTATION, Considered
from counterspin.physics import observation
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.own_velocity import AxisError, computer_correction
from counterspin.physics.terms import SHARED_TERMS, TERMS, term

SCALE: Final = "scale"  #: relative change of an accelerometer's recorded output
RUN_SCALE: Final = "run scale"  #: the same in one run only
RESPONSE: Final = "response"  #: s^2; a gain of 1 - RESPONSE w^2/2 at the angular frequency w
ANGLE: Final = "angle"  #: rad, by which a recorded angle is too small
BIAS: Final = "bias"  #: g, of one accelerometer in one run
BIAS_DRIFT: Final = "bias drift"  #: g/s, of an accelerometer in one run, or in each from its start
JUMP: Final = "jump"  #: step of a record, in its unit
CORIOLIS: Final = "coriolis"  #: part of the error velocity that is wrongly taken into account
SLOPE: Final = "slope"  #: change of a record's slope, in its unit and 1/s
BIAS_STEP: Final = "bias step"  #: g, of one accelerometer within one run

#: Estimates of the part of the error velocity, which is all or nothing.
_WHOLE_VELOCITY: Final = (0.8, 1.2)

#: Up to here a change of scale, and a turn of the angle in rad, is not refused by reading.
_SCALE_RANGE: Final = (-0.5, 0.5)
_ANGLE_RANGE: Final = (-0.5, 0.5)

#: Largest change of the gain at the frequency of the fastest run, and the step of a second
#: derivative in parts of a radian of that run.
_LARGEST_RESPONSE: Final = 0.1
_RESPONSE_STEP: Final = 1e-2

#: Terms of accelerometers and platform.
_ERRORS: Final = frozenset((*TERMS, *SHARED_TERMS))

#: Numbers of neighbouring residuals that are added up.
_WINDOWS: Final = (4, 16, 64, 256)

#: ln of the decades, about six, that a mistake may be of.
_DECADES: Final = 6.0 * math.log(10.0)

#: Part of the stated values that are off which are mistaken, rather than off by what is typical.
_MISTAKE_PROBABILITY: Final = 0.5

#: How likely a mistake of some kind is beside one of the whole campaign.
_PRIOR_ODDS: Final[Mapping[str, float]] = {
    "priors": 0.3,  # several statements, all off by as much
    RUN_SCALE: 0.1,
    BIAS: 0.1,
    BIAS_DRIFT: 0.3,
    JUMP: 0.03,
    SLOPE: 0.03,
    BIAS_STEP: 0.03,
}


def record_mistakes(
    fit: JointFit, trends: Mapping[str, float], *, angle_recorded: bool
) -> Iterator[Alternative]:
    """Yield what may be otherwise in the records of an accelerometer, of a run, or of all.

    trends: Accelerometer -> typical size of a drift of its bias, g/s.
    angle_recorded: Whether the spindle's angle was; else its zero is found and nothing can be wrong
        with it.
    """
    design_blocks = fit.design_blocks
    outputs = {i: _fitted_output(fit, i) for i in range(len(design_blocks))}
    accelerometers = list(dict.fromkeys(block.accelerometer for block in design_blocks))
    runs = list(dict.fromkeys(block.run for block in design_blocks))
    limits = {(unknown.owner, unknown.symbol): unknown.limit for unknown in fit.model.unknowns}
    for name in accelerometers:
        columns = {
            i: outputs[i] for i, block in enumerate(design_blocks) if block.accelerometer == name
        }
        yield Alternative(SCALE, name, SCALE, columns, credible_range=_SCALE_RANGE)
        if len(columns) > 1:
            yield _bias_drift(fit, list(columns), name, trends[name])
    if len(runs) > 1:
        yield from _low_pass_alternatives(fit, accelerometers)
    for run in runs if len(runs) > 1 else ():
        columns = {i: outputs[i] for i, block in enumerate(design_blocks) if block.run == run}
        yield Alternative(RUN_SCALE, run, SCALE, columns, credible_range=_SCALE_RANGE)
    for i, block in enumerate(design_blocks):
        owner = f"{block.run}.{block.accelerometer}"
        if len(accelerometers) > 1 and len(runs) > 1:
            column = {i: outputs[i]}
            yield Alternative(RUN_SCALE, owner, SCALE, column, credible_range=_SCALE_RANGE)
        drift_column = _integrated_bias(fit, i, 0)
        limit = limits.get((block.accelerometer, "K_F"), TERMS["K_F"].limit)
        yield Alternative(BIAS, owner, BIAS, {i: drift_column}, credible_range=(-limit, limit))
        yield _bias_drift(fit, [i], owner, trends[block.accelerometer])
    if angle_recorded:
        angle_columns = {
            i: rotation_column(block.series, ROTATION[0]) for i, block in enumerate(design_blocks)
        }
        yield Alternative(ANGLE, "", "records.angle", angle_columns, credible_range=_ANGLE_RANGE)
        for run in runs if len(runs) > 1 else ():
            columns = {
                i: angle_columns[i] for i, block in enumerate(design_blocks) if block.run == run
            }
            yield Alternative(ANGLE, run, ANGLE, columns, credible_range=_ANGLE_RANGE)


def _low_pass_alternatives(fit: JointFit, accelerometers: Sequence[str]) -> Iterator[Alternative]:
    """Yield for each accelerometer that its gain depends on the frequency.

    A first-order low pass of time constant tau has the gain 1 - (w tau)^2/2: it adds tau^2/2 times
    the second derivative of what is recorded. It also delays by tau, as a late angle does.
    """
    design_blocks = fit.design_blocks
    fastest = max(abs(block.series.trajectory.spindle.rate) for block in design_blocks)
    step, limit = _RESPONSE_STEP / fastest, 2.0 * _LARGEST_RESPONSE / fastest**2
    for name in accelerometers:
        columns = {}
        for i, block in enumerate(design_blocks):
            if block.accelerometer == name:
                before, at_sample, after = (
                    block.series.reference(delay=delay) for delay in (-step, 0.0, step)
                )
                columns[i] = 0.5 * (before - 2.0 * at_sample + after) / step**2
        yield Alternative(RESPONSE, name, RESPONSE, columns, credible_range=(-limit, limit))


def _integrated_bias(fit: JointFit, i: int, power: int, start: float | None = None) -> Array:
    """Return the effect of a bias of t^power on a record, in g and s from a time or its start."""
    series = fit.design_blocks[i].series
    exponent = power + series.order
    column: Array = (series.time - (series.time[0] if start is None else start)) ** exponent
    return column * (
        series.trajectory.site.gravity * math.factorial(power) / math.factorial(exponent)
    )


def _bias_drift(
    fit: JointFit, indices: Sequence[int], owner: str, default_sd: float
) -> Alternative:
    """Return the alternative of a bias drift in some records, in each from its start."""
    columns = {i: _integrated_bias(fit, i, 1) for i in indices}
    longest = max(float(np.ptp(fit.design_blocks[i].series.time)) for i in indices)
    steepest = TERMS["K_F"].limit / longest
    return Alternative(
        BIAS_DRIFT,
        owner,
        BIAS_DRIFT,
        columns,
        credible_range=(-steepest, steepest),
        default_sd=default_sd,
    )


def _fitted_output(fit: JointFit, i: int) -> Array:
    """Return the fitted output. The recorded output would correlate with its own noise."""
    series = fit.design_blocks[i].series
    return series.reference() + series.error - fit.residuals[i].unweighted


def coriolis_mistakes(fit: JointFit, *, own_velocity: bool) -> Iterator[Alternative]:
    """Yield that the navigation computers took the other velocity for the Coriolis acceleration.

    own_velocity: Whether they are said to take their own; else the platform's.
    """
    columns: dict[int, Array] = {}
    for run in dict.fromkeys(block.run for block in fit.design_blocks):
        block_indices = [i for i, block in enumerate(fit.design_blocks) if block.run == run]
        errors = []
        for i in block_indices:
            series = fit.design_blocks[i].series
            site, axis = series.trajectory.site, series.mounting.turned(series.attitude).input_axis
            residual_gravity = observation.residual_gravity(
                site, axis, series.time, series.observable
            )
            errors.append(
                AxisError(axis, series.observable, series.time, series.error + residual_gravity)
            )
        for i, block in zip(block_indices, computer_correction(site, errors), strict=True):
            if block.any():
                columns[i] = block if own_velocity else -block
    if columns:
        yield Alternative(
            CORIOLIS, "", "records.reference", columns, credible_range=_WHOLE_VELOCITY
        )


def evaluate_alternative(fit: JointFit, alternative: Alternative, value: float) -> Alternative:
    """Return an alternative with the columns that it has where it is as large as `value`.

    A turned angle is no longer a first-order matter from a degree on, and what a record is a
    multiple of is known only once its scale is.

    alternative: One of this module's.
    """
    if alternative.kind in (SCALE, RUN_SCALE):
        return replace(
            alternative, columns={i: _fitted_output(fit, i) for i in alternative.columns}
        )
    if alternative.kind == ANGLE or alternative.symbol == TIMING:
        columns = {}
        for i in alternative.columns:
            series = fit.design_blocks[i].series
            if alternative.kind == ANGLE:
                spindle = series.trajectory.spindle
                new_spindle = replace(spindle, start_angle=spindle.start_angle + value)
                reference = series.reference(replace(series.trajectory, spindle=new_spindle))
            else:
                reference = series.reference(delay=-value)
            columns[i] = (reference - series.reference()) / value
        return replace(alternative, columns=columns)
    return alternative


def changepoints(
    fit: JointFit, count: int, about: Alternative | None = None, within: float = 0.0
) -> Iterator[Alternative]:
    """Yield steps and bends of each record at evenly spaced times, or of one about a time.

    A step of the bias is a step of a force and a bend of a velocity; of a displacement it is one
    more, without which a bias that settles early in a run is told from none.

    about: One that has been found; None: all records, over their whole length.
    within: s, how far from it.
    """
    for i, block in enumerate(fit.design_blocks):
        owner, time = f"{block.run}.{block.accelerometer}", block.series.time
        start, end = float(time[0]), float(time[-1])
        last, output_range = (
            end,
            float(np.ptp(_fitted_output(fit, i))),
        )  # no step exceeds what is recorded
        if about is not None:
            if about.owner != owner or about.time is None:
                continue
            start, end = max(start, about.time - within), min(end, about.time + within)
        for at in np.linspace(start, end, count + 2)[1:-1].tolist():
            step = (time > at).astype(float)
            if not 0.0 < step.sum() < step.size:
                continue
            if about is None or about.kind == JUMP:
                yield Alternative(
                    JUMP,
                    owner,
                    JUMP,
                    {i: step},
                    time=at,
                    credible_range=(-output_range, output_range),
                )
            if about is None or about.kind == SLOPE:
                ramp, steepest = {i: step * (time - at)}, output_range / (last - at)
                yield Alternative(
                    SLOPE, owner, SLOPE, ramp, time=at, credible_range=(-steepest, steepest)
                )
            if block.series.order == 2 and (about is None or about.kind == BIAS_STEP):
                column, limit = {i: step * _integrated_bias(fit, i, 0, at)}, TERMS["K_F"].limit
                yield Alternative(
                    BIAS_STEP, owner, BIAS_STEP, column, time=at, credible_range=(-limit, limit)
                )


def input_mistakes(fit: JointFit, inputs: Mapping[str, float]) -> Iterator[Alternative]:
    """Yield inputs that are stated as exact.

    inputs: Symbol -> typical size.
    """
    for name, default_sd in inputs.items():
        columns = {}
        for i, block in enumerate(fit.design_blocks):
            if not input_affects(block.series, name, input_owner(block.series, name)):
                continue
            # What the errors found so far are of depends on the inputs too.
            table = {
                symbol: column
                for index, column in zip(block.unknowns, block.design.T, strict=True)
                if (symbol := fit.model.unknowns[index].symbol) in _ERRORS
            }
            known = {
                symbol: float(fit.solution.estimate[index])
                for index in block.unknowns
                if (symbol := fit.model.unknowns[index].symbol) in table
            }
            now = expected_output(block.series, known, table)
            columns[i] = input_column(block.series, name, block.scale_factor, known, now)
        by_owner: dict[str, dict[int, Array]] = {}
        for i, column in columns.items():
            owner = input_owner(fit.design_blocks[i].series, name)
            by_owner.setdefault(owner, {})[i] = column
        for owner, known_values in by_owner.items():
            yield Alternative("input", owner, name, known_values, default_sd=default_sd)


def term_mistakes(fit: JointFit, terms: Mapping[Considered, float]) -> Iterator[Alternative]:
    """Yield terms that the model leaves out; of those that every run has anew, all alike too.

    terms: Term -> typical size.
    """
    grouped_alternatives: dict[str, list[Alternative]] = {}
    columns_by_term: dict[Considered, dict[int, Array]] = {key: {} for key in terms}
    for i, block in enumerate(fit.design_blocks):
        # The terms of a record share its motion and its integrals.
        acting = [key for key in terms if key.affects(block.series)]
        symbols = list(dict.fromkeys(key.symbol for key in acting))
        matrix = block.series.columns(symbols, block.scale_factor)
        for key in acting:
            columns_by_term[key][i] = matrix[:, symbols.index(key.symbol)]
    for alternative_term, default_sd in terms.items():
        columns = columns_by_term[alternative_term]
        credible_range = -alternative_term.limit, alternative_term.limit
        alternative = Alternative(
            "term",
            alternative_term.owner,
            alternative_term.symbol,
            columns,
            credible_range=credible_range,
            default_sd=default_sd,
        )
        yield alternative
        if term(alternative_term.symbol).per_run:
            grouped_alternatives.setdefault(alternative_term.symbol, []).append(alternative)
    for same_term in grouped_alternatives.values():
        if len(same_term) > 1:
            everywhere = {
                i: column for alternative in same_term for i, column in alternative.columns.items()
            }
            yield replace(same_term[0], owner="", columns=everywhere)


def window_test_p(values: Array) -> float:
    """Return the probability that no neighbours would be as far off together by chance.

    The largest sum of neighbouring residuals, over windows of several lengths, against its
    distribution for independent residuals; all windows count as tests (Bonferroni), which is more
    than they are.

    values: In the order of time, shape (n,).
    """
    cumulative = np.append(0.0, np.cumsum(values))
    scale = math.sqrt(float(values @ values) / max(values.size, 1)) or 1.0
    largest, tests = 0.0, 0
    for length in _WINDOWS:
        if length < values.size:
            sums = (cumulative[length:] - cumulative[:-length]) / (scale * math.sqrt(length))
            largest = max(largest, float(np.max(np.abs(sums))))
            # Windows that overlap by half or more say nearly the same.
            tests += 4 * math.ceil(values.size / length)
    return min(1.0, 2.0 * max(tests, 1) * normal_cdf(-largest))


def log_bayes_factor(alternative: Alternative, value: float, u: float) -> float:
    """Return ln of the evidence for an alternative, but for what all have and for how it fits.

    For a parameter that fits as v with the standard uncertainty u it goes as u p(v), where p is
    what was known of it before (Jeffreys, Theory of Probability, 3rd ed., sections 5.0 and 5.2).
    Of a term p has the width of its typical size, which is an order of magnitude, and Cauchy's wide
    tails. A mistake, such as a digit, a unit or a place, is of any size: 1/|v| over the decades.
    """
    if not (math.isfinite(u) and u > 0.0 and value != 0.0):
        return -math.inf
    prior_odds = _PRIOR_ODDS.get(alternative.kind, 1.0)
    mistake_density = prior_odds / (abs(value) * _DECADES)
    if alternative.default_sd is None or not alternative.default_sd > 0.0:
        return math.log(u * mistake_density)
    prior_density = prior_odds / (
        math.pi * alternative.default_sd * (1.0 + (value / alternative.default_sd) ** 2)
    )
    if alternative.stated:
        prior_density = (
            _MISTAKE_PROBABILITY * mistake_density + (1.0 - _MISTAKE_PROBABILITY) * prior_density
        )
    return math.log(u * prior_density)


# Turned about the input axis -------------------------------------------------------------------

#: The terms that the turn changes.
ACROSS: Final = tuple(
    symbol for symbol, row in TERMS.items() if not {"P", "O"}.isdisjoint(row.effect.factors)
)


def rotate_mounting(mounting: Mounting, quarters: int) -> Mounting:
    """Return a mounting after quarter turns about its input axis, from P towards O."""
    input_axis, pendulous, output = mounting.matrix
    for _ in range(quarters % 4):
        pendulous, output = output, -pendulous
    rotated_mounting = Mounting.from_axes(input_axis.tolist(), pendulous.tolist(), output.tolist())
    return replace(rotated_mounting, response=mounting.response)


def with_rotated_mounting(fit: JointFit, accelerometer: str, quarters: int) -> JointFit:
    """Return a relaxed fit with an accelerometer turned; what was stated is of its axes then."""
    observations = tuple(
        _recompute_columns(fit, observation, quarters)
        if isinstance(observation, DesignBlock) and observation.accelerometer == accelerometer
        else observation
        for observation in fit.observations
    )
    fit = replace(fit, observations=observations)
    return fit.with_noise({name: fit.noise[name] for name in fit.noise if name == accelerometer})


def _recompute_columns(fit: JointFit, block: DesignBlock, quarters: int) -> DesignBlock:
    symbols = [fit.model.unknowns[index].symbol for index in block.unknowns]
    places = [k for k, symbol in enumerate(symbols) if symbol in ACROSS]
    series = replace(block.series, mounting=rotate_mounting(block.series.mounting, quarters))
    design = block.design.copy()
    if places:
        columns = series.columns([symbols[k] for k in places], block.scale_factor)
        design[:, places] = np.asarray(columns)
    return replace(block, series=series, design=design)
