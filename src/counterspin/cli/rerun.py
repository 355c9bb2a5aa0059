"""`counterspin rerun`: a result's calibration made again."""

from __future__ import annotations

from pathlib import Path

from counterspin.cli.words import NOT_SAVED, SaveOptions
from counterspin.errors import CounterspinError


def rerun(
    result: Path,
    /,
    *,
    folder: Path | None = None,
    saved: SaveOptions = NOT_SAVED,
) -> None:
    """Repeat the calibration of a result from the same files, and compare the two.

    Parameters
    ----------
    result
        The result's JSON file.
    folder
        Folder of its campaign; by default the folder of the result.
    """
    from counterspin.comparisons.rerun import rerun as run
    from counterspin.comparisons.result import RepeatedCalibration
    from counterspin.reports.text import progress, report_console

    saved.reserve(RepeatedCalibration.file_kind)
    with progress() as advance:
        repeated = run(result, folder, progress=advance)
    with saved.written(repeated):
        report_console().print(repeated)
    if not repeated.same:
        raise CounterspinError(f"{result}: the repeated calibration differs")
