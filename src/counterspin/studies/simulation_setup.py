"""Simulated set-up of a study: runs, accelerometers, site, noise.

Each pose of a triad's records is a reading there, with the noise of its mean, drawn as often.
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
from counterspin.simulation.pose_record import record_seconds
from counterspin.studies.draws import Draws

#: Of a strobe from the end of a record, in turns: it is in the record.
_ROUNDING: Final = 1e-9

#: A displacement begins with an offset and a velocity of its own, which two samples would fit.
_MIN_SAMPLES: Final = 3


@frozen
class SimulationSetup:
    """Simulated set-up of a campaign."""

    runs: tuple[str, ...]  #: Names of the runs.
    #: Of each run; the spindles have the constant values.
    spindles: tuple[Spindle, ...]
    attitudes: tuple[Array, ...]
    durations: tuple[float, ...]
    mountings: Mapping[str, Mounting]  #: Accelerometer -> its axes.
    observables: Mapping[str, str]  #: Accelerometer -> what its records hold.
    outputs_in_g: frozenset[str]  #: Accelerometers whose records are in g.
    #: As the analyses assume them.
    site: Site
    radius: float
    sampling_rate: float  #: Hz.
    angle_recorded: bool  #: Whether the records have an angle.
    #: Sizes of the noise of the records by key of [noise], where it does not vary.
    noise: Mapping[str, float]
    #: Noise of the time stamps, s, and of the encoder, rad, that the analyses assume; 0: none.
    stated_timing_noise: tuple[float, float]
    conditions: tuple[RunConditions, ...]  #: Of each run.
    table_ratios: tuple[float, ...]  #: Of each run.
    recorders: tuple[str, ...]  #: Whose clock the record of each run has, where there are several.

    def times(self, run: int) -> Array:
        """Return the times of a run's samples, s."""
        count = sample_count(self.durations[run], self.sampling_rate)
        return np.arange(count) / self.sampling_rate

    def trajectory(self, run: int, spindle: Spindle) -> Trajectory:
        """Return the motion of a run that the analyses assume."""
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
            stated + float(draws.input_error(symbol)[0])
            for symbol, stated in (
                ("centrifuge.radius", self.radius),
                ("site.gravity", self.site.gravity),
                ("site.latitude", self.site.latitude),
            )
        )
        site = replace(self.site, gravity=gravity, latitude=latitude)
        return replace(self.trajectory(run, spindle), radius=radius, site=site)

    def true_mounting(self, name: str, draws: Draws) -> Mounting:
        """Return the axes of an accelerometer, with its true response in the first trial."""
        mounting = self.mountings[name]
        response = mounting.response
        if response is None:
            return mounting
        for (owner, symbol), error in draws.inputs.items():
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
        """Return a record with errors; without `error`, they are zero.

        times: Of its rows, s; None: those of the samples.
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
            in_g=name in self.outputs_in_g,
            recorder=self.recorders[run],
        )
        return series.with_timestamp_noise(self.stated_timing_noise[0])

    def strobes(self, run: int, name: str) -> Array:
        """Return the spindle angles of an accelerometer's strobes, rad, in the order of time."""
        axis = self.mountings[name].turned(self.attitudes[run]).input_axis
        spindle, phase = self.spindles[run], strobe_angle(axis)
        ends = sorted(spindle.start_angle + spindle.rate * t for t in (0.0, self.durations[run]))
        low, high = (np.array(ends) - phase) / TURN
        turns = np.arange(math.ceil(low - _ROUNDING), math.floor(high + _ROUNDING) + 1)
        angles: Array = phase + TURN * turns
        return angles if spindle.rate > 0.0 else angles[::-1]

    def true_noise(self, name: str) -> Noise:
        """Return the true noise of an accelerometer's records."""
        return Noise.from_sizes(self.noise, self.observables[name])


def make_setup(campaign: Campaign) -> SimulationSetup:
    """Return the simulated set-up of a campaign."""
    assert campaign.simulation is not None
    rate = campaign.simulation.sampling_rate
    errors = [
        f"runs[{index}]: {run.duration:.4g} s contain too few samples at {rate:.4g} Hz; a "
        "trial requires at least three samples, preferably many more"
        for index, run in enumerate(campaign.runs)
        if run.duration is not None and sample_count(run.duration, rate) < _MIN_SAMPLES
    ]
    stated = inputs_by_owner(campaign)
    errors += [
        f"truth.{owner or symbol.partition('.')[0]}.{symbol.partition('.')[2]}: a study can "
        "simulate this entry only if the campaign states it too"
        for owner, symbol in campaign.simulation.truth.inputs
        if symbol in RESPONSE_INPUTS and (owner, symbol) not in stated
    ]
    if errors:
        raise CampaignError(str(campaign.path), errors, code="not-simulable")
    return SimulationSetup(
        runs=tuple(run.name for run in campaign.runs),
        spindles=tuple(run.spindle for run in campaign.simulation.truth.runs.values()),
        attitudes=tuple(run.attitude for run in campaign.runs),
        table_ratios=tuple(run.table_ratio for run in campaign.runs),
        durations=tuple(run.duration for run in campaign.runs if run.duration),
        mountings={name: a.mounting for name, a in campaign.accelerometers.items()},
        observables={name: a.observable for name, a in campaign.accelerometers.items()},
        outputs_in_g=frozenset(
            name for name, a in campaign.accelerometers.items() if a.channel.in_g
        ),
        site=campaign.site,
        radius=campaign.radius.value,
        sampling_rate=rate,
        angle_recorded=campaign.angle is not None,
        noise=simulated_noise(campaign),
        stated_timing_noise=stated_timing_noise(campaign),
        conditions=tuple(run_conditions(campaign).values()),
        recorders=tuple(campaign.recording_of(run).recorder for run in campaign.runs),
    )


def expand_pose_records(document: Mapping[str, Any], campaign: Campaign) -> dict[str, Any]:
    """Replace the pose records of a description by poses with readings, whose values are drawn.

    campaign: As it describes it, with [simulation].
    """
    records = (
        {pose_record.name: pose_record for pose_record in campaign.triad.records}
        if campaign.triad
        else {}
    )
    runs: list[Any] = []
    for run in document.get("runs", ()):
        record = records.get(run.get("name")) if is_pose(run) else None
        runs += [run] if record is None else _pose_runs(record, campaign)
    return {**document, "runs": runs}


def _pose_runs(record: PoseRecord, campaign: Campaign) -> Iterator[dict[str, Any]]:
    """Yield the poses of a record as runs."""
    assert campaign.simulation is not None
    assert campaign.triad is not None
    count = campaign.simulation.poses
    interval = record_seconds(record, 2) - record_seconds(record, 1)
    reading = {}
    for name in campaign.triad.accelerometers:
        output = campaign.accelerometers[name].output
        unit, sensitivity = ("g", 1.0) if output is None else (output.unit, output.sensitivity)
        u = (
            ""
            if record.u is None
            else f" ± {record.u / campaign.gravity.value * abs(sensitivity)!r}"
        )
        reading[name] = f"?{u} {unit}"
    centres = (np.arange(count) + 0.5) / count
    for index, centre in enumerate(centres.tolist()):
        pose = {
            "name": f"{record.name} {index + 1}",
            "motion": "static",
            "attitude": "unknown",
            "reading": reading,
            "time": f"{(record.time or 0.0) + index * interval!r} s",
        }
        if record.temperature is not None:
            knots = np.linspace(0.0, 1.0, len(record.temperature))
            pose["temperature"] = f"{float(np.interp(centre, knots, record.temperature))!r} K"
        yield pose


def set_pose_noise(campaign: Campaign, records: tuple[PoseRecord, ...]) -> Campaign:
    """Return a campaign whose poses have the true noise of means in the records."""
    assert campaign.simulation is not None
    assert campaign.triad is not None
    truth = campaign.simulation.truth
    # A record's rest is twice the requested length, plus the length that its search takes.
    sd = mean_noise(campaign, 2.0 * min(record.rest for record in records))
    noise = dict.fromkeys(campaign.triad.accelerometers, sd) | dict(truth.reading_noise)
    simulated_truth = replace(truth, reading_noise=noise)
    return replace(campaign, simulation=campaign.simulation.replace_private(truth=simulated_truth))


def mean_noise(campaign: Campaign, seconds: float) -> float:
    """Return the true standard deviation of the mean of `seconds` of a record, g."""
    assert campaign.simulation is not None
    noise, rate = simulated_noise(campaign), campaign.simulation.sampling_rate
    white = noise["specific_force"] / math.sqrt(max(seconds * rate, 1.0))
    walk = noise["acceleration"] / math.sqrt(max(seconds, 1.0 / rate))
    return math.hypot(white, walk) / campaign.gravity.value
