"""Text, numbers and namespaces of a certificate's XML, and validation against the DCC schema.

The files that PTB publishes import each other by URL. Here an import is resolved to the file of the
folder that declares the namespace.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final
from urllib.parse import urljoin

from lxml import etree

from counterspin.characters import escape_controls
from counterspin.errors import CounterspinError, DamagedFileError, RecordError
from counterspin.input import detect_file_type

DCC: Final = "https://ptb.de/dcc"
SI: Final = "https://ptb.de/si"
NAMESPACES: Final = {"dcc": DCC, "si": SI}

#: Language of the text that counterspin writes.
ENGLISH: Final = "en"

Element = Any  # lxml has no type annotations


def clean_text(words: str) -> str:
    """Return text stripped, with control characters escaped (XML 1.0, 2.2)."""
    return escape_controls(words).strip()


def format_exact(value: float) -> str:
    """Format a number so that it reads back as the same double."""
    return repr(float(value))


def format_decimal(value: float) -> str:
    """Format a coverage factor or probability, which must not have an exponent."""
    return f"{value:.4f}".rstrip("0").rstrip(".")


_XS: Final = "{http://www.w3.org/2001/XMLSchema}"

#: Number of errors shown; further ones mostly follow from the first.
_MAX_ERRORS: Final = 5


def check_schema(document: bytes, schema: Path, source: str) -> None:
    """Validate a certificate."""
    faults = load_schema(schema)
    root = parse(document, source)
    if faults.validate(root):
        return
    log = list(faults.error_log)
    lines = [f"line {entry.line}: {_with_prefixes(entry.message)}" for entry in log[:_MAX_ERRORS]]
    remaining_count = f"\n  and {len(log) - _MAX_ERRORS} more" if len(log) > _MAX_ERRORS else ""
    raise RecordError(
        f"{source} does not conform to the schema in {schema}\n  "
        + "\n  ".join(lines)
        + remaining_count,
        code="wrong-document",
    )


def parse(document: bytes, source: str, *, comments: bool = False) -> Any:
    """Return the root of a document called `source`; RecordError if it is not XML.

    Comments are removed, because a signature does not cover them: a number with a comment in it
    reads the same whether signed or not. With `comments` they stay.
    """
    try:
        root = etree.fromstring(document, parser(remove_comments=not comments))
    except etree.LxmlError as error:
        seen = "" if document.lstrip()[:1] == b"<" else detect_file_type(document) or "other text"
        reason = f"it is {seen}" if seen else str(error)
        raise DamagedFileError(
            f"{source} is not XML, or it is damaged ({reason}); give the XML or PDF of a "
            "certificate"
        ) from error
    if root.getroottree().docinfo.doctype:
        # Entities could hide content, and no certificate needs them.
        raise RecordError(
            f"{source}: has a document type declaration, which is not allowed in a certificate",
            code="wrong-document",
        )
    return root


def parser(**options: Any) -> Any:
    """Return a parser that fetches nothing and replaces no entities."""
    return etree.XMLParser(no_network=True, resolve_entities=False, huge_tree=True, **options)


def load_schema(schema: Path) -> Any:
    """Return the schema, ready to validate; raises as `check_schema` does."""
    main = _main_file(schema)
    # The published files are in sibling folders: dcc/v3.3.0, dsi, qudt.
    folders = [schema] if schema.is_dir() else [main.parent, main.parent.parent]
    reader = parser()
    reader.resolvers.add(_LocalResolver(_import_locations(folders)))
    try:
        return etree.XMLSchema(etree.parse(str(main), reader))
    except (etree.LxmlError, OSError) as error:
        raise CounterspinError(
            f"{main} is not a schema, or the folder lacks files that it imports ({error}); "
            "download dcc.xsd, the D-SI schema, the QUDT schema and xmldsig-core-schema.xsd",
            code="wrong-document",
        ) from error


def _main_file(schema: Path) -> Path:
    if schema.is_file():
        return schema
    if not schema.is_dir():
        raise CounterspinError(f"{schema}: file not found", code="file-not-found")
    schemas = [path for path in _schema_files(schema) if _target_namespace(path) == DCC]
    if len(schemas) == 1:
        return schemas[0]
    description = "several DCC schemas; name one of them" if schemas else "no DCC schema (dcc.xsd)"
    raise CounterspinError(f"{schema}: contains {description}", code="wrong-document")


class _LocalResolver(etree.Resolver):  # type: ignore[misc]  # lxml has no type annotations
    """Resolves addresses to files of the folder; others resolve to nothing."""

    def __init__(self, places: dict[str, Path]) -> None:
        self._places = places

    def resolve(self, url: str, _public_id: str | None, context: Any) -> Any:
        place = self._places.get(url)
        if place is not None:
            return self.resolve_filename(str(place), context)
        if "://" in url and not url.startswith("file:"):
            return self.resolve_empty(context)
        return None


def _schema_files(folder: Path) -> list[Path]:
    # Opening a pipe of that name would block.
    return sorted(path for path in folder.rglob("*.xsd") if path.is_file())


def _import_locations(folders: list[Path]) -> dict[str, Path]:
    """Return URL -> file for all imports of the schemas in the folders."""
    paths = [path for folder in folders for path in _schema_files(folder)]
    by_space = {
        space: path for path in reversed(paths) if (space := _target_namespace(path)) is not None
    }
    places = {}
    for path in paths:
        for location, space in _declared_imports(path):
            if space in by_space:
                places[location] = by_space[space]
                places[urljoin(str(path), location)] = by_space[space]
    return places


def _target_namespace(path: Path) -> str | None:
    try:
        space: str | None = etree.parse(str(path), parser()).getroot().get("targetNamespace")
    except (etree.LxmlError, OSError):
        return None
    return space


def _declared_imports(path: Path) -> Iterator[tuple[str, str]]:
    try:
        root = etree.parse(str(path), parser()).getroot()
    except (etree.LxmlError, OSError):
        return
    for element in root.iter(f"{_XS}import"):
        location, space = element.get("schemaLocation"), element.get("namespace")
        if location and space:
            yield location, space


def _with_prefixes(message: str) -> str:
    """Return an error message with prefixes instead of namespaces."""
    for prefix, space in NAMESPACES.items():
        message = message.replace(f"{{{space}}}", f"{prefix}:")
    return re.sub(r"\s+", " ", message)
