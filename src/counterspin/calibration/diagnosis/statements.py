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
from counterspin.calibration.checks.shifts import most_moved, shown_size
from counterspin.calibration.result_parts import Finding
from counterspin.calibration.view import AccelerometerView, FittedGroup
from counterspin.campaign.description import Campaign
from counterspin.frozen import frozen
from counterspin.inference.diagnostics import SIGNIFICANCE, normal_equivalent
from counterspin.inference.distributions import normal_quantile
from counterspin.inference.joint.alternatives import of_priors
from counterspin.inference.joint.estimation import Estimate
from counterspin.inference.joint.fit import JointFit, relax
from counterspin.inference.joint.mistakes import ACROSS, turned, with_turned
from counterspin.inference.joint.series import CLOCK
from counterspin.reports.numbers import format_number

#: Standard deviations by which a mounting may fit worse and still not be excluded.
_NOT_EXCLUDED: Final = 3.0

#: A coefficient that moves by so many of its u, or whose u grows by as much, is worth a remark.
_WORTH_A_REMARK: Final = 1.0

_DIRECTIONS: Final = (("west", "east"), ("south", "north"), ("down", "up"))

#: An error is noticed from so many standard deviations on.
_NOTICED: Final = 4.0

#: A coefficient that moves by so many of its u is worth a remark.
_WORTH_OF_UNTESTED: Final = 2.0

#: How many such things are named.
_MOST: Final = 3


@frozen
class OtherMounting:
    """A fit with an accelerometer turned about its input axis."""

    view: AccelerometerView  #: As it is stated.
    quarters: int  #: Turns from the stated pendulous axis towards the output axis.
    fit: JointFit  #: Of the turned one, relaxed.
    #: By how much its chi-square is less than that of the stated one, over the residuals' scale.
    gain: float
    dof: float | None  #: Degrees of freedom of that scale; None where the noise was stated.
    readings: tuple[FittedGroup, ...] = ()  #: All readings, and how they fit then.

    @property
    def pendulous(self) -> tuple[str, str]:
        """Where the pendulous axis is stated to point, and where it would."""
        stated = self.view.accelerometer.mounting
        return _direction(stated.matrix[1]), _direction(turned(stated, self.quarters).matrix[1])

    def seen_by(self, view: AccelerometerView) -> AccelerometerView:
        """Return a view of an accelerometer whose readings are as they fit then."""
        return view.with_parts(self.readings)

    def moved(self) -> tuple[str, float, float]:
        """Return which coefficient moves most, by how much, and over its u."""
        found = [
            (symbol, shift, abs(shift) / u)
            for symbol, place in self.view.places.items()
            if self.view.assessment.determined[f"{self.view.name}.{symbol}"]
            and symbol not in ACROSS
            and (u := float(self.view.fit.solution.u[place])) > 0.0
            for shift in [
                float(self.fit.solution.estimate[place] - self.view.fit.solution.estimate[place])
            ]
        ]
        return max(found, key=lambda one: one[2], default=("", 0.0, 0.0))


def other_mountings(views: Sequence[AccelerometerView]) -> tuple[OtherMounting, ...]:
    """Return the other mountings of those accelerometers whose stated terms rest on them."""
    found = []
    estimated = views[0].estimate
    relaxed = replace(estimated, fit=relax(estimated.fit), core=None)
    read = tuple({id(part): part for view in views for part in view.parts}.values())
    for view in views:
        if not _stated(view):
            continue
        given = not view.has_records or view.diagnostics.noise_given
        given = given and all(math.isinf(part.dof) for part in view.parts)
        (stated, _), *others = (_turned(view, relaxed, read, n) for n in range(4))
        for quarters, (fit, readings) in enumerate(others, 1):
            scale = fit.solution.chi2 / max(fit.solution.dof, 1.0)
            scale = max(scale, 1.0) if given else scale
            gain = (stated.solution.chi2 - fit.solution.chi2) / scale
            dof = None if given else max(fit.solution.dof, 1.0)
            found.append(OtherMounting(view, quarters, fit, gain, dof, readings))
    return tuple(found)


def _turned(
    view: AccelerometerView, relaxed: Estimate, read: Sequence[FittedGroup], quarters: int
) -> tuple[JointFit, tuple[FittedGroup, ...]]:
    """Return a relaxed fit with an accelerometer turned, its readings with the noise they have."""
    fit = with_turned(relaxed.fit, view.name, quarters) if quarters else relaxed.fit
    # The degrees of freedom are not asked for.
    dof = np.full(len(fit.model.unknowns), np.inf)
    estimated = replace(relaxed, fit=fit, dof=dof)
    return view.data.fit_turned(estimated, read, view.name, partial(turned, quarters=quarters))


def _stated(view: AccelerometerView) -> list[str]:
    """Return the terms with a_P and a_O of which the description says something."""
    stated = {*view.accelerometer.priors, *view.campaign.model.priors}
    return [symbol for symbol in ACROSS if symbol in stated]


def better(others: Sequence[OtherMounting]) -> OtherMounting | None:
    """Return the mounting that fits best, if it is better than the stated one by more than chance.

    All or nothing: if the stated one is right, another one is better by c in chi-square with the
    probability that a normal number, or Student's where the noise was estimated, exceeds sqrt(c),
    at most.
    """
    best = max(others, key=lambda other: other.gain, default=None)
    if best is None or best.gain <= 0.0:
        return None
    chance = 0.5 * SIGNIFICANCE / len(others)
    size = normal_equivalent(math.sqrt(best.gain), best.dof)
    return best if size > normal_quantile(1.0 - chance) else None


def wrong_mounting(other: OtherMounting) -> Finding:
    """Return the finding that an accelerometer is mounted another way than is stated."""
    name, (stated, found) = other.view.name, other.pendulous
    symbol, shift, size = other.moved()
    what, turns = "records", ""
    if any(part.motion != "poses" for part in other.view.parts):
        what, turns = "readings", ", the sense in which the attitudes turn"
    text = (
        f"The {what} of {name} would fit if its pendulous axis pointed {found} instead of "
        f"{stated}, as stated. Check pendulous_axis{turns}, and for which axes "
        f"{_listed(_stated(other.view))} "
        "was measured."
    )
    if symbol:
        times = format_number(size, 2)
        text += f" {symbol} would move by {shown_size(symbol, shift)}, {times} times its u."
    return Finding(
        code="wrong-mounting",
        subject=name,
        text=text,
        size=math.sqrt(other.gain),
        contradicts=size > 1.0,
    )


def unseen_axes(others: Sequence[OtherMounting]) -> Iterator[str]:
    """Yield for each accelerometer what rests on axes that its records do not show."""
    for name in dict.fromkeys(other.view.name for other in others):
        own = [other for other in others if other.view.name == name]
        if better(own) is not None:
            continue
        open_ = [other for other in own if other.gain > -(_NOT_EXCLUDED**2)]
        # A quarter turn either way may do the same but for rounding: the first is named.
        worst = max(open_, key=lambda other: round(other.moved()[2], 6), default=None)
        if worst is None or worst.moved()[2] < _WORTH_A_REMARK:
            continue
        symbol, shift, size = worst.moved()
        stated, found = worst.pendulous
        way = "larger" if shift > 0.0 else "smaller"
        resting = _stated(worst.view)
        values, rest = ("values", "rest") if resting[1:] else ("value", "rests")
        yield (
            f"{name}: the records do not show where the pendulous axis points, and the "
            f"stated {values} of {_listed(resting)} {rest} on it. With {found} for "
            f"{stated} they "
            f"would fit as well, and {symbol} would be {shown_size(symbol, abs(shift))} {way}, "
            f"{format_number(size, 2)} times its u."
        )


def _listed(symbols: Sequence[str]) -> str:
    return " and ".join([", ".join(symbols[:-1]), symbols[-1]] if symbols[1:] else symbols)


def _direction(axis: np.ndarray) -> str:
    """Return a direction as a description has it: a name, or three numbers."""
    for place, names in enumerate(_DIRECTIONS):
        if abs(axis[place]) > 1.0 - 1e-9:
            return names[int(axis[place] > 0.0)]
    return f"[{', '.join(format_number(float(x), 4) for x in axis)}]"


# What the data cannot check


@frozen
class _Thing:
    """One thing that may be otherwise."""

    words: str  #: What would be off.
    symbol: str  #: The term or input that it is of.
    typical: float  #: By how much it may be off.
    places: tuple[int, ...]  #: Of the unknowns whose priors are off; of a clock, of its unknown.
    #: What one unit of it is in the rows of the blocks, shape (n,), and of the priors, shape (p,).
    data: Array
    priors: Array


def untested_statements(views: Sequence[AccelerometerView]) -> Iterator[str]:
    """Yield for each accelerometer what it rests on that its data cannot check."""
    fit = relax(views[0].fit)
    things = [*_statements(views[0].campaign, fit), *_clocks(fit)]
    if not things:
        return
    data, priors = (
        np.column_stack(rows)
        for rows in zip(*((one.data, one.priors) for one in things), strict=True)
    )
    left = np.linalg.norm(fit.solution.unexplained(data, priors), axis=0)
    typical = np.array([one.typical for one in things])
    size = np.minimum(typical, _NOTICED / np.maximum(left, _NOTICED / typical))
    moved = size * fit.solution.taken_up(data, priors)
    for view in views:
        found = []
        for place, thing in enumerate(things):
            symbol, shift, times = most_moved(view, thing.places, moved[:, place])
            if times >= _WORTH_OF_UNTESTED:
                off = f"{thing.words} is off by {shown_size(thing.symbol, float(size[place]))}"
                much = f"{shown_size(symbol, abs(shift))} ({format_number(times, 2)} times its u)"
                found.append((times, f"if {off}, {symbol} is wrong by {much}"))
        found.sort(reverse=True)
        if found:
            yield (
                f"{view.name} depends on values that its data cannot check: "
                f"{'; '.join(said for _, said in found[:_MOST])}. No residual would show this."
            )


def _statements(campaign: Campaign, fit: JointFit) -> Iterator[_Thing]:
    """Yield each stated value that has an uncertainty; those that all runs have alike, together."""
    sd = fit.solution.prior_sd
    rows = sum(block.factor.shape[0] for block in fit.blocks)
    for other in of_priors(fit):
        places = tuple(place for place in other.priors if sd[place] > 0.0)
        priors = np.zeros(sd.size)
        priors[list(places)] = [-other.priors[place] / sd[place] for place in places]
        symbol = fit.model.unknowns[next(iter(other.priors))].symbol
        typical = campaign.typical_of(symbol, other.owner)
        yield _Thing(
            f"the stated value of {other.name}", symbol, typical, places, np.zeros(rows), priors
        )


def _clocks(fit: JointFit) -> Iterator[_Thing]:
    """Yield the clock of each run that shares its recorder with other runs."""
    for place, unknown in enumerate(fit.model.unknowns):
        if unknown.symbol != CLOCK:
            continue
        shown = [place in one.unknowns for one in fit.observations]
        runs = dict.fromkeys(
            one.run for one, here in zip(fit.observations, shown, strict=True) if here
        )
        for run in runs if len(runs) > 1 else ():
            data = np.concatenate(
                [
                    block.factor[:, place] * float(one.run == run)
                    for one, block in zip(fit.observations, fit.blocks, strict=True)
                ]
            )
            words, none = f"the clock in {run} alone", np.zeros(len(fit.model.unknowns))
            yield _Thing(words, CLOCK, unknown.prior[1], (place,), data, none)
