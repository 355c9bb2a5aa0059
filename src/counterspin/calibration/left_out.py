"""What a model leaves out: terms, and what is stated as exact, at their typical sizes.

An uncertainty knows only of what the model has. What it says nothing of moves the estimates all the
same, by its size times their sensitivity to it: hence a second uncertainty with all of that at
typical sizes, and the terms by name that decide it.

- `joint_omissions`, `omissions_of`, `two_stage_omissions`: what each would move the coefficients by
- `with_typical`: coefficients with the second uncertainty
- `decisive`, `Effect`: what moves a coefficient by more than its u
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.joint_problem import (
    exact_inputs,
    exact_terms,
    left_out_of,
    left_out_of_machine,
)
from counterspin.calibration.joint_view import AccelerometerView
from counterspin.calibration.result_parts import AccelerometerResult, Coefficient, OmittedTerm
from counterspin.campaign.resolved import Campaign
from counterspin.frozen import frozen
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.omitted_terms import sensitivities
from counterspin.inference.readings import Readings
from counterspin.inference.two_stage.request import TwoStageRequest
from counterspin.inference.two_stage.second_stage import SecondStage
from counterspin.physics.terms import TERMS, term


def joint_omissions(views: Sequence[AccelerometerView]) -> dict[str, dict[str, OmittedTerm]]:
    """Return by accelerometer what each thing left out would move its coefficients by.

    Parameters
    ----------
    views
        Of all accelerometers of one fit.
    """
    # What the dividing head adds is in the readings' noise already.
    readings = [
        replace(part.readings, u=part.sigma, u_head=np.zeros_like(part.sigma))
        for view in views
        for part in view.readings
    ]
    places = {view.name: view.places for view in views}
    return omissions_of(views[0].campaign, views[0].fit, places, readings)


def omissions_of(
    campaign: Campaign,
    fit: JointFit,
    places: Mapping[str, Mapping[str, int]],
    readings: Sequence[Readings],
) -> dict[str, dict[str, OmittedTerm]]:
    """Return by accelerometer what each thing left out would move its coefficients by.

    Of a term that every run has anew, the runs' effects are combined as independent ones.

    Parameters
    ----------
    campaign, fit
        A campaign and its fit, of records that may be still to come.
    places
        By accelerometer and symbol, the place among the fit's unknowns.
    readings
        That are part of the fit, each with its noise.
    """
    terms = {
        name: (*left_out_of(campaign, name), *left_out_of_machine(campaign, name))
        for name in places
    }
    # Accelerometers share the platform's terms, and all of them one set of columns.
    every = list(dict.fromkeys(other for own in terms.values() for other in own))
    column_of = {other: column for column, other in enumerate(every)}
    inputs = exact_inputs(campaign)
    moved = sensitivities(fit, every, inputs, readings)
    omissions: dict[str, dict[str, OmittedTerm]] = {}
    for name, own in places.items():
        rows, exact = list(own.values()), exact_terms(campaign, name)
        by_symbol: dict[str, list[Array]] = {}
        for other in terms[name]:
            effect = moved[rows, column_of[other]]
            if other.symbol in exact and other.symbol in own:
                # What is held at a value is off by the whole of its error.
                effect[list(own).index(other.symbol)] = -1.0
            by_symbol.setdefault(other.symbol, []).append(effect)
        for column, symbol in enumerate(inputs, start=len(every)):
            by_symbol[symbol] = [moved[rows, column]]
        omissions[name] = {
            symbol: _omitted(
                campaign.typical_of(symbol, name),
                symbol,
                own,
                effects[0] if len(effects) == 1 else np.linalg.norm(effects, axis=0),
            )
            for symbol, effects in by_symbol.items()
        }
    return omissions


def two_stage_omissions(
    campaign: Campaign, name: str, second: SecondStage, request: TwoStageRequest
) -> dict[str, OmittedTerm]:
    """Return what the things that are not known would move the second stage's estimates by.

    Parameters
    ----------
    campaign, name
        The description and one of its accelerometers.
    second
        The second stage; it ignores these terms.
    request
        What was asked of it.
    """
    shifts = {symbol: second.shift(symbol) for symbol in second.ignored} | second.exact_shifts()
    for place, symbol in enumerate(("centrifuge.radius", "site.gravity")):
        if symbol not in exact_inputs(campaign):
            continue
        size = (campaign.radius, campaign.gravity)[place].value
        effects = [
            request.from_relative(own, second.estimate(own)[0])[place] / size
            for own in second.symbols
        ]
        shifts[symbol] = np.array(effects)
    return {
        symbol: _omitted(campaign.typical_of(symbol, name), symbol, second.symbols, effects)
        for symbol, effects in shifts.items()
    }


def _omitted(
    typical: float, symbol: str, coefficients: Sequence[str] | Mapping[str, int], effects: Array
) -> OmittedTerm:
    moves = {
        name: float(effect)
        for name, effect in zip(coefficients, effects, strict=True)
        if name in TERMS
    }
    return OmittedTerm(
        sensitivity=moves.get("K_II"),
        unit=term(symbol).unit,
        typical=typical,
        moves=moves,
    )


def with_typical(
    coefficients: Mapping[str, Coefficient], omissions: Mapping[str, OmittedTerm]
) -> dict[str, Coefficient]:
    """Return coefficients with `u_typical`: u with all that is left out at its typical size.

    Parameters
    ----------
    coefficients
        Of one accelerometer.
    omissions
        What its model leaves out.
    """
    if not omissions:
        return dict(coefficients)
    return {
        symbol: c.model_copy(
            update={
                "u_typical": math.hypot(
                    c.u,
                    *(
                        omitted.moves.get(symbol, 0.0) * (omitted.typical or 0.0)
                        for omitted in omissions.values()
                    ),
                )
            }
        )
        if c.u is not None and symbol in TERMS and (c.estimated or symbol in omissions)
        else c
        for symbol, c in coefficients.items()
    }


@frozen
class Effect:
    """What one thing left out does to a coefficient at its typical size.

    Attributes
    ----------
    symbol, size, unit
        The term or input, and the standard uncertainty assumed of it.
    shift
        What it moves the coefficient by, in the coefficient's unit.
    """

    symbol: str
    size: float
    unit: str
    shift: float


def decisive(accelerometer: AccelerometerResult) -> dict[str, list[Effect]]:
    """Return by coefficient, K_II first, what would move it by more than its u, the largest first.

    Results of versions that did not state sizes are judged by those of today's table.
    """
    effects: dict[str, list[Effect]] = {}
    for name in sorted(accelerometer.coefficients, key=lambda name: name != "K_II"):
        c = accelerometer.coefficients[name]
        if not c.estimated or not c.u:
            continue
        for symbol, omitted in accelerometer.left_out.items():
            size = term(symbol).typical if omitted.typical is None else omitted.typical
            moves = omitted.moves or {"K_II": omitted.sensitivity or 0.0}
            shift = abs(moves.get(name, 0.0)) * size
            if shift > c.u:
                effects.setdefault(name, []).append(Effect(symbol, size, omitted.unit, shift))
    return {name: sorted(own, key=lambda effect: -effect.shift) for name, own in effects.items()}
