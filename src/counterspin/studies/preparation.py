"""From a study's description to what its engine needs.

- `world_of`: what is simulated
- `truth_of`: what is true, fixed and varying
- `analyses_of`: what competes
"""

from __future__ import annotations

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.joint_problem import model_of, noise_of
from counterspin.calibration.two_stage_request import request_of
from counterspin.campaign.resolved import Campaign
from counterspin.errors import CampaignError, NotIdentifiableError
from counterspin.studies.choice import Analysis
from counterspin.studies.description import StudyDescription
from counterspin.studies.draws import StudyTruth
from counterspin.studies.full import Instrumented
from counterspin.studies.joint import JointAnalysis


def world_of(campaign: Campaign) -> Instrumented:
    """Return what is simulated.

    Raises
    ------
    CampaignError
        If an accelerometer's record is no displacement.
    """
    others = [a.name for a in campaign.accelerometers.values() if a.observable != "displacement"]
    if others:
        raise CampaignError(
            str(campaign.path),
            [
                f"accelerometers.{name}: a study needs records of displacement; for velocity or "
                "force, `forecast` predicts u, and `simulate` with `calibrate` "
                "makes one trial"
                for name in others
            ],
        )
    assert campaign.simulation is not None
    noise = campaign.simulation.truth.noise
    return Instrumented(
        runs=tuple(run.name for run in campaign.runs),
        spindles=tuple(run.truth.spindle for run in campaign.runs if run.truth),
        attitudes=tuple(run.attitude for run in campaign.runs),
        durations=tuple(run.duration for run in campaign.runs if run.duration),
        mountings={name: a.mounting for name, a in campaign.accelerometers.items()},
        site=campaign.site,
        radius=campaign.radius.value,
        sampling_rate=campaign.simulation.sampling_rate,
        angle_recorded=campaign.angle is not None,
        angle_noise=float(noise.angle),
        random_walk=float(noise.acceleration),
        quantisation=float(noise.quantisation),
        timing_noise=float(noise.timing),
    )


def truth_of(study: StudyDescription) -> StudyTruth:
    """Return what is true: [truth], and what the study varies in its stead."""
    campaign = study.campaign
    assert campaign.simulation is not None
    fixed: dict[tuple[str, str], Array] = {
        (name, symbol): np.array([value])
        for name, coefficients in campaign.simulation.truth.coefficients.items()
        for symbol, value in coefficients.items()
    }
    platforms = [run.truth.platform for run in campaign.runs if run.truth]
    for symbol in dict.fromkeys(symbol for platform in platforms for symbol in platform):
        fixed["", symbol] = np.array([platform.get(symbol, 0.0) for platform in platforms])
    for one in study.varying:
        fixed.pop((one.owner, one.symbol), None)
    return StudyTruth(
        fixed=fixed,
        spindles=tuple(run.truth.spindle for run in campaign.runs if run.truth),
        radius=campaign.radius.value,
        white=float(campaign.simulation.truth.noise.displacement),
        varying=study.varying,
    )


def analyses_of(study: StudyDescription) -> tuple[Analysis, ...]:
    """Return what competes: a two-stage analysis is one for each accelerometer.

    Raises
    ------
    NotIdentifiableError
        If a two-stage analysis has an accelerometer whose input axis is not horizontal.
    """
    analyses = []
    for described in study.analyses:
        name, options, campaign = described.name, described.two_stage, described.campaign
        if options is None:
            joint = JointAnalysis(model_of(campaign), noise_of(campaign))
            analyses.append(Analysis(name, "", joint))
            continue
        if campaign.angle is None:
            raise NotIdentifiableError(
                f"{name}: a study of the two-stage method needs a recorded angle ([records] "
                "angle); without it study the joint fit alone ([study.analyses])"
            )
        for owner, accelerometer in campaign.accelerometers.items():
            request = request_of(campaign, accelerometer, options)
            analyses.append(Analysis(name, owner, request))
    return tuple(analyses)
