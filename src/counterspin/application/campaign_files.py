"""Campaign folders: upload, copy, rename and move to the trash, without deleting data."""

from __future__ import annotations

import filecmp
import re
import shutil
from contextlib import ExitStack, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Final
from urllib.parse import unquote

from counterspin.application.answers import (
    AddedRuns,
    NameAnswer,
    RestoredFolder,
    StoredFile,
    TrashEntry,
    TrashPlace,
)
from counterspin.application.app_state import AppState
from counterspin.application.editing import parse_campaign_text, set_value
from counterspin.application.served_folder import (
    NotFoundError,
    PathForbiddenError,
    RequestError,
    ServedFolder,
)
from counterspin.campaign.documents import DESCRIPTION_NAME, load_document
from counterspin.errors import CounterspinError, ExistingFileError, WriteError
from counterspin.frozen import frozen
from counterspin.ingest.description import draft_further_runs
from counterspin.output import make_folder, move_into_place
from counterspin.records.format_registry import suffix_problem
from counterspin.temporary_folders import remove_abandoned_folders, temporary_folder

#: Prefixes of the temporary folders for copies of campaigns and for uploads.
COPY_PREFIX: Final = ".counterspin-copy-"
_UPLOAD_PREFIX: Final = ".counterspin-upload-"


@frozen
class Upload:
    """A file that is being uploaded."""

    path: Path  #: Final path.
    temporary_path: Path  #: New file for the content, in a temporary folder next to the path.
    cleanup: ExitStack  #: Removes the temporary folder.
    created_folders: tuple[Path, ...]  #: Folders created for the file, the innermost first.

    def discard(self) -> None:
        """Remove the remains of an incomplete upload."""
        self.cleanup.close()
        for folder in self.created_folders:
            with suppress(OSError):  # the folder is not empty
                folder.rmdir()


def open_upload(app: AppState, name: str) -> Upload:
    """Create the temporary file of an upload."""
    path = app.folder.path(name)
    if problem := suffix_problem(path):
        raise PathForbiddenError(f"{name}: {problem}")
    folders = tuple(folder for folder in path.parents if not folder.exists())
    make_folder(path.parent)
    cleanup = ExitStack()
    try:
        folder = cleanup.enter_context(temporary_folder(_UPLOAD_PREFIX, path.parent))
        temporary_path = folder / "part"
        temporary_path.touch()
    except OSError as error:
        cleanup.close()
        raise WriteError(f"{name} cannot be written ({error.strerror})") from error
    return Upload(path, temporary_path, cleanup, folders)


def complete_upload(app: AppState, upload: Upload) -> StoredFile:
    """Rename a complete upload; CounterspinError if a file with other content has the name."""
    n_bytes = upload.temporary_path.stat().st_size
    if upload.path.is_file() and filecmp.cmp(upload.temporary_path, upload.path, shallow=False):
        upload.temporary_path.unlink()  # the same file was uploaded again
    else:
        move_into_place(upload.temporary_path, upload.path)
    return {"name": app.folder.name(upload.path), "bytes": n_bytes}


#: Hidden folder for removed campaigns.
TRASH_FOLDER: Final = ".counterspin-trash"

#: Name of a folder in the trash: time of removal, and former name, with % and / percent-encoded.
_TRASH_NAME: Final = re.compile(r"\d{8}T\d{12}-(?P<name>.+)")


def remove_remnants(served_folder: ServedFolder) -> None:
    """Remove incomplete uploads and copies that killed servers left behind."""
    for folder, _ in served_folder.folders():
        for prefix in (COPY_PREFIX, _UPLOAD_PREFIX):
            remove_abandoned_folders(prefix, folder)


def copy_campaign(app: AppState, name: str, to: str) -> NameAnswer:
    """Copy a campaign's folder, with records and results; return the copy's name."""
    source, target = _campaign_folder(app, name), _check_new_folder(app, name, to)
    try:
        with temporary_folder(COPY_PREFIX, target.parent) as temporary_parent:
            copied_folder = shutil.copytree(
                source, temporary_parent / target.name, ignore=shutil.ignore_patterns(".*")
            )
            copied_folder.rename(target)
    except OSError as error:
        raise WriteError(f"{to} cannot be written ({error.strerror or error})") from error
    return {"name": app.folder.name(target)}


def rename_campaign(app: AppState, name: str, to: str) -> NameAnswer:
    """Rename a campaign's folder; return the new name."""
    source, target = _idle_campaign_folder(app, name), _check_new_folder(app, name, to)
    _move_path(source, target)
    return {"name": app.folder.name(target)}


def move_to_trash(app: AppState, name: str) -> TrashPlace:
    """Move a campaign's folder to the trash; return its new path."""
    source = _idle_campaign_folder(app, name)
    target = _trash_path(app, source)
    make_folder(target.parent)
    _move_path(source, target)
    return {"place": target.name}


def discard_uploads(app: AppState, folder: str, names: list[str]) -> TrashPlace:
    """Move the files of an unfinished import to the trash; return the name of their folder there.

    names: Names of the files, relative to the served folder; missing files are skipped.
    """
    source = app.folder.path(folder)
    paths = [app.folder.path(name) for name in dict.fromkeys(names)]
    if source == app.folder.root or any(path.parent != source for path in paths):
        raise PathForbiddenError("only files in the import folder can be discarded")
    if (source / DESCRIPTION_NAME).exists():
        raise ExistingFileError(f"{folder} is a campaign, so its files were not discarded")
    files = [path for path in paths if path.is_file() and not path.is_symlink()]
    if not files:
        return {"place": None}
    target = _trash_path(app, source)
    make_folder(target)
    for file in files:
        _move_path(file, target / file.name)
    with suppress(OSError):  # a folder with further files remains
        source.rmdir()
    return {"place": target.name}


def _trash_path(app: AppState, source: Path) -> Path:
    """Return a new path in the trash; its name contains the names of the parent folders."""
    timestamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S%f")
    # Encoding other characters, too, would make long names in many scripts too long.
    name = app.folder.name(source).replace("%", "%25").replace("/", "%2F")
    return app.folder.root / TRASH_FOLDER / f"{timestamp}-{name}"


def list_trash(app: AppState) -> list[TrashEntry]:
    """Return name in the trash and former name of each campaign, the latest first."""
    trash_folder = app.folder.root / TRASH_FOLDER
    # A link to another folder is not the trash.
    is_own_folder = trash_folder.is_dir() and app.folder.contains(trash_folder)
    paths = sorted(trash_folder.iterdir(), reverse=True) if is_own_folder else []
    return [
        {"place": path.name, "name": unquote(match["name"])}
        for path in paths
        if (match := _TRASH_NAME.fullmatch(path.name))
    ]


def restore_campaign(app: AppState, place: str) -> RestoredFolder:
    """Restore a folder from the trash under its former name, with a number if the name is taken.

    place: Name of the folder in the trash.

    Returns the folder's name, and the names of the files of an unfinished import.
    """
    original_name = {entry["place"]: entry["name"] for entry in list_trash(app)}.get(place)
    if original_name is None:
        raise NotFoundError(f"{place} is not in the trash")
    target = app.folder.path(find_free_name(app, original_name))
    make_folder(target.parent)
    _move_path(app.folder.root / TRASH_FOLDER / place, target)
    is_campaign = (target / DESCRIPTION_NAME).exists()
    files = [] if is_campaign else sorted(path for path in target.iterdir() if path.is_file())
    return {"name": app.folder.name(target), "files": [app.folder.name(file) for file in files]}


def find_free_name(app: AppState, name: str) -> str:
    """Return the name, with the first free number appended if a folder has the name."""
    names = (name if number == 1 else f"{name}-{number}" for number in range(1, 1000))
    return next(candidate for candidate in names if not app.folder.path(candidate).exists())


def add_records(app: AppState, name: str, files: list[str]) -> AddedRuns:
    """Add a run to a campaign for each new record; return sentences on the runs.

    files: Names of the records, relative to the served folder.
    """
    description = app.description_path(name)
    description_text = app.folder.read(app.folder.name(description))
    document = load_document(description)
    app.require_inside(description.parent, document)
    runs = [run for run in document.get("runs", []) if isinstance(run, dict)]
    if not runs or "record" not in runs[0]:
        raise RequestError(
            "this campaign uses readings, not records; add your readings to the readings table"
        )
    known_records = {(description.parent / str(run.get("record"))).resolve() for run in runs}
    new_files = [file for file in map(app.file, files) if file.resolve() not in known_records]
    text = description_text.text
    new_runs = draft_further_runs(new_files, document, description.parent) if new_files else []
    for index, run in enumerate(new_runs, len(runs)):
        text = set_value(text, ["runs", index], run)
    if new_runs:
        if problems := parse_campaign_text(app, description, text).problems:
            raise CounterspinError(": ".join(problems[0]), code="invalid-value")
        app.folder.write(app.folder.name(description), text, description_text.version)
    return {"added": [f"{run['name']} at {run['rate']}" for run in new_runs]}


def _campaign_folder(app: AppState, name: str) -> Path:
    """Return a campaign's folder; PathForbiddenError if it contains or is a link."""
    source = app.description_path(name).parent
    if source == app.folder.root:
        raise RequestError(
            "this campaign is the served folder itself; use your file manager to copy or move "
            "the folder"
        )
    if app.folder.root.joinpath(*Path(name).parts).is_symlink():
        raise PathForbiddenError(
            f"{name} is a link to a folder; the application does not move or copy links"
        )
    for path in source.rglob("*"):
        if path.is_symlink():
            raise PathForbiddenError(
                f"{app.folder.name(path)} is a link; copy or move the campaign manually"
            )
    return source


def _idle_campaign_folder(app: AppState, name: str) -> Path:
    """Return a campaign's folder; RequestError if a job is running in it."""
    source = _campaign_folder(app, name)
    active_jobs = [job for job in app.jobs.all() if job.state in ("waiting", "running")]
    if any(job.campaign == name or job.campaign.startswith(f"{name}/") for job in active_jobs):
        raise RequestError(
            f"{name}: a job is running in this campaign; stop it, or wait until it ends"
        )
    return source


def _check_new_folder(app: AppState, name: str, to: str) -> Path:
    """Return a free folder for a campaign from which relative paths to its records stay valid."""
    target = app.folder.path(to)
    if target == app.folder.root or target.exists():
        raise RequestError(f"{to or 'this folder'} already exists; choose another name")
    source = app.description_path(name).parent
    if target.is_relative_to(source):
        raise RequestError(f"{to} is inside {name}; choose a folder outside {name}")
    try:
        uses_outside_files = ".." in str(load_document(source / DESCRIPTION_NAME))
    except CounterspinError:
        uses_outside_files = True  # an unreadable description may refer to any file
    if uses_outside_files and target.parent != source.parent:
        raise RequestError(
            f"{name}: the description uses relative paths to files outside the campaign folder; "
            "choose a destination in the same parent folder"
        )
    make_folder(target.parent)
    return target


def _move_path(source: Path, target: Path) -> None:
    try:
        source.rename(target)
    except OSError as error:
        raise WriteError(f"{source.name} cannot be moved ({error.strerror})") from error
