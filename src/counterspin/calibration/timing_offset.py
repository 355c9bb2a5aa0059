"""The timing offset between angle and output at which a fit takes derivatives.

A delay of 0.5 ms turns the arm by 3 mrad at one revolution a second. The square of that is larger
than what a record of specific force shows, so an estimated offset is found first, and all
references and columns are taken along the motion that it gives.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from counterspin.calibration.joint_problem import JointProblem
from counterspin.calibration.observed_runs import observe_run
from counterspin.campaign.quantity import Quantity
from counterspin.inference.joint.estimation import locate_input
from counterspin.inference.joint.series import TIMING

#: A first-order model is exact enough for offsets that turn the arm by less, rad.
_MAX_LINEAR_ANGLE: Final = 3e-4

#: An offset is located if its prior allows more than `_MAX_LINEAR_ANGLE` within so many standard
#: deviations.
_PRIOR_DEVIATIONS: Final = 4.0

#: Located: the offset moves by less than this turn of the arm, rad.
_CONVERGED: Final = 1e-5

_ROUNDS: Final = 8


def locate_delay(problem: JointProblem) -> JointProblem:
    """Return the problem with the derivatives taken at the timing offset that the records show.

    A problem whose offset is not estimated, or is known to a small turn of the arm, is returned as
    it is.
    """
    priors = [unknown.prior[1] for unknown in problem.model.unknowns if unknown.symbol == TIMING]
    fastest = max((abs(run.run.rate) for run in problem.observed), default=0.0)
    if not priors or _PRIOR_DEVIATIONS * max(priors) * fastest < _MAX_LINEAR_ANGLE:
        return problem
    for _ in range(_ROUNDS):
        change = locate_input(problem.series, problem.model, problem.noise, TIMING)
        if abs(change) * fastest < _CONVERGED:
            break
        problem = _with_delay(problem, problem.delay + change)
    return problem


def _with_delay(problem: JointProblem, delay: float) -> JointProblem:
    """Return the problem with another deviation of the offset from the stated one, s."""
    campaign = problem.campaign
    stated = campaign.timing_offset or Quantity(0.0, 0.0, "s")
    shifted = replace(campaign, timing_offset=replace(stated, value=stated.value + delay))
    observed = [
        observe_run(shifted, run.run, run.record, run.trajectory.conditions)
        for run in problem.observed
    ]
    return replace(problem, observed=observed, delay=delay)
