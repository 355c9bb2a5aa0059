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
from counterspin.records.memory import MemoryTable, memory_table
from counterspin.toml_text import format_document

if TYPE_CHECKING:
    import polars as pl

#: Name of the record at rest among the records of runs: its key in the description.
STATIC_RECORD: Final = "noise.from"

#: The function that takes a table of readings from a frame.
_INSERT_READINGS: Final = "counterspin.readings.table:insert_readings"

#: How the record of each ending is written.
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
    """Make a campaign from a description and records, without files where there are none.

    Parameters
    ----------
    description
        What ``campaign.toml`` says, as nested mappings with the same keys; ``schema`` may be left
        out, and so may the ``record`` of a run for which `records` has one, or of each where
        there are no records (yet). Quantities are text, or a `Quantity`. Or the file itself.
    records
        Run's name -> its record: a frame of polars or pandas, a mapping of arrays, a structured
        array, or a file. Numbers are copied. ``"noise.from"`` -> a record at rest, from which the
        noise is taken.
    readings
        The table of ``[readings]`` as a frame, in the place of its ``file``; each of its rows
        becomes a run, as which `Campaign.write` writes it.
    folder
        Where the files are that the description names; None: the current one, or the file's.

    Returns
    -------
    Campaign
        As `read_campaign` returns it.

    Raises
    ------
    CampaignError
        With every mistake of the description, as for a file.
    RecordError
        If a frame cannot be taken for a record.
    """
    source, where = _source(description, folder)
    document = dict(source.document)
    problems = Problems(document)
    if readings is not None:
        load_name(_INSERT_READINGS)(document, readings, problems)
        if problems.lines:
            raise CampaignError(source.label, problems.lines)
    if records is None:
        assign_filenames(document)
    tables = attach_records(document, records or {}, where, problems)
    return Campaign.of(replace(source, document=document), where, tables, problems)


def _source(
    description: Mapping[str, Any] | Path | str, folder: Path | str | None
) -> tuple[Source, Path]:
    """Return the source of a description, and the folder of its files."""
    if isinstance(description, Mapping):
        where = Path(folder if folder is not None else ".").absolute()
        problems = Problems(description)
        document = {"schema": 1} | to_toml_value(description, (), problems.add)
        problems.lines += find_invalid_values(document, "")
        source = Source(document)
        if problems.lines:
            raise CampaignError(source.label, problems.lines)
        return source, where
    file = description_file(description).absolute()
    document, checksum = load_with_checksum(file, CAMPAIGN_ADVICE, "campaign")
    where = file.parent if folder is None else Path(folder).absolute()
    return Source(document, file, checksum, document), where


def change_campaign(
    campaign: Campaign, patch: Mapping[str, Any], records: Mapping[str, Any]
) -> tuple[dict[str, Any], dict[Path, MemoryTable]]:
    """Return a campaign's document with a merge patch, and the records in memory by file."""
    source = require_source(campaign)
    label = source.label if source.file is None else f"{source.file}, changed in memory"
    problems = Problems(source.document)
    document = merge_patch(source.document, _plain_patch(patch, (), problems))
    tables = attach_records(document, records, campaign.folder, problems)
    if problems.lines:
        raise CampaignError(label, problems.lines)
    return document, tables


def _plain_patch(value: Any, path: KeyPath, problems: Problems) -> Any:
    """Return a value as TOML would be read; None stays in tables, where it removes keys."""
    if not isinstance(value, Mapping):
        return to_toml_value(value, path, problems.add)
    return {
        key: None if inner is None else _plain_patch(inner, (*path, key), problems)
        for key, inner in value.items()
    }


def copy_record(record: Path | MemoryTable, target: Path, *, overwrite: bool) -> None:
    """Write a record that is there, in memory or as a file, to another place."""
    if isinstance(record, MemoryTable):
        write = partial(WRITERS[target.suffix.lower()], record.frame())
    else:
        write = partial(shutil.copyfile, record)
    write_atomically(target, write, overwrite=overwrite)


def assign_filenames(document: dict[str, Any]) -> None:
    """Name a record for each run that states none, for what needs none or makes it."""
    runs = document.get("runs")
    if not isinstance(runs, list):
        return
    taken = [run.get("record") for run in runs if isinstance(run, Mapping)]
    named: list[Any] = []
    for run in runs:
        table = isinstance(run, Mapping) and isinstance(run.get("name"), str)
        if table and "record" not in run and "reading" not in run:
            taken.append(record_name(run["name"], ".parquet", taken))
            named.append({**run, "record": taken[-1]})
        else:
            named.append(run)
    document["runs"] = named


def attach_records(
    document: dict[str, Any], records: Mapping[str, Any], folder: Path, problems: Problems
) -> dict[Path, MemoryTable]:
    """Put records into a document's runs; return those in memory by the file that each replaces.

    records: Run's name -> frame or file; `AT_REST` -> that of the record at rest.
    folder: Of the document's files.
    """
    given = list(list_of(document, "runs"))
    names = {run.get("name"): place for place, run in enumerate(given) if isinstance(run, Mapping)}
    tables: dict[Path, MemoryTable] = {}
    for name, record in records.items():
        if name == STATIC_RECORD:
            tables |= _attach_static_record(document, record, folder)
            continue
        if name not in names:
            known = [known for known in names if isinstance(known, str)]
            problems.add(
                ("records",), f'no run is named "{name}"' + suggest_name(name, known), "unknown-run"
            )
            continue
        run = dict(given[names[name]])
        if isinstance(record, Path | str):
            run["record"] = _file_name(Path(record).absolute(), folder)
        else:
            taken = [other.get("record") for other in given if isinstance(other, Mapping)]
            stated = run.get("record")
            if not (isinstance(stated, str) and stated.lower().endswith(tuple(WRITERS))):
                run["record"] = record_name(name, ".parquet", taken)
            tables[folder / run["record"]] = memory_table(f"{name} in memory", record)
        given[names[name]] = run
    if given:
        document["runs"] = given
    return tables


def _attach_static_record(
    document: dict[str, Any], record: Any, folder: Path
) -> dict[Path, MemoryTable]:
    """Put a record at rest into a document's noise; return it by its file where it is in memory."""
    noise = document.get("noise", {})
    if not isinstance(noise, Mapping):
        return {}  # which is a mistake that is told with all others
    if isinstance(record, Path | str):
        document["noise"] = {**noise, "from": _file_name(Path(record).absolute(), folder)}
        return {}
    stated = noise.get("from")
    if not (isinstance(stated, str) and stated.lower().endswith(tuple(WRITERS))):
        runs = document.get("runs")
        taken = [r.get("record") for r in runs or () if isinstance(r, Mapping)]
        stated = record_name("rest", ".parquet", taken)
    document["noise"] = {**noise, "from": stated}
    return {folder / stated: memory_table("record at rest in memory", record)}


def record_name(run: str, ending: str, taken: list[Any]) -> str:
    """Return the file that the record of a run would be written to, none of those taken."""
    plain_name = re.sub(r"[^\w.-]+", "_", run).strip("._") or "run"
    others = {str(other).lower() for other in taken}
    name, number = f"{plain_name}{ending}", 2
    while name.lower() in others:
        name, number = f"{plain_name}-{number}{ending}", number + 1
    return name


def _file_name(file: Path, folder: Path) -> str:
    try:
        return file.relative_to(folder).as_posix()
    except ValueError:
        return str(file)


def write_campaign(campaign: Campaign, folder: Path | str, *, overwrite: bool = False) -> Path:
    """Write a campaign; see `Campaign.write`."""
    source = require_source(campaign)
    folder = Path(folder)
    document = dict(source.document)
    files = _Files(campaign, folder)
    document["runs"] = [files.relocate_run(run) for run in document.get("runs", ())]
    if not document["runs"]:
        del document["runs"]
    for table in campaign.tables:
        if table.is_relative_to(campaign.folder):
            files.targets.setdefault(folder / table.relative_to(campaign.folder), table)
    if campaign.rest is not None:
        noise = document["noise"]
        document["noise"] = {**noise, "from": files.target_name(noise["from"], "rest")}
    description = folder / DESCRIPTION_NAME
    _refuse_overwriting([description, *files.targets], campaign, overwrite=overwrite)
    for target, record in files.targets.items():
        make_folder(target.parent)
        if isinstance(record, MemoryTable) or not (target.exists() and target.samefile(record)):
            copy_record(record, target, overwrite=overwrite)
    make_folder(folder)
    unchanged = not source.in_memory and document == source.document
    if unchanged and source.file is not None:
        if not (description.exists() and description.samefile(source.file)):
            write_atomically(
                description, partial(shutil.copyfile, source.file), overwrite=overwrite
            )
    else:
        write_text(description, format_document(document), overwrite=overwrite)
    return description


class _Files:
    """The names of a campaign's files in another folder."""

    def __init__(self, campaign: Campaign, folder: Path) -> None:
        self.campaign, self.folder = campaign, folder
        self.targets: dict[Path, Path | MemoryTable] = {}

    def target_name(self, name: str, owner: str) -> str:
        """Note where a file goes, and return its name there: the owner's where its own is taken."""
        source, folder = self.campaign.folder, self.folder
        file = source / name
        record = self.campaign.record_at(file)
        is_inside = file.is_relative_to(source) and ".." not in file.parts
        relative_name = name if is_inside else file.name
        if is_inside and Path(name).is_absolute():
            relative_name = file.relative_to(source).as_posix()
        if record is file and self.targets.get(folder / relative_name) == file:
            return relative_name  # of another part of the same record
        taken = [target.relative_to(folder).as_posix() for target in self.targets]
        if relative_name.lower() in map(str.lower, taken):
            relative_name = record_name(owner, file.suffix, taken)
        self.targets[folder / relative_name] = record
        return relative_name

    def relocate_run(self, run: Any) -> Any:
        """Note where a run's files go, and return the run as it names them there."""
        if "record" not in run:
            return run
        # A run that is left out need not have a name.
        name, relocated = str(run.get("name", "run")), dict(run)
        relocated["record"] = self.target_name(run["record"], name)
        if "continued_in" in run:
            relocated["continued_in"] = [
                self.target_name(file, name) for file in run["continued_in"]
            ]
        if "pulses" in run:
            relocated["pulses"] = self.target_name(run["pulses"], name)
        return relocated


def _refuse_overwriting(targets: list[Path], campaign: Campaign, *, overwrite: bool) -> None:
    """Raise CounterspinError for a file that is in the way, or a record that is not there."""
    for target in targets:
        if target.exists() and not overwrite:
            raise ExistingFileError(
                f"{target} already exists; choose another folder, or set `overwrite=True`"
            )
    for file in (*campaign.files, *filter(None, [campaign.rest])):
        record = campaign.record_at(file)
        if isinstance(record, Path) and not record.is_file():
            raise CounterspinError(f"{record}: file not found", code="file-not-found")
