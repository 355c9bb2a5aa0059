"""The state that all requests share: folder, jobs, cached files; each action's command line.

This module alone knows the options of the command line within the application; a test has the
command line parse every one of them.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, TypeVar

from counterspin import shell
from counterspin.application.folder import NotThereError, OutsideError, ServedFolder
from counterspin.application.guard import Tickets
from counterspin.application.jobs import Jobs, LiveViews
from counterspin.calibration.result import Result
from counterspin.campaign.description import Campaign
from counterspin.campaign.documents import DESCRIPTION_NAME, load_document
from counterspin.certificates.signers import Signer
from counterspin.errors import CampaignError
from counterspin.input import FileIdentity


def calibrate_command(campaign: Path, output: Path, method: str, accept_misfit: str | None) -> str:
    """Return the command that calibrates a campaign and writes its result."""
    words = ["calibrate", str(campaign), "--json", str(output), "--overwrite"]
    if method != "joint":
        words.append(f"--method={method}")
    if accept_misfit:
        words.append(f"--accept-misfit={accept_misfit}")
    return _typed(words)


def report_command(result: Path) -> str:
    """Return the command that writes a result's report."""
    return _typed(["report", str(result), "--output", str(result.with_suffix(".html"))])


def init_command(folder: Path, test: str) -> str:
    """Return the command that writes an example campaign."""
    return _typed(["init", str(folder), f"--test={test}"])


def demo_command(folder: Path) -> str:
    """Return the command that simulates and calibrates the demonstration's campaign."""
    return _typed(["demo", "--output", str(folder)])


def compare_command(results: Sequence[Path]) -> str:
    """Return the command that compares results."""
    return _typed(["compare", *map(str, results)])


def history_command(folder: Path, term: str) -> str:
    """Return the command that follows a coefficient through a folder's results."""
    return _typed(["history", str(folder), f"--term={term}"])


def certificate_command(
    result: Path, lab: Path, output: Path, both: bool, signing: Mapping[str, str]
) -> str:
    """Return the command that issues a result's certificate.

    signing: Options for the signer, such as `key`, and their values.
    """
    words = ["certificate", str(result), str(lab), "--output", str(output)]
    if both:
        words.append("--both")
    return _typed([*words, *(f"--{name}={value}" for name, value in signing.items())])


def plan_command(file: Path, folder: Path | None) -> str:
    """Return the command that plans, and writes the campaign into a folder if there is one."""
    return _typed(["plan", str(file), *([] if folder is None else ["--output", str(folder)])])


def forecast_command(campaign: Path) -> str:
    """Return the command that predicts a campaign's uncertainties."""
    return _typed(["plan", "--check", str(campaign)])


def study_command(campaign: Path, trials: int, output: Path) -> str:
    """Return the command that studies a campaign and writes the result."""
    words = ["study", str(campaign), f"--trials={trials}", "--json", str(output), "--overwrite"]
    return _typed(words)


def simulate_command(campaign: Path, folder: Path) -> str:
    """Return the command that makes a campaign's records in another folder."""
    return _typed(["simulate", str(campaign), "--output", str(folder)])


def export_command(
    folder: Path, files: Sequence[Path], answers: Mapping[str, str], test: str
) -> str:
    """Return the command that makes a campaign of a recorder's files."""
    said = [f"--answer={key}={answer}" for key, answer in answers.items()]
    kind = [f"--test={test}"]
    return _typed(["init", str(folder), *kind, "--from", *map(str, files), *said])


def check_command(record: Path, campaign: Path, run: str) -> str:
    """Return the command that judges one record."""
    return _typed(["check", str(record), f"--campaign={campaign}", f"--run={run}"])


def watch_command(campaign: Path, goal: str) -> str:
    """Return the command that follows a campaign's records."""
    return _typed(["watch", str(campaign), *([f"--goal={goal}"] if goal else [])])


def _typed(words: Sequence[str]) -> str:
    return shell.join_command(["counterspin", *words])


T = TypeVar("T")

#: How many things are remembered where nothing else is said.
_MAX_REMEMBERED: Final = 300


class FileCache:
    """A cache of values computed from files; an entry expires when one of its files changes."""

    def __init__(self, most: int = _MAX_REMEMBERED) -> None:
        self._most = most
        self._known: OrderedDict[Any, tuple[Any, Any]] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: Any, files: Sequence[Path], make: Callable[[], T]) -> T:
        """Return the cached value of `make`, or its new value if a file has changed."""
        found, keep = self.find(key, files)
        return keep(make()) if found is None else found

    def find(self, key: Any, files: Sequence[Path]) -> tuple[Any, Callable[[T], T]]:
        """Return the cached value or None, and a function that stores a new one."""
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
    """The served folder, the jobs, and the cached files."""

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
        """End all jobs and processes."""
        self.jobs.close()
        self.live.close()

    def result(self, name: str) -> Result:
        """Return a result by the name of its file; RecordError if it is not a result."""
        path = self.file(name)
        return self.remembered.get(("result", path), [path], lambda: Result.read(path))

    def file(self, name: str) -> Path:
        """Return the path of a file; NotThereError if no file has the name."""
        path = self.folder.path(name)
        if not path.is_file():
            raise NotThereError(f"{name}: file not found")
        return path

    def description(self, name: str) -> Path:
        """Return the description of the campaign in a folder."""
        return self.file(f"{name}/{DESCRIPTION_NAME}" if name else DESCRIPTION_NAME)

    def campaign(self, name: str) -> Campaign:
        """Return the campaign of a folder; all of its files must be in the served folder."""
        from counterspin.campaign.description import read_campaign

        path = self.description(name)
        document = load_document(path)
        self.require_inside(path.parent, document)
        # A table of readings is part of the description.
        files = [path, *(path.parent / name for _, name in _texts(document))]
        return self.remembered.get(("campaign", path), files, lambda: read_campaign(path))

    def place(self, name: str) -> Path:
        """Return the path for new files, in a folder that may exist already."""
        path = self.folder.path(name)
        if path.is_dir():
            for file in path.iterdir():
                if file.is_symlink() and not self.folder.holds(file):
                    raise OutsideError(f"{self.folder.name(file)} leads out of this folder")
        return path

    def require_inside(self, folder: Path, document: Mapping[str, Any]) -> None:
        """Raise CampaignError if a document names files that are not in the folder.

        Every string in the document is checked as if it were a path.

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
