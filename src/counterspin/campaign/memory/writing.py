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
    files = _Files(campaign, folder)
    document["runs"] = [files.run_placed(run) for run in document.get("runs", ())]
    if not document["runs"]:
        del document["runs"]
    for table in campaign.tables:
        if table.is_relative_to(campaign.folder):
            files.targets.setdefault(folder / table.relative_to(campaign.folder), table)
    if campaign.rest is not None:
        noise = document["noise"]
        document["noise"] = {**noise, "from": files.placed(noise["from"], "rest")}
    description = folder / DESCRIPTION_NAME
    _refuse_overwriting([description, *files.targets], campaign, overwrite=overwrite)
    for target, record in files.targets.items():
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


class _Files:
    """Where the files of a campaign go in another folder."""

    def __init__(self, campaign: Documented, folder: Path) -> None:
        self.campaign, self.folder = campaign, folder
        self.targets: dict[Path, Path | MemoryTable] = {}

    def placed(self, name: str, owner: str) -> str:
        """Note where a file goes, and return its name there: the owner's where its own is taken."""
        source, folder = self.campaign.folder, self.folder
        file = source / name
        record = self.campaign.record_at(file)
        inside = file.is_relative_to(source) and ".." not in file.parts
        there = name if inside else file.name
        if inside and Path(name).is_absolute():
            there = file.relative_to(source).as_posix()
        if record is file and self.targets.get(folder / there) == file:
            return there  # of another part of the same record
        taken = [target.relative_to(folder).as_posix() for target in self.targets]
        if there.lower() in map(str.lower, taken):
            there = record_name(owner, file.suffix, taken)
        self.targets[folder / there] = record
        return there

    def run_placed(self, run: Any) -> Any:
        """Note where a run's files go, and return the run as it names them there."""
        if "record" not in run:
            return run
        # A run that is left out need not have a name.
        name, now = str(run.get("name", "run")), dict(run)
        now["record"] = self.placed(run["record"], name)
        if "continued_in" in run:
            now["continued_in"] = [self.placed(file, name) for file in run["continued_in"]]
        if "pulses" in run:
            now["pulses"] = self.placed(run["pulses"], name)
        return now


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
