"""Campaigns from mappings and arrays, and campaigns written as a folder."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from counterspin.campaign.description import Campaign
from counterspin.campaign.documents import (
    CAMPAIGN_ADVICE,
    DESCRIPTION_NAME,
    KeyPath,
    Source,
    description_file,
    find_invalid_values,
    is_inside_folder,
    list_of,
    load_with_checksum,
    merge_patch,
    require_source,
    to_toml_value,
)
from counterspin.campaign.validation import Problems, suggest_name
from counterspin.errors import CampaignError, CounterspinError, ExistingFileError
from counterspin.loading import load_name
from counterspin.output import make_folder, write_atomically, write_binary, write_text
from counterspin.records.memory import MemoryTable, make_memory_table
from counterspin.toml_text import format_document

if TYPE_CHECKING:
    import polars as pl

#: Name of the record at rest among the records of runs: its key in the description.
STATIC_RECORD_KEY: Final = "noise.from"

#: Function that inserts a table of readings from a data frame.
_INSERT_READINGS: Final = "counterspin.readings.table:insert_readings"

#: File extension -> function that writes a record.
WRITERS: Final[Mapping[str, Callable[[pl.DataFrame, Path], object]]] = {
    ".csv": lambda frame, path: write_binary(path, frame.write_csv),
    ".parquet": lambda frame, path: write_binary(path, frame.write_parquet),
}


def make_campaign(
    description: Mapping[str, Any] | Path | str,
    records: Mapping[str, Any] | None = None,
    *,
    readings: Any = None,
    folder: Path | str | None = None,
) -> Campaign:
    """Make a campaign from a description and records in memory or in files.

    Parameters
    ----------
    description
        Contents of ``campaign.toml`` as nested mappings with the same keys, or the path of the
        file. ``schema`` may be omitted, and so may the ``record`` of a run if `records` contains
        it, or if there are no records yet. Quantities are text, or a `Quantity`.
    records
        Name of a run -> record: a frame of polars or pandas, a mapping of arrays, a structured
        array, or a file. Numbers are copied. ``"noise.from"`` -> record at rest, from which the
        noise is estimated.
    readings
        Table of ``[readings]`` as a data frame, in place of its ``file``; each row becomes a run,
        which `Campaign.write` writes as such.
    folder
        Folder of the files that the description names; None: the folder of the description, or
        the current folder.

    Returns
    -------
    Campaign
        The campaign, as from `read_campaign`.

    Raises
    ------
    CampaignError
        With every mistake of the description, as for a file.
    RecordError
        If a data frame is not a record.
    """
    source, files_folder = _load_source(description, folder)
    document = dict(source.document)
    problems = Problems(document)
    if readings is not None:
        load_name(_INSERT_READINGS)(document, readings, problems)
        if problems.lines:
            raise CampaignError(source.label, problems.lines)
    if records is None:
        assign_filenames(document)
    tables = attach_records(document, records or {}, files_folder, problems)
    return Campaign.of(replace(source, document=document), files_folder, tables, problems)


def _load_source(
    description: Mapping[str, Any] | Path | str, folder: Path | str | None
) -> tuple[Source, Path]:
    """Return the source of a description, and the folder of its files."""
    if isinstance(description, Mapping):
        files_folder = Path(folder if folder is not None else ".").absolute()
        problems = Problems(description)
        document = {"schema": 1} | to_toml_value(description, (), problems.add)
        problems.lines += find_invalid_values(document, "")
        source = Source(document)
        if problems.lines:
            raise CampaignError(source.label, problems.lines)
        return source, files_folder
    file = description_file(description).absolute()
    document, checksum = load_with_checksum(file, CAMPAIGN_ADVICE, "campaign")
    files_folder = file.parent if folder is None else Path(folder).absolute()
    return Source(document, file, checksum, document), files_folder


def change_campaign(
    campaign: Campaign, patch: Mapping[str, Any], records: Mapping[str, Any]
) -> tuple[dict[str, Any], dict[Path, MemoryTable]]:
    """Return a campaign's document with a merge patch, and the records in memory by file."""
    source = require_source(campaign)
    label = source.label if source.file is None else f"{source.file}, changed in memory"
    problems = Problems(source.document)
    document = merge_patch(source.document, _convert_patch(patch, (), problems))
    tables = attach_records(document, records, campaign.folder, problems)
    if problems.lines:
        raise CampaignError(label, problems.lines)
    return document, tables


def _convert_patch(value: Any, path: KeyPath, problems: Problems) -> Any:
    """Convert a merge patch to TOML values; None stays in tables, where it removes keys."""
    if not isinstance(value, Mapping):
        return to_toml_value(value, path, problems.add)
    return {
        key: None if item is None else _convert_patch(item, (*path, key), problems)
        for key, item in value.items()
    }


def copy_record(record: Path | MemoryTable, target: Path, *, overwrite: bool) -> None:
    """Write an existing record, in memory or in a file, to another file."""
    if isinstance(record, MemoryTable):
        write = partial(WRITERS[target.suffix.lower()], record.frame())
    else:
        write = partial(shutil.copyfile, record)
    write_atomically(target, write, overwrite=overwrite)


def assign_filenames(document: dict[str, Any]) -> None:
    """Assign a record name to each run without one, before the records exist."""
    runs = document.get("runs")
    if not isinstance(runs, list):
        return
    used_names = [run.get("record") for run in runs if isinstance(run, Mapping)]
    named_runs: list[Any] = []
    for run in runs:
        is_named = isinstance(run, Mapping) and isinstance(run.get("name"), str)
        if is_named and "record" not in run and "reading" not in run:
            used_names.append(unused_file_name(run["name"], ".parquet", used_names))
            named_runs.append({**run, "record": used_names[-1]})
        else:
            named_runs.append(run)
    document["runs"] = named_runs


def attach_records(
    document: dict[str, Any], records: Mapping[str, Any], folder: Path, problems: Problems
) -> dict[Path, MemoryTable]:
    """Put records into a document's runs; return those in memory by the file that each replaces.

    records: Name of a run -> data frame or file; `STATIC_RECORD_KEY` -> record at rest.
    folder: Folder of the document's files.
    """
    runs = list(list_of(document, "runs"))
    indices = {run.get("name"): index for index, run in enumerate(runs) if isinstance(run, Mapping)}
    tables: dict[Path, MemoryTable] = {}
    for name, record in records.items():
        if name == STATIC_RECORD_KEY:
            tables |= _attach_static_record(document, record, folder)
            continue
        if name not in indices:
            run_names = [run_name for run_name in indices if isinstance(run_name, str)]
            problems.add(
                ("records",),
                f'no run is named "{name}"' + suggest_name(name, run_names),
                "unknown-run",
            )
            continue
        run = dict(runs[indices[name]])
        if isinstance(record, Path | str):
            run["record"] = _relative_name(Path(record).absolute(), folder)
        else:
            used_names = [run.get("record") for run in runs if isinstance(run, Mapping)]
            stated_name = run.get("record")
            if not (isinstance(stated_name, str) and stated_name.lower().endswith(tuple(WRITERS))):
                run["record"] = unused_file_name(name, ".parquet", used_names)
            tables[folder / run["record"]] = make_memory_table(f"{name} in memory", record)
        runs[indices[name]] = run
    if runs:
        document["runs"] = runs
    return tables


def _attach_static_record(
    document: dict[str, Any], record: Any, folder: Path
) -> dict[Path, MemoryTable]:
    """Put a record at rest into a document's noise; return it by file if it is in memory."""
    noise = document.get("noise", {})
    if not isinstance(noise, Mapping):
        return {}  # reported with the other mistakes
    if isinstance(record, Path | str):
        document["noise"] = {**noise, "from": _relative_name(Path(record).absolute(), folder)}
        return {}
    file_name = noise.get("from")
    if not (isinstance(file_name, str) and file_name.lower().endswith(tuple(WRITERS))):
        runs = document.get("runs")
        used_names = [run.get("record") for run in runs or () if isinstance(run, Mapping)]
        file_name = unused_file_name("rest", ".parquet", used_names)
    document["noise"] = {**noise, "from": file_name}
    return {folder / file_name: make_memory_table("record at rest in memory", record)}


def unused_file_name(run: str, suffix: str, used_names: list[Any]) -> str:
    """Return a file name for the record of a run that is not among the used names."""
    base_name = re.sub(r"[^\w.-]+", "_", run).strip("._") or "run"
    lowercase_names = {str(used_name).lower() for used_name in used_names}
    name, number = f"{base_name}{suffix}", 2
    while name.lower() in lowercase_names:
        name, number = f"{base_name}-{number}{suffix}", number + 1
    return name


def _relative_name(file: Path, folder: Path) -> str:
    try:
        return file.relative_to(folder).as_posix()
    except ValueError:
        return str(file)


def write_campaign(campaign: Campaign, folder: Path | str, *, overwrite: bool = False) -> Path:
    """Write a campaign; see `Campaign.write`."""
    source = require_source(campaign)
    folder = Path(folder)
    document = dict(source.document)
    relocated_files = _RelocatedFiles(campaign, folder)
    document["runs"] = [relocated_files.relocate_run(run) for run in document.get("runs", ())]
    if not document["runs"]:
        del document["runs"]
    for table in campaign.tables:
        if table.is_relative_to(campaign.folder):
            relocated_files.targets.setdefault(folder / table.relative_to(campaign.folder), table)
    if campaign.rest is not None:
        noise = document["noise"]
        document["noise"] = {**noise, "from": relocated_files.target_name(noise["from"], "rest")}
    description = folder / DESCRIPTION_NAME
    _refuse_overwriting([description, *relocated_files.targets], campaign, overwrite=overwrite)
    for target, record in relocated_files.targets.items():
        make_folder(target.parent)
        if isinstance(record, MemoryTable) or not (target.exists() and target.samefile(record)):
            copy_record(record, target, overwrite=overwrite)
    make_folder(folder)
    is_unchanged = not source.in_memory and document == source.document
    if is_unchanged and source.file is not None:
        if not (description.exists() and description.samefile(source.file)):
            write_atomically(
                description, partial(shutil.copyfile, source.file), overwrite=overwrite
            )
    else:
        write_text(description, format_document(document), overwrite=overwrite)
    return description


class _RelocatedFiles:
    """Assigns names to a campaign's files in another folder."""

    def __init__(self, campaign: Campaign, folder: Path) -> None:
        self.campaign, self.folder = campaign, folder
        self.targets: dict[Path, Path | MemoryTable] = {}

    def target_name(self, name: str, owner: str) -> str:
        """Register a file and return its new name; a conflict is resolved by the owner's name."""
        source_folder, folder = self.campaign.folder, self.folder
        file = source_folder / name
        record = self.campaign.record_at(file)
        is_inside = is_inside_folder(file, source_folder)
        relative_name = name if is_inside else file.name
        if is_inside and Path(name).is_absolute():
            relative_name = file.relative_to(source_folder).as_posix()
        if record is file and self.targets.get(folder / relative_name) == file:
            return relative_name  # another part of the same record
        used_names = [target.relative_to(folder).as_posix() for target in self.targets]
        if relative_name.lower() in map(str.lower, used_names):
            relative_name = unused_file_name(owner, file.suffix, used_names)
        self.targets[folder / relative_name] = record
        return relative_name

    def relocate_run(self, run: Any) -> Any:
        """Register the files of a run, and return the run with their new names."""
        if "record" not in run:
            return run
        # An excluded run may lack a name.
        name, new_run = str(run.get("name", "run")), dict(run)
        new_run["record"] = self.target_name(run["record"], name)
        if "continued_in" in run:
            new_run["continued_in"] = [self.target_name(file, name) for file in run["continued_in"]]
        if "pulses" in run:
            new_run["pulses"] = self.target_name(run["pulses"], name)
        return new_run


def _refuse_overwriting(targets: list[Path], campaign: Campaign, *, overwrite: bool) -> None:
    """Raise CounterspinError if a target already exists, or if a record is missing."""
    for target in targets:
        if target.exists() and not overwrite:
            raise ExistingFileError(
                f"{target} already exists; choose another folder, or use `overwrite=True`"
            )
    for file in (*campaign.files, *filter(None, [campaign.rest])):
        record = campaign.record_at(file)
        if isinstance(record, Path) and not record.is_file():
            raise CounterspinError(f"{record}: file not found", code="file-not-found")
