"""`counterspin serve`: the campaigns of a folder as a page of this machine alone."""

from __future__ import annotations

from pathlib import Path

from counterspin.cli.words import OnOff, say
from counterspin.errors import CampaignError, CounterspinError, installing


def serve(
    directory: Path,
    /,
    *,
    port: int = 0,
    browser: OnOff = True,
    signer: str | None = None,
    cert: Path | None = None,
) -> None:
    """Open the application: a web page for this machine only, with campaigns, plans, certificates.

    Parameters
    ----------
    directory
        Folder of the campaigns; nothing outside it is read or written.
    port
        Port to listen on; 0 chooses a free one.
    browser
        Open the page in the browser.
    signer
        Command with which the page may sign certificates: it reads bytes on standard input and
        writes their signature, for example with a smart card or token.
    cert
        X.509 certificate (PEM) of the key with which the command signs.
    """
    if (signer is None) != (cert is None):
        raise CampaignError("serve", ["give --signer and --cert together"])
    try:
        from counterspin.application.server import serve as run
    except ModuleNotFoundError as error:
        if error.name not in ("starlette", "uvicorn", "tomlkit"):
            raise
        raise CounterspinError(
            f"the page needs Starlette and uvicorn: {installing('application')}"
        ) from error
    signing = None if signer is None or cert is None else (signer, cert)
    run(directory, port=port, browser=browser, signing=signing, say=say)
