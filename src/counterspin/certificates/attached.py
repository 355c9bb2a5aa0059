"""A certificate's file: its XML, which a PDF carries (PDF/A-3, ISO 19005-3), and its pages."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, Final

from counterspin.certificates.pdf_signature import PagesSignature, pages_signature
from counterspin.errors import REASON_LENGTH, CounterspinError, RecordError, installing
from counterspin.input import read_file
from counterspin.records.isolation import in_reader_process

_PYPDF_MISSING: Final = (
    f"reading a PDF needs the package pypdf, which is not installed: {installing('signature')}"
)


def is_pdf(path: Path) -> bool:
    """Return whether a certificate's file is for people, by the ending of its name."""
    return path.suffix.lower() == ".pdf"


def read_document(path: Path) -> bytes:
    """Return the XML of a certificate: the file, or what is attached to a PDF.

    A PDF is read where it can do no harm, as records of native formats are.
    """
    if is_pdf(path):
        return in_reader_process(_attached, path)
    return _content(path)


def verify_pages(path: Path, public: bytes) -> PagesSignature:
    """Return what the signature of a PDF's pages is worth, as `pages_signature` does."""
    return in_reader_process(_pages_signature, path, public)


def _content(path: Path) -> bytes:
    try:
        return read_file(path)
    except OSError as error:
        raise RecordError(
            f"{path}: cannot be read ({error.strerror}); give the XML or PDF of a certificate"
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
        raise _damaged(path, error) from error
    if len(found) != 1:
        held = "no XML file is" if not found else f"{len(found)} XML files are"
        raise RecordError(f"{path}: {held} attached to it; the PDF of a certificate has one")
    return found[0]


def _pages_signature(path: Path, public: bytes) -> PagesSignature:
    content = _content(path)
    try:
        return pages_signature(content, public)
    except (CounterspinError, MemoryError):
        raise
    except Exception as error:  # whatever pyHanko raises on a damaged file
        raise _damaged(path, error) from error


def _damaged(path: Path, error: Exception) -> RecordError:
    reason = str(error)[:REASON_LENGTH] or type(error).__name__
    return RecordError(f"{path}: is not a PDF, or is damaged ({reason})")


def _xml_files(reader: Any) -> list[bytes]:
    return [
        bytes(data)
        for name, versions in reader.attachments.items()
        if name.lower().endswith(".xml")
        for data in versions
    ]
