"""`counterspin check`: one record, judged."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from counterspin.cli.words import NOT_SAVED, SaveOptions
from counterspin.errors import CounterspinError


def check(
    record: Path,
    /,
    *,
    campaign: Annotated[Path, Parameter(name="--campaign")],
    run: str | None = None,
    saved: SaveOptions = NOT_SAVED,
) -> None:
    """Check the record of one run: clock, angle, rate, residuals and the uncertainty it will give.

    Parameters
    ----------
    record
        The record file of a run that the campaign describes.
    campaign
        The campaign's folder, or its campaign.toml.
    run
        Name of the run, if the file's name does not show it.
    """
    from counterspin.monitoring.check import check as judge
    from counterspin.monitoring.result import CheckedRun
    from counterspin.reports.text import report_console

    saved.reserve(CheckedRun.file_kind)
    checked = judge(record, campaign, run=run)
    with saved.written(checked):
        report_console().print(checked)
    if not checked.good:
        raise CounterspinError("the run has faults and should be repeated")
