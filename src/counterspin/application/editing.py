"""Editing of a file as a form and as text.

The text is the source: a changed field changes the text, and comments and the order of keys are
kept (tomlkit).
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

from counterspin.application.answers import EditedDocument, EditedFile, SavedDocument
from counterspin.application.app_state import AppState
from counterspin.application.form import campaign_form, detect_run_types, plan_form
from counterspin.application.served_folder import TEXT_MAX_BYTES, PathForbiddenError, RequestError
from counterspin.calibration.result import Result
from counterspin.campaign.description import resolve_campaign
from counterspin.campaign.documents import DESCRIPTION_NAME, load_document, parse_document
from counterspin.campaign.questions import ask_questions
from counterspin.campaign.validation import Problems
from counterspin.certificates.completeness import (
    MissingEntry,
    missing_data,
    missing_data_despite_mistakes,
    section_name,
)
from counterspin.certificates.lab import read_lab
from counterspin.errors import CampaignError, CounterspinError
from counterspin.frozen import frozen
from counterspin.planning.plan_file import is_plan
from counterspin.planning.stations import read_any_plan
from counterspin.studies.description import parse_study
from counterspin.toml_text import parse_toml

KeyPath = Sequence[str | int]

#: Sections whose tables have headings; tables within other sections are written inline.
_TABLE_SECTIONS: Final = ("accelerometers", "truth", "model", "specification", "study")


@frozen
class EditedText:
    """A TOML text with its parsed document and its mistakes."""

    text: str  #: Content of the file.
    document: dict[str, Any]  #: Parsed document; empty if the text is not TOML.
    #: Mistakes: key (empty: the whole document) and message.
    problems: tuple[tuple[str, str], ...] = ()
    questions: tuple[str, ...] = ()  #: Questions on probable mistakes.
    missing: tuple[MissingEntry, ...] = ()  #: Entries that a certificate lacks.

    def to_dict(self) -> EditedDocument:
        """Return the state for the page."""
        return {
            "text": self.text,
            "document": json.loads(json.dumps(self.document, default=str)),
            "problems": [{"key": key, "words": words} for key, words in self.problems],
            "questions": list(self.questions),
            "missing": [{"key": entry.key, "words": entry.message} for entry in self.missing],
            "run_kinds": detect_run_types(self.document),
        }


def parse_campaign_text(app: AppState, file: Path, text: str) -> EditedText:
    """Parse a campaign's text and find all mistakes."""
    try:
        document = parse_text(text)
        app.require_inside(file.parent, document)
    except CampaignError as error:
        return EditedText(text, {}, _split_problems(error.problems, app))
    problems = Problems(document)
    campaign = resolve_campaign(document, file, problems)
    question_texts = (
        () if campaign is None else tuple(question.text for question in ask_questions(campaign))
    )
    if "study" in document and not problems.lines:
        try:
            parse_study(document, file)
        except CampaignError as error:
            return EditedText(text, document, _split_problems(error.problems, app), question_texts)
    return EditedText(text, document, _split_problems(problems.lines, app), question_texts)


def parse_lab_text(text: str, result: Result) -> EditedText:
    """Parse laboratory data for the certificate of a result and find all mistakes."""
    try:
        document = parse_text(text)
    except CampaignError as error:
        return EditedText(text, {}, _split_problems(error.problems))
    try:
        lab, _ = read_lab(document, result)
    except CampaignError as error:
        problems = _split_problems(error.problems)
        invalid_sections = {section_name(key) for key, _ in problems}
        missing = missing_data_despite_mistakes(document, invalid_sections, result)
        return EditedText(text, document, problems, missing=tuple(missing))
    return EditedText(text, document, missing=tuple(missing_data(lab, result)))


def parse_plan_text(app: AppState, file: Path, text: str) -> EditedText:
    """Parse a plan's text and find all mistakes."""
    document: dict[str, Any] = {}
    try:
        document = parse_text(text)
        app.require_inside(file.parent, document)
        read_any_plan(document, file)
    except CampaignError as error:
        return EditedText(text, document, _split_problems(error.problems, app))
    return EditedText(text, document)


def parse_text(text: str, source: str = "the text") -> dict[str, Any]:
    """Parse an edited text; CampaignError if it is not TOML or too long."""
    content = text.encode("utf-8", "replace")
    if len(content) > TEXT_MAX_BYTES:
        raise CampaignError(
            source, [f"has more than {TEXT_MAX_BYTES} bytes"], code="file-too-large"
        )
    return parse_document(content, source)


def _split_problems(
    problems: Sequence[str], app: AppState | None = None
) -> tuple[tuple[str, str], ...]:
    """Split problems into key and message; the key is empty for the whole document.

    app: Application whose folder paths in the messages are relative to; None: no paths.
    """
    keyed_problems = []
    for line in problems:
        problem = line if app is None else app.folder.relative_paths(line)
        key, colon, message = problem.partition(": ")
        has_key = bool(colon) and " " not in key.split('"')[0]
        keyed_problems.append((key, message) if has_key else ("", problem))
    return tuple(keyed_problems)


def set_value(text: str, path: KeyPath, value: Any, kind: str = "") -> str:
    """Return a text with another value at a key, and unchanged formatting.

    value: New value; None removes the key or the list entry.
    """
    if not path:
        raise RequestError("the key is missing")
    if kind == "date" and value is not None:
        try:
            value = datetime.date.fromisoformat(value)
        except (TypeError, ValueError) as error:
            raise CounterspinError(
                f"{value!r} is not a date; use the form 2026-03-01", code="invalid-date"
            ) from error
    parsed_document = parse_text(text)
    try:
        expected_document = _make_expected_document(parsed_document, path, value)
        document = tomlkit.parse(text)
        _set_and_keep_format(document, path, value)
        changed_text = tomlkit.dumps(document)
        is_as_expected = parse_toml(changed_text) == expected_document
    except (TOMLKitError, LookupError, TypeError, ValueError, AttributeError) as error:
        raise RequestError(_NOT_EDITABLE) from error
    if not is_as_expected:
        raise RequestError(_NOT_EDITABLE)
    return changed_text


_NOT_EDITABLE: Final = "This value cannot be edited in the form. Edit the file as text instead."


def _make_expected_document(document: dict[str, Any], path: KeyPath, value: Any) -> dict[str, Any]:
    """Return the document that must result from parsing the changed text."""
    changed_document = copy.deepcopy(document)
    table: Any = changed_document
    for key, next_key in pairwise(path):
        table = _get_or_create_item(table, key, {} if isinstance(next_key, str) else [])
    _assign_value(table, path[-1], value)
    return changed_document


def _set_and_keep_format(document: tomlkit.TOMLDocument, path: KeyPath, value: Any) -> None:
    """Change a document and keep its formatting."""
    container: Any = document
    added_keys: list[tuple[Any, str]] = []
    for depth, (key, next_key) in enumerate(pairwise(path)):
        needs_table_heading = depth == 0 or (depth == 1 and path[0] in _TABLE_SECTIONS)
        new_value: Any = tomlkit.aot()
        if isinstance(next_key, str):
            new_value = (
                tomlkit.table(depth == 0 and key in _TABLE_SECTIONS)
                if needs_table_heading
                else tomlkit.inline_table()
            )
        if isinstance(key, str) and key not in container:
            added_keys.append((container, key))
        container = _get_or_create_item(container, key, new_value)
    last_key = path[-1]
    if isinstance(value, dict) and _has_heading(container, path):
        table = tomlkit.table()
        table.update(value)
        table.add(tomlkit.nl())
        value = table
    if isinstance(last_key, str) and value is not None and last_key not in container:
        added_keys.append((container, last_key))
    _assign_value(container, last_key, value)
    for table, key in added_keys:
        _move_above_comments(table, key)


def _move_above_comments(table: Any, key: str) -> None:
    """Move a key from the end of a table above comments that belong to the next table.

    Comments directly below the last key belong to the table. Comments after a blank line, or from a
    commented heading on, such as ``# [specification]``, do not: if the heading is uncommented, the
    key would belong to it.
    """
    if not isinstance(table, Table | Container):
        return
    # The index of keys is not updated, because the table is only written from here on.
    body = (table.value if isinstance(table, Table) else table).body
    keys = [None if item is None else item.key for item, _ in body]
    index = keys.index(key)
    if isinstance(body[index][1], Table | AoT):
        return
    target_index = index
    while target_index and body[target_index - 1][0] is None:
        target_index -= 1
    while isinstance(element := body[target_index][1], Comment) and not _HEADING.match(
        element.trivia.comment
    ):
        target_index += 1
    body.insert(target_index, body.pop(index))


_HEADING: Final = re.compile(r"#\s*\[")


def _has_heading(container: Any, path: KeyPath) -> bool:
    """Return whether a table at this path gets a heading."""
    if isinstance(path[-1], int):
        return isinstance(container, AoT)
    return len(path) <= (2 if path[0] in _TABLE_SECTIONS else 1)


def _get_or_create_item(container: Any, key: str | int, new_value: Any) -> Any:
    """Return the value at a key or index; create an empty value if there is none."""
    if isinstance(key, int):
        if key == len(container):
            container.append(new_value)
    elif key not in container:
        container[key] = new_value
    return container[key]


def _assign_value(container: Any, key: str | int, value: Any) -> None:
    if value is None:
        if isinstance(key, int) or key in container:
            del container[key]
    elif isinstance(key, int) and key == len(container):
        container.append(value)
    else:
        container[key] = value


def read_campaign_text(app: AppState, name: str) -> EditedFile:
    """Return text, version, form, values and mistakes of a campaign's description."""
    path = app.description_path(name)
    file_version = app.folder.read(app.folder.name(path))
    content = parse_campaign_text(app, path, file_version.text).to_dict()
    return {
        **content,
        "file": app.folder.name(path),
        "version": file_version.version,
        "form": campaign_form(),
    }


def read_plan_text(app: AppState, name: str) -> EditedFile:
    """Return text, version, form, values and mistakes of a plan file."""
    path = app.file(name)
    document = load_document(path)
    if not is_plan(document):
        raise PathForbiddenError(f"{name} is not a plan: [limits] and [goal] are missing")
    file_version = app.folder.read(name)
    return {
        **parse_plan_text(app, path, file_version.text).to_dict(),
        "file": name,
        "version": file_version.version,
        "form": plan_form("stations" in document),
    }


def check_text(app: AppState, file: str, text: str, result: str | None = None) -> EditedDocument:
    """Return values and mistakes of a text for a file, without saving it."""
    return _parse_file_text(app, file, text, result).to_dict()


def change_text(
    app: AppState,
    file: str,
    text: str,
    path: list[str | int],
    value: Any,
    kind: Literal["", "date"] = "",
    result: str | None = None,
) -> EditedDocument:
    """Return a text with another value at a key, checked as in `check_text`."""
    return _parse_file_text(app, file, set_value(text, path, value, kind), result).to_dict()


def _parse_file_text(app: AppState, file: str, text: str, result: str | None) -> EditedText:
    path = _text_path(app, file)
    if path.name == DESCRIPTION_NAME:
        return parse_campaign_text(app, path, text)
    if result is not None:
        return parse_lab_text(text, app.result(result))
    if not (path.is_file() and is_plan(load_document(path))):
        raise PathForbiddenError(
            f"{file}: only descriptions, plans and laboratory data can be edited in the application"
        )
    return parse_plan_text(app, path, text)


def save_text(
    app: AppState, file: str, text: str, version: str, result: str | None = None
) -> SavedDocument:
    """Write a text, even with mistakes, unless the file has changed since it was read."""
    path, content = _text_path(app, file), _parse_file_text(app, file, text, result)
    if result is None and path.name != DESCRIPTION_NAME and not is_plan(content.document):
        raise RequestError(f"{file}: a plan requires [limits] and [goal]; nothing was saved")
    saved_file = app.folder.write(file, text, version)
    return {**content.to_dict(), "file": file, "version": saved_file.version}


def _text_path(app: AppState, file: str) -> Path:
    """Return the path of a text file; PathForbiddenError unless it is a TOML file."""
    path = app.folder.path(file)
    if path.suffix.lower() != ".toml":
        raise PathForbiddenError(f"{file}: only TOML files can be edited in the application")
    return path
