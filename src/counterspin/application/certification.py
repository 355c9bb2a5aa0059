"""Certificates and reports from the page, and files to be saved elsewhere."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final, Literal

from counterspin.application.commands import certificate_command
from counterspin.application.desk import Desk
from counterspin.application.folder import OutsideError
from counterspin.campaign.toml_file import load_document
from counterspin.certificates.issuing import issue_certificate
from counterspin.errors import CounterspinError
from counterspin.input import read_file

#: Endings of what may be saved elsewhere: what this program writes.
_WRITTEN_SUFFIXES: Final = (".html", ".json", ".md", ".pdf", ".svg", ".toml", ".xml")


def begin_certificate(desk: Desk, result: str, lab: str, output: str) -> dict[str, Any]:
    """Issue the certificate of a result; return what it is known by, and what to check."""
    files = desk.file(result), desk.file(lab), desk.folder.path(output)
    # The ledger, too.
    desk.require_inside(files[1].parent, load_document(files[1]))
    with desk.drawing:
        made = issue_certificate(*files)
    return {
        "identifier": made.identifier,
        "accelerometers": made.accelerometers,
        "notes": made.notes,
        "file": output,
        "command": certificate_command(*files),
    }


def report_of(desk: Desk, result: str, kind: Literal["html", "md", "pdf"]) -> tuple[str, bytes]:
    """Return a report's own name and what is in it; nothing is written into the folder."""
    from counterspin.reports.publishing import report

    found = desk.result(result)
    with desk.drawing:
        made = report(found, "pdf") if kind == "pdf" else report(found, kind).encode()
    return f"{desk.file(result).stem}.{kind}", made


def taken_file(desk: Desk, name: str) -> tuple[str, bytes]:
    """Return a file's own name and what is in it; OutsideError of what is not made here."""
    path: Path = desk.file(name)
    if path.suffix.lower() not in _WRITTEN_SUFFIXES:
        raise OutsideError(f"{name}: only files that counterspin writes can be saved from here")
    try:
        return path.name, read_file(path)
    except OSError as error:
        raise CounterspinError(f"{name}: cannot be read: {error.strerror}") from error
