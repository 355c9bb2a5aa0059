"""State shared by all requests: folder, jobs and cached files."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, TypeVar

from counterspin.application.access_control import Tickets
from counterspin.application.jobs import Jobs, LiveViews
from counterspin.application.served_folder import NotFoundError, PathForbiddenError, ServedFolder
from counterspin.calibration.result import Result
from counterspin.campaign.description import Campaign
from counterspin.campaign.documents import DESCRIPTION_NAME, load_document
from counterspin.certificates.signers import Signer
from counterspin.errors import CampaignError
from counterspin.input import FileIdentity

T = TypeVar("T")

#: Default number of entries of a cache.
_MAX_CACHED_VALUES: Final = 300


class FileCache:
    """A cache of values computed from files; an entry expires when one of its files changes."""

    def __init__(self, max_values: int = _MAX_CACHED_VALUES) -> None:
        self._max_entries = max_values
        self._entries: OrderedDict[Any, tuple[Any, Any]] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: Any, files: Sequence[Path], compute: Callable[[], T]) -> T:
        """Return the cached value of `compute`, or its new value if a file has changed."""
        cached_value, store = self.lookup(key, files)
        return store(compute()) if cached_value is None else cached_value

    def lookup(self, key: Any, files: Sequence[Path]) -> tuple[Any, Callable[[T], T]]:
        """Return the cached value or None, and a function that stores a new one."""
        identities = tuple(map(_file_identity, files))

        def store(value: T) -> T:
            with self._lock:
                self._entries[key] = (identities, value)
                while len(self._entries) > self._max_entries:
                    self._entries.popitem(last=False)
            return value

        with self._lock:
            if key in self._entries and self._entries[key][0] == identities:
                self._entries.move_to_end(key)
                return self._entries[key][1], store
        return None, store


def _file_identity(file: Path) -> FileIdentity | None:
    with suppress(OSError, ValueError):
        return FileIdentity.from_file(file)
    return None


class AppState:
    """The served folder, the jobs, and the cached files."""

    def __init__(
        self,
        folder: ServedFolder,
        signer: Signer | None = None,
        signer_options: Mapping[str, str] | None = None,
    ) -> None:
        self.folder = folder
        #: Signer of certificates if no key is uploaded, and its options of the command line.
        self.signer = signer
        self.signer_options = signer_options or {}
        self.jobs = Jobs()
        self.live = LiveViews()
        self.cache = FileCache()
        #: Tickets for GET requests: name and parameters.
        self.tickets = Tickets[tuple[str, dict[str, str]]]()
        #: Lock for drawing, because Matplotlib is not thread-safe.
        self.drawing = threading.Lock()

    def close(self) -> None:
        """End all jobs and processes."""
        self.jobs.close()
        self.live.close()

    def result(self, name: str) -> Result:
        """Return a result by the name of its file; RecordError if it is not a result."""
        path = self.file(name)
        return self.cache.get(("result", path), [path], lambda: Result.read(path))

    def file(self, name: str) -> Path:
        """Return the path of a file; NotFoundError if the file does not exist."""
        path = self.folder.path(name)
        if not path.is_file():
            raise NotFoundError(f"{name}: file not found")
        return path

    def description_path(self, name: str) -> Path:
        """Return the description of the campaign in a folder."""
        return self.file(f"{name}/{DESCRIPTION_NAME}" if name else DESCRIPTION_NAME)

    def campaign(self, name: str) -> Campaign:
        """Return the campaign of a folder; all of its files must be in the served folder."""
        from counterspin.campaign.description import read_campaign

        path = self.description_path(name)
        document = load_document(path)
        self.require_inside(path.parent, document)
        # A table of readings is also part of the description.
        files = [path, *(path.parent / name for _, name in _iter_strings(document))]
        return self.cache.get(("campaign", path), files, lambda: read_campaign(path))

    def target_path(self, name: str) -> Path:
        """Return the path for new files, in a folder that may exist already."""
        path = self.folder.path(name)
        if path.is_dir():
            for file in path.iterdir():
                if file.is_symlink() and not self.folder.contains(file):
                    raise PathForbiddenError(f"{self.folder.name(file)} is outside this folder")
        return path

    def require_inside(self, folder: Path, document: Mapping[str, Any]) -> None:
        """Raise CampaignError if a document names files that are not in the folder.

        Every string in the document is checked as if it were a path.

        document: A campaign's description, a plan, the laboratory's data.
        """
        problems = [
            f"{key}: {name!r} is outside the served folder and cannot be used here"
            for key, name in _iter_strings(document)
            if not self.folder.contains_named(folder, name)
        ]
        if problems:
            raise CampaignError(
                str(folder / DESCRIPTION_NAME), problems, code="path-outside-folder"
            )


def _iter_strings(document: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield key and value of all strings in a document."""

    def walk(value: Any, path: str) -> Iterator[tuple[str, str]]:
        if isinstance(value, str):
            yield path, value
        elif isinstance(value, Mapping):
            for key, item in value.items():
                yield from walk(item, f"{path}.{key}" if path else str(key))
        elif isinstance(value, list):
            for index, item in enumerate(value):
                yield from walk(item, f"{path}[{index}]")

    return walk(document, "")
