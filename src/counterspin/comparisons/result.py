"""A comparison of results, and its JSON.

Values are in the units of the coefficients, in g-units of the first result's gravity.
"""

from __future__ import annotations

from typing import Any, ClassVar, Final, Literal

from counterspin.inference.diagnostics import SIGNIFICANCE
from counterspin.reports.numbers import field_unit
from counterspin.results import ReportableResult, ResultPart, make_frame


class ComparedResult(ResultPart):
    """One of the results: its name in the comparison, and its method."""

    name: str  #: What it is called here.
    title: str  #: Of its campaign.
    method: str  #: ``joint`` or ``two-stage``.
    model: str  #: ``exact`` or ``as-printed``.
    state: str | None  #: Whether it may be relied on.
    version: str  #: Of counterspin.
    date: str | None  #: As its campaign states it.
    #: Its own, m/s^2, where its numbers are converted to g-units of the first result's; else None.
    gravity: float | None = None
    #: Those that it has; None in comparisons of earlier versions.
    accelerometers: list[str] | None = None

    def has(self, accelerometer: str) -> bool:
        """Check for an accelerometer in this result."""
        return self.accelerometers is None or accelerometer in self.accelerometers


class ComparedEstimate(ResultPart):
    """A coefficient in one result."""

    value: float | None  #: Estimate; None where it is not determined or not in the model.
    u: float | None  #: Standard uncertainty.
    dof: float | None = None  #: Degrees of freedom; None is infinite.
    #: From the first result that determines it; None for that one itself.
    difference: float | None = None
    #: Standard uncertainty of `difference`, what both have in common being counted; 0 where nothing
    #: that is uncertain lies between the two.
    u_difference: float | None = None
    z: float | None = None  #: `difference` over `u_difference`.


class ComparedCoefficient(ResultPart):
    """A coefficient through all results: one estimate for each, in their order."""

    accelerometer: str  #: Its name.
    term: str  #: Symbol.
    unit: str  #: Of all its numbers.
    estimates: list[ComparedEstimate]  #: One for each result.


class AgreementOfTwo(ResultPart):
    """The agreement of an accelerometer's coefficients with the first result that has them."""

    result: str  #: Which result.
    accelerometer: str  #: Which accelerometer.
    #: Whether it rests on the ``same`` records as that one, ``part`` of them are, or they are
    #: ``independent``.
    records: Literal["same", "part", "independent"]
    terms: list[str]  #: Those that both determine.
    chi2: float  #: Of their differences together.
    dof: int  #: Directions in which these can differ.
    p: float | None  #: Probability of more by chance; None without a degree of freedom.
    shared: list[str]  #: Sources that move both results alike, in addition to the records.
    assumed: list[str]  #: What had to be assumed of their correlation, in sentences.

    @property
    def agrees(self) -> bool:
        """True if the differences are consistent with chance."""
        return self.p is None or self.p >= SIGNIFICANCE


class Change(ResultPart):
    """A difference between results: its words in each result, in their order."""

    subject: str  #: What: a file, ``terms of Qx``, ``radius``, ``method`` and so on.
    values: list[str]  #: In each result; a file by the first digits of its SHA-256, ``-`` for none.


#: Columns of `ResultComparison.table`.
_COLUMNS: Final = (
    *("accelerometer", "term", "result", "value", "u", "difference", "u_difference", "z", "unit"),
)


class ResultComparison(ReportableResult):
    """A comparison of results; `reference` is the result that the others are compared with."""

    BLOCKS: ClassVar[str] = "counterspin.comparisons.page:comparison_blocks"
    KIND: ClassVar[str] = "comparison"

    gravity: float  #: Of the g-units, m/s^2: that of the first result.
    results: list[ComparedResult]  #: Those compared, in the order in which they were given.
    #: Each through all results, of all accelerometers that more than one result has.
    coefficients: list[ComparedCoefficient]
    #: Each later result with the first that has the accelerometer.
    agreements: list[AgreementOfTwo]
    changes: list[Change]  #: What is not the same: files, terms, noise, options, versions.
    unsealed: list[str] = []  #: Names of the results whose files have no seal.

    def reference(self, accelerometer: str) -> ComparedResult:
        """Return the first result that has an accelerometer: the others are compared with it."""
        return next(result for result in self.results if result.has(accelerometer))

    def table(self, library: str = "polars") -> Any:
        """Return the estimates as a frame, a row for each coefficient and result.

        Parameters
        ----------
        library
            ``polars``, or ``pandas`` where it is installed.

        Returns
        -------
        polars.DataFrame or pandas.DataFrame
            In the units of the field.

        Raises
        ------
        ValueError
            If the library is unknown.
        """
        columns: dict[str, list[Any]] = {name: [] for name in _COLUMNS}
        for coefficient in self.coefficients:
            unit, factor = field_unit(coefficient.unit)
            for result, estimate in zip(self.results, coefficient.estimates, strict=True):
                numbers = (estimate.value, estimate.u, estimate.difference, estimate.u_difference)
                row = (
                    *(coefficient.accelerometer, coefficient.term, result.name),
                    *(None if number is None else number * factor for number in numbers),
                    *(estimate.z, unit),
                )
                for column, cell in zip(columns.values(), row, strict=True):
                    column.append(cell)
        return make_frame(columns, _COLUMNS[3:8], library)

    @property
    def identifier(self) -> str:
        """The names of the compared results."""
        return " / ".join(result.name for result in self.results)


class RepeatedCoefficient(ResultPart):
    """A coefficient before and now."""

    name: str  #: Such as ``Qx.K_II``, ``platform.drift.north`` or ``run1.platform.tilt.north``.
    unit: str  #: Of its numbers.
    before: float | None  #: Estimate in the result.
    u_before: float | None  #: Its standard uncertainty.
    now: float | None  #: Estimate made again.
    u_now: float | None  #: Its standard uncertainty.
    #: The larger change of the two: of the estimate, in parts of it or of its u, whichever is
    #: larger; of u, in parts of it. None where one has a number that the other lacks.
    relative: float | None
    in_u: float | None  #: Change of the estimate over `u_before`; None without `u_before`.


class RepeatedCalibration(ReportableResult):
    """A result and the same calibration made again."""

    BLOCKS: ClassVar[str] = "counterspin.comparisons.page:repeat_blocks"
    KIND: ClassVar[str] = "repeat of a result"

    result: str  #: What was repeated: its file or title.
    same: bool  #: Whether every estimate, u and judgement is the same within `limit`.
    limit: float  #: Largest `relative` of equal numbers.
    #: The largest `relative` of all coefficients; None where one has a number that the other lacks.
    largest: float | None
    largest_in_u: float | None  #: The largest size of `in_u`; None without u.
    coefficients: list[RepeatedCoefficient]  #: All that either result has.
    state_before: str | None  #: Whether the result may be relied on, as it was judged.
    state_now: str | None  #: The same now.
    #: Differences other than in the numbers: inputs by their checksums, versions,
    #: environment.
    changes: list[Change]
    #: Inputs that were found under another name: name in the result -> where.
    moved: dict[str, str] = {}
    unsealed: list[str] = []  #: The name of the result, if its file has no seal.
