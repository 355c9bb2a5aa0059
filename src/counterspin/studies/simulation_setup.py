"""Simulated setup of a study: runs, accelerometers, site, noise.

Each pose in the records of a triad becomes a reading with the noise of the mean of the pose.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, Final

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.joint_problem import stated_timing_noise
from counterspin.calibration.model import inputs_by_owner
from counterspin.campaign.conditions import run_conditions
from counterspin.campaign.description import Campaign
from counterspin.campaign.reading import PoseRecord
from counterspin.campaign.runs import is_pose, sample_count
from counterspin.campaign.static_noise import simulated_noise
from counterspin.errors import CampaignError
from counterspin.frozen import frozen
from counterspin.inference.joint.series import ResidualSeries
from counterspin.inference.noise.model import Noise
from counterspin.inference.two_stage.first_stage import strobe_angle
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.conditions import RunConditions
from counterspin.physics.frequency_response import RESPONSE_INPUTS
from counterspin.physics.motion import Site, Trajectory
from counterspin.physics.spindle import TURN, Spindle
from counterspin.simulation.pose_record import record_duration
from counterspin.studies.draws import Draws

#: Tolerance for strobes at the ends of a record, turns.
_ROUNDING_TOLERANCE: Final = 1e-9

#: Minimum number of samples: two samples would fit the start offset and velocity of a displacement.
_MIN_SAMPLES: Final = 3


@frozen
class SimulationSetup:
    """Simulated setup of a campaign."""

    runs: tuple[str, ...]  #: Names of the runs.
    spindles: tuple[Spindle, ...]  #: Spindle of each run with the fixed values.
    attitudes: tuple[Array, ...]  #: Attitude of each run.
    durations: tuple[float, ...]  #: Duration of each run, s.
    mountings: Mapping[str, Mounting]  #: Axes by accelerometer.
    observables: Mapping[str, str]  #: Observable of the records by accelerometer.
    accelerometers_in_g: frozenset[str]  #: Accelerometers whose records are in g.
    site: Site  #: Stated site.
    radius: float  #: Stated radius, m.
    sampling_rate: float  #: Sampling rate, Hz.
    has_angle: bool  #: True if the records contain the angle.
    noise: Mapping[str, float]  #: True noise of the records, by key of [noise].
    #: Stated noise of the time stamps, s, and of the encoder, rad; 0: none.
    stated_timing_noise: tuple[float, float]
    conditions: tuple[RunConditions, ...]  #: Conditions of each run.
    table_ratios: tuple[float, ...]  #: Ratio of the table rate of each run.
    recorders: tuple[str, ...]  #: Recorder of each run; empty with a single recorder.

    def times(self, run: int) -> Array:
        """Return the sample times of a run, s."""
        count = sample_count(self.durations[run], self.sampling_rate)
        return np.arange(count) / self.sampling_rate

    def trajectory(self, run: int, spindle: Spindle) -> Trajectory:
        """Return the assumed motion of a run in the analyses."""
        return Trajectory(
            spindle,
            self.radius,
            self.site,
            conditions=self.conditions[run],
            table_ratio=self.table_ratios[run],
        )

    def true_trajectory(self, run: int, spindle: Spindle, draws: Draws) -> Trajectory:
        """Return the true motion of a run in the first trial."""
        radius, gravity, latitude = (
            stated_value + float(draws.input_error(symbol)[0])
            for symbol, stated_value in (
                ("centrifuge.radius", self.radius),
                ("site.gravity", self.site.gravity),
                ("site.latitude", self.site.latitude),
            )
        )
        site = replace(self.site, gravity=gravity, latitude=latitude)
        return replace(self.trajectory(run, spindle), radius=radius, site=site)

    def true_mounting(self, name: str, draws: Draws) -> Mounting:
        """Return the mounting of an accelerometer with its true response in the first trial."""
        mounting = self.mountings[name]
        response = mounting.response
        if response is None:
            return mounting
        for (owner, symbol), error in draws.input_errors.items():
            if symbol in RESPONSE_INPUTS and owner in ("", name):
                response = response.deviate(symbol, float(error[0]))
        return replace(mounting, response=response)

    def series(
        self,
        run: int,
        name: str,
        spindle: Spindle,
        times: Array | None = None,
        error: Array | None = None,
    ) -> ResidualSeries:
        """Return a record with errors.

        times: Times of the rows, s; None: the sample times.
        error: Error of each row; None: zero.
        """
        times = self.times(run) if times is None else times
        series = ResidualSeries(
            accelerometer=name,
            run=self.runs[run],
            trajectory=self.trajectory(run, spindle),
            mounting=self.mountings[name],
            observable=self.observables[name],
            attitude=self.attitudes[run],
            time=times,
            time_sd=np.zeros_like(times),
            count=np.ones_like(times),
            spacing=1.0 / self.sampling_rate,
            error=np.zeros_like(times) if error is None else error,
            in_g=name in self.accelerometers_in_g,
            recorder=self.recorders[run],
        )
        return series.with_timestamp_noise(self.stated_timing_noise[0])

    def strobes(self, run: int, name: str) -> Array:
        """Return the spindle angles of the strobes of an accelerometer, rad, in time order."""
        axis = self.mountings[name].turned(self.attitudes[run]).input_axis
        spindle, phase = self.spindles[run], strobe_angle(axis)
        end_angles = sorted(
            spindle.start_angle + spindle.rate * time for time in (0.0, self.durations[run])
        )
        low, high = (np.array(end_angles) - phase) / TURN
        turn_numbers = np.arange(
            math.ceil(low - _ROUNDING_TOLERANCE), math.floor(high + _ROUNDING_TOLERANCE) + 1
        )
        angles: Array = phase + TURN * turn_numbers
        return angles if spindle.rate > 0.0 else angles[::-1]

    def true_noise(self, name: str) -> Noise:
        """Return the true noise of the records of an accelerometer."""
        return Noise.from_sizes(self.noise, self.observables[name])


def make_setup(campaign: Campaign) -> SimulationSetup:
    """Return the simulated setup of a campaign."""
    assert campaign.simulation is not None
    sampling_rate = campaign.simulation.sampling_rate
    errors = [
        f"runs[{index}]: {run.duration:.4g} s contain too few samples at {sampling_rate:.4g} Hz; a "
        "trial requires at least three samples, preferably many more"
        for index, run in enumerate(campaign.runs)
        if run.duration is not None and sample_count(run.duration, sampling_rate) < _MIN_SAMPLES
    ]
    stated_inputs = inputs_by_owner(campaign)
    errors += [
        f"truth.{owner or symbol.partition('.')[0]}.{symbol.partition('.')[2]}: a study can "
        "simulate this entry only if the campaign states it too"
        for owner, symbol in campaign.simulation.truth.inputs
        if symbol in RESPONSE_INPUTS and (owner, symbol) not in stated_inputs
    ]
    if errors:
        raise CampaignError(str(campaign.path), errors, code="not-simulable")
    return SimulationSetup(
        runs=tuple(run.name for run in campaign.runs),
        spindles=tuple(run.spindle for run in campaign.simulation.truth.runs.values()),
        attitudes=tuple(run.attitude for run in campaign.runs),
        table_ratios=tuple(run.table_ratio for run in campaign.runs),
        durations=tuple(run.duration for run in campaign.runs if run.duration),
        mountings={
            name: accelerometer.mounting for name, accelerometer in campaign.accelerometers.items()
        },
        observables={
            name: accelerometer.observable
            for name, accelerometer in campaign.accelerometers.items()
        },
        accelerometers_in_g=frozenset(
            name
            for name, accelerometer in campaign.accelerometers.items()
            if accelerometer.channel.in_g
        ),
        site=campaign.site,
        radius=campaign.radius.value,
        sampling_rate=sampling_rate,
        has_angle=campaign.angle is not None,
        noise=simulated_noise(campaign),
        stated_timing_noise=stated_timing_noise(campaign),
        conditions=tuple(run_conditions(campaign).values()),
        recorders=tuple(campaign.recording_of(run).recorder for run in campaign.runs),
    )


def expand_pose_records(document: Mapping[str, Any], campaign: Campaign) -> dict[str, Any]:
    """Replace the pose records of a description by poses with simulated readings.

    campaign: Campaign of the description, with [truth].
    """
    records = campaign.triad.records if campaign.triad else ()
    records_by_name = {record.name: record for record in records}
    runs: list[Any] = []
    for run in document.get("runs", ()):
        record = records_by_name.get(run.get("name")) if is_pose(run) else None
        runs += [run] if record is None else _pose_runs(record, campaign)
    return {**document, "runs": runs}


def _pose_runs(record: PoseRecord, campaign: Campaign) -> Iterator[dict[str, Any]]:
    """Yield the poses of a record as runs."""
    assert campaign.simulation is not None
    assert campaign.triad is not None
    n_poses = campaign.simulation.poses
    interval = record_duration(record, 2) - record_duration(record, 1)
    reading_texts = {}
    for name in campaign.triad.accelerometers:
        output = campaign.accelerometers[name].output
        unit, sensitivity = ("g", 1.0) if output is None else (output.unit, output.sensitivity)
        u_text = (
            ""
            if record.u is None
            else f" ± {record.u / campaign.gravity.value * abs(sensitivity)!r}"
        )
        reading_texts[name] = f"?{u_text} {unit}"
    record_fractions = (np.arange(n_poses) + 0.5) / n_poses
    for index, fraction in enumerate(record_fractions.tolist()):
        pose = {
            "name": f"{record.name} {index + 1}",
            "motion": "static",
            "attitude": "unknown",
            "reading": reading_texts,
            "time": f"{(record.time or 0.0) + index * interval!r} s",
        }
        if record.temperature is not None:
            knots = np.linspace(0.0, 1.0, len(record.temperature))
            pose["temperature"] = f"{float(np.interp(fraction, knots, record.temperature))!r} K"
        yield pose


def set_pose_noise(campaign: Campaign, records: tuple[PoseRecord, ...]) -> Campaign:
    """Return a campaign whose poses have the true noise of the means of the records."""
    assert campaign.simulation is not None
    assert campaign.triad is not None
    truth = campaign.simulation.truth
    # A simulated rest has twice the requested duration, in addition to the search time.
    noise_sd = mean_noise(campaign, 2.0 * min(record.min_rest for record in records))
    noise = dict.fromkeys(campaign.triad.accelerometers, noise_sd) | dict(truth.reading_noise)
    simulated_truth = replace(truth, reading_noise=noise)
    return replace(campaign, simulation=campaign.simulation.replace_private(truth=simulated_truth))


def mean_noise(campaign: Campaign, seconds: float) -> float:
    """Return the true standard deviation of the mean of `seconds` of a record, g."""
    assert campaign.simulation is not None
    noise, sampling_rate = simulated_noise(campaign), campaign.simulation.sampling_rate
    white_noise = noise["specific_force"] / math.sqrt(max(seconds * sampling_rate, 1.0))
    random_walk = noise["acceleration"] / math.sqrt(max(seconds, 1.0 / sampling_rate))
    return math.hypot(white_noise, random_walk) / campaign.gravity.value
