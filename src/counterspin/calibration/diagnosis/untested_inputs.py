"""Statements that the data contradict, or cannot check: mountings, values, clocks.

The records hold the input axis to the motion. The other two matter only for the terms with a_P and
a_O: where something is stated of these, the three other mountings are tried, each by a fit of its
own. One that fits decidedly better is a cause. One that fits as well and would move a coefficient
is worth a remark, for nothing but the description says which it is.

A stated value that is far off what the data say is found. One of which the data say nothing is
taken as it is, and so is a recorder's clock, which runs in each run as in the others. Where such a
thing, off by no more than its typical size, would move a coefficient by several of its u and leave
no trace, a remark says so.
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
from counterspin.calibration.checks.shifts import format_size, largest_shift
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

#: Standard deviations by which a mounting may fit worse and still not be excluded.
_NOT_EXCLUDED: Final = 3.0

#: A coefficient that moves by so many of its u, or whose u grows by as much, is worth a remark.
_WORTH_A_REMARK: Final = 1.0

_DIRECTIONS: Final = (("west", "east"), ("south", "north"), ("down", "up"))

#: An error is noticed from so many standard deviations on.
_DETECTABLE_SIGMAS: Final = 4.0

#: A coefficient that moves by so many of its u is worth a remark.
_WORTH_OF_UNTESTED: Final = 2.0

#: How many such things are named.
_MAX_NAMED: Final = 3


@frozen
class AlternativeMounting:
    """A fit with an accelerometer turned about its input axis."""

    view: AccelerometerView  #: As it is stated.
    quarter_turns: int  #: Turns from the stated pendulous axis towards the output axis.
    fit: JointFit  #: Of the turned one, relaxed.
    #: By how much its chi-square is less than that of the stated one, over the residuals' scale.
    gain: float
    dof: float | None  #: Degrees of freedom of that scale; None where the noise was stated.
    groups: tuple[FittedGroup, ...] = ()  #: All readings, and how they fit then.

    @property
    def pendulous_directions(self) -> tuple[str, str]:
        """Where the pendulous axis is stated to point, and where it would."""
        stated_mounting = self.view.accelerometer.mounting
        return _describe_direction(stated_mounting.matrix[1]), _describe_direction(
            rotate_mounting(stated_mounting, self.quarter_turns).matrix[1]
        )

    def apply_to(self, view: AccelerometerView) -> AccelerometerView:
        """Return a view of an accelerometer whose readings are as they fit then."""
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


def fit_alternative_mountings(
    views: Sequence[AccelerometerView],
) -> tuple[AlternativeMounting, ...]:
    """Return the other mountings of those accelerometers whose stated terms rest on them."""
    mountings = []
    estimate = views[0].estimate
    relaxed_estimate = replace(estimate, fit=estimate_considered(estimate.fit), compressed_fit=None)
    groups = tuple({id(group): group for view in views for group in view.groups}.values())
    for view in views:
        if not _stated_cross_terms(view):
            continue
        noise_known = not view.has_records or view.diagnostics.noise_given
        noise_known = noise_known and all(math.isinf(group.noise_dof) for group in view.groups)
        (stated_fit, _), *rotated_fits = (
            _fit_rotated(view, relaxed_estimate, groups, quarter_turns)
            for quarter_turns in range(4)
        )
        for quarters, (fit, fitted_groups) in enumerate(rotated_fits, 1):
            scale = fit.solution.chi2 / max(fit.solution.dof, 1.0)
            scale = max(scale, 1.0) if noise_known else scale
            gain = (stated_fit.solution.chi2 - fit.solution.chi2) / scale
            dof = None if noise_known else max(fit.solution.dof, 1.0)
            mountings.append(AlternativeMounting(view, quarters, fit, gain, dof, fitted_groups))
    return tuple(mountings)


def _fit_rotated(
    view: AccelerometerView, relaxed: Estimate, groups: Sequence[FittedGroup], quarter_turns: int
) -> tuple[JointFit, tuple[FittedGroup, ...]]:
    """Return a relaxed fit with an accelerometer turned, its readings with the noise they have."""
    fit = (
        rotate_accelerometer(relaxed.fit, view.name, quarter_turns)
        if quarter_turns
        else relaxed.fit
    )
    # The degrees of freedom are not asked for.
    dof = np.full(len(fit.model.unknowns), np.inf)
    estimate = replace(relaxed, fit=fit, dof=dof)
    return view.data.fit_rotated_mounting(
        estimate, groups, view.name, partial(rotate_mounting, quarter_turns=quarter_turns)
    )


def _stated_cross_terms(view: AccelerometerView) -> list[str]:
    """Return the terms with a_P and a_O of which the description says something."""
    stated_terms = {*view.accelerometer.priors, *view.campaign.model.priors}
    return [symbol for symbol in CROSS_AXIS_SYMBOLS if symbol in stated_terms]


def find_better_mounting(mountings: Sequence[AlternativeMounting]) -> AlternativeMounting | None:
    """Return the mounting that fits best, if it is better than the stated one by more than chance.

    All or nothing: if the stated one is right, another one is better by c in chi-square with the
    probability that a normal number, or Student's where the noise was estimated, exceeds sqrt(c),
    at most.
    """
    best_mounting = max(mountings, key=lambda mounting: mounting.gain, default=None)
    if best_mounting is None or best_mounting.gain <= 0.0:
        return None
    tail_p = 0.5 * SIGNIFICANCE / len(mountings)
    z = normal_equivalent(math.sqrt(best_mounting.gain), best_mounting.dof)
    return best_mounting if z > normal_quantile(1.0 - tail_p) else None


def mounting_finding(mounting: AlternativeMounting) -> Finding:
    """Return the finding that an accelerometer is mounted another way than is stated."""
    name, (stated, fitted) = mounting.view.name, mounting.pendulous_directions
    symbol, shift, z = mounting.largest_shift()
    data, sense = "records", ""
    if any(group.motion != "poses" for group in mounting.view.groups):
        data, sense = "readings", ", the sense of rotation of the attitudes"
    text = (
        f"The {data} of {name} would fit if the pendulous axis pointed {fitted} instead of the "
        f"stated {stated}. Check pendulous_axis{sense}, and the axes of the stated "
        f"{_join_symbols(_stated_cross_terms(mounting.view))}."
    )
    if symbol:
        ratio = format_number(z, 2)
        text += (
            f" {symbol} would change by {format_size(symbol, shift)}, {ratio} times the u of "
            f"{symbol}."
        )
    return Finding(
        code="wrong-mounting",
        subject=name,
        text=text,
        size=math.sqrt(mounting.gain),
        contradicts=z > 1.0,
    )


def undetermined_axis_remarks(mountings: Sequence[AlternativeMounting]) -> Iterator[str]:
    """Yield for each accelerometer what rests on axes that its records do not show."""
    for name in dict.fromkeys(mounting.view.name for mounting in mountings):
        candidates = [mounting for mounting in mountings if mounting.view.name == name]
        if find_better_mounting(candidates) is not None:
            continue
        possible = [mounting for mounting in candidates if mounting.gain > -(_NOT_EXCLUDED**2)]
        # A quarter turn either way may do the same but for rounding: the first is named.
        worst_mounting = max(
            possible, key=lambda mounting: round(mounting.largest_shift()[2], 6), default=None
        )
        if worst_mounting is None or worst_mounting.largest_shift()[2] < _WORTH_A_REMARK:
            continue
        symbol, shift, z = worst_mounting.largest_shift()
        stated, fitted = worst_mounting.pendulous_directions
        direction = "larger" if shift > 0.0 else "smaller"
        symbols = _stated_cross_terms(worst_mounting.view)
        values, verb = ("values", "depend") if symbols[1:] else ("value", "depends")
        yield (
            f"{name}: the records do not determine the direction of the pendulous axis, and the "
            f"stated {values} of {_join_symbols(symbols)} {verb} on this direction. With "
            f"{fitted} instead of {stated}, the records would fit equally well, but {symbol} "
            f"would be {format_size(symbol, abs(shift))} {direction}, a change of "
            f"{format_number(z, 2)} times the u of {symbol}."
        )


def _join_symbols(symbols: Sequence[str]) -> str:
    return " and ".join([", ".join(symbols[:-1]), symbols[-1]] if symbols[1:] else symbols)


def _describe_direction(axis: np.ndarray) -> str:
    """Return a direction as a description has it: a name, or three numbers."""
    for index, names in enumerate(_DIRECTIONS):
        if abs(axis[index]) > 1.0 - 1e-9:
            return names[int(axis[index] > 0.0)]
    return f"[{', '.join(format_number(float(component), 4) for component in axis)}]"


# What the data cannot check


@frozen
class _UntestedInput:
    """One thing that may be otherwise."""

    description: str  #: What would be off.
    symbol: str  #: The term or input that it is of.
    typical: float  #: By how much it may be off.
    indices: tuple[int, ...]  #: Of the unknowns whose priors are off; of a clock, of its unknown.
    #: What one unit of it is in the rows of the blocks, shape (n,), and of the priors, shape (p,).
    data: Array
    priors: Array


def untested_input_remarks(views: Sequence[AccelerometerView]) -> Iterator[str]:
    """Yield for each accelerometer what it rests on that its data cannot check."""
    fit = estimate_considered(views[0].fit)
    inputs = [*_stated_priors(views[0].campaign, fit), *_run_clocks(fit)]
    if not inputs:
        return
    data, priors = (
        np.column_stack(rows)
        for rows in zip(*((item.data, item.priors) for item in inputs), strict=True)
    )
    residual_norms = np.linalg.norm(fit.solution.project_out(data, priors), axis=0)
    typical_sizes = np.array([item.typical for item in inputs])
    size = np.minimum(
        typical_sizes,
        _DETECTABLE_SIGMAS / np.maximum(residual_norms, _DETECTABLE_SIGMAS / typical_sizes),
    )
    shifts = size * fit.solution.undetected_shifts(data, priors)
    for view in views:
        remarks = []
        for index, item in enumerate(inputs):
            symbol, shift, ratio = largest_shift(view, item.indices, shifts[:, index])
            if ratio >= _WORTH_OF_UNTESTED:
                clause = (
                    f"{item.description} has an error of "
                    f"{format_size(item.symbol, float(size[index]))}"
                )
                amount = (
                    f"{format_size(symbol, abs(shift))}, or {format_number(ratio, 2)} u({symbol})"
                )
                remarks.append((ratio, f"if {clause}, the error of {symbol} is {amount}"))
        remarks.sort(reverse=True)
        if remarks:
            yield (
                f"The result for {view.name} depends on values that the data cannot verify: "
                f"{'; '.join(sentence for _, sentence in remarks[:_MAX_NAMED])}. The residuals "
                "would not reveal an error in these values."
            )


def _stated_priors(campaign: Campaign, fit: JointFit) -> Iterator[_UntestedInput]:
    """Yield each stated value that has an uncertainty; those that all runs have alike, together."""
    sd = fit.solution.prior_sd
    rows = sum(block.factor.shape[0] for block in fit.blocks)
    for alternative in prior_alternatives(fit):
        indices = tuple(index for index in alternative.prior_shifts if sd[index] > 0.0)
        priors = np.zeros(sd.size)
        priors[list(indices)] = [-alternative.prior_shifts[index] for index in indices]
        symbol = fit.model.unknowns[next(iter(alternative.prior_shifts))].symbol
        typical_size = campaign.typical_of(symbol, alternative.owner)
        yield _UntestedInput(
            f"the stated value of {alternative.name}",
            symbol,
            typical_size,
            indices,
            np.zeros(rows),
            fit.solution.whiten_priors(priors[:, None])[:, 0],
        )


def _run_clocks(fit: JointFit) -> Iterator[_UntestedInput]:
    """Yield the clock of each run that shares its recorder with other runs."""
    for index, unknown in enumerate(fit.model.unknowns):
        if unknown.symbol != CLOCK:
            continue
        flags = [index in observation.unknowns for observation in fit.observations]
        runs = dict.fromkeys(
            observation.run
            for observation, is_shown in zip(fit.observations, flags, strict=True)
            if is_shown
        )
        for run in runs if len(runs) > 1 else ():
            data = np.concatenate(
                [
                    block.factor[:, index] * float(observation.run == run)
                    for observation, block in zip(fit.observations, fit.blocks, strict=True)
                ]
            )
            description, no_priors = (
                f"the clock during {run} only",
                np.zeros(len(fit.model.unknowns)),
            )
            yield _UntestedInput(description, CLOCK, unknown.prior[1], (index,), data, no_priors)
