"""`counterspin report`: a result as HTML, PDF, Markdown or in the terminal."""

from __future__ import annotations

from pathlib import Path

from counterspin.cli.words import OutputFile, say


def report(
    source: Path,
    /,
    *,
    output: OutputFile = None,
    identifier: str | None = None,
    date: str | None = None,
    overwrite: bool = False,
) -> None:
    """Write the full report of a result: answer, checks, budget, residuals, origin.

    Parameters
    ----------
    source
        Result file, or a campaign's folder or description, which is calibrated first.
    output
        The report: .html, .pdf or .md; without it, the report is printed.
    identifier
        What it is known by; else it follows from the result.
    date
        When it was made, such as 2026-03-01; else SOURCE_DATE_EPOCH or now.
    overwrite
        Replace an earlier report; never another file.
    """
    from counterspin.calibration.pages.full_report import document
    from counterspin.calibration.pages.publishing import KIND, issue_date, write_report
    from counterspin.calibration.result import Result
    from counterspin.output import marked, reserve
    from counterspin.reports.publication import check_format
    from counterspin.reports.text import Report, report_console

    issued = issue_date(date)
    if output is not None:
        check_format(output)
        reserve(output, lambda: marked(KIND), overwrite=overwrite)
    if source.suffix.lower() == ".json" or (source.is_file() and source.suffix != ".toml"):
        result = Result.read(source)
    else:
        from counterspin.calibration.calibrate import calibrate
        from counterspin.reports.progress import progress

        with progress() as advance:
            result = calibrate(source, progress=advance)
    if output is None:
        report_console().print(Report(document(result)))
        return
    write_report(result, output, identifier=identifier, issued=issued, overwrite=overwrite)
    say(f"Wrote {output}.")
