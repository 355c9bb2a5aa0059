"""Values of inputs at which a fit evaluates derivatives: timing offset and frequency response.

A delay of 0.5 ms rotates the arm by 3 mrad at one revolution per second, and the second-order
effect is significant in a record of specific force. Therefore, inputs that delay the output are
estimated first, and all references and design columns are evaluated at these estimates.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.calibration.joint_problem import JointProblem
from counterspin.calibration.observed_runs import observe_run
from counterspin.campaign.accelerometers import update_responses
from counterspin.campaign.quantity import Quantity
from counterspin.inference.joint.estimation import locate_inputs
from counterspin.inference.joint.series import TIMING
from counterspin.inference.joint.unknowns import Unknown
from counterspin.physics.frequency_response import RESPONSE_INPUTS

#: Phase change of the output up to which a first-order model is sufficient, rad.
_MAX_LINEAR_ANGLE: Final = 3e-4

#: Standard deviations of the prior within which the phase change must stay below the limit.
_PRIOR_SIGMAS: Final = 4.0

#: Convergence: largest phase change in the last iteration, rad.
_ANGLE_TOLERANCE: Final = 1e-5

_MAX_ITERATIONS: Final = 8


def locate_nonlinear_inputs(problem: JointProblem) -> JointProblem:
    """Return the problem with derivatives evaluated at the estimated inputs.

    A problem without inputs that change the phase significantly is returned unchanged.
    """
    max_rate = max((abs(run.run.rate) for run in problem.observed_runs), default=0.0)
    unknowns = [
        unknown
        for unknown in problem.model.unknowns
        if _phase_change(problem, unknown, _PRIOR_SIGMAS * unknown.prior[1], max_rate)
        >= _MAX_LINEAR_ANGLE
    ]
    names = [unknown.name for unknown in unknowns]
    for _ in range(_MAX_ITERATIONS if unknowns else 0):
        values = locate_inputs(problem.series, problem.model, problem.noise, names)
        phase_changes = [
            _phase_change(problem, unknown, values[unknown.name], max_rate) for unknown in unknowns
        ]
        if max(phase_changes) < _ANGLE_TOLERANCE:
            break
        changes = {(unknown.owner, unknown.symbol): values[unknown.name] for unknown in unknowns}
        problem = _apply_changes(problem, changes)
    return problem


def _phase_change(problem: JointProblem, unknown: Unknown, change: float, rate: float) -> float:
    """Return the change of the complex gain with an input, rad; 0 for other unknowns."""
    if unknown.symbol == TIMING:
        return abs(change) * rate
    if unknown.symbol not in RESPONSE_INPUTS or math.isinf(change):
        return 0.0
    frequency = np.array([rate / (2.0 * math.pi)])
    max_gain_change = 0.0
    for name, accelerometer in problem.campaign.accelerometers.items():
        if unknown.owner in ("", name) and (response := accelerometer.response) is not None:
            old_gain = response.gain(frequency)
            new_gain = response.deviate(unknown.symbol, change).gain(frequency)
            max_gain_change = max(max_gain_change, abs(complex(new_gain[0] - old_gain[0])))
    return max_gain_change


def _apply_changes(problem: JointProblem, changes: Mapping[tuple[str, str], float]) -> JointProblem:
    """Return the problem with additional shifts of inputs from their stated values."""
    campaign = problem.campaign
    shifts = {
        key: problem.shifts.get(key, 0.0) + changes.get(key, 0.0)
        for key in dict.fromkeys((*problem.shifts, *changes))
    }
    if ("", TIMING) in shifts:
        stated_offset = campaign.timing_offset or Quantity(0.0, 0.0, "s")
        delay = stated_offset.value + shifts["", TIMING]
        campaign = replace(campaign, timing_offset=replace(stated_offset, value=delay))
    response_values = {
        (owner, symbol): quantity.value + shifts[owner, symbol]
        for name, accelerometer in campaign.accelerometers.items()
        for symbol, quantity in accelerometer.response_inputs.items()
        for owner in ("", name)
        if (owner, symbol) in shifts
    }
    if response_values:
        accelerometers = update_responses(campaign.accelerometers, response_values)
        campaign = replace(campaign, accelerometers=accelerometers)
    observed_runs = [
        observe_run(campaign, run.run, run.record, run.trajectory.conditions)
        for run in problem.observed_runs
    ]
    return replace(problem, observed_runs=observed_runs, shifts=shifts)
