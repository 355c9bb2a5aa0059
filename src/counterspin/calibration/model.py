"""From [model] to unknowns: what is asked for, what is held, and everything else that acts.

Whatever acts on records and readings is an unknown of the one fit, with the prior that the
description states, else with the typical size of the table of terms; only what is assumed to be
perfect is left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Final

import numpy as np

from counterspin.campaign.conditions import (
    clock_of,
    conditions_of,
    dated_of,
    directions_of,
    has_assumed_warming,
    origin_of,
    temperatures_of,
)
from counterspin.campaign.description import Campaign
from counterspin.campaign.model import EVERYTHING
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.terms import acts, shows, symbols_shown
from counterspin.inference.joint.series import CLOCK, RATE_CLOCK, TIMING
from counterspin.inference.joint.unknowns import ROTATION, Considered, Unknown, Unknowns
from counterspin.inference.least_squares import NO_PRIOR
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.effects import AttitudeError, Slope, SpecificForceProduct
from counterspin.physics.terms import (
    ACCELEROMETER_TERMS,
    LINEAR,
    SHARED_TERMS,
    Term,
    accelerometer_of,
    same_for_all,
    term,
)

#: Largest credible errors of a rotation that nobody recorded: rad, rad/s, 1/s.
_ROTATION_LIMITS: Final = (math.pi, 1.0, 1e-2)

#: Products of components of unit vectors that are smaller are zero.
_ROUNDING: Final = 1e-9

#: At 1 g their sum with K_II is that of the squares of the specific forces, a constant.
SQUARES: Final = ("K_PP", "K_OO")


def model_of(campaign: Campaign) -> Unknowns:
    """Return the requested, the considered and all other acting terms of a campaign."""
    asked: list[Unknown] = []
    others: list[Unknown] = []
    held: list[Considered] = []
    wanted, kept = campaign.model.terms, campaign.model.considered
    for owner, symbol in _acting(campaign):
        known = _stated(campaign, owner, symbol)
        prior, unstated = prior_of(campaign, owner, symbol, known)
        limit = campaign.limit_of(symbol, owner)
        if symbol in wanted:
            default = math.inf if known else campaign.typical_of(symbol, owner)
            prior, unstated = (prior, unstated) if known else (NO_PRIOR, False)
            asked.append(Unknown(owner, symbol, prior, limit, unstated=unstated, default=default))
        elif symbol in kept:
            held.append(Considered(owner, symbol, prior, limit, asked=False, unstated=unstated))
        elif known or prior[1] > 0.0:
            others.append(Unknown(owner, symbol, prior, limit, asked=False, unstated=unstated))
    if campaign.angle is None:
        asked += [
            Unknown(run.name, symbol, NO_PRIOR, limit)
            for run in campaign.runs
            for symbol, limit in zip(ROTATION, _ROTATION_LIMITS, strict=True)
        ]
    for (owner, symbol), known in inputs_by_owner(campaign).items():
        # Of an input the unknown is its deviation from what is stated.
        (_, u), unstated = prior_of(campaign, "", symbol, known)
        if u > 0.0:
            limit = campaign.limit_of(symbol)
            if symbol in kept:
                held.append(Considered(owner, symbol, (0.0, u), limit, False, unstated))
            else:
                others.append(Unknown(owner, symbol, (0.0, u), limit, False, unstated))
    return Unknowns((*asked, *_squares(campaign, others), *others), tuple(held))


def is_requested(campaign: Campaign, symbol: str, name: str = "") -> bool:
    """Return whether a result is not determined without a term.

    Such terms are those that [model] names, K_II of a test on a centrifuge, and the terms that give
    the corrected output of a triad in poses. Other usual terms may be missing.

    name: Of the accelerometer; empty: a term of the machine.
    """
    if campaign.model.named and symbol in campaign.model.terms:
        return True
    if symbol == "K_II":
        return bool(campaign.runs) or any(reading.rate for reading in campaign.readings)
    triad = campaign.triad
    posed = triad is not None and triad.posed and name in triad.accelerometers
    return posed and symbol in ("K_F", *LINEAR)


def assumed_of(campaign: Campaign, model: Unknowns, name: str) -> tuple[Considered, ...]:
    """Return the terms that could reach an accelerometer and that are assumed to be perfect.

    Each is taken as a held term without uncertainty; a tilt is one term for each run.

    model: Of the campaign, as `model_of` returns it.
    """
    there = {
        (other.owner, other.symbol): other.prior[1]
        for other in (*model.unknowns, *model.considered)
    }
    return tuple(
        Considered(owner, symbol, (term(symbol).nominal, 0.0), campaign.limit_of(symbol, owner))
        for owner, symbol in _acting(campaign, name)
        if there.get((owner, symbol), 0.0) == 0.0
    )


def assumed(campaign: Campaign, model: Unknowns) -> tuple[str, ...]:
    """Return the symbols of all terms and inputs that act and are assumed to be perfect."""
    if not campaign.model.assume:
        return ()
    terms = (
        other.symbol
        for name in campaign.accelerometers
        for other in assumed_of(campaign, model, name)
    )
    inputs = (symbol for symbol in assumed_inputs(campaign))
    return tuple(dict.fromkeys([*terms, *inputs]))


def assumed_inputs(campaign: Campaign) -> list[str]:
    """Return the inputs that are taken as exact."""
    exact = (
        symbol
        for (_, symbol), known in inputs_by_owner(campaign).items()
        if known.u == 0.0 and campaign.model.assumes(symbol)
    )
    return list(dict.fromkeys(exact))


def prior_of(
    campaign: Campaign, owner: str, symbol: str, known: Quantity | None
) -> tuple[tuple[float, float], bool]:
    """Return value and standard uncertainty, and whether the uncertainty is a typical size."""
    if known is not None and known.u > 0.0:
        return (known.value, known.u), False
    value = term(symbol).nominal if known is None else known.value
    if campaign.model.assumes(symbol):
        return (value, 0.0), False
    return (value, campaign.typical_of(symbol, owner)), True


def _stated(campaign: Campaign, owner: str, symbol: str) -> Quantity | None:
    """Return the stated prior of a term of an owner."""
    if owner in campaign.accelerometers and symbol in campaign.accelerometers[owner].priors:
        return campaign.accelerometers[owner].priors[symbol]
    return campaign.model.priors.get(symbol)


def inputs_of(campaign: Campaign) -> dict[str, Quantity]:
    """Return by name the inputs that act, as they are stated; without u where none is."""
    return {
        f"{owner}.{symbol}" if owner else symbol: known
        for (owner, symbol), known in inputs_by_owner(campaign).items()
    }


def inputs_by_owner(campaign: Campaign) -> dict[tuple[str, str], Quantity]:
    """Return the same by owner, the recorder of a clock, and symbol."""
    inputs = {("", "site.gravity"): campaign.gravity, ("", "site.latitude"): campaign.latitude}
    turning = [reading for reading in campaign.readings if reading.rate]
    if campaign.runs or turning:
        inputs["", "centrifuge.radius"] = campaign.radius
    for owner, symbol in dict.fromkeys(clock_of(campaign, reading) for reading in turning):
        stated = campaign.rate_clock if symbol == RATE_CLOCK else campaign.clock
        inputs[owner, symbol] = stated or Quantity(0.0, 0.0, "1")
    for one in map(campaign.recording_of, campaign.runs):
        inputs[one.recorder, CLOCK] = one.clock or Quantity(0.0, 0.0, "1")
    if campaign.runs and campaign.angle is not None:
        inputs["", TIMING] = campaign.timing_offset or Quantity(0.0, 0.0, "s")
    return inputs


def _acting(campaign: Campaign, only: str = "") -> list[tuple[str, str]]:
    """Return owner and symbol of all terms that act, of one accelerometer or of all of them."""
    names = [only] if only else list(campaign.accelerometers)
    of_frame = campaign.triad.of_frame if campaign.triad else ()
    known = {*campaign.model.terms, *campaign.model.considered, *campaign.model.priors}
    own = [
        (name, symbol)
        for name in names
        for symbol, row in ACCELEROMETER_TERMS.items()
        if symbol in campaign.model.terms or _acts(campaign, row)
        if (name, symbol) not in of_frame
    ]
    readings = tuple(r for r in campaign.readings if r.accelerometer in names)
    read = [("", s) for s in symbols_shown(readings) if s not in ACCELEROMETER_TERMS]
    # A radius for all accelerometers of a mounting stands in place of theirs where it is named.
    read = [
        (o, s)
        for o, s in read
        if s in known
        or not s.startswith("centrifuge.radius.")
        or (accelerometer_of(s) and same_for_all(s) not in known)
    ]
    return list(dict.fromkeys([*own, *_of_platform(campaign, names), *read]))


def _acts(campaign: Campaign, row: Term[SpecificForceProduct | Slope]) -> bool:
    """Return whether what a coefficient changes with has changed."""
    if isinstance(row.effect, SpecificForceProduct):
        arm = (reading.axes for reading in campaign.readings if reading.motion == "arm")
        return not row.effect.of_rotation or any(_rotates(row.effect, axes) for axes in arm)
    if row.effect.condition == "force":
        return bool(campaign.runs) or any(reading.rate for reading in campaign.readings)
    origin = origin_of(campaign)
    if row.effect.condition == "time":
        recorded = bool(campaign.runs) or bool(campaign.triad and campaign.triad.records)
        return recorded or any(one.time not in (None, origin.time) for one in dated_of(campaign))
    if row.effect.condition == "direction":
        return bool(directions_of(campaign))
    warm = set(temperatures_of(campaign))
    if any(run.temperature for run in campaign.runs):
        warm |= {
            origin.temperature + run.temperature_offset for run in conditions_of(campaign).values()
        }
    # An assumed change of temperature is small: only the first power acts.
    assumed = row.effect.power == 1 and has_assumed_warming(campaign)
    return assumed or any(temperature != origin.temperature for temperature in warm)


def _rotates(product: SpecificForceProduct, axes: Mounting) -> bool:
    """Return whether a constant rotation of an arm gives a product of the rotation a mean."""
    up = axes.matrix[:, 2]
    mean = product.evaluate(np.zeros(3), np.array([up[0], up[1], 0.0]))
    return abs(float(mean)) > _ROUNDING


def _of_platform(campaign: Campaign, names: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield owner and symbol of the terms that records of these accelerometers show."""
    accelerometers = [campaign.accelerometers[name] for name in names]
    attitudes = dict.fromkeys(run.attitude.tobytes() for run in campaign.runs)
    wanted = {*campaign.model.terms, *campaign.model.considered}
    for symbol, row in SHARED_TERMS.items():
        if campaign.angle is None and symbol.startswith("encoder."):
            continue
        if isinstance(row.effect, AttitudeError) and not _turns(campaign, row.effect):
            continue
        acting = {
            key
            for key in attitudes
            if any(_reaches(symbol, one.observable, one.mounting, key) for one in accelerometers)
        }
        reached = [
            run for run in campaign.runs if symbol in wanted or run.attitude.tobytes() in acting
        ]
        for run in reached if row.per_run else reached[:1]:
            yield (run.name if row.per_run else ""), symbol


def _turns(campaign: Campaign, turn: AttitudeError) -> bool:
    """Return whether a turn acts on records; a strapped instrument has a table but no gyros."""
    if turn.kind == "table":
        return campaign.strapped
    return not campaign.strapped or turn.kind in ("tilt", "compliance")


@lru_cache(maxsize=1024)
def _reaches(symbol: str, observable: str, mounting: Mounting, attitude: bytes) -> bool:
    """Return whether a shared term shows in a record; a calibration asks so several times.

    attitude: The bytes of its rows.
    """
    reaches = acts if observable == "displacement" else shows
    return reaches(SHARED_TERMS[symbol], mounting, np.frombuffer(attitude).reshape(3, 3))


def _squares(campaign: Campaign, others: Sequence[Unknown]) -> Iterator[Unknown]:
    """Yield the squares that 1 g cannot tell from K_II, where all is assumed to be perfect.

    They count as if they were asked for: K_II is no more than K_II - K_PP or K_II - K_OO.
    """
    motions = {reading.motion for reading in campaign.readings}
    motions |= {"static"} if campaign.posed else set()
    if motions != {"static"} or campaign.runs or "K_II" not in campaign.model.terms:
        return
    if EVERYTHING not in campaign.model.assume:
        return
    known = {*campaign.model.terms, *campaign.model.considered}
    there = {(other.owner, other.symbol) for other in others}
    for name in campaign.accelerometers:
        for symbol in SQUARES:
            if symbol not in known and (name, symbol) not in there:
                limit = campaign.limit_of(symbol, name)
                yield Unknown(name, symbol, (0.0, limit), limit, unstated=True)
