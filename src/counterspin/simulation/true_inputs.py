"""The uncertain inputs as they truly are, where [truth] says otherwise than the description."""

from __future__ import annotations

from dataclasses import replace

from counterspin.campaign.description import Campaign
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.runs import Run
from counterspin.inference.joint.inputs import CLOCK, TIMING
from counterspin.inference.linear_readings import Readings, with_input
from counterspin.records.record import ColumnSpec


def with_true_inputs(campaign: Campaign) -> Campaign:
    """Return the campaign with radius, gravity, latitude and delay of the angle as they truly are.

    Its columns and clocks stay as the description has them: with these its records are read.
    """
    assert campaign.simulation is not None
    true = campaign.simulation.truth.inputs
    gravity, latitude, radius = (
        replace(stated, value=true.get(("", symbol), stated.value))
        for symbol, stated in (
            ("site.gravity", campaign.gravity),
            ("site.latitude", campaign.latitude),
            ("centrifuge.radius", campaign.radius),
        )
    )
    late = true.get(("", TIMING))
    return replace(
        campaign,
        site=replace(campaign.site, gravity=gravity.value, latitude=latitude.value),
        gravity=gravity,
        latitude=latitude,
        radius=radius,
        timing_offset=campaign.timing_offset if late is None else Quantity(late, 0.0, "s"),
    )


def at_true_inputs(campaign: Campaign, group: Readings) -> Readings:
    """Return readings where radius, gravity and latitude are what they truly are.

    The radius of a mounting that is a term of its own is no matter of the centrifuge's.
    """
    assert campaign.simulation is not None
    true, model = with_true_inputs(campaign), campaign.model
    own = {*model.terms, *model.considered, *model.priors}
    own |= campaign.simulation.truth.machine.keys()
    for symbol, (was, stated) in {
        "centrifuge.radius": (true.radius, campaign.radius),
        "site.gravity": (true.gravity, campaign.gravity),
        "site.latitude": (true.latitude, campaign.latitude),
    }.items():
        group = with_input(group, symbol, was.value - stated.value, own)
    return group


def stamped_over_true(campaign: Campaign, run: Run) -> float:
    """Return what a recorder of this clock shows of a time, less the error that is stated of it."""
    assert campaign.simulation is not None
    recording = campaign.recording_of(run)
    stated = recording.clock.value if recording.clock else 0.0
    true = campaign.simulation.truth.inputs.get((recording.recorder, CLOCK), stated)
    return (1.0 + true) / (1.0 + stated)


def stated_over_true(campaign: Campaign, channel: ColumnSpec) -> float:
    """Return the gravity that a column is read with over the true one, in whose g an output is."""
    true = with_true_inputs(campaign).gravity.value
    return campaign.gravity.value / true if channel.in_g else 1.0
