"""Select the unknowns of a fit from [model]: requested, nuisance and considered terms.

Each term that affects records or readings is an unknown with its stated prior, or with the default
standard uncertainty of the table of terms. Terms that are assumed perfect are fixed.
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
from counterspin.campaign.terms import shown_symbols
from counterspin.inference.joint.series import CLOCK, RATE_CLOCK, TIMING
from counterspin.inference.joint.unknowns import ROTATION, Considered, Unknown, Unknowns
from counterspin.inference.least_squares import NO_PRIOR
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.effects import Slope, SpecificForceProduct
from counterspin.physics.frequency_response import CUTOFF
from counterspin.physics.terms import (
    ACCELEROMETER_TERMS,
    LEVER_ARM,
    SENSITIVITY_TERMS,
    SHARED_TERMS,
    Term,
    accelerometer_name,
    shared_symbol,
    term,
)

#: Largest credible errors of a rotation that was not recorded: rad, rad/s, 1/s.
_ROTATION_LIMITS: Final = (math.pi, 1.0, 1e-2)

#: Products of components of unit vectors below this value count as zero.
_ZERO_TOLERANCE: Final = 1e-9

#: Terms that are inseparable from K_II at 1 g, because the sum of the squares is constant.
SQUARE_TERMS: Final = ("K_PP", "K_OO")


def make_unknowns(campaign: Campaign) -> Unknowns:
    """Return the requested, the considered and the nuisance terms of a campaign."""
    requested_unknowns: list[Unknown] = []
    nuisance_unknowns: list[Unknown] = []
    considered_terms: list[Considered] = []
    requested_symbols, considered_symbols = campaign.model.terms, campaign.model.considered
    for owner, symbol in _active_terms(campaign):
        stated_value = _stated_prior(campaign, owner, symbol)
        prior, is_default = resolve_prior(campaign, owner, symbol, stated_value)
        limit = campaign.limit_of(symbol, owner)
        if symbol in requested_symbols:
            sd = math.inf if stated_value else campaign.typical_of(symbol, owner)
            prior, is_default = (prior, is_default) if stated_value else (NO_PRIOR, False)
            requested_unknowns.append(
                Unknown(owner, symbol, prior, limit, has_default_prior=is_default, default_sd=sd)
            )
        elif symbol in considered_symbols:
            considered_terms.append(
                Considered(
                    owner, symbol, prior, limit, is_of_interest=False, has_default_prior=is_default
                )
            )
        elif stated_value or prior[1] > 0.0:
            nuisance_unknowns.append(
                Unknown(
                    owner, symbol, prior, limit, is_of_interest=False, has_default_prior=is_default
                )
            )
    if campaign.angle is None:
        requested_unknowns += [
            Unknown(run.name, symbol, NO_PRIOR, limit)
            for run in campaign.runs
            for symbol, limit in zip(ROTATION, _ROTATION_LIMITS, strict=True)
        ]
    for (owner, symbol), stated_value in inputs_by_owner(campaign).items():
        # The unknown of an input is its deviation from the stated value.
        (_, u), is_default = resolve_prior(campaign, "", symbol, stated_value)
        if u > 0.0:
            limit = campaign.limit_of(symbol)
            if symbol in considered_symbols:
                considered_terms.append(
                    Considered(owner, symbol, (0.0, u), limit, False, is_default)
                )
            else:
                nuisance_unknowns.append(Unknown(owner, symbol, (0.0, u), limit, False, is_default))
    unknowns = (
        *requested_unknowns,
        *_inseparable_squares(campaign, nuisance_unknowns),
        *nuisance_unknowns,
    )
    correlations = campaign.model.correlations
    return Unknowns(
        tuple(
            replace(unknown, correlations=correlations[unknown.name])
            if unknown.name in correlations
            else unknown
            for unknown in unknowns
        ),
        tuple(considered_terms),
    )


def is_requested(campaign: Campaign, symbol: str, name: str = "") -> bool:
    """Return whether a result without this term is in the state ``not-determined``.

    This applies to the terms that [model] names, to K_II of a test on a centrifuge, and to the
    terms that correct the output of a triad in poses.

    name: The accelerometer; empty for a term of the machine.
    """
    if campaign.model.has_named_terms and symbol in campaign.model.terms:
        return True
    if symbol == "K_II":
        return bool(campaign.runs) or any(reading.rate for reading in campaign.readings)
    triad = campaign.triad
    has_poses = triad is not None and triad.has_poses and name in triad.accelerometers
    return has_poses and symbol in ("K_F", *SENSITIVITY_TERMS)


def fixed_terms(campaign: Campaign, model: Unknowns, name: str) -> tuple[Considered, ...]:
    """Return the terms that affect an accelerometer and are assumed perfect, with u = 0.

    model: The unknowns of the campaign, from `make_unknowns`.
    """
    prior_sds = {
        (parameter.owner, parameter.symbol): parameter.prior[1]
        for parameter in (*model.unknowns, *model.considered)
    }
    return tuple(
        Considered(owner, symbol, (term(symbol).nominal, 0.0), campaign.limit_of(symbol, owner))
        for owner, symbol in _active_terms(campaign, name)
        if prior_sds.get((owner, symbol), 0.0) == 0.0
    )


def fixed_symbols(campaign: Campaign, model: Unknowns) -> tuple[str, ...]:
    """Return the symbols of all terms and inputs that are assumed perfect."""
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
    """Return the symbols of the inputs that count as exact."""
    exact_symbols = (
        symbol
        for (_, symbol), quantity in inputs_by_owner(campaign).items()
        if quantity.u == 0.0 and campaign.model.assumes(symbol)
    )
    return list(dict.fromkeys(exact_symbols))


def resolve_prior(
    campaign: Campaign, owner: str, symbol: str, stated_value: Quantity | None
) -> tuple[tuple[float, float], bool]:
    """Return prior mean and standard uncertainty, and whether the latter is the default."""
    if stated_value is not None and stated_value.u > 0.0:
        return (stated_value.value, stated_value.u), False
    value = term(symbol).nominal if stated_value is None else stated_value.value
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
    """Return the stated values of the inputs that affect the data, by name."""
    return {
        f"{owner}.{symbol}" if owner else symbol: quantity
        for (owner, symbol), quantity in inputs_by_owner(campaign).items()
    }


def inputs_by_owner(campaign: Campaign) -> dict[tuple[str, str], Quantity]:
    """Return the stated inputs by owner and symbol; the owner of a clock is its recorder."""
    inputs = {("", "site.gravity"): campaign.gravity, ("", "site.latitude"): campaign.latitude}
    readings = [reading for reading in campaign.readings if reading.rate]
    if campaign.runs or readings:
        inputs["", "centrifuge.radius"] = campaign.radius
    for owner, symbol in dict.fromkeys(rate_clock_input(campaign, reading) for reading in readings):
        clock = campaign.rate_clock if symbol == RATE_CLOCK else campaign.clock
        inputs[owner, symbol] = clock or Quantity(0.0, 0.0, "1")
    for recording in map(campaign.recording_of, campaign.runs):
        inputs[recording.recorder, CLOCK] = recording.clock or Quantity(0.0, 0.0, "1")
    if campaign.runs and campaign.angle is not None:
        inputs["", TIMING] = campaign.timing_offset or Quantity(0.0, 0.0, "s")
    for name, accelerometer in campaign.accelerometers.items() if campaign.runs else ():
        for symbol, quantity in accelerometer.response_inputs.items():
            inputs["" if symbol == CUTOFF else name, symbol] = quantity
    return inputs


def _active_terms(campaign: Campaign, accelerometer: str = "") -> list[tuple[str, str]]:
    """Return owner and symbol of the terms that affect one accelerometer, or any of them."""
    names = [accelerometer] if accelerometer else list(campaign.accelerometers)
    frame_terms = campaign.triad.frame_misalignments if campaign.triad else ()
    named_symbols = {*campaign.model.terms, *campaign.model.considered, *campaign.model.priors}
    conditions = set(changing_conditions(campaign))
    terms = [
        (name, symbol)
        for name in names
        for symbol, row in ACCELEROMETER_TERMS.items()
        if symbol in campaign.model.terms or _is_active(campaign, row, conditions)
        if (name, symbol) not in frame_terms
    ]
    readings = tuple(reading for reading in campaign.readings if reading.accelerometer in names)
    # A named radius of a mounting replaces the radii of its accelerometers.
    reading_terms = [
        ("", symbol)
        for symbol in shown_symbols(readings)
        if symbol not in ACCELEROMETER_TERMS
        if symbol in named_symbols
        or not symbol.startswith("centrifuge.radius.")
        or (accelerometer_name(symbol) and shared_symbol(symbol) not in named_symbols)
    ]
    return list(dict.fromkeys([*terms, *_platform_terms(campaign, names), *reading_terms]))


def _is_active(
    campaign: Campaign, row: Term[SpecificForceProduct | Slope], conditions: Collection[str]
) -> bool:
    """Return whether a coefficient affects the output under these changing conditions."""
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
    # An assumed change of temperature is small, so only the linear term matters.
    is_assumed = row.effect.condition == "temperature" and row.effect.power == 1
    return row.effect.condition in conditions or (is_assumed and ASSUMED_TEMPERATURE in conditions)


def _has_mean_product(product: SpecificForceProduct, axes: Mounting) -> bool:
    """Return whether a product has a non-zero mean at a constant rotation of an arm."""
    up_axis = axes.matrix[:, 2]
    mean_product = product.evaluate(np.zeros(3), np.array([up_axis[0], up_axis[1], 0.0]))
    return abs(float(mean_product)) > _ZERO_TOLERANCE


def _platform_terms(campaign: Campaign, names: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield owner and symbol of the platform terms that affect these accelerometers."""
    accelerometers = [campaign.accelerometers[name] for name in names]
    attitudes = dict.fromkeys(key for run in campaign.runs for key in run.attitude_keys)
    has_lever_arm = any(run.turns_in_space for run in campaign.runs)
    named_symbols = {*campaign.model.terms, *campaign.model.considered}
    for symbol, row in SHARED_TERMS.items():
        if campaign.angle is None and symbol.startswith("encoder."):
            continue
        # Strapdown instruments rotate with the table and have no gyros.
        if row.effect.part == ("gyros" if campaign.strapped else "table"):
            continue
        if symbol == LEVER_ARM:
            yield from ((name, symbol) for name in names if has_lever_arm)
            continue
        active_keys = {
            key
            for key in attitudes
            if any(
                _is_observable(symbol, accelerometer.observable, accelerometer.mounting, key)
                for accelerometer in accelerometers
            )
        }
        affected_runs = [
            run
            for run in campaign.runs
            if symbol in named_symbols or not active_keys.isdisjoint(run.attitude_keys)
        ]
        for run in affected_runs if row.per_run else affected_runs[:1]:
            yield (run.name if row.per_run else ""), symbol


@lru_cache(maxsize=1024)
def _is_observable(symbol: str, observable: str, mounting: Mounting, attitude_bytes: bytes) -> bool:
    """Return whether a shared term affects a record."""
    effect, attitude = SHARED_TERMS[symbol].effect, np.frombuffer(attitude_bytes).reshape(3, 3)
    is_sensitive = effect.acts_on if observable == "displacement" else effect.affects_output
    return is_sensitive(mounting.turned(attitude).input_axis, attitude)


def _inseparable_squares(campaign: Campaign, unknowns: Sequence[Unknown]) -> Iterator[Unknown]:
    """Yield K_PP and K_OO if they are inseparable from K_II, although assumed perfect.

    At 1 g, the data determine only K_II - K_PP or K_II - K_OO.
    """
    motions = {reading.motion for reading in campaign.readings}
    motions |= {"static"} if campaign.posed else set()
    if motions != {"static"} or campaign.runs or "K_II" not in campaign.model.terms:
        return
    if ALL_TERMS not in campaign.model.assume:
        return
    named_symbols = {*campaign.model.terms, *campaign.model.considered}
    nuisance_keys = {(parameter.owner, parameter.symbol) for parameter in unknowns}
    for name in campaign.accelerometers:
        for symbol in SQUARE_TERMS:
            if symbol not in named_symbols and (name, symbol) not in nuisance_keys:
                limit = campaign.limit_of(symbol, name)
                yield Unknown(name, symbol, (0.0, limit), limit, has_default_prior=True)
