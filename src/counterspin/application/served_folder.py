"""Access to the files of the served folder only.

Names that lead out of the folder by ``..``, as absolute paths or through links are refused. Hidden
files, including temporary files, are excluded.
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

#: Largest depth and number of searched folders.
_MAX_DEPTH: Final = 5
_MAX_FOLDERS: Final = 2000

#: Largest number of parts of a name; resolving thousands of parts would take too long.
_MAX_PATH_PARTS: Final = 30

#: Largest length of the name of a file or folder, in bytes of UTF-8.
_MAX_NAME_BYTES: Final = 255

#: Largest size of a text file in the editor, in bytes.
TEXT_MAX_BYTES: Final = 1_000_000

#: Version of a missing file.
NO_FILE_VERSION: Final = ""


class RequestError(CounterspinError):
    """The application cannot do what the page requests."""

    code = "request-refused"


class PathForbiddenError(CounterspinError):
    """The error for a name outside the folder, or an invalid name."""

    code = "path-forbidden"


class NotFoundError(CounterspinError):
    """The error for a file that does not exist."""

    code = "not-found"


class EditConflictError(CounterspinError):
    """The error for a file that changed since it was read; `current` is its current version."""

    code = "edit-conflict"

    def __init__(self, name: str, current_file: FileVersion) -> None:
        self.current = current_file
        super().__init__(
            f"Another window or program has changed {name}, so nothing was written. "
            "Compare the two versions, then save again."
        )


@frozen
class FileVersion:
    """The text of a file and its SHA-256; both are empty if the file does not exist."""

    text: str
    version: str


class ServedFolder:
    """The served folder.

    root: Path of the folder; CounterspinError if it is not a folder.
    """

    def __init__(self, root: Path) -> None:
        if not root.is_dir():
            problem = "is a file, not a folder" if root.exists() else "folder not found"
            raise CounterspinError(
                f"{root}: {problem}; give the folder that contains the campaigns",
                code="file-not-found",
            )
        self.root = root.resolve()
        self._write_lock = threading.Lock()

    def path(self, name: str) -> Path:
        """Return the path of a name; PathForbiddenError if it is outside the folder.

        name: Name relative to the folder, with slashes; empty: the folder itself.
        """
        self._require_root()
        parts = PurePosixPath(name).parts
        if len(parts) > _MAX_PATH_PARTS:
            raise PathForbiddenError(f"{name!r} has more than {_MAX_PATH_PARTS} folder levels")
        has_hidden_part = any(not part or part[0] == "." or part[-1] in ". " for part in parts)
        if (
            has_hidden_part
            or name.startswith("/")
            or any(character in name for character in "\\:\0\n\r")
        ):
            raise PathForbiddenError(
                f"{name!r} is not a valid file name in this folder: use a name inside this folder, "
                "without backslashes, colons or line breaks; no part may begin with a dot, or end "
                "with a dot or a space"
            )
        lengths = [len(part.encode("utf-8", "surrogatepass")) for part in parts]
        if max(lengths, default=0) > _MAX_NAME_BYTES:
            raise PathForbiddenError(
                f"the name {parts[lengths.index(max(lengths))][:20]!r}... is too long "
                f"({max(lengths)} bytes; at most {_MAX_NAME_BYTES} are possible)"
            )
        path = self.root.joinpath(*parts)
        if not self.contains(path):
            raise PathForbiddenError(f"{name!r} is outside this folder")
        return path

    def _require_root(self) -> None:
        if not self.root.is_dir():
            raise NotFoundError(
                f"the folder {self.root.name} no longer exists; restore it, or stop the server and "
                "serve another folder"
            )

    def contains(self, path: Path) -> bool:
        """Return whether a path, with links resolved, is in the folder."""
        try:
            return path.resolve().is_relative_to(self.root)
        except (OSError, RuntimeError, ValueError):
            return False  # a circular link, or a name that is too long

    def contains_named(self, folder: Path, name: str) -> bool:
        """Return whether a text, as a path relative to a document, stays in the folder.

        folder: Folder of the document, in the served folder.
        """
        parts = PurePath(name).parts
        if not parts:
            return True
        stays_below = ".." not in parts and not PurePath(name).is_absolute()
        if stays_below and not os.path.lexists(folder / parts[0]):
            return True  # the path does not exist, so it contains no links
        return self.contains(folder / name)

    def name(self, path: Path) -> str:
        """Return the name of a path relative to the folder; a path outside is unchanged."""
        try:
            name = path.relative_to(self.root).as_posix()
        except ValueError:
            return str(path)
        return "" if name == "." else name

    def relative_paths(self, message: str) -> str:
        """Return a message with paths relative to the folder."""
        return message.replace(f"{self.root}{os.sep}", "").replace(str(self.root), "this folder")

    def folders(self) -> Iterator[tuple[Path, list[str]]]:
        """Yield the folder and its subfolders, each with its sorted file names.

        Hidden folders and links to folders are not followed.
        """
        self._require_root()
        for directory, folders, files in islice(os.walk(self.root), _MAX_FOLDERS):
            path = Path(directory)
            is_deepest = len(path.relative_to(self.root).parts) >= _MAX_DEPTH
            folders[:] = [] if is_deepest else sorted(name for name in folders if name[0] != ".")
            yield path, sorted(name for name in files if name[0] != ".")

    def read(self, name: str, max_bytes: int = TEXT_MAX_BYTES) -> FileVersion:
        """Return text and version of a file; both are empty if the file does not exist."""
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
        """Write a text atomically; EditConflictError if the file has changed since it was read.

        edited_version: Version that was edited; empty: a new file.
        """
        path = self.path(name)
        try:
            content = text.encode("utf-8")
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
                lambda partial_file: partial_file.write_bytes(content),
                overwrite=edited_version != NO_FILE_VERSION,
            )
        return FileVersion(text, hashlib.sha256(content).hexdigest())
