"""Trials simulated without any shortcut, sample by sample, and analysed as `calibrate` does.

The check of the faster engines, and the only one for readings, for noise that is not white or not
stated, for a rotation that the joint fit has to find, and for terms with a kink.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from counterspin.arrays import Array
from counterspin.campaign.description import Campaign
from counterspin.campaign.reading import MeasuredRate, Reading
from counterspin.frozen import frozen
from counterspin.inference.joint.estimation import correct_series, estimate
from counterspin.inference.joint.series import CLOCK, TIMING, ResidualSeries
from counterspin.inference.joint.time_stamps import find_stamp_errors
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.two_stage.first_stage import Strobes, by_angle, strobe_angle
from counterspin.inference.two_stage.model import TwoStageRequest
from counterspin.inference.two_stage.second_stage import (
    StrobedRun,
    second_stage,
    with_estimated_noise,
)
from counterspin.physics import observation, simulation
from counterspin.physics.motion import encoder_error
from counterspin.physics.spindle import Spindle, SpindleFit, fit_spindle
from counterspin.physics.terms import affects_readings, symbol_of
from counterspin.readings.groups import numbered_groups
from counterspin.readings.joint_data import estimate_with_groups
from counterspin.readings.known_attitudes import INPUT_STEPS, Readings, with_input
from counterspin.readings.means import segment_count
from counterspin.simulation.readings import (
    apply_rates,
    draw_by_run,
    head_errors,
    indications,
    true_directions,
    true_poses,
    true_rates,
)
from counterspin.studies.draws import NOISE_LEVELS, Draws, of_run
from counterspin.studies.work import JointRequest, Trials
from counterspin.studies.world import World, noise_of_mean
from counterspin.triads.groups import make_group
from counterspin.triads.poses import TriadPoses, predict_indications


class Rotation(NamedTuple):
    """The rotation of a run in one trial, as the analysis has it."""

    spindle: Spindle
    fit: SpindleFit | None = None  #: To the recorded angle; None: exact, or nobody recorded it.


@frozen
class TrialRecords:
    """The records of all runs in one trial."""

    world: World  #: With this trial's noise.
    draws: Draws  #: What is true in it.
    generator: np.random.Generator  #: Draws the noise.

    @classmethod
    def of(cls, world: World, draws: Draws, generator: np.random.Generator) -> TrialRecords:
        """Return the records of a trial, with the levels of noise that are true in it."""
        levels = {NOISE_LEVELS[symbol][1]: float(level[0]) for symbol, level in draws.noise.items()}
        noise = replace(world.noise, white=float(draws.white[0]), **levels)
        return cls(replace(world, noise=noise), draws, generator)

    def series(self) -> list[ResidualSeries]:
        """Return the records of all runs and accelerometers."""
        world = self.world
        series = []
        for run in range(len(world.runs)):
            spindle = self.draws.spindle(world.spindles[run], run)
            times = world.times(run)
            shown = times * self._clock(run)
            stamped = world.noise.stamps(self.generator, shown)
            rotation = self._identified(run, spindle, stamped, times)
            identified = rotation.spindle
            for name in world.mountings:
                signal = self._recorded(run, name, spindle, times)
                assumed = world.trajectory(run, identified)
                error = signal - observation.reference(
                    assumed,
                    world.mountings[name],
                    stamped,
                    world.observables[name],
                    world.attitudes[run],
                )
                record = world.series(run, name, identified, stamped, error)
                series.append(self._with_stamps(record, rotation))
        return series

    def _with_stamps(self, record: ResidualSeries, rotation: Rotation) -> ResidualSeries:
        """Return a record with what its angle shows of the time stamps, as `calibrate` has it."""
        if rotation.fit is None:
            return record
        stated = self.world.stated_times
        stamps = find_stamp_errors(rotation.fit, record.time, record.count, stated)
        if stamps is None:
            return record
        record = replace(record, angle_error=rotation.fit.error, timestamp_errors=stamps)
        return record.correct_times(stamps.prior[0])

    def strobed_run(self, run: int, name: str, request: TwoStageRequest) -> StrobedRun:
        """Return a run with one reading at each strobe."""
        world = self.world
        spindle = self.draws.spindle(world.spindles[run], run)
        # The row in which the angle passes a strobe began earlier by the angle's delay.
        passed = spindle.time_at(world.strobes(run, name)) - float(self.draws.off(TIMING)[0])
        sampled, clock = world.times(run), self._clock(run)
        identified = self._identified(run, spindle, sampled * clock, sampled).spindle
        times, noise = passed * clock, world.noise
        taken = noise.stamps(self.generator, passed) if noise.timing > 0.0 else passed
        signal = self._recorded(run, name, spindle, taken)
        assumed = world.trajectory(run, identified)
        error = signal - observation.reference(
            assumed, world.mountings[name], times, attitude=world.attitudes[run]
        )
        readings = Strobes(times, error, np.ones_like(times), 0)
        parabola = request.first_stage(readings, assumed, request.timing)
        return StrobedRun(world.runs[run], assumed, parabola, world.attitudes[run])

    def _clock(self, run: int) -> float:
        """Return the indicated time of a run's recorder over the true time."""
        return 1.0 + float(self.draws.off(CLOCK, self.world.recorders[run])[0])

    def _identified(self, run: int, true: Spindle, stamped: Array, times: Array) -> Rotation:
        """Return the rotation that a run's recorded angle shows.

        stamped: Times of the rows as they are recorded, s.
        times: The same as they were.
        """
        world, late = self.world, float(self.draws.off(TIMING)[0])
        if not world.angle_recorded:
            return Rotation(Spindle(world.spindles[run].rate))
        angle = true.angle(times + late)
        misread = encoder_error(self._values("", run), angle)
        # Drawn in any case, so that trials of other true values have the same noise of the output.
        recorded = world.noise.angles(self.generator, angle + misread)
        if world.noise.angle == 0.0 and not misread.any() and np.array_equal(stamped, times + late):
            return Rotation(true)
        fit = fit_spindle(stamped, recorded, world.spindles[run].rate)
        return Rotation(fit.spindle, fit)

    def _recorded(self, run: int, name: str, spindle: Spindle, times: Array) -> Array:
        """Return the noisy output at the times."""
        world = self.world
        signal = simulation.simulate_record(
            world.true_trajectory(run, spindle, self.draws),
            world.mountings[name],
            self._values(name, run),
            self._values("", run),
            times,
            world.observables[name],
            attitude=world.attitudes[run],
        )
        if name in world.in_g:
            # In g of the true gravity, and read with the stated one.
            stated = world.site.gravity
            signal = signal * (stated / (stated + float(self.draws.off("site.gravity")[0])))
        return world.noise.signals(
            self.generator,
            times,
            signal,
            world.observables[name],
            world.conditions[run].start,
        )

    def _values(self, owner: str, run: int) -> dict[str, float]:
        """Return the true values of an accelerometer in a run, or of the shared terms."""
        return {
            symbol: float(of_run(values, run)[0])
            for (key_owner, symbol), values in self.draws.values.items()
            if key_owner == owner
        }


@frozen
class DrawnPoses:
    """Poses of a triad whose attitudes the analysis does not know."""

    group: TriadPoses  #: As the fit takes them, with the noise-free indications.
    along: Array  #: True directions of the specific force, shape (n, 3).
    noise: Array  #: True standard deviation of each indication, g, shape (n, 3).


_NO_NOISE: Final = "the readings have no noise, so that results do not scatter"


@frozen
class TrialReadings:
    """The readings of a campaign in each trial."""

    readings: tuple[Reading, ...]  #: Of the campaign, m of them, in its order.
    #: The same as the fit takes them, with the places of each.
    grouped: tuple[tuple[Readings, tuple[int, ...]], ...]
    noise: Array  #: True standard deviation of the mean of each reading's repeats, g, shape (m,).
    #: Degrees of freedom of an uncertainty that each trial estimates again, as that of a record
    #: is; infinite where it is stated; shape (m,).
    scattered: Array
    poses: tuple[DrawnPoses, ...]  #: Poses at unknown attitudes, in addition.
    rates: Array  #: True rate of each reading, rad/s, shape (m,).

    @classmethod
    def of(cls, campaign: Campaign) -> TrialReadings:
        """Return the readings of a campaign; raise ValueError if they have no noise."""
        assert campaign.simulation is not None
        known, rates = campaign.simulation.truth.reading_noise, true_rates(campaign)
        readings, noise, scattered = [], [], []
        for reading, rate in zip(campaign.readings, rates.tolist(), strict=True):
            stated_noise = known.get(reading.accelerometer)
            true = (
                (reading.u or 0.0)
                if stated_noise is None
                else stated_noise / math.sqrt(reading.repeats)
            )
            dof = math.inf
            if reading.record is not None:
                true, dof = _record_noise(campaign, reading)
            if true <= 0.0 and reading.u is None:
                raise ValueError(f"{_NO_NOISE}: {reading.name}")
            # Drawn values are not rounded.
            own_u = true if math.isfinite(dof) else reading.u
            # An angle shows the true rate; of its noise, u of the rate is negligible.
            measured = MeasuredRate(rate, 0.0) if reading.by_clock else None
            readings.append(replace(reading, value=0.0, u=own_u, resolution=0.0, measured=measured))
            noise.append(true)
            scattered.append(dof)
        ready = replace(campaign, readings=tuple(readings))
        return cls(
            ready.readings,
            tuple(
                (group, tuple(places)) for group, places in numbered_groups(ready, ready.readings)
            ),
            np.array(noise),
            np.array(scattered),
            tuple(_drawn_poses(campaign)),
            rates,
        )

    def groups(
        self, draws: Draws, generator: np.random.Generator, model: Unknowns
    ) -> list[Readings | TriadPoses]:
        """Return the readings of one trial, as the fit takes them."""
        return [*self._read(draws, generator, model), *self._draw_poses(draws, generator)]

    @property
    def with_true_noise(self) -> list[Readings | TriadPoses]:
        """Readings and poses, each with its true standard deviation as its uncertainty."""
        readings = [
            replace(group, u=np.maximum(self.noise[list(places)], 1e-15))
            for group, places in self.grouped
        ]
        poses = [replace(drawn.group, u=np.maximum(drawn.noise, 1e-15)) for drawn in self.poses]
        return [*readings, *poses]

    def _draw_poses(self, draws: Draws, generator: np.random.Generator) -> Iterator[TriadPoses]:
        """Yield the poses of one trial."""
        true = {key: float(value.mean()) for key, value in draws.values.items()}
        for drawn in self.poses:
            group = drawn.group
            coefficients = [
                {symbol: value for (owner, symbol), value in true.items() if owner == name}
                for name in group.accelerometers
            ]
            value = predict_indications(group, coefficients, drawn.along)
            gravity = float(draws.off("site.gravity")[0])
            value = value * (1.0 + group.in_si * gravity / group.gravity)
            value = value + drawn.noise * generator.standard_normal(value.shape)
            repeats = group.repeats[:, None]
            again = 2.0 * generator.standard_gamma(np.tile(0.5 * (repeats - 1.0), 3))
            scatter = np.sum(again * drawn.noise**2 * repeats, axis=1)
            yield replace(group, value=value, scatter=scatter)

    def _read(
        self, draws: Draws, generator: np.random.Generator, model: Unknowns
    ) -> Iterator[Readings]:
        """Yield the readings of one trial."""
        errors = head_errors(self.readings, generator)
        uncertain = any(np.any(group.u_rate) for group, _ in self.grouped)
        of_rates = draw_by_run(self.readings, generator) if uncertain else np.zeros_like(errors)
        noise = self.noise * generator.standard_normal(self.noise.size)
        true = {key: float(value.mean()) for key, value in draws.values.items()}
        machine = {
            symbol: value
            for (owner, symbol), value in true.items()
            if not owner and affects_readings(symbol)
        }
        off = {symbol: float(draws.off(symbol)[0]) for symbol in INPUT_STEPS}
        # A radius with its default prior is a deviation from that of the centrifuge.
        everything = (*model.unknowns, *model.considered)
        known = {*machine, *(parameter.symbol for parameter in everything)}
        known -= {parameter.symbol for parameter in everything if parameter.has_default_prior}
        for group, places in self.grouped:
            at = list(places)
            coefficients = {
                s: value for (owner, s), value in true.items() if owner == group.accelerometer
            }
            # The analysis assumes the stated values of the inputs, not the true ones.
            actual = apply_rates(group, self.rates[at])
            for symbol, by in off.items():
                actual = with_input(actual, symbol, by, known)
            for name in dict.fromkeys(filter(None, group.clocks)):
                symbol = symbol_of(name)
                fast = draws.off(symbol, name.removesuffix(symbol).removesuffix("."))[0]
                actual = with_input(actual, name, float(fast), known)
            actual = actual.with_rate_errors(of_rates[at] * group.u_rate)
            value = indications(actual, coefficients, machine, errors[at])
            value = value * (1.0 + group.in_si * off["site.gravity"] / group.site.gravity)
            value = value + noise[at]
            result = replace(group, value=value)
            if group.u is None:
                repeats = group.repeats - 1.0
                scatter = 2.0 * generator.standard_gamma(0.5 * repeats)
                variances = self.noise[at] ** 2 * group.repeats
                result = replace(result, scatter=scatter * variances)
            elif np.isfinite(self.scattered[at]).any():
                dof = np.where(np.isfinite(self.scattered[at]), self.scattered[at], 1.0)
                sigma = self.noise[at] * np.sqrt(2.0 * generator.standard_gamma(0.5 * dof) / dof)
                result = replace(
                    result, u=np.where(np.isfinite(self.scattered[at]), sigma, group.u)
                )
            yield result


def _drawn_poses(campaign: Campaign) -> Iterator[DrawnPoses]:
    """Yield the poses of a campaign, those that state their noise and the others."""
    assert campaign.simulation is not None
    poses, along = true_poses(campaign), true_directions(campaign)
    known = campaign.simulation.truth.reading_noise
    for kind in (True, False):
        places = [
            place
            for place, pose in enumerate(poses)
            if all(reading.u is not None for reading in pose) is kind
        ]
        if not places:
            continue
        noise = np.array(
            [
                [
                    known[reading.accelerometer] / math.sqrt(reading.repeats)
                    if reading.accelerometer in known
                    else reading.u or 0.0
                    for reading in poses[place]
                ]
                for place in places
            ]
        )
        if not kind and not noise.all():
            raise ValueError(f"{_NO_NOISE}: {poses[places[0]][0].name}")
        # Drawn values are not rounded.
        group = replace(make_group(campaign, [poses[place] for place in places]), resolution=0.0)
        yield DrawnPoses(group, along[places], noise)


def _record_noise(campaign: Campaign, reading: Reading) -> tuple[float, float]:
    """Return the standard deviation of a record's mean, g, and its degrees of freedom."""
    assert campaign.simulation is not None
    duration = reading.duration or 0.0
    rate = campaign.simulation.sampling_rate
    turns = math.floor(duration * abs(reading.rate) / (2.0 * math.pi) + 1e-9)
    if reading.rate and turns:
        duration = turns * 2.0 * math.pi / abs(reading.rate)
    freedom = max(segment_count(math.floor(duration * rate)) - 1.0, 1.0)
    return noise_of_mean(campaign, duration), freedom


@frozen
class FullEngine:
    """Trials of any analysis, one by one."""

    world: World | None  #: What is simulated of records; None: there are none.
    request: TwoStageRequest | JointRequest  #: Options of the analysis.
    joint: JointRequest  #: The joint fit that estimates noise that is not stated.
    owner: str = ""  #: The accelerometer of a two-stage analysis.
    rows: tuple[int, ...] = ()  #: Places of the joint model's unknowns that are reported.
    readings: TrialReadings | None = None  #: Of a joint analysis; None: there are none.

    def trials(self, draws: Draws, generator: np.random.Generator) -> Trials:
        """Return the results of the analysis for n trials; see `Engine`."""
        made = [self._trial(draws.take(place), generator) for place in range(draws.trials)]
        return Trials(*(np.array(part).T for part in zip(*made, strict=True)))

    def _trial(self, draws: Draws, generator: np.random.Generator) -> tuple[Array, Array, Array]:
        """Return estimate, u and degrees of freedom of one trial, shape (c,) each."""
        records = None if self.world is None else TrialRecords.of(self.world, draws, generator)
        if isinstance(self.request, TwoStageRequest):
            assert records is not None
            return self._two_stage(self.request, records)
        model, estimated = self.request.model, None
        if records is not None:
            estimated = estimate(records.series(), model, self.request.noise)
        if self.readings is not None:
            groups = self.readings.groups(draws, generator, model)
            estimated, _ = estimate_with_groups(estimated, model, groups)
        assert estimated is not None
        solution, unknowns = estimated.fit.solution, estimated.fit.model.unknowns
        rows = list(self.rows)
        nominal = np.array([unknowns[i].nominal for i in rows])
        return solution.estimate[rows] + nominal, solution.u[rows], estimated.dof[rows]

    def _two_stage(
        self, request: TwoStageRequest, records: TrialRecords
    ) -> tuple[Array, Array, Array]:
        world, components = records.world, None
        scattered = world.noise.timing > 0.0 or world.stated_times[0] > 0.0
        corrects = world.angle_recorded and scattered
        if request.random_walk is None or corrects:
            series = tuple(records.series())
            if request.random_walk is None:
                estimated = estimate(series, self.joint.model, self.joint.noise)
                components = estimated.estimated_noise[self.owner]
                request = request.with_noise(components.noise)
                corrected = estimated.series
            else:
                corrected = correct_series(series, self.joint.model, self.joint.noise)
            runs = [
                _strobed(
                    record.correct_times(other.corrected_fraction).with_timestamp_noise(
                        other.timestamp_sd
                    ),
                    request,
                )
                for record, other in zip(series, corrected, strict=True)
                if record.accelerometer == self.owner
            ]
        else:
            runs = [records.strobed_run(run, self.owner, request) for run in range(len(world.runs))]
        second = second_stage(runs, world.mountings[self.owner], request, ignored=())
        if components is not None:
            second = with_estimated_noise(second, components.noise, components)
        solution = second.fit.solution
        return solution.estimate, solution.u, np.asarray(second.dof)


def _strobed(record: ResidualSeries, request: TwoStageRequest) -> StrobedRun:
    """Return a run whose strobes are read from its whole record, as `calibrate` does."""
    phase = strobe_angle(record.mounting.turned(record.attitude).input_axis)
    angle = record.trajectory.spindle.angle(record.time)
    strobes = by_angle(record.time, angle, record.error, phase)
    parabola = request.first_stage(strobes, record.trajectory, record.timestamp_sd)
    return StrobedRun(record.run, record.trajectory, parabola, record.attitude)
