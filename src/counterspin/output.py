"""Files that appear whole or not at all, and take no other file's place.

- `FileKind`: what a command writes, and how its own work is known again
- `reserve`: refuse to write where a file would be lost
- `holds`: a test of files for a mark
- `write_whole`: one file
- `write_text`: one file of text; `write_open`: one that is opened first
- `make_folder`: where they go
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO, Final

from counterspin.errors import CounterspinError
from counterspin.frozen import frozen

#: How much of either end of a file is searched for a mark.
_END_BYTES: Final = 1 << 18


@frozen
class FileKind:
    """A kind of file that a command writes.

    Attributes
    ----------
    words
        What a message calls it, with its article.
    recognises
        Whether a file is of this kind.
    """

    words: str
    recognises: Callable[[Path], bool]


def reserve(path: Path, kind: Callable[[], FileKind], *, overwrite: bool = False) -> None:
    """Refuse a place for an output where a file would be lost, before any work is done.

    What is there is replaced only if it is of the same kind and `overwrite` asks for it: so no
    input, campaign, record or other command's result can be lost to a slip. A device or a pipe
    is no file, and takes what comes.

    Parameters
    ----------
    path
        The output.
    kind
        Returns what it will be; not called if nothing is there.
    overwrite
        Whether an earlier one of the same kind may be replaced.

    Raises
    ------
    CounterspinError
        If a file is in the way, or there is no such folder.
    """
    place = path.resolve()
    if not place.exists():
        if not place.parent.is_dir():
            raise CounterspinError(f"{path}: cannot be written: there is no folder {path.parent}")
        return
    if place.is_dir():
        raise CounterspinError(_refusal(path, IsADirectoryError()))
    if not place.is_file():
        return
    expected = kind()
    try:
        same = expected.recognises(place)
    except OSError:
        same = False
    if not same:
        raise CounterspinError(
            f"{path} exists and is not {expected.words}; it is not replaced: name another file"
        )
    if not overwrite:
        raise CounterspinError(f"{path} exists; name another file, or give `overwrite=True`")


def holds(mark: bytes) -> Callable[[Path], bool]:
    """Return a test of files: whether these bytes are among the first or last 256 KiB."""

    def test(path: Path) -> bool:
        with path.open("rb") as file:
            head = file.read(_END_BYTES)
            file.seek(max(file.seek(0, os.SEEK_END) - _END_BYTES, 0))
            return mark in head or mark in file.read()

    return test


def make_folder(folder: Path) -> None:
    """Make a folder, and those above it, where it is not there; CounterspinError if it cannot."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        if isinstance(error, FileExistsError):
            raise CounterspinError(f"{folder} is a file, not a folder; name a folder") from error
        raise CounterspinError(
            f"{folder}: cannot be made ({error.strerror}); choose another place"
        ) from error


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file under a temporary name beside its place, then move it there.

    A link keeps standing, and what it leads to is replaced; a device or a pipe such as
    ``/dev/stdout`` is written to.

    Parameters
    ----------
    path
        Where the file is to be; its folder must exist.
    write
        Writes the file under the name it is given, which has the same ending.

    Raises
    ------
    CounterspinError
        If the file cannot be written; nothing is left behind then.
    """
    place = path.resolve()
    stream = place.exists() and not (place.is_file() or place.is_dir())
    try:
        handle, name = tempfile.mkstemp(
            suffix=path.suffix, prefix=".", dir=None if stream else place.parent
        )
    except OSError as error:
        raise CounterspinError(_refusal(path, error)) from error
    os.close(handle)
    part = Path(name)
    try:
        write(part)
        if stream:
            place.write_bytes(part.read_bytes())
            return
        # mkstemp makes files for the owner only; a result is an ordinary file.
        mask = os.umask(0)
        os.umask(mask)
        part.chmod(0o666 & ~mask)
        part.replace(place)
    except OSError as error:
        raise CounterspinError(_refusal(path, error)) from error
    finally:
        part.unlink(missing_ok=True)


def write_open(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Write a file that is opened here: polars knows no name that is not UTF-8."""
    with path.open("wb") as file:
        write(file)


def write_text(path: Path, text: str) -> None:
    """Write text as UTF-8, whole or not at all; raises as `write_whole` does."""
    write_whole(path, lambda part: part.write_text(text, encoding="utf-8"))


def _refusal(path: Path, error: OSError) -> str:
    if path.is_dir():
        return f"{path}: cannot be written, being a folder; give the name of a file"
    reason = error.strerror or str(error)
    return f"{path}: cannot be written ({reason}); choose another place or free this one"
