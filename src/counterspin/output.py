"""Files that appear whole or not at all, and take no other file's place."""

from __future__ import annotations

import os
import re
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO, Final

from counterspin.errors import CounterspinError, ExistingFileError, WriteError
from counterspin.frozen import frozen
from counterspin.input import open_file

#: How much of either end of a file is searched for a mark.
_END_BYTES: Final = 1 << 18

#: What `mark` puts into a file.
#: The apostrophe may be escaped as in HTML.
_MARK: Final = re.compile(rb"Made by counterspin: ((?:[a-z ']|&#39;)+)\.")

#: Names of devices on Windows, with any ending: ``NUL.json`` discards what is written.
_DEVICE: Final = re.compile(
    r"(?:CON|PRN|AUX|NUL|CONIN\$|CONOUT\$|(?:COM|LPT)[0-9¹²³]) *(?:\..*)?", re.I
)
#: Characters that no name of a file has on Windows; what follows a colon names a hidden stream.
_FORBIDDEN: Final = re.compile(r'[<>:"|?*\x00-\x1f]')
#: How often, and after which time in s, a file that another program has open is tried again.
_RENAME_ATTEMPTS: Final = 10
_RENAME_PAUSE: Final = 0.1


@frozen
class FileType:
    """A kind of file that a command writes."""

    words: str  #: What a message calls it, with its article.
    recognises: Callable[[Path], bool]  #: Whether a file is of this kind.


def reserve(
    path: Path, kind: Callable[[], FileType] | None = None, *, overwrite: bool = False
) -> None:
    """Refuse a place for an output where a file would be lost, before any work is done.

    What is there is replaced only if it is of the same kind and `overwrite` asks for it: so no
    input, campaign, record or other command's result can be lost to a slip. A device or a pipe
    is no file, and takes what comes.

    kind: Returns what it will be; not called if nothing is there. None: who asks knows what is
        there.
    overwrite: Whether an earlier one of the same kind may be replaced.
    """
    place = _place(path)
    try:
        if not place.exists():
            if not place.parent.is_dir():
                raise CounterspinError(
                    f"{path} cannot be written: the folder {path.parent} does not exist",
                    code="file-not-found",
                )
            return
    except OSError as error:
        raise WriteError(_refusal(path, error)) from error
    if place.is_dir():
        raise WriteError(_refusal(path, IsADirectoryError()))
    if not place.is_file():
        return
    if kind is not None:
        expected = kind()
        try:
            same = expected.recognises(place)
        except OSError:
            same = False
        if not same:
            raise ExistingFileError(
                f"{path} already exists and is not {expected.words}, so it was not overwritten; "
                "choose another file"
            )
    if not overwrite:
        advice = "" if kind is None else ", or set `overwrite=True`"
        raise ExistingFileError(f"{path} already exists; choose another file{advice}")


def mark(words: str) -> str:
    """Return the note that identifies the file in formats with a field for remarks."""
    return f"Made by counterspin: {words}."


def marked(words: str) -> FileType:
    """Return the kind of files that have this `mark` at either end, and none of another kind."""

    def recognises(path: Path) -> bool:
        # Words of a user may look like another mark: then nobody can tell.
        marks = {match[1] for end in _ends(path) for match in _MARK.finditer(end)}
        return {mark.replace(b"&#39;", b"'") for mark in marks} == {words.encode()}

    return FileType(f"{words} written by counterspin", recognises)


def holds(words: bytes) -> Callable[[Path], bool]:
    """Return a test of files: whether these bytes are among the first or last 256 KiB."""
    return lambda path: any(words in end for end in _ends(path))


def _ends(path: Path) -> tuple[bytes, bytes]:
    with open_file(path) as file:
        head = file.read(_END_BYTES)
        file.seek(max(file.seek(0, os.SEEK_END) - _END_BYTES, 0))
        return head, file.read()


def require_valid_name(path: Path) -> None:
    """Raise CounterspinError if Windows takes a name for a device or stores it under another name.

    Other systems have no such names.
    """
    if sys.platform != "win32":
        return
    for part in path.parts[1:] if path.anchor else path.parts:
        if _DEVICE.fullmatch(part):
            reason = f"{part} is the name of a device on Windows"
        elif found := _FORBIDDEN.search(part):
            reason = f"names must not contain {found[0]!r} on Windows"
        elif part[-1] in ". " and part not in (".", ".."):
            reason = "names must not end with a dot or a space on Windows"
        else:
            continue
        raise CounterspinError(
            f"{path} cannot be written: {reason}; choose another name", code="invalid-name"
        )


def make_folder(folder: Path) -> None:
    """Make a folder, and those above it, where it is not there; CounterspinError if it cannot."""
    require_valid_name(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        if isinstance(error, FileExistsError):
            raise ExistingFileError(f"{folder} is a file, not a folder; give a folder") from error
        raise WriteError(
            f"{folder} cannot be created ({error.strerror}); choose another location"
        ) from error


def write_whole(
    path: Path,
    write: Callable[[Path], object],
    kind: Callable[[], FileType] | None = None,
    *,
    overwrite: bool = False,
) -> None:
    """Write a file under a hidden name beside its place, then give it its own.

    A link keeps standing, and what it leads to is replaced; a device or a pipe such as
    ``/dev/stdout`` is written to.

    kind, overwrite: As in `reserve`: what may be replaced, also if it came while this was written.
    """
    reserve(path, kind, overwrite=overwrite)
    place = _place(path)
    if place.exists() and not place.is_file():
        _pour(path, write)
        return
    part = begin(path)
    try:
        write(part)
        finish(part, path, kind, overwrite=overwrite)
    except OSError as error:
        raise WriteError(_refusal(path, error)) from error
    finally:
        with suppress(OSError):  # on Windows another program may have it open
            part.unlink(missing_ok=True)


def write_open(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Write a file that is opened here: polars knows no name that is not UTF-8."""
    with path.open("wb") as file:
        write(file)


def write_text(
    path: Path,
    text: str,
    kind: Callable[[], FileType] | None = None,
    *,
    overwrite: bool = False,
) -> None:
    """Write text as UTF-8, whole or not at all; parameters and errors as in `write_whole`."""
    data = text.encode("utf-8")
    write_whole(path, lambda part: part.write_bytes(data), kind, overwrite=overwrite)


def begin(path: Path) -> Path:
    """Make a hidden, empty file beside the place of an output; CounterspinError if it cannot be."""
    part = _place(path).parent / f".{os.urandom(8).hex()}{path.suffix}"
    try:
        # The system takes the process's umask from these rights: a result is an ordinary file.
        os.close(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
    except OSError as error:
        raise WriteError(_refusal(path, error)) from error
    return part


def finish(
    part: Path,
    path: Path,
    kind: Callable[[], FileType] | None = None,
    *,
    overwrite: bool = False,
) -> None:
    """Give a finished file its name: in one step, so that no other writer's file is lost."""
    place = _place(path)
    while True:
        try:
            _take(part, place)
        except FileExistsError:
            reserve(path, kind, overwrite=overwrite)
            if not overwrite:
                continue  # what was in the way is gone
            _retry(lambda: part.replace(place))
        return


def _retry(rename: Callable[[], object]) -> None:
    """Rename a file; on Windows, wait for a virus scanner or indexer that has it open."""
    attempts = _RENAME_ATTEMPTS if sys.platform == "win32" else 1
    for attempt in range(attempts):
        try:
            rename()
        except PermissionError:
            if attempt == attempts - 1:
                raise
            time.sleep(_RENAME_PAUSE)
        else:
            return


def _take(part: Path, place: Path) -> None:
    """Give a file a name that nobody has; FileExistsError if somebody does."""
    if os.name == "nt":
        _retry(lambda: part.rename(place))  # which replaces nothing there
        return
    try:
        os.link(part, place)
    except FileExistsError:
        raise
    except OSError:
        # A file system without hard links, such as FAT: an empty file takes the name, and the
        # finished one its place. A kill between the two leaves the empty one.
        os.close(os.open(place, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
        try:
            part.replace(place)
        except OSError:
            place.unlink()
            raise
    else:
        part.unlink()


def _pour(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file elsewhere, and what is in it into a device or a pipe."""
    from counterspin.temporary_folders import temporary_folder

    try:
        with temporary_folder("counterspin-output-") as folder:
            part = folder / f"whole{path.suffix}"
            write(part)
            path.write_bytes(part.read_bytes())
    except OSError as error:
        raise WriteError(_refusal(path, error)) from error


def _place(path: Path) -> Path:
    """Return where a path leads, links and all; CounterspinError if that is nowhere."""
    require_valid_name(path)
    try:
        place = path.resolve()
        around = place.is_symlink()
    except RuntimeError:  # of Python before 3.13
        around = True
    except OSError as error:
        raise WriteError(_refusal(path, error)) from error
    if around:
        raise WriteError(
            f"{path} cannot be written because the path contains a circular link; choose another "
            "file"
        )
    return place


def _refusal(path: Path, error: OSError) -> str:
    if isinstance(error, IsADirectoryError) or path.is_dir():
        return f"{path} cannot be written because it is a folder; give the name of a file"
    reason = error.strerror or str(error)
    if sys.platform == "win32" and isinstance(error, PermissionError) and path.is_file():
        return (
            f"{path} cannot be overwritten ({reason}): the file is open in another program, or "
            "write-protected; close it in that program, or choose another file"
        )
    return (
        f"{path} cannot be written ({reason}); choose another location, or make this one writable"
    )
