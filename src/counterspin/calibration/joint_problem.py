"""From a campaign to the joint fit's problem: series, unknowns, priors, noise.

- `series_of`: the data
- `model_of`: what is estimated, considered and uncertain
- `left_out_of`, `left_out_of_machine`: what the model says nothing of
- `exact_terms`, `exact_inputs`: what it has as exact
- `noise_of`: what is known of the noise
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from counterspin.calibration.observed import ObservedRun
from counterspin.calibration.readings import machine_of
from counterspin.campaign.machine import symbols_shown
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.resolved import Accelerometer, Campaign, Run
from counterspin.campaign.terms import acts
from counterspin.inference.joint.estimation import NoiseRequest
from counterspin.inference.joint.inputs import TIMING
from counterspin.inference.joint.series import Series, jitter_of
from counterspin.inference.joint.unknowns import ROTATION, Considered, Unknown, Unknowns
from counterspin.inference.least_squares import NO_PRIOR
from counterspin.physics import observation
from counterspin.physics.effects import Product, Slope
from counterspin.physics.terms import INPUTS, OWN_TERMS, SHARED_TERMS, Term, term

#: Largest credible errors of a rotation that nobody recorded: rad, rad/s, 1/s.
_ROTATION_LIMITS: Final = (math.pi, 1.0, 1e-2)


def series_of(campaign: Campaign, observed: Sequence[ObservedRun]) -> tuple[Series, ...]:
    """Return one series for each run and accelerometer, missing samples left out."""
    series = []
    for run in observed:
        for name, signal in run.signals.items():
            keep = np.isfinite(signal.error)
            accelerometer = signal.accelerometer
            series.append(
                Series(
                    accelerometer=name,
                    run=run.run.name,
                    trajectory=run.trajectory,
                    mounting=accelerometer.mounting,
                    observable=accelerometer.observable,
                    attitude=run.run.attitude,
                    time=run.record.time[keep],
                    spread=run.record.time_sd[keep],
                    count=run.record.count[keep].astype(float),
                    spacing=run.record.report.step,
                    error=signal.error[keep],
                    in_g=accelerometer.channel.unit.endswith("g"),
                    jitter=_jitter(campaign, run.run, accelerometer),
                    angle_error=run.rotation.error if run.rotation else None,
                    by_latitude=None if signal.by_latitude is None else signal.by_latitude[keep],
                )
            )
    return tuple(series)


def _jitter(campaign: Campaign, run: Run, accelerometer: Accelerometer) -> float:
    """Return what noise of the time stamps adds to each sample, if its size is stated."""
    timing = campaign.noise.timing if campaign.noise else 0.0
    order = observation.ORDERS[accelerometer.observable]
    known = timing if isinstance(timing, float) else 0.0
    axis = accelerometer.mounting.turned(run.attitude).input_axis
    return jitter_of(known, campaign.radius.value, run.rate, order, axis)


def model_of(campaign: Campaign) -> Unknowns:
    """Return the unknowns and considered terms that a campaign asks for.

    What is known beforehand of a term that the campaign neither estimates nor considers is
    considered all the same: its value is taken away and its uncertainty carried.
    """
    unknowns: list[Unknown] = []
    considered: list[Considered] = []
    model = campaign.model
    for name, accelerometer in campaign.accelerometers.items():
        for symbol in OWN_TERMS:
            prior = _pair(accelerometer.priors.get(symbol))
            if symbol in model.terms:
                unknowns.append(Unknown(name, symbol, prior, campaign.limit_of(symbol, name)))
            elif prior is not NO_PRIOR:
                limit = campaign.limit_of(symbol, name)
                considered.append(Considered(name, symbol, prior, limit))
    platform = [s for s in (*model.terms, *model.considered) if s not in OWN_TERMS]
    for symbol in platform:
        prior = _pair(model.priors.get(symbol))
        owners = [run.name for run in campaign.runs] if term(symbol).per_run else [""]
        for owner in owners:
            if symbol in model.terms:
                unknowns.append(Unknown(owner, symbol, prior, campaign.limit_of(symbol)))
            else:
                considered.append(Considered(owner, symbol, prior, campaign.limit_of(symbol)))
    if campaign.angle is None:
        unknowns += [
            Unknown(run.name, symbol, NO_PRIOR, limit)
            for run in campaign.runs
            for symbol, limit in zip(ROTATION, _ROTATION_LIMITS, strict=True)
        ]
    of_machine, considered_of_machine = machine_of(campaign)
    return Unknowns(
        (*unknowns, *of_machine),
        (*considered, *considered_of_machine),
        _uncertain_inputs(campaign),
    )


def left_out_of(campaign: Campaign, name: str) -> tuple[Considered, ...]:
    """Return the terms that could reach an accelerometer and that its model says nothing of.

    A term that is stated as exact is one of them: its uncertainty is missing. Each is taken as a
    considered term without uncertainty; a tilt is one term for each run.
    """
    accelerometer, model = campaign.accelerometers[name], campaign.model
    machine = campaign.machine
    known = {*model.terms, *model.considered, *machine.terms, *machine.considered}
    known = {*known, *accelerometer.priors} - exact_terms(campaign, name)
    terms = [
        Considered(name, row.symbol, (row.nominal, 0.0), campaign.limit_of(row.symbol, name))
        for row in OWN_TERMS.values()
        if row.symbol not in known and _acts(campaign, row)
    ]
    attitudes = {run.attitude.tobytes(): run.attitude for run in campaign.runs}
    for row in SHARED_TERMS.values():
        if campaign.angle is None and row.symbol.startswith("encoder."):
            continue
        reaching = {key for key, own in attitudes.items() if acts(row, accelerometer.mounting, own)}
        reached = [run for run in campaign.runs if run.attitude.tobytes() in reaching]
        if row.symbol not in known and reached:
            owners = [run.name for run in reached] if row.per_run else [""]
            limit = campaign.limit_of(row.symbol)
            terms += [Considered(owner, row.symbol, (0.0, 0.0), limit) for owner in owners]
    return tuple(terms)


def left_out_of_machine(campaign: Campaign, name: str) -> tuple[Considered, ...]:
    """Return likewise the terms of the machine that the readings of an accelerometer could show.

    Without radii of mountings: of these the radius of the centrifuge is known.
    """
    machine = campaign.machine
    stated = {symbol for symbol, prior in machine.priors.items() if prior.u > 0.0}
    known = {*machine.terms, *machine.considered, *stated, *OWN_TERMS}
    own = tuple(reading for reading in campaign.readings if reading.accelerometer == name)
    terms = []
    for symbol in symbols_shown(own):
        if symbol in known or symbol.startswith("centrifuge.radius."):
            continue
        row = term(symbol)
        owner = name if row.per_accelerometer else ""
        terms.append(Considered(owner, symbol, (0.0, 0.0), campaign.limit_of(symbol, name)))
    return tuple(terms)


def exact_terms(campaign: Campaign, name: str) -> set[str]:
    """Return the terms that an accelerometer's campaign states without an uncertainty."""
    model = campaign.model
    stated = {**campaign.accelerometers[name].priors}
    stated |= {s: q for s, q in model.priors.items() if s in (*model.terms, *model.considered)}
    return {symbol for symbol, prior in stated.items() if prior.u == 0.0}


def _acts(campaign: Campaign, row: Term[Product | Slope]) -> bool:
    """Return whether a term can act on records: one of temperature needs more than one run."""
    by_warmth = isinstance(row.effect, Slope) and row.effect.condition == "temperature"
    return not by_warmth or len(campaign.runs) > 1


def _pair(quantity: Quantity | None) -> tuple[float, float]:
    return (quantity.value, quantity.u) if quantity else NO_PRIOR


def _inputs(campaign: Campaign) -> dict[str, float]:
    """Return the standard uncertainty of each input; 0 where it is stated as exact."""
    stated = {
        "centrifuge.radius": campaign.radius,
        "site.gravity": campaign.gravity,
        "site.latitude": campaign.latitude,
    }
    if campaign.angle is not None:
        stated[TIMING] = campaign.timing_offset or Quantity(0.0, 0.0, "s")
    return {name: quantity.u for name, quantity in stated.items()}


def _uncertain_inputs(campaign: Campaign) -> Mapping[str, float]:
    return {name: u for name, u in _inputs(campaign).items() if u > 0.0}


def exact_inputs(campaign: Campaign) -> dict[str, float]:
    """Return the inputs that are stated as exact, with the uncertainty to be assumed of each."""
    return {name: INPUTS[name].typical for name, u in _inputs(campaign).items() if u == 0.0}


def noise_of(campaign: Campaign) -> dict[str, NoiseRequest]:
    """Return what is known of each accelerometer's noise; None stands for "to be estimated".

    Without [noise], or where it says nothing of an accelerometer's record, all is estimated. In
    a record of specific force the accelerometer's white noise cannot be told from that of the
    record: only one of the two is estimated.
    """
    requests = {}
    for name, accelerometer in campaign.accelerometers.items():
        integrated = observation.ORDERS[accelerometer.observable] > 0
        everything = NoiseRequest(None, None if integrated else 0.0)
        noise = campaign.noise
        if noise is None:
            requests[name] = everything
            continue
        white = _given(getattr(noise, accelerometer.observable))
        walk = _given(noise.acceleration)
        if not integrated and walk is None:
            white, walk = None, 0.0
        displacement = accelerometer.observable == "displacement"
        step = noise.quantisation if displacement else 0.0
        quantisation = step if isinstance(step, float) else 0.0
        # A record without any noise cannot be weighted: then the residuals have to say.
        silent = white == 0.0 and walk == 0.0 and quantisation == 0.0
        if silent:
            white, walk, quantisation = everything.white, everything.random_walk, 0.0
        wander = (_given(noise.flicker), _given(noise.bias_walk))
        if noise.wanders and white == 0.0 and None in (walk, *wander):
            white = None  # beside what wanders there is white noise
        requests[name] = NoiseRequest(white, walk, quantisation, *wander)
    return requests


def _given(size: float | str) -> float | None:
    return size if isinstance(size, float) else None
