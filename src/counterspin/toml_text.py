"""A document as TOML text, for the campaigns that a plan or a simulation writes."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from typing import Any

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


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
