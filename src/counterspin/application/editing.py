"""Edit a file as a form and as a text, which always agree.

The text is the source: a changed field changes the text, with comments and the order of its keys
kept (tomlkit), and the text is saved.
"""

from __future__ import annotations

import copy
import datetime
import json
import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, Literal

import tomlkit
from tomlkit.container import Container
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import AoT, Comment, Table

from counterspin.application.desk import Desk
from counterspin.application.folder import TEXT_BYTES, OutsideError
from counterspin.application.form import campaign_form, plan_form, run_kinds
from counterspin.calibration.result import Result
from counterspin.campaign.description import resolve_campaign
from counterspin.campaign.documents import DESCRIPTION_NAME, load_document, parse_document
from counterspin.campaign.questions import questions
from counterspin.campaign.validation import Problems
from counterspin.certificates.completeness import (
    MissingEntry,
    missing_data,
    missing_despite_mistakes,
    section_of,
)
from counterspin.certificates.lab import read_lab
from counterspin.errors import CampaignError, CounterspinError
from counterspin.frozen import frozen
from counterspin.planning.plan_file import is_plan
from counterspin.planning.stations import read_any_plan
from counterspin.studies.description import parse_study
from counterspin.toml_text import parse_toml

KeyPath = Sequence[str | int]

#: Sections that hold tables with headings of their own; tables within others are written in line.
_OF_TABLES: Final = ("accelerometers", "truth", "model", "specification", "study")


@frozen
class EditedText:
    """A TOML text with its parsed document and its mistakes."""

    text: str  #: Of the file.
    document: dict[str, Any]  #: Its tables; empty where the text is not TOML.
    #: Mistakes, each as key (empty: of the whole) and words.
    problems: tuple[tuple[str, str], ...] = ()
    questions: tuple[str, ...] = ()  #: What may well be a slip.
    missing: tuple[MissingEntry, ...] = ()  #: What a certificate lacks, by key.

    def shown(self) -> dict[str, Any]:
        """Return the state for the page."""
        return {
            "text": self.text,
            "document": json.loads(json.dumps(self.document, default=str)),
            "problems": [{"key": key, "words": words} for key, words in self.problems],
            "questions": list(self.questions),
            "missing": [{"key": entry.key, "words": entry.words} for entry in self.missing],
            "run_kinds": run_kinds(self.document),
        }


def checked_campaign(desk: Desk, file: Path, text: str) -> EditedText:
    """Return a campaign's text with all its mistakes."""
    try:
        document = parse_text(text)
        desk.require_inside(file.parent, document)
    except CampaignError as error:
        return EditedText(text, {}, _split(error.problems))
    problems = Problems(document)
    campaign = resolve_campaign(document, file, problems)
    asked = () if campaign is None else tuple(q.text for q in questions(campaign))
    if "study" in document and not problems.lines:
        try:
            parse_study(document, file)
        except CampaignError as error:
            return EditedText(text, document, _split(error.problems), asked)
    return EditedText(text, document, _split(problems.lines), asked)


def checked_lab(text: str, result: Result) -> EditedText:
    """Return the laboratory's data with all mistakes, for the certificate of a result."""
    try:
        document = parse_text(text)
    except CampaignError as error:
        return EditedText(text, {}, _split(error.problems))
    try:
        lab, _ = read_lab(document, result)
    except CampaignError as error:
        problems = _split(error.problems)
        mistaken = {section_of(key) for key, _ in problems}
        missing = missing_despite_mistakes(document, mistaken, result)
        return EditedText(text, document, problems, missing=tuple(missing))
    return EditedText(text, document, missing=tuple(missing_data(lab, result)))


def checked_plan(desk: Desk, file: Path, text: str) -> EditedText:
    """Return a plan's text with all its mistakes."""
    document: dict[str, Any] = {}
    try:
        document = parse_text(text)
        desk.require_inside(file.parent, document)
        read_any_plan(document, file)
    except CampaignError as error:
        return EditedText(text, document, _split(error.problems))
    return EditedText(text, document)


def parse_text(text: str, source: str = "the text") -> dict[str, Any]:
    """Return the document of an edited text; CampaignError if it is not TOML or too long."""
    content = text.encode("utf-8", "replace")
    if len(content) > TEXT_BYTES:
        raise CampaignError(source, [f"has more than {TEXT_BYTES} bytes"])
    return parse_document(content, source)


def _split(problems: Sequence[str]) -> tuple[tuple[str, str], ...]:
    """Return a mistake's key and words; a mistake of the whole document has no key."""
    split = []
    for problem in problems:
        key, colon, words = problem.partition(": ")
        is_key = bool(colon) and " " not in key.split('"')[0]
        split.append((key, words) if is_key else ("", problem))
    return tuple(split)


def with_value(text: str, path: KeyPath, value: Any, kind: str = "") -> str:
    """Return a text with another value at a key; the rest stays as it is written.

    value: The new value; None removes the key, or the list's entry.
    """
    if not path:
        raise CounterspinError("no key is named")
    if kind == "date" and value is not None:
        try:
            value = datetime.date.fromisoformat(value)
        except (TypeError, ValueError) as error:
            raise CounterspinError(f"{value!r} is not a date: write 2026-03-01") from error
    said = parse_text(text)
    try:
        wanted = _with(said, path, value)
        document = tomlkit.parse(text)
        _set(document, path, value)
        made = tomlkit.dumps(document)
        same = parse_toml(made) == wanted
    except (TOMLKitError, LookupError, TypeError, ValueError, AttributeError) as error:
        raise CounterspinError(_NOT_HERE) from error
    if not same:
        raise CounterspinError(_NOT_HERE)
    return made


_NOT_HERE: Final = "This field cannot change the file as it is written; edit the text instead."


def _with(document: dict[str, Any], path: KeyPath, value: Any) -> dict[str, Any]:
    """Return the document that the changed text must parse to."""
    wanted = copy.deepcopy(document)
    place: Any = wanted
    for part, following in pairwise(path):
        place = _inside(place, part, {} if isinstance(following, str) else [])
    _put(place, path[-1], value)
    return wanted


def _set(document: tomlkit.TOMLDocument, path: KeyPath, value: Any) -> None:
    """Change a document and keep its formatting."""
    place: Any = document
    new: list[tuple[Any, str]] = []
    for depth, (part, following) in enumerate(pairwise(path)):
        headed = depth == 0 or (depth == 1 and path[0] in _OF_TABLES)
        empty: Any = tomlkit.aot()
        if isinstance(following, str):
            empty = tomlkit.table(depth == 0 and part in _OF_TABLES) if headed else None
            empty = tomlkit.inline_table() if empty is None else empty
        if isinstance(part, str) and part not in place:
            new.append((place, part))
        place = _inside(place, part, empty)
    last = path[-1]
    if isinstance(value, dict) and _is_headed(place, path):
        table = tomlkit.table()
        table.update(value)
        table.add(tomlkit.nl())
        value = table
    if isinstance(last, str) and value is not None and last not in place:
        new.append((place, last))
    _put(place, last, value)
    for table, key in new:
        _move_up(table, key)


def _move_up(table: Any, new: str) -> None:
    """Move a key from a table's end above the comments that belong to the next table.

    Comments directly below the table's last key belong to the table. Those after a blank line, or
    from a heading on, such as ``# [specification]``, do not: uncommented, the heading would take
    the key.
    """
    if not isinstance(table, Table | Container):
        return
    # The table's index of its keys is not kept up: only the text is made of it now.
    body = (table.value if isinstance(table, Table) else table).body
    here = [None if key is None else key.key for key, _ in body].index(new)
    if isinstance(body[here][1], Table | AoT):
        return
    above = here
    while above and body[above - 1][0] is None:
        above -= 1
    while isinstance(said := body[above][1], Comment) and not _HEADING.match(said.trivia.comment):
        above += 1
    body.insert(above, body.pop(here))


_HEADING: Final = re.compile(r"#\s*\[")


def _is_headed(place: Any, path: KeyPath) -> bool:
    """Return whether a table at this place gets its own heading."""
    if isinstance(path[-1], int):
        return isinstance(place, AoT)
    return len(path) <= (2 if path[0] in _OF_TABLES else 1)


def _inside(place: Any, part: str | int, empty: Any) -> Any:
    """Return the value at a key or place; create an empty one if there is none."""
    if isinstance(part, int):
        if part == len(place):
            place.append(empty)
    elif part not in place:
        place[part] = empty
    return place[part]


def _put(place: Any, last: str | int, value: Any) -> None:
    if value is None:
        if isinstance(last, int) or last in place:
            del place[last]
    elif isinstance(last, int) and last == len(place):
        place.append(value)
    else:
        place[last] = value


def description(desk: Desk, name: str) -> dict[str, Any]:
    """Return a campaign's description: text, version, form, values and mistakes."""
    path = desk.description(name)
    seen = desk.folder.read(desk.folder.name(path))
    told = checked_campaign(desk, path, seen.text).shown()
    return told | {
        "file": desk.folder.name(path),
        "version": seen.version,
        "form": campaign_form(),
    }


def plan_text(desk: Desk, name: str) -> dict[str, Any]:
    """Return a plan's text, version, form, values and mistakes; name: its file."""
    path = desk.file(name)
    document = load_document(path)
    if not is_plan(document):
        raise OutsideError(f"{name}: not a plan: it has no [limits] and [goal]")
    seen = desk.folder.read(name)
    return checked_plan(desk, path, seen.text).shown() | {
        "file": name,
        "version": seen.version,
        "form": plan_form("stations" in document),
    }


def check_text(desk: Desk, file: str, text: str, result: str | None = None) -> dict[str, Any]:
    """Return the values and mistakes of a text that would replace a file's."""
    return _checked(desk, file, text, result).shown()


def change_text(
    desk: Desk,
    file: str,
    text: str,
    path: list[str | int],
    value: Any,
    kind: Literal["", "date"] = "",
    result: str | None = None,
) -> dict[str, Any]:
    """Return a text with another value at a key, as `check_text` does."""
    return _checked(desk, file, with_value(text, path, value, kind), result).shown()


def _checked(desk: Desk, file: str, text: str, result: str | None) -> EditedText:
    path = _place(desk, file)
    if path.name == DESCRIPTION_NAME:
        return checked_campaign(desk, path, text)
    if result is not None:
        return checked_lab(text, desk.result(result))
    if not (path.is_file() and is_plan(load_document(path))):
        raise OutsideError(
            f"{file}: only descriptions, plans and the laboratory's data are edited here"
        )
    return checked_plan(desk, path, text)


def save_text(
    desk: Desk, file: str, text: str, version: str, result: str | None = None
) -> dict[str, Any]:
    """Write a text, even with mistakes, if the file has not changed since its editor read it."""
    path, told = _place(desk, file), _checked(desk, file, text, result)
    if result is None and path.name != DESCRIPTION_NAME and not is_plan(told.document):
        raise CounterspinError(f"{file}: a plan has [limits] and [goal]; nothing was saved")
    return told.shown() | {"file": file, "version": desk.folder.write(file, text, version).version}


def _place(desk: Desk, file: str) -> Path:
    """Return the path of a text; OutsideError unless it is a TOML file."""
    path = desk.folder.path(file)
    if path.suffix.lower() != ".toml":
        raise OutsideError(f"{file}: only files in TOML are edited here")
    return path
