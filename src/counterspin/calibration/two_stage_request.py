"""From a campaign to the two-stage method's request: what is known beforehand, which noise.

- `request_of`
"""

from __future__ import annotations

import math

from counterspin.calibration.options import TwoStageOptions
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.resolved import Accelerometer, Campaign
from counterspin.errors import NotIdentifiableError
from counterspin.inference.two_stage.request import TwoStageRequest
from counterspin.inference.two_stage.strobes import strobe_angle


def request_of(
    campaign: Campaign, accelerometer: Accelerometer, options: TwoStageOptions
) -> TwoStageRequest:
    """Return what a campaign asks of the two-stage method for one accelerometer.

    Parameters
    ----------
    campaign, accelerometer
        The description and one of its accelerometers.
    options
        How the method is applied.

    Raises
    ------
    NotIdentifiableError
        If the accelerometer's record is not a displacement along a horizontal axis.
    """
    if accelerometer.observable != "displacement":
        raise NotIdentifiableError(
            f"{accelerometer.name}: the two-stage method needs the displacement, and this record "
            f"is of {accelerometer.observable.replace('_', ' ')}; use the joint method"
        )
    for run in campaign.runs:
        strobe_angle(accelerometer.mounting.turned(run.attitude).input_axis)
    model = campaign.model
    known: dict[str, Quantity] = dict(accelerometer.priors)
    known |= {s: q for s, q in model.priors.items() if s in (*model.terms, *model.considered)}
    sigma, walk = _noise(campaign, options)
    return TwoStageRequest(
        model=options.model,
        priors={symbol: (quantity.value, quantity.u) for symbol, quantity in known.items()},
        fit_bias=options.fit_bias,
        nominal_angle=campaign.angle is None,
        ripple=options.ripple,
        weighted=options.weighted,
        sigma=sigma,
        random_walk=walk,
        u_radius=campaign.radius.u / campaign.radius.value,
        u_gravity=campaign.gravity.u / campaign.gravity.value,
    )


def _noise(campaign: Campaign, options: TwoStageOptions) -> tuple[float | None, float]:
    """Return the displacement noise of a sample (None: from residuals) and the random walk."""
    noise = campaign.noise
    if noise is None or options.from_residuals:
        return None, 0.0
    walk = noise.acceleration if isinstance(noise.acceleration, float) else 0.0
    step = noise.quantisation if isinstance(noise.quantisation, float) else 0.0
    if not isinstance(noise.displacement, float):
        return None, walk
    sigma = math.hypot(noise.displacement, step / math.sqrt(12.0))
    return sigma or None, walk
