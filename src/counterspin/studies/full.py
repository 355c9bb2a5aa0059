"""Trials of whole records: simulated without any shortcut, and analysed as `calibrate` does.

The check of the faster engines, and the only one for noise that is not white or not stated, for a
rotation that the joint fit has to find, and for terms with a kink.

- `Instrumented`: what is simulated
- `FullEngine`: the trials
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from counterspin.arrays import Array
from counterspin.campaign.resolved import sample_count
from counterspin.inference.joint.estimation import estimate
from counterspin.inference.joint.series import Series, jitter_of
from counterspin.inference.two_stage.first_stage import first_stage
from counterspin.inference.two_stage.request import TwoStageRequest
from counterspin.inference.two_stage.second_stage import StrobedRun, second_stage
from counterspin.inference.two_stage.strobes import Strobes, strobe_angle
from counterspin.physics import simulation
from counterspin.physics.accelerometer import TERMS, Mounting
from counterspin.physics.motion import Site, Trajectory
from counterspin.physics.spindle import Spindle, fit_spindle
from counterspin.studies.draws import OTHER_NOISE, Draws
from counterspin.studies.joint import JointAnalysis
from counterspin.studies.strobes import StrobedMotion
from counterspin.studies.two_stage import Trials


@dataclass(frozen=True)
class Instrumented:
    """A campaign as it is simulated.

    Attributes
    ----------
    runs
        Names.
    spindles, attitudes, durations
        Of each run; the spindles with what does not vary.
    mountings
        Accelerometer -> its axes; all record displacement.
    site, radius
        As the analyses assume them.
    sampling_rate
        Hz.
    angle_recorded
        Whether the records have an angle.
    angle_noise, random_walk, quantisation, timing_noise
        Of the records beside their white noise: rad, m/s^2/Hz^0.5, m, s.
    """

    runs: tuple[str, ...]
    spindles: tuple[Spindle, ...]
    attitudes: tuple[Array, ...]
    durations: tuple[float, ...]
    mountings: Mapping[str, Mounting]
    site: Site
    radius: float
    sampling_rate: float
    angle_recorded: bool = True
    angle_noise: float = 0.0
    random_walk: float = 0.0
    quantisation: float = 0.0
    timing_noise: float = 0.0

    def times(self, run: int) -> Array:
        """Return the times of a run's samples, s."""
        count = sample_count(self.durations[run], self.sampling_rate)
        return np.arange(count) / self.sampling_rate

    def series(self, run: int, name: str, spindle: Spindle, error: Array | None = None) -> Series:
        """Return a record, without errors where none are given."""
        times = self.times(run)
        return Series(
            accelerometer=name,
            run=self.runs[run],
            trajectory=Trajectory(spindle, self.radius, self.site),
            mounting=self.mountings[name],
            observable="displacement",
            attitude=self.attitudes[run],
            time=times,
            spread=np.zeros_like(times),
            count=np.ones_like(times),
            spacing=1.0 / self.sampling_rate,
            error=np.zeros_like(times) if error is None else error,
            jitter=jitter_of(self.timing_noise, self.radius, self.spindles[run].rate, 2),
        )

    def strobed(self, run: int, name: str) -> StrobedMotion:
        """Return a run as the strobes of an accelerometer see it."""
        mounting, attitude = self.mountings[name], self.attitudes[run]
        phase = strobe_angle(mounting.turned(attitude).input_axis)
        return StrobedMotion.of(
            self.spindles[run], self.durations[run], phase, mounting, attitude, self.site
        )


@dataclass(frozen=True)
class FullEngine:
    """Trials of any analysis, record by record.

    Attributes
    ----------
    world
        What is simulated.
    analysis
        What is done with the records.
    owner
        The accelerometer of a two-stage analysis.
    rows
        Places of the joint model's unknowns that are reported.
    """

    world: Instrumented
    analysis: TwoStageRequest | JointAnalysis
    owner: str = ""
    rows: tuple[int, ...] = ()

    def trials(self, draws: Draws, generator: np.random.Generator) -> Trials:
        """Return what the analysis says of n trials; see `TwoStageEngine.trials`."""
        found = [self._trial(draws.take(trial), generator) for trial in range(draws.trials)]
        estimate_, u, dof = (np.array(part).T for part in zip(*found, strict=True))
        return Trials(estimate_, u, dof)

    def _trial(
        self, draws: Draws, generator: np.random.Generator
    ) -> tuple[Sequence[float], Sequence[float], Sequence[float]]:
        levels = {OTHER_NOISE[symbol]: float(value[0]) for symbol, value in draws.noise.items()}
        one = replace(self, world=replace(self.world, **levels)) if levels else self  # type: ignore[arg-type]
        if isinstance(self.analysis, JointAnalysis):
            return one._joint(draws, generator)
        return one._two_stage(draws, generator)

    def _joint(
        self, draws: Draws, generator: np.random.Generator
    ) -> tuple[Sequence[float], Sequence[float], Sequence[float]]:
        analysis, world = self.analysis, self.world
        assert isinstance(analysis, JointAnalysis)
        series = []
        for run in range(len(world.runs)):
            spindle = draws.spindle(world.spindles[run], run)
            times = world.times(run)
            # What is stamped is not quite when it was sampled.
            stamped = times + world.timing_noise * generator.standard_normal(times.size)
            identified = self._identified(generator, run, spindle, stamped, times)
            for name in world.mountings:
                signal = self._recorded(draws, generator, run, name, spindle, times)
                assumed = Trajectory(identified, world.radius, world.site)
                axis = world.mountings[name].turned(world.attitudes[run]).input_axis
                error = signal - assumed.position(stamped) @ axis
                series.append(world.series(run, name, identified, error))
        found = estimate(series, analysis.model, analysis.requests)
        solution, unknowns = found.fit.solution, found.fit.model.unknowns
        rows = list(self.rows)
        u = np.sqrt(
            np.diag(
                solution.covariance_noise
                + solution.covariance_prior
                + solution.covariance_considered
            )
        )
        nominal = np.array([unknowns[i].nominal for i in rows])
        return list(solution.estimate[rows] + nominal), list(u[rows]), list(found.dof[rows])

    def _two_stage(
        self, draws: Draws, generator: np.random.Generator
    ) -> tuple[Sequence[float], Sequence[float], Sequence[float]]:
        analysis, world, name = self.analysis, self.world, self.owner
        assert isinstance(analysis, TwoStageRequest)
        runs = []
        for run in range(len(world.runs)):
            spindle = draws.spindle(world.spindles[run], run)
            strobed = world.strobed(run, name)
            times = spindle.time_at(strobed.angles)
            identified = self._identified(generator, run, spindle, world.times(run))
            signal = self._recorded(draws, generator, run, name, spindle, times)
            assumed = Trajectory(identified, world.radius, world.site)
            error = signal - assumed.position(times) @ strobed.mounting.input_axis
            readings = Strobes(times, error, np.ones_like(times), 0)
            parabola = first_stage(readings, analysis.sigma, analysis.random_walk)
            runs.append(StrobedRun(world.runs[run], assumed, parabola, world.attitudes[run]))
        second = second_stage(runs, world.mountings[name], analysis, ignored=())
        values, us, dofs = [], [], []
        for symbol in analysis.unknowns:
            index = second.symbols.index(symbol)
            value = float(second.solution.estimate[index])
            u = math.hypot(float(second.solution.u[index]), *analysis.from_inputs(symbol, value))
            noise = math.sqrt(float(second.solution.covariance_noise[index, index]))
            values.append(value)
            us.append(u)
            dofs.append(float(second.dof[index]) * (u / noise) ** 4)
        return values, us, dofs

    def _identified(
        self,
        generator: np.random.Generator,
        run: int,
        true: Spindle,
        stamped: Array,
        times: Array | None = None,
    ) -> Spindle:
        """Return the rotation that a run's recorded angle shows."""
        world = self.world
        if not world.angle_recorded:
            return Spindle(world.spindles[run].rate)
        if world.angle_noise == 0.0 and world.timing_noise == 0.0:
            return true
        angle = true.angle(stamped if times is None else times)
        angle = angle + world.angle_noise * generator.standard_normal(angle.size)
        return fit_spindle(stamped, angle, world.spindles[run].rate).spindle

    def _recorded(
        self,
        draws: Draws,
        generator: np.random.Generator,
        run: int,
        name: str,
        spindle: Spindle,
        times: Array,
    ) -> Array:
        """Return the noisy displacement at the times."""
        coefficients, platform = {}, {}
        for (owner, symbol), values in draws.values.items():
            value = float(values[min(run, values.shape[0] - 1), 0])
            if symbol in TERMS and owner == name:
                coefficients[symbol] = value
            elif not owner:
                platform[symbol] = value
        signal = simulation.recorded(
            Trajectory(spindle, float(draws.radius[0]), self.world.site),
            self.world.mountings[name],
            coefficients,
            platform,
            times,
            attitude=self.world.attitudes[run],
        )
        walk = simulation.accelerometer_walk(generator, times, self.world.random_walk, 2)
        signal = signal + walk + draws.white[0] * generator.standard_normal(times.size)
        step = self.world.quantisation
        return np.asarray(np.round(signal / step) * step if step > 0.0 else signal)
