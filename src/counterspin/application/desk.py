"""What all requests to the application share: the folder, the jobs, and what was read before.

- `Desk`
- `Remembered`: what was made of files, until one of them changes
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, TypeVar

from counterspin.application.folder import NotThereError, OutsideError, ServedFolder
from counterspin.application.guard import Tickets
from counterspin.application.jobs import Jobs
from counterspin.application.live import LiveViews
from counterspin.calibration.result import Result
from counterspin.campaign.resolved import Campaign
from counterspin.campaign.toml_file import DESCRIPTION_NAME, load_document
from counterspin.errors import CampaignError
from counterspin.input import FileIdentity

T = TypeVar("T")

#: How many things are remembered where nothing else is said.
_MAX_REMEMBERED: Final = 300


class Remembered:
    """What was made of files, which takes long, until one of them changes.

    Parameters
    ----------
    most
        How many things are remembered.
    """

    def __init__(self, most: int = _MAX_REMEMBERED) -> None:
        self._most = most
        self._known: OrderedDict[Any, tuple[Any, Any]] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: Any, files: Sequence[Path], make: Callable[[], T]) -> T:
        """Return what `make` returns, or returned for these very files before.

        Parameters
        ----------
        key
            What is asked for.
        files
            What it is made of.
        make
            Makes it; what it raises is not remembered.
        """
        found, keep = self.find(key, files)
        return keep(make()) if found is None else found

    def find(self, key: Any, files: Sequence[Path]) -> tuple[Any, Callable[[T], T]]:
        """Return what is remembered, or None, and what remembers what is made of the files.

        Parameters
        ----------
        key, files
            As for `get`.
        """
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

    def __init__(self, folder: ServedFolder) -> None:
        self.folder = folder
        self.jobs = Jobs()
        self.live = LiveViews()
        self.remembered = Remembered()
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
        """Return the campaign of a folder, none of whose files lies outside of what is served.

        Raises
        ------
        NotThereError
            If there is no description.
        CampaignError
            If it is wrong.
        OutsideError
            If it names a file that is not in the folder that is served.
        """
        from counterspin.campaign.description import read_campaign

        path = self.description(name)
        document = load_document(path)
        self.require_inside(path.parent, document)
        # A table of readings is part of the description.
        files = [path, *(path.parent / file for file in _files(document))]
        campaign = self.remembered.get(("campaign", path), files, lambda: read_campaign(path))
        for file in (*(run.record for run in campaign.runs), *campaign.tables):
            if not self.folder.holds(file):
                raise OutsideError(f"{file} is not in this folder, and is not read from here")
        return campaign

    def require_inside(self, folder: Path, document: dict[str, Any]) -> None:
        """Raise CampaignError if a description names files that are not in the folder."""
        wrong = [
            f"{key}: {file!r} is not in the folder that is served, and is not read from here"
            for key, file in _named(document)
            if not self.folder.holds(folder / file)
        ]
        if wrong:
            raise CampaignError(str(folder / DESCRIPTION_NAME), wrong)


def _files(document: dict[str, Any]) -> list[str]:
    return [file for _, file in _named(document)]


def _named(document: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the files that a description names, with their keys, whatever else is wrong with it.

    Every text at a key that names a file, at any depth: a key that is added later is not missed.
    """
    found: list[tuple[str, str]] = []

    def look(value: Any, path: str) -> None:
        if isinstance(value, dict):
            for key, item in value.items():
                if key in ("record", "file") and isinstance(item, str):
                    found.append((f"{path}{key}", item))
                look(item, f"{path}{key}.")
        elif isinstance(value, list):
            for place, item in enumerate(value):
                look(item, f"{path.rstrip('.')}[{place}].")

    look(document, "")
    return found
