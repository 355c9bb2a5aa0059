"""`counterspin noise`: the noise of a record at rest."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from counterspin.cli.words import NOT_SAVED, SaveOptions, group, say
from counterspin.frozen import frozen


@group
@frozen
class ColumnOptions:
    """What the columns of the record are, if neither file nor campaign states it.

    Parameters
    ----------
    columns
        Analyse this column; may be repeated. The default is every column of known unit.
    unit
        Unit of columns for which the file states none, such as g, m/s^2 or m/s.
    sampling_rate
        Sampling rate of a record without a time column, such as "100 Hz".
    gravity
        Gravity for conversion between g and m/s^2, without a campaign; default 9.80665 m/s^2.
    rate
        Rate of a spindle that turned nearby, such as "1 rev/s": names its spectral lines.
    """

    columns: Annotated[list[str] | None, Parameter(name="--column", consume_multiple=False)] = None
    unit: str | None = None
    sampling_rate: str | None = None
    gravity: str | None = None
    rate: str | None = None


_AS_THE_FILE_SAYS = ColumnOptions()


def noise(
    record: Path,
    /,
    *,
    campaign: Path | None = None,
    recorded: ColumnOptions = _AS_THE_FILE_SAYS,
    report: Path | None = None,
    plot: Path | None = None,
    saved: SaveOptions = NOT_SAVED,
) -> None:
    """Analyse the noise of a record at rest: spectrum, Allan deviation, components, lines.

    Parameters
    ----------
    record
        Record of a sensor at rest, in any record format.
    campaign
        A campaign's folder or campaign.toml, which states what the columns are.
    report
        Also write a report: .html, .pdf or .md.
    plot
        Plot Allan deviation and spectrum: .svg, .png or .pdf.
    """
    from counterspin.monitoring.noise import noise as run
    from counterspin.monitoring.page import PLOTS, noise_plots
    from counterspin.monitoring.result import NoiseResult
    from counterspin.output import marked, reserve
    from counterspin.reports.charts import check_format, save
    from counterspin.reports.publication import check_format as check_report
    from counterspin.reports.text import report_console

    if report is not None:
        check_report(report)
        kind = NoiseResult.report_kind()
        reserve(report, lambda: marked(kind), overwrite=saved.overwrite)
    if plot is not None:
        check_format(plot)
        reserve(plot, lambda: marked(PLOTS), overwrite=saved.overwrite)
    saved.reserve(NoiseResult.file_kind)
    result = run(
        record,
        campaign=campaign,
        columns=recorded.columns or (),
        unit=recorded.unit,
        sampling_rate=recorded.sampling_rate,
        gravity=recorded.gravity,
        rate=recorded.rate,
    )
    with saved.written(result):
        if plot is not None:
            pictures = [
                picture
                for signal in result.signals
                for picture in noise_plots(signal, result.gravity)
            ]
            save(pictures, plot, PLOTS, overwrite=saved.overwrite)
        if report is not None:
            result.write_report(report, overwrite=saved.overwrite)
        report_console().print(result)
    for path in (report, plot):
        if path is not None:
            say(f"Wrote {path}.")
