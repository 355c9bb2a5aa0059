"""`counterspin init`: a commented campaign to start from, for each kind of test."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final, Literal

from counterspin.errors import CounterspinError, ExistingFileError
from counterspin.input import to_path
from counterspin.output import make_folder, write_text

#: The kinds of test; of all but the last there is an example.
Test = Literal["double-turntable", "tumble", "arm", "poses"]

#: Of each kind its description, and the table of readings beside it.
_EXAMPLES: Final[Mapping[str, tuple[str, str | None]]] = {
    "double-turntable": ("starter.toml", None),
    "tumble": ("starter_tumble.toml", "starter_tumble.csv"),
    "arm": ("starter_arm.toml", "starter_arm.csv"),
}

#: The schema of descriptions, as their first line names it for editors.
SCHEMA_NAME: Final = "campaign.schema.json"

#: The table of readings, as the descriptions name it.
_TABLE: Final = "readings.csv"


def init(folder: Path | str, test: Test = "double-turntable") -> Path:
    """Write an example description into a folder, and the table that its readings go into.

    Parameters
    ----------
    folder
        Made if it is not there.
    test
        Which example: records of a double turntable, readings of a multi-position tumble, or
        readings on the arm of a centrifuge.

    Returns
    -------
    Path
        The description.

    Raises
    ------
    CounterspinError
        If there is no such test, there is a description or table already, or the folder cannot be
        written.
    """
    from importlib.resources import files

    from counterspin.campaign.documents import DESCRIPTION_NAME

    if test == "poses":
        raise CounterspinError(
            "no example with poses is available; create a campaign from a log of your sensor by "
            "naming the log file",
            code="wrong-usage",
        )
    if test not in _EXAMPLES:
        raise CounterspinError(
            f"`test` must be one of {', '.join(_EXAMPLES)}, not {test!r}", code="wrong-usage"
        )
    folder = to_path(folder, "the folder of the new campaign")
    description, table = _EXAMPLES[test]
    written = {DESCRIPTION_NAME: description} | ({_TABLE: table} if table else {})
    for name in written:
        if (folder / name).exists():
            raise ExistingFileError(
                f"{folder / name} already exists; edit it, or choose another folder"
            )
    make_folder(folder)
    for name, example in written.items():
        text = (files("counterspin.ingest") / example).read_text("utf-8")
        write_text(folder / name, text)
    return folder / DESCRIPTION_NAME
