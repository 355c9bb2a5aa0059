"""The lines of a TOML file in which its keys stand, for messages."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from counterspin.campaign.checking import key_path

_PART: Final = r"""(?:[\w-]+|"[^"\n]*"|'[^'\n]*')"""
_KEY: Final = re.compile(rf"\s*({_PART}(?:\s*\.\s*{_PART})*)\s*=")
_HEADER: Final = re.compile(rf"\s*\[(\[?)\s*({_PART}(?:\s*\.\s*{_PART})*)\s*\]\]?\s*(?:#.*)?")
#: Texts and a comment, in which brackets are no brackets.
_TEXTS: Final = re.compile(r"""\"(?:[^"\\]|\\.)*\"|'[^']*'|#.*""")
#: The key with which a message begins, and the last part of a key.
_OF_MESSAGE: Final = re.compile(rf"({_PART}(?:\.{_PART}|\[\d+\])*): ")
_LAST: Final = re.compile(r"(?:\.[\w-]+|\[\d+\])$")


def lines_of_messages(messages: Sequence[str], file: Path) -> list[int | None]:
    """Return the line of a document's file to which each message refers, from 1.

    Of a key that is missing it is that of its table; None where a message names no key that is
    there, or the file cannot be read.
    """
    try:
        found = lines_of(file.read_text("utf-8-sig"))
    except (OSError, ValueError):
        found = {}
    return [_line_of(message, found) for message in messages]


def _line_of(message: str, found: dict[str, int]) -> int | None:
    named = _OF_MESSAGE.match(message)
    key = named[1] if named else ""
    while key and key.replace('"', "") not in found:
        # What stands in quotation marks may be the row of another file.
        shorter = _LAST.sub("", key)
        key = shorter if shorter != key else ""
    return found.get(key.replace('"', ""))


def lines_of(text: str) -> dict[str, int]:
    """Return key -> line, of a document in TOML; keys as messages write them, unquoted."""
    found: dict[str, int] = {}
    counts: dict[tuple[str | int, ...], int] = {}
    table: tuple[str | int, ...] = ()
    depth, quotes = 0, ""
    for number, line in enumerate(text.splitlines(), 1):
        if quotes:  # within a text of several lines
            quotes = "" if line.count(quotes) % 2 else quotes
            continue
        header = _HEADER.fullmatch(line) if depth == 0 else None
        if header is not None:
            table = _opened(header, counts)
            found.setdefault(_plain(table), number)
            continue
        key = _KEY.match(line) if depth == 0 else None
        if key is not None:
            path = table
            for part in _parts(key[1]):
                path = (*path, part)
                found.setdefault(_plain(path), number)
        quotes = next((q for q in ('"""', "'''") if line.count(q) % 2), "")
        brackets = _TEXTS.sub("", line[key.end() :] if key else line)
        depth += sum(map(brackets.count, "[{")) - sum(map(brackets.count, "]}"))
    return found


def _opened(
    header: re.Match[str], counts: dict[tuple[str | int, ...], int]
) -> tuple[str | int, ...]:
    """Return the table that a header opens, counting those of each list of tables."""
    path: tuple[str | int, ...] = ()
    *outer, last = _parts(header[2])
    for part in outer:
        path = (*path, part)
        path = (*path, counts[path]) if path in counts else path
    path = (*path, last)
    if header[1]:
        counts[path] = counts.get(path, -1) + 1
    return (*path, counts[path]) if path in counts else path


def _parts(key: str) -> list[str]:
    return [part.strip("\"'") for part in re.findall(_PART, key)]


def _plain(path: tuple[str | int, ...]) -> str:
    return key_path(path).replace('"', "")
