"""Commands for records: simulation, checks, monitoring and noise analysis."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from counterspin.cli.common import (
    NO_RESULT_FILE,
    OutputFolder,
    SaveOptions,
    command,
    option_group,
    print_output,
    require_distinct_files,
)
from counterspin.errors import CounterspinError, UsageError
from counterspin.frozen import frozen

if TYPE_CHECKING:
    from collections.abc import Iterator

    from counterspin.monitoring.result import WatchState


@command
def simulate(campaign: Path, /, *, output: OutputFolder, overwrite: bool = False) -> None:
    """Simulate the records and readings of a campaign with known coefficients.

    Parameters
    ----------
    campaign
        Campaign description with [truth] tables, or its folder.
    output
        Folder for the records, the readings and the description.
    overwrite
        Replace the files of an earlier simulation; other files are never replaced.
    """
    from counterspin.campaign.description import read_campaign
    from counterspin.campaign.questions import ask_questions
    from counterspin.reports.text import show_progress
    from counterspin.simulation.simulate import simulate as run_simulation

    campaign_description = read_campaign(campaign)
    with show_progress(labels=("Simulating", "Files", "Files")) as advance:
        written_files = run_simulation(
            campaign_description, output, overwrite=overwrite, progress=advance
        )
    print_output(*(f"Warning: {question.text}" for question in ask_questions(campaign_description)))
    files_text = (
        f"{len(written_files)} {'file' if len(written_files) == 1 else 'files'} and "
        if written_files
        else ""
    )
    print_output(f"Wrote {files_text}campaign.toml to {output}.")


@command
def check(
    record: Path,
    /,
    *,
    campaign: Annotated[Path, Parameter(name="--campaign")],
    run: str | None = None,
    save_options: SaveOptions = NO_RESULT_FILE,
) -> None:
    """Check the record of a run: clock, angle, rate, residuals and the expected uncertainty.

    Parameters
    ----------
    record
        Record file of a run in the campaign.
    campaign
        Campaign folder, or its campaign.toml.
    run
        Name of the run, if the file name does not identify it.
    """
    from counterspin.monitoring.check import check as run_check
    from counterspin.monitoring.result import CheckedRun
    from counterspin.reports.text import make_console

    save_options.check_writable(CheckedRun.file_kind)
    checked_run = run_check(record, campaign, run=run)
    with save_options.saving(checked_run):
        make_console().print(checked_run)
    if not checked_run.good:
        raise CounterspinError(
            "the run failed its checks and should be repeated", code="run-faulty"
        )


@command
def watch(
    directory: Path,
    /,
    *,
    goal: tuple[str, ...] = (),
    plan: Path | None = None,
    interval: float = 1.0,
    once: bool = False,
    json: Annotated[bool, Parameter(name="--json-lines")] = False,
) -> None:
    """Monitor growing records: rate, ripple, residuals and current uncertainty.

    The command ends when every run has reached the duration stated in the campaign, or with Ctrl-C.
    Nothing is saved. After a restart, the command reads the records again and continues.

    Parameters
    ----------
    directory
        Campaign folder, or its campaign.toml.
    goal
        Standard uncertainty to reach, such as "K_II 1e-8 g/g^2" or "Qx.K_II 0.01 ug/g^2"; may be
        repeated.
    plan
        PLAN.toml whose target contains the goals.
    interval
        Interval at which the files are read, in seconds.
    once
        Print the current state and exit.
    json
        Print each state as a line of JSON.
    """
    from counterspin.monitoring.watch import Pace
    from counterspin.monitoring.watch import watch as watch_campaign

    if plan is not None and goal:
        raise UsageError("watch", ["give either `goal` or `plan`, not both"])
    states = watch_campaign(
        directory, goals=goal if plan is None else plan, pace=Pace(interval), once=once
    )
    if json:
        for state in states:
            print_output(state.model_dump_json(by_alias=True))
            sys.stdout.flush()
    elif sys.stdout.isatty() and not once:
        _show_live_display(states)
    else:
        _print_lines(states, once=once)


def _show_live_display(states: Iterator[WatchState]) -> None:
    from rich.live import Live

    from counterspin.reports.text import make_console

    console = make_console()
    with Live(console=console, auto_refresh=False) as display:
        for state in states:
            display.update(state, refresh=True)


def _print_lines(states: Iterator[WatchState], *, once: bool) -> None:
    from counterspin.monitoring.page import format_watch_line
    from counterspin.reports.text import make_console

    for state in states:
        if once:
            make_console().print(state)
            return
        time_of_day = time.strftime("%H:%M:%S")
        event_lines = [f"{time_of_day} {event}" for event in state.events]
        failure_lines = [
            f"{time_of_day} {run.run}: {run.why}" for run in state.runs if run.state == "failed"
        ]
        print_output(*event_lines, *failure_lines, f"{time_of_day} {format_watch_line(state)}")
        sys.stdout.flush()


@option_group
@frozen
class ColumnOptions:
    """Columns of the record, if neither the file nor the campaign states them.

    Parameters
    ----------
    columns
        Column to analyse; may be repeated. Default: every column with a known unit.
    unit
        Unit of columns without a unit in the file, such as g, m/s^2 or m/s.
    sampling_rate
        Sampling rate of a record without a time column, such as "100 Hz".
    gravity
        Without --campaign: gravity for conversion between g and m/s^2; default: 9.80665 m/s^2.
    rate
        Rate of a nearby rotating spindle, such as "1 rev/s"; its spectral lines are labelled.
    select
        Rows to read from a file with several sensors: column=value, such as device=A.
    """

    columns: Annotated[list[str] | None, Parameter(name="--column", consume_multiple=False)] = None
    unit: str | None = None
    sampling_rate: str | None = None
    gravity: str | None = None
    rate: str | None = None
    select: str | None = None


_DEFAULT_COLUMNS = ColumnOptions()


@command
def noise(
    record: Path,
    /,
    *,
    campaign: Path | None = None,
    column_options: ColumnOptions = _DEFAULT_COLUMNS,
    report: Path | None = None,
    plot: Path | None = None,
    save_options: SaveOptions = NO_RESULT_FILE,
) -> None:
    """Analyse the noise of a static record: spectrum, Allan deviation, components, lines.

    Parameters
    ----------
    record
        Static record of a sensor, in any record format.
    campaign
        Campaign folder or campaign.toml that describes the columns.
    report
        Also write a report: .html, .pdf or .md.
    plot
        Plot the Allan deviation and the spectrum: .svg, .png or .pdf.
    """
    from counterspin.monitoring.noise import noise as analyse_noise
    from counterspin.monitoring.page import FILE_DESCRIPTION, noise_plots
    from counterspin.monitoring.result import NoiseResult
    from counterspin.output import check_writable, marked_file_type
    from counterspin.reports.charts import require_figure_format, save_figure
    from counterspin.reports.publication import require_report_format
    from counterspin.reports.text import make_console

    require_distinct_files(json=save_options.json, report=report, plot=plot)
    overwrite = save_options.overwrite
    if report is not None:
        require_report_format(report)
        document_type = NoiseResult.report_kind()
        check_writable(report, lambda: marked_file_type(document_type), overwrite=overwrite)
    if plot is not None:
        require_figure_format(plot)
        check_writable(plot, lambda: marked_file_type(FILE_DESCRIPTION), overwrite=overwrite)
    save_options.check_writable(NoiseResult.file_kind)
    result = analyse_noise(
        record,
        campaign=campaign,
        columns=column_options.columns or (),
        unit=column_options.unit,
        sampling_rate=column_options.sampling_rate,
        gravity=column_options.gravity,
        rate=column_options.rate,
        select=column_options.select,
    )
    with save_options.saving(result):
        if plot is not None:
            pictures = [
                picture
                for signal in result.signals
                for picture in noise_plots(signal, result.gravity)
            ]
            save_figure(pictures, plot, FILE_DESCRIPTION, overwrite=overwrite)
        if report is not None:
            result.write_report(report, overwrite=overwrite)
        make_console().print(result)
    for path in (report, plot):
        if path is not None:
            print_output(f"Wrote {path}.")
