"""A comparison of results, and its JSON.

Values are in the units of the coefficients, in g-units of the first result's gravity.
"""

from __future__ import annotations

from typing import Any, ClassVar, Final, Literal

from counterspin.inference.diagnostics import SIGNIFICANCE
from counterspin.reports.numbers import field_unit
from counterspin.reports.shown import ShownResult
from counterspin.results import ResultPart


class ComparedResult(ResultPart):
    """One of the results: what it is called here, and how it was made."""

    name: str  #: What it is called here.
    title: str
    method: str
    model: str
    state: str | None
    version: str
    date: str | None
    #: Its own, m/s^2, where its numbers are converted to g-units of the first result's; else None.
    gravity: float | None = None
    #: Those that it has; None in comparisons of earlier versions.
    accelerometers: list[str] | None = None

    def has(self, accelerometer: str) -> bool:
        """Return whether an accelerometer is in this result."""
        return self.accelerometers is None or accelerometer in self.accelerometers


class ComparedEstimate(ResultPart):
    """A coefficient in one result."""

    #: Estimate, standard uncertainty, degrees of freedom (None is infinite); None where it is not
    #: determined or not in the model.
    value: float | None
    u: float | None
    dof: float | None = None
    #: From the first result that determines it; None for that one itself.
    difference: float | None = None
    #: Standard uncertainty of `difference`, what both have in common being counted; 0 where nothing
    #: that is uncertain lies between the two.
    u_difference: float | None = None
    z: float | None = None  #: `difference` over `u_difference`.


class ComparedCoefficient(ResultPart):
    """A coefficient through all results: one estimate for each, in their order."""

    accelerometer: str
    term: str
    unit: str
    estimates: list[ComparedEstimate]


class AgreementOfTwo(ResultPart):
    """Whether an accelerometer's coefficients agree with those of the first result that has it."""

    #: Which.
    result: str
    accelerometer: str
    #: Whether it rests on the ``same`` records as that one, ``part`` of them are, or they are
    #: ``independent``.
    records: Literal["same", "part", "independent"]
    terms: list[str]  #: Those that both determine.
    #: Of their differences together, with `dof` directions in which they can differ; None where
    #: there is none.
    chi2: float
    dof: int
    p: float | None
    shared: list[str]  #: What moves both alike, beside the records.
    assumed: list[str]  #: What had to be assumed of their correlation, in sentences.

    @property
    def agrees(self) -> bool:
        """Whether their differences are such as chance makes."""
        return self.p is None or self.p >= SIGNIFICANCE


class Change(ResultPart):
    """Something that is not the same in all results: its words in each, in their order."""

    subject: str
    values: list[str]


#: Columns of `Compared.table`.
_COLUMNS: Final = (
    *("accelerometer", "term", "result", "value", "u", "difference", "u_difference", "z", "unit"),
)


class Compared(ShownResult):
    """Results beside each other; what one is compared with is `reference`.

    Attributes
    ----------
    gravity
        Of the g-units, m/s^2: that of the first result.
    results
        In the order in which they were given.
    coefficients
        Of all accelerometers that more than one result has.
    agreements
        Each later result with the first that has the accelerometer.
    changes
        What is not the same: files, terms, noise, options, versions.
    """

    BLOCKS: ClassVar[str] = "counterspin.comparisons.page:comparison_blocks"
    KIND: ClassVar[str] = "comparison"

    gravity: float
    results: list[ComparedResult]
    coefficients: list[ComparedCoefficient]
    agreements: list[AgreementOfTwo]
    changes: list[Change]

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
            If there is no such library.
        """
        from counterspin.calibration.notebook.tables import frame_of

        columns: dict[str, list[Any]] = {name: [] for name in _COLUMNS}
        for coefficient in self.coefficients:
            unit, factor = field_unit(coefficient.unit)
            for result, found in zip(self.results, coefficient.estimates, strict=True):
                numbers = (found.value, found.u, found.difference, found.u_difference)
                row = (
                    *(coefficient.accelerometer, coefficient.term, result.name),
                    *(None if number is None else number * factor for number in numbers),
                    *(found.z, unit),
                )
                for column, cell in zip(columns.values(), row, strict=True):
                    column.append(cell)
        return frame_of(columns, _COLUMNS[3:8], library)

    @property
    def identifier(self) -> str:
        """The names of what is compared."""
        return " / ".join(result.name for result in self.results)


class RepeatedCoefficient(ResultPart):
    """A coefficient before and now."""

    name: str  #: Such as ``Qx.K_II``, ``platform.drift.north`` or ``run1.platform.tilt.north``.
    unit: str
    #: Estimate and standard uncertainty; None where there is none.
    before: float | None
    u_before: float | None
    now: float | None
    u_now: float | None
    #: The larger change of the two: of the estimate, in parts of it or of its u, whichever is
    #: larger; of u, in parts of it. None where one has a number that the other lacks.
    relative: float | None
    in_u: float | None  #: Change of the estimate over `u_before`; None where there is no such u.


class Repeated(ShownResult):
    """A result and the same calibration made again.

    Attributes
    ----------
    result
        What was repeated: its file or title.
    same
        Whether every estimate, u and judgement is the same within `limit`.
    limit
        Largest `relative` of what counts as the same.
    largest, largest_in_u
        Of all coefficients: the largest `relative`, and the largest size of `in_u`; None where
        one has a number that the other lacks, or there is no u.
    coefficients
        All that either has.
    state_before, state_now
        Whether the result may be relied on, as it was judged and as it is.
    changes
        What is not the same beside the numbers: inputs by their checksums, versions, environment.
    moved
        Inputs that were found under another name: name in the result -> where.
    """

    BLOCKS: ClassVar[str] = "counterspin.comparisons.rerun_page:repeat_blocks"
    KIND: ClassVar[str] = "repeat of a result"

    result: str
    same: bool
    limit: float
    largest: float | None
    largest_in_u: float | None
    coefficients: list[RepeatedCoefficient]
    state_before: str | None
    state_now: str | None
    changes: list[Change]
    moved: dict[str, str] = {}
