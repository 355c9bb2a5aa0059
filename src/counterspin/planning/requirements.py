"""Requirements for the centrifuge: how large each of its faults may become."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.campaign.description import Campaign
from counterspin.campaign.runs import sample_count
from counterspin.inference.joint.inputs import INPUTS, TIMING
from counterspin.inference.joint.prepared import prepared_for
from counterspin.inference.joint.unknowns import ROTATION, unit_of
from counterspin.planning.faults import Fault, of_path, perfect
from counterspin.planning.forecast import Forecast, expected_values, scale_factors
from counterspin.planning.result import Requirement
from counterspin.planning.sensitivities import sensitivities

#: A fault that adds this part of u in quadrature makes u grow by a twentieth.
_TOLERABLE_PART_OF_U: Final = math.sqrt(1.05**2 - 1.0)

#: The inputs of which something is required.
_INPUTS: Final = ("centrifuge.radius", TIMING)

#: No centrifuge has larger faults; a length is a part of the radius.
_LARGEST_SIZES: Final = {"rad": 0.1, "s": 1.0, "1/s": 1e-2, "1": 0.1}


def requirements_of(
    prediction: Forecast, name: str, sampling_rate: float
) -> tuple[str, list[Requirement]]:
    """Return how good the centrifuge must be for the uncertainty that is predicted.

    Each fault by itself, at the size given, makes u of the coefficient grow by a twentieth.

    sampling_rate: Hz.
    """
    campaign = prediction.campaign
    paths = [of_path(symbol) for symbol in ("encoder.harmonic.1", "centrifuge.imbalance.1")]
    # A fit that has a fault among its unknowns gives way to it: it says nothing of its own need.
    symbols = {part.symbol for fault in paths for part in fault.parts}
    before = prediction.fit
    model = before.model.without({*symbols, *INPUTS, TIMING})
    prepared = prepared_for(before.prepared, before.model, model, scale_factors(campaign), {})
    fit = replace(before, model=model, observations=prepared)
    place = [unknown.name for unknown in model.unknowns].index(name)
    unknown = model.unknowns[place]
    expected = expected_values(campaign, model.unknowns)
    words = f"at the expected value of {name}"
    if expected[place] == 0.0:
        expected[place] = unknown.limit
        unit = unit_of(unknown.symbol)
        words = f"if {name} had its largest credible value, {unknown.limit:.3g} {unit}"
    # A fault of the rotation has its own size in each run.
    owners = {symbol: [run.name for run in campaign.runs] for symbol in ROTATION}
    owners |= {symbol: [""] for symbol in _INPUTS}
    faults = [
        Fault(symbol, "", 1.0, "", tuple(perfect(owner, symbol) for owner in of))
        for symbol, of in owners.items()
    ]
    found = sensitivities(replace(prediction, fit=fit), [*faults, *paths], expected)
    zero, rate, drift, radius, delay, *machine = (one.moved[place] for one in found)
    rates = np.array([run.rate for run in campaign.runs])
    lines = [
        ("radius", radius, "m"),
        ("drift of the rate that the recorded angle does not show", drift, "1/s"),
        ("rate, relative, the same error in all runs", rate @ rates, "1"),
        ("zero of the angle, new in each run", zero, "rad"),
        (
            "noise of the angle, per sample",
            _angle_noise(campaign, np.column_stack([zero, rate, drift]), sampling_rate),
            "rad",
        ),
        (f"{paths[0].words}, the same in all runs", machine[0], "rad"),
        (paths[1].words, machine[1], "m"),
        ("delay between the clocks of angle and output", delay, "s"),
    ]
    allowed = _TOLERABLE_PART_OF_U * prediction.u[name]
    largest = {**_LARGEST_SIZES, "m": _LARGEST_SIZES["1"] * campaign.radius.value}
    return words, [
        Requirement(
            words=text,
            size=size if (size := _over(allowed, moved)) <= largest[unit] else None,
            unit=unit,
        )
        for text, moved, unit in lines
    ]


def _over(allowed: float, moved: Array | float) -> float:
    """Return the size of a fault whose parts, one unit each, move the coefficient so."""
    sensitivity = float(np.linalg.norm(moved))
    return allowed / sensitivity if sensitivity > 0.0 else math.inf


def _angle_noise(campaign: Campaign, of_run: Array, sampling_rate: float) -> float:
    """Return the sensitivity to white noise of the recorded angle.

    The rotation is fitted to the angle, th0 + w t + C w t^2/2, so that noise of a sample comes in
    through the uncertainty of these three.
    """
    variance = 0.0
    for run, sensitivity in zip(campaign.runs, of_run, strict=True):
        duration = run.duration or 0.0
        n = sample_count(duration, sampling_rate)
        scale = np.array([1.0, 1.0 / duration, 2.0 / (abs(run.rate) * duration**2)])
        a, b, c = (sensitivity * scale).tolist()  # to 1, t and t^2, t from 0 to 1
        # The same of 1, t - 1/2 and (t - 1/2)^2 less its mean, whose products add up to nothing
        # over even samples, and whose squares have these means.
        linear = (n + 1.0) / (12.0 * (n - 1.0))
        square = (n + 1.0) * (n**2 - 4.0) / (180.0 * (n - 1.0) ** 3)
        rest = c - b + a * (0.25 - linear)
        variance += (a**2 + (b - 0.5 * a) ** 2 / linear + rest**2 / square) / n
    return math.sqrt(variance)
