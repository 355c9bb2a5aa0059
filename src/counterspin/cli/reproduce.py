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
    from json import dumps

    from counterspin.output import write_text
    from counterspin.reports.text import report_console
    from counterspin.reproduction.comparison import reproduce as run
    from counterspin.reproduction.page import render_reproduction

    reproduction = run()
    if json is not None:
        write_text(json, dumps(reproduction.to_dict(), indent=1) + "\n")
    report_console().print(render_reproduction(reproduction))
