"""Full simulation of trials, sample by sample, with the analysis of `calibrate`.

It validates the faster engines. It is the only engine for readings, for noise that is not white or
not stated, for a rotation that the joint fit estimates, and for terms with a kink.
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
from counterspin.inference.joint.time_stamps import find_timestamp_errors
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.noise.simulation import add_noise, add_white_noise
from counterspin.inference.two_stage.first_stage import Strobes, by_angle, strobe_angle
from counterspin.inference.two_stage.model import TwoStageRequest
from counterspin.inference.two_stage.second_stage import (
    StrobedRun,
    apply_noise_uncertainty,
    second_stage,
)
from counterspin.physics import observation, simulation
from counterspin.physics.motion import encoder_error
from counterspin.physics.spindle import Spindle, SpindleFit, fit_spindle
from counterspin.physics.terms import affects_readings, find_symbol
from counterspin.readings.groups import numbered_groups
from counterspin.readings.joint_data import estimate_with_groups
from counterspin.readings.known_attitudes import INPUT_STEPS, Readings, perturb_input
from counterspin.readings.means import count_segments
from counterspin.simulation.readings import (
    apply_rates,
    compute_indications,
    draw_by_run,
    head_errors,
    true_directions,
    true_poses,
    true_rates,
)
from counterspin.studies.batch_runner import JointRequest, TrialResults
from counterspin.studies.draws import Draws, run_values
from counterspin.studies.simulation_setup import SimulationSetup, mean_noise
from counterspin.triads.groups import make_group
from counterspin.triads.poses import TriadPoses, predict_indications


class RunRotation(NamedTuple):
    """The assumed rotation of a run in the analysis of a trial."""

    spindle: Spindle
    fit: SpindleFit | None = None  #: Fit to the recorded angle; None: exact, or no angle recorded.


@frozen
class TrialRecords:
    """Records of all runs in one trial."""

    setup: SimulationSetup  #: Setup with the noise of this trial.
    draws: Draws  #: True values.
    generator: np.random.Generator  #: Random generator of the noise.

    @classmethod
    def from_draws(
        cls, setup: SimulationSetup, draws: Draws, generator: np.random.Generator
    ) -> TrialRecords:
        """Return the records of the first trial, with its true noise levels."""
        noise = draws.select_trial(0).noise_sizes(setup.noise)
        return cls(replace(setup, noise=noise), draws, generator)

    def series(self) -> list[ResidualSeries]:
        """Return the records of all runs and accelerometers."""
        setup = self.setup
        series = []
        for run in range(len(setup.runs)):
            spindle = self.draws.true_spindle(setup.spindles[run], run)
            times = setup.times(run)
            indicated_times = times * self._clock_scale(run)
            timestamps = add_white_noise(self.generator, indicated_times, setup.noise["timing"])
            rotation = self._estimate_rotation(run, spindle, timestamps, times)
            assumed_spindle = rotation.spindle
            for name in setup.mountings:
                signal = self._noisy_output(run, name, spindle, times)
                assumed_trajectory = setup.trajectory(run, assumed_spindle)
                error = signal - observation.reference(
                    assumed_trajectory,
                    setup.mountings[name],
                    timestamps,
                    setup.observables[name],
                    setup.attitudes[run],
                )
                record = setup.series(run, name, assumed_spindle, timestamps, error)
                series.append(self._correct_timestamps(record, rotation))
        return series

    def _correct_timestamps(self, record: ResidualSeries, rotation: RunRotation) -> ResidualSeries:
        """Correct the time stamps of a record by the recorded angle, as in `calibrate`."""
        if rotation.fit is None:
            return record
        stated_noise = self.setup.stated_timing_noise
        errors = find_timestamp_errors(rotation.fit, record.time, record.count, stated_noise)
        if errors is None:
            return record
        record = replace(record, angle_error=rotation.fit.error, timestamp_errors=errors)
        return record.correct_times(errors.prior[0])

    def strobed_run(self, run: int, name: str, request: TwoStageRequest) -> StrobedRun:
        """Return a run with one reading at each strobe."""
        setup = self.setup
        spindle = self.draws.true_spindle(setup.spindles[run], run)
        # The angle is delayed, so that its row at a strobe began earlier.
        strobe_times = spindle.time_at(setup.strobes(run, name)) - float(
            self.draws.input_error(TIMING)[0]
        )
        row_times, clock_scale = setup.times(run), self._clock_scale(run)
        assumed_spindle = self._estimate_rotation(
            run, spindle, row_times * clock_scale, row_times
        ).spindle
        indicated_times, timing_noise = strobe_times * clock_scale, setup.noise["timing"]
        sample_times = (
            add_white_noise(self.generator, strobe_times, timing_noise)
            if timing_noise > 0.0
            else strobe_times
        )
        signal = self._noisy_output(run, name, spindle, sample_times)
        assumed_trajectory = setup.trajectory(run, assumed_spindle)
        error = signal - observation.reference(
            assumed_trajectory,
            setup.mountings[name],
            indicated_times,
            attitude=setup.attitudes[run],
        )
        strobes = Strobes(indicated_times, error, np.ones_like(indicated_times), 0)
        parabola = request.first_stage(strobes, assumed_trajectory, request.timing)
        return StrobedRun(setup.runs[run], assumed_trajectory, parabola, setup.attitudes[run])

    def _clock_scale(self, run: int) -> float:
        """Return the indicated time of a run's recorder over the true time."""
        return 1.0 + float(self.draws.input_error(CLOCK, self.setup.recorders[run])[0])

    def _estimate_rotation(
        self, run: int, true_spindle: Spindle, timestamps: Array, true_times: Array
    ) -> RunRotation:
        """Return the rotation of a run estimated from its recorded angle.

        timestamps: Recorded times of the rows, s.
        true_times: True times of the rows, s.
        """
        setup, delay = self.setup, float(self.draws.input_error(TIMING)[0])
        if not setup.has_angle:
            return RunRotation(Spindle(setup.spindles[run].rate))
        angle = true_spindle.angle(true_times + delay)
        angle_error = encoder_error(self._true_values("", run), angle)
        # Draw in any case, so that trials with other true values have the same output noise.
        recorded_angle = add_white_noise(self.generator, angle + angle_error, setup.noise["angle"])
        if (
            setup.noise["angle"] == 0.0
            and not angle_error.any()
            and np.array_equal(timestamps, true_times + delay)
        ):
            return RunRotation(true_spindle)
        fit = fit_spindle(timestamps, recorded_angle, setup.spindles[run].rate)
        return RunRotation(fit.spindle, fit)

    def _noisy_output(self, run: int, name: str, spindle: Spindle, times: Array) -> Array:
        """Return the noisy output of an accelerometer at `times`."""
        setup = self.setup
        signal = simulation.simulate_record(
            setup.true_trajectory(run, spindle, self.draws),
            setup.true_mounting(name, self.draws),
            self._true_values(name, run),
            self._true_values("", run),
            times,
            setup.observables[name],
            attitude=setup.attitudes[run],
        )
        if name in setup.accelerometers_in_g:
            # The output is in true g, and is read in stated g.
            stated_gravity = setup.site.gravity
            signal = signal * (
                stated_gravity / (stated_gravity + float(self.draws.input_error("site.gravity")[0]))
            )
        noise, order = setup.true_noise(name), observation.ORDERS[setup.observables[name]]
        return add_noise(self.generator, times, signal, noise, order, setup.conditions[run].start)

    def _true_values(self, owner: str, run: int) -> dict[str, float]:
        """Return the true values of an accelerometer in a run; owner '': of the shared terms."""
        return {
            symbol: float(run_values(values, run)[0])
            for (key_owner, symbol), values in self.draws.values.items()
            if key_owner == owner
        }


@frozen
class DrawnPoses:
    """Poses of a triad at unknown attitudes."""

    group: TriadPoses  #: Poses for the fit, with noise-free indications.
    directions: Array  #: True directions of the specific force, shape (n, 3).
    noise_sds: Array  #: True standard deviation of each indication, g, shape (n, 3).


_NO_NOISE: Final = "the readings have no noise, so the results do not scatter"


@frozen
class TrialReadings:
    """Readings of a campaign in each trial."""

    readings: tuple[Reading, ...]  #: The m readings in the order of the campaign.
    #: Groups of readings for the fit, with the indices of each group's readings.
    numbered_groups: tuple[tuple[Readings, tuple[int, ...]], ...]
    noise_sds: Array  #: True standard deviation of the mean of each reading, g, shape (m,).
    #: Degrees of freedom of the uncertainty, estimated in each trial, as for a record; infinite for
    #: a stated uncertainty; shape (m,).
    estimated_dof: Array
    poses: tuple[DrawnPoses, ...]  #: Poses at unknown attitudes.
    rates: Array  #: True rate of each reading, rad/s, shape (m,).

    @classmethod
    def from_campaign(cls, campaign: Campaign) -> TrialReadings:
        """Return the readings of a campaign; raise ValueError if they have no noise."""
        assert campaign.simulation is not None
        noise_by_name, rates = campaign.simulation.truth.reading_noise, true_rates(campaign)
        readings, true_noises, estimated_dof = [], [], []
        for reading, rate in zip(campaign.readings, rates.tolist(), strict=True):
            noise = noise_by_name.get(reading.accelerometer)
            true_noise = (reading.u or 0.0) if noise is None else noise / math.sqrt(reading.repeats)
            noise_dof = math.inf
            if reading.record is not None:
                true_noise, noise_dof = _record_noise(campaign, reading)
            if true_noise <= 0.0 and reading.u is None:
                raise ValueError(f"{_NO_NOISE}: {reading.name}")
            # Simulated values are not rounded.
            reading_u = true_noise if math.isfinite(noise_dof) else reading.u
            # The recorded angle determines the true rate; its uncertainty is negligible.
            measured_rate = MeasuredRate(rate, 0.0) if reading.uses_recorder_clock else None
            readings.append(
                replace(
                    reading, value=0.0, u=reading_u, resolution=0.0, measured_rate=measured_rate
                )
            )
            true_noises.append(true_noise)
            estimated_dof.append(noise_dof)
        noise_free_campaign = replace(campaign, readings=tuple(readings))
        return cls(
            noise_free_campaign.readings,
            tuple(
                (group, tuple(indices))
                for group, indices in numbered_groups(
                    noise_free_campaign, noise_free_campaign.readings
                )
            ),
            np.array(true_noises),
            np.array(estimated_dof),
            tuple(_make_drawn_poses(campaign)),
            rates,
        )

    def groups(
        self, draws: Draws, generator: np.random.Generator, model: Unknowns
    ) -> list[Readings | TriadPoses]:
        """Return the groups of readings and poses of one trial, for the fit."""
        return [*self._draw_readings(draws, generator, model), *self._draw_poses(draws, generator)]

    @property
    def groups_with_true_noise(self) -> list[Readings | TriadPoses]:
        """Groups of readings and poses, with their true standard deviations as uncertainties."""
        readings = [
            replace(group, u=np.maximum(self.noise_sds[list(indices)], 1e-15))
            for group, indices in self.numbered_groups
        ]
        poses = [
            replace(drawn_poses.group, u=np.maximum(drawn_poses.noise_sds, 1e-15))
            for drawn_poses in self.poses
        ]
        return [*readings, *poses]

    def _draw_poses(self, draws: Draws, generator: np.random.Generator) -> Iterator[TriadPoses]:
        """Yield the poses of one trial."""
        mean_values = {key: float(value.mean()) for key, value in draws.values.items()}
        for drawn_poses in self.poses:
            group = drawn_poses.group
            coefficients = [
                {symbol: value for (owner, symbol), value in mean_values.items() if owner == name}
                for name in group.accelerometers
            ]
            indications = predict_indications(group, coefficients, drawn_poses.directions)
            gravity_error = float(draws.input_error("site.gravity")[0])
            indications = indications * (1.0 + group.in_si * gravity_error / group.gravity)
            indications = indications + drawn_poses.noise_sds * generator.standard_normal(
                indications.shape
            )
            repeats = group.repeats[:, None]
            sums_of_squares = 2.0 * generator.standard_gamma(np.tile(0.5 * (repeats - 1.0), 3))
            scatter = np.sum(sums_of_squares * drawn_poses.noise_sds**2 * repeats, axis=1)
            yield replace(group, value=indications, scatter=scatter)

    def _draw_readings(
        self, draws: Draws, generator: np.random.Generator, model: Unknowns
    ) -> Iterator[Readings]:
        """Yield the readings of one trial."""
        angle_errors = head_errors(self.readings, generator)
        rate_sds = [group.u_rate + group.u_amplitude for group, _ in self.numbered_groups]
        has_rate_errors = any(np.any(rate_sd) for rate_sd in rate_sds)
        rate_errors = (
            draw_by_run(self.readings, generator)
            if has_rate_errors
            else np.zeros_like(angle_errors)
        )
        noise = self.noise_sds * generator.standard_normal(self.noise_sds.size)
        mean_values = {key: float(value.mean()) for key, value in draws.values.items()}
        machine = {
            symbol: value
            for (owner, symbol), value in mean_values.items()
            if not owner and affects_readings(symbol)
        }
        input_errors = {symbol: float(draws.input_error(symbol)[0]) for symbol in INPUT_STEPS}
        # A radius with its default prior is a deviation from the radius of the centrifuge.
        parameters = (*model.unknowns, *model.considered)
        symbols = {*machine, *(parameter.symbol for parameter in parameters)}
        symbols -= {parameter.symbol for parameter in parameters if parameter.has_default_prior}
        for (group, reading_indices), rate_sd in zip(self.numbered_groups, rate_sds, strict=True):
            indices = list(reading_indices)
            coefficients = {
                symbol: value
                for (owner, symbol), value in mean_values.items()
                if owner == group.accelerometer
            }
            # The analysis assumes the stated values of the inputs, not the true ones.
            true_group = apply_rates(group, self.rates[indices])
            for symbol, input_error in input_errors.items():
                true_group = perturb_input(true_group, symbol, input_error, symbols)
            for name in dict.fromkeys(filter(None, group.clocks)):
                symbol = find_symbol(name)
                owner = name.removesuffix(symbol).removesuffix(".")
                clock_error = float(draws.input_error(symbol, owner)[0])
                true_group = perturb_input(true_group, name, clock_error, symbols)
            true_group = true_group.with_rate_errors(rate_errors[indices] * rate_sd)
            value = compute_indications(true_group, coefficients, machine, angle_errors[indices])
            value = value * (1.0 + group.in_si * input_errors["site.gravity"] / group.site.gravity)
            value = value + noise[indices]
            result = replace(group, value=value)
            group_dof = self.estimated_dof[indices]
            is_estimated = np.isfinite(group_dof)
            if group.u is None:
                repeat_dof = group.repeats - 1.0
                scatter = 2.0 * generator.standard_gamma(0.5 * repeat_dof)
                variances = self.noise_sds[indices] ** 2 * group.repeats
                result = replace(result, scatter=scatter * variances)
            elif is_estimated.any():
                dof = np.where(is_estimated, group_dof, 1.0)
                estimated_noise = self.noise_sds[indices] * np.sqrt(
                    2.0 * generator.standard_gamma(0.5 * dof) / dof
                )
                result = replace(result, u=np.where(is_estimated, estimated_noise, group.u))
            yield result


def _make_drawn_poses(campaign: Campaign) -> Iterator[DrawnPoses]:
    """Yield the poses of a campaign in two groups: with and without a stated noise."""
    assert campaign.simulation is not None
    poses, directions = true_poses(campaign), true_directions(campaign)
    noise_by_name = campaign.simulation.truth.reading_noise
    for has_stated_noise in (True, False):
        indices = [
            index
            for index, pose in enumerate(poses)
            if all(reading.u is not None for reading in pose) is has_stated_noise
        ]
        if not indices:
            continue
        noise = np.array(
            [
                [
                    noise_by_name[reading.accelerometer] / math.sqrt(reading.repeats)
                    if reading.accelerometer in noise_by_name
                    else reading.u or 0.0
                    for reading in poses[index]
                ]
                for index in indices
            ]
        )
        if not has_stated_noise and not noise.all():
            raise ValueError(f"{_NO_NOISE}: {poses[indices[0]][0].name}")
        # Simulated values are not rounded.
        group = replace(make_group(campaign, [poses[index] for index in indices]), resolution=0.0)
        yield DrawnPoses(group, directions[indices], noise)


def _record_noise(campaign: Campaign, reading: Reading) -> tuple[float, float]:
    """Return the standard deviation of the mean of a record, g, and its degrees of freedom."""
    assert campaign.simulation is not None
    duration = reading.duration or 0.0
    sampling_rate = campaign.simulation.sampling_rate
    revolutions = math.floor(duration * abs(reading.rate) / (2.0 * math.pi) + 1e-9)
    if reading.rate and revolutions:
        duration = revolutions * 2.0 * math.pi / abs(reading.rate)
    dof = max(count_segments(math.floor(duration * sampling_rate)) - 1.0, 1.0)
    return mean_noise(campaign, duration), dof


@frozen
class FullEngine:
    """Full simulation of the trials of any analysis, one by one."""

    setup: SimulationSetup | None  #: Setup of the records; None: no records.
    request: TwoStageRequest | JointRequest  #: Options of the analysis.
    joint_request: JointRequest  #: Joint fit, which estimates unstated noise.
    owner: str = ""  #: Accelerometer of a two-stage analysis.
    rows: tuple[int, ...] = ()  #: Indices of the reported unknowns of the joint model.
    readings: TrialReadings | None = None  #: Readings of a joint analysis; None: no readings.

    def run_trials(self, draws: Draws, generator: np.random.Generator) -> TrialResults:
        """Return the results of the analysis for n trials; see `TrialEngine`."""
        results = [
            self._run_trial(draws.select_trial(index), generator) for index in range(draws.n_trials)
        ]
        return TrialResults(*(np.array(values).T for values in zip(*results, strict=True)))

    def _run_trial(
        self, draws: Draws, generator: np.random.Generator
    ) -> tuple[Array, Array, Array]:
        """Return estimate, u and degrees of freedom of one trial, shape (c,) each."""
        records = (
            None if self.setup is None else TrialRecords.from_draws(self.setup, draws, generator)
        )
        if isinstance(self.request, TwoStageRequest):
            assert records is not None
            return self._run_two_stage(self.request, records)
        model, estimation = self.request.model, None
        if records is not None:
            estimation = estimate(records.series(), model, self.request.noise)
        if self.readings is not None:
            groups = self.readings.groups(draws, generator, model)
            estimation, _ = estimate_with_groups(estimation, model, groups)
        assert estimation is not None
        solution, unknowns = estimation.fit.solution, estimation.fit.model.unknowns
        rows = list(self.rows)
        nominal_values = np.array([unknowns[i].nominal for i in rows])
        return solution.estimate[rows] + nominal_values, solution.u[rows], estimation.dof[rows]

    def _run_two_stage(
        self, request: TwoStageRequest, records: TrialRecords
    ) -> tuple[Array, Array, Array]:
        setup, estimated_noise = records.setup, None
        has_timing_noise = setup.noise["timing"] > 0.0 or setup.stated_timing_noise[0] > 0.0
        corrects_times = setup.has_angle and has_timing_noise
        if request.random_walk is None or corrects_times:
            series = tuple(records.series())
            if request.random_walk is None:
                estimation = estimate(series, self.joint_request.model, self.joint_request.noise)
                estimated_noise = estimation.estimated_noise[self.owner]
                request = request.with_noise(estimated_noise.noise)
                corrected_series = estimation.series
            else:
                corrected_series = correct_series(
                    series, self.joint_request.model, self.joint_request.noise
                )
            runs = [
                _make_strobed_run(
                    record.correct_times(corrected_record.corrected_fraction).with_timestamp_noise(
                        corrected_record.timestamp_sd
                    ),
                    request,
                )
                for record, corrected_record in zip(series, corrected_series, strict=True)
                if record.accelerometer == self.owner
            ]
        else:
            runs = [records.strobed_run(run, self.owner, request) for run in range(len(setup.runs))]
        result = second_stage(runs, setup.mountings[self.owner], request, ignored=())
        if estimated_noise is not None:
            result = apply_noise_uncertainty(result, estimated_noise.noise, estimated_noise)
        solution = result.fit.solution
        return solution.estimate, solution.u, np.asarray(result.dof)


def _make_strobed_run(record: ResidualSeries, request: TwoStageRequest) -> StrobedRun:
    """Return a run with the strobes of its full record, as in `calibrate`."""
    phase = strobe_angle(record.mounting.turned(record.attitude).input_axis)
    angle = record.trajectory.spindle.angle(record.time)
    strobes = by_angle(record.time, angle, record.error, phase)
    parabola = request.first_stage(strobes, record.trajectory, record.timestamp_sd)
    return StrobedRun(record.run, record.trajectory, parabola, record.attitude)
