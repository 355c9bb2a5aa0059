"""Records of a document that are in memory, and the files that stand for them."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from counterspin.campaign.checking import Problems, did_you_mean
from counterspin.output import write_open
from counterspin.records.memory import MemoryTable, memory_table

if TYPE_CHECKING:
    import polars as pl

#: How the record of each ending is written.
WRITERS: Final[Mapping[str, Callable[[pl.DataFrame, Path], object]]] = {
    ".csv": lambda frame, path: write_open(path, frame.write_csv),
    ".parquet": lambda frame, path: write_open(path, frame.write_parquet),
}


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

    records: Run's name -> frame or file.
    folder: Of the document's files.
    """
    runs = document.get("runs")
    given = list(runs) if isinstance(runs, list) else []
    names = {run.get("name"): place for place, run in enumerate(given) if isinstance(run, Mapping)}
    tables = {}
    for name, record in records.items():
        if name not in names:
            known = [known for known in names if isinstance(known, str)]
            problems.add(("records",), f'no run is called "{name}"' + did_you_mean(name, known))
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
    if records:
        document["runs"] = given
    return tables


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
