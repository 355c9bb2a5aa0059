"""From a campaign to the two-stage method's request: what is known beforehand, which noise."""

from __future__ import annotations

import math
from collections.abc import Mapping

from counterspin.calibration.joint_problem import JointProblem
from counterspin.calibration.options import TwoStageOptions
from counterspin.campaign.accelerometers import Accelerometer
from counterspin.campaign.noise_at_rest import said_noise
from counterspin.campaign.settings import StatedNoise
from counterspin.errors import NotIdentifiableError
from counterspin.inference.joint.estimation import estimate
from counterspin.inference.noise.model import Noise
from counterspin.inference.noise.search import FoundNoise
from counterspin.inference.two_stage.request import TwoStageRequest
from counterspin.inference.two_stage.strobes import strobe_angle
from counterspin.physics.terms import OWN_TERMS, SHARED_TERMS


def request_of(
    problem: JointProblem,
    accelerometer: Accelerometer,
    options: TwoStageOptions,
    components: FoundNoise | None = None,
) -> TwoStageRequest:
    """Return what a campaign asks of the two-stage method for one accelerometer.

    `components` is noise that was found, where the campaign states none. It raises
    NotIdentifiableError if the record is not a displacement along a horizontal axis, or the bias
    wanders.
    """
    campaign, model = problem.campaign, problem.model
    if accelerometer.observable != "displacement":
        raise NotIdentifiableError(
            f"{accelerometer.name}: the two-stage method needs the displacement, and this record "
            f"is of {accelerometer.observable.replace('_', ' ')}; use the joint method"
        )
    stated = said_noise(campaign)[accelerometer.name].sizes
    if stated is not None and stated.wanders:
        raise NotIdentifiableError(
            f"{accelerometer.name}: the two-stage method cannot treat a wandering bias "
            "(noise.flicker, noise.bias_walk); use the joint method"
        )
    for run in campaign.runs:
        strobe_angle(accelerometer.mounting.turned(run.attitude).input_axis)
    priors = {
        other.symbol: other.prior
        for other in (*model.unknowns, *model.considered)
        if math.isfinite(other.prior[1])
        and other.symbol in (OWN_TERMS if other.owner == accelerometer.name else SHARED_TERMS)
    }
    noise = problem.noise[accelerometer.name]
    request = TwoStageRequest(
        model=options.model,
        priors=priors,
        fit_bias=options.fit_bias,
        nominal_angle=campaign.angle is None,
        ripple=options.ripple,
        weighted=options.weighted,
        sigma=None if options.from_residuals else _sigma(stated),
        from_residuals=options.from_residuals,
        random_walk=None if "random_walk" in noise.wanted else noise.random_walk,
        timing=_number(stated, "timing") or 0.0,
        u_radius=campaign.radius.u / campaign.radius.value,
        u_gravity=campaign.gravity.u / campaign.gravity.value,
        limits={s: campaign.limit_of(s, accelerometer.name) for s in (*OWN_TERMS, *SHARED_TERMS)},
    )
    return request if components is None else request.with_noise(components.noise)


def _sigma(noise: StatedNoise | None) -> float | None:
    """Return the displacement noise of a sample, m; None where it is not stated."""
    white = _number(noise, "displacement")
    step = _number(noise, "quantisation") or 0.0
    return None if white is None else math.hypot(white, step / math.sqrt(12.0)) or None


def _number(noise: StatedNoise | None, component: str) -> float | None:
    """Return a component of the stated noise; None where it is not a number."""
    size = getattr(noise, component, None)
    return size if isinstance(size, float) else None


def walk_is_stated(noises: Mapping[str, Noise]) -> bool:
    """Return whether the accelerometers' own noise is known, as the joint method has it.

    It is where [noise] states it, zero included; a [noise] that states no noise at all leaves
    all of it to be found.
    """
    return not any("random_walk" in noise.wanted for noise in noises.values())


def noise_found(problem: JointProblem) -> Mapping[str, FoundNoise]:
    """Return each accelerometer's noise where the random walk is not stated; else nothing.

    One sample a revolution tells little of it: it is that of the joint fit, from all samples.
    """
    if walk_is_stated(problem.noise):
        return {}
    return estimate(problem.series, problem.model, problem.noise).components
