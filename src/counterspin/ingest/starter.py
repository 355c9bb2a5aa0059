"""`counterspin init`: a commented example campaign for each test type."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final, Literal

from counterspin.errors import CounterspinError, ExistingFileError
from counterspin.input import to_path
from counterspin.output import make_folder, write_text

#: Test types; there is an example of each except the last.
Test = Literal["double-turntable", "tumble", "arm", "poses"]

#: Test type -> example description and table of readings.
_EXAMPLES: Final[Mapping[str, tuple[str, str | None]]] = {
    "double-turntable": ("starter.toml", None),
    "tumble": ("starter_tumble.toml", "starter_tumble.csv"),
    "arm": ("starter_arm.toml", "starter_arm.csv"),
}

#: File name of the description schema, which the first line of a description states for editors.
SCHEMA_NAME: Final = "campaign.schema.json"

#: File name of the table of readings in the descriptions.
_TABLE_NAME: Final = "readings.csv"


def init(folder: Path | str, test: Test = "double-turntable") -> Path:
    """Write an example description, and its table of readings, to a folder.

    Parameters
    ----------
    folder
        Target folder; created if it does not exist.
    test
        Test type: ``double-turntable`` (records), ``tumble`` (readings of a multi-position tumble)
        or ``arm`` (readings on the arm of a centrifuge).

    Returns
    -------
    Path
        The description file.

    Raises
    ------
    CounterspinError
        If the test type is unknown, a description or table already exists, or the folder cannot
        be written.
    """
    from importlib.resources import files

    from counterspin.campaign.documents import DESCRIPTION_NAME

    if test == "poses":
        raise CounterspinError(
            "no example with poses is available; give the log file of your sensor to create a "
            "campaign",
            code="wrong-usage",
        )
    if test not in _EXAMPLES:
        raise CounterspinError(
            f"`test` must be one of {', '.join(_EXAMPLES)}, not {test!r}", code="wrong-usage"
        )
    folder = to_path(folder, "the folder of the new campaign")
    description, table = _EXAMPLES[test]
    example_by_name = {DESCRIPTION_NAME: description} | ({_TABLE_NAME: table} if table else {})
    for name in example_by_name:
        if (folder / name).exists():
            raise ExistingFileError(
                f"{folder / name} already exists; edit it, or choose another folder"
            )
    make_folder(folder)
    for name, example in example_by_name.items():
        text = (files("counterspin.ingest") / example).read_text("utf-8")
        write_text(folder / name, text)
    return folder / DESCRIPTION_NAME
