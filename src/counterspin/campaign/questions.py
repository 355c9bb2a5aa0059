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
from counterspin.physics.gravity import HEIGHT_RANGE, gravity_range
from counterspin.physics.own_velocity import (
    NAVIGATION_OBSERVABLES,
    AxisError,
    coriolis,
    unobserved_projection,
)
from counterspin.physics.terms import find_symbol

#: Values of standard gravity that a navigation computer may subtract at any site, m/s^2.
_STANDARD_GRAVITIES: Final = (9.80665, 9.8066, 9.8)

#: Smallest vertical component of an input axis for which residual gravity matters.
_MIN_VERTICAL_COMPONENT: Final = 0.05

#: Smallest Coriolis acceleration per unrecorded velocity that matters, 1/s.
_MIN_CORIOLIS_COUPLING: Final = 1e-7


@frozen
class Question:
    """A question about a statement of the description."""

    code: str  #: Kind of the question.
    subject: str  #: Subject, such as ``site`` or ``Qx.K_F``.
    text: str  #: Question in complete sentences.


def ask_questions(campaign: Campaign) -> list[Question]:
    """Return the questions about a campaign's description."""
    return [
        *_question_gravity(campaign),
        *_question_removed_gravity(campaign),
        *_question_own_velocity(campaign),
        *_question_exact_priors(campaign),
    ]


def _question_gravity(campaign: Campaign) -> Iterator[Question]:
    """Ask about a gravity that is impossible at the latitude."""
    min_gravity, max_gravity = gravity_range(campaign.site.latitude)
    margin = 3.0 * math.hypot(campaign.gravity.u, _gravity_gradient(campaign) * campaign.latitude.u)
    latitude_deg = math.degrees(campaign.site.latitude)
    removed_gravity = campaign.site.removed_gravity
    question = "Do gravity and latitude belong to the same site?"
    values = [("site", "Gravity", campaign.site.gravity, question)]
    if removed_gravity is not None and removed_gravity not in _STANDARD_GRAVITIES:
        question = "Does the computer really subtract this value?"
        values.append(("site.removed_gravity", "The removed gravity", removed_gravity, question))
    for subject, label, gravity, question in values:
        if min_gravity - margin <= gravity <= max_gravity + margin:
            continue
        yield Question(
            code="gravity-latitude",
            subject=subject,
            text=f"{label} of {gravity:.6g} m/s^2 does not agree with latitude "
            f"{latitude_deg:.4g} deg. At this latitude and heights from {HEIGHT_RANGE[0]:.0f} to "
            f"{HEIGHT_RANGE[1]:.0f} m, gravity is {min_gravity:.4f} to {max_gravity:.4f} m/s^2. "
            f"{question}",
        )


def _question_removed_gravity(campaign: Campaign) -> Iterator[Question]:
    """Ask for the subtracted gravity if it matters and gravity is uncertain."""
    if campaign.site.removed_gravity is not None or campaign.gravity.u == 0.0:
        return
    for name, accelerometer in campaign.accelerometers.items():
        run_names = [
            run.name
            for run in campaign.runs
            if abs(accelerometer.mounting.turned(run.attitude).input_axis[2])
            > _MIN_VERTICAL_COMPONENT
        ]
        if not run_names or accelerometer.observable == "specific_force":
            continue
        run_text = f"run {run_names[0]}" if len(run_names) == 1 else f"{len(run_names)} runs"
        yield Question(
            code="removed-gravity",
            subject=f"{name}.K_I",
            text=f"{name} is upright in {run_text}, so its {accelerometer.observable} contains the "
            "part of gravity that the navigation computer does not remove. Gravity is known only "
            f"to within {campaign.gravity.u:.2g} m/s^2. counterspin assumes that the computer "
            "removes gravity exactly; if the computer removes a fixed value, state this value as "
            "removed_gravity in [site].",
        )


def _question_own_velocity(campaign: Campaign) -> Iterator[Question]:
    """Ask for the unrecorded velocity components that the navigation computer has used."""
    if not campaign.own_velocity:
        return
    no_times = np.empty(0)
    coriolis_matrix = coriolis(campaign.site)
    couplings: dict[str, float] = {}
    for run in campaign.runs:
        axes = {
            name: AxisError(
                accelerometer.mounting.turned(run.attitude).input_axis,
                accelerometer.observable,
                no_times,
                no_times,
            )
            for name, accelerometer in campaign.accelerometers.items()
        }
        projection = unobserved_projection(list(axes.values()))
        for name, axis in axes.items():
            if axis.observable in NAVIGATION_OBSERVABLES:
                coupling = float(np.linalg.norm(axis.input_axis @ coriolis_matrix @ projection))
                couplings[name] = max(coupling, couplings.get(name, 0.0))
    if not couplings:
        yield Question(
            code="unrecorded-axis",
            subject="records.reference",
            text='reference = "own velocity" has no effect here: no Coriolis acceleration is '
            "removed from a specific force. Omit this key, or record displacement or velocity.",
        )
    for name, coupling in couplings.items():
        if coupling > _MIN_CORIOLIS_COUPLING:
            # The best parabola through a t^3 over a duration T has the coefficient 3/2 a T.
            bias_shift = 1e-3 * coupling * 100.0 / 2.0
            yield Question(
                code="unrecorded-axis",
                subject=f"{name}.K_F",
                text=f"The computer's velocity along unrecorded directions affects {name}. "
                "counterspin assumes that this velocity has no errors. An error of 1 mg along one "
                f"of these directions shifts K_F by {bias_shift:.1g} g in a run of 100 s. Record "
                "all three axes in the same run.",
            )


def _gravity_gradient(campaign: Campaign) -> float:
    """Return the change of gravity with latitude, m/s^2/rad."""
    latitude, step = campaign.site.latitude, 1e-4
    gravity_above, gravity_below = (gravity_range(latitude + offset)[0] for offset in (step, -step))
    return (gravity_above - gravity_below) / (2.0 * step)


def _question_exact_priors(campaign: Campaign) -> Iterator[Question]:
    """Ask about coefficients that are stated without an uncertainty."""
    priors_by_name = {
        f"{name}.{symbol}": prior
        for name, accelerometer in campaign.accelerometers.items()
        for symbol, prior in accelerometer.priors.items()
    }
    for subject, prior in {**priors_by_name, **campaign.model.priors}.items():
        if prior.u == 0.0:
            value = f"{prior.value:.9g}"
            is_assumed = campaign.model.assumes(find_symbol(subject))
            treatment = (
                "as exact, because it is listed in model.assume"
                if is_assumed
                else "with the default uncertainty"
            )
            yield Question(
                code="exact-prior",
                subject=subject,
                text=f"{subject} is stated as {value} {prior.unit} without an uncertainty, so "
                f'counterspin uses it {treatment}. How accurately is it known? Write "{value} ± '
                f'U {prior.unit}".',
            )
