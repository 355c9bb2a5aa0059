"""The parts of a plan's result that are read off a forecast: uncertainties, budgets, runs.

- `accelerometers_of`, `platform_of`: what the campaign will tell
- `planned_runs`: its runs as a table
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from counterspin.calibration.joint_parts import budget_lines, coefficient
from counterspin.calibration.result_parts import ConfoundedTerms
from counterspin.campaign.resolved import Campaign
from counterspin.physics.accelerometer import TERMS
from counterspin.planning.forecast import Forecast
from counterspin.planning.result import PlannedAccelerometer, PlannedRun, Predicted


def accelerometers_of(prediction: Forecast) -> dict[str, PlannedAccelerometer]:
    """Return what a campaign will tell of each accelerometer."""
    return {name: _accelerometer(prediction, name) for name in prediction.campaign.accelerometers}


def _accelerometer(prediction: Forecast, name: str) -> PlannedAccelerometer:
    unknowns = prediction.fit.model.unknowns
    own = {u.symbol: i for i, u in enumerate(unknowns) if u.owner == name and u.symbol in TERMS}
    coefficients = {symbol: _predicted(prediction, index) for symbol, index in own.items()}
    campaign = prediction.campaign
    others = [f"{other}." for other in campaign.accelerometers if other != name]
    return PlannedAccelerometer(
        coefficients={s: coefficients[s] for s in campaign.model.terms if s in coefficients},
        budget={
            symbol: budget_lines(prediction.estimate, index, name)
            for symbol, index in own.items()
            if coefficients[symbol].estimated
        },
        confounded=[
            ConfoundedTerms(
                terms=[t.removeprefix(f"{name}.") for t in item.terms],
                correlation=item.correlation,
                determined=item.determined.replace(f"{name}.", ""),
                weights=list(item.named_weights),
                u=item.u,
            )
            for item in prediction.assessment.confounded
            if not any(t.startswith(other) for t in item.terms for other in others)
        ],
    )


def platform_of(prediction: Forecast) -> dict[str, Predicted]:
    """Return what a campaign will tell of the platform's terms that all runs share."""
    return {
        unknown.symbol: _predicted(prediction, index)
        for index, unknown in enumerate(prediction.fit.model.unknowns)
        if not unknown.owner
    }


def _predicted(prediction: Forecast, index: int) -> Predicted:
    shown = coefficient(prediction.estimate, prediction.assessment, index)
    prior = prediction.fit.model.unknowns[index].prior[1]
    return Predicted(
        u=shown.u if shown.estimated else None,
        u_noise=shown.u_noise,
        u_prior=shown.u_prior,
        u_considered=shown.u_considered,
        prior=prior if math.isfinite(prior) else None,
        unit=shown.unit,
        estimated=shown.estimated,
    )


def planned_runs(
    campaign: Campaign, attitudes: Mapping[str, str], starts: Mapping[str, float] | None = None
) -> list[PlannedRun]:
    """Return a campaign's runs in their order.

    Parameters
    ----------
    campaign
        Every run with its duration.
    attitudes
        Run -> name of its attitude.
    starts
        Run -> when its record starts, s; None: not planned.
    """
    runs = []
    for run in campaign.runs:
        duration = run.duration or 0.0
        runs.append(
            PlannedRun(
                name=run.name,
                rate=run.rate,
                specific_force=campaign.radius.value * run.rate**2 / campaign.site.gravity,
                revolutions=abs(run.rate) * duration / (2.0 * math.pi),
                duration=duration,
                attitude=attitudes[run.name],
                start=None if starts is None else starts[run.name],
            )
        )
    return runs
