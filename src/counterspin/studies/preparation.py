"""From a study's description to what its engine needs.

- `world_of`: what is simulated
- `truth_of`: what is true, fixed and varying
- `analyses_of`: what competes
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.joint_problem import model_of, noise_of
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.resolved import Campaign
from counterspin.errors import CampaignError, NotIdentifiableError
from counterspin.inference.two_stage.second_stage import RIPPLE
from counterspin.inference.two_stage.strobes import strobe_angle
from counterspin.physics.accelerometer import TERMS
from counterspin.studies.choice import Analysis
from counterspin.studies.description import AnalysisDescription, StudyDescription
from counterspin.studies.draws import StudyTruth
from counterspin.studies.full import Instrumented
from counterspin.studies.joint import JointAnalysis
from counterspin.studies.two_stage import TwoStage

_NOTHING: Final = (0.0, math.inf)


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
                "force, `counterspin plan --check` predicts u, and `simulate` with `calibrate` "
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
    found = []
    for one in study.analyses:
        if one.method == "joint":
            what = JointAnalysis(model_of(one.campaign), noise_of(one.campaign))
            found.append(Analysis(one.name, "", what))
            continue
        for name in one.campaign.accelerometers:
            found.append(Analysis(one.name, name, _two_stage(one, name)))
    return tuple(found)


def _two_stage(one: AnalysisDescription, name: str) -> TwoStage:
    campaign = one.campaign
    accelerometer = campaign.accelerometers[name]
    for run in campaign.runs:
        strobe_angle(accelerometer.mounting.turned(run.attitude).input_axis)
    if campaign.angle is None:
        raise NotIdentifiableError(
            f"{one.name}: a study of the two-stage method needs a recorded angle ([records] "
            "angle); without it study the joint fit alone ([study.analyses])"
        )
    asked = (*campaign.model.terms, *campaign.model.considered)
    quantities: dict[str, Quantity] = dict(accelerometer.priors)
    quantities |= {s: q for s, q in campaign.model.priors.items() if s in asked}
    priors = {symbol: (q.value, q.u) for symbol, q in quantities.items()}
    scale_factor = priors.pop("K_I", (TERMS["K_I"].nominal, 0.0))
    bias = priors.pop("K_F", _NOTHING)
    unknowns = {"K_II": priors.pop("K_II", _NOTHING)}
    if one.model == "exact" and one.fit_bias and bias[1] > 0.0:
        unknowns["K_F"] = bias
    else:
        priors["K_F"] = (bias[0], bias[1] if math.isfinite(bias[1]) else 0.0)
    if one.model == "as-printed":
        unknowns[RIPPLE] = _NOTHING
    sigma, walk = _noise(campaign, one)
    return TwoStage(
        model=one.model,
        weighted=one.weighted,
        ripple=one.ripple,
        unknowns=unknowns,
        known={"K_I": scale_factor, **priors},
        scale_factor=scale_factor[0],
        sigma=sigma,
        walk=walk,
        u_radius=campaign.radius.u / campaign.radius.value,
        u_gravity=campaign.gravity.u / campaign.gravity.value,
    )


def _noise(campaign: Campaign, one: AnalysisDescription) -> tuple[float | None, float]:
    """Return the noise that the analysis assumes, as `counterspin calibrate` does."""
    noise = campaign.noise
    if noise is None or one.sigma == "residuals":
        return None, 0.0
    walk = noise.acceleration if isinstance(noise.acceleration, float) else 0.0
    step = noise.quantisation if isinstance(noise.quantisation, float) else 0.0
    if not isinstance(noise.displacement, float):
        return None, walk
    return math.hypot(noise.displacement, step / math.sqrt(12.0)) or None, walk
