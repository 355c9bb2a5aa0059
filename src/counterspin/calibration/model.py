"""From [model] to unknowns: what is asked for, what is held, and everything else that acts.

Whatever acts on records and readings is an unknown of the one fit, with the prior that the
description states, else with the typical size of the table of terms; only what is assumed to be
perfect is left out.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Final

import numpy as np

from counterspin.campaign.conditions import (
    ASSUMED_TEMPERATURE,
    changing_conditions,
    rate_clock_input,
)
from counterspin.campaign.description import Campaign
from counterspin.campaign.model import ALL_TERMS
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.terms import symbols_shown
from counterspin.inference.joint.series import CLOCK, RATE_CLOCK, TIMING
from counterspin.inference.joint.unknowns import ROTATION, Considered, Unknown, Unknowns
from counterspin.inference.least_squares import NO_PRIOR
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.effects import Slope, SpecificForceProduct
from counterspin.physics.frequency_response import CUTOFF
from counterspin.physics.terms import (
    ACCELEROMETER_TERMS,
    LEVER_ARM,
    LINEAR,
    SHARED_TERMS,
    Term,
    accelerometer_name,
    same_for_all,
    term,
)

#: Largest credible errors of a rotation that nobody recorded: rad, rad/s, 1/s.
_ROTATION_LIMITS: Final = (math.pi, 1.0, 1e-2)

#: Products of components of unit vectors that are smaller are zero.
_ROUNDING: Final = 1e-9

#: At 1 g their sum with K_II is that of the squares of the specific forces, a constant.
SQUARES: Final = ("K_PP", "K_OO")


def make_unknowns(campaign: Campaign) -> Unknowns:
    """Return the requested, the considered and all other acting terms of a campaign."""
    requested: list[Unknown] = []
    nuisance: list[Unknown] = []
    considered: list[Considered] = []
    requested_symbols, considered_symbols = campaign.model.terms, campaign.model.considered
    for owner, symbol in _acting_terms(campaign):
        known = _stated_prior(campaign, owner, symbol)
        prior, unstated = resolve_prior(campaign, owner, symbol, known)
        limit = campaign.limit_of(symbol, owner)
        if symbol in requested_symbols:
            default = math.inf if known else campaign.typical_of(symbol, owner)
            prior, unstated = (prior, unstated) if known else (NO_PRIOR, False)
            requested.append(
                Unknown(owner, symbol, prior, limit, has_default_prior=unstated, default_sd=default)
            )
        elif symbol in considered_symbols:
            considered.append(
                Considered(
                    owner, symbol, prior, limit, is_of_interest=False, has_default_prior=unstated
                )
            )
        elif known or prior[1] > 0.0:
            nuisance.append(
                Unknown(
                    owner, symbol, prior, limit, is_of_interest=False, has_default_prior=unstated
                )
            )
    if campaign.angle is None:
        requested += [
            Unknown(run.name, symbol, NO_PRIOR, limit)
            for run in campaign.runs
            for symbol, limit in zip(ROTATION, _ROTATION_LIMITS, strict=True)
        ]
    for (owner, symbol), known in inputs_by_owner(campaign).items():
        # Of an input the unknown is its deviation from what is stated.
        (_, u), unstated = resolve_prior(campaign, "", symbol, known)
        if u > 0.0:
            limit = campaign.limit_of(symbol)
            if symbol in considered_symbols:
                considered.append(Considered(owner, symbol, (0.0, u), limit, False, unstated))
            else:
                nuisance.append(Unknown(owner, symbol, (0.0, u), limit, False, unstated))
    unknowns = (*requested, *_inseparable_squares(campaign, nuisance), *nuisance)
    correlations = campaign.model.correlations
    return Unknowns(
        tuple(
            replace(unknown, correlations=correlations[unknown.name])
            if unknown.name in correlations
            else unknown
            for unknown in unknowns
        ),
        tuple(considered),
    )


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
    is_posed = triad is not None and triad.posed and name in triad.accelerometers
    return is_posed and symbol in ("K_F", *LINEAR)


def fixed_terms(campaign: Campaign, model: Unknowns, name: str) -> tuple[Considered, ...]:
    """Return the terms that could reach an accelerometer and that are assumed to be perfect.

    Each is taken as a held term without uncertainty; a tilt is one term for each run.

    model: Of the campaign, as `make_unknowns` returns it.
    """
    prior_sds = {
        (parameter.owner, parameter.symbol): parameter.prior[1]
        for parameter in (*model.unknowns, *model.considered)
    }
    return tuple(
        Considered(owner, symbol, (term(symbol).nominal, 0.0), campaign.limit_of(symbol, owner))
        for owner, symbol in _acting_terms(campaign, name)
        if prior_sds.get((owner, symbol), 0.0) == 0.0
    )


def fixed_symbols(campaign: Campaign, model: Unknowns) -> tuple[str, ...]:
    """Return the symbols of all terms and inputs that act and are assumed to be perfect."""
    if not campaign.model.assume:
        return ()
    terms = (
        parameter.symbol
        for name in campaign.accelerometers
        for parameter in fixed_terms(campaign, model, name)
    )
    inputs = (symbol for symbol in exact_inputs(campaign))
    return tuple(dict.fromkeys([*terms, *inputs]))


def exact_inputs(campaign: Campaign) -> list[str]:
    """Return the inputs that are taken as exact."""
    exact = (
        symbol
        for (_, symbol), known in inputs_by_owner(campaign).items()
        if known.u == 0.0 and campaign.model.assumes(symbol)
    )
    return list(dict.fromkeys(exact))


def resolve_prior(
    campaign: Campaign, owner: str, symbol: str, known: Quantity | None
) -> tuple[tuple[float, float], bool]:
    """Return value and standard uncertainty, and whether the uncertainty is a typical size."""
    if known is not None and known.u > 0.0:
        return (known.value, known.u), False
    value = term(symbol).nominal if known is None else known.value
    if campaign.model.assumes(symbol):
        return (value, 0.0), False
    return (value, campaign.typical_of(symbol, owner)), True


def _stated_prior(campaign: Campaign, owner: str, symbol: str) -> Quantity | None:
    """Return the stated prior of a term of an owner."""
    if owner in campaign.accelerometers and symbol in campaign.accelerometers[owner].priors:
        return campaign.accelerometers[owner].priors[symbol]
    if symbol == "platform.tilt.up":
        run_priors = {run.name: run.table_angle_prior for run in campaign.runs}
        return run_priors.get(owner) or campaign.model.priors.get(symbol)
    return campaign.model.priors.get(symbol)


def stated_inputs(campaign: Campaign) -> dict[str, Quantity]:
    """Return by name the inputs that act, as they are stated; without u where none is."""
    return {
        f"{owner}.{symbol}" if owner else symbol: known
        for (owner, symbol), known in inputs_by_owner(campaign).items()
    }


def inputs_by_owner(campaign: Campaign) -> dict[tuple[str, str], Quantity]:
    """Return the same by owner, the recorder of a clock, and symbol."""
    inputs = {("", "site.gravity"): campaign.gravity, ("", "site.latitude"): campaign.latitude}
    rotating = [reading for reading in campaign.readings if reading.rate]
    if campaign.runs or rotating:
        inputs["", "centrifuge.radius"] = campaign.radius
    for owner, symbol in dict.fromkeys(rate_clock_input(campaign, reading) for reading in rotating):
        stated = campaign.rate_clock if symbol == RATE_CLOCK else campaign.clock
        inputs[owner, symbol] = stated or Quantity(0.0, 0.0, "1")
    for recording in map(campaign.recording_of, campaign.runs):
        inputs[recording.recorder, CLOCK] = recording.clock or Quantity(0.0, 0.0, "1")
    if campaign.runs and campaign.angle is not None:
        inputs["", TIMING] = campaign.timing_offset or Quantity(0.0, 0.0, "s")
    for name, accelerometer in campaign.accelerometers.items() if campaign.runs else ():
        for symbol, known in accelerometer.response_inputs.items():
            inputs["" if symbol == CUTOFF else name, symbol] = known
    return inputs


def _acting_terms(campaign: Campaign, accelerometer: str = "") -> list[tuple[str, str]]:
    """Return owner and symbol of all terms that act, of one accelerometer or of all of them."""
    names = [accelerometer] if accelerometer else list(campaign.accelerometers)
    frame_terms = campaign.triad.of_frame if campaign.triad else ()
    named = {*campaign.model.terms, *campaign.model.considered, *campaign.model.priors}
    changing = set(changing_conditions(campaign))
    accelerometer_terms = [
        (name, symbol)
        for name in names
        for symbol, row in ACCELEROMETER_TERMS.items()
        if symbol in campaign.model.terms or _is_active(campaign, row, changing)
        if (name, symbol) not in frame_terms
    ]
    readings = tuple(reading for reading in campaign.readings if reading.accelerometer in names)
    reading_terms = [("", s) for s in symbols_shown(readings) if s not in ACCELEROMETER_TERMS]
    # A radius for all accelerometers of a mounting stands in place of theirs where it is named.
    reading_terms = [
        (o, s)
        for o, s in reading_terms
        if s in named
        or not s.startswith("centrifuge.radius.")
        or (accelerometer_name(s) and same_for_all(s) not in named)
    ]
    return list(
        dict.fromkeys([*accelerometer_terms, *_platform_terms(campaign, names), *reading_terms])
    )


def _is_active(
    campaign: Campaign, row: Term[SpecificForceProduct | Slope], changing: Collection[str]
) -> bool:
    """Return whether a coefficient acts; changing: as in `changing_conditions`."""
    if isinstance(row.effect, SpecificForceProduct):
        arm_axes = (reading.axes for reading in campaign.readings if reading.motion == "arm")
        table_axes = (
            accelerometer.mounting.turned(run.attitude)
            for run in campaign.runs
            if run.turns_in_space
            for accelerometer in campaign.accelerometers.values()
        )
        return not row.effect.requires_rotation or any(
            _has_mean_product(row.effect, axes) for axes in (*arm_axes, *table_axes)
        )
    # An assumed change of temperature is small: only the first power acts.
    is_assumed = row.effect.condition == "temperature" and row.effect.power == 1
    return row.effect.condition in changing or (is_assumed and ASSUMED_TEMPERATURE in changing)


def _has_mean_product(product: SpecificForceProduct, axes: Mounting) -> bool:
    """Return whether a constant rotation of an arm gives a product of the rotation a mean."""
    up = axes.matrix[:, 2]
    mean = product.evaluate(np.zeros(3), np.array([up[0], up[1], 0.0]))
    return abs(float(mean)) > _ROUNDING


def _platform_terms(campaign: Campaign, names: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield owner and symbol of the terms that records of these accelerometers show."""
    accelerometers = [campaign.accelerometers[name] for name in names]
    attitudes = dict.fromkeys(key for run in campaign.runs for key in run.attitude_keys)
    has_lever_arm = any(run.turns_in_space for run in campaign.runs)
    named = {*campaign.model.terms, *campaign.model.considered}
    for symbol, row in SHARED_TERMS.items():
        if campaign.angle is None and symbol.startswith("encoder."):
            continue
        # Strapped instruments turn with the table, and have no gyros.
        if row.effect.part == ("gyros" if campaign.strapped else "table"):
            continue
        if symbol == LEVER_ARM:
            yield from ((name, symbol) for name in names if has_lever_arm)
            continue
        acting = {
            key
            for key in attitudes
            if any(
                _is_observable(symbol, accelerometer.observable, accelerometer.mounting, key)
                for accelerometer in accelerometers
            )
        }
        affected = [
            run
            for run in campaign.runs
            if symbol in named or not acting.isdisjoint(run.attitude_keys)
        ]
        for run in affected if row.per_run else affected[:1]:
            yield (run.name if row.per_run else ""), symbol


@lru_cache(maxsize=1024)
def _is_observable(symbol: str, observable: str, mounting: Mounting, attitude: bytes) -> bool:
    """Return whether a shared term shows in a record; a calibration asks so several times.

    attitude: The bytes of its rows.
    """
    effect, rows = SHARED_TERMS[symbol].effect, np.frombuffer(attitude).reshape(3, 3)
    is_shown = effect.acts_on if observable == "displacement" else effect.shows_in
    return is_shown(mounting.turned(rows).input_axis, rows)


def _inseparable_squares(campaign: Campaign, nuisance: Sequence[Unknown]) -> Iterator[Unknown]:
    """Yield the squares that 1 g cannot tell from K_II, where all is assumed to be perfect.

    They count as if they were asked for: K_II is no more than K_II - K_PP or K_II - K_OO.
    """
    motions = {reading.motion for reading in campaign.readings}
    motions |= {"static"} if campaign.posed else set()
    if motions != {"static"} or campaign.runs or "K_II" not in campaign.model.terms:
        return
    if ALL_TERMS not in campaign.model.assume:
        return
    known = {*campaign.model.terms, *campaign.model.considered}
    present = {(parameter.owner, parameter.symbol) for parameter in nuisance}
    for name in campaign.accelerometers:
        for symbol in SQUARES:
            if symbol not in known and (name, symbol) not in present:
                limit = campaign.limit_of(symbol, name)
                yield Unknown(name, symbol, (0.0, limit), limit, has_default_prior=True)
