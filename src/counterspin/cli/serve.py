"""`counterspin serve`: the campaigns of a folder as a page of this machine alone."""

from __future__ import annotations

from pathlib import Path

from counterspin.cli.words import OnOff, say
from counterspin.errors import CounterspinError, installing


def serve(directory: Path, /, *, port: int = 0, browser: OnOff = True) -> None:
    """Open a page that only this machine reaches: campaigns, results, plans, certificates.

    Parameters
    ----------
    directory
        The folder whose campaigns are shown; nothing outside of it is read or written.
    port
        Where to listen; 0: any that is free.
    browser
        Open the page in the browser.
    """
    try:
        from counterspin.application.server import serve as run
    except ModuleNotFoundError as error:
        if error.name not in ("starlette", "uvicorn", "tomlkit"):
            raise
        raise CounterspinError(
            f"the page needs Starlette and uvicorn: {installing('application')}"
        ) from error
    run(directory, port=port, browser=browser, say=say)
