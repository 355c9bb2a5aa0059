"""`counterspin history`: results of instruments over time."""

from __future__ import annotations

from pathlib import Path

from counterspin.cli.words import NOT_SAVED, SaveOptions
from counterspin.errors import CampaignError, CounterspinError


def history(
    *paths: Path,
    term: str = "K_II",
    serial: str | None = None,
    reliability: float = 0.95,
    saved: SaveOptions = NOT_SAVED,
    figure: Path | None = None,
) -> None:
    """Follow a coefficient of each instrument over time: drift and agreement of its results.

    Parameters
    ----------
    paths
        Result files, and folders that are searched for results.
    term
        The coefficient; or offset, sensitivity or angle of triads.
    serial
        Only the instrument with this serial number.
    reliability
        Probability that the instrument is still within specification on the date when it is due.
    figure
        Draw a control chart of each instrument: .svg, .png or .pdf.
    """
    from counterspin.histories.history import history as run
    from counterspin.histories.page import CHART, history_plots
    from counterspin.histories.result import History
    from counterspin.output import marked, reserve
    from counterspin.reports.charts import check_format, save
    from counterspin.reports.text import report_console

    if not paths:
        raise CampaignError("history", ["give result files, or folders that contain them"])
    if figure is not None:
        check_format(figure)
        reserve(figure, lambda: marked(CHART), overwrite=saved.overwrite)
    saved.reserve(History.file_kind)
    result = run(paths, term=term, serial=serial, reliability=reliability)
    with saved.written(result):
        if figure is not None:
            save(history_plots(result), figure, CHART, overwrite=saved.overwrite)
        report_console().print(result)
    if result.damaged:
        raise CounterspinError(
            f"{len(result.damaged)} of the result files cannot be read; the history leaves them out"
        )
