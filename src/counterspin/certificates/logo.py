"""Logo of the laboratory: a PNG or SVG file that is embedded in the pages."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Final

from lxml import etree

from counterspin.certificates.schema import make_parser
from counterspin.errors import InputError, describe_read_error, read_error_code
from counterspin.input import read_file
from counterspin.reports.pdf import is_image

#: Maximum size of a logo file, bytes.
MAX_LOGO_BYTES: Final = 1_000_000

_PNG_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"
_SVG_NAMESPACE: Final = "{http://www.w3.org/2000/svg}"

#: Elements that run code or load other files.
_FORBIDDEN_TAGS: Final = frozenset({"script", "foreignObject", "image", "feImage", "use"})
#: A reference to another file in a style.
_FILE_REFERENCE: Final = re.compile(r"@import|url\(\s*['\"]?(?!#)", re.IGNORECASE)


def read_logo(folder: Path, name: str) -> bytes:
    """Read a logo; ValueError if it cannot be used.

    folder: Folder of the laboratory file.
    """
    try:
        content = read_file(folder / name, MAX_LOGO_BYTES)
    except OSError as error:
        raise InputError(f"{name}: {describe_read_error(error)}", read_error_code(error)) from error
    if not content.startswith(_PNG_SIGNATURE):
        _check_svg(name, content)
    if not is_image(content):
        raise ValueError(f"{name} is damaged, or it is not an image that can be placed on a page")
    return content


def _check_svg(name: str, content: bytes) -> None:
    """Raise ValueError unless content is an SVG image without code and file references."""
    try:
        root = etree.fromstring(content, make_parser())
    except etree.LxmlError:
        root = None
    if root is None or root.tag != f"{_SVG_NAMESPACE}svg":
        raise ValueError(f"{name} is neither a PNG nor an SVG image")
    if root.getroottree().docinfo.doctype:
        raise ValueError(f"{name} has a document type declaration; save it as plain SVG")
    for element in root.iter():
        if problem := _forbidden_content(element):
            raise ValueError(
                f"{name} has {problem}; save the logo as plain SVG, with text as paths"
            )


def _forbidden_content(element: Any) -> str:
    """Return the forbidden content of an SVG element, or an empty text."""
    if not isinstance(element.tag, str):
        return "" if isinstance(element, etree._Comment) else "a processing instruction"
    tag = etree.QName(element).localname
    if tag in _FORBIDDEN_TAGS:
        return f"an element <{tag}>"
    for key, value in element.attrib.items():
        attribute = etree.QName(key).localname
        if attribute.startswith("on"):
            return f"an attribute {attribute}"
        if attribute == "href" and not value.startswith("#"):
            return "a link to another file"
        if _FILE_REFERENCE.search(value):
            return "a reference to another file"
    return "a reference to another file" if _FILE_REFERENCE.search(element.text or "") else ""
