"""What competes in a study: the joint fit of all accelerometers, the two-stage method of one."""

from __future__ import annotations

from collections.abc import Mapping

from counterspin.calibration.joint_problem import JointProblem
from counterspin.calibration.two_stage_request import request_of
from counterspin.errors import NotIdentifiableError
from counterspin.frozen import frozen
from counterspin.inference.joint.unknowns import ROTATION, Unknowns
from counterspin.inference.noise.model import Noise
from counterspin.inference.two_stage.request import TwoStageRequest
from counterspin.physics.terms import OWN_TERMS
from counterspin.studies.description import StudyDescription


@frozen
class JointRequest:
    """What is asked of the joint fit."""

    model: Unknowns  #: Unknowns, considered terms, uncertain inputs.
    noise: Mapping[str, Noise]  #: Accelerometer -> its noise, given or to be estimated.

    @property
    def reported(self) -> list[int]:
        """Places of the unknowns that a study reports: those asked for that the runs share."""
        return [
            place
            for place, unknown in enumerate(self.model.unknowns)
            if unknown.asked
            and not (unknown.unstated and unknown.prior[1] >= unknown.limit)
            and (
                unknown.symbol in OWN_TERMS
                or (not unknown.owner and unknown.symbol not in ROTATION)
            )
        ]


@frozen
class Analysis:
    """One competitor."""

    name: str  #: As the study calls it.
    owner: str  #: The accelerometer of a two-stage analysis; empty for the joint fit of all.
    request: TwoStageRequest | JointRequest  #: What is asked of the method.
    #: The joint fit of the same campaign, which finds the noise that nobody states.
    joint: JointRequest


def analyses_of(study: StudyDescription) -> tuple[Analysis, ...]:
    """Return what competes: a two-stage analysis is one for each accelerometer."""
    analyses = []
    for described in study.analyses:
        name, options, campaign = described.name, described.two_stage, described.campaign
        problem = JointProblem(campaign)
        joint = JointRequest(problem.model, problem.noise)
        if options is None:
            analyses.append(Analysis(name, "", joint, joint))
            continue
        if campaign.angle is None:
            raise NotIdentifiableError(
                f"{name}: a study of the two-stage method needs a recorded angle ([records] "
                "angle); without it study the joint fit alone ([study.analyses])"
            )
        for owner, accelerometer in campaign.accelerometers.items():
            request = request_of(problem, accelerometer, options)
            analyses.append(Analysis(name, owner, request, joint))
    return tuple(analyses)
