"""The laboratory's data for the certificate of a result, their preview, and a profile of them.

The profile is a file of the served folder. It keeps what is the same on each certificate of a
laboratory, and fills in the data of the next one.
"""

from __future__ import annotations

import datetime
import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from counterspin.application.desk import Desk
from counterspin.application.editing import checked_lab, parse_text, with_value
from counterspin.application.form import lab_form
from counterspin.calibration.result import Result
from counterspin.campaign.documents import KeyPath, key_path, table_of
from counterspin.certificates.issuing import draft_pages
from counterspin.certificates.lab import example_text, is_template_value
from counterspin.errors import CounterspinError
from counterspin.toml_text import write_document

#: The profile's file, in the served folder itself.
PROFILE_NAME: Final = "laboratory.toml"

#: Sections of the laboratory's data, and keys of [certificate], that are the same on each
#: certificate.
_SECTIONS: Final = ("laboratory", "persons", "equipment", "cmc")
_KEYS: Final = ("language", "place", "traceability", "procedure")


def lab_data(desk: Desk, file: str, result: str) -> dict[str, Any]:
    """Return the laboratory's data in a file; without a file, the template with the profile."""
    seen, found = desk.folder.read(file), desk.result(result)
    text = seen.text or _initial_text(desk, found, desk.folder.path(file).parent)
    return checked_lab(text, found).shown() | {
        "file": file,
        "version": seen.version,
        "form": lab_form(),
        "signer": "" if desk.signer is None else desk.signer.name,
        "profile": bool(_profile(desk)),
    }


def draft_preview(desk: Desk, file: str, text: str, result: str) -> dict[str, Any]:
    """Return the pages of the certificate as SVG images, marked as a draft.

    file: That of the laboratory's data, from which the logo is found.
    """
    found, document, folder = desk.result(result), parse_text(text), desk.folder.path(file).parent
    desk.require_inside(folder, document)
    with desk.drawing:
        return {"pages": draft_pages(found, document, folder)}


def save_profile(desk: Desk, file: str, text: str) -> dict[str, Any]:
    """Write the laboratory's profile from its data; return the file's name."""
    document, folder = parse_text(text), desk.folder.path(file).parent
    desk.require_inside(folder, document)
    kept: dict[str, Any] = {
        key: value for key in _SECTIONS if (value := _without_template(document.get(key), (key,)))
    }
    settings = table_of(document, "certificate")
    kept["certificate"] = _without_template(
        {key: settings[key] for key in _KEYS if key in settings}, ("certificate",)
    )
    _move_logo(kept, folder, desk.folder.root)
    if not any(kept.values()):
        raise CounterspinError("The profile would be empty: fill in the laboratory first.")
    desk.folder.write(PROFILE_NAME, write_document(kept), desk.folder.read(PROFILE_NAME).version)
    return {"file": PROFILE_NAME}


def _initial_text(desk: Desk, result: Result, folder: Path) -> str:
    """Return the template, with the values of the profile and the date of the campaign.

    folder: That of the laboratory's data.
    """
    text = example_text()
    day = result.details.get("date")
    with suppress(TypeError, ValueError):
        text = _with_dates(text, datetime.date.fromisoformat(day or ""))
    profile = dict(_profile(desk))
    _move_logo(profile, desk.folder.root, folder)
    for path, value in _entries(profile):
        try:
            text = with_value(text, path, value)
        except CounterspinError as error:
            raise CounterspinError(
                f"{PROFILE_NAME}: {key_path(path)}: cannot be used; correct or remove this file"
            ) from error
    return text


def _move_logo(document: dict[str, Any], folder: Path, new_folder: Path) -> None:
    """State the path of the logo relative to another folder."""
    laboratory = table_of(document, "laboratory")
    if isinstance(logo := laboratory.get("logo"), str):
        path = Path(os.path.relpath(folder / logo, new_folder)).as_posix()
        document["laboratory"] = {**laboratory, "logo": path}


def _with_dates(text: str, day: datetime.date) -> str:
    for key in ("begin", "end"):
        text = with_value(text, ("certificate", key), day)
    return text


def _profile(desk: Desk) -> Mapping[str, Any]:
    """Return the profile; empty without one."""
    return parse_text(desk.folder.read(PROFILE_NAME).text, PROFILE_NAME)


def _without_template(value: Any, path: KeyPath) -> Any:
    """Return a value without those of the template."""
    if isinstance(value, dict):
        kept = {key: _without_template(inner, (*path, key)) for key, inner in value.items()}
        return {key: inner for key, inner in kept.items() if inner not in (None, {}, [])}
    if isinstance(value, list):
        kept_items = [_without_template(inner, path) for inner in value]
        return [inner for inner in kept_items if inner not in (None, {}, [])]
    return None if is_template_value(path, value) else value


def _entries(profile: Mapping[str, Any]) -> Iterator[tuple[KeyPath, Any]]:
    """Yield the entries of a profile with their paths: a table's values, and a list's tables."""
    for section, content in profile.items():
        if isinstance(content, dict):
            yield from (((section, key), value) for key, value in content.items())
        elif isinstance(content, list):
            yield from (((section, place), value) for place, value in enumerate(content))
