"""What all requests share: the folder, the jobs, what was read; a click as a command's words.

The one place of the application that knows the options of the command line; a test has the
command line read every one of them back.
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

    signing: Options that say who signs, such as `key`, and their values.
    """
    words = ["certificate", str(result), str(lab), "--output", str(output)]
    if both:
        words.append("--both")
    return _typed([*words, *(f"--{name}={value}" for name, value in signing.items())])


def plan_command(file: Path, folder: Path | None) -> str:
    """Return the command that plans, and writes the campaign into a folder if there is one."""
    return _typed(["plan", str(file), *([] if folder is None else ["--output", str(folder)])])


def forecast_command(campaign: Path) -> str:
    """Return the command that says what a campaign will tell."""
    return _typed(["plan", "--check", str(campaign)])


def study_command(campaign: Path, trials: int, output: Path) -> str:
    """Return the command that studies a campaign and writes what it finds."""
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
