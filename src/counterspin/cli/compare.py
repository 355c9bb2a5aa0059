"""`counterspin compare`: results beside each other."""

from __future__ import annotations

from pathlib import Path

from counterspin.cli.words import NOT_SAVED, SaveOptions


def compare(*results: Path, saved: SaveOptions = NOT_SAVED, report: Path | None = None) -> None:
    """Compare results of different models, methods or campaigns, and show what changed.

    Parameters
    ----------
    results
        Two or more result files; each is compared with the first.
    report
        Also write the comparison to this file: .html, .pdf or .md.
    """
    from counterspin.comparisons.compare import compare as run
    from counterspin.comparisons.result import ResultComparison
    from counterspin.output import marked, reserve
    from counterspin.reports.publication import check_format
    from counterspin.reports.text import report_console

    if report is not None:
        check_format(report)
        reserve(report, lambda: marked(ResultComparison.report_kind()), overwrite=saved.overwrite)
    saved.reserve(ResultComparison.file_kind)
    compared = run(*results)
    with saved.written(compared):
        if report is not None:
            compared.write_report(report, overwrite=saved.overwrite)
        report_console().print(compared)
