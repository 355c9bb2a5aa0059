"""`counterspin report`: any result as HTML, PDF, Markdown or in the terminal."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Final

from counterspin.cli.words import OutputFile, say

if TYPE_CHECKING:
    from counterspin.reports.publication import ShownResult

#: Whatever a command writes with --json, beside a calibration: module and class.
_KINDS: Final = (
    ("planning.result", "PlanResult"),
    ("studies.result", "StudyResult"),
    ("histories.result", "History"),
    ("comparisons.result", "ResultComparison"),
    ("comparisons.result", "RepeatedCalibration"),
    ("monitoring.result", "CheckedRun"),
    ("monitoring.result", "WatchState"),
    ("monitoring.result", "NoiseResult"),
    ("calibration.batch", "BatchResult"),
    ("validation.page", "Dossier"),
    ("reproduction.plan", "Reproduction"),
)


def report(
    source: Path,
    /,
    *,
    output: OutputFile = None,
    identifier: str | None = None,
    date: str | None = None,
    overwrite: bool = False,
) -> None:
    """Write the report of any result as HTML, PDF or Markdown, or print it.

    Parameters
    ----------
    source
        File written by any command with --json: a calibration, plan, study, history and so on; or a
        campaign's folder or description, which is calibrated first.
    output
        The report: .html, .pdf or .md; without it, the report is printed.
    identifier
        Identifier of the report; by default derived from the result.
    date
        Date of the report, such as 2026-03-01; by default SOURCE_DATE_EPOCH or now.
    overwrite
        Replace an earlier report of the same kind; other files are never replaced.
    """
    from counterspin.calibration.result import Result
    from counterspin.output import marked, reserve
    from counterspin.reports.publication import check_format, issue_date
    from counterspin.reports.text import Report, report_console

    issued = issue_date(date)
    is_file = source.suffix.lower() == ".json" or (source.is_file() and source.suffix != ".toml")
    kind = _kind_of(source) if is_file else Result
    if output is not None:
        check_format(output)
        reserve(output, lambda: marked(kind.report_kind()), overwrite=overwrite)
    if is_file:
        result = kind.read(source)
    else:
        from counterspin.calibration.calibrate import calibrate
        from counterspin.reports.text import progress

        with progress() as advance:
            result = calibrate(source, progress=advance)
    if output is None:
        report_console().print(Report(list(result.publication(identifier).blocks)))
        return
    result.write_report(output, identifier=identifier, issued=issued, overwrite=overwrite)
    say(f"Wrote {output}.")


def _kind_of(path: Path) -> type[ShownResult]:
    """Return the class whose file this is; a calibration's where it is none's, to say what."""
    from counterspin.calibration.result import Result

    if Result.file_kind().recognises(path):
        return Result
    for module, name in _KINDS:
        kind: type[ShownResult] = getattr(import_module(f"counterspin.{module}"), name)
        if kind.file_kind().recognises(path):
            return kind
    return Result
