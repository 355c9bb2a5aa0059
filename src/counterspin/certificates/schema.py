"""Text, numbers and namespaces of the XML of a certificate, and validation with the DCC schema.

The schema files of PTB import each other by URL. Here, an import is resolved to the local file that
declares the namespace.
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

DCC_NAMESPACE: Final = "https://ptb.de/dcc"
SI_NAMESPACE: Final = "https://ptb.de/si"
NAMESPACES: Final = {"dcc": DCC_NAMESPACE, "si": SI_NAMESPACE}

#: Language of the text that counterspin writes.
ENGLISH: Final = "en"

Element = Any  # lxml has no type annotations


def clean_text(text: str) -> str:
    """Return text stripped, with control characters escaped (XML 1.0, 2.2)."""
    return escape_controls(text).strip()


def format_exact(value: float) -> str:
    """Format a number so that it reads back as the same double."""
    return repr(float(value))


def format_decimal(value: float) -> str:
    """Format a coverage factor or probability, which must not have an exponent."""
    return f"{value:.4f}".rstrip("0").rstrip(".")


_XS_NAMESPACE: Final = "{http://www.w3.org/2001/XMLSchema}"

#: Maximum number of reported errors; further errors are usually consequences.
_MAX_ERRORS: Final = 5


def check_schema(document: bytes, schema: Path, source: str) -> None:
    """Validate a certificate; RecordError if it does not conform to the schema."""
    validator = load_schema(schema)
    root = parse_xml(document, source)
    if validator.validate(root):
        return
    errors = list(validator.error_log)
    lines = [
        f"line {error.line}: {_replace_namespaces(error.message)}" for error in errors[:_MAX_ERRORS]
    ]
    omitted_text = f"\n  and {len(errors) - _MAX_ERRORS} more" if len(errors) > _MAX_ERRORS else ""
    raise RecordError(
        f"{source} does not conform to the schema in {schema}\n  "
        + "\n  ".join(lines)
        + omitted_text,
        code="wrong-document",
    )


def parse_xml(document: bytes, source: str, *, keep_comments: bool = False) -> Any:
    """Parse a document named `source`; RecordError if it is not XML.

    Comments are removed, because a signature does not cover them.
    """
    try:
        root = etree.fromstring(document, make_parser(remove_comments=not keep_comments))
    except etree.LxmlError as error:
        file_type = (
            "" if document.lstrip()[:1] == b"<" else detect_file_type(document) or "other text"
        )
        reason = f"it is {file_type}" if file_type else str(error)
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


def make_parser(**options: Any) -> Any:
    """Return a parser without network access and entity replacement."""
    return etree.XMLParser(no_network=True, resolve_entities=False, huge_tree=True, **options)


def load_schema(schema: Path) -> Any:
    """Load a schema; CounterspinError if it is incomplete or not a schema."""
    main_file = _find_main_file(schema)
    # The published files are in sibling folders: dcc/v3.3.0, dsi, qudt.
    folders = [schema] if schema.is_dir() else [main_file.parent, main_file.parent.parent]
    parser = make_parser()
    parser.resolvers.add(_LocalResolver(_import_locations(folders)))
    try:
        return etree.XMLSchema(etree.parse(str(main_file), parser))
    except (etree.LxmlError, OSError) as error:
        raise CounterspinError(
            f"{main_file} is not a schema, or the folder lacks files that it imports ({error}); "
            "download dcc.xsd, the D-SI schema, the QUDT schema and xmldsig-core-schema.xsd",
            code="wrong-document",
        ) from error


def _find_main_file(schema: Path) -> Path:
    if schema.is_file():
        return schema
    if not schema.is_dir():
        raise CounterspinError(f"{schema}: file not found", code="file-not-found")
    dcc_files = [path for path in _schema_files(schema) if _target_namespace(path) == DCC_NAMESPACE]
    if len(dcc_files) == 1:
        return dcc_files[0]
    problem = "several DCC schemas; name one of them" if dcc_files else "no DCC schema (dcc.xsd)"
    raise CounterspinError(f"{schema}: contains {problem}", code="wrong-document")


class _LocalResolver(etree.Resolver):  # type: ignore[misc]  # lxml has no type annotations
    """Resolver of URLs to local files; other URLs resolve to nothing."""

    def __init__(self, path_by_url: dict[str, Path]) -> None:
        self._path_by_url = path_by_url

    def resolve(self, url: str, _public_id: str | None, context: Any) -> Any:
        path = self._path_by_url.get(url)
        if path is not None:
            return self.resolve_filename(str(path), context)
        if "://" in url and not url.startswith("file:"):
            return self.resolve_empty(context)
        return None


def _schema_files(folder: Path) -> list[Path]:
    # Opening a pipe would block.
    return sorted(path for path in folder.rglob("*.xsd") if path.is_file())


def _import_locations(folders: list[Path]) -> dict[str, Path]:
    """Return URL -> file for all imports of the schemas in the folders."""
    paths = [path for folder in folders for path in _schema_files(folder)]
    path_by_namespace = {
        namespace: path
        for path in reversed(paths)
        if (namespace := _target_namespace(path)) is not None
    }
    path_by_url = {}
    for path in paths:
        for location, namespace in _declared_imports(path):
            if namespace in path_by_namespace:
                path_by_url[location] = path_by_namespace[namespace]
                path_by_url[urljoin(str(path), location)] = path_by_namespace[namespace]
    return path_by_url


def _target_namespace(path: Path) -> str | None:
    try:
        namespace: str | None = (
            etree.parse(str(path), make_parser()).getroot().get("targetNamespace")
        )
    except (etree.LxmlError, OSError):
        return None
    return namespace


def _declared_imports(path: Path) -> Iterator[tuple[str, str]]:
    try:
        root = etree.parse(str(path), make_parser()).getroot()
    except (etree.LxmlError, OSError):
        return
    for element in root.iter(f"{_XS_NAMESPACE}import"):
        location, namespace = element.get("schemaLocation"), element.get("namespace")
        if location and namespace:
            yield location, namespace


def _replace_namespaces(message: str) -> str:
    """Replace namespaces by prefixes in an error message."""
    for prefix, namespace in NAMESPACES.items():
        message = message.replace(f"{{{namespace}}}", f"{prefix}:")
    return re.sub(r"\s+", " ", message)
