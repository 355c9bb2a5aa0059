"""Campaigns made in Python."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from counterspin.campaign.checking import Problems
from counterspin.campaign.description import Campaign, resolved_in_memory
from counterspin.campaign.memory.documents import plain
from counterspin.campaign.memory.records import give_records, name_records
from counterspin.campaign.memory.source import Source
from counterspin.campaign.readings_table import ReadingsSettings, ReadingsTable
from counterspin.campaign.settings import Output
from counterspin.campaign.toml_file import (
    CAMPAIGN_ADVICE,
    description_file,
    list_of,
    load_with_checksum,
    table_of,
    unusable,
)
from counterspin.errors import CampaignError
from counterspin.records.memory import columns_of

#: What messages call a table of readings without a file.
_IN_MEMORY: Final = "readings in memory"


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
        name_records(document)
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
    tables = table_of(document, "accelerometers")
    rows = (dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True))
    outputs = {name: _output(table) for name, table in tables.items()}
    table = ReadingsTable(settings, outputs, problems, document)
    made = [run for run, _ in table.runs(list(columns), rows)]
    document["runs"] = [*list_of(document, "runs"), *made]


def _output(table: Any) -> Output | None:
    """Return what an accelerometer's readings are in, as far as its unit tells."""
    output = table.get("output") if isinstance(table, Mapping) else None
    unit = output.get("unit") if isinstance(output, Mapping) else None
    return Output.model_construct(unit=unit) if isinstance(unit, str) else None
