"""A history: the results of each instrument over time; its JSON.

Values are in the unit of the term, in g-units of one gravity, which is stated.

- `History`: all of it
- `InstrumentHistory`, `Point`, `Scatter`, `Trend`: one instrument's results and their analysis
- `ControlLimits`, `SpecificationLimits`, `Due`, `LaboratoryPair`: limits, interval, comparison
- `UnusedResult`: what could not be used, and why
"""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from counterspin.reports.shown import ShownResult, loaded, on_axes
from counterspin.results import ResultPart

#: Whether the results of an instrument agree.
Verdict = Literal["single", "constant", "drifts", "differ", "disagree"]


class Point(ResultPart):
    """One result.

    Attributes
    ----------
    date
        Of the campaign, as ISO 8601.
    file
        The result's file.
    accelerometer
        Its name in that campaign.
    method
        ``joint`` or ``two-stage``.
    value, u, dof
        Estimate, standard uncertainty, degrees of freedom (None is infinite).
    difference, z
        From the weighted mean, and over the standard uncertainty of this difference; None for one
        result alone.
    e_n
        E_n score against the result before; None for the first.
    laboratory
        Of the campaign; None where it states none.
    """

    date: str
    file: str
    accelerometer: str
    method: str
    value: float
    u: float
    dof: float | None
    difference: float | None
    z: float | None
    e_n: float | None
    laboratory: str | None = None


class Scatter(ResultPart):
    """How results scatter about a mean or a line; p and Birge ratio need a degree of freedom."""

    chi2: float
    dof: int
    p: float | None
    birge: float | None


class Trend(ResultPart):
    """A straight line through the results: change per year of 365.25 days.

    Attributes
    ----------
    value, u
        Drift and its standard uncertainty, in the term's unit per year.
    p
        Probability of a drift as large by chance.
    date
        Weighted mean date, ISO 8601.
    level, u_level
        The line there.
    scatter
        About the line.
    """

    value: float
    u: float
    p: float
    date: str
    level: float
    u_level: float
    scatter: Scatter


class ControlLimits(ResultPart):
    """Individuals and moving range, from the results alone (NIST/SEMATECH e-Handbook, 6.3.2.2).

    Attributes
    ----------
    centre
        Mean of the results, not weighted.
    warning_low, warning_high, action_low, action_high
        At two and at three standard deviations, these from the mean moving range.
    mean_range, range_limit
        Mean moving range, and its upper action limit.
    beyond
        Files of the results beyond the action limits.
    leaps
        Files of the results that differ from the one before by more than `range_limit`.
    """

    centre: float
    warning_low: float
    warning_high: float
    action_low: float
    action_high: float
    mean_range: float
    range_limit: float
    beyond: list[str]
    leaps: list[str]


class SpecificationLimits(ResultPart):
    """The specification of the latest result that has one, its limits in the term's unit."""

    low: float | None
    high: float | None
    words: str


class Due(ResultPart):
    """When the instrument is due again.

    Attributes
    ----------
    date
        Last day on which it is in specification with `reliability`, by the line; None: see reason.
    reliability
        Probability.
    reason
        Why there is no date.
    """

    date: str | None
    reliability: float
    reason: str | None = None


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
    """One instrument's results, oldest first.

    Attributes
    ----------
    serial_number
        The accelerometer's; or the campaign's and the accelerometer's name.
    stated_by
        Which of the two.
    points
        The results.
    mean, u_mean, scatter
        Weighted mean, its standard uncertainty, and the scatter about it.
    drift
        None where all results are of one date.
    verdict
        ``single``: one result; ``constant``: they agree and do not drift; ``drifts``: they agree
        with a line that is not level; ``differ``: two dates differ, by drift or by a jump;
        ``disagree``: they scatter by more than their uncertainties.
    shared
        What results have in common, such as ``centrifuge.radius``.
    correlation
        The largest of two results that follows; None: they are independent.
    control
        Limits from the results alone; None for fewer than three.
    specification
        None where no result has one.
    due
        When it is due again, or why nothing can be said; None in files of earlier versions.
    laboratories
        Each pair of those that the results name.
    """

    serial_number: str
    stated_by: Literal["accelerometer", "campaign"]
    points: list[Point]
    mean: float
    u_mean: float
    scatter: Scatter
    drift: Trend | None
    verdict: Verdict
    shared: list[str] = []
    correlation: float | None = None
    control: ControlLimits | None = None
    specification: SpecificationLimits | None = None
    due: Due | None = None
    laboratories: list[LaboratoryPair] = []


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

    FACE: ClassVar[str] = "counterspin.histories.page:render_history"
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
