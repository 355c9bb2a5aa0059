"""Trials simulated without any shortcut, and analysed as `calibrate` does.

The check of the faster engines, and the only one for readings, for noise that is not white or not
stated, for a rotation that the joint fit has to find, and for terms with a kink.
"""

from __future__ import annotations

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.readings import with_groups
from counterspin.frozen import frozen
from counterspin.inference.joint.estimation import estimate
from counterspin.inference.joint.series import Series
from counterspin.inference.two_stage.request import TwoStageRequest
from counterspin.inference.two_stage.second_stage import StrobedRun, second_stage, with_found_noise
from counterspin.inference.two_stage.strobes import by_angle, strobe_angle
from counterspin.studies.analyses import JointRequest
from counterspin.studies.draws import Draws
from counterspin.studies.engine import Trials
from counterspin.studies.trial_readings import TrialReadings
from counterspin.studies.trial_records import TrialRecords
from counterspin.studies.world import World


@frozen
class FullEngine:
    """Trials of any analysis, one by one."""

    world: World | None  #: What is simulated of records; None: there are none.
    request: TwoStageRequest | JointRequest  #: What is asked of the analysis.
    joint: JointRequest  #: The joint fit that finds the noise that nobody states.
    owner: str = ""  #: The accelerometer of a two-stage analysis.
    rows: tuple[int, ...] = ()  #: Places of the joint model's unknowns that are reported.
    readings: TrialReadings | None = None  #: Of a joint analysis; None: there are none.

    def trials(self, draws: Draws, generator: np.random.Generator) -> Trials:
        """Return what the analysis says of n trials; see `Engine`."""
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
            estimated, _ = with_groups(estimated, model, groups)
        assert estimated is not None
        solution, unknowns = estimated.fit.solution, estimated.fit.model.unknowns
        rows = list(self.rows)
        nominal = np.array([unknowns[i].nominal for i in rows])
        return solution.estimate[rows] + nominal, solution.u[rows], estimated.dof[rows]

    def _two_stage(
        self, request: TwoStageRequest, records: TrialRecords
    ) -> tuple[Array, Array, Array]:
        world, components = records.world, None
        if request.random_walk is None:
            series = records.series()
            estimated = estimate(series, self.joint.model, self.joint.noise)
            components = estimated.components[self.owner]
            request = request.with_noise(components.noise)
            own = [record for record in series if record.accelerometer == self.owner]
            runs = [_strobed(record, request) for record in own]
        else:
            runs = [records.strobed_run(run, self.owner, request) for run in range(len(world.runs))]
        second = second_stage(runs, world.mountings[self.owner], request, ignored=())
        if components is not None:
            second = with_found_noise(second, components.covariance, components.unseen)
        solution = second.fit.solution
        return solution.estimate, solution.u, np.asarray(second.dof)


def _strobed(record: Series, request: TwoStageRequest) -> StrobedRun:
    """Return a run whose strobes are read from its whole record, as `calibrate` does."""
    phase = strobe_angle(record.mounting.turned(record.attitude).input_axis)
    angle = record.trajectory.spindle.angle(record.time)
    strobes = by_angle(record.time, angle, record.error, phase)
    parabola = request.first_stage(strobes, record.trajectory)
    return StrobedRun(record.run, record.trajectory, parabola, record.attitude)
