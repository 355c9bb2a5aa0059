"""Comparison of the two-stage K_II with the joint one."""

from __future__ import annotations

import math

import numpy as np

from counterspin.calibration.accelerometer_view import AccelerometerView
from counterspin.calibration.options import TwoStageOptions
from counterspin.calibration.outcome import make_coefficient
from counterspin.calibration.result_parts import Comparison
from counterspin.calibration.two_stage.method import two_stage_view, walk_is_stated
from counterspin.errors import NotIdentifiableError, RecordError
from counterspin.inference.joint import encoder
from counterspin.inference.joint.fit import JointFit
from counterspin.physics.terms import ACCELEROMETER_TERMS, INPUTS, affects_readings


def compare_k_ii(view: AccelerometerView) -> Comparison | None:
    """Return the two-stage K_II beside the joint one; None where that method does not apply.

    Of what two stages do not estimate they are given what the joint fit found: else a drift, say,
    that was asked for and is there would make them disagree.
    """
    index = view.k_ii_index
    if index is None or view.problem.campaign.model.correlations:
        return None  # the second stage takes its considered terms as independent
    components = {} if walk_is_stated(view.problem.noise) else view.estimate.estimated_noise
    determined = _determined_values(view.fit)
    try:
        stage_view, _ = two_stage_view(
            view.problem,
            view.accelerometer,
            TwoStageOptions(),
            components,
            view.estimate.series,
            determined,
        )
    except (NotIdentifiableError, RecordError):
        return None
    position = stage_view.indices["K_II"]
    parameter = make_coefficient(stage_view.estimate, stage_view.assessment, position)
    if not parameter.estimated or parameter.value is None or parameter.u is None:
        return None
    solution, stage_solution = view.fit.solution, stage_view.fit.solution
    covariance = solution.covariance_noise + solution.covariance_prior
    stage_variance = (stage_solution.covariance_noise + stage_solution.covariance_prior)[
        position, position
    ]
    # What the joint fit found moves each estimate by its own sensitivity: that of the joint one is
    # its regression on it, and the rest of its variance would remain if all of it were known.
    considered_indices = {
        (parameter.owner, parameter.symbol): k
        for k, parameter in enumerate(stage_view.fit.model.considered)
    }
    unknowns = view.fit.model.unknowns
    joint_indices = [
        k
        for k, unknown in enumerate(unknowns)
        if (unknown.owner, unknown.symbol) in {*considered_indices} & {*determined}
    ]
    stage_indices = [
        considered_indices[unknowns[k].owner, unknowns[k].symbol] for k in joint_indices
    ]
    sd = np.sqrt(np.diag(covariance)[joint_indices])
    scaled = covariance[np.ix_(joint_indices, joint_indices)] / np.outer(sd, sd)
    regression = np.linalg.lstsq(scaled, covariance[joint_indices, index] / sd, rcond=None)[0]
    joint_variance = covariance[index, index] - float(regression @ scaled @ regression)
    effect_difference = (
        stage_solution.sensitivity_considered[position, stage_indices] * sd - regression
    )
    common_variance = float(effect_difference @ scaled @ effect_difference)
    # A term that only the two-stage method holds counts in its own variance; one that both hold
    # moves each estimate by its own sensitivity.
    considered = _considered_effects(view.fit, index)
    known = {unknowns[k].name for k in joint_indices}
    for name, (effect, sd_considered) in _considered_effects(stage_view.fit, position).items():
        if name in considered:
            joint_effect, _ = considered.pop(name)
            common_variance += ((effect - joint_effect) * sd_considered) ** 2
        elif name not in known:
            stage_variance += (effect * sd_considered) ** 2
    common_variance += sum(
        (effect * sd_considered) ** 2 for effect, sd_considered in considered.values()
    )
    # What the encoder leaves open of the rotation is in the joint variance where it is estimated.
    rotation_names = {
        parameter.name for parameter in unknowns if parameter.symbol in encoder.SYMBOLS
    }
    effects = stage_solution.sensitivity_considered[position]
    stage_variance += sum(
        float(effects[k] * parameter.prior[1]) ** 2
        for k, parameter in enumerate(stage_view.fit.model.considered)
        if parameter.name in rotation_names
    )
    # Both rest on the same records, and the joint estimate is the better one: variances subtract
    # (Hausman). Where the two-stage method leaves more out it can seem better; then they add.
    u_difference = math.sqrt(
        (
            stage_variance - joint_variance
            if stage_variance > joint_variance
            else stage_variance + joint_variance
        )
        + common_variance
    )
    difference = parameter.value - float(solution.estimate[index])
    return Comparison(
        value=parameter.value,
        u=parameter.u,
        difference=difference,
        u_difference=u_difference,
        z=difference / u_difference,
    )


def _determined_values(fit: JointFit) -> dict[tuple[str, str], tuple[float, float]]:
    """Return value and u of what was asked for, not stated, and determined."""
    return {
        (unknown.owner, unknown.symbol): (float(value) + unknown.nominal, float(u))
        for unknown, value, u in zip(
            fit.model.unknowns, fit.solution.estimate, fit.solution.u, strict=True
        )
        if unknown.is_of_interest and math.isinf(unknown.prior[1]) and u < unknown.limit
    }


def _considered_effects(fit: JointFit, index: int) -> dict[str, tuple[float, float]]:
    """Return the considered terms: name -> sensitivity of an unknown and standard uncertainty.

    Uncertain inputs and errors of the encoder are left out: they move both methods alike.
    """
    solution = fit.solution
    return {
        parameter.name: (float(effect), float(sd))
        for parameter, effect, sd in zip(
            fit.model.considered,
            solution.sensitivity_considered[index],
            solution.considered_sd,
            strict=False,
        )
        if parameter.symbol not in (*encoder.SYMBOLS, *INPUTS)
        and (parameter.symbol in ACCELEROMETER_TERMS or not affects_readings(parameter.symbol))
    }
