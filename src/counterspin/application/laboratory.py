"""Laboratory data for the certificate of a result, with preview and profile.

The profile is a file in the served folder with the data that are common to all certificates of a
laboratory. It prefills the data of the next certificate.
"""

from __future__ import annotations

import datetime
import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from counterspin.application.answers import (
    CertificatePages,
    IssuedCertificate,
    LaboratoryData,
    ProfileFile,
)
from counterspin.application.app_state import AppState
from counterspin.application.editing import parse_lab_text, parse_text, set_value
from counterspin.application.form import lab_form
from counterspin.application.served_folder import RequestError
from counterspin.calibration.result import Result
from counterspin.campaign.documents import KeyPath, format_key_path, table_of
from counterspin.certificates.certificate_reader import read_certificate, read_document
from counterspin.certificates.issuing import draft_pages
from counterspin.certificates.lab import example_text, is_template_value
from counterspin.errors import CounterspinError
from counterspin.toml_text import format_document

#: File name of the profile, at the top level of the served folder.
PROFILE_NAME: Final = "laboratory.toml"

#: Sections of the laboratory data, and keys of [certificate], that are kept in the profile.
_PROFILE_SECTIONS: Final = ("laboratory", "persons", "equipment", "cmc")
_PROFILE_KEYS: Final = ("language", "place", "traceability", "procedure")


def read_lab_data(app: AppState, file: str, result: str) -> LaboratoryData:
    """Return the laboratory data in a file; without a file, the template and the profile."""
    file_version, calibration = app.folder.read(file), app.result(result)
    text = file_version.text or _initial_text(app, calibration, app.folder.path(file).parent)
    return {
        **parse_lab_text(text, calibration).to_dict(),
        "file": file,
        "version": file_version.version,
        "form": lab_form(),
        "signer": "" if app.signer is None else app.signer.name,
        "profile": bool(_read_profile(app)),
        "certificates": list(_issued_certificates(app, app.file(result).parent)),
    }


def _issued_certificates(app: AppState, folder: Path) -> Iterator[IssuedCertificate]:
    """Yield file and identifier of each issued certificate of a folder, the newest first."""
    paths = [path for path in folder.glob("*.xml") if app.folder.contains(path) and path.is_file()]
    for path in sorted(paths, key=lambda path: -path.stat().st_mtime):
        try:
            identifier = read_certificate(read_document(path), path.name).identifier
        except CounterspinError:
            continue  # an XML file of another program
        if not identifier.startswith("DRAFT-"):
            yield {"file": app.folder.name(path), "identifier": identifier}


def render_draft(app: AppState, file: str, text: str, result: str) -> CertificatePages:
    """Return the pages of the certificate as SVG images, marked as a draft.

    file: File of the laboratory data; the path of the logo is relative to its folder.
    """
    calibration = app.result(result)
    document = parse_text(text)
    folder = app.folder.path(file).parent
    app.require_inside(folder, document)
    with app.drawing:
        return {"pages": draft_pages(calibration, document, folder)}


def save_profile(app: AppState, file: str, text: str) -> ProfileFile:
    """Write the profile from laboratory data; return the file name."""
    document, folder = parse_text(text), app.folder.path(file).parent
    app.require_inside(folder, document)
    profile: dict[str, Any] = {
        key: value
        for key in _PROFILE_SECTIONS
        if (value := _strip_template(document.get(key), (key,)))
    }
    settings = table_of(document, "certificate")
    profile["certificate"] = _strip_template(
        {key: settings[key] for key in _PROFILE_KEYS if key in settings}, ("certificate",)
    )
    _rebase_logo_path(profile, folder, app.folder.root)
    if not any(profile.values()):
        raise RequestError("The profile would be empty. Fill in the Laboratory section first.")
    app.folder.write(PROFILE_NAME, format_document(profile), app.folder.read(PROFILE_NAME).version)
    return {"file": PROFILE_NAME}


def _initial_text(app: AppState, result: Result, folder: Path) -> str:
    """Return the template, with the values of the profile and the date of the campaign.

    folder: Folder of the laboratory data.
    """
    text = example_text()
    date_text = result.details.get("date")
    with suppress(TypeError, ValueError):
        text = _set_dates(text, datetime.date.fromisoformat(date_text or ""))
    profile = dict(_read_profile(app))
    _rebase_logo_path(profile, app.folder.root, folder)
    for path, value in _profile_entries(profile):
        try:
            text = set_value(text, path, value)
        except CounterspinError as error:
            raise RequestError(
                f"{PROFILE_NAME}: {format_key_path(path)} cannot be used; correct or remove "
                "this file"
            ) from error
    return text


def _rebase_logo_path(document: dict[str, Any], folder: Path, new_folder: Path) -> None:
    """Make the path of the logo relative to another folder."""
    laboratory = table_of(document, "laboratory")
    if isinstance(logo := laboratory.get("logo"), str):
        path = Path(os.path.relpath(folder / logo, new_folder)).as_posix()
        document["laboratory"] = {**laboratory, "logo": path}


def _set_dates(text: str, day: datetime.date) -> str:
    for key in ("begin", "end"):
        text = set_value(text, ("certificate", key), day)
    return text


def _read_profile(app: AppState) -> Mapping[str, Any]:
    """Return the profile; empty if there is none."""
    return parse_text(app.folder.read(PROFILE_NAME).text, PROFILE_NAME)


def _strip_template(value: Any, path: KeyPath) -> Any:
    """Return a value without values of the template."""
    if isinstance(value, dict):
        stated_values = {key: _strip_template(item, (*path, key)) for key, item in value.items()}
        return {key: item for key, item in stated_values.items() if item not in (None, {}, [])}
    if isinstance(value, list):
        stated_items = [_strip_template(item, path) for item in value]
        return [item for item in stated_items if item not in (None, {}, [])]
    return None if is_template_value(path, value) else value


def _profile_entries(profile: Mapping[str, Any]) -> Iterator[tuple[KeyPath, Any]]:
    """Yield paths and values of a profile: values of tables, and tables in lists."""
    for section, content in profile.items():
        if isinstance(content, dict):
            yield from (((section, key), value) for key, value in content.items())
        elif isinstance(content, list):
            yield from (((section, index), value) for index, value in enumerate(content))
