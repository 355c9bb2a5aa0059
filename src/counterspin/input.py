"""Reading of regular files, and parsing of JSON."""

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

#: Largest size of a document (campaign, plan, result, certificate), in bytes.
MAX_DOCUMENT_BYTES: Final = 200_000_000

#: Largest number of digits of an integer in JSON; the largest floating-point number has 309.
_MAX_DIGITS: Final = 400

#: Largest number of characters of an argument quoted in an error message.
_MAX_QUOTED_CHARACTERS: Final = 60


def to_path(value: object, expected: str) -> Path:
    """Return an argument as a path; TypeError, naming the expected argument, for other types."""
    if not isinstance(value, str | os.PathLike):
        raise TypeError(f"give {expected}, as text or a path, not {describe_argument(value)}")
    return Path(value)


def describe_argument(value: object) -> str:
    """Return an argument with its type; only the type if the argument is long."""
    text, type_name = repr(value), type(value).__name__
    is_short = len(text) <= _MAX_QUOTED_CHARACTERS and "\n" not in text
    return f"{text} ({type_name})" if is_short else f"an object of type {type_name}"


#: Tests of the mode of special files, and their names.
_SPECIAL_FILES: Final = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISCHR, "a device"),
)


#: First bytes of files, and their types.
_SIGNATURES: Final = (
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

#: Length of the longest escape sequence in JSON.
_ESCAPE_LENGTH: Final = len(r"\u0000")

#: Words, and parts of numbers, that the parser does not accept if they are cut.
_VALUE_PARTS: Final = ("true", "false", "null", "-", ".", "e+", "e-", "E+", "E-")

#: Start of a message of the JSON parser -> message in plain words.
_JSON_ERRORS: Final = (
    ("Expecting ','", "a comma or a closing bracket is missing"),
    ("Expecting ':'", "a colon is missing after the key"),
    ("Expecting property name", "a key in double quotation marks is missing"),
    ("Expecting value", "a value is missing, or is not a valid value"),
    ("Illegal trailing comma", "a comma precedes a closing bracket; remove the comma"),
    ("Invalid control character", "a text contains a line break or another control character"),
    ("Invalid \\", "a text contains an invalid escape sequence after a backslash"),
    ("Extra data", "the document ends here, but more text follows"),
)


@frozen
class FileIdentity:
    """Location of a file on its disk, its size in bytes, and its modification time in ns."""

    device: int
    inode: int
    size: int
    modified_ns: int

    @classmethod
    def from_file(cls, file: int | Path) -> FileIdentity:
        """Return the identity of an open file (its descriptor) or of the file now at a path."""
        status = os.stat(file)  # noqa: PTH116 - a descriptor or a path
        return cls(status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns)


def open_file(path: Path) -> FileIO:
    """Open a regular file to read its bytes, unbuffered."""
    try:
        require_regular_file(path, path.stat().st_mode)
    except ValueError as error:
        raise OSError(errno.EINVAL, "this is not a valid file name", str(path)) from error
    file = FileIO(path, opener=_open_nonblocking)
    try:
        # The file may have been replaced since.
        require_regular_file(path, os.fstat(file.fileno()).st_mode)
    except OSError:
        file.close()
        raise
    return file


def read_file(path: Path, max_bytes: int = MAX_DOCUMENT_BYTES) -> bytes:
    """Return the content of a regular file; OSError as in `open_file`, or if it is too large."""
    with open_file(path) as file:
        chunks = []
        n_remaining_bytes = max_bytes
        while chunk := file.read(min(n_remaining_bytes + 1, 1 << 20)):
            chunks.append(chunk)
            n_remaining_bytes -= len(chunk)
            if n_remaining_bytes < 0:
                raise OSError(errno.EFBIG, f"the file has more than {max_bytes} bytes", str(path))
    return b"".join(chunks)


def parse_json(text: str | bytes) -> Any:
    """Return the document in a JSON text; ValueError if it is not JSON.

    Texts that programs may read differently are rejected, too: duplicate keys, NaN, infinity,
    integers with too many digits, and nesting too deep for the parser.
    """
    try:
        return json.loads(
            text,
            parse_int=_parse_integer,
            parse_constant=_reject_constant,
            object_pairs_hook=_build_object,
        )
    except RecursionError as error:
        raise ValueError("the document is nested too deeply") from error
    except json.JSONDecodeError as error:
        raise ValueError(_describe_json_error(error)) from error


def _describe_json_error(error: json.JSONDecodeError) -> str:
    """Return the message of a syntax error, with line and column."""
    text, remaining_text = error.doc.rstrip(), error.doc[error.pos :].strip()
    is_cut = (
        not remaining_text
        or error.msg.startswith("Unterminated string")
        or any(word.startswith(remaining_text) for word in _VALUE_PARTS)
        or (error.msg.startswith("Invalid \\") and len(remaining_text) < _ESCAPE_LENGTH)
    )
    if is_cut:
        line, column = text.count("\n") + 1, len(text) - text.rfind("\n") - 1
        return f"the end of the file is missing: it ends at line {line}, column {column}"
    messages = (message for start, message in _JSON_ERRORS if error.msg.startswith(start))
    message = next(messages, "invalid syntax")
    return f"line {error.lineno}, column {error.colno}: {message}"


def _parse_integer(digits: str) -> int:
    if len(digits) > _MAX_DIGITS:
        raise ValueError(f"a number has {len(digits)} digits; at most {_MAX_DIGITS} are allowed")
    return int(digits)


def _build_object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a JSON object; ValueError if a key occurs twice."""
    document = dict(pairs)
    if len(document) < len(pairs):
        duplicate_key = Counter(key for key, _ in pairs).most_common(1)[0][0]
        raise ValueError(f"the key {duplicate_key!r} occurs twice in one object")
    return document


def _reject_constant(constant: str) -> None:
    raise ValueError(f"{constant} is not a valid number in JSON")


def detect_file_type(content: bytes) -> str:
    """Return the apparent type of a file, for a message; empty if it is unknown."""
    text = content[:1000].removeprefix(b"\xef\xbb\xbf").lstrip()
    if not text:
        return "an empty file"
    file_types = (file_type for signature, file_type in _SIGNATURES if text.startswith(signature))
    return next(file_types, "")


def require_regular_file(path: Path, mode: int) -> None:
    """Raise the OSError of `open_file` unless a mode (`st_mode`) is that of a regular file."""
    if stat.S_ISREG(mode):
        return
    description = next(
        (name for is_type, name in _SPECIAL_FILES if is_type(mode)), "not a regular file"
    )
    error_number = errno.EISDIR if stat.S_ISDIR(mode) else errno.EINVAL
    raise OSError(error_number, f"this is {description}, not a file", str(path))


def _open_nonblocking(path: str, flags: int) -> int:
    # Opening a pipe would block until another process writes to it.
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0))
