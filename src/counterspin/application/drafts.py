"""Exports that are dragged in: what is guessed of them, and the campaign that they make."""

from __future__ import annotations

import filecmp
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import numpy as np

from counterspin.application.commands import export_command
from counterspin.application.desk import Desk, FileCache
from counterspin.application.folder import OutsideError
from counterspin.campaign.starter import Test
from counterspin.exports.description import AnyDraft, guessed_test, write_description
from counterspin.exports.description import drafted as described_as
from counterspin.exports.looking import FileColumn, look_at
from counterspin.exports.tumble import TumbleDraft
from counterspin.frozen import frozen
from counterspin.output import begin, finish, make_folder
from counterspin.records.formats import wrong_ending

_LOOKS: Final = FileCache(2)
#: Rows, and parts of a column, that are shown before a campaign is written.
_PREVIEW_ROWS: Final = 4
_PREVIEW_PARTS: Final = 90


@frozen
class Arrival:
    """A file that is being uploaded."""

    path: Path  #: Where it goes.
    part: Path  #: A new file beside it that takes its bytes.
    folders: tuple[Path, ...]  #: Those that were made for it, the innermost first.

    def end(self) -> None:
        """Remove what an incomplete upload has left."""
        self.part.unlink(missing_ok=True)
        for folder in self.folders:
            with suppress(OSError):  # something is in it
                folder.rmdir()


def place_for(desk: Desk, name: str) -> Arrival:
    """Return the places of an uploaded file."""
    path = desk.folder.path(name)
    if wrong := wrong_ending(path):
        raise OutsideError(f"{name}: {wrong}")
    folders = tuple(folder for folder in path.parents if not folder.exists())
    make_folder(path.parent)
    return Arrival(path, begin(path), folders)


def arrived(desk: Desk, arrival: Arrival) -> dict[str, Any]:
    """Give a complete upload its name; CounterspinError if a file of other content has it."""
    size = arrival.part.stat().st_size
    if arrival.path.is_file() and filecmp.cmp(arrival.part, arrival.path, shallow=False):
        arrival.part.unlink()  # brought once more, after a mistake
    else:
        finish(arrival.part, arrival.path)
    return {"name": desk.folder.name(arrival.path), "bytes": size}


def _draft(
    desk: Desk, names: Sequence[str], answers: dict[str, str] | None, stated: Test | None
) -> tuple[AnyDraft, Test]:
    files = [desk.file(name) for name in names]
    said = {key: answer for key, answer in (answers or {}).items() if answer.strip()}
    sheet = said.get("sheet", "")
    looks = _LOOKS.get((sheet, *files), files, lambda: look_at(files, said))
    test = stated or guessed_test(looks)
    return described_as(looks, said, test), test


def drafted(
    desk: Desk,
    names: list[str],
    answers: dict[str, str] | None = None,
    test: Test | None = None,
) -> dict[str, Any]:
    """Return what files show, in sentences and columns, what may be answered, and what is wrong.

    Columns of words are among them where it may be answered what they are.
    """
    found, test = _draft(desk, names, answers, test)
    asked = {question.key for question in found.questions}
    asked |= {f"{question.guess} is" for question in found.questions}
    words = {name: cells for name, cells in found.look.words.items() if f"{name} is" in asked}
    return {
        "test": test,
        "statements": list(found.statements),
        "questions": [vars(question) for question in found.questions],
        "problems": list(found.problems),
        "file": found.look.path.name,
        "columns": [
            *({"name": n, "first": c[:_PREVIEW_ROWS], "extent": []} for n, c in words.items()),
            *map(_preview, found.look.columns),
        ],
        "directions": found.directions if isinstance(found, TumbleDraft) else [],
    }


def _preview(column: FileColumn) -> dict[str, Any]:
    """Return a column's first values, and least and greatest value of each part of it."""
    parts = np.array_split(column.values, min(_PREVIEW_PARTS, len(column.values)))
    known = [part[np.isfinite(part)] for part in parts]
    return {
        "name": column.name,
        "first": ["" if np.isnan(v) else f"{v:.9g}" for v in column.values[:_PREVIEW_ROWS]],
        "extent": [[float(part.min()), float(part.max())] if part.size else None for part in known],
    }


def begin_drafted(
    desk: Desk,
    folder: str,
    names: list[str],
    answers: dict[str, str] | None = None,
    test: Test | None = None,
) -> dict[str, Any]:
    """Write the campaign that files and answers make; return its name and the command."""
    place = desk.place(folder)
    found, test = _draft(desk, names, answers, test)
    write_description(found, place)
    files = [desk.file(name) for name in names]
    command = export_command(place, files, dict(found.answers), test)
    return {"name": desk.folder.name(place), "command": command}
