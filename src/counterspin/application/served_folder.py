"""The files of the served folder, and no others.

No name leads out of the folder: not by ``..``, not as an absolute name, not by a link. Hidden
files, including temporary ones, are excluded.
"""

from __future__ import annotations

import hashlib
import os
import threading
from collections.abc import Iterator
from itertools import islice
from pathlib import Path, PurePath, PurePosixPath
from typing import Final

from counterspin.errors import CounterspinError, describe_read_error, read_error_code
from counterspin.frozen import frozen
from counterspin.input import read_file
from counterspin.output import make_folder, write_atomically

#: Folders within folders that are looked into, and most folders in all.
_MAX_DEPTH: Final = 5
_MAX_FOLDERS: Final = 2000

#: Most folders of a name; each of thousands would be looked up through all above it.
_MAX_PATH_PARTS: Final = 30

#: Most bytes of a text that is shown to be edited.
TEXT_MAX_BYTES: Final = 1_000_000

#: Version of a file that is not there.
NO_FILE_VERSION: Final = ""


class RequestError(CounterspinError):
    """The application cannot do what the page requests."""

    code = "request-refused"


class PathForbiddenError(CounterspinError):
    """The error for a name that leads out of the folder, or is not a file's name."""

    code = "path-forbidden"


class NotFoundError(CounterspinError):
    """The error for a file that does not exist."""

    code = "not-found"


class EditConflictError(CounterspinError):
    """The error for a file that changed since its editor read it; `now` is its present content."""

    code = "edit-conflict"

    def __init__(self, name: str, current: FileVersion) -> None:
        self.current = current
        super().__init__(
            f"Another window or program has changed {name}, so nothing was written. "
            "Compare the two versions, then save again."
        )


@frozen
class FileVersion:
    """A text and its SHA-256; both are empty without a file."""

    text: str
    version: str


class ServedFolder:
    """The served folder.

    root: The folder; CounterspinError if it is not one.
    """

    def __init__(self, root: Path) -> None:
        if not root.is_dir():
            kind = "is a file, not a folder" if root.exists() else "folder not found"
            raise CounterspinError(
                f"{root}: {kind}; give the folder that contains the campaigns",
                code="file-not-found",
            )
        self.root = root.resolve()
        self._write_lock = threading.Lock()

    def path(self, name: str) -> Path:
        """Return the path of a name; OutsideError if it is out of the folder.

        name: Relative to the folder, with slashes; empty: the folder itself.
        """
        parts = PurePosixPath(name).parts
        if len(parts) > _MAX_PATH_PARTS:
            raise PathForbiddenError(f"{name!r} has more than {_MAX_PATH_PARTS} folder levels")
        is_hidden = any(not part or part[0] == "." or part[-1] in ". " for part in parts)
        if is_hidden or name.startswith("/") or any(c in name for c in "\\:\0\n\r"):
            raise PathForbiddenError(f"{name!r} is not a valid file name in this folder")
        path = self.root.joinpath(*parts)
        if not self.contains(path):
            raise PathForbiddenError(f"{name!r} is outside this folder")
        return path

    def contains(self, path: Path) -> bool:
        """Return whether a path, with links resolved, is in the folder."""
        try:
            return path.resolve().is_relative_to(self.root)
        except (OSError, RuntimeError, ValueError):
            return False  # a link to itself, a name that is too long

    def contains_named(self, folder: Path, name: str) -> bool:
        """Return whether a text, as a file's name relative to a document, stays in the folder.

        folder: The document's, in the served folder.
        """
        parts = PurePath(name).parts
        if not parts:
            return True
        stays_below = ".." not in parts and not PurePath(name).is_absolute()
        if stays_below and not os.path.lexists(folder / parts[0]):
            return True  # no link leads on from there
        return self.contains(folder / name)

    def name(self, path: Path) -> str:
        """Return a path's name within the folder; a path outside is unchanged."""
        try:
            name = path.relative_to(self.root).as_posix()
        except ValueError:
            return str(path)
        return "" if name == "." else name

    def relative_paths(self, message: str) -> str:
        """Return a message with names within the folder instead of whole paths."""
        return message.replace(f"{self.root}{os.sep}", "").replace(str(self.root), "this folder")

    def folders(self) -> Iterator[tuple[Path, list[str]]]:
        """Yield the folder and those in it, each with the names of its files, sorted.

        Neither hidden ones nor links to folders are followed.
        """
        for directory, folders, files in islice(os.walk(self.root), _MAX_FOLDERS):
            path = Path(directory)
            is_deepest = len(path.relative_to(self.root).parts) >= _MAX_DEPTH
            folders[:] = [] if is_deepest else sorted(name for name in folders if name[0] != ".")
            yield path, sorted(name for name in files if name[0] != ".")

    def read(self, name: str, max_bytes: int = TEXT_MAX_BYTES) -> FileVersion:
        """Return a file's text and version; an empty one without a file."""
        path = self.path(name)
        try:
            content = read_file(path, max_bytes)
            return FileVersion(content.decode("utf-8-sig"), hashlib.sha256(content).hexdigest())
        except FileNotFoundError:
            return FileVersion("", NO_FILE_VERSION)
        except UnicodeDecodeError as error:
            raise CounterspinError(f"{name} is not UTF-8 text", code="wrong-encoding") from error
        except OSError as error:
            raise CounterspinError(
                f"{name}: {describe_read_error(error)}", code=read_error_code(error)
            ) from error

    def write(self, name: str, text: str, edited_version: str) -> FileVersion:
        """Write a text atomically if the file has not changed since its editor read it.

        edited_version: The version that was edited; empty: there was no file.
        """
        path = self.path(name)
        try:
            data = text.encode("utf-8")
        except UnicodeEncodeError as error:
            raise CounterspinError(
                f"{name}: the content is not valid text", code="wrong-encoding"
            ) from error
        with self._write_lock:
            current = self.read(name)
            if current.version != edited_version:
                raise EditConflictError(name, current)
            make_folder(path.parent)
            write_atomically(
                path,
                lambda part: part.write_bytes(data),
                overwrite=edited_version != NO_FILE_VERSION,
            )
        return FileVersion(text, hashlib.sha256(data).hexdigest())
