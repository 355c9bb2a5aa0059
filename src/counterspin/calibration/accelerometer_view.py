"""View of a joint fit for one accelerometer, and interface of readings and poses.

Readings and poses are implemented by an extension (`counterspin.calibration.extensions`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import field, replace
from functools import cached_property
from typing import Any, Final, Protocol, Self

from counterspin.arrays import Array
from counterspin.calibration.joint_problem import JointProblem
from counterspin.calibration.result_parts import Finding
from counterspin.campaign.accelerometers import Accelerometer
from counterspin.campaign.description import Campaign
from counterspin.frozen import frozen
from counterspin.inference.diagnostics import Diagnostics, diagnose
from counterspin.inference.identifiability import Assessment
from counterspin.inference.joint.agreement import jackknife_runs
from counterspin.inference.joint.design_blocks import DesignBlock
from counterspin.inference.joint.estimated_noise import noise_level_dof
from counterspin.inference.joint.estimation import Estimate
from counterspin.inference.joint.fit import JointFit, Residuals
from counterspin.inference.joint.series import ResidualSeries
from counterspin.inference.joint.summary import Jackknife
from counterspin.physics.accelerometer import Mounting

#: Smallest degrees of freedom, for a short record that the fit follows exactly.
_MIN_DOF: Final = 0.5


class FittedGroup(Protocol):
    """Readings or poses with a common noise, and their fit."""

    @property
    def residuals(self) -> Array:
        """Residuals, g, shape (n,)."""

    @property
    def chi2(self) -> float:
        """Chi-square of the residuals."""

    @property
    def residual_dof(self) -> float:
        """Degrees of freedom of the residuals."""

    @property
    def noise_dof(self) -> float:
        """Degrees of freedom of an estimated noise; infinite for a stated one."""

    @property
    def motion(self) -> str:
        """Test type, as in `Observation`."""

    @property
    def label(self) -> str:
        """Name in messages, plural."""

    @property
    def accelerometers(self) -> tuple[str, ...]:
        """Names of the accelerometers that were read."""

    @property
    def sigma(self) -> Array:
        """Standard uncertainty of each, g, shape (n,)."""

    @property
    def has_external_noise(self) -> bool:
        """True if the residuals are compared with a noise from another source."""

    def evaluate(self, fit: JointFit) -> Self:
        """Return the group under another fit of the same observations."""


class ReadingData:
    """Readings and poses of a campaign in a joint fit; this base class contains none."""

    groups: tuple[FittedGroup, ...] = ()  #: Groups with a common noise.

    def result_fields(self, estimate: Estimate) -> Mapping[str, Any]:  # noqa: ARG002
        """Return fields of `Outcome` that these data determine."""
        return {}

    def contributions(self, views: Sequence[AccelerometerView]) -> dict[str, Contribution]:
        """Return the contributions to the results of accelerometers, by name."""
        return {view.name: Contribution(view) for view in views}

    def findings(self, view: AccelerometerView) -> list[Finding]:  # noqa: ARG002
        """Return the findings of tests of the residuals of an accelerometer."""
        return []

    def remarks(self, views: Sequence[AccelerometerView]) -> Iterator[str]:  # noqa: ARG002
        """Yield remarks on the data that are not findings."""
        yield from ()

    def advice(self, view: AccelerometerView, symbol: str) -> tuple[str, str]:  # noqa: ARG002
        """Return the kind of data that leaves a term undetermined, and advice; empty: none."""
        return "records", ""

    def fit_rotated_mounting(
        self,
        estimate: Estimate,
        groups: Sequence[FittedGroup],  # noqa: ARG002
        name: str,  # noqa: ARG002
        rotate: Callable[[Mounting], Mounting],  # noqa: ARG002
    ) -> tuple[JointFit, tuple[FittedGroup, ...]]:
        """Return the fit of records and groups with another mounting of an accelerometer.

        estimate: Estimate from the records with this mounting.
        groups: Groups with the stated mounting.
        """
        return estimate.fit, ()


@frozen
class AccelerometerView:
    """View of a joint fit for one accelerometer."""

    problem: JointProblem  #: Campaign and observed runs.
    estimate: Estimate  #: Estimate for all accelerometers.
    assessment: Assessment  #: Identifiability of the unknowns.
    name: str  #: Name of the accelerometer.
    #: Readings and poses of all accelerometers.
    reading_data: ReadingData = field(default_factory=ReadingData)
    groups: tuple[FittedGroup, ...] = ()  #: Groups of readings or poses of this accelerometer.

    @property
    def campaign(self) -> Campaign:
        """The description."""
        return self.problem.campaign

    @property
    def fit(self) -> JointFit:
        """The joint fit."""
        return self.estimate.fit

    @property
    def accelerometer(self) -> Accelerometer:
        """Description of the accelerometer."""
        return self.campaign.accelerometers[self.name]

    @cached_property
    def indices(self) -> dict[str, int]:
        """Parameters of interest: symbol -> index among the unknowns of the fit."""
        return {
            unknown.symbol: index
            for index, unknown in enumerate(self.fit.model.unknowns)
            if unknown.owner == self.name and unknown.is_of_interest
        }

    @property
    def k_ii_index(self) -> int | None:
        """Index of K_II among the unknowns; None if K_II is not a parameter of interest."""
        return self.indices.get("K_II")

    def jackknife(self) -> list[Jackknife]:
        """Return the jackknife of K_II: the shift with each run omitted in turn."""
        return [] if self.k_ii_index is None else jackknife_runs(self.estimate, self.k_ii_index)

    def select_groups(self, groups: Sequence[FittedGroup]) -> AccelerometerView:
        """Return the view with the groups that contain the accelerometer."""
        selection = [group for group in groups if self.name in group.accelerometers]
        return replace(self, groups=tuple(selection))

    @property
    def has_records(self) -> bool:
        """Whether the fit contains records of the accelerometer, not only readings."""
        return any(block.accelerometer == self.name for block in self.fit.design_blocks)

    def records(self) -> Iterator[tuple[int, DesignBlock, Residuals]]:
        """Yield index, design block and residuals of each record of the accelerometer."""
        for index, block in enumerate(self.fit.design_blocks):
            if block.accelerometer == self.name:
                yield index, block, self.fit.residuals[index]

    @property
    def series(self) -> list[ResidualSeries]:
        """Series of the accelerometer in the fit."""
        return [block.series for _, block, _ in self.records()]

    @cached_property
    def diagnostics(self) -> Diagnostics:
        """Tests of the whitened residuals, run by run."""
        whitened_by_run, times_by_run, dof_by_run = {}, {}, {}
        for index, block, residuals in self.records():
            whitened_residuals = residuals.whitened
            whitened_by_run[block.run] = whitened_residuals
            # A difference is assigned to the later of its rows.
            times_by_run[block.run] = block.series.time[-whitened_residuals.size :]
            dof_by_run[block.run] = max(self.fit.degrees_of_freedom[index], _MIN_DOF)
        is_noise_stated = self.name not in self.estimate.estimated_noise
        return diagnose(
            whitened_by_run,
            dof_by_run,
            noise_given=is_noise_stated,
            noise_dof=noise_level_dof(self.fit, self.name) if is_noise_stated else math.inf,
            times=times_by_run,
            n_fits=len(self.campaign.accelerometers),
        )


@frozen(eq=False)
class Contribution:
    """Contribution of readings and poses to the result of an accelerometer."""

    #: View for the tests of residuals. If test methods disagree, it contains a separate fit of each
    #: method, because the disagreement is already a finding.
    residual_view: AccelerometerView
    findings: Sequence[Finding] = ()
    remarks: Sequence[str] = ()
    fields: Mapping[str, Any] = field(default_factory=dict)  #: Fields of `AccelerometerResult`.
