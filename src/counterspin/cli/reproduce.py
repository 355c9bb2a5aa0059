"""`counterspin reproduce`: the paper's figures beside ours."""

from __future__ import annotations

from counterspin.cli.words import JsonFile


def reproduce(*, json: JsonFile = None) -> None:
    """Recompute the paper's figures beside what is printed, and say why they differ.

    Parameters
    ----------
    json
        Write all figures to this file too.
    """
    from counterspin.reports.text import report_console
    from counterspin.reproduction.comparison import reproduce as run
    from counterspin.reproduction.page import render_reproduction

    reproduction = run()
    if json is not None:
        reproduction.write(json)
    report_console().print(render_reproduction(reproduction))
