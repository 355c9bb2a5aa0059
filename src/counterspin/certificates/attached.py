"""The XML that a certificate's PDF carries (PDF/A-3, ISO 19005-3)."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, Final

from counterspin.errors import REASON_LENGTH, CounterspinError, RecordError, installing
from counterspin.input import read_file
from counterspin.records.isolation import isolated

_PYPDF_MISSING: Final = (
    f"reading a PDF needs the package pypdf, which is not installed: {installing('signature')}"
)


def read_document(path: Path) -> bytes:
    """Return the XML of a certificate: the file, or what is attached to a PDF.

    A PDF is read where it can do no harm, as records of native formats are.
    """
    if path.suffix.lower() == ".pdf":
        return isolated(_attached, path)
    return _content(path)


def _content(path: Path) -> bytes:
    try:
        return read_file(path)
    except OSError as error:
        raise RecordError(
            f"{path}: cannot be read ({error.strerror}); give a certificate's XML or PDF"
        ) from error


def _attached(path: Path) -> bytes:
    content = _content(path)
    try:
        import pypdf
    except ImportError as error:
        raise CounterspinError(_PYPDF_MISSING) from error
    try:
        found = _xml_files(pypdf.PdfReader(io.BytesIO(content)))
    except MemoryError:
        raise
    except Exception as error:  # whatever pypdf and zlib raise on a damaged file
        reason = str(error)[:REASON_LENGTH] or type(error).__name__
        raise RecordError(f"{path}: is not a PDF, or is damaged ({reason})") from error
    if len(found) != 1:
        held = "no XML file is" if not found else f"{len(found)} XML files are"
        raise RecordError(f"{path}: {held} attached to it; a certificate's PDF has one")
    return found[0]


def _xml_files(reader: Any) -> list[bytes]:
    return [
        bytes(data)
        for name, versions in reader.attachments.items()
        if name.lower().endswith(".xml")
        for data in versions
    ]
