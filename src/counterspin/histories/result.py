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

    date: str  #: Of the campaign, as ISO 8601; UTC where it states a zone.
    file: str  #: The result's file.
    accelerometer: str  #: Its name in that campaign; both, of an angle.
    method: str  #: ``joint`` or ``two-stage``.
    value: float  #: The estimate.
    u: float  #: Its standard uncertainty.
    dof: float | None  #: Degrees of freedom; None is infinite.
    difference: float | None  #: From the weighted mean; None for one result alone.
    z: float | None  #: The difference over its own standard uncertainty; None likewise.
    e_n: float | None  #: E_n score against the result before; None for the first.
    laboratory: str | None = None  #: Of the campaign; None where it states none.
    mounting: str | None = None  #: Its name in the campaign; None likewise.
    turn_on: str | None = None  #: Its name in the campaign; None likewise.


class Scatter(ResultPart):
    """The scatter of results about a mean or a line; p and Birge ratio need a degree of freedom."""

    chi2: float  #: Sum of squared differences over u.
    dof: int  #: Its degrees of freedom.
    p: float | None  #: Probability of more; None without a degree of freedom.
    birge: float | None  #: Root of chi2/dof; None likewise.


class Trend(ResultPart):
    """A straight line through the results: change per year of 365.25 days."""

    value: float  #: Drift, in the term's unit per year.
    u: float  #: Its standard uncertainty.
    p: float  #: Probability of a drift as large by chance.
    date: str  #: Weighted mean date, ISO 8601.
    level: float  #: The line there.
    u_level: float  #: Its standard uncertainty.
    scatter: Scatter  #: About the line.


class ControlLimits(ResultPart):
    """Individuals and moving range, from the results alone (NIST/SEMATECH e-Handbook, 6.3.2.2)."""

    centre: float  #: Mean of the results, not weighted.
    warning_low: float  #: Lower warning limit.
    warning_high: float  #: Upper warning limit.
    action_low: float  #: Lower action limit.
    action_high: float  #: Upper action limit.
    mean_range: float  #: Mean moving range.
    range_limit: float  #: Its upper action limit.
    beyond: list[str]  #: Files of the results beyond the action limits.
    #: Files of the results that differ from the one before by more than `range_limit`.
    leaps: list[str]


class SpecificationLimits(ResultPart):
    """The specification of the latest result that has one, its limits in the term's unit."""

    low: float | None  #: Lower limit; None: none.
    high: float | None  #: Upper limit; None: none.
    words: str  #: As it was written.


class Due(ResultPart):
    """The date when the next calibration of the instrument is due."""

    #: Last day on which it is in specification with `reliability`, by the line; None: see reason.
    date: str | None
    reliability: float  #: Probability.
    reason: str | None = None  #: The reason for a missing date.


class LaboratoryPair(ResultPart):
    """Two laboratories: the second's weighted mean minus the first's, and its E_n (ISO 13528)."""

    first: str  #: A laboratory.
    second: str  #: Another one.
    difference: float  #: Its weighted mean minus the first's.
    e_n: float  #: Their E_n.

    @property
    def agrees(self) -> bool:
        """True if the two agree within their expanded uncertainties."""
        return abs(self.e_n) <= 1.0


class RepeatComponent(ResultPart):
    """The variation of results from one turn-on, mounting or day to another."""

    value: float  #: Standard deviation beyond the u of the results; 0: nothing is seen.
    low: float  #: Lower end of its 95 % interval; 0: there may be nothing.
    high: float | None  #: Upper end; None: no limit.
    groups: int  #: How many turn-ons, mountings or days there are.
    freedom: int  #: What they tell beyond coarser ones: degrees of freedom.
    same_as: list[str] = []  #: What else changed whenever this did, and is part of it.


class Repeatability(ResultPart):
    """The repeatability of results, by restricted likelihood: turn-on, remount and day."""

    #: By ``day``, ``mounting`` and ``turn_on``, as far as the results tell.
    components: dict[str, RepeatComponent]
    total: float  #: Root of the sum of their squares: from one result to any other.
    about: Literal["mean", "line"]  #: About the mean, or about the line where they drift.
    value: float  #: The mean with these variances; of a line, that at the mean date.
    u: float  #: Its standard uncertainty.
    not_told: dict[str, str] = {}  #: What of the three cannot be told, and why.


class InstrumentHistory(ResultPart):
    """One instrument's results, oldest first."""

    serial_number: str  #: The accelerometer's; or the campaign's and the accelerometer's name.
    stated_by: Literal["accelerometer", "campaign"]  #: Which of the two.
    points: list[Point]  #: The results.
    mean: float  #: Weighted mean.
    u_mean: float  #: Its standard uncertainty.
    scatter: Scatter  #: About the mean.
    drift: Trend | None  #: None where all results are of one date.
    #: ``single``: one result; ``constant``: they agree and do not drift; ``drifts``: they agree
    #: with a line that is not level; ``differ``: two dates differ, by drift or by a jump;
    #: ``disagree``: they scatter by more than their uncertainties.
    verdict: Verdict
    shared: list[str] = []  #: What results have in common, such as ``centrifuge.radius``.
    #: The largest of two results that follows; None: they are independent.
    correlation: float | None = None
    #: Limits from the results alone; None for fewer than three.
    control: ControlLimits | None = None
    specification: SpecificationLimits | None = None  #: None where no result has one.
    #: When it is due again, or why nothing can be said; None in files of earlier versions.
    due: Due | None = None
    #: What they vary by beyond their u; None for too few, and in files of earlier versions.
    repeatability: Repeatability | None = None
    laboratories: list[LaboratoryPair] = []  #: Each pair of those that the results name.


class UnusedResult(ResultPart):
    """A file, or one accelerometer in it, that is not in the history, and why."""

    file: str  #: The file.
    accelerometer: str | None = None  #: Which of its accelerometers; None is all.
    reason: str  #: Why.


class History(ReportableResult):
    """The history of all instruments."""

    BLOCKS: ClassVar[str] = "counterspin.histories.page:history_blocks"
    KIND: ClassVar[str] = "history"

    #: The coefficient, or ``offset``, ``sensitivity`` or ``angle`` (minus 90 deg) of triads.
    term: str
    unit: str  #: Of every value; of a drift, per year.
    gravity: float  #: Of the g-units, m/s^2: that of the latest result.
    converted: bool  #: Whether results of another gravity were converted to it.
    instruments: list[InstrumentHistory]  #: One for each serial number.
    #: Results that cannot be used: without a date or serial number, or duplicates.
    left_out: list[UnusedResult]
    damaged: list[UnusedResult]  #: Files that cannot be read, and why.
    passed_over: list[str]  #: JSON files in the folders that are not results.
    notes: list[str]  #: Further remarks about the files, in sentences.

    def plot(self, *, axes: Any = None) -> list[Any]:
        """Draw the control chart of each instrument."""
        return draw_pictures(load_name("counterspin.histories.page:history_plots")(self), axes)
