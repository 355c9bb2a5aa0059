"""The laboratory's logo: a PNG or SVG file that is embedded in the pages."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Final

from lxml import etree

from counterspin.certificates.schema import parser
from counterspin.errors import InputError, describe_read_error, read_error_code
from counterspin.input import read_file
from counterspin.reports.pdf import is_image

#: Largest size of a logo's file, in bytes.
MAX_BYTES: Final = 1_000_000

_PNG: Final = b"\x89PNG\r\n\x1a\n"
_SVG: Final = "{http://www.w3.org/2000/svg}"

#: Elements that run code or load other files.
_REFUSED: Final = frozenset({"script", "foreignObject", "image", "feImage", "use"})
#: A reference to another file in a style.
_OTHER_FILE: Final = re.compile(r"@import|url\(\s*['\"]?(?!#)", re.IGNORECASE)


def read_logo(folder: Path, name: str) -> bytes:
    """Return the content of a logo's file; ValueError if it cannot be used.

    folder: That of the laboratory's file.
    """
    try:
        data = read_file(folder / name, MAX_BYTES)
    except OSError as error:
        raise InputError(f"{name}: {describe_read_error(error)}", read_error_code(error)) from error
    if not data.startswith(_PNG):
        _check_svg(name, data)
    if not is_image(data):
        raise ValueError(f"{name} is damaged, or it is not an image that can be placed on a page")
    return data


def _check_svg(name: str, data: bytes) -> None:
    """Raise ValueError unless data are an SVG image without code and references to other files."""
    try:
        root = etree.fromstring(data, parser())
    except etree.LxmlError:
        root = None
    if root is None or root.tag != f"{_SVG}svg":
        raise ValueError(f"{name} is neither a PNG nor an SVG image")
    if root.getroottree().docinfo.doctype:
        raise ValueError(f"{name} has a document type declaration; save it as plain SVG")
    for element in root.iter():
        if problem := _problem(element):
            raise ValueError(
                f"{name} has {problem}; save the logo as plain SVG, with text as paths"
            )


def _problem(element: Any) -> str:
    """Return the forbidden content of an element of a logo; empty if it has none."""
    if not isinstance(element.tag, str):
        return "" if isinstance(element, etree._Comment) else "a processing instruction"
    tag = etree.QName(element).localname
    if tag in _REFUSED:
        return f"an element <{tag}>"
    for key, value in element.attrib.items():
        attribute = etree.QName(key).localname
        if attribute.startswith("on"):
            return f"an attribute {attribute}"
        if attribute == "href" and not value.startswith("#"):
            return "a link to another file"
        if _OTHER_FILE.search(value):
            return "a reference to another file"
    return "a reference to another file" if _OTHER_FILE.search(element.text or "") else ""
