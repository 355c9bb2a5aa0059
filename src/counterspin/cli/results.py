"""Commands for results: reports, histories, comparisons, repetitions and ledgers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from counterspin.cli.common import (
    NO_RESULT_FILE,
    OutputFile,
    OutputFolder,
    SaveOptions,
    command,
    print_output,
    require_distinct_files,
)
from counterspin.errors import CounterspinError, UsageError
from counterspin.loading import load_name

if TYPE_CHECKING:
    from counterspin.results import ReportableResult


@command
def report(
    source: Path,
    /,
    *,
    output: OutputFile = None,
    identifier: str | None = None,
    date: str | None = None,
    overwrite: bool = False,
) -> None:
    """Write a report of any result as HTML, PDF or Markdown, or print it.

    Parameters
    ----------
    source
        Result file written by any command with --json, or a campaign folder or description, which
        is calibrated first.
    output
        Report file: .html, .pdf or .md. By default, the report is printed.
    identifier
        Identifier of the report; by default, it is derived from the result.
    date
        Date of the report, such as 2026-03-01; by default, SOURCE_DATE_EPOCH or the current date.
    overwrite
        Replace an earlier report of the same kind; other files are never replaced.
    """
    from counterspin.calibration.result import Result
    from counterspin.output import check_writable, marked_file_type
    from counterspin.reports.publication import parse_issue_date, require_report_format
    from counterspin.reports.text import Report, make_console

    issue_date = parse_issue_date(date)
    is_file = source.suffix.lower() == ".json" or (source.is_file() and source.suffix != ".toml")
    result_class = _detect_result_class(source) if is_file else Result
    if output is not None:
        require_report_format(output)
        check_writable(
            output, lambda: marked_file_type(result_class.report_kind()), overwrite=overwrite
        )
    if is_file:
        result = result_class.read(source)
    else:
        from counterspin.calibration.calibrate import calibrate
        from counterspin.reports.text import show_progress

        with show_progress() as advance:
            result = calibrate(source, progress=advance)
    if output is None:
        make_console().print(Report(list(result.publication(identifier).blocks)))
        return
    result.write_report(output, identifier=identifier, issued=issue_date, overwrite=overwrite)
    print_output(f"Wrote {output}.")


def _detect_result_class(path: Path) -> type[ReportableResult]:
    """Return the class of a result file; `Result` if unknown, for its error message."""
    from counterspin.calibration.result import Result
    from counterspin.results import RESULT_CLASSES

    for name in RESULT_CLASSES:
        result_class: type[ReportableResult] = load_name(f"counterspin.{name}")
        if result_class.file_kind().recognises(path):
            return result_class
    return Result


@command
def history(
    *paths: Path,
    term: str = "K_II",
    serial: str | None = None,
    reliability: float = 0.95,
    save_options: SaveOptions = NO_RESULT_FILE,
    figure: Path | None = None,
) -> None:
    """Track a coefficient over time: drift and consistency between calibrations.

    Parameters
    ----------
    paths
        Result files, and folders that are searched for results.
    term
        Coefficient to track; for triads: offset, sensitivity or angle.
    serial
        Serial number of the instrument; default: all instruments.
    reliability
        Required probability that the instrument is within specification on the due date.
    figure
        Draw a control chart of each instrument: .svg, .png or .pdf.
    """
    from counterspin.histories.history import history as compute_history
    from counterspin.histories.page import FILE_DESCRIPTION, history_plots
    from counterspin.histories.result import History
    from counterspin.output import check_writable, marked_file_type
    from counterspin.reports.charts import require_figure_format, save_figure
    from counterspin.reports.text import make_console

    require_distinct_files(json=save_options.json, figure=figure)
    if not paths:
        raise UsageError("history", ["give result files, or folders that contain them"])
    overwrite = save_options.overwrite
    if figure is not None:
        require_figure_format(figure)
        check_writable(figure, lambda: marked_file_type(FILE_DESCRIPTION), overwrite=overwrite)
    save_options.check_writable(History.file_kind)
    result = compute_history(paths, term=term, serial=serial, reliability=reliability)
    with save_options.saving(result):
        if figure is not None:
            save_figure(history_plots(result), figure, FILE_DESCRIPTION, overwrite=overwrite)
        make_console().print(result)
    if result.damaged:
        raise CounterspinError(
            f"{len(result.damaged)} of the result files cannot be read, so the history omits them",
            code="batch-failed",
        )


@command
def compare(
    *results: Path, save_options: SaveOptions = NO_RESULT_FILE, report: Path | None = None
) -> None:
    """Compare results of different models, methods or campaigns, and show what changed.

    Parameters
    ----------
    results
        Two or more result files. Each file is compared with the first.
    report
        Also write the comparison to this file: .html, .pdf or .md.
    """
    from counterspin.comparisons.compare import compare as compare_results
    from counterspin.comparisons.result import ResultComparison
    from counterspin.output import check_writable, marked_file_type
    from counterspin.reports.publication import require_report_format
    from counterspin.reports.text import make_console

    require_distinct_files(json=save_options.json, report=report)
    if report is not None:
        require_report_format(report)
        check_writable(
            report,
            lambda: marked_file_type(ResultComparison.report_kind()),
            overwrite=save_options.overwrite,
        )
    save_options.check_writable(ResultComparison.file_kind)
    comparison = compare_results(*results)
    with save_options.saving(comparison):
        if report is not None:
            comparison.write_report(report, overwrite=save_options.overwrite)
        make_console().print(comparison)


@command
def intercompare(
    *results: Path,
    coefficient: str | None = None,
    save_options: SaveOptions = NO_RESULT_FILE,
    report: Path | None = None,
    figure: Path | None = None,
) -> None:
    """Compare laboratories: reference value, consistency, degrees of equivalence.

    Parameters
    ----------
    results
        One result file per laboratory, all for the same instrument.
    coefficient
        Coefficients, such as K_I,K_II; default: all coefficients that every result determines.
    report
        Also write the comparison to this file: .html, .pdf or .md.
    figure
        Draw the degrees of equivalence and a Youden plot: .svg, .png or .pdf.
    """
    from counterspin.comparisons.intercompare import intercompare as compare_laboratories
    from counterspin.comparisons.intercomparison_page import FILE_DESCRIPTION, intercomparison_plots
    from counterspin.comparisons.result import Intercomparison
    from counterspin.output import check_writable, marked_file_type
    from counterspin.reports.charts import require_figure_format, save_figure
    from counterspin.reports.publication import require_report_format
    from counterspin.reports.text import make_console

    require_distinct_files(json=save_options.json, report=report, figure=figure)
    overwrite = save_options.overwrite
    if report is not None:
        require_report_format(report)
        check_writable(
            report, lambda: marked_file_type(Intercomparison.report_kind()), overwrite=overwrite
        )
    if figure is not None:
        require_figure_format(figure)
        check_writable(figure, lambda: marked_file_type(FILE_DESCRIPTION), overwrite=overwrite)
    save_options.check_writable(Intercomparison.file_kind)
    symbols = None if coefficient is None else [s.strip() for s in coefficient.split(",")]
    intercomparison = compare_laboratories(*results, coefficients=symbols)
    with save_options.saving(intercomparison):
        if report is not None:
            intercomparison.write_report(report, overwrite=overwrite)
        if figure is not None:
            save_figure(
                intercomparison_plots(intercomparison),
                figure,
                FILE_DESCRIPTION,
                overwrite=overwrite,
            )
        make_console().print(intercomparison)


@command
def rerun(
    result: Path, /, *, folder: Path | None = None, save_options: SaveOptions = NO_RESULT_FILE
) -> None:
    """Repeat the calibration of a result from the same files, and compare both results.

    Parameters
    ----------
    result
        Result file (JSON).
    folder
        Campaign folder; by default the folder of the result.
    """
    from counterspin.comparisons.rerun import rerun as repeat_calibration
    from counterspin.comparisons.result import RepeatedCalibration
    from counterspin.reports.text import make_console, show_progress

    save_options.check_writable(RepeatedCalibration.file_kind)
    with show_progress() as advance:
        repetition = repeat_calibration(result, folder, progress=advance)
    with save_options.saving(repetition):
        make_console().print(repetition)
    if not repetition.same:
        raise CounterspinError(f"{result}: the repeated calibration differs", code="results-differ")


@command
def export(
    result: Path,
    /,
    *,
    output: OutputFolder,
    normalisation: Literal["none", "ieee"] = "none",
    form: Literal["coefficients", "psins", "kalibr", "ros"] = "coefficients",
    noise: Path | None = None,
    overwrite: bool = False,
) -> None:
    """Export the coefficients of a result for other programs.

    Parameters
    ----------
    result
        Result written by `counterspin calibrate --json`.
    output
        File to write: .csv, .xlsx or .mat; .mat for psins; .yaml for kalibr and ros.
    normalisation
        Normalisation of the coefficients; ieee: as in IEEE Std 1293, K2 = K_II/K_I and so on.
    form
        Content of the export. coefficients: all coefficients with their covariance. psins, kalibr,
        ros: the linear correction of a triad in the format of these programs.
    noise
        With kalibr: file with the noise of the three accelerometers, written by `counterspin noise
        --json`.
    overwrite
        Replace an earlier export; other files are never replaced.
    """
    from counterspin.calibration.result import Result
    from counterspin.correction.export import export as write_export
    from counterspin.monitoring.result import NoiseResult

    densities = None if noise is None else NoiseResult.read(noise).largest_densities()
    write_export(
        Result.read(result),
        output,
        normalisation=normalisation,
        form=form,
        noise=densities,
        overwrite=overwrite,
    )
    print_output(f"Wrote {output}.")


@command
def ledger(
    action: Literal["verify", "add"],
    ledger: Path,
    results: tuple[Path, ...] = (),
    /,
    *,
    who: str | None = None,
    why: str | None = None,
) -> None:
    """Verify the entries of an instrument's ledger, or add results to it.

    Parameters
    ----------
    action
        verify: check and list all entries; add: enter results.
    ledger
        Ledger file (append-only).
    results
        With add: result files.
    who
        With add: name of the person who makes the entry.
    why
        With add: reason for the entry.
    """
    from counterspin.calibration.result import Result
    from counterspin.certificates.ledger import ledger_blocks, verify_ledger
    from counterspin.errors import RecordError
    from counterspin.reports.text import Report, make_console

    if action == "add":
        if not (results and who and who.strip() and why and why.strip()):
            raise UsageError("ledger", ["give RESULT.json, --who NAME and --why REASON"])
        for result_file in results:
            Result.read(result_file)  # before the first entry
        for result_file in results:
            add_to_ledger(ledger, result_file, who=who, why=why)
        return
    if results or who or why:
        raise UsageError("ledger", ["verify does not accept result files; give only the ledger"])
    ledger_state = verify_ledger(ledger)
    make_console().print(Report(list(ledger_blocks(ledger_state))))
    if ledger_state.partial_entry:
        raise RecordError(
            f"{ledger}: entry {len(ledger_state.entries)} is followed by an incomplete line of "
            f"{len(ledger_state.partial_entry)} bytes. Either a command was interrupted, or the "
            "end of the file was altered. The preceding entries are intact, and the next entry "
            "will preserve this line",
            code="ledger-altered",
        )


def add_to_ledger(ledger: Path, result: Path, *, who: str, why: str) -> None:
    """Enter a result file in a ledger, and print the entry."""
    from counterspin.certificates.ledger import record_result
    from counterspin.reports.publication import parse_issue_date

    entry = record_result(ledger, result, who=who, why=why, date=parse_issue_date())
    print_output(f"{ledger}: entry {entry.number} is result {result}, hash {entry.digest}.")
