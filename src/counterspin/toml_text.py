"""TOML text, parsed with bounded time and memory, and written from documents."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from typing import Any, Final

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")

#: No key has more parts. The parser's memory grows with the square of their number.
_MOST_KEY_PARTS: Final = 16
#: No value lies deeper. Parsers and readers call themselves once for each level.
_MOST_LEVELS: Final = 32
#: No text has more keys and values; 10,000 runs need half as many.
_MOST_ITEMS: Final = 500_000

#: Strings and comments, whose dots and brackets have no meaning. A string without an end is
#: skipped up to the end of its line, or of the text, so that no part of a text is scanned twice.
_SKIPPED: Final = "|".join(
    (
        r'"""(?:[^"\\]|\\.|"(?!""))*+(?:"{3,5})?',
        r"'''(?:[^']|'(?!''))*+(?:'{3,5})?",
        r'"(?:[^"\\\n]|\\[^\n])*+"?',
        r"'[^'\n]*+'?",
        r"#[^\n]*+",
    )
)
_TOKEN: Final = re.compile(rf"(?:{_SKIPPED})|(?P<mark>[.\n=,\[\]{{}}])", re.DOTALL)


class NestingError(ValueError):
    """A TOML text has a key with too many parts, or is nested too deeply.

    Attributes
    ----------
    line
        The line of the first one, from 1; None if it is known only after parsing.
    """

    def __init__(self, problem: str, line: int | None = None) -> None:
        super().__init__(problem)
        self.line = line


def parse_toml(text: str) -> dict[str, Any]:
    """Return the document of a TOML text; every TOML that counterspin reads passes here.

    Raises
    ------
    NestingError
        If the keys or the nesting of the text are not those of a document.
    ValueError
        If the text is not TOML (`tomllib.TOMLDecodeError`).
    """
    import tomllib

    check_nesting(text)
    document = tomllib.loads(text)
    _check_levels(document)
    return document


def check_nesting(text: str) -> None:
    """Raise NestingError unless a TOML text can be parsed in bounded time and memory."""
    depth, dots, items = 0, 0, 0
    for token in _TOKEN.finditer(text):
        mark = token["mark"]
        if mark == ".":
            dots += 1
        elif mark is not None:
            dots = 0
            depth += (mark in "[{") - (mark in "]}")
        items += mark is not None and mark in ".=,[{"
        problem = (
            (dots >= _MOST_KEY_PARTS and f"a key has more than {_MOST_KEY_PARTS} parts")
            or (depth > _MOST_LEVELS and _TOO_DEEP)
            or (items > _MOST_ITEMS and f"there are more than {_MOST_ITEMS} keys and values")
        )
        if problem:
            raise NestingError(problem, text.count("\n", 0, token.start()) + 1)


_TOO_DEEP: Final = f"is nested too deeply: at most {_MOST_LEVELS} levels are allowed"


def _check_levels(value: Any, levels: int = 0) -> None:
    """Raise NestingError if tables or lists lie too deep in a parsed document."""
    if not isinstance(value, dict | list):
        return
    if levels > _MOST_LEVELS:
        raise NestingError(_TOO_DEEP)
    for item in value.values() if isinstance(value, dict) else value:
        _check_levels(item, levels + 1)


def write_document(document: Mapping[str, Any], comments: Mapping[str, str] | None = None) -> str:
    """Return a document as TOML."""
    lines: list[str] = []
    plain = {key: value for key, value in document.items() if not _is_section(value)}
    lines += [f"{_key(key)} = {write_value(value)}" for key, value in plain.items()]
    for key, value in document.items():
        if not _is_section(value):
            continue
        if comments and key in comments:
            lines += ["", f"# {comments[key]}"]
        if isinstance(value, Mapping):
            lines += _table((key,), value)
        else:
            for entry in value:
                lines += ["", f"[[{_key(key)}]]", *_entries(entry)]
    return "\n".join(lines) + "\n"


def _is_section(value: Any) -> bool:
    tables = isinstance(value, list) and bool(value) and all(isinstance(e, Mapping) for e in value)
    return isinstance(value, Mapping) or tables


def _table(path: tuple[str, ...], table: Mapping[str, Any]) -> Iterator[str]:
    """Yield a table; those inside it that hold tables themselves get headings of their own."""
    deeper = {
        key: value
        for key, value in table.items()
        if isinstance(value, Mapping) and len(path) == 1 and path[0] in ("accelerometers", "truth")
    } | {key: value for key, value in table.items() if path == ("model",) and _is_section(value)}
    own = {key: value for key, value in table.items() if key not in deeper}
    if own or not deeper:
        yield from ["", f"[{'.'.join(map(_key, path))}]", *_entries(own)]
    for key, value in deeper.items():
        yield from _table((*path, key), value)


def _entries(table: Mapping[str, Any]) -> list[str]:
    return [f"{_key(key)} = {write_value(value)}" for key, value in table.items()]


def _key(key: str) -> str:
    return key if _BARE_KEY.fullmatch(key) else _text(key)


def write_value(value: Any) -> str:
    """Return a value as it stands behind its key, in one line."""
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, Mapping):
        inside = ", ".join(f"{_key(key)} = {write_value(inner)}" for key, inner in value.items())
        return f"{{ {inside} }}" if inside else "{}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(write_value, value))}]"
    if isinstance(value, int | float):
        return repr(value)
    return str(value)  # dates and times write themselves as TOML does


def _text(text: str) -> str:
    # JSON's escapes are TOML's too, once characters beyond the first plane stay as they are.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
