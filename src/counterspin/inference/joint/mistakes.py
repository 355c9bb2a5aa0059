"""Likely mistakes of a campaign, as alternative hypotheses.

The column of a mistake is its first-order effect on the records; large mistakes are rejected when
a record is read. An accelerometer that is rotated about its input axis requires a fit of its own:
half a turn reverses the sign of K_IP, K_IO, delta_O and delta_P, a quarter turn exchanges K_PP and
K_OO.
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

SCALE: Final = "scale"  #: relative error of the recorded output of an accelerometer
RUN_SCALE: Final = "run scale"  #: relative error of the recorded output in a single run
RESPONSE: Final = "response"  #: s^2; a gain of 1 - RESPONSE w^2/2 at the angular frequency w
ANGLE: Final = "angle"  #: offset by which a recorded angle is too small, rad
BIAS: Final = "bias"  #: change of the bias of an accelerometer in a run, g
BIAS_DRIFT: Final = "bias drift"  #: drift from the start of a run or of each run, g/s
JUMP: Final = "jump"  #: step of a record, in its unit
CORIOLIS: Final = "coriolis"  #: fraction of the error velocity that is wrongly included
HEMISPHERE: Final = "hemisphere"  #: 1 if the sign of the latitude is wrong, 0 if it is right
SLOPE: Final = "slope"  #: change of the slope of a record, in its unit per second
BIAS_STEP: Final = "bias step"  #: step of the bias of an accelerometer during a run, g

#: Credible estimates of the Coriolis fraction, which is 0 or 1.
_FULL_CORIOLIS_RANGE: Final = (0.8, 1.2)

#: Credible estimates of a wrong hemisphere, of which the records may show little.
_HEMISPHERE_RANGE: Final = (0.5, 1.5)

#: Ranges of scale and angle (rad) errors that the reading of records does not reject.
_SCALE_RANGE: Final = (-0.5, 0.5)
_ANGLE_RANGE: Final = (-0.5, 0.5)

#: Largest change of the gain at the frequency of the fastest run, and step of a second derivative,
#: in radians of this run.
_MAX_RESPONSE: Final = 0.1
_RESPONSE_STEP: Final = 1e-2

#: Terms of accelerometers and platform.
_ERROR_TERMS: Final = frozenset((*TERMS, *SHARED_TERMS))

#: Numbers of adjacent residuals in a sum.
_WINDOW_LENGTHS: Final = (4, 16, 64, 256)

#: Logarithm of the range of the size of a mistake, about six decades.
_LOG_RANGE: Final = 6.0 * math.log(10.0)

#: Prior probability that the error of a stated value is a mistake, and not of typical size.
_MISTAKE_PROBABILITY: Final = 0.5

#: Kind of mistake -> prior odds relative to a mistake of the whole campaign.
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
    fit: JointFit, drift_sds: Mapping[str, float], *, has_recorded_angle: bool
) -> Iterator[Alternative]:
    """Yield mistakes in the records of an accelerometer, a run or the campaign.

    drift_sds: Accelerometer -> typical size of a bias drift, g/s.
    has_recorded_angle: Whether the spindle angle was recorded; otherwise its zero is estimated.
    """
    design_blocks = fit.design_blocks
    outputs = {i: _fitted_output(fit, i) for i in range(len(design_blocks))}
    accelerometers = list(dict.fromkeys(block.accelerometer for block in design_blocks))
    runs = list(dict.fromkeys(block.run for block in design_blocks))
    limits = {(unknown.owner, unknown.symbol): unknown.limit for unknown in fit.model.unknowns}
    for name in accelerometers:
        rows = [i for i, block in enumerate(design_blocks) if block.accelerometer == name]
        columns = {i: outputs[i] for i in rows}
        yield Alternative(SCALE, name, SCALE, columns, credible_range=_SCALE_RANGE)
        if len(columns) > 1:
            yield _bias_drift_alternative(fit, list(columns), name, drift_sds[name])
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
        bias_column = _bias_column(fit, i, 0)
        limit = limits.get((block.accelerometer, "K_F"), TERMS["K_F"].limit)
        yield Alternative(BIAS, owner, BIAS, {i: bias_column}, credible_range=(-limit, limit))
        yield _bias_drift_alternative(fit, [i], owner, drift_sds[block.accelerometer])
    if has_recorded_angle:
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
    """Yield a low-pass response of each accelerometer.

    A first-order low pass with time constant tau has the gain 1 - (w tau)^2/2: it adds tau^2/2
    times the second derivative of the output. It also delays the output by tau, like a late angle.
    """
    design_blocks = fit.design_blocks
    max_rate = max(abs(block.series.trajectory.spindle.rate) for block in design_blocks)
    step, limit = _RESPONSE_STEP / max_rate, 2.0 * _MAX_RESPONSE / max_rate**2
    for name in accelerometers:
        columns = {}
        for i, block in enumerate(design_blocks):
            if block.accelerometer == name:
                earlier, current, later = (
                    block.series.reference(delay=delay) for delay in (-step, 0.0, step)
                )
                columns[i] = 0.5 * (earlier - 2.0 * current + later) / step**2
        yield Alternative(RESPONSE, name, RESPONSE, columns, credible_range=(-limit, limit))


def _bias_column(fit: JointFit, i: int, power: int, start: float | None = None) -> Array:
    """Return the effect of a bias t^power on a record, with t in s from `start` and bias in g."""
    series = fit.design_blocks[i].series
    exponent = power + series.order
    column: Array = (series.time - (series.time[0] if start is None else start)) ** exponent
    return column * (
        series.trajectory.site.gravity * math.factorial(power) / math.factorial(exponent)
    )


def _bias_drift_alternative(
    fit: JointFit, indices: Sequence[int], owner: str, default_sd: float
) -> Alternative:
    """Return the alternative of a bias drift from the start of some records."""
    columns = {i: _bias_column(fit, i, 1) for i in indices}
    max_duration = max(float(np.ptp(fit.design_blocks[i].series.time)) for i in indices)
    max_drift = TERMS["K_F"].limit / max_duration
    return Alternative(
        BIAS_DRIFT,
        owner,
        BIAS_DRIFT,
        columns,
        credible_range=(-max_drift, max_drift),
        default_sd=default_sd,
    )


def _fitted_output(fit: JointFit, i: int) -> Array:
    """Return the fitted output. The recorded output would correlate with its own noise."""
    series = fit.design_blocks[i].series
    return series.reference() + series.error - fit.residuals[i].unweighted


def coriolis_mistakes(fit: JointFit, *, uses_own_velocity: bool) -> Iterator[Alternative]:
    """Yield the mistake that navigation computers use the other velocity for Coriolis terms.

    uses_own_velocity: Whether the description states their own velocity; else the platform's.
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
                columns[i] = block if uses_own_velocity else -block
    if columns:
        yield Alternative(
            CORIOLIS, "", "records.reference", columns, credible_range=_FULL_CORIOLIS_RANGE
        )


def hemisphere_mistakes(fit: JointFit) -> Iterator[Alternative]:
    """Yield the mistake that the latitude has the wrong sign, if it affects the records."""
    columns = {}
    for i, block in enumerate(fit.design_blocks):
        series, trajectory = block.series, block.series.trajectory
        site = replace(trajectory.site, latitude=-trajectory.site.latitude)
        columns[i] = series.reference(replace(trajectory, site=site)) - series.reference()
    if any(column.any() for column in columns.values()):
        yield Alternative(HEMISPHERE, "", HEMISPHERE, columns, credible_range=_HEMISPHERE_RANGE)


def evaluate_alternative(fit: JointFit, alternative: Alternative, value: float) -> Alternative:
    """Return an alternative with its columns computed at an estimated value.

    The effect of an angle above a degree is nonlinear, and the column of a scale error depends on
    the fitted output.

    alternative: An alternative of this module.
    """
    if alternative.kind in (SCALE, RUN_SCALE):
        columns = {i: _fitted_output(fit, i) for i in alternative.columns}
        return replace(alternative, columns=columns)
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
    fit: JointFit, n_times: int, center: Alternative | None = None, half_width: float = 0.0
) -> Iterator[Alternative]:
    """Yield steps and changes of slope of records at evenly spaced times.

    A step of the bias is a step of specific force, a change of slope of velocity, and an additional
    kind of change for displacement.

    center: Alternative about whose time a single record is searched; None: all records.
    half_width: Half-width of this search, s.
    """
    for i, block in enumerate(fit.design_blocks):
        owner, time = f"{block.run}.{block.accelerometer}", block.series.time
        start, end = float(time[0]), float(time[-1])
        record_end, max_step = (
            end,
            float(np.ptp(_fitted_output(fit, i))),
        )  # no step exceeds the range of the output
        if center is not None:
            if center.owner != owner or center.time is None:
                continue
            start, end = max(start, center.time - half_width), min(end, center.time + half_width)
        for changepoint in np.linspace(start, end, n_times + 2)[1:-1].tolist():
            step = (time > changepoint).astype(float)
            if not 0.0 < step.sum() < step.size:
                continue
            if center is None or center.kind == JUMP:
                yield Alternative(
                    JUMP,
                    owner,
                    JUMP,
                    {i: step},
                    time=changepoint,
                    credible_range=(-max_step, max_step),
                )
            if center is None or center.kind == SLOPE:
                ramp, max_slope = (
                    {i: step * (time - changepoint)},
                    max_step / (record_end - changepoint),
                )
                yield Alternative(
                    SLOPE,
                    owner,
                    SLOPE,
                    ramp,
                    time=changepoint,
                    credible_range=(-max_slope, max_slope),
                )
            if block.series.order == 2 and (center is None or center.kind == BIAS_STEP):
                column, limit = {i: step * _bias_column(fit, i, 0, changepoint)}, TERMS["K_F"].limit
                yield Alternative(
                    BIAS_STEP,
                    owner,
                    BIAS_STEP,
                    column,
                    time=changepoint,
                    credible_range=(-limit, limit),
                )


def input_mistakes(fit: JointFit, default_sds: Mapping[str, float]) -> Iterator[Alternative]:
    """Yield errors of inputs that are stated as exact.

    default_sds: Symbol -> typical size of the error.
    """
    for name, default_sd in default_sds.items():
        columns = {}
        for i, block in enumerate(fit.design_blocks):
            if not input_affects(block.series, name, input_owner(block.series, name)):
                continue
            # The effects of estimated coefficients depend on the inputs too.
            columns_by_symbol = {
                symbol: column
                for index, column in zip(block.unknowns, block.design.T, strict=True)
                if (symbol := fit.model.unknowns[index].symbol) in _ERROR_TERMS
            }
            coefficients = {
                symbol: float(fit.solution.estimate[index])
                for index in block.unknowns
                if (symbol := fit.model.unknowns[index].symbol) in columns_by_symbol
            }
            output = expected_output(block.series, coefficients, columns_by_symbol)
            columns[i] = input_column(block.series, name, block.scale_factor, coefficients, output)
        columns_by_owner: dict[str, dict[int, Array]] = {}
        for i, column in columns.items():
            owner = input_owner(fit.design_blocks[i].series, name)
            columns_by_owner.setdefault(owner, {})[i] = column
        for owner, owner_columns in columns_by_owner.items():
            yield Alternative("input", owner, name, owner_columns, default_sd=default_sd)


def term_mistakes(fit: JointFit, terms: Mapping[Considered, float]) -> Iterator[Alternative]:
    """Yield terms that the model omits; for terms of each run, also their common value.

    terms: Term -> typical size.
    """
    alternatives_by_symbol: dict[str, list[Alternative]] = {}
    columns_by_term: dict[Considered, dict[int, Array]] = {term: {} for term in terms}
    for i, block in enumerate(fit.design_blocks):
        # The terms of a record share its motion and its integrals.
        relevant_terms = [term for term in terms if term.affects(block.series)]
        symbols = list(dict.fromkeys(term.symbol for term in relevant_terms))
        matrix = block.series.columns(symbols, block.scale_factor)
        for considered_term in relevant_terms:
            columns_by_term[considered_term][i] = matrix[:, symbols.index(considered_term.symbol)]
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
            alternatives_by_symbol.setdefault(alternative_term.symbol, []).append(alternative)
    for run_alternatives in alternatives_by_symbol.values():
        if len(run_alternatives) > 1:
            all_columns = {
                i: column
                for alternative in run_alternatives
                for i, column in alternative.columns.items()
            }
            yield replace(run_alternatives[0], owner="", columns=all_columns)


def window_test_p(residuals: Array) -> float:
    """Return the p-value of the largest sum of adjacent residuals.

    The sums over windows of several lengths are compared with their distribution for independent
    residuals. All windows count as tests (Bonferroni), which is conservative.

    residuals: In time order, shape (n,).
    """
    cumsum = np.append(0.0, np.cumsum(residuals))
    scale = math.sqrt(float(residuals @ residuals) / max(residuals.size, 1)) or 1.0
    max_sum, n_tests = 0.0, 0
    for length in _WINDOW_LENGTHS:
        if length < residuals.size:
            sums = (cumsum[length:] - cumsum[:-length]) / (scale * math.sqrt(length))
            max_sum = max(max_sum, float(np.max(np.abs(sums))))
            # Windows that overlap by half or more are nearly equivalent.
            n_tests += 4 * math.ceil(residuals.size / length)
    return min(1.0, 2.0 * max(n_tests, 1) * normal_cdf(-max_sum))


def log_bayes_factor(alternative: Alternative, value: float, u: float) -> float:
    """Return the logarithm of the Occam factor of an alternative, up to a common constant.

    For an estimate v with standard uncertainty u, the factor is proportional to u p(v) with the
    prior density p (Jeffreys, Theory of Probability, 3rd ed., sections 5.0 and 5.2). For a term, p
    is a Cauchy density with the typical size as its scale. A mistake, such as a wrong digit or
    unit, may have any size: p is proportional to 1/|v| over the decades.
    """
    if not (math.isfinite(u) and u > 0.0 and value != 0.0):
        return -math.inf
    prior_odds = _PRIOR_ODDS.get(alternative.kind, 1.0)
    mistake_density = prior_odds / (abs(value) * _LOG_RANGE)
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


# Rotation about the input axis -----------------------------------------------------------------

#: Terms that change by a rotation about the input axis.
CROSS_AXIS_SYMBOLS: Final = tuple(
    symbol for symbol, row in TERMS.items() if not {"P", "O"}.isdisjoint(row.effect.factors)
)


def rotate_mounting(mounting: Mounting, quarter_turns: int) -> Mounting:
    """Return a mounting after quarter turns about its input axis, from P towards O."""
    input_axis, pendulous_axis, output_axis = mounting.matrix
    for _ in range(quarter_turns % 4):
        pendulous_axis, output_axis = output_axis, -pendulous_axis
    rotated_mounting = Mounting.from_axes(
        input_axis.tolist(), pendulous_axis.tolist(), output_axis.tolist()
    )
    return replace(rotated_mounting, response=mounting.response)


def rotate_accelerometer(fit: JointFit, accelerometer: str, quarter_turns: int) -> JointFit:
    """Return a relaxed fit with an accelerometer rotated; stated values belong to the new axes."""
    observations = tuple(
        _recompute_columns(fit, observation, quarter_turns)
        if isinstance(observation, DesignBlock) and observation.accelerometer == accelerometer
        else observation
        for observation in fit.observations
    )
    fit = replace(fit, observations=observations)
    return fit.with_noise({name: fit.noise[name] for name in fit.noise if name == accelerometer})


def _recompute_columns(fit: JointFit, block: DesignBlock, quarter_turns: int) -> DesignBlock:
    symbols = [fit.model.unknowns[index].symbol for index in block.unknowns]
    column_indices = [k for k, symbol in enumerate(symbols) if symbol in CROSS_AXIS_SYMBOLS]
    series = replace(block.series, mounting=rotate_mounting(block.series.mounting, quarter_turns))
    design = block.design.copy()
    if column_indices:
        columns = series.columns([symbols[k] for k in column_indices], block.scale_factor)
        design[:, column_indices] = np.asarray(columns)
    return replace(block, series=series, design=design)
