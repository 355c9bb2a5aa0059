"""A history: the results of each instrument over time; its JSON.

Values are in the unit of the term, in g-units of one gravity, which is stated.
"""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from counterspin.reports.shown import ShownResult, loaded, on_axes
from counterspin.results import ResultPart

#: Whether the results of an instrument agree.
Verdict = Literal["single", "constant", "drifts", "differ", "disagree"]


class Point(ResultPart):
    """One result."""

    date: str  #: Of the campaign, as ISO 8601.
    file: str  #: The result's file.
    accelerometer: str  #: Its name in that campaign.
    method: str  #: ``joint`` or ``two-stage``.
    #: Estimate, standard uncertainty, degrees of freedom (None is infinite).
    value: float
    u: float
    dof: float | None
    #: From the weighted mean, and over the standard uncertainty of this difference; None for one
    #: result alone.
    difference: float | None
    z: float | None
    e_n: float | None  #: E_n score against the result before; None for the first.
    laboratory: str | None = None  #: Of the campaign; None where it states none.


class Scatter(ResultPart):
    """How results scatter about a mean or a line; p and Birge ratio need a degree of freedom."""

    chi2: float
    dof: int
    p: float | None
    birge: float | None


class Trend(ResultPart):
    """A straight line through the results: change per year of 365.25 days."""

    #: Drift and its standard uncertainty, in the term's unit per year.
    value: float
    u: float
    p: float  #: Probability of a drift as large by chance.
    date: str  #: Weighted mean date, ISO 8601.
    #: The line there.
    level: float
    u_level: float
    scatter: Scatter  #: About the line.


class ControlLimits(ResultPart):
    """Individuals and moving range, from the results alone (NIST/SEMATECH e-Handbook, 6.3.2.2)."""

    centre: float  #: Mean of the results, not weighted.
    #: At two and at three standard deviations, these from the mean moving range.
    warning_low: float
    warning_high: float
    action_low: float
    action_high: float
    #: Mean moving range, and its upper action limit.
    mean_range: float
    range_limit: float
    beyond: list[str]  #: Files of the results beyond the action limits.
    #: Files of the results that differ from the one before by more than `range_limit`.
    leaps: list[str]


class SpecificationLimits(ResultPart):
    """The specification of the latest result that has one, its limits in the term's unit."""

    low: float | None
    high: float | None
    words: str


class Due(ResultPart):
    """When the instrument is due again."""

    #: Last day on which it is in specification with `reliability`, by the line; None: see reason.
    date: str | None
    reliability: float  #: Probability.
    reason: str | None = None  #: Why there is no date.


class LaboratoryPair(ResultPart):
    """Two laboratories: the second's weighted mean less the first's, and its E_n (ISO 13528)."""

    first: str
    second: str
    difference: float
    e_n: float

    @property
    def agrees(self) -> bool:
        """Whether the two agree within their expanded uncertainties."""
        return abs(self.e_n) <= 1.0


class InstrumentHistory(ResultPart):
    """One instrument's results, oldest first."""

    serial_number: str  #: The accelerometer's; or the campaign's and the accelerometer's name.
    stated_by: Literal["accelerometer", "campaign"]  #: Which of the two.
    points: list[Point]  #: The results.
    #: Weighted mean, its standard uncertainty, and the scatter about it.
    mean: float
    u_mean: float
    scatter: Scatter
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
    laboratories: list[LaboratoryPair] = []  #: Each pair of those that the results name.


class UnusedResult(ResultPart):
    """A file, or one accelerometer in it, that is not in the history, and why."""

    file: str
    accelerometer: str | None = None
    reason: str


class History(ShownResult):
    """The history of all instruments.

    Attributes
    ----------
    term, unit
        The coefficient and its unit.
    gravity
        Of the g-units, m/s^2: that of the latest result.
    converted
        Whether results of another gravity were converted to it.
    instruments
        By serial number.
    left_out
        Results that cannot be used: without a date or serial number, or duplicates.
    damaged
        Files that cannot be read.
    passed_over
        Files in the folders that are not results.
    notes
        Further remarks about the files, in sentences.
    """

    BLOCKS: ClassVar[str] = "counterspin.histories.page:history_blocks"
    KIND: ClassVar[str] = "history"

    term: str
    unit: str
    gravity: float
    converted: bool
    instruments: list[InstrumentHistory]
    left_out: list[UnusedResult]
    damaged: list[UnusedResult]
    passed_over: list[str]
    notes: list[str]

    def plot(self, *, axes: Any = None) -> list[Any]:
        """Draw the control chart of each instrument."""
        return on_axes(list(loaded("counterspin.histories.page:history_plots")(self)), axes)
