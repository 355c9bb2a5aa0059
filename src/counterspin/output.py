"""Atomic writing of files, without overwriting other files."""

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

#: Number of bytes at either end of a file that are searched for a mark.
_N_SEARCHED_BYTES: Final = 1 << 18

#: The text of `file_mark`; its apostrophe may be escaped as in HTML.
_FILE_MARK: Final = re.compile(rb"Made by counterspin: ((?:[a-z ']|&#39;)+)\.")

#: Names of devices on Windows, with any suffix: ``NUL.json`` discards its content.
_DEVICE_NAME: Final = re.compile(
    r"(?:CON|PRN|AUX|NUL|CONIN\$|CONOUT\$|(?:COM|LPT)[0-9¹²³]) *(?:\..*)?", re.I
)
#: Characters not allowed in file names on Windows; a colon would begin the name of a hidden stream.
_FORBIDDEN_CHARACTER: Final = re.compile(r'[<>:"|?*\x00-\x1f]')
#: Number of attempts to rename a file that another program has open, and delay between them, s.
_N_RENAME_ATTEMPTS: Final = 10
_RENAME_DELAY: Final = 0.1


@frozen
class FileType:
    """A type of file that a command writes."""

    description: str  #: Name in messages, with its article.
    recognises: Callable[[Path], bool]  #: Returns whether a file is of this type.


def check_writable(
    path: Path, file_type: Callable[[], FileType] | None = None, *, overwrite: bool = False
) -> None:
    """Raise CounterspinError if an output cannot be written, or would overwrite another file.

    An existing file is replaced only if it has the same type and `overwrite` is set, so that no
    input, campaign, record or result of another command is lost by mistake. Devices and pipes are
    always accepted.

    file_type: Returns the type of the output; called only if a file exists. None: the caller has
        checked the existing file.
    overwrite: Whether an existing file of the same type may be replaced.
    """
    target = _resolve_target(path)
    try:
        if not target.exists():
            if not target.parent.is_dir():
                raise CounterspinError(
                    f"{path} cannot be written: the folder {path.parent} does not exist",
                    code="file-not-found",
                )
            return
    except OSError as error:
        raise WriteError(_describe_write_error(path, error)) from error
    if target.is_dir():
        raise WriteError(_describe_write_error(path, IsADirectoryError()))
    if not target.is_file():
        return
    if file_type is not None:
        expected_type = file_type()
        try:
            is_same_type = expected_type.recognises(target)
        except OSError:
            is_same_type = False
        if not is_same_type:
            raise ExistingFileError(
                f"{path} already exists and is not {expected_type.description}, so it was not "
                "overwritten; choose another file"
            )
    if not overwrite:
        advice = "" if file_type is None else ", or use `overwrite=True`"
        raise ExistingFileError(f"{path} already exists; choose another file{advice}")


def file_mark(document_type: str) -> str:
    """Return the remark that identifies the file, for formats with a field for remarks."""
    return f"Made by counterspin: {document_type}."


def marked_file_type(document_type: str) -> FileType:
    """Return the type of the files with this `file_mark`, and no other, at either end."""

    def recognises(path: Path) -> bool:
        # Text of a user may look like another mark; the type is then ambiguous.
        marks = {match[1] for chunk in _read_ends(path) for match in _FILE_MARK.finditer(chunk)}
        return {mark.replace(b"&#39;", b"'") for mark in marks} == {document_type.encode()}

    return FileType(f"{document_type} written by counterspin", recognises)


def contains_bytes(pattern: bytes) -> Callable[[Path], bool]:
    """Return a predicate: whether the first or last 256 KiB of a file contain these bytes."""
    return lambda path: any(pattern in chunk for chunk in _read_ends(path))


def _read_ends(path: Path) -> tuple[bytes, bytes]:
    with open_file(path) as file:
        head = file.read(_N_SEARCHED_BYTES)
        file.seek(max(file.seek(0, os.SEEK_END) - _N_SEARCHED_BYTES, 0))
        return head, file.read()


def require_valid_name(path: Path) -> None:
    """Raise CounterspinError if a name is a device on Windows, or Windows would change it.

    Other systems have no such names.
    """
    if sys.platform != "win32":
        return
    for name in path.parts[1:] if path.anchor else path.parts:
        if _DEVICE_NAME.fullmatch(name):
            reason = f"{name} is the name of a device on Windows"
        elif match := _FORBIDDEN_CHARACTER.search(name):
            reason = f"names must not contain {match[0]!r} on Windows"
        elif name[-1] in ". " and name not in (".", ".."):
            reason = "names must not end with a dot or a space on Windows"
        else:
            continue
        raise CounterspinError(
            f"{path} cannot be written: {reason}; choose another name", code="invalid-name"
        )


def make_folder(folder: Path) -> None:
    """Make a folder and its parents unless they exist; CounterspinError if that fails."""
    require_valid_name(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        if isinstance(error, FileExistsError):
            raise ExistingFileError(f"{folder} is a file, not a folder; give a folder") from error
        raise WriteError(
            f"{folder} cannot be created ({error.strerror}); choose another location"
        ) from error


def write_atomically(
    path: Path,
    write: Callable[[Path], object],
    file_type: Callable[[], FileType] | None = None,
    *,
    overwrite: bool = False,
) -> None:
    """Write a file under a hidden name in the same folder, then rename it.

    The target of a symbolic link is replaced, and the link is kept. A device or a pipe such as
    ``/dev/stdout`` is written directly.

    file_type, overwrite: As in `check_writable`; also for a file that appears during writing.
    """
    check_writable(path, file_type, overwrite=overwrite)
    target = _resolve_target(path)
    if target.exists() and not target.is_file():
        _write_to_device(path, write)
        return
    partial_file = create_partial_file(path)
    try:
        write(partial_file)
        move_into_place(partial_file, path, file_type, overwrite=overwrite)
    except OSError as error:
        raise WriteError(_describe_write_error(path, error)) from error
    finally:
        with suppress(OSError):  # on Windows, another program may have the file open
            partial_file.unlink(missing_ok=True)


def write_binary(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Open a file and write it: polars cannot open names that are not UTF-8."""
    with path.open("wb") as file:
        write(file)


def write_text(
    path: Path,
    text: str,
    file_type: Callable[[], FileType] | None = None,
    *,
    overwrite: bool = False,
) -> None:
    """Write text as UTF-8; parameters and errors as in `write_atomically`."""
    content = text.encode("utf-8")
    write_atomically(
        path, lambda partial_file: partial_file.write_bytes(content), file_type, overwrite=overwrite
    )


def create_partial_file(path: Path) -> Path:
    """Create a hidden, empty file in the folder of an output; CounterspinError if that fails."""
    partial_file = _resolve_target(path).parent / f".{os.urandom(8).hex()}{path.suffix}"
    try:
        # The system applies the umask, so the result has the usual permissions.
        os.close(os.open(partial_file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
    except OSError as error:
        raise WriteError(_describe_write_error(path, error)) from error
    return partial_file


def move_into_place(
    partial_file: Path,
    path: Path,
    file_type: Callable[[], FileType] | None = None,
    *,
    overwrite: bool = False,
) -> None:
    """Rename a finished file atomically, so that no other writer's file is lost."""
    target = _resolve_target(path)
    while True:
        try:
            _rename_exclusively(partial_file, target)
        except FileExistsError:
            check_writable(path, file_type, overwrite=overwrite)
            if not overwrite:
                continue  # the existing file has been removed
            _retry_rename(lambda: partial_file.replace(target))
        return


def _retry_rename(rename: Callable[[], object]) -> None:
    """Rename a file; on Windows, retry while a virus scanner or indexer has it open."""
    n_attempts = _N_RENAME_ATTEMPTS if sys.platform == "win32" else 1
    for attempt in range(n_attempts):
        try:
            rename()
        except PermissionError:
            if attempt == n_attempts - 1:
                raise
            time.sleep(_RENAME_DELAY)
        else:
            return


def _rename_exclusively(partial_file: Path, target: Path) -> None:
    """Rename a file; FileExistsError if a file with the new name exists."""
    if os.name == "nt":
        _retry_rename(lambda: partial_file.rename(target))  # never replaces a file on Windows
        return
    try:
        os.link(partial_file, target)
    except FileExistsError:
        raise
    except OSError:
        # File systems without hard links, such as FAT: create an empty file with the name, and
        # replace it. If the process is killed in between, the empty file remains.
        os.close(os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
        try:
            partial_file.replace(target)
        except OSError:
            target.unlink()
            raise
    else:
        partial_file.unlink()


def _write_to_device(path: Path, write: Callable[[Path], object]) -> None:
    """Write a temporary file, and copy its content to a device or a pipe."""
    from counterspin.temporary_folders import temporary_folder

    try:
        with temporary_folder("counterspin-output-") as folder:
            partial_file = folder / f"whole{path.suffix}"
            write(partial_file)
            path.write_bytes(partial_file.read_bytes())
    except OSError as error:
        raise WriteError(_describe_write_error(path, error)) from error


def _resolve_target(path: Path) -> Path:
    """Return a path with symbolic links resolved; CounterspinError if they are circular."""
    require_valid_name(path)
    try:
        target = path.resolve()
        is_circular_link = target.is_symlink()
    except RuntimeError:  # Python before 3.13
        is_circular_link = True
    except OSError as error:
        raise WriteError(_describe_write_error(path, error)) from error
    if is_circular_link:
        raise WriteError(
            f"{path} cannot be written because the path contains a circular link; choose another "
            "file"
        )
    return target


def _describe_write_error(path: Path, error: OSError) -> str:
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
