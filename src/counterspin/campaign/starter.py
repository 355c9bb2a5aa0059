"""`counterspin init`: a commented campaign description to start from."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from counterspin.campaign.toml_file import DESCRIPTION_NAME
from counterspin.errors import CounterspinError
from counterspin.output import make_folder, write_text


def init(folder: Path | str) -> Path:
    """Write the example description into a folder.

    Parameters
    ----------
    folder
        Made if it is not there.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    CounterspinError
        If there is a description already, or the folder cannot be written.
    """
    folder = Path(folder)
    target = folder / DESCRIPTION_NAME
    if target.exists():
        raise CounterspinError(f"{target} exists; edit it, or choose another folder")
    make_folder(folder)
    write_text(target, (files("counterspin.campaign") / "starter.toml").read_text("utf-8"))
    return target
