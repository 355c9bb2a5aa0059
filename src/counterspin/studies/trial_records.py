"""The records of one trial: simulated sample by sample, without any shortcut."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.joint.inputs import CLOCK, TIMING
from counterspin.inference.joint.series import Series
from counterspin.inference.two_stage.request import TwoStageRequest
from counterspin.inference.two_stage.second_stage import StrobedRun
from counterspin.inference.two_stage.strobes import Strobes
from counterspin.physics import observation, simulation
from counterspin.physics.path_errors import encoder_error
from counterspin.physics.spindle import Spindle, fit_spindle
from counterspin.studies.draws import Draws, of_run
from counterspin.studies.noise import NOISE_LEVELS
from counterspin.studies.world import World


@frozen
class TrialRecords:
    """What is recorded of all runs in one trial."""

    world: World  #: With this trial's noise.
    draws: Draws  #: What is true in it.
    generator: np.random.Generator  #: Draws the noise.

    @classmethod
    def of(cls, world: World, draws: Draws, generator: np.random.Generator) -> TrialRecords:
        """Return the records of a trial, with the levels of noise that are true in it."""
        levels = {NOISE_LEVELS[symbol][1]: float(level[0]) for symbol, level in draws.noise.items()}
        noise = replace(world.noise, white=float(draws.white[0]), **levels)
        return cls(replace(world, noise=noise), draws, generator)

    def series(self) -> list[Series]:
        """Return the records of all runs and accelerometers."""
        world = self.world
        series = []
        for run in range(len(world.runs)):
            spindle = self.draws.spindle(world.spindles[run], run)
            times = world.times(run)
            shown = times * self._clock(run)
            stamped = world.noise.stamps(self.generator, shown)
            identified = self._identified(run, spindle, stamped, times)
            for name in world.mountings:
                signal = self._recorded(run, name, spindle, times)
                assumed = world.trajectory(run, identified)
                error = signal - observation.reference(
                    assumed, world.mountings[name], stamped, attitude=world.attitudes[run]
                )
                series.append(world.series(run, name, identified, shown, error))
        return series

    def strobed_run(self, run: int, name: str, request: TwoStageRequest) -> StrobedRun:
        """Return a run of which one reading is taken at each strobe."""
        world = self.world
        spindle = self.draws.spindle(world.spindles[run], run)
        strobed = world.strobed(run, name)
        # The row in which the angle passes a strobe began earlier by the angle's delay.
        passed = spindle.time_at(strobed.angles) - float(self.draws.off(TIMING)[0])
        sampled, clock = world.times(run), self._clock(run)
        identified = self._identified(run, spindle, sampled * clock, sampled)
        times, noise = passed * clock, world.noise
        taken = noise.stamps(self.generator, passed) if noise.timing > 0.0 else passed
        signal = self._recorded(run, name, spindle, taken)
        assumed = world.trajectory(run, identified)
        error = signal - observation.reference(
            assumed, world.mountings[name], times, attitude=strobed.attitude
        )
        readings = Strobes(times, error, np.ones_like(times), 0)
        parabola = request.first_stage(readings, assumed)
        return StrobedRun(world.runs[run], assumed, parabola, world.attitudes[run])

    def _clock(self, run: int) -> float:
        """Return what the recorder of a run shows of a time, in parts of it."""
        return 1.0 + float(self.draws.off(CLOCK, self.world.recorders[run])[0])

    def _identified(self, run: int, true: Spindle, stamped: Array, times: Array) -> Spindle:
        """Return the rotation that a run's recorded angle shows.

        stamped: Times of the rows as they are recorded, s.
        times: The same as they were.
        """
        world, late = self.world, float(self.draws.off(TIMING)[0])
        if not world.angle_recorded:
            return Spindle(world.spindles[run].rate)
        angle = true.angle(times + late)
        misread = encoder_error(self._values("", run), angle)
        if world.noise.angle == 0.0 and not misread.any() and np.array_equal(stamped, times + late):
            return true
        recorded = world.noise.angles(self.generator, angle + misread)
        return fit_spindle(stamped, recorded, world.spindles[run].rate).spindle

    def _recorded(self, run: int, name: str, spindle: Spindle, times: Array) -> Array:
        """Return the noisy displacement at the times."""
        world = self.world
        signal = simulation.recorded(
            world.true_trajectory(run, spindle, self.draws),
            world.mountings[name],
            self._values(name, run),
            self._values("", run),
            times,
            attitude=world.attitudes[run],
        )
        start = world.conditions[run].start
        return world.noise.displacements(self.generator, times, signal, start)

    def _values(self, owner: str, run: int) -> dict[str, float]:
        """Return what is true of an accelerometer in a run, or of what all share."""
        return {
            symbol: float(of_run(values, run)[0])
            for (one, symbol), values in self.draws.values.items()
            if one == owner
        }
