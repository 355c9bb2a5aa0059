"""`counterspin apply`: indicated specific force, corrected with a result."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from counterspin.cli.common import OnOff, OutputFolder, command, option_group
from counterspin.errors import UsageError
from counterspin.frozen import frozen


def _require_non_negative(_: object, value: int | None) -> None:
    """Validate like `cyclopts.validators.Number`, which would slow down every command."""
    if value is not None and value < 0:
        raise ValueError("Must be >= 0.")


@option_group
@frozen
class ForceOptions:
    """Column and unit of the forces, and forces along the other axes.

    Parameters
    ----------
    column
        Column to correct; required if several columns are possible.
    unit
        Unit of the forces in the table: g, m/s^2, mg, or the unit of the calibrated output, such as
        count. If the table is in that last unit, the corrected forces are in g.
    pendulous
        Specific force along the pendulous axis: a column, or a constant such as "-1 g".
    output_axis
        Specific force along the output axis, in the same form.
    temperature
        Temperature of the accelerometer: a column in degC, or a constant such as "23 ± 1 degC".
    others
        Other accelerometers on the same platform, from which counterspin computes both cross-axis
        forces: Qy=COLUMN,Qz=COLUMN.
    force
        Also apply a result of the equations as printed in the paper, whose K_II is half the true
        value.
    """

    column: Annotated[str | None, Parameter(name="--input")] = None
    unit: str = "g"
    pendulous: Annotated[str | None, Parameter(allow_leading_hyphen=True)] = None
    output_axis: Annotated[str | None, Parameter(allow_leading_hyphen=True)] = None
    temperature: Annotated[str | None, Parameter(allow_leading_hyphen=True)] = None
    others: str | None = None
    force: bool = False


@option_group
@frozen
class FileOptions:
    """Format of the file, if it is not detected; keys as in [records] of a campaign.

    Parameters
    ----------
    skip_lines
        Number of lines above the column names.
    delimiter
        Character that separates the cells.
    decimal
        Decimal separator of the numbers.
    encoding
        Encoding of the text, such as latin-1.
    units_row
        Whether a row of units follows the column names.
    sheet
        Sheet of an Excel file.
    group
        Group of an HDF5 or TDMS file, or structure of a MATLAB file.
    """

    skip_lines: Annotated[int | None, Parameter(validator=_require_non_negative)] = None
    delimiter: Literal[",", ";", "tab"] | None = None
    decimal: Literal[".", ","] | None = None
    encoding: str | None = None
    units_row: OnOff | None = None
    sheet: str | None = None
    group: str | None = None


_DEFAULT_FORCES, _DEFAULT_FORMAT = ForceOptions(), FileOptions()


@command
def apply(
    result: Path,
    file: Path,
    /,
    *,
    output: OutputFolder,
    accelerometer: str | None = None,
    force_options: ForceOptions = _DEFAULT_FORCES,
    file_options: FileOptions = _DEFAULT_FORMAT,
    overwrite: bool = False,
) -> None:
    """Correct the output of a calibrated accelerometer.

    Parameters
    ----------
    result
        Result written by `counterspin calibrate --json`.
    file
        Record file with a column for the output of the accelerometer, such as .csv, .parquet, .h5
        or .mat.
    output
        Output file: the table with two additional columns, the corrected specific force and its
        uncertainty.
    accelerometer
        Accelerometer to correct. Default: the only accelerometer of the result, every
        accelerometer in --others, or all three of a triad if the columns carry their names.
    overwrite
        Replace an earlier corrected file; other files are never replaced.
    """
    from counterspin.calibration.result import Result
    from counterspin.correction.apply import ApplyOptions
    from counterspin.correction.apply_file import apply_file
    from counterspin.correction.page import correction_report
    from counterspin.records.dialect import Dialect
    from counterspin.reports.text import make_console

    dialect_keys = vars(file_options) | {
        "delimiter": "\t" if file_options.delimiter == "tab" else file_options.delimiter
    }
    correction = apply_file(
        Result.read(result),
        accelerometer,
        file,
        output,
        column=force_options.column,
        options=ApplyOptions(
            unit=force_options.unit,
            pendulous=force_options.pendulous,
            output_axis=force_options.output_axis,
            temperature=force_options.temperature,
            others=parse_others(force_options.others),
            force=force_options.force,
            dialect=Dialect(**dialect_keys),
        ),
        overwrite=overwrite,
    )
    make_console().print(correction_report(correction))


def parse_others(text: str | None) -> dict[str, str]:
    """Parse ``"Qy=COLUMN,Qz=COLUMN"``; raises UsageError for other text."""
    columns = {}
    for pair in text.split(",") if text else []:
        name, separator, column = (part.strip() for part in pair.partition("="))
        if not (name and separator and column) or name in columns:
            raise UsageError(
                "apply", [f"--others: {text!r} is not of the form Qy=COLUMN,Qz=COLUMN"]
            )
        columns[name] = column
    return columns
