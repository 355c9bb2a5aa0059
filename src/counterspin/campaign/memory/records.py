"""Records of a document that are in memory, and the files that stand for them."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from counterspin.campaign.checking import Problems, did_you_mean
from counterspin.campaign.toml_file import list_of
from counterspin.output import write_open, write_whole
from counterspin.records.memory import MemoryTable, memory_table

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
    """Put records into a document's runs; return those in memory by the file each stands for.

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
