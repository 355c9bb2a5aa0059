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

    date: str  #: Date of the campaign (ISO 8601), in UTC if the date has a time zone.
    file: str  #: Result file.
    #: Name of the accelerometer in that campaign; for an angle, the names of both accelerometers.
    accelerometer: str
    method: str  #: ``joint`` or ``two-stage``.
    value: float  #: Estimate.
    u: float  #: Standard uncertainty.
    dof: float | None  #: Degrees of freedom; None means infinite.
    difference: float | None  #: Difference from the weighted mean; None for a single result.
    z: float | None  #: Difference divided by its standard uncertainty; None for a single result.
    e_n: float | None  #: E_n score relative to the previous result; null for the first result.
    laboratory: str | None = None  #: Laboratory of the campaign; None if not stated.
    mounting: str | None = None  #: Label of the mounting in the campaign; None if not stated.
    turn_on: str | None = None  #: Label of the power cycle in the campaign; None if not stated.


class Scatter(ResultPart):
    """The scatter of results about a mean or a line; p and Birge ratio need a degree of freedom."""

    chi2: float  #: Sum of the squares of the differences, each divided by its u.
    dof: int  #: Degrees of freedom.
    p: float | None  #: Probability of a larger chi-square; null if there are no degrees of freedom.
    #: Birge ratio, the square root of chi2/dof; null if there are no degrees of freedom.
    birge: float | None


class Trend(ResultPart):
    """A straight line through the results: change per year of 365.25 days."""

    value: float  #: Drift, in the term's unit per year.
    u: float  #: Standard uncertainty.
    p: float  #: Probability of a drift at least this large by chance (p-value).
    date: str  #: Weighted mean date (ISO 8601).
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
    beyond: list[str]  #: Files of the results that lie beyond the action limits.
    #: Files of results that differ from the previous result by more than `range_limit`.
    leaps: list[str]


class SpecificationLimits(ResultPart):
    """The specification of the latest result that has one, its limits in the term's unit."""

    low: float | None  #: Lower limit; null if there is none.
    high: float | None  #: Upper limit; null if there is none.
    words: str  #: Specification as written in the campaign.


class DueDate(ResultPart):
    """The date when the next calibration of the instrument is due."""

    #: Last day on which the straight line is within specification with the probability
    #: `reliability`; null if there is no such day.
    date: str | None
    reliability: float  #: Required probability.
    reason: str | None = None  #: Reason why there is no date.


class LaboratoryPair(ResultPart):
    """Two laboratories: the second's weighted mean minus the first's, and its E_n (ISO 13528)."""

    first: str  #: First laboratory.
    second: str  #: Second laboratory.
    #: Weighted mean of the second laboratory minus the weighted mean of the first laboratory.
    difference: float
    e_n: float  #: E_n score of the difference between the two laboratories.

    @property
    def agrees(self) -> bool:
        """True if the two agree within their expanded uncertainties."""
        return abs(self.e_n) <= 1.0


class RepeatabilityComponent(ResultPart):
    """The variation of results from one turn-on, mounting or day to another."""

    #: Standard deviation in excess of the u of the results; 0 if no excess is detected.
    value: float
    low: float  #: Lower end of the 95 % interval; 0 if the component may be absent.
    high: float | None  #: Upper end of the 95 % interval; null if there is no upper limit.
    groups: int  #: Number of power cycles, mountings or days.
    freedom: int  #: Degrees of freedom in addition to those of coarser groups.
    #: Other components that always changed together with this component and are part of it.
    same_as: list[str] = []


class Repeatability(ResultPart):
    """The repeatability of results, by restricted likelihood: turn-on, remount and day."""

    #: Components for `day`, `mounting` and `turn_on`, if the results determine them.
    components: dict[str, RepeatabilityComponent]
    #: Total standard deviation between results (root sum of squares of the components).
    total: float
    #: Reference for the scatter: the mean, or the straight line if the results drift.
    about: Literal["mean", "line"]
    #: Mean of the results, weighted by the inverse of these variances; if the results drift, the
    #: value of the line at the mean date.
    value: float
    u: float  #: Standard uncertainty of the value.
    not_told: dict[str, str] = {}  #: Components that cannot be determined, each with the reason.


class InstrumentHistory(ResultPart):
    """One instrument's results, oldest first."""

    #: Serial number of the accelerometer, or otherwise the serial number of the campaign with the
    #: name of the accelerometer.
    serial_number: str
    #: Whether the serial number is that of the accelerometer or that of the campaign.
    stated_by: Literal["accelerometer", "campaign"]
    points: list[Point]  #: Results in the order of their dates.
    mean: float  #: Weighted mean.
    u_mean: float  #: Standard uncertainty of the mean.
    scatter: Scatter  #: Scatter about the mean.
    drift: Trend | None  #: Drift; None if all results have the same date.
    #: Verdict: ``single`` (one result), ``constant`` (consistent without drift), ``drifts``
    #: (consistent with a drift), ``differ`` (two dates differ, because of a drift or a jump) or
    #: ``disagree`` (the scatter exceeds the uncertainties).
    verdict: Verdict
    #: Sources of uncertainty common to several results, such as ``centrifuge.radius``.
    shared: list[str] = []
    #: Largest correlation between any two results due to these sources; null if the results are
    #: independent.
    correlation: float | None = None
    #: Control limits calculated from the results alone; null if there are fewer than three results.
    control: ControlLimits | None = None
    #: Specification; null if no result states one.
    specification: SpecificationLimits | None = None
    #: Date of the next calibration, or the reason why there is none; null in files of earlier
    #: versions.
    due: DueDate | None = None
    #: Repeatability in excess of the u of the results; null if there are too few results, and in
    #: files of earlier versions.
    repeatability: Repeatability | None = None
    laboratories: list[LaboratoryPair] = []  #: Comparison of each pair of laboratories.


class UnusedResult(ResultPart):
    """A file, or one accelerometer in it, that is not in the history, and why."""

    file: str  #: Result file.
    accelerometer: str | None = None  #: Name of the accelerometer; null means all accelerometers.
    reason: str  #: Reason for the exclusion.


class History(ReportableResult):
    """The history of all instruments."""

    BLOCKS: ClassVar[str] = "counterspin.histories.page:history_blocks"
    KIND: ClassVar[str] = "history"

    #: Coefficient; for triads, ``offset``, ``sensitivity`` or ``angle`` (difference from 90 deg).
    term: str
    unit: str  #: Unit of all values; a drift is in this unit per year.
    gravity: float  #: Gravity on which all g-units are based, m/s^2, from the latest result.
    converted: bool  #: Whether results with a different gravity were converted to `gravity`.
    instruments: list[InstrumentHistory]  #: History for each serial number.
    #: Results that cannot be used, for example results without a date or serial number, or
    #: duplicates.
    left_out: list[UnusedResult]
    damaged: list[UnusedResult]  #: Files that cannot be read, each with the reason.
    passed_over: list[str]  #: JSON files that are not results, found in the folders.
    notes: list[str]  #: Further remarks on the files, as text.

    def plot(self, *, axes: Any = None) -> list[Any]:
        """Draw the control chart of each instrument."""
        return draw_pictures(load_name("counterspin.histories.page:history_plots")(self), axes)
