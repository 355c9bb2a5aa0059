"""Questions about statements of a description that may be slips, although they are valid.

A calibration reports each question as a finding, `simulate` and `plan` as a warning.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

import numpy as np

from counterspin.campaign.description import Campaign
from counterspin.frozen import frozen
from counterspin.physics.gravity import HEIGHTS, gravity_range
from counterspin.physics.own_velocity import NAVIGATED, AxisError, coriolis, unobserved_projection
from counterspin.physics.terms import find_symbol

#: Standard gravity, which a computer may take away at any place, m/s^2.
_STANDARD_GRAVITIES: Final = (9.80665, 9.8066, 9.8)

#: Vertical part of an input axis from which gravity that is left shows.
_VERTICAL_PART: Final = 0.05

#: Part of an unrecorded velocity from which its Coriolis acceleration shows, 1/s.
_CORIOLIS_PART: Final = 1e-7


@frozen
class Question:
    """One question."""

    code: str  #: What kind of question.
    subject: str  #: What it is about, such as ``site`` or ``Qx.K_F``.
    text: str  #: In whole sentences.


def questions(campaign: Campaign) -> list[Question]:
    """Return the questions about a campaign's description."""
    return [
        *_gravity(campaign),
        *_removed_gravity(campaign),
        *_own_velocity(campaign),
        *_exact_priors(campaign),
    ]


def _gravity(campaign: Campaign) -> Iterator[Question]:
    """Ask about a gravity that is impossible at the latitude."""
    low, high = gravity_range(campaign.site.latitude)
    margin = 3.0 * math.hypot(campaign.gravity.u, _slope(campaign) * campaign.latitude.u)
    degrees = math.degrees(campaign.site.latitude)
    removed = campaign.site.removed_gravity
    stated = [
        (
            "site",
            "Gravity",
            campaign.site.gravity,
            "Do gravity and latitude belong to the same site?",
        )
    ]
    if removed is not None and removed not in _STANDARD_GRAVITIES:
        words = "Does the computer really subtract this value?"
        stated.append(("site.removed_gravity", "The removed gravity", removed, words))
    for subject, what, gravity, question in stated:
        if low - margin <= gravity <= high + margin:
            continue
        yield Question(
            code="gravity-latitude",
            subject=subject,
            text=f"{what} of {gravity:.6g} m/s^2 does not agree with latitude {degrees:.4g} deg. "
            f"At this latitude and heights from {HEIGHTS[0]:.0f} to {HEIGHTS[1]:.0f} m, "
            f"gravity is {low:.4f} to {high:.4f} m/s^2. {question}",
        )


def _removed_gravity(campaign: Campaign) -> Iterator[Question]:
    """Ask for the subtracted gravity if gravity is not known exactly, where it matters."""
    if campaign.site.removed_gravity is not None or campaign.gravity.u == 0.0:
        return
    for name, accelerometer in campaign.accelerometers.items():
        upright = [
            run.name
            for run in campaign.runs
            if abs(accelerometer.mounting.turned(run.attitude).input_axis[2]) > _VERTICAL_PART
        ]
        if not upright or accelerometer.observable == "specific_force":
            continue
        runs = f"run {upright[0]}" if len(upright) == 1 else f"{len(upright)} runs"
        yield Question(
            code="removed-gravity",
            subject=f"{name}.K_I",
            text=f"{name} is upright in {runs}, so its {accelerometer.observable} contains the "
            "gravity that the navigation computer does not remove. Gravity is known only to "
            f"within {campaign.gravity.u:.2g} m/s^2. counterspin assumes that the computer "
            "removes gravity exactly; if the computer removes a fixed value, state this value "
            "as removed_gravity in [site].",
        )


def _own_velocity(campaign: Campaign) -> Iterator[Question]:
    """Ask for the unrecorded part of the velocity that a computer has used as its own."""
    if not campaign.own_velocity:
        return
    none = np.empty(0)
    turn = coriolis(campaign.site)
    lacking: dict[str, float] = {}
    for run in campaign.runs:
        axes = {
            name: AxisError(a.mounting.turned(run.attitude).input_axis, a.observable, none, none)
            for name, a in campaign.accelerometers.items()
        }
        away = unobserved_projection(list(axes.values()))
        for name, axis_component in axes.items():
            if axis_component.observable in NAVIGATED:
                coupled = float(np.linalg.norm(axis_component.input_axis @ turn @ away))
                lacking[name] = max(coupled, lacking.get(name, 0.0))
    if not lacking:
        yield Question(
            code="unrecorded-axis",
            subject="records.reference",
            text='reference = "own velocity" has no effect here: no Coriolis acceleration is '
            "removed from a specific force. Omit this key, or record displacement or velocity.",
        )
    for name, coupled in lacking.items():
        if coupled > _CORIOLIS_PART:
            # The parabola that fits best to a t^3 over T has 3/2 T of it.
            moved = 1e-3 * coupled * 100.0 / 2.0
            yield Question(
                code="unrecorded-axis",
                subject=f"{name}.K_F",
                text=f"The computer's velocity along unrecorded directions affects {name} and "
                "is assumed to be free of errors. An error of 1 mg in such a direction "
                f"shifts K_F by {moved:.1g} g in a run of 100 s. Record all three axes in "
                "the same run.",
            )


def _slope(campaign: Campaign) -> float:
    """Return the change of gravity with latitude, m/s^2/rad."""
    latitude, step = campaign.site.latitude, 1e-4
    ahead, behind = (gravity_range(latitude + change)[0] for change in (step, -step))
    return (ahead - behind) / (2.0 * step)


def _exact_priors(campaign: Campaign) -> Iterator[Question]:
    """Ask about coefficients that are stated without an uncertainty."""
    stated = {
        f"{name}.{symbol}": prior
        for name, accelerometer in campaign.accelerometers.items()
        for symbol, prior in accelerometer.priors.items()
    }
    for subject, prior in {**stated, **campaign.model.priors}.items():
        if prior.u == 0.0:
            value = f"{prior.value:.9g}"
            assumed = campaign.model.assumes(find_symbol(subject))
            taken = (
                "as exact, because it is listed in model.assume"
                if assumed
                else "with the default uncertainty"
            )
            yield Question(
                code="exact-prior",
                subject=subject,
                text=f"{subject} is stated as {value} {prior.unit} without an uncertainty and "
                f'is therefore used {taken}. How accurately is it known? Write "{value} ± '
                f'U {prior.unit}".',
            )
