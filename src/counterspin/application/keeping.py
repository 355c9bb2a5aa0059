"""Campaign folders: upload, copy, rename and move to the trash; nothing is ever lost."""

from __future__ import annotations

import filecmp
import re
import shutil
from contextlib import ExitStack, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote, unquote

from counterspin.application.desk import Desk
from counterspin.application.editing import checked_campaign, with_value
from counterspin.application.folder import NotThereError, OutsideError, ServedFolder
from counterspin.campaign.documents import DESCRIPTION_NAME, load_document
from counterspin.errors import CounterspinError
from counterspin.frozen import frozen
from counterspin.ingest.description import further_runs
from counterspin.output import finish, make_folder
from counterspin.records.format_registry import suffix_problem
from counterspin.temporary_folders import remove_abandoned_folders, temporary_folder

#: Prefixes of the temporary folders in which a campaign is made or copied, and a file is uploaded.
COPY_PREFIX: Final = ".counterspin-copy-"
_UPLOAD_PREFIX: Final = ".counterspin-upload-"


@frozen
class Arrival:
    """A file that is being uploaded."""

    path: Path  #: Where it goes.
    part: Path  #: A new file that takes its bytes, in a temporary folder beside it.
    temporary: ExitStack  #: Removes that folder.
    folders: tuple[Path, ...]  #: Those that were made for it, the innermost first.

    def end(self) -> None:
        """Remove the remains of an incomplete upload."""
        self.temporary.close()
        for folder in self.folders:
            with suppress(OSError):  # something is in it
                folder.rmdir()


def place_for(desk: Desk, name: str) -> Arrival:
    """Return the places of an uploaded file."""
    path = desk.folder.path(name)
    if wrong := suffix_problem(path):
        raise OutsideError(f"{name}: {wrong}")
    folders = tuple(folder for folder in path.parents if not folder.exists())
    make_folder(path.parent)
    temporary = ExitStack()
    try:
        part = temporary.enter_context(temporary_folder(_UPLOAD_PREFIX, path.parent)) / "part"
        part.touch()
    except OSError as error:
        temporary.close()
        raise CounterspinError(f"{name}: cannot be written ({error.strerror})") from error
    return Arrival(path, part, temporary, folders)


def complete_upload(desk: Desk, arrival: Arrival) -> dict[str, Any]:
    """Rename a complete upload; CounterspinError if a file with other content has the name."""
    size = arrival.part.stat().st_size
    if arrival.path.is_file() and filecmp.cmp(arrival.part, arrival.path, shallow=False):
        arrival.part.unlink()  # brought once more, after a mistake
    else:
        finish(arrival.part, arrival.path)
    return {"name": desk.folder.name(arrival.path), "bytes": size}


#: Where campaigns go that are put away; as a hidden folder it is no part of the page.
TRASH: Final = ".counterspin-trash"

#: Folders in the trash: when each was moved, and its name before, percent-encoded.
_TRASHED: Final = re.compile(r"\d{8}T\d{12}-(?P<name>.+)")


def remove_abandoned_parts(served: ServedFolder) -> None:
    """Remove the incomplete uploads and copies of campaigns that killed servers left."""
    for folder, _ in served.folders():
        for prefix in (COPY_PREFIX, _UPLOAD_PREFIX):
            remove_abandoned_folders(prefix, folder)


def copy_campaign(desk: Desk, name: str, to: str) -> dict[str, Any]:
    """Copy a campaign's folder, with records and results; return the copy's name."""
    source, place = _source(desk, name), _new_place(desk, name, to)
    try:
        with temporary_folder(COPY_PREFIX, place.parent) as part:
            whole = shutil.copytree(source, part / place.name, ignore=shutil.ignore_patterns(".*"))
            whole.rename(place)
    except OSError as error:
        raise CounterspinError(f"{to}: cannot be written ({error.strerror or error})") from error
    return {"name": desk.folder.name(place)}


def rename_campaign(desk: Desk, name: str, to: str) -> dict[str, Any]:
    """Give a campaign's folder another name; return it."""
    source, place = _idle(desk, name), _new_place(desk, name, to)
    _move(source, place)
    return {"name": desk.folder.name(place)}


def put_away(desk: Desk, name: str) -> dict[str, Any]:
    """Move a campaign's folder to the trash; return its new path."""
    source = _idle(desk, name)
    moment = datetime.now(UTC).strftime("%Y%m%dT%H%M%S%f")
    # A campaign of a subfolder is restored into it.
    place = desk.folder.root / TRASH / f"{moment}-{quote(desk.folder.name(source), safe='')}"
    make_folder(place.parent)
    _move(source, place)
    return {"place": place.name}


def trash_contents(desk: Desk) -> list[dict[str, str]]:
    """Return place and former name of each campaign in the trash, the latest first."""
    trash = desk.folder.root / TRASH
    is_ours = trash.is_dir() and desk.folder.holds(trash)  # no link to another folder
    places = sorted(trash.iterdir(), reverse=True) if is_ours else []
    return [
        {"place": place.name, "name": unquote(match["name"])}
        for place in places
        if (match := _TRASHED.fullmatch(place.name))
    ]


def restore_campaign(desk: Desk, place: str) -> dict[str, Any]:
    """Move a campaign from the trash back to its folder, or beside what is there; return its name.

    place: Its name in the trash.
    """
    former = {entry["place"]: entry["name"] for entry in trash_contents(desk)}.get(place)
    if former is None:
        raise NotThereError(f"the trash has no {place}")
    target = desk.folder.path(free_name(desk, former))
    make_folder(target.parent)
    _move(desk.folder.root / TRASH / place, target)
    return {"name": desk.folder.name(target)}


def free_name(desk: Desk, name: str) -> str:
    """Return the name if no folder has it, or else with the first free number."""
    names = (name if number == 1 else f"{name}-{number}" for number in range(1, 1000))
    return next(free for free in names if not desk.folder.path(free).exists())


def add_records(desk: Desk, name: str, files: list[str]) -> dict[str, Any]:
    """Make a run of each record that was added to a campaign; return sentences on the runs.

    files: Their names, relative to the served folder.
    """
    description = desk.description(name)
    before = desk.folder.read(desk.folder.name(description))
    document = load_document(description)
    desk.require_inside(description.parent, document)
    runs = [run for run in document.get("runs", []) if isinstance(run, dict)]
    if not runs or "record" not in runs[0]:
        raise CounterspinError(
            "the runs of this campaign are readings, not records; add yours to its table"
        )
    named = {(description.parent / str(run.get("record"))).resolve() for run in runs}
    new = [file for file in map(desk.file, files) if file.resolve() not in named]
    text, added = before.text, further_runs(new, document, description.parent) if new else []
    for place, run in enumerate(added, len(runs)):
        text = with_value(text, ["runs", place], run)
    if added:
        if problems := checked_campaign(desk, description, text).problems:
            raise CounterspinError(": ".join(problems[0]))
        desk.folder.write(desk.folder.name(description), text, before.version)
    return {"added": [f"{run['name']} at {run['rate']}" for run in added]}


def _source(desk: Desk, name: str) -> Path:
    """Return a campaign's folder; OutsideError if it is outside the served folder."""
    source = desk.description(name).parent
    if source == desk.folder.root:
        raise CounterspinError("this campaign is the served folder itself; move it by hand")
    if desk.folder.root.joinpath(*Path(name).parts).is_symlink():
        raise OutsideError(f"{name} is a link to a folder, which the application leaves alone")
    for path in source.rglob("*"):
        if path.is_symlink():
            raise OutsideError(f"{desk.folder.name(path)} is a link; copy or move it by hand")
    return source


def _idle(desk: Desk, name: str) -> Path:
    """Return a campaign's folder if no job is at work in it."""
    source = _source(desk, name)
    busy = [job for job in desk.jobs.all() if job.state in ("waiting", "running")]
    if any(job.campaign == name or job.campaign.startswith(f"{name}/") for job in busy):
        raise CounterspinError(f"{name}: a job is running in it; wait until it ends, or stop it")
    return source


def _new_place(desk: Desk, name: str, to: str) -> Path:
    """Return a free folder for a campaign, from which its records can be found."""
    place = desk.folder.path(to)
    if place == desk.folder.root or place.exists():
        raise CounterspinError(f"{to or 'this folder'} exists, and is not replaced")
    source = desk.description(name).parent
    if place.is_relative_to(source):
        raise CounterspinError(f"{to} lies in {name}; choose a place beside it")
    try:
        away = ".." in str(load_document(source / DESCRIPTION_NAME))
    except CounterspinError:
        away = True  # a description that cannot be read may name anything
    if away and place.parent != source.parent:
        raise CounterspinError(
            f"{name}: its description names files outside of its folder, relative to it; choose a "
            "name in the same folder"
        )
    make_folder(place.parent)
    return place


def _move(source: Path, place: Path) -> None:
    try:
        source.rename(place)
    except OSError as error:
        raise CounterspinError(f"{source.name}: cannot be moved ({error.strerror})") from error
