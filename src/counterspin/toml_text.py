"""TOML text, parsed with bounded time and memory, and written from documents."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from typing import Any, Final

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")

#: Largest number of parts of a key. The parser's memory grows with the square of this number.
_MAX_KEY_PARTS: Final = 16
#: Largest nesting depth. Parsers and readers recurse once per level.
_MAX_DEPTH: Final = 32
#: Largest number of keys and values; 10,000 runs need half as many.
_MAX_ENTRIES: Final = 500_000

#: Strings and comments, in which dots and brackets have no meaning. An unterminated string is
#: skipped up to the end of its line, or of the text, so that no part is scanned twice.
_STRING_OR_COMMENT: Final = "|".join(
    (
        r'"""(?:[^"\\]|\\.|"(?!""))*+(?:"{3,5})?',
        r"'''(?:[^']|'(?!''))*+(?:'{3,5})?",
        r'"(?:[^"\\\n]|\\[^\n])*+"?',
        r"'[^'\n]*+'?",
        r"#[^\n]*+",
    )
)
_TOKEN: Final = re.compile(rf"(?:{_STRING_OR_COMMENT})|(?P<mark>[.\n=,\[\]{{}}])", re.DOTALL)


class NestingError(ValueError):
    """A TOML text has a key with too many parts, or is nested too deeply.

    Attributes
    ----------
    line
        Line of the first such key or value, from 1; None if it is known only after parsing.
    """

    def __init__(self, problem: str, line: int | None = None) -> None:
        super().__init__(problem)
        self.line = line


def parse_toml(text: str) -> dict[str, Any]:
    """Parse a TOML text; counterspin reads all TOML with this function.

    Raises
    ------
    NestingError
        If the text has too many keys, or is nested too deeply.
    ValueError
        If the text is not TOML (`tomllib.TOMLDecodeError`).
    """
    import tomllib

    check_nesting(text)
    document = tomllib.loads(text)
    _check_depth(document)
    return document


def check_nesting(text: str) -> None:
    """Raise NestingError unless a TOML text can be parsed in bounded time and memory."""
    depth, n_dots, n_entries = 0, 0, 0
    for token in _TOKEN.finditer(text):
        delimiter = token["mark"]
        if delimiter == ".":
            n_dots += 1
        elif delimiter is not None:
            n_dots = 0
            depth += (delimiter in "[{") - (delimiter in "]}")
        n_entries += delimiter is not None and delimiter in ".=,[{"
        problem = (
            (n_dots >= _MAX_KEY_PARTS and f"a key has more than {_MAX_KEY_PARTS} parts")
            or (depth > _MAX_DEPTH and _TOO_DEEP_MESSAGE)
            or (n_entries > _MAX_ENTRIES and f"there are more than {_MAX_ENTRIES} keys and values")
        )
        if problem:
            raise NestingError(problem, text.count("\n", 0, token.start()) + 1)


_TOO_DEEP_MESSAGE: Final = f"is nested too deeply: at most {_MAX_DEPTH} levels are allowed"


def _check_depth(value: Any, depth: int = 0) -> None:
    """Raise NestingError if a parsed document is nested too deeply."""
    if not isinstance(value, dict | list):
        return
    if depth > _MAX_DEPTH:
        raise NestingError(_TOO_DEEP_MESSAGE)
    for item in value.values() if isinstance(value, dict) else value:
        _check_depth(item, depth + 1)


def format_document(document: Mapping[str, Any], comments: Mapping[str, str] | None = None) -> str:
    """Return a document as TOML."""
    lines: list[str] = []
    scalars = {key: value for key, value in document.items() if not _is_section(value)}
    lines += [f"{_format_key(key)} = {format_value(value)}" for key, value in scalars.items()]
    for key, value in document.items():
        if not _is_section(value):
            continue
        if comments and key in comments:
            lines += ["", f"# {comments[key]}"]
        if isinstance(value, Mapping):
            lines += _format_table((key,), value)
        else:
            for entry in value:
                lines += ["", f"[[{_format_key(key)}]]", *_format_entries(entry)]
    return "\n".join(lines) + "\n"


def _is_section(value: Any) -> bool:
    is_table_list = (
        isinstance(value, list)
        and bool(value)
        and all(isinstance(entry, Mapping) for entry in value)
    )
    return isinstance(value, Mapping) or is_table_list


def _format_table(path: tuple[str, ...], table: Mapping[str, Any]) -> Iterator[str]:
    """Yield the lines of a table; nested tables that contain tables get their own headings."""
    nested_tables = {
        key: value
        for key, value in table.items()
        if isinstance(value, Mapping) and len(path) == 1 and path[0] in ("accelerometers", "truth")
    } | {key: value for key, value in table.items() if path == ("model",) and _is_section(value)}
    own_entries = {key: value for key, value in table.items() if key not in nested_tables}
    if own_entries or not nested_tables:
        yield from ["", f"[{'.'.join(map(_format_key, path))}]", *_format_entries(own_entries)]
    for key, value in nested_tables.items():
        yield from _format_table((*path, key), value)


def _format_entries(table: Mapping[str, Any]) -> list[str]:
    return [f"{_format_key(key)} = {format_value(value)}" for key, value in table.items()]


def _format_key(key: str) -> str:
    return key if _BARE_KEY.fullmatch(key) else _quote_text(key)


def format_value(value: Any) -> str:
    """Return a value as TOML, in one line."""
    if isinstance(value, str):
        return _quote_text(value)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, Mapping):
        entries = ", ".join(
            f"{_format_key(key)} = {format_value(entry)}" for key, entry in value.items()
        )
        return f"{{ {entries} }}" if entries else "{}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(format_value, value))}]"
    if isinstance(value, int | float):
        return repr(value)
    return str(value)  # TOML dates and times have the same format


def _quote_text(text: str) -> str:
    # TOML has the escapes of JSON, if characters outside the basic plane are not escaped.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
