"""The description of a campaign, and the laboratory's data, as they are edited in the page."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from counterspin.application.desk import Desk
from counterspin.application.editing import EditedText, changed, checked_campaign, checked_lab
from counterspin.application.folder import OutsideError
from counterspin.application.form import campaign_form, lab_form
from counterspin.campaign.toml_file import DESCRIPTION_NAME
from counterspin.certificates.lab import write_example


def description(desk: Desk, name: str) -> dict[str, Any]:
    """Return a campaign's description: text, version, form, what it says, what is wrong."""
    path = desk.description(name)
    seen = desk.folder.read(desk.folder.name(path))
    told = checked_campaign(desk, path, seen.text).shown()
    return told | {
        "file": desk.folder.name(path),
        "version": seen.version,
        "form": campaign_form(),
    }


def lab_data(desk: Desk, file: str, result: str) -> dict[str, Any]:
    """Return the laboratory's data in a file, or the example where there is none yet."""
    seen = desk.folder.read(file)
    text = seen.text or _example()
    told = checked_lab(text, desk.result(result)).shown()
    return told | {
        "file": file,
        "version": seen.version,
        "form": lab_form(),
        "signer": "" if desk.signer is None else desk.signer.name,
    }


def _example() -> str:
    """Return the example of the laboratory's data."""
    from tempfile import TemporaryDirectory

    with TemporaryDirectory() as folder:
        return write_example(Path(folder) / "LAB.toml").read_text(encoding="utf-8")


def check_text(desk: Desk, file: str, text: str, result: str | None = None) -> dict[str, Any]:
    """Return what a text would say in the place of a file, and what is wrong with it."""
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
    return _checked(desk, file, changed(text, path, value, kind), result).shown()


def _checked(desk: Desk, file: str, text: str, result: str | None) -> EditedText:
    path = _place(desk, file)
    if path.name == DESCRIPTION_NAME:
        return checked_campaign(desk, path, text)
    if result is None:
        raise OutsideError(f"{file}: only descriptions and the laboratory's data are edited here")
    return checked_lab(text, desk.result(result))


def save_text(
    desk: Desk, file: str, text: str, version: str, result: str | None = None
) -> dict[str, Any]:
    """Write a text, mistakes and all, if the file still is what its editor had seen."""
    _place(desk, file)
    told = _checked(desk, file, text, result).shown()
    return told | {"file": file, "version": desk.folder.write(file, text, version).version}


def _place(desk: Desk, file: str) -> Path:
    """Return where a text stands; OutsideError of what is no TOML file."""
    path = desk.folder.path(file)
    if path.suffix.lower() != ".toml":
        raise OutsideError(f"{file}: only files in TOML are edited here")
    return path
