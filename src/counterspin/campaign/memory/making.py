"""Campaigns made in Python."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from counterspin.campaign.checking import Problems, did_you_mean
from counterspin.campaign.description import resolve_campaign
from counterspin.campaign.memory.documents import plain
from counterspin.campaign.memory.source import Source, keep
from counterspin.campaign.readings import Output
from counterspin.campaign.readings_table import ReadingsSettings, runs_of
from counterspin.campaign.resolved import Campaign
from counterspin.campaign.toml_file import (
    CAMPAIGN_ADVICE,
    DESCRIPTION_NAME,
    description_file,
    load_with_checksum,
    unusable,
)
from counterspin.errors import CampaignError
from counterspin.records.memory import MemoryTable, columns_of, memory_table

#: What messages call a table of readings without a file.
_IN_MEMORY: Final = "readings in memory"

#: Endings of the files that records in memory are written to.
WRITABLE: Final = (".csv", ".parquet")


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
        array, or a file. Numbers are copied.
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
        With every mistake of the description, as of a file.
    RecordError
        If a frame cannot be taken for a record.
    """
    source, where = _source(description, folder)
    document = dict(source.document)
    problems = Problems(document)
    if readings is not None:
        _take_readings(document, readings, problems)
        if problems.lines:
            raise CampaignError(source.label, problems.lines)
    if records is None:
        _name_records(document)
    tables = give_records(document, records or {}, where, problems)
    return resolved_in_memory(replace(source, document=document), tables, where, problems)


def _source(
    description: Mapping[str, Any] | Path | str, folder: Path | str | None
) -> tuple[Source, Path]:
    """Return where a description comes from, and the folder of its files."""
    if isinstance(description, Mapping):
        where = Path(folder if folder is not None else ".").absolute()
        problems = Problems(description)
        document = {"schema": 1} | plain(description, (), problems)
        problems.lines += unusable(document, "")
        source = Source(document)
        if problems.lines:
            raise CampaignError(source.label, problems.lines)
        return source, where
    file = description_file(description).absolute()
    document, checksum = load_with_checksum(file, CAMPAIGN_ADVICE, "campaign")
    where = file.parent if folder is None else Path(folder).absolute()
    return Source(document, file, checksum, document), where


def resolved_in_memory(
    source: Source, tables: Mapping[Path, MemoryTable], folder: Path, problems: Problems
) -> Campaign:
    """Return the campaign of a document; CampaignError with all its mistakes."""
    campaign = resolve_campaign(source.document, folder / DESCRIPTION_NAME, problems)
    if campaign is None or problems.lines:
        raise CampaignError(source.label, problems.lines)
    named = {run.record for run in campaign.runs} | {r.record for r in campaign.readings}
    made = replace(
        campaign,
        path=Path(source.label),
        title=campaign.title if source.file or "title" in _table(source, "campaign") else "",
        frames={path: table for path, table in tables.items() if path in named},
    )
    return keep(made, source)


def _table(source: Source, key: str) -> Mapping[str, Any]:
    value = source.document.get(key)
    return value if isinstance(value, Mapping) else {}


def _take_readings(document: dict[str, Any], frame: Any, problems: Problems) -> None:
    """Put the rows of a frame among a document's runs, by what its section of readings says."""
    raw = document.pop("readings", None)
    if not isinstance(raw, Mapping) or "file" in raw:
        said = "names a file; leave it out" if isinstance(raw, Mapping) else "is missing"
        problems.add(
            ("readings",),
            f"{said}: the table is given as a frame, and `columns` say which column is what",
        )
        return
    settings = problems.check(ReadingsSettings, {**raw, "file": _IN_MEMORY}, ("readings",))
    columns = {
        name: values.to_list() if hasattr(values, "to_list") else list(values)
        for name, values in columns_of(_IN_MEMORY, frame)
    }
    if settings is None:
        return
    if len({len(values) for values in columns.values()}) != 1:
        problems.add(("readings",), "the columns of the frame differ in length, or there are none")
        return
    accelerometers = document.get("accelerometers")
    tables = accelerometers if isinstance(accelerometers, Mapping) else {}
    rows = (dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True))
    outputs = {name: _output(table) for name, table in tables.items()}
    made = [run for run, _ in runs_of(settings, list(columns), rows, outputs, problems)]
    runs = document.get("runs")
    document["runs"] = [*(runs if isinstance(runs, list) else []), *made]


def _output(table: Any) -> Output | None:
    """Return what an accelerometer's readings are in, as far as its unit tells."""
    output = table.get("output") if isinstance(table, Mapping) else None
    unit = output.get("unit") if isinstance(output, Mapping) else None
    return Output(unit, 1.0) if isinstance(unit, str) else None


def _name_records(document: dict[str, Any]) -> None:
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
            if not (isinstance(stated, str) and stated.lower().endswith(WRITABLE)):
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
