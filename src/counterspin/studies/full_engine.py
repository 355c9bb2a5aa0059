"""Trials of whole records: simulated without any shortcut, and analysed as `calibrate` does.

The check of the faster engines, and the only one for noise that is not white or not stated, for a
rotation that the joint fit has to find, and for terms with a kink.

- `FullEngine`: the trials
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from counterspin.arrays import Array
from counterspin.inference.joint.estimation import estimate
from counterspin.inference.two_stage.first_stage import first_stage
from counterspin.inference.two_stage.request import TwoStageRequest
from counterspin.inference.two_stage.second_stage import StrobedRun, second_stage
from counterspin.inference.two_stage.strobes import Strobes
from counterspin.physics import simulation
from counterspin.physics.accelerometer import TERMS
from counterspin.physics.motion import Trajectory
from counterspin.physics.spindle import Spindle, fit_spindle
from counterspin.studies.analyses import JointRequest
from counterspin.studies.draws import Draws, of_run
from counterspin.studies.noise import NOISE_LEVELS
from counterspin.studies.two_stage_engine import Trials
from counterspin.studies.world import World


@dataclass(frozen=True)
class FullEngine:
    """Trials of any analysis, record by record.

    Attributes
    ----------
    world
        What is simulated.
    request
        What is asked of the analysis.
    owner
        The accelerometer of a two-stage analysis.
    rows
        Places of the joint model's unknowns that are reported.
    """

    world: World
    request: TwoStageRequest | JointRequest
    owner: str = ""
    rows: tuple[int, ...] = ()

    def trials(self, draws: Draws, generator: np.random.Generator) -> Trials:
        """Return what the analysis says of n trials; see `TwoStageEngine.trials`."""
        trials = [self._trial(draws.take(trial), generator) for trial in range(draws.trials)]
        estimate_, u, dof = (np.array(part).T for part in zip(*trials, strict=True))
        return Trials(estimate_, u, dof)

    def _trial(
        self, draws: Draws, generator: np.random.Generator
    ) -> tuple[Sequence[float], Sequence[float], Sequence[float]]:
        levels = {NOISE_LEVELS[symbol][1]: float(level[0]) for symbol, level in draws.noise.items()}
        noise = replace(self.world.noise, white=float(draws.white[0]), **levels)
        engine = replace(self, world=replace(self.world, noise=noise))
        if isinstance(self.request, JointRequest):
            return engine._joint(self.request, draws, generator)
        return engine._two_stage(self.request, draws, generator)

    def _joint(
        self, request: JointRequest, draws: Draws, generator: np.random.Generator
    ) -> tuple[Sequence[float], Sequence[float], Sequence[float]]:
        world = self.world
        series = []
        for run in range(len(world.runs)):
            spindle = draws.spindle(world.spindles[run], run)
            times = world.times(run)
            stamped = world.noise.stamps(generator, times)
            identified = self._identified(generator, run, spindle, stamped, times)
            for name in world.mountings:
                signal = self._recorded(draws, generator, run, name, spindle, times)
                assumed = Trajectory(identified, world.radius, world.site)
                axis = world.mountings[name].turned(world.attitudes[run]).input_axis
                error = signal - assumed.position(stamped) @ axis
                series.append(world.series(run, name, identified, error))
        estimated = estimate(series, request.model, request.noise)
        solution, unknowns = estimated.fit.solution, estimated.fit.model.unknowns
        rows = list(self.rows)
        u = np.sqrt(
            np.diag(
                solution.covariance_noise
                + solution.covariance_prior
                + solution.covariance_considered
            )
        )
        nominal = np.array([unknowns[i].nominal for i in rows])
        return list(solution.estimate[rows] + nominal), list(u[rows]), list(estimated.dof[rows])

    def _two_stage(
        self, request: TwoStageRequest, draws: Draws, generator: np.random.Generator
    ) -> tuple[Sequence[float], Sequence[float], Sequence[float]]:
        world, name = self.world, self.owner
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
            parabola = first_stage(readings, request.sigma, request.random_walk)
            runs.append(StrobedRun(world.runs[run], assumed, parabola, world.attitudes[run]))
        second = second_stage(runs, world.mountings[name], request, ignored=())
        values, us, dofs = [], [], []
        for symbol in request.unknowns:
            index = second.symbols.index(symbol)
            value = float(second.solution.estimate[index])
            u = math.hypot(float(second.solution.u[index]), *request.from_inputs(symbol, value))
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
        if world.noise.angle == 0.0 and world.noise.timing == 0.0:
            return true
        angle = true.angle(stamped if times is None else times)
        recorded = world.noise.angles(generator, angle)
        return fit_spindle(stamped, recorded, world.spindles[run].rate).spindle

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
            value = float(of_run(values, run)[0])
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
        return self.world.noise.displacements(generator, times, signal)
