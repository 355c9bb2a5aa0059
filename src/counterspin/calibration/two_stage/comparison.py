"""Comparison of the two-stage K_II with the joint one."""

from __future__ import annotations

import math

import numpy as np

from counterspin.calibration.accelerometer_view import AccelerometerView
from counterspin.calibration.options import TwoStageOptions
from counterspin.calibration.outcome import make_coefficient
from counterspin.calibration.result_parts import Comparison
from counterspin.calibration.two_stage.method import is_walk_stated, two_stage_view
from counterspin.errors import NotIdentifiableError, RecordError
from counterspin.inference.joint import encoder
from counterspin.inference.joint.fit import JointFit
from counterspin.physics.terms import ACCELEROMETER_TERMS, INPUTS, affects_readings


def compare_k_ii(view: AccelerometerView) -> Comparison | None:
    """Return the comparison of the two-stage K_II with the joint one; None if not applicable.

    Requested terms that the two-stage method does not estimate, such as a drift, get their values
    from the joint fit.
    """
    index = view.k_ii_index
    if index is None or view.problem.campaign.model.correlations:
        return None  # the second stage requires independent considered terms
    components = {} if is_walk_stated(view.problem.noise) else view.estimate.estimated_noise
    joint_values = _determined_values(view.fit)
    try:
        stage_view, _ = two_stage_view(
            view.problem,
            view.accelerometer,
            TwoStageOptions(),
            components,
            view.estimate.series,
            joint_values,
        )
    except (NotIdentifiableError, RecordError):
        return None
    stage_index = stage_view.indices["K_II"]
    stage_k_ii = make_coefficient(stage_view.estimate, stage_view.assessment, stage_index)
    if not stage_k_ii.estimated or stage_k_ii.value is None or stage_k_ii.u is None:
        return None
    solution, stage_solution = view.fit.solution, stage_view.fit.solution
    covariance = solution.covariance_noise + solution.covariance_prior
    stage_variance = (stage_solution.covariance_noise + stage_solution.covariance_prior)[
        stage_index, stage_index
    ]
    # Terms from the joint fit affect both estimates. The sensitivity of the joint K_II to them is
    # the regression coefficient, and the residual variance is independent of them.
    index_by_key = {
        (parameter.owner, parameter.symbol): k
        for k, parameter in enumerate(stage_view.fit.model.considered)
    }
    unknowns = view.fit.model.unknowns
    joint_indices = [
        k
        for k, unknown in enumerate(unknowns)
        if (unknown.owner, unknown.symbol) in {*index_by_key} & {*joint_values}
    ]
    stage_indices = [index_by_key[unknowns[k].owner, unknowns[k].symbol] for k in joint_indices]
    sd = np.sqrt(np.diag(covariance)[joint_indices])
    correlation = covariance[np.ix_(joint_indices, joint_indices)] / np.outer(sd, sd)
    regression = np.linalg.lstsq(correlation, covariance[joint_indices, index] / sd, rcond=None)[0]
    joint_variance = covariance[index, index] - float(regression @ correlation @ regression)
    effect_difference = (
        stage_solution.sensitivity_considered[stage_index, stage_indices] * sd - regression
    )
    common_variance = float(effect_difference @ correlation @ effect_difference)
    # A term considered only in the two-stage method adds to its variance; a term considered in both
    # adds the difference of its effects.
    joint_effects = _considered_effects(view.fit, index)
    joint_names = {unknowns[k].name for k in joint_indices}
    for name, (effect, considered_sd) in _considered_effects(stage_view.fit, stage_index).items():
        if name in joint_effects:
            joint_effect, _ = joint_effects.pop(name)
            common_variance += ((effect - joint_effect) * considered_sd) ** 2
        elif name not in joint_names:
            stage_variance += (effect * considered_sd) ** 2
    common_variance += sum(
        (effect * considered_sd) ** 2 for effect, considered_sd in joint_effects.values()
    )
    # The joint variance includes the encoder errors, which the joint fit estimates.
    rotation_names = {unknown.name for unknown in unknowns if unknown.symbol in encoder.SYMBOLS}
    effects = stage_solution.sensitivity_considered[stage_index]
    stage_variance += sum(
        float(effects[k] * parameter.prior[1]) ** 2
        for k, parameter in enumerate(stage_view.fit.model.considered)
        if parameter.name in rotation_names
    )
    # Both methods use the same records, and the joint estimate is efficient, so the variances
    # subtract (Hausman). With fewer terms, the two-stage variance may be smaller; then they add.
    u_difference = math.sqrt(
        (
            stage_variance - joint_variance
            if stage_variance > joint_variance
            else stage_variance + joint_variance
        )
        + common_variance
    )
    difference = stage_k_ii.value - float(solution.estimate[index])
    return Comparison(
        value=stage_k_ii.value,
        u=stage_k_ii.u,
        difference=difference,
        u_difference=u_difference,
        z=difference / u_difference,
    )


def _determined_values(fit: JointFit) -> dict[tuple[str, str], tuple[float, float]]:
    """Return value and u of the requested terms that are determined without a stated prior."""
    return {
        (unknown.owner, unknown.symbol): (float(value) + unknown.nominal, float(u))
        for unknown, value, u in zip(
            fit.model.unknowns, fit.solution.estimate, fit.solution.u, strict=True
        )
        if unknown.is_of_interest and math.isinf(unknown.prior[1]) and u < unknown.limit
    }


def _considered_effects(fit: JointFit, index: int) -> dict[str, tuple[float, float]]:
    """Return name of a considered term -> sensitivity of an unknown, and standard uncertainty.

    Inputs and encoder errors are excluded because they affect both methods equally.
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
