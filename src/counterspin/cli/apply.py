"""`counterspin apply`: indicated specific force, corrected with a result."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from counterspin.cli.words import OnOff, OutputFolder, group
from counterspin.errors import CampaignError
from counterspin.frozen import frozen


def _check_count(_: object, value: int | None) -> None:
    """As `cyclopts.validators.Number`, which every command would load at its start."""
    if value is not None and value < 0:
        raise ValueError("Must be >= 0.")


@group
@frozen
class Forces:
    """What the file's numbers are, and what is known of the other axes.

    Parameters
    ----------
    column
        The column to correct; may be left out where only one is possible.
    unit
        Unit of the table's forces: g, m/s^2, mg; or of the outputs that were calibrated, such as
        count: then the corrected forces are in g.
    pendulous
        Specific force along the pendulous axis: a column, or a constant such as "-1 g".
    output_axis
        Specific force along the output axis, likewise.
    temperature
        How warm it was: a column in degC, or a constant such as "23 ± 1 degC".
    others
        Accelerometers beside it, from which both follow: Qy=COLUMN,Qz=COLUMN.
    force
        Apply even a result of the equations as printed, whose K_II is half the true one.
    """

    column: Annotated[str | None, Parameter(name="--input")] = None
    unit: str = "g"
    pendulous: Annotated[str | None, Parameter(allow_leading_hyphen=True)] = None
    output_axis: Annotated[str | None, Parameter(allow_leading_hyphen=True)] = None
    temperature: Annotated[str | None, Parameter(allow_leading_hyphen=True)] = None
    others: str | None = None
    force: bool = False


@group
@frozen
class Written:
    """How the file is written, where it does not show; as [records] of a campaign says it.

    Parameters
    ----------
    skip_lines
        Lines before the names of the columns.
    delimiter
        Between its cells.
    decimal
        In its numbers.
    encoding
        Of its text, such as latin-1.
    units_row
        Whether a row of units stands below the names.
    sheet
        Of an Excel file.
    group
        Of an HDF5 or TDMS file, or the structure of a MATLAB file.
    """

    skip_lines: Annotated[int | None, Parameter(validator=_check_count)] = None
    delimiter: Literal[",", ";", "tab"] | None = None
    decimal: Literal[".", ","] | None = None
    encoding: str | None = None
    units_row: OnOff | None = None
    sheet: str | None = None
    group: str | None = None


_ALONE, _PLAIN = Forces(), Written()


def apply(
    result: Path,
    file: Path,
    /,
    *,
    output: OutputFolder,
    accelerometer: str | None = None,
    forces: Forces = _ALONE,
    written: Written = _PLAIN,
    overwrite: bool = False,
) -> None:
    """Correct indicated specific force for a calibrated accelerometer.

    Parameters
    ----------
    result
        Result that `counterspin calibrate --json` wrote.
    file
        Record file with a column of indicated specific force, such as .csv, .parquet, .h5 or .mat.
    output
        File to write: the table and two more columns, corrected force and its uncertainty.
    accelerometer
        Which of the result's accelerometers it is. Left out: all that --others names are corrected,
        or all three of a triad whose columns have their names.
    overwrite
        Replace an earlier corrected file; never another file.
    """
    from counterspin.calibration.result import Result
    from counterspin.correction.apply import ApplyOptions
    from counterspin.correction.apply_file import apply_file
    from counterspin.correction.page import render_application
    from counterspin.records.dialect import Dialect
    from counterspin.reports.text import report_console

    keys = vars(written) | {"delimiter": "\t" if written.delimiter == "tab" else written.delimiter}
    done = apply_file(
        Result.read(result),
        accelerometer,
        file,
        output,
        column=forces.column,
        options=ApplyOptions(
            unit=forces.unit,
            pendulous=forces.pendulous,
            output_axis=forces.output_axis,
            temperature=forces.temperature,
            others=parse_others(forces.others),
            force=forces.force,
            dialect=Dialect(**keys),
        ),
        overwrite=overwrite,
    )
    report_console().print(render_application(done))


def parse_others(text: str | None) -> dict[str, str]:
    """Read ``"Qy=COLUMN,Qz=COLUMN"``; raises CampaignError if it is not that."""
    pairs = {}
    for item in text.split(",") if text else []:
        name, mark, column = (part.strip() for part in item.partition("="))
        if not (name and mark and column) or name in pairs:
            raise CampaignError(
                "apply", [f"--others: {text!r} is not of the form Qy=COLUMN,Qz=COLUMN"]
            )
        pairs[name] = column
    return pairs
