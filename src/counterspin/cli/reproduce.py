"""`counterspin reproduce`: the paper's figures beside ours."""

from __future__ import annotations

from counterspin.cli.words import NOT_SAVED, SaveOptions


def reproduce(*, saved: SaveOptions = NOT_SAVED) -> None:
    """Compare the paper's numbers with recomputed ones, and explain the differences."""
    from counterspin.reports.text import report_console
    from counterspin.reproduction.comparison import reproduce as run
    from counterspin.reproduction.plan import Reproduction

    saved.reserve(Reproduction.file_kind)
    reproduction = run()
    with saved.written(reproduction):
        report_console().print(reproduction)
