"""A history: the results of each instrument over time; its JSON.

Values are in the unit of the term, in g-units of one gravity, which is stated.
"""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from counterspin.loading import load_name
from counterspin.results import ReportableResult, ResultPart, draw_pictures

#: Whether the results of an instrument agree.
Verdict = Literal["single", "constant", "drifts", "differ", "disagree"]


class Point(ResultPart):
    """A result in the history."""

    date: str  #: Date of the campaign (ISO 8601); UTC if it states a time zone.
    file: str  #: Result file.
    accelerometer: str  #: Name of the accelerometer in that campaign; for an angle, both names.
    method: str  #: ``joint`` or ``two-stage``.
    value: float  #: Estimate.
    u: float  #: Standard uncertainty.
    dof: float | None  #: Degrees of freedom; None means infinite.
    difference: float | None  #: Difference from the weighted mean; None for a single result.
    z: float | None  #: Difference divided by its standard uncertainty; None for a single result.
    e_n: float | None  #: E_n score relative to the previous result; None for the first.
    laboratory: str | None = None  #: Laboratory of the campaign; None if not stated.
    mounting: str | None = None  #: Label of the mounting in the campaign; None if not stated.
    turn_on: str | None = None  #: Label of the power cycle in the campaign; None if not stated.


class Scatter(ResultPart):
    """The scatter of results about a mean or a line; p and Birge ratio need a degree of freedom."""

    chi2: float  #: Sum of squares of the differences divided by u.
    dof: int  #: Degrees of freedom.
    p: float | None  #: Probability of a larger chi-square; None without a degree of freedom.
    birge: float | None  #: Birge ratio, the root of chi2/dof; None without a degree of freedom.


class Trend(ResultPart):
    """A straight line through the results: change per year of 365.25 days."""

    value: float  #: Drift, in the term's unit per year.
    u: float  #: Standard uncertainty.
    p: float  #: Probability of at least this drift by chance.
    date: str  #: Weighted mean date, ISO 8601.
    level: float  #: Value of the line at `date`.
    u_level: float  #: Standard uncertainty of `level`.
    scatter: Scatter  #: Scatter about the line.


class ControlLimits(ResultPart):
    """Individuals and moving range, from the results alone (NIST/SEMATECH e-Handbook, 6.3.2.2)."""

    centre: float  #: Unweighted mean of the results.
    warning_low: float  #: Lower warning limit.
    warning_high: float  #: Upper warning limit.
    action_low: float  #: Lower action limit.
    action_high: float  #: Upper action limit.
    mean_range: float  #: Mean moving range.
    range_limit: float  #: Upper action limit of the moving range.
    beyond: list[str]  #: Files of results beyond the action limits.
    #: Files of results that differ from the previous result by more than `range_limit`.
    leaps: list[str]


class SpecificationLimits(ResultPart):
    """The specification of the latest result that has one, its limits in the term's unit."""

    low: float | None  #: Lower limit; None without a lower limit.
    high: float | None  #: Upper limit; None without an upper limit.
    words: str  #: Specification as written.


class Due(ResultPart):
    """The date when the next calibration of the instrument is due."""

    #: Last day on which the line is within specification with probability `reliability`; None:
    #: see `reason`.
    date: str | None
    reliability: float  #: Required probability.
    reason: str | None = None  #: Reason for a missing date.


class LaboratoryPair(ResultPart):
    """Two laboratories: the second's weighted mean minus the first's, and its E_n (ISO 13528)."""

    first: str  #: First laboratory.
    second: str  #: Second laboratory.
    difference: float  #: Weighted mean of the second minus that of the first.
    e_n: float  #: E_n score of the pair.

    @property
    def agrees(self) -> bool:
        """True if the two agree within their expanded uncertainties."""
        return abs(self.e_n) <= 1.0


class RepeatComponent(ResultPart):
    """The variation of results from one turn-on, mounting or day to another."""

    value: float  #: Standard deviation in excess of the u of the results; 0 if none is detected.
    low: float  #: Lower end of the 95 % interval; 0 if the component may be absent.
    high: float | None  #: Upper end of the 95 % interval; None if unlimited.
    groups: int  #: Number of power cycles, mountings or days.
    freedom: int  #: Degrees of freedom in excess of coarser groups.
    #: Other component that always changed together with this one and is part of it.
    same_as: list[str] = []


class Repeatability(ResultPart):
    """The repeatability of results, by restricted likelihood: turn-on, remount and day."""

    #: Components for ``day``, ``mounting`` and ``turn_on``, as far as the results determine
    #: them.
    components: dict[str, RepeatComponent]
    #: Total standard deviation between results (root sum of squares of the components).
    total: float
    #: Reference of the scatter: the mean, or the line if the results drift.
    about: Literal["mean", "line"]
    value: float  #: Mean weighted by these variances; for a line, its value at the mean date.
    u: float  #: Standard uncertainty.
    not_told: dict[str, str] = {}  #: Components that cannot be determined, and the reason.


class InstrumentHistory(ResultPart):
    """One instrument's results, oldest first."""

    #: Serial number of the accelerometer; or that of the campaign with the accelerometer's
    #: name.
    serial_number: str
    #: Source of the serial number: accelerometer or campaign.
    stated_by: Literal["accelerometer", "campaign"]
    points: list[Point]  #: Results in order of date.
    mean: float  #: Weighted mean.
    u_mean: float  #: Standard uncertainty of the mean.
    scatter: Scatter  #: Scatter about the mean.
    drift: Trend | None  #: Drift; None if all results have the same date.
    #: Verdict. ``single``: one result; ``constant``: consistent without drift; ``drifts``:
    #: consistent with a drift; ``differ``: two dates differ, by drift or by a jump;
    #: ``disagree``: the scatter exceeds the uncertainties.
    verdict: Verdict
    shared: list[str] = []  #: Sources common to results, such as ``centrifuge.radius``.
    #: Largest resulting correlation between two results; None if independent.
    correlation: float | None = None
    #: Control limits from the results alone; None for fewer than three.
    control: ControlLimits | None = None
    specification: SpecificationLimits | None = None  #: Specification; None if no result has one.
    #: Date of the next calibration, or the reason for its absence; None in files of earlier
    #: versions.
    due: Due | None = None
    #: Repeatability in excess of the u of the results; None for too few results, and in files
    #: of earlier versions.
    repeatability: Repeatability | None = None
    laboratories: list[LaboratoryPair] = []  #: Comparison of each pair of laboratories.


class UnusedResult(ResultPart):
    """A file, or one accelerometer in it, that is not in the history, and why."""

    file: str  #: Result file.
    accelerometer: str | None = None  #: Name of the accelerometer; None means all.
    reason: str  #: Reason for the exclusion.


class History(ReportableResult):
    """The history of all instruments."""

    BLOCKS: ClassVar[str] = "counterspin.histories.page:history_blocks"
    KIND: ClassVar[str] = "history"

    term: str  #: Coefficient, or ``offset``, ``sensitivity`` or ``angle`` (minus 90 deg) of triads.
    unit: str  #: Unit of every value; of a drift, per year.
    gravity: float  #: Gravity of the g-units, m/s^2, from the latest result.
    converted: bool  #: Whether results with another gravity were converted to `gravity`.
    instruments: list[InstrumentHistory]  #: History of each serial number.
    #: Results that cannot be used: without a date or serial number, or duplicates.
    left_out: list[UnusedResult]
    damaged: list[UnusedResult]  #: Files that cannot be read, and the reason.
    passed_over: list[str]  #: JSON files in the folders that are not results.
    notes: list[str]  #: Further remarks about the files, in sentences.

    def plot(self, *, axes: Any = None) -> list[Any]:
        """Draw the control chart of each instrument."""
        return draw_pictures(load_name("counterspin.histories.page:history_plots")(self), axes)
