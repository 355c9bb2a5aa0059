"""What a joint fit holds of one accelerometer."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Final

from counterspin.calibration.joint_problem import JointProblem
from counterspin.campaign.accelerometers import Accelerometer
from counterspin.campaign.description import Campaign
from counterspin.frozen import frozen
from counterspin.inference.diagnostics import Diagnostics, diagnose
from counterspin.inference.fitted_readings import FittedReadings
from counterspin.inference.identifiability import Assessment
from counterspin.inference.joint.agreement import Jackknife, leave_out
from counterspin.inference.joint.estimation import Estimate
from counterspin.inference.joint.fit import JointFit, Residuals
from counterspin.inference.joint.found_noise import level_dof
from counterspin.inference.joint.prepared import Prepared
from counterspin.inference.linear_readings import Readings
from counterspin.inference.poses import TriadPoses

#: Degrees of freedom of a very short record, whose every row the fit may follow.
_FEWEST_DOF: Final = 0.5


@frozen
class AccelerometerView:
    """A joint fit as one accelerometer sees it."""

    problem: JointProblem  #: The campaign, and what was recorded.
    estimate: Estimate  #: Of all accelerometers together.
    assessment: Assessment  #: Which unknowns the records determine.
    name: str  #: The accelerometer's.
    readings: tuple[FittedReadings, ...] = ()  #: Its readings, and how they fit.
    poses: tuple[FittedReadings, ...] = ()  #: Those of its triad, and how they fit.

    @property
    def campaign(self) -> Campaign:
        """The description."""
        return self.problem.campaign

    @property
    def fit(self) -> JointFit:
        """The solved problem."""
        return self.estimate.fit

    @property
    def accelerometer(self) -> Accelerometer:
        """Its description."""
        return self.campaign.accelerometers[self.name]

    @cached_property
    def places(self) -> dict[str, int]:
        """What is asked of it: symbol -> place among the unknowns of the fit."""
        return {
            unknown.symbol: index
            for index, unknown in enumerate(self.fit.model.unknowns)
            if unknown.owner == self.name and unknown.asked
        }

    @property
    def k_ii(self) -> int | None:
        """Place of its K_II; None where the model has none."""
        return self.places.get("K_II")

    def jackknife(self) -> list[Jackknife]:
        """Return what becomes of its K_II without each run."""
        return [] if self.k_ii is None else leave_out(self.estimate, self.k_ii)

    @property
    def parts(self) -> tuple[FittedReadings, ...]:
        """Its readings, then the poses."""
        return (*self.readings, *self.poses)

    def with_parts(self, parts: Sequence[FittedReadings]) -> AccelerometerView:
        """Return the view with those of some readings and poses that are the accelerometer's."""
        own = [part for part in parts if self.name in part.readings.accelerometers]
        return replace(
            self,
            readings=tuple(part for part in own if isinstance(part.readings, Readings)),
            poses=tuple(part for part in own if isinstance(part.readings, TriadPoses)),
        )

    @property
    def has_records(self) -> bool:
        """Whether it was recorded, and not only read."""
        return any(prepared.accelerometer == self.name for prepared in self.fit.prepared)

    def records(self) -> Iterator[tuple[int, Prepared, Residuals]]:
        """Yield its records: place among those of the fit, columns, residuals."""
        for index, prepared in enumerate(self.fit.prepared):
            if prepared.accelerometer == self.name:
                yield index, prepared, self.fit.residuals[index]

    @cached_property
    def diagnostics(self) -> Diagnostics:
        """Tests of its whitened residuals, run by run."""
        rows, times, freedom = {}, {}, {}
        for index, prepared, residuals in self.records():
            whitened = residuals.whitened
            rows[prepared.run] = whitened
            # Differences belong to the later of the rows they are made from.
            times[prepared.run] = prepared.series.time[-whitened.size :]
            freedom[prepared.run] = max(self.fit.degrees_of_freedom[index], _FEWEST_DOF)
        noise_given = self.name not in self.estimate.components
        fits = len(self.campaign.accelerometers)
        return diagnose(
            rows,
            freedom,
            noise_given=noise_given,
            noise_dof=level_dof(self.fit, self.name) if noise_given else math.inf,
            times=times,
            fits=fits,
        )
