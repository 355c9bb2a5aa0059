"""Campaigns as folders: copied, renamed, put away, given records; nothing is ever lost."""

from __future__ import annotations

import shutil
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from counterspin.application.desk import Desk
from counterspin.application.editing import changed, checked_campaign
from counterspin.application.folder import OutsideError
from counterspin.campaign.toml_file import DESCRIPTION_NAME, load_document
from counterspin.errors import CounterspinError
from counterspin.exports.description import further_runs
from counterspin.output import make_folder

#: Where campaigns go that are put away; as a hidden folder it is no part of the page.
TRASH: Final = ".counterspin-trash"


def copy_campaign(desk: Desk, name: str, to: str) -> dict[str, Any]:
    """Copy a campaign's folder, with records and results; return the copy's name."""
    source, place = _source(desk, name), _new_place(desk, name, to)
    try:
        with TemporaryDirectory(dir=place.parent, prefix=".counterspin-") as part:
            whole = shutil.copytree(
                source, Path(part) / place.name, ignore=shutil.ignore_patterns(".*")
            )
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
    """Move a campaign's folder to the trash; return where it then is."""
    source = _idle(desk, name)
    moment = datetime.now(UTC).strftime("%Y%m%dT%H%M%S%f")
    place = desk.folder.root / TRASH / f"{moment}-{source.name}"
    make_folder(place.parent)
    _move(source, place)
    return {"place": desk.folder.name(place)}


def add_records(desk: Desk, name: str, files: list[str]) -> dict[str, Any]:
    """Make a run of each record that was brought to a campaign; return what was added, in words.

    files: Their names, from the folder that is served.
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
        text = changed(text, ["runs", place], run)
    if added:
        if problems := checked_campaign(desk, description, text).problems:
            raise CounterspinError(": ".join(problems[0]))
        desk.folder.write(desk.folder.name(description), text, before.version)
    return {"added": [f"{run['name']} at {run['rate']}" for run in added]}


def _source(desk: Desk, name: str) -> Path:
    """Return a campaign's folder; OutsideError of what would lead out of the folder served."""
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
    """Return where a campaign may go: a free place, from which its records are found."""
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
