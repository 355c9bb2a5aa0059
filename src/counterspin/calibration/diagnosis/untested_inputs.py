"""Inputs that the data contradict or cannot check: mountings, stated values, clocks.

The records determine the input axis. The other two axes matter only for the terms with a_P and a_O.
If such a term is stated, each of the three other mountings is tested by a separate fit. A mounting
that fits significantly better is a cause. A mounting that fits equally well and shifts a
coefficient leads to a remark.

The data do not verify every stated value, nor the clock of a recorder that several runs share. A
remark reports such an input if an undetected error of it, up to its default standard uncertainty,
shifts a coefficient by several u.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.accelerometer_view import AccelerometerView, FittedGroup
from counterspin.calibration.checks.shifts import format_magnitude, largest_shift
from counterspin.calibration.result_parts import Finding
from counterspin.campaign.description import Campaign
from counterspin.frozen import frozen
from counterspin.inference.diagnostics import SIGNIFICANCE, normal_equivalent
from counterspin.inference.distributions import normal_quantile
from counterspin.inference.joint.alternatives import prior_alternatives
from counterspin.inference.joint.estimation import Estimate
from counterspin.inference.joint.fit import JointFit, estimate_considered
from counterspin.inference.joint.mistakes import (
    CROSS_AXIS_SYMBOLS,
    rotate_accelerometer,
    rotate_mounting,
)
from counterspin.inference.joint.series import CLOCK
from counterspin.reports.numbers import format_number

#: Standard deviations by which a mounting must fit worse to be excluded.
_EXCLUSION_SIGMAS: Final = 3.0

#: Shift of a coefficient, in u, from which a possible mounting leads to a remark.
_MIN_MOUNTING_SHIFT: Final = 1.0

_DIRECTION_NAMES: Final = (("west", "east"), ("south", "north"), ("down", "up"))

#: Size of a detectable error, in standard deviations of the residuals.
_DETECTABLE_SIGMAS: Final = 4.0

#: Shift of a coefficient, in u, from which an untested input leads to a remark.
_MIN_INPUT_SHIFT: Final = 2.0

#: Largest number of untested inputs in a remark.
_MAX_NAMED_INPUTS: Final = 3


@frozen
class AlternativeMounting:
    """A fit with an accelerometer rotated about its input axis."""

    view: AccelerometerView  #: View with the stated mounting.
    quarter_turns: int  #: Quarter turns from the stated pendulous axis towards the output axis.
    fit: JointFit  #: Relaxed fit with the rotated mounting.
    gain: float  #: Decrease in chi-square from the stated mounting, over the residual variance.
    dof: float | None  #: Degrees of freedom of the residual variance; None: stated noise.
    groups: tuple[FittedGroup, ...] = ()  #: All readings, evaluated in this fit.

    @property
    def pendulous_directions(self) -> tuple[str, str]:
        """Stated and alternative direction of the pendulous axis."""
        stated_mounting = self.view.accelerometer.mounting
        return _describe_direction(stated_mounting.matrix[1]), _describe_direction(
            rotate_mounting(stated_mounting, self.quarter_turns).matrix[1]
        )

    def apply_to(self, view: AccelerometerView) -> AccelerometerView:
        """Return a view of an accelerometer with the readings evaluated in this fit."""
        return view.select_groups(self.groups)

    def largest_shift(self) -> tuple[str, float, float]:
        """Return the coefficient with the largest shift, the shift, and the shift over u."""
        candidates = [
            (symbol, shift, abs(shift) / u)
            for symbol, index in self.view.indices.items()
            if self.view.assessment.determined[f"{self.view.name}.{symbol}"]
            and symbol not in CROSS_AXIS_SYMBOLS
            and (u := float(self.view.fit.solution.u[index])) > 0.0
            for shift in [
                float(self.fit.solution.estimate[index] - self.view.fit.solution.estimate[index])
            ]
        ]
        return max(candidates, key=lambda candidate: candidate[2], default=("", 0.0, 0.0))


def fit_rotated_mountings(views: Sequence[AccelerometerView]) -> tuple[AlternativeMounting, ...]:
    """Return the alternative mountings of the accelerometers with stated cross-axis terms."""
    mountings = []
    estimate = views[0].estimate
    relaxed_estimate = replace(estimate, fit=estimate_considered(estimate.fit), compressed_fit=None)
    groups = tuple({id(group): group for view in views for group in view.groups}.values())
    for view in views:
        if not _stated_cross_terms(view):
            continue
        is_noise_known = not view.has_records or view.diagnostics.noise_given
        is_noise_known &= all(math.isinf(group.noise_dof) for group in view.groups)
        (stated_fit, _), *rotated_fits = (
            _fit_rotated_mounting(view, relaxed_estimate, groups, quarter_turns)
            for quarter_turns in range(4)
        )
        for quarter_turns, (fit, new_groups) in enumerate(rotated_fits, 1):
            residual_variance = fit.solution.chi2 / max(fit.solution.dof, 1.0)
            residual_variance = max(residual_variance, 1.0) if is_noise_known else residual_variance
            gain = (stated_fit.solution.chi2 - fit.solution.chi2) / residual_variance
            dof = None if is_noise_known else max(fit.solution.dof, 1.0)
            mountings.append(AlternativeMounting(view, quarter_turns, fit, gain, dof, new_groups))
    return tuple(mountings)


def _fit_rotated_mounting(
    view: AccelerometerView,
    relaxed_estimate: Estimate,
    groups: Sequence[FittedGroup],
    quarter_turns: int,
) -> tuple[JointFit, tuple[FittedGroup, ...]]:
    """Return a relaxed fit with a rotated accelerometer, and its evaluated readings."""
    fit = (
        rotate_accelerometer(relaxed_estimate.fit, view.name, quarter_turns)
        if quarter_turns
        else relaxed_estimate.fit
    )
    # The degrees of freedom are not used.
    dof = np.full(len(fit.model.unknowns), np.inf)
    estimate = replace(relaxed_estimate, fit=fit, dof=dof)
    return view.reading_data.fit_rotated_mounting(
        estimate, groups, view.name, partial(rotate_mounting, quarter_turns=quarter_turns)
    )


def _stated_cross_terms(view: AccelerometerView) -> list[str]:
    """Return the terms with a_P or a_O that have stated priors."""
    stated_terms = {*view.accelerometer.priors, *view.campaign.model.priors}
    return [symbol for symbol in CROSS_AXIS_SYMBOLS if symbol in stated_terms]


def find_better_mounting(mountings: Sequence[AlternativeMounting]) -> AlternativeMounting | None:
    """Return the best mounting if it fits significantly better than the stated one.

    If the stated mounting is correct, the p-value of a gain c in chi-square is at most the
    one-sided tail probability of sqrt(c), by the normal distribution or, for estimated noise, by
    Student's t.
    """
    best_mounting = max(mountings, key=lambda mounting: mounting.gain, default=None)
    if best_mounting is None or best_mounting.gain <= 0.0:
        return None
    tail_p = 0.5 * SIGNIFICANCE / len(mountings)
    z = normal_equivalent(math.sqrt(best_mounting.gain), best_mounting.dof)
    return best_mounting if z > normal_quantile(1.0 - tail_p) else None


def mounting_finding(mounting: AlternativeMounting) -> Finding:
    """Return the finding that the mounting of an accelerometer is not as stated."""
    name, (stated_axis, fitted_axis) = mounting.view.name, mounting.pendulous_directions
    symbol, shift, z = mounting.largest_shift()
    data_name, sense_clause = "records", ""
    if any(group.motion != "poses" for group in mounting.view.groups):
        data_name, sense_clause = "readings", ", the sense of rotation of the attitudes"
    text = (
        f"The {data_name} of {name} would fit if the pendulous axis pointed {fitted_axis} instead "
        f"of the stated {stated_axis}. Check pendulous_axis{sense_clause}, and the axes of the "
        f"stated {_join_symbols(_stated_cross_terms(mounting.view))}."
    )
    if symbol:
        ratio_text = format_number(z, 2)
        text += (
            f" {symbol} would change by {format_magnitude(symbol, shift)}, {ratio_text} times the "
            f"u of {symbol}."
        )
    return Finding(
        code="wrong-mounting",
        subject=name,
        text=text,
        size=math.sqrt(mounting.gain),
        contradicts=z > 1.0,
    )


def undetermined_axis_remarks(mountings: Sequence[AlternativeMounting]) -> Iterator[str]:
    """Yield a remark for each accelerometer whose result depends on undetermined axes."""
    for name in dict.fromkeys(mounting.view.name for mounting in mountings):
        candidates = [mounting for mounting in mountings if mounting.view.name == name]
        if find_better_mounting(candidates) is not None:
            continue
        possible_mountings = [
            mounting for mounting in candidates if mounting.gain > -(_EXCLUSION_SIGMAS**2)
        ]
        # Opposite quarter turns may differ by rounding only: the first one counts.
        worst_mounting = max(
            possible_mountings,
            key=lambda mounting: round(mounting.largest_shift()[2], 6),
            default=None,
        )
        if worst_mounting is None or worst_mounting.largest_shift()[2] < _MIN_MOUNTING_SHIFT:
            continue
        symbol, shift, z = worst_mounting.largest_shift()
        stated_axis, fitted_axis = worst_mounting.pendulous_directions
        direction = "larger" if shift > 0.0 else "smaller"
        symbols = _stated_cross_terms(worst_mounting.view)
        values, verb = ("values", "depend") if symbols[1:] else ("value", "depends")
        yield (
            f"{name}: the records do not determine the direction of the pendulous axis, and the "
            f"stated {values} of {_join_symbols(symbols)} {verb} on this direction. With "
            f"{fitted_axis} instead of {stated_axis}, the records would fit equally well, but "
            f"{symbol} would be {format_magnitude(symbol, abs(shift))} {direction}, a change of "
            f"{format_number(z, 2)} times the u of {symbol}."
        )


def _join_symbols(symbols: Sequence[str]) -> str:
    return " and ".join([", ".join(symbols[:-1]), symbols[-1]] if symbols[1:] else symbols)


def _describe_direction(axis: np.ndarray) -> str:
    """Return a direction as in the description: a name, or three components."""
    for index, names in enumerate(_DIRECTION_NAMES):
        if abs(axis[index]) > 1.0 - 1e-9:
            return names[int(axis[index] > 0.0)]
    return f"[{', '.join(format_number(float(component), 4) for component in axis)}]"


# Inputs that the data cannot check


@frozen
class _UntestedInput:
    """An input that the data may not verify."""

    description: str  #: Description in a remark.
    symbol: str  #: Symbol of the term or input.
    default_sd: float  #: Default standard uncertainty.
    indices: tuple[int, ...]  #: Indices of its unknowns.
    #: Effect of one unit on the rows of the blocks, shape (n,), and on the priors, shape (p,).
    row_effect: Array
    prior_effect: Array


def untested_input_remarks(views: Sequence[AccelerometerView]) -> Iterator[str]:
    """Yield a remark for each accelerometer whose result depends on unverifiable inputs."""
    fit = estimate_considered(views[0].fit)
    inputs = [*_stated_prior_inputs(views[0].campaign, fit), *_run_clock_inputs(fit)]
    if not inputs:
        return
    data = np.column_stack([candidate.row_effect for candidate in inputs])
    priors = np.column_stack([candidate.prior_effect for candidate in inputs])
    residual_norms = np.linalg.norm(fit.solution.project_out(data, priors), axis=0)
    default_sds = np.array([candidate.default_sd for candidate in inputs])
    input_changes = np.minimum(
        default_sds,
        _DETECTABLE_SIGMAS / np.maximum(residual_norms, _DETECTABLE_SIGMAS / default_sds),
    )
    shifts = input_changes * fit.solution.undetected_shifts(data, priors)
    for view in views:
        remarks = []
        for index, candidate in enumerate(inputs):
            symbol, shift, ratio = largest_shift(view, candidate.indices, shifts[:, index])
            if ratio >= _MIN_INPUT_SHIFT:
                clause = (
                    f"{candidate.description} has an error of "
                    f"{format_magnitude(candidate.symbol, float(input_changes[index]))}"
                )
                shift_text = (
                    f"{format_magnitude(symbol, abs(shift))}, or "
                    f"{format_number(ratio, 2)} u({symbol})"
                )
                remarks.append((ratio, f"if {clause}, the error of {symbol} is {shift_text}"))
        remarks.sort(reverse=True)
        if remarks:
            yield (
                f"The result for {view.name} depends on values that the data cannot verify: "
                f"{'; '.join(sentence for _, sentence in remarks[:_MAX_NAMED_INPUTS])}. The "
                "residuals would not reveal an error in these values."
            )


def _stated_prior_inputs(campaign: Campaign, fit: JointFit) -> Iterator[_UntestedInput]:
    """Yield the stated values with an uncertainty; values common to all runs count once."""
    prior_sd = fit.solution.prior_sd
    rows = sum(block.factor.shape[0] for block in fit.blocks)
    for alternative in prior_alternatives(fit):
        indices = tuple(index for index in alternative.prior_shifts if prior_sd[index] > 0.0)
        priors = np.zeros(prior_sd.size)
        priors[list(indices)] = [-alternative.prior_shifts[index] for index in indices]
        symbol = fit.model.unknowns[next(iter(alternative.prior_shifts))].symbol
        default_sd = campaign.typical_of(symbol, alternative.owner)
        yield _UntestedInput(
            f"the stated value of {alternative.name}",
            symbol,
            default_sd,
            indices,
            np.zeros(rows),
            fit.solution.whiten_priors(priors[:, None])[:, 0],
        )


def _run_clock_inputs(fit: JointFit) -> Iterator[_UntestedInput]:
    """Yield the clock of each run whose recorder also recorded other runs."""
    for index, unknown in enumerate(fit.model.unknowns):
        if unknown.symbol != CLOCK:
            continue
        depends_on_clock = [index in observation.unknowns for observation in fit.observations]
        runs = dict.fromkeys(
            observation.run
            for observation, is_dependent in zip(fit.observations, depends_on_clock, strict=True)
            if is_dependent
        )
        for run in runs if len(runs) > 1 else ():
            data = np.concatenate(
                [
                    block.factor[:, index] * float(observation.run == run)
                    for observation, block in zip(fit.observations, fit.blocks, strict=True)
                ]
            )
            description = f"the clock during {run} only"
            priors = np.zeros(len(fit.model.unknowns))
            yield _UntestedInput(description, CLOCK, unknown.prior[1], (index,), data, priors)
