"""A joint fit as each accelerometer sees it, and the readings and poses in it.

Records of a double turntable need no more than this. An extension adds readings and poses
(`counterspin.calibration.extensions`).
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

#: Degrees of freedom of a very short record, whose every row the fit may follow.
_MIN_DOF: Final = 0.5


class FittedGroup(Protocol):
    """Readings or poses with noise of one kind, and their fit."""

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
        """Kind of test, as in `Observation`."""

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
    """Readings and poses of a campaign in a joint fit; this class: none."""

    groups: tuple[FittedGroup, ...] = ()  #: Groups with noise of one kind.

    def fields(self, estimate: Estimate) -> Mapping[str, Any]:  # noqa: ARG002
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
        """Return the fit of groups with an accelerometer mounted otherwise, beside records.

        estimate: Of the records with the accelerometer mounted otherwise.
        groups: The groups as they are stated.
        """
        return estimate.fit, ()


@frozen
class AccelerometerView:
    """A joint fit as one accelerometer sees it."""

    problem: JointProblem  #: The campaign, and what was recorded.
    estimate: Estimate  #: Of all accelerometers together.
    assessment: Assessment  #: Which unknowns the records determine.
    name: str  #: The accelerometer's.
    #: Of all accelerometers together.
    data: ReadingData = field(default_factory=ReadingData)
    groups: tuple[FittedGroup, ...] = ()  #: Its groups of readings or poses.

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
    def indices(self) -> dict[str, int]:
        """Parameters of interest: symbol -> index among the unknowns of the fit."""
        return {
            unknown.symbol: index
            for index, unknown in enumerate(self.fit.model.unknowns)
            if unknown.owner == self.name and unknown.is_of_interest
        }

    @property
    def k_ii_index(self) -> int | None:
        """Place of its K_II; None where the model has none."""
        return self.indices.get("K_II")

    def jackknife(self) -> list[Jackknife]:
        """Return the jackknife of its K_II: the shift without each run."""
        return [] if self.k_ii_index is None else jackknife_runs(self.estimate, self.k_ii_index)

    def select_groups(self, groups: Sequence[FittedGroup]) -> AccelerometerView:
        """Return the view with those of some groups that are the accelerometer's."""
        selection = [group for group in groups if self.name in group.accelerometers]
        return replace(self, groups=tuple(selection))

    @property
    def has_records(self) -> bool:
        """Whether it was recorded, and not only read."""
        return any(block.accelerometer == self.name for block in self.fit.design_blocks)

    def records(self) -> Iterator[tuple[int, DesignBlock, Residuals]]:
        """Yield its records: place among those of the fit, columns, residuals."""
        for index, block in enumerate(self.fit.design_blocks):
            if block.accelerometer == self.name:
                yield index, block, self.fit.residuals[index]

    @property
    def series(self) -> list[ResidualSeries]:
        """Its records as the fit has them."""
        return [prepared.series for _, prepared, _ in self.records()]

    @cached_property
    def diagnostics(self) -> Diagnostics:
        """Tests of its whitened residuals, run by run."""
        whitened_by_run, times_by_run, dof_by_run = {}, {}, {}
        for index, block, residuals in self.records():
            whitened_residuals = residuals.whitened
            whitened_by_run[block.run] = whitened_residuals
            # Differences belong to the later of the rows they are made from.
            times_by_run[block.run] = block.series.time[-whitened_residuals.size :]
            dof_by_run[block.run] = max(self.fit.degrees_of_freedom[index], _MIN_DOF)
        noise_given = self.name not in self.estimate.estimated_noise
        accelerometer_count = len(self.campaign.accelerometers)
        return diagnose(
            whitened_by_run,
            dof_by_run,
            noise_given=noise_given,
            noise_dof=noise_level_dof(self.fit, self.name) if noise_given else math.inf,
            times=times_by_run,
            n_fits=accelerometer_count,
        )


@frozen(eq=False)
class Contribution:
    """Contribution of readings and poses to the result of an accelerometer."""

    #: The view whose residuals are tested. If test methods disagree, each method has a fit alone,
    #: because the disagreement is a finding already.
    residual_view: AccelerometerView
    findings: Sequence[Finding] = ()
    remarks: Sequence[str] = ()
    fields: Mapping[str, Any] = field(default_factory=dict)  #: Of `AccelerometerResult`.
