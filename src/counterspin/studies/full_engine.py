"""Trials of whole records: simulated without any shortcut, and analysed as `calibrate` does.

The check of the faster engines, and the only one for noise that is not white or not stated, for a
rotation that the joint fit has to find, and for terms with a kink.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.joint.estimation import estimate
from counterspin.inference.joint.inputs import CLOCK, TIMING
from counterspin.inference.joint.series import Series
from counterspin.inference.two_stage.found_noise import with_found_noise
from counterspin.inference.two_stage.request import TwoStageRequest
from counterspin.inference.two_stage.second_stage import StrobedRun, second_stage
from counterspin.inference.two_stage.strobes import Strobes, by_angle, strobe_angle
from counterspin.physics import observation, simulation
from counterspin.physics.path_errors import encoder_error
from counterspin.physics.spindle import Spindle, fit_spindle
from counterspin.studies.analyses import JointRequest
from counterspin.studies.draws import Draws, of_run
from counterspin.studies.noise import NOISE_LEVELS
from counterspin.studies.trials import Trials, one_by_one
from counterspin.studies.world import World


@frozen
class FullEngine:
    """Trials of any analysis, record by record."""

    world: World  #: What is simulated.
    request: TwoStageRequest | JointRequest  #: What is asked of the analysis.
    joint: JointRequest  #: The joint fit that finds the noise that nobody states.
    owner: str = ""  #: The accelerometer of a two-stage analysis.
    rows: tuple[int, ...] = ()  #: Places of the joint model's unknowns that are reported.

    def trials(self, draws: Draws, generator: np.random.Generator) -> Trials:
        """Return what the analysis says of n trials; see `Engine`."""
        return one_by_one(self._trial, draws, generator)

    def _trial(self, draws: Draws, generator: np.random.Generator) -> tuple[Array, Array, Array]:
        levels = {NOISE_LEVELS[symbol][1]: float(level[0]) for symbol, level in draws.noise.items()}
        noise = replace(self.world.noise, white=float(draws.white[0]), **levels)
        engine = replace(self, world=replace(self.world, noise=noise))
        if isinstance(self.request, JointRequest):
            return engine._joint(self.request, draws, generator)
        return engine._two_stage(self.request, draws, generator)

    def series(self, draws: Draws, generator: np.random.Generator) -> list[Series]:
        """Return the records of all runs and accelerometers in one trial."""
        world = self.world
        series = []
        for run in range(len(world.runs)):
            spindle = draws.spindle(world.spindles[run], run)
            times = world.times(run)
            shown = times * self._clock(draws, run)
            stamped = world.noise.stamps(generator, shown)
            identified = self._identified(generator, run, spindle, draws, stamped, times)
            for name in world.mountings:
                signal = self._recorded(draws, generator, run, name, spindle, times)
                assumed = world.trajectory(run, identified)
                error = signal - observation.reference(
                    assumed, world.mountings[name], stamped, attitude=world.attitudes[run]
                )
                series.append(world.series(run, name, identified, shown, error))
        return series

    def _joint(
        self, request: JointRequest, draws: Draws, generator: np.random.Generator
    ) -> tuple[Array, Array, Array]:
        estimated = estimate(self.series(draws, generator), request.model, request.noise)
        solution, unknowns = estimated.fit.solution, estimated.fit.model.unknowns
        rows = list(self.rows)
        nominal = np.array([unknowns[i].nominal for i in rows])
        return solution.estimate[rows] + nominal, solution.u[rows], estimated.dof[rows]

    def _two_stage(
        self, request: TwoStageRequest, draws: Draws, generator: np.random.Generator
    ) -> tuple[Array, Array, Array]:
        components = None
        if request.random_walk is None:
            series = self.series(draws, generator)
            estimated = estimate(series, self.joint.model, self.joint.noise)
            components = estimated.components[self.owner]
            request = request.with_noise(components.noise)
            readings = [record for record in series if record.accelerometer == self.owner]
            runs = [self._strobed(record, request) for record in readings]
        else:
            runs = [
                self._strobed_alone(run, request, draws, generator)
                for run in range(len(self.world.runs))
            ]
        second = second_stage(runs, self.world.mountings[self.owner], request, ignored=())
        if components is not None:
            second = with_found_noise(second, components.covariance, components.unseen)
        solution = second.fit.solution
        return solution.estimate, solution.u, np.asarray(second.dof)

    def _strobed_alone(
        self, run: int, request: TwoStageRequest, draws: Draws, generator: np.random.Generator
    ) -> StrobedRun:
        """Return a run of which one reading is taken at each strobe."""
        world, name = self.world, self.owner
        spindle = draws.spindle(world.spindles[run], run)
        strobed = world.strobed(run, name)
        # The row in which the angle passes a strobe began earlier by the angle's delay.
        passed = spindle.time_at(strobed.angles) - float(draws.off(TIMING)[0])
        sampled, clock = world.times(run), self._clock(draws, run)
        identified = self._identified(generator, run, spindle, draws, sampled * clock, sampled)
        times, noise = passed * clock, world.noise
        taken = noise.stamps(generator, passed) if noise.timing > 0.0 else passed
        signal = self._recorded(draws, generator, run, name, spindle, taken)
        assumed = world.trajectory(run, identified)
        error = signal - observation.reference(
            assumed, world.mountings[name], times, attitude=strobed.attitude
        )
        readings = Strobes(times, error, np.ones_like(times), 0)
        parabola = request.first_stage(readings, assumed)
        return StrobedRun(world.runs[run], assumed, parabola, world.attitudes[run])

    def _strobed(self, record: Series, request: TwoStageRequest) -> StrobedRun:
        """Return a run whose strobes are read from its whole record, as `calibrate` does."""
        phase = strobe_angle(record.mounting.turned(record.attitude).input_axis)
        angle = record.trajectory.spindle.angle(record.time)
        strobes = by_angle(record.time, angle, record.error, phase)
        parabola = request.first_stage(strobes, record.trajectory)
        return StrobedRun(record.run, record.trajectory, parabola, record.attitude)

    def _clock(self, draws: Draws, run: int) -> float:
        """Return what the recorder of a run shows of a time, in parts of it."""
        return 1.0 + float(draws.off(CLOCK, self.world.recorders[run])[0])

    def _identified(
        self,
        generator: np.random.Generator,
        run: int,
        true: Spindle,
        draws: Draws,
        stamped: Array,
        times: Array,
    ) -> Spindle:
        """Return the rotation that a run's recorded angle shows.

        stamped: Times of the rows as they are recorded, s.
        times: The same as they were.
        """
        world, late = self.world, float(draws.off(TIMING)[0])
        if not world.angle_recorded:
            return Spindle(world.spindles[run].rate)
        angle = true.angle(times + late)
        misread = encoder_error(_shared(draws, run), angle)
        if world.noise.angle == 0.0 and not misread.any() and np.array_equal(stamped, times + late):
            return true
        recorded = world.noise.angles(generator, angle + misread)
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
        coefficients = {
            symbol: float(of_run(values, run)[0])
            for (owner, symbol), values in draws.values.items()
            if owner == name
        }
        signal = simulation.recorded(
            self.world.true_trajectory(run, spindle, draws),
            self.world.mountings[name],
            coefficients,
            _shared(draws, run),
            times,
            attitude=self.world.attitudes[run],
        )
        start = self.world.conditions[run].start
        return self.world.noise.displacements(generator, times, signal, start)


def _shared(draws: Draws, run: int) -> dict[str, float]:
    """Return what all accelerometers share in a run of a single trial."""
    return {
        symbol: float(of_run(values, run)[0])
        for (owner, symbol), values in draws.values.items()
        if not owner
    }
