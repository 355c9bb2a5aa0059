"""What all requests to the application share: the folder, the jobs, and what was read before."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, TypeVar

from counterspin.application.folder import NotThereError, OutsideError, ServedFolder
from counterspin.application.guard import Tickets
from counterspin.application.jobs import Jobs
from counterspin.application.live import LiveViews
from counterspin.calibration.result import Result
from counterspin.campaign.description import Campaign
from counterspin.campaign.toml_file import DESCRIPTION_NAME, load_document
from counterspin.certificates.signers import Signer
from counterspin.errors import CampaignError
from counterspin.input import FileIdentity

T = TypeVar("T")

#: How many things are remembered where nothing else is said.
_MAX_REMEMBERED: Final = 300


class FileCache:
    """What was made of files, which takes long, until one of them changes."""

    def __init__(self, most: int = _MAX_REMEMBERED) -> None:
        self._most = most
        self._known: OrderedDict[Any, tuple[Any, Any]] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: Any, files: Sequence[Path], make: Callable[[], T]) -> T:
        """Return what `make` returns, or returned for these very files before."""
        found, keep = self.find(key, files)
        return keep(make()) if found is None else found

    def find(self, key: Any, files: Sequence[Path]) -> tuple[Any, Callable[[T], T]]:
        """Return what is remembered, or None, and what remembers what is made of the files."""
        stamp = tuple(map(_identity, files))

        def keep(made: T) -> T:
            with self._lock:
                self._known[key] = (stamp, made)
                while len(self._known) > self._most:
                    self._known.popitem(last=False)
            return made

        with self._lock:
            if key in self._known and self._known[key][0] == stamp:
                self._known.move_to_end(key)
                return self._known[key][1], keep
        return None, keep


def _identity(file: Path) -> FileIdentity | None:
    with suppress(OSError, ValueError):
        return FileIdentity.of(file)
    return None


class Desk:
    """The folder that is served, what is being worked on, and what was read before."""

    def __init__(
        self,
        folder: ServedFolder,
        signer: Signer | None = None,
        signer_options: Mapping[str, str] | None = None,
    ) -> None:
        self.folder = folder
        #: Who signs certificates without a key that is brought, and how the command line names it.
        self.signer = signer
        self.signer_options = signer_options or {}
        self.jobs = Jobs()
        self.live = LiveViews()
        self.remembered = FileCache()
        #: Each for a request that only reads: its name, and what it says.
        self.tickets = Tickets[tuple[str, dict[str, str]]]()
        #: Who draws holds it: Matplotlib draws one picture at a time.
        self.drawing = threading.Lock()

    def close(self) -> None:
        """End all that goes on."""
        self.jobs.close()
        self.live.close()

    def result(self, name: str) -> Result:
        """Return a result by the name of its file; RecordError if it is none."""
        path = self.file(name)
        return self.remembered.get(("result", path), [path], lambda: Result.read(path))

    def file(self, name: str) -> Path:
        """Return where a file is; NotThereError if there is none of that name."""
        path = self.folder.path(name)
        if not path.is_file():
            raise NotThereError(f"{name}: there is no such file in this folder")
        return path

    def description(self, name: str) -> Path:
        """Return the description of the campaign in a folder."""
        return self.file(f"{name}/{DESCRIPTION_NAME}" if name else DESCRIPTION_NAME)

    def campaign(self, name: str) -> Campaign:
        """Return the campaign of a folder, none of whose files lies outside of what is served."""
        from counterspin.campaign.description import read_campaign

        path = self.description(name)
        document = load_document(path)
        self.require_inside(path.parent, document)
        # A table of readings is part of the description.
        files = [path, *(path.parent / name for _, name in _texts(document))]
        return self.remembered.get(("campaign", path), files, lambda: read_campaign(path))

    def place(self, name: str) -> Path:
        """Return where new files go, in a folder that may be there already."""
        path = self.folder.path(name)
        if path.is_dir():
            for file in path.iterdir():
                if file.is_symlink() and not self.folder.holds(file):
                    raise OutsideError(f"{self.folder.name(file)} leads out of this folder")
        return path

    def require_inside(self, folder: Path, document: Mapping[str, Any]) -> None:
        """Raise CampaignError if a document names files that are not in the folder.

        Every text is taken for the name of a file, at whichever key it stands: none is missed.

        document: A campaign's description, a plan, the laboratory's data.
        """
        wrong = [
            f"{key}: {name!r} is outside the served folder and cannot be used here"
            for key, name in _texts(document)
            if not self.folder.holds_named(folder, name)
        ]
        if wrong:
            raise CampaignError(str(folder / DESCRIPTION_NAME), wrong)


def _texts(document: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the texts of a document, with their keys."""

    def look(value: Any, path: str) -> Iterator[tuple[str, str]]:
        if isinstance(value, str):
            yield path, value
        elif isinstance(value, Mapping):
            for key, item in value.items():
                yield from look(item, f"{path}.{key}" if path else str(key))
        elif isinstance(value, list):
            for place, item in enumerate(value):
                yield from look(item, f"{path}[{place}]")

    return look(document, "")
