"""The readings and poses of one trial: simulated without linearisation."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.campaign.description import Campaign
from counterspin.campaign.noise_at_rest import true_noise
from counterspin.campaign.readings import Reading
from counterspin.campaign.triads.grouped import one_group
from counterspin.frozen import frozen
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.linear_readings import INPUT_STEPS, Readings, with_input
from counterspin.inference.poses import TriadPoses, indications_along
from counterspin.physics.terms import shown_by_readings
from counterspin.records.mean import stretches
from counterspin.simulation.readings import (
    head_errors,
    indications,
    numbered_groups,
    true_directions,
    true_poses,
)
from counterspin.studies.draws import Draws


@frozen
class DrawnPoses:
    """Poses of a triad whose attitudes the analysis does not know."""

    group: TriadPoses  #: As the fit takes them, with what is indicated without noise.
    along: Array  #: True directions of the specific force, shape (n, 3).
    noise: Array  #: True standard deviation of each indication, g, shape (n, 3).


_NO_NOISE: Final = "the readings have no noise, so that results do not scatter"


@frozen
class TrialReadings:
    """What is read of a campaign in each trial."""

    readings: tuple[Reading, ...]  #: Of the campaign, m of them, in its order.
    #: The same as the fit takes them, with the places of each.
    grouped: tuple[tuple[Readings, tuple[int, ...]], ...]
    noise: Array  #: True standard deviation of the mean of each reading's repeats, g, shape (m,).
    #: Degrees of freedom of an uncertainty that is found anew in each trial, as that of a record
    #: is; infinite where it is stated; shape (m,).
    scattered: Array
    poses: tuple[DrawnPoses, ...]  #: Poses at unknown attitudes beside them.

    @classmethod
    def of(cls, campaign: Campaign) -> TrialReadings:
        """Return what is read of a campaign; raise ValueError if it has no noise."""
        assert campaign.simulation is not None
        known = campaign.simulation.truth.reading_noise
        readings, noise, scattered = [], [], []
        for reading in campaign.readings:
            own = known.get(reading.accelerometer)
            true = (reading.u or 0.0) if own is None else own / math.sqrt(reading.repeats)
            dof = math.inf
            if reading.record is not None:
                true, dof = _of_record(campaign, reading)
            if true <= 0.0 and reading.u is None:
                raise ValueError(f"{_NO_NOISE}: {reading.name}")
            # What is drawn is not rounded.
            own_u = true if math.isfinite(dof) else reading.u
            readings.append(replace(reading, value=0.0, u=own_u, resolution=0.0))
            noise.append(true)
            scattered.append(dof)
        ready = replace(campaign, readings=tuple(readings))
        return cls(
            ready.readings,
            tuple((group, tuple(places)) for group, places in numbered_groups(ready)),
            np.array(noise),
            np.array(scattered),
            tuple(_drawn_poses(campaign)),
        )

    def groups(
        self, draws: Draws, generator: np.random.Generator, model: Unknowns
    ) -> list[Readings | TriadPoses]:
        """Return what one trial reads, as the fit takes it."""
        return [*self._read(draws, generator, model), *self._posed(draws, generator)]

    @property
    def with_true_noise(self) -> list[Readings | TriadPoses]:
        """Readings and poses, each with its true standard deviation as its uncertainty."""
        readings = [
            replace(group, u=np.maximum(self.noise[list(places)], 1e-15))
            for group, places in self.grouped
        ]
        poses = [replace(own.group, u=np.maximum(own.noise, 1e-15)) for own in self.poses]
        return [*readings, *poses]

    def _posed(self, draws: Draws, generator: np.random.Generator) -> Iterator[TriadPoses]:
        """Yield the poses of one trial."""
        true = {key: float(value.mean()) for key, value in draws.values.items()}
        for own in self.poses:
            group = own.group
            coefficients = [
                {symbol: value for (owner, symbol), value in true.items() if owner == name}
                for name in group.accelerometers
            ]
            value = indications_along(group, coefficients, own.along)
            gravity = float(draws.off("site.gravity")[0])
            value = value * (1.0 + group.in_si * gravity / group.gravity)
            value = value + own.noise * generator.standard_normal(value.shape)
            repeats = group.repeats[:, None]
            again = 2.0 * generator.standard_gamma(np.tile(0.5 * (repeats - 1.0), 3))
            scatter = np.sum(again * own.noise**2 * repeats, axis=1)
            yield replace(group, value=value, scatter=scatter)

    def _read(
        self, draws: Draws, generator: np.random.Generator, model: Unknowns
    ) -> Iterator[Readings]:
        """Yield the readings of one trial."""
        errors = head_errors(self.readings, generator)
        noise = self.noise * generator.standard_normal(self.noise.size)
        true = {key: float(value.mean()) for key, value in draws.values.items()}
        machine = {
            symbol: value
            for (owner, symbol), value in true.items()
            if not owner and shown_by_readings(symbol)
        }
        off = {symbol: float(draws.off(symbol)[0]) for symbol in INPUT_STEPS}
        known = {other.symbol for other in (*model.unknowns, *model.considered)}
        for group, places in self.grouped:
            at = list(places)
            own = {s: value for (owner, s), value in true.items() if owner == group.accelerometer}
            # The analysis assumes what is stated of the inputs, whatever is true.
            actual = group
            for symbol, by in off.items():
                actual = with_input(actual, symbol, by, known | machine.keys())
            value = indications(actual, own, machine, errors[at])
            value = value * (1.0 + group.in_si * off["site.gravity"] / group.site.gravity)
            value = value + noise[at]
            one = replace(group, value=value)
            if group.u is None:
                repeats = group.repeats - 1.0
                scatter = 2.0 * generator.standard_gamma(0.5 * repeats)
                variances = self.noise[at] ** 2 * group.repeats
                one = replace(one, scatter=scatter * variances)
            elif np.isfinite(self.scattered[at]).any():
                dof = np.where(np.isfinite(self.scattered[at]), self.scattered[at], 1.0)
                sigma = self.noise[at] * np.sqrt(2.0 * generator.standard_gamma(0.5 * dof) / dof)
                one = replace(one, u=np.where(np.isfinite(self.scattered[at]), sigma, group.u))
            yield one


def _drawn_poses(campaign: Campaign) -> Iterator[DrawnPoses]:
    """Yield the poses of a campaign, those that state their noise and the others."""
    assert campaign.simulation is not None
    poses, along = true_poses(campaign), true_directions(campaign)
    known = campaign.simulation.truth.reading_noise
    for kind in (True, False):
        places = [
            place
            for place, pose in enumerate(poses)
            if all(one.u is not None for one in pose) is kind
        ]
        if not places:
            continue
        noise = np.array(
            [
                [
                    known[one.accelerometer] / math.sqrt(one.repeats)
                    if one.accelerometer in known
                    else one.u or 0.0
                    for one in poses[place]
                ]
                for place in places
            ]
        )
        if not kind and not noise.all():
            raise ValueError(f"{_NO_NOISE}: {poses[places[0]][0].name}")
        # What is drawn is not rounded.
        group = replace(one_group(campaign, [poses[place] for place in places]), resolution=0.0)
        yield DrawnPoses(group, along[places], noise)


def _of_record(campaign: Campaign, reading: Reading) -> tuple[float, float]:
    """Return the standard deviation of a record's mean, g, and the freedom of what it shows."""
    assert campaign.simulation is not None
    duration = reading.duration or 0.0
    noise, rate = true_noise(campaign), campaign.simulation.sampling_rate
    turns = math.floor(duration * abs(reading.rate) / (2.0 * math.pi) + 1e-9)
    if reading.rate and turns:
        duration = turns * 2.0 * math.pi / abs(reading.rate)
    white = float(noise.specific_force) / math.sqrt(max(duration * rate, 1.0))
    walk = float(noise.acceleration) / math.sqrt(max(duration, 1.0 / rate))
    freedom = max(stretches(math.floor(duration * rate)) - 1.0, 1.0)
    return math.hypot(white, walk) / campaign.gravity.value, freedom
