"""A campaign in memory as a folder."""

from __future__ import annotations

import shutil
from functools import partial
from pathlib import Path
from typing import Any

from counterspin.campaign.memory.records import record_name, write_as_it_is
from counterspin.campaign.memory.source import Documented, source_of
from counterspin.campaign.toml_file import DESCRIPTION_NAME
from counterspin.errors import CounterspinError
from counterspin.output import make_folder, write_text, write_whole
from counterspin.records.memory import MemoryTable
from counterspin.toml_text import write_document


def write_campaign(campaign: Documented, folder: Path | str, *, overwrite: bool = False) -> Path:
    """Write a campaign; see `Campaign.write`."""
    source = source_of(campaign)
    folder = Path(folder)
    document = dict(source.document)
    targets: dict[Path, Path | MemoryTable] = {}
    document["runs"] = [_placed(campaign, folder, run, targets) for run in document.get("runs", ())]
    if not document["runs"]:
        del document["runs"]
    for table in campaign.tables:
        if table.is_relative_to(campaign.folder):
            targets.setdefault(folder / table.relative_to(campaign.folder), table)
    if campaign.rest is not None:
        name = _rest_placed(campaign, campaign.rest, folder, targets)
        document["noise"] = {**document["noise"], "from": name}
    description = folder / DESCRIPTION_NAME
    _refuse_overwriting([description, *targets], campaign, overwrite=overwrite)
    for target, record in targets.items():
        make_folder(target.parent)
        if isinstance(record, MemoryTable) or not (target.exists() and target.samefile(record)):
            write_as_it_is(record, target, overwrite=overwrite)
    make_folder(folder)
    unchanged = not source.in_memory and document == source.document
    if unchanged and source.file is not None:
        if not (description.exists() and description.samefile(source.file)):
            write_whole(description, partial(shutil.copyfile, source.file), overwrite=overwrite)
    else:
        write_text(description, write_document(document), overwrite=overwrite)
    return description


def _rest_placed(
    campaign: Documented, rest: Path, folder: Path, targets: dict[Path, Path | MemoryTable]
) -> str:
    """Note where the record at rest goes, and return its name there."""
    source, record = campaign.folder, campaign.record_at(rest)
    inside = rest.is_relative_to(source) and ".." not in rest.parts
    name = rest.relative_to(source).as_posix() if inside else rest.name
    taken = [target.relative_to(folder).as_posix() for target in targets]
    if name.lower() in map(str.lower, taken):
        name = record_name("rest", rest.suffix, taken)
    targets[folder / name] = record
    return name


def _placed(
    campaign: Documented, folder: Path, run: Any, targets: dict[Path, Path | MemoryTable]
) -> Any:
    """Note where a run's record goes, and return the run as it names it there."""
    if "record" not in run:
        return run
    file = campaign.folder / run["record"]
    inside = file.is_relative_to(campaign.folder) and ".." not in file.parts
    name = run["record"] if inside else file.name
    if inside and targets.get(folder / name) == file:
        return run  # of another part of the same record
    taken = [target.relative_to(folder).as_posix() for target in targets]
    if name.lower() in map(str.lower, taken):
        name = record_name(run["name"], file.suffix, taken)
    targets[folder / name] = campaign.record_at(file)
    further = _further_placed(campaign, folder, run, targets)
    return run if name == run["record"] and not further else {**run, "record": name, **further}


def _further_placed(
    campaign: Documented, folder: Path, run: Any, targets: dict[Path, Path | MemoryTable]
) -> dict[str, Any]:
    """Note where the other files of a run go; return the keys that name them differently there."""

    def placed(name: str) -> str:
        file = campaign.folder / name
        inside = file.is_relative_to(campaign.folder) and ".." not in file.parts
        taken = [target.relative_to(folder).as_posix() for target in targets]
        there = name if inside else file.name
        if there.lower() in map(str.lower, taken):
            there = record_name(run["name"], file.suffix, taken)
        targets[folder / there] = file
        return there

    now: dict[str, Any] = {}
    if "continued_in" in run:
        now["continued_in"] = [placed(name) for name in run["continued_in"]]
    if "pulses" in run:
        now["pulses"] = placed(run["pulses"])
    return {key: names for key, names in now.items() if names != run[key]}


def _refuse_overwriting(targets: list[Path], campaign: Documented, *, overwrite: bool) -> None:
    """Raise CounterspinError for a file that is in the way, or a record that is not there."""
    for target in targets:
        if target.exists() and not overwrite:
            raise CounterspinError(
                f"{target} exists; write into another folder, or give `overwrite=True`"
            )
    for file in (*campaign.files, *filter(None, [campaign.rest])):
        record = campaign.record_at(file)
        if isinstance(record, Path) and not record.is_file():
            raise CounterspinError(f"{record}: there is no such record to copy")
