"""Campaigns in memory: their records, and how they are joined and written as a folder."""

from __future__ import annotations

import copy
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol, TypeVar

from counterspin.campaign.accelerometers import Accelerometer
from counterspin.campaign.checking import Problems, did_you_mean
from counterspin.campaign.documents import DESCRIPTION_NAME, Source, differences, list_of
from counterspin.errors import CampaignError, CounterspinError
from counterspin.output import make_folder, write_open, write_text, write_whole
from counterspin.records.memory import MemoryTable, memory_table
from counterspin.toml_text import write_document

if TYPE_CHECKING:
    import polars as pl

#: Name of the record at rest among the records of runs: its key in the description.
AT_REST: Final = "noise.from"

#: How the record of each ending is written.
WRITERS: Final[Mapping[str, Callable[[pl.DataFrame, Path], object]]] = {
    ".csv": lambda frame, path: write_open(path, frame.write_csv),
    ".parquet": lambda frame, path: write_open(path, frame.write_parquet),
}


def write_as_it_is(record: Path | MemoryTable, target: Path, *, overwrite: bool) -> None:
    """Write a record that is there, in memory or as a file, to another place."""
    if isinstance(record, MemoryTable):
        write = partial(WRITERS[target.suffix.lower()], record.frame())
    else:
        write = partial(shutil.copyfile, record)
    write_whole(target, write, overwrite=overwrite)


def name_records(document: dict[str, Any]) -> None:
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


def give_records(
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
        if name == AT_REST:
            tables |= _give_rest(document, record, folder)
            continue
        if name not in names:
            known = [known for known in names if isinstance(known, str)]
            problems.add(("records",), f'there is no run "{name}"' + did_you_mean(name, known))
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


def _give_rest(document: dict[str, Any], record: Any, folder: Path) -> dict[Path, MemoryTable]:
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


class Documented(Protocol):
    """A campaign, as far as its document and its files are concerned."""

    @property
    def title(self) -> str:
        """The title in reports."""

    @property
    def path(self) -> Path:
        """The path of its description, or a substitute."""

    @property
    def folder(self) -> Path:
        """The folder of its files."""

    @property
    def source(self) -> Source | None:
        """The document that it was resolved from."""

    @property
    def accelerometers(self) -> Mapping[str, Accelerometer]:
        """The accelerometers by name."""

    @property
    def files(self) -> tuple[Path, ...]:
        """All record files."""

    @property
    def tables(self) -> tuple[Path, ...]:
        """Files of readings."""

    @property
    def rest(self) -> Path | None:
        """The record at rest that says the noise."""

    def record_at(self, file: Path) -> Path | MemoryTable:
        """Return the record in memory that replaces a file, or else the file."""


C = TypeVar("C", bound=Documented)


def source_of(campaign: Documented) -> Source:
    """Return the source of a campaign; CounterspinError if it is unknown."""
    if campaign.source is None:
        raise CounterspinError(
            f"{campaign.path}: the campaign was modified without `change`, so that "
            "its description is unknown; make all changes with `change`"
        )
    return campaign.source


def keep(campaign: C, source: Source) -> C:
    """Set the source of a campaign that has just been resolved, and return it.

    The source is not an argument of the class: a copy that `dataclasses.replace` changes has none.
    """
    object.__setattr__(campaign, "source", source)
    return campaign


# Joined

#: What all must have in common -> its key in the description.
_COMMON: Final = {
    "gravity": "site.gravity",
    "latitude": "site.latitude",
    "radius": "centrifuge.radius",
    "strapped": "centrifuge.strapped",
    "reference_temperature": "centrifuge.reference_temperature",
    "time": "records.time",
    "angle": "records.angle",
    "dialect": "records",
    "timing_offset": "records.timing_offset",
    "clock": "records.clock",
    "own_velocity": "records.reference",
    "noise": "noise",
    "rest": "noise.from",
    "specifications": "specification",
}

#: What each accelerometer must have in common with its namesakes.
_OF_EACH: Final = (
    "mounting",
    "observable",
    "channel",
    "priors",
    "serial_number",
    "output",
    "force",
    "grade",
)


def join_campaigns(
    campaigns: Sequence[Documented],
) -> tuple[dict[str, Any], dict[Path, MemoryTable]]:
    """Return one document with the runs of several campaigns, and the records in memory by file.

    It is for the folder of the first.
    """
    first = campaigns[0]
    problems = [
        p for place, other in enumerate(campaigns[1:], 2) for p in _apart(first, other, place)
    ]
    if problems:
        raise CampaignError("join", problems)
    document = copy.deepcopy(dict(source_of(first).document))
    if not all(_same_simulation(first, other) for other in campaigns[1:]):
        for key in ("truth", "simulation"):
            document.pop(key, None)
    runs: list[dict[str, Any]] = []
    tables: dict[Path, MemoryTable] = {}
    for place, campaign in enumerate(campaigns, 1):
        for run in copy.deepcopy(source_of(campaign).document.get("runs", [])):
            if "truth" not in document:
                run.pop("truth", None)
            run["name"] = _distinct(run["name"], place, [other["name"] for other in runs])
            for key in ("continued_in", "pulses"):
                if key in run and campaign.folder != first.folder:
                    names = run[key]
                    run[key] = (
                        str(campaign.folder / names)
                        if isinstance(names, str)
                        else [str(campaign.folder / name) for name in names]
                    )
            if "record" in run:
                _place_record(run, campaign, first.folder, runs, tables)
            runs.append(run)
    document["runs"] = runs
    titles = dict.fromkeys(campaign.title for campaign in campaigns if campaign.title)
    if titles:
        document["campaign"] = {**document.get("campaign", {}), "title": " + ".join(titles)}
    if first.rest is not None and isinstance(rest := first.record_at(first.rest), MemoryTable):
        tables[first.rest] = rest
    return document, tables


def _apart(first: Documented, other: Documented, place: int) -> Iterator[str]:
    """Yield what two campaigns would have to have in common, and have not."""
    words = f"is not the same in campaign {place}"
    for attribute, key in _COMMON.items():
        if getattr(first, attribute) != getattr(other, attribute):
            yield f"{key}: {words} ({_said(first, key)}, {_said(other, key)})"
    rest = [c.rest and c.record_at(c.rest) for c in (first, other)]
    in_memory = [one.checksum if isinstance(one, MemoryTable) else "" for one in rest]
    if first.rest == other.rest and in_memory[0] != in_memory[1]:
        yield f"noise.from: {words}"
    for name in dict.fromkeys([*first.accelerometers, *other.accelerometers]):
        one, two = first.accelerometers.get(name), other.accelerometers.get(name)
        if one is None or two is None:
            yield f"accelerometers.{name}: is not in campaign {1 if one is None else place}"
            continue
        unequal = [key for key in _OF_EACH if getattr(one, key) != getattr(two, key)]
        if unequal:
            yield f"accelerometers.{name}: {words} ({', '.join(unequal)})"
    for section in ("model", "centrifuge"):
        one, two = (source_of(c).document.get(section, {}) for c in (first, other))
        for key in differences(one, two, (section,)):
            if key != "centrifuge.radius":
                yield f"{key}: {words}"
    for number, campaign in ((1, first), (place, other)):
        if "readings" in source_of(campaign).document:
            yield f"readings: campaign {number} has a table of readings; write them as [[runs]]"


def _said(campaign: Documented, key: str) -> str:
    """Return a description's value at a key."""
    value: Any = source_of(campaign).document
    for part in key.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    return "nothing" if value is None else str(value)


def _same_simulation(first: Documented, other: Documented) -> bool:
    one, two = (source_of(c).document for c in (first, other))
    return all(one.get(key) == two.get(key) for key in ("truth", "simulation"))


def _distinct(name: str, place: int, taken: Sequence[str]) -> str:
    """Return a unique name of a run, with the number of its campaign if necessary."""
    new, number = name, place
    while new in taken:
        new, number = f"{name} ({number})", number + 1
    return new


def _place_record(
    run: dict[str, Any],
    campaign: Documented,
    folder: Path,
    runs: Sequence[Mapping[str, Any]],
    tables: dict[Path, MemoryTable],
) -> None:
    """Name a run's record as the joined campaign finds it, and take along what is in memory."""
    record = campaign.record_at(campaign.folder / run["record"])
    if isinstance(record, Path):
        inside = campaign.folder == folder
        run["record"] = run["record"] if inside else str(record)
        return
    taken = [other.get("record") for other in runs]
    ending = Path(run["record"]).suffix
    if str(run["record"]).lower() in {str(name).lower() for name in taken}:
        run["record"] = record_name(run["name"], ending, taken)
    tables[folder / run["record"]] = MemoryTable(
        f"{run['name']} in memory", record.columns, record.others
    )


# Written


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
    """The names of a campaign's files in another folder."""

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
