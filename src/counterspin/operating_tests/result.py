"""Results of operating tests, and their JSON."""

from __future__ import annotations

from typing import Any, ClassVar, Final

from counterspin.results import ReportableResult, ResultPart, make_frame


class OperatingQuantity(ResultPart):
    """The result of one operating test."""

    name: str  #: Name of the test, such as ``hysteresis-error``.
    value: float | None  #: Value in `unit`; null if the data do not determine it.
    u: float | None  #: Standard uncertainty in `unit`.
    unit: str  #: Unit of the value.
    percent: float | None  #: Value in percent of full scale; null if it is not meaningful.
    u_percent: float | None  #: Standard uncertainty of `percent`.
    at: float | None  #: Input at which the value was found; null if there is none.
    note: str  #: Definition of the quantity, or the reason why it is not determined.


_COLUMNS: Final = ("name", "value", "u", "unit", "percent", "u_percent")


class OperatingTests(ReportableResult):
    """The operating tests of an accelerometer from one table."""

    BLOCKS: ClassVar[str] = "counterspin.operating_tests.page:operating_blocks"
    KIND: ClassVar[str] = "result of operating tests"

    file: str  #: Name of the file.
    sha256: str  #: SHA-256 of the file.
    version: str  #: Version of counterspin.
    input_unit: str  #: Unit of the inputs.
    output_unit: str  #: Unit of the outputs.
    full_scale: float  #: Full scale of the input.
    noise: float  #: Noise standard deviation of a single output, in `output_unit`.
    noise_dof: float  #: Degrees of freedom of `noise`.
    #: Whether the noise was estimated from repeats at the same input; otherwise, from residuals.
    noise_from_repeats: bool
    quantities: list[OperatingQuantity]  #: Results of the tests.
    time: list[float]  #: Times of the rows, s, at most 2,000; empty without a time column.
    inputs: list[float]  #: Inputs in the order of the file, at most 2,000; empty for a warm-up.
    outputs: list[float]  #: Outputs of the same rows.

    def quantity(self, name: str) -> OperatingQuantity:
        """Return the result of a test by name."""
        return next(quantity for quantity in self.quantities if quantity.name == name)

    def table(self, library: str = "polars") -> Any:
        """Return the results as a frame, a row for each test.

        Parameters
        ----------
        library
            ``polars``, or ``pandas`` where it is installed.

        Raises
        ------
        ValueError
            If the library is unknown.
        """
        columns = {name: [getattr(row, name) for row in self.quantities] for name in _COLUMNS}
        return make_frame(columns, ("value", "u", "percent", "u_percent"), library)
