"""What a coefficient rests on that the data cannot check: statements, and one clock of all runs.

A stated value that is far off what the data say is found. One of which the data say nothing is
taken as it is, and so is a recorder's clock, which runs in each run as in the others. Where such a
thing, off by no more than its typical size, would move a coefficient by several of its u and leave
no trace, a remark says so: nothing but the description vouches for it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.joint_view import AccelerometerView
from counterspin.campaign.description import Campaign
from counterspin.frozen import frozen
from counterspin.inference.joint.alternatives import of_priors
from counterspin.inference.joint.fit import JointFit, relax
from counterspin.inference.joint.series import CLOCK
from counterspin.inference.joint.unknowns import unit_of
from counterspin.reports.numbers import field_unit, format_number

#: An error is noticed from so many standard deviations on.
_NOTICED: Final = 4.0

#: A coefficient that moves by so many of its u is worth a remark.
_WORTH_A_REMARK: Final = 2.0

#: How many such things are named.
_MOST: Final = 3


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


def untested(views: Sequence[AccelerometerView]) -> Iterator[str]:
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
            symbol, shift, times = _most_moved(view, thing, moved[:, place])
            if times >= _WORTH_A_REMARK:
                off = f"{thing.words} is off by {_shown(thing.symbol, float(size[place]))}"
                much = f"{_shown(symbol, abs(shift))}, {format_number(times, 2)} of its u"
                found.append((times, f"if {off}, {symbol} is wrong by {much}"))
        found.sort(reverse=True)
        if found:
            yield (
                f"{view.name} rests on what its data cannot check: "
                f"{'; '.join(said for _, said in found[:_MOST])}. No residual would show it."
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
            f"what is stated of {other.name}", symbol, typical, places, np.zeros(rows), priors
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


def _most_moved(view: AccelerometerView, thing: _Thing, moved: Array) -> tuple[str, float, float]:
    """Return which coefficient moves most over its u, by how much, and by how many of its u."""
    found = [
        (symbol, float(moved[place]), abs(float(moved[place])) / u)
        for symbol, place in view.places.items()
        if view.assessment.determined[f"{view.name}.{symbol}"]
        and place not in thing.places
        and (u := float(view.fit.solution.u[place])) > 0.0
    ]
    return max(found, key=lambda one: one[2], default=("", 0.0, 0.0))


def _shown(symbol: str, size: float) -> str:
    unit, factor = field_unit(unit_of(symbol))
    if unit == "1":
        unit, factor = "ppm", 1e6
    return f"{format_number(size * factor, 2)} {unit}"
