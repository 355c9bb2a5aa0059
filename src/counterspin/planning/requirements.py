"""Requirements for the centrifuge: how large each of its faults may become."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.campaign.description import Campaign
from counterspin.campaign.resolved import sample_count
from counterspin.inference.joint.fit import blocks_of, solve_blocks
from counterspin.inference.joint.inputs import INPUTS, TIMING
from counterspin.inference.joint.prepared import prepare_columns, prepared_for
from counterspin.inference.joint.unknowns import ROTATION, Considered, Unknowns, unit_of
from counterspin.planning.faults import of_path
from counterspin.planning.forecast import Forecast, expected_values, scale_factors
from counterspin.planning.result import Requirement
from counterspin.planning.watching import watch

#: A fault that adds this part of u in quadrature makes u grow by a twentieth.
_TOLERABLE_PART_OF_U: Final = math.sqrt(1.05**2 - 1.0)

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
    faults = [of_path(symbol) for symbol in ("encoder.harmonic.1", "centrifuge.imbalance.1")]
    # A fit that has a fault among its unknowns gives way to it: it says nothing of its own need.
    symbols = {part.term.symbol for fault in faults for part in fault.parts}
    model = prediction.fit.model.without({*symbols, *INPUTS, TIMING})
    place = [unknown.name for unknown in model.unknowns].index(name)
    unknown = model.unknowns[place]
    expected = expected_values(campaign, model.unknowns)
    words = f"at the value expected of {name}"
    if expected[place] == 0.0:
        expected[place] = unknown.limit
        unit = unit_of(unknown.symbol)
        words = f"if {name} were as large as is credible, {unknown.limit:.3g} {unit}"
    rotation = tuple(
        Considered(run.name, symbol, (0.0, 1.0), 1.0)
        for run in campaign.runs
        for symbol in ROTATION
    )
    inputs = tuple(Considered("", symbol, (0.0, 1.0), 1.0) for symbol in (*INPUTS, TIMING))
    watched = Unknowns(model.unknowns, (*rotation, *inputs))
    factors, noise = scale_factors(campaign), prediction.fit.noise
    # One after the other: the columns of all of them together would take much memory.
    blocks = [
        block
        for record in prediction.fit.prepared
        for block in blocks_of(
            prepare_columns([record.series], watched, factors, expected), watched, noise
        )
    ]
    solution = solve_blocks(blocks, watched)
    allowed = _TOLERABLE_PART_OF_U * prediction.u[name]
    row = solution.sensitivity_considered[place]
    of_run = row[: len(rotation)].reshape(len(campaign.runs), len(ROTATION))
    of_input = dict(zip((*INPUTS, TIMING), row[len(rotation) :], strict=True))
    rates = np.array([run.rate for run in campaign.runs])
    before = prediction.fit
    without = prepared_for(before.prepared, before.model, model, factors, {})
    fit = replace(before, model=model, prepared=without)
    machine = watch(replace(prediction, fit=fit), faults)
    eccentricity, imbalance = (machine.sensitivity(fault, place) for fault in range(2))
    lines = [
        ("radius", of_input["centrifuge.radius"], "m"),
        (
            "drift of the rate that the recorded angle does not show",
            _norm(of_run[:, 2]),
            "1/s",
        ),
        ("rate, relative, the same error in all runs", float(of_run[:, 1] @ rates), "1"),
        ("zero of the angle, new in each run", _norm(of_run[:, 0]), "rad"),
        ("noise of the angle, per sample", _angle_noise(campaign, of_run, sampling_rate), "rad"),
        (f"{faults[0].words}, the same in all runs", eccentricity, "rad"),
        (faults[1].words, imbalance, "m"),
        ("delay between the clocks of angle and output", of_input[TIMING], "s"),
    ]
    largest = {**_LARGEST_SIZES, "m": _LARGEST_SIZES["1"] * campaign.radius.value}
    return words, [
        Requirement(
            words=text,
            size=size if (size := _over(allowed, abs(sensitivity))) <= largest[unit] else None,
            unit=unit,
        )
        for text, sensitivity, unit in lines
    ]


def _over(allowed: float, sensitivity: float) -> float:
    return allowed / sensitivity if sensitivity > 0.0 else math.inf


def _norm(values: Array) -> float:
    return float(np.linalg.norm(values))


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
