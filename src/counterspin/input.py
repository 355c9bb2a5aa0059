"""Files that are read: ordinary files, under the very name that is given, and JSON in them."""

from __future__ import annotations

import errno
import json
import os
import stat
from collections import Counter
from io import FileIO
from pathlib import Path
from typing import Any, Final

from counterspin.frozen import frozen

#: No document (campaign, plan, result, certificate) has more bytes.
DOCUMENT_BYTES: Final = 200_000_000

#: Most digits of an integer in JSON; the largest floating-point number has 309.
_MOST_DIGITS: Final = 400

#: Most characters of an argument that an error message repeats.
_MOST_CHARACTERS: Final = 60


def path_of(value: object, wanted: str) -> Path:
    """Return an argument as a path; TypeError with what is wanted for any other type."""
    if not isinstance(value, str | os.PathLike):
        raise TypeError(f"give {wanted}, as text or a path, not {describe_argument(value)}")
    return Path(value)


def describe_argument(value: object) -> str:
    """Return an argument with its type; only the type where the argument is long."""
    text, kind = repr(value), type(value).__name__
    is_short = len(text) <= _MOST_CHARACTERS and "\n" not in text
    return f"{text} ({kind})" if is_short else f"an object of type {kind}"


#: What is no file -> what it is.
_KINDS: Final = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISCHR, "a device"),
)


#: How files of some kinds begin, and what they are.
_BEGINNINGS: Final = (
    (b"\x89PNG", "an image (PNG)"),
    (b"\xff\xd8\xff", "an image (JPEG)"),
    (b"%PDF", "a PDF"),
    (b"PK\x03\x04", "an Excel workbook, or a ZIP archive"),
    (b"PAR1", "a Parquet file"),
    (b"\x89HDF", "an HDF5 file"),
    (b"TDSm", "a TDMS file"),
    (b"MATLAB", "a MATLAB file"),
    (b"<", "XML or HTML"),
    (b"{", "JSON"),
)


@frozen
class FileIdentity:
    """A file's place on its disk, its size in bytes, and when it was last written, in ns."""

    device: int
    inode: int
    size: int
    modified: int

    @classmethod
    def of(cls, file: int | Path) -> FileIdentity:
        """Return the identity of an open file (its number) or of the one at a path now."""
        status = os.stat(file)  # noqa: PTH116 - of a number or a path
        return cls(status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns)


def open_file(path: Path) -> FileIO:
    """Open an ordinary file to read its bytes, unbuffered."""
    try:
        require_file(path, path.stat().st_mode)
    except ValueError as error:
        raise OSError(errno.EINVAL, "this is not a valid file name", str(path)) from error
    file = FileIO(path, opener=_without_waiting)
    try:
        # What stands there may have been exchanged since.
        require_file(path, os.fstat(file.fileno()).st_mode)
    except OSError:
        file.close()
        raise
    return file


def read_file(path: Path, most: int = DOCUMENT_BYTES) -> bytes:
    """Return the content of an ordinary file; OSError as in `open_file`, or if there is more."""
    with open_file(path) as file:
        parts = []
        left = most
        while part := file.read(min(left + 1, 1 << 20)):
            parts.append(part)
            left -= len(part)
            if left < 0:
                raise OSError(errno.EFBIG, f"the file has more than {most} bytes", str(path))
    return b"".join(parts)


def parse_json(text: str | bytes) -> Any:
    """Return the document in a JSON text; ValueError if programs may read it differently.

    Refused are a key that occurs twice in one object, NaN and infinity, integers of many digits,
    and a nesting that is too deep for the parser.
    """
    try:
        return json.loads(
            text,
            parse_int=_integer,
            parse_constant=_refuse_constant,
            object_pairs_hook=_unique_keys,
        )
    except RecursionError as error:
        raise ValueError("the document is nested too deeply") from error


def _integer(digits: str) -> int:
    if len(digits) > _MOST_DIGITS:
        raise ValueError(f"a number has {len(digits)} digits; at most {_MOST_DIGITS} are allowed")
    return int(digits)


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a JSON object; ValueError if a key occurs twice."""
    document = dict(pairs)
    if len(document) < len(pairs):
        twice = Counter(key for key, _ in pairs).most_common(1)[0][0]
        raise ValueError(f"the key {twice!r} occurs twice in one object")
    return document


def _refuse_constant(word: str) -> None:
    raise ValueError(f"{word} is not a valid number in JSON")


def detect_file_type(content: bytes) -> str:
    """Return the apparent type of a file, for a message; empty if it is unknown."""
    text = content[:1000].removeprefix(b"\xef\xbb\xbf").lstrip()
    if not text:
        return "an empty file"
    words = (words for beginning, words in _BEGINNINGS if text.startswith(beginning))
    return next(words, "")


def require_file(path: Path, mode: int) -> None:
    """Raise the OSError of `open_file` if something of this mode (`st_mode`) is no file."""
    if stat.S_ISREG(mode):
        return
    kind = next((words for is_kind, words in _KINDS if is_kind(mode)), "not a regular file")
    code = errno.EISDIR if stat.S_ISDIR(mode) else errno.EINVAL
    raise OSError(code, f"this is {kind}, not a file", str(path))


def _without_waiting(path: str, flags: int) -> int:
    # A pipe would be waited for until somebody writes to it.
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0))
