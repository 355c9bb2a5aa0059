"""`counterspin apply`: indicated specific force, corrected with a result."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from counterspin.cli.words import OutputFolder, group
from counterspin.errors import CampaignError
from counterspin.frozen import frozen


@group
@frozen
class Forces:
    """What the file's numbers are, and what is known of the other axes.

    Parameters
    ----------
    unit
        Unit of the table's forces: g, m/s^2, mg.
    pendulous
        Specific force along the pendulous axis: a column, or a constant such as "-1 g".
    output_axis
        Specific force along the output axis, likewise.
    others
        Accelerometers beside it, from which both follow: Qy=COLUMN,Qz=COLUMN.
    force
        Apply even a result of the equations as printed, whose K_II is half the true one.
    """

    unit: str = "g"
    pendulous: Annotated[str | None, Parameter(allow_leading_hyphen=True)] = None
    output_axis: Annotated[str | None, Parameter(allow_leading_hyphen=True)] = None
    others: str | None = None
    force: bool = False


_ALONE = Forces()


def apply(
    result: Path,
    file: Path,
    /,
    *,
    accelerometer: str,
    output: OutputFolder,
    column: Annotated[str | None, Parameter(name="--input")] = None,
    forces: Forces = _ALONE,
    overwrite: bool = False,
) -> None:
    """Correct indicated specific force for a calibrated accelerometer.

    Parameters
    ----------
    result
        Result that `counterspin calibrate --json` wrote.
    file
        Record file with a column of indicated specific force, such as .csv, .parquet, .h5 or .mat.
    accelerometer
        Which of the result's accelerometers it is.
    output
        File to write: the table and two more columns, corrected force and its uncertainty.
    column
        The column to correct; may be left out where only one is possible.
    overwrite
        Replace an earlier corrected file; never another file.
    """
    from counterspin.calibration.result import Result
    from counterspin.correction.apply import ApplyOptions
    from counterspin.correction.apply_file import apply_file
    from counterspin.correction.page import render_application
    from counterspin.reports.text import report_console

    done = apply_file(
        Result.read(result),
        accelerometer,
        file,
        output,
        column=column,
        options=ApplyOptions(
            unit=forces.unit,
            pendulous=forces.pendulous,
            output_axis=forces.output_axis,
            others=parse_others(forces.others),
            force=forces.force,
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
