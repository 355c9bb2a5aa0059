"""A comparison of results, and its JSON.

Values are in the units of the coefficients, in g-units of the first result's gravity.
"""

from __future__ import annotations

from typing import Any, ClassVar, Final, Literal

from counterspin.inference.diagnostics import SIGNIFICANCE
from counterspin.loading import load_name
from counterspin.reports.numbers import find_display_unit
from counterspin.results import ReportableResult, ResultPart, draw_pictures, make_frame


class ComparedResult(ResultPart):
    """A compared result: name, method and version."""

    name: str  #: Label of the result.
    title: str  #: Title of the campaign.
    method: str  #: ``joint`` or ``two-stage``.
    model: str  #: ``exact`` or ``as-printed``.
    state: str | None  #: State of the result.
    version: str  #: Version of counterspin.
    date: str | None  #: Date stated in the campaign.
    #: Gravity of the result, m/s^2, if its numbers were converted to the g-units of the first
    #: result; otherwise null.
    gravity: float | None = None
    #: Accelerometers in the result; None in comparisons of earlier versions.
    accelerometers: list[str] | None = None

    def has(self, accelerometer: str) -> bool:
        """Return whether this result has an accelerometer."""
        return self.accelerometers is None or accelerometer in self.accelerometers


class ComparedEstimate(ResultPart):
    """A coefficient in one result."""

    value: float | None  #: Estimate; null if the coefficient is not determined or not in the model.
    u: float | None  #: Standard uncertainty.
    dof: float | None = None  #: Degrees of freedom; None means infinite.
    #: Difference from the first result that determines the coefficient; null for that result.
    difference: float | None = None
    #: Standard uncertainty of `difference`, which allows for common sources; 0 if only exact
    #: quantities differ.
    u_difference: float | None = None
    z: float | None = None  #: `difference` divided by `u_difference`.


class ComparedCoefficient(ResultPart):
    """A coefficient in all results: one estimate for each result, in order."""

    accelerometer: str  #: Name of the accelerometer.
    term: str  #: Symbol of the term.
    unit: str  #: Unit of all numbers.
    estimates: list[ComparedEstimate]  #: Estimates of the results.


class PairAgreement(ResultPart):
    """The agreement of an accelerometer's coefficients with the first result that has them."""

    result: str  #: Label of the result.
    accelerometer: str  #: Name of the accelerometer.
    #: Whether both results use the ``same`` records, share ``part`` of their records, or use
    #: ``independent`` records.
    records: Literal["same", "part", "independent"]
    terms: list[str]  #: Terms that both results determine.
    chi2: float  #: Chi-square of all differences.
    dof: int  #: Degrees of freedom of the differences.
    #: Probability of a larger chi-square by chance (p-value); null if there are no degrees of
    #: freedom.
    p: float | None
    shared: list[str]  #: Sources of uncertainty common to both results, in addition to the records.
    assumed: list[str]  #: Assumptions about the correlation, as text.

    @property
    def agrees(self) -> bool:
        """True if the differences are consistent with chance."""
        return self.p is None or self.p >= SIGNIFICANCE


class Change(ResultPart):
    """A difference between results, with its text in each result."""

    #: Subject of the change, for example a file, ``terms of Qx``, ``radius`` or ``method``.
    subject: str
    #: Value in each result; for a file, the first digits of its SHA-256; ``-`` if there is no
    #: value.
    values: list[str]


#: Columns of `ResultComparison.table`.
_COLUMNS: Final = (
    *("accelerometer", "term", "result", "value", "u", "difference", "u_difference", "z", "unit"),
)


class ResultComparison(ReportableResult):
    """A comparison of results with a reference result."""

    BLOCKS: ClassVar[str] = "counterspin.comparisons.page:comparison_blocks"
    KIND: ClassVar[str] = "comparison"

    gravity: float  #: Gravity of the first result, to which all g-units refer, m/s^2.
    results: list[ComparedResult]  #: Compared results, in the order given.
    #: Coefficients of all results, for accelerometers that occur in more than one result.
    coefficients: list[ComparedCoefficient]
    #: Agreement of each later result with the first result that contains the accelerometer.
    agreements: list[PairAgreement]
    #: Differences between the results in files, terms, noise, options and versions.
    changes: list[Change]
    unsealed: list[str] = []  #: Labels of results whose files have no seal.

    def reference(self, accelerometer: str) -> ComparedResult:
        """Return the reference result of an accelerometer: the first result that contains it."""
        return next(result for result in self.results if result.has(accelerometer))

    def table(self, library: str = "polars") -> Any:
        """Return the estimates as a data frame, with a row for each coefficient and result.

        Parameters
        ----------
        library
            ``polars``, or ``pandas`` if it is installed.

        Returns
        -------
        polars.DataFrame or pandas.DataFrame
            Estimates in the usual units of the field.

        Raises
        ------
        ValueError
            If the library is unknown.
        """
        columns: dict[str, list[Any]] = {name: [] for name in _COLUMNS}
        for coefficient in self.coefficients:
            unit, factor = find_display_unit(coefficient.unit)
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
    """A coefficient in the original result and in the repeated calibration."""

    #: Name of the coefficient, such as ``Qx.K_II``, ``platform.drift.north`` or
    #: ``run1.platform.tilt.north``.
    name: str
    unit: str  #: Unit of the numbers.
    before: float | None  #: Estimate in the original result.
    u_before: float | None  #: Standard uncertainty in the original result.
    now: float | None  #: Estimate in the repeated calibration.
    u_now: float | None  #: Standard uncertainty in the repeated calibration.
    #: The larger of two relative changes: the change of u relative to u, and the change of the
    #: estimate relative to its magnitude or its u, whichever is larger; null if only one
    #: result has the number.
    relative: float | None
    #: Change of the estimate divided by `u_before`; null if there is no `u_before`.
    in_u: float | None


class RepeatedCalibration(ReportableResult):
    """A result and its repeated calibration."""

    BLOCKS: ClassVar[str] = "counterspin.comparisons.page:repeated_calibration_blocks"
    KIND: ClassVar[str] = "repeat of a result"

    result: str  #: File or title of the original result.
    same: bool  #: Whether all estimates, uncertainties and states agree within `limit`.
    limit: float  #: Value of `relative` up to which two numbers count as equal.
    #: Largest value of `relative` of all coefficients; null if only one of the two results has a
    #: number.
    largest: float | None
    largest_in_u: float | None  #: Largest magnitude of `in_u`; null if there is no u.
    coefficients: list[RepeatedCoefficient]  #: Coefficients of both results.
    state_before: str | None  #: State of the original result.
    state_now: str | None  #: State of the repeated calibration.
    changes: list[Change]  #: Other differences: input checksums, versions and environment.
    #: Inputs that were found under another name, each with its name in the result and its path.
    moved: dict[str, str] = {}
    unsealed: list[str] = []  #: Label of the original result, if its file has no seal.


class DegreeOfEquivalence(ResultPart):
    """A laboratory's value, and its difference from the reference value."""

    value: float  #: Measured value.
    u: float  #: Standard uncertainty of `value`.
    member: bool  #: Whether the value contributes to the reference value.
    d: float | None = None  #: Value minus reference value; None without a reference value.
    #: Expanded uncertainty of `d` (k = 2), allowing for all covariances.
    expanded_u_d: float | None = None
    #: `d` divided by `expanded_u_d` (ISO 13528); satisfactory if the magnitude is at most 1.
    e_n: float | None = None
    zeta: float | None = None  #: `d` divided by its standard uncertainty (ISO 13528).


class PairwiseDegree(ResultPart):
    """The difference of two laboratories: second minus first."""

    first: str  #: Name of the first laboratory.
    second: str  #: Name of the second laboratory.
    d: float  #: Second value minus first value.
    expanded_u_d: float  #: Expanded uncertainty of `d` (k = 2).
    e_n: float  #: `d` divided by `expanded_u_d`.


class ReferenceValue(ResultPart):
    """The reference value of a coefficient, and the degrees of equivalence."""

    accelerometer: str  #: Name of the accelerometer.
    term: str  #: Symbol of the term.
    unit: str  #: Unit of all numbers.
    chi2: float  #: Chi-square of all laboratories about their weighted mean.
    dof: int  #: Degrees of freedom of `chi2`.
    p: float  #: Probability of a larger chi-square by chance.
    consistent: bool  #: Whether ``p`` is at least the significance level.
    #: Weighted mean of the largest consistent subset; None if no two laboratories are consistent.
    value: float | None = None
    u: float | None = None  #: Standard uncertainty of the reference value.
    p_members: float | None = None  #: `p` of the largest consistent subset.
    #: Other consistent subsets of the same size, with larger chi-square.
    alternatives: list[list[str]] = []
    #: Uncertainty sources common to several laboratories, included as covariances.
    shared: list[str] = []
    degrees: dict[str, DegreeOfEquivalence]  #: Degree of equivalence of each laboratory.
    pairs: list[PairwiseDegree]  #: Differences between all pairs of laboratories.


class Intercomparison(ReportableResult):
    """A comparison of laboratories that calibrated the same instrument."""

    BLOCKS: ClassVar[str] = "counterspin.comparisons.intercomparison_page:intercomparison_blocks"
    KIND: ClassVar[str] = "intercomparison"

    gravity: float  #: Gravity on which all g-units are based, m/s^2, from the first result.
    significance: float  #: Significance level of the chi-square test.
    laboratories: list[str]  #: Names of the laboratories, in the given order.
    references: list[ReferenceValue]  #: Reference value of each coefficient.
    assumed: list[str] = []  #: Assumptions about common sources, as sentences.
    unsealed: list[str] = []  #: Laboratories whose result files have no seal.

    def plot(self, *, axes: Any = None) -> list[Any]:
        """Draw the degrees of equivalence of each coefficient, and a Youden plot of two."""
        make_plots = load_name("counterspin.comparisons.intercomparison_page:intercomparison_plots")
        return draw_pictures(make_plots(self), axes)

    @property
    def identifier(self) -> str:
        """The names of the laboratories."""
        return " / ".join(self.laboratories)
