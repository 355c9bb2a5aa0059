"""The values of inputs at which a fit takes derivatives: timing offset and frequency response.

A delay of 0.5 ms turns the arm by 3 mrad at one revolution a second. The square of that is larger
than what a record of specific force shows. So estimated inputs that delay the output are found
first, and all references and columns are taken at the values found.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.calibration.joint_problem import JointProblem
from counterspin.calibration.observed_runs import observe_run
from counterspin.campaign.accelerometers import with_responses
from counterspin.campaign.quantity import Quantity
from counterspin.inference.joint.estimation import locate_inputs
from counterspin.inference.joint.series import TIMING
from counterspin.inference.joint.unknowns import Unknown
from counterspin.physics.frequency_response import RESPONSE_INPUTS

#: A first-order model is exact enough for inputs that turn the output by less, rad.
_MAX_LINEAR_ANGLE: Final = 3e-4

#: An input is located if its prior allows more than `_MAX_LINEAR_ANGLE` within so many standard
#: deviations.
_PRIOR_DEVIATIONS: Final = 4.0

#: Located: the inputs turn the output by less than this, rad.
_CONVERGED: Final = 1e-5

_ROUNDS: Final = 8


def locate_nonlinear_inputs(problem: JointProblem) -> JointProblem:
    """Return the problem with the derivatives taken at the inputs that the records show.

    A problem whose inputs are not estimated, or are known to a small turn of the output, is
    returned as it is.
    """
    fastest = max((abs(run.run.rate) for run in problem.observed), default=0.0)
    located_unknowns = [
        unknown
        for unknown in problem.model.unknowns
        if _turn(problem, unknown, _PRIOR_DEVIATIONS * unknown.prior[1], fastest)
        >= _MAX_LINEAR_ANGLE
    ]
    names = [unknown.name for unknown in located_unknowns]
    for _ in range(_ROUNDS if located_unknowns else 0):
        located_values = locate_inputs(problem.series, problem.model, problem.noise, names)
        phase_changes = [
            _turn(problem, unknown, located_values[unknown.name], fastest)
            for unknown in located_unknowns
        ]
        if max(phase_changes) < _CONVERGED:
            break
        changes = {
            (unknown.owner, unknown.symbol): located_values[unknown.name]
            for unknown in located_unknowns
        }
        problem = _with_changes(problem, changes)
    return problem


def _turn(problem: JointProblem, unknown: Unknown, change: float, rate: float) -> float:
    """Return the change of the complex gain at a rate with an input, rad; 0 for other unknowns."""
    if unknown.symbol == TIMING:
        return abs(change) * rate
    if unknown.symbol not in RESPONSE_INPUTS or math.isinf(change):
        return 0.0
    frequency = np.array([rate / (2.0 * math.pi)])
    largest = 0.0
    for name, accelerometer in problem.campaign.accelerometers.items():
        if unknown.owner in ("", name) and (response := accelerometer.response) is not None:
            old_gain = response.gain(frequency)
            new_gain = response.deviate(unknown.symbol, change).gain(frequency)
            largest = max(largest, abs(complex(new_gain[0] - old_gain[0])))
    return largest


def _with_changes(problem: JointProblem, changes: Mapping[tuple[str, str], float]) -> JointProblem:
    """Return the problem with further deviations of inputs from their stated values."""
    campaign = problem.campaign
    shifts = {
        key: problem.shifts.get(key, 0.0) + changes.get(key, 0.0)
        for key in dict.fromkeys((*problem.shifts, *changes))
    }
    if ("", TIMING) in shifts:
        stated_offset = campaign.timing_offset or Quantity(0.0, 0.0, "s")
        delay = stated_offset.value + shifts["", TIMING]
        campaign = replace(campaign, timing_offset=replace(stated_offset, value=delay))
    responses = {
        (owner, symbol): known.value + shifts[owner, symbol]
        for name, accelerometer in campaign.accelerometers.items()
        for symbol, known in accelerometer.response_inputs.items()
        for owner in ("", name)
        if (owner, symbol) in shifts
    }
    if responses:
        accelerometers = with_responses(campaign.accelerometers, responses)
        campaign = replace(campaign, accelerometers=accelerometers)
    observed_runs = [
        observe_run(campaign, run.run, run.record, run.trajectory.conditions)
        for run in problem.observed
    ]
    return replace(problem, observed=observed_runs, shifts=shifts)
