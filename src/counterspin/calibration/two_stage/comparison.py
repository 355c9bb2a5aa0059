"""Comparison of the two-stage K_II with the joint one."""

from __future__ import annotations

import math

import numpy as np

from counterspin.calibration.options import TwoStageOptions
from counterspin.calibration.outcome import coefficient
from counterspin.calibration.result_parts import Comparison
from counterspin.calibration.two_stage.method import two_stage_view, walk_is_stated
from counterspin.calibration.view import AccelerometerView
from counterspin.errors import NotIdentifiableError, RecordError
from counterspin.inference.joint import encoder
from counterspin.inference.joint.fit import JointFit
from counterspin.physics.terms import ACCELEROMETER_TERMS, INPUTS, shown_by_readings


def compare(view: AccelerometerView) -> Comparison | None:
    """Return the two-stage K_II beside the joint one; None where that method does not apply.

    Of what two stages do not estimate they are given what the joint fit found: else a drift, say,
    that was asked for and is there would make them disagree.
    """
    index = view.k_ii
    if index is None:
        return None
    components = {} if walk_is_stated(view.problem.noise) else view.estimate.components
    found = _found(view.fit)
    try:
        beside, _ = two_stage_view(
            view.problem,
            view.accelerometer,
            TwoStageOptions(),
            components,
            view.estimate.series,
            found,
        )
    except (NotIdentifiableError, RecordError):
        return None
    place = beside.places["K_II"]
    other = coefficient(beside.estimate, beside.assessment, place)
    if not other.estimated or other.value is None or other.u is None:
        return None
    solution, second = view.fit.solution, beside.fit.solution
    covariance = solution.covariance_noise + solution.covariance_prior
    theirs = (second.covariance_noise + second.covariance_prior)[place, place]
    # What the joint fit found moves each estimate by its own sensitivity: that of the joint one is
    # its regression on it, and the rest of its variance would remain if all of it were known.
    held = {(other.owner, other.symbol): k for k, other in enumerate(beside.fit.model.considered)}
    unknowns = view.fit.model.unknowns
    there = [k for k, o in enumerate(unknowns) if (o.owner, o.symbol) in {*held} & {*found}]
    here = [held[unknowns[k].owner, unknowns[k].symbol] for k in there]
    sd = np.sqrt(np.diag(covariance)[there])
    scaled = covariance[np.ix_(there, there)] / np.outer(sd, sd)
    regression = np.linalg.lstsq(scaled, covariance[there, index] / sd, rcond=None)[0]
    own = covariance[index, index] - float(regression @ scaled @ regression)
    apart = second.sensitivity_considered[place, here] * sd - regression
    both = float(apart @ scaled @ apart)
    # A term that only the two-stage method holds counts in its own variance; one that both hold
    # moves each estimate by its own sensitivity.
    considered = _considered(view.fit, index)
    known = {unknowns[k].name for k in there}
    for name, (effect, sd_of) in _considered(beside.fit, place).items():
        if name in considered:
            joint_effect, _ = considered.pop(name)
            both += ((effect - joint_effect) * sd_of) ** 2
        elif name not in known:
            theirs += (effect * sd_of) ** 2
    both += sum((effect * sd_of) ** 2 for effect, sd_of in considered.values())
    # What the encoder leaves open of the rotation is in the joint variance where it is estimated.
    turned = {other.name for other in unknowns if other.symbol in encoder.SYMBOLS}
    effects = second.sensitivity_considered[place]
    theirs += sum(
        float(effects[k] * other.prior[1]) ** 2
        for k, other in enumerate(beside.fit.model.considered)
        if other.name in turned
    )
    # Both rest on the same records, and the joint estimate is the better one: variances subtract
    # (Hausman). Where the two-stage method leaves more out it can seem better; then they add.
    spread = math.sqrt((theirs - own if theirs > own else theirs + own) + both)
    difference = other.value - float(solution.estimate[index])
    return Comparison(
        value=other.value,
        u=other.u,
        difference=difference,
        u_difference=spread,
        z=difference / spread,
    )


def _found(fit: JointFit) -> dict[tuple[str, str], tuple[float, float]]:
    """Return value and u of what was asked for, not stated, and determined."""
    return {
        (other.owner, other.symbol): (float(value) + other.nominal, float(u))
        for other, value, u in zip(
            fit.model.unknowns, fit.solution.estimate, fit.solution.u, strict=True
        )
        if other.asked and math.isinf(other.prior[1]) and u < other.limit
    }


def _considered(fit: JointFit, index: int) -> dict[str, tuple[float, float]]:
    """Return the considered terms: name -> sensitivity of an unknown and standard uncertainty.

    Uncertain inputs and errors of the encoder are left out: they move both methods alike.
    """
    solution = fit.solution
    return {
        other.name: (float(effect), float(sd))
        for other, effect, sd in zip(
            fit.model.considered,
            solution.sensitivity_considered[index],
            solution.considered_sd,
            strict=False,
        )
        if other.symbol not in (*encoder.SYMBOLS, *INPUTS)
        and (other.symbol in ACCELEROMETER_TERMS or not shown_by_readings(other.symbol))
    }
