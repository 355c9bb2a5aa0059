"""Simulated readings as files: in the description and in the table of readings."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np

from counterspin.campaign.checking import Problems
from counterspin.campaign.description import Campaign
from counterspin.campaign.quantity import NUMBER, PLUS_MINUS, parse
from counterspin.campaign.readings import BLANK, Reading, is_reading
from counterspin.campaign.readings_table import (
    ReadingsSettings,
    ReadingsTable,
    is_empty,
    load_table,
)
from counterspin.campaign.toml_file import load_document
from counterspin.errors import CampaignError
from counterspin.input import read_file
from counterspin.toml_text import write_document
from counterspin.units import unit_factor

#: Simulated readings are written with so many digits beyond their standard uncertainty.
_DIGITS: Final = 3

_WRITTEN = re.compile(rf"\s*({NUMBER}|{re.escape(BLANK)})\s*(.*)", re.DOTALL)


def filled_description(
    campaign: Campaign, exact: Sequence[Reading], generator: np.random.Generator
) -> str | None:
    """Return a campaign's description with values in place of those of its runs.

    Comments stay where they are, as long as the text is of the usual form.

    Returns: none if no run has a reading, so that nothing is to be changed.
    """
    text = _description(campaign)
    document = tomllib.loads(text)
    runs = [run for run in document.get("runs", []) if is_reading(run)]
    if not any("reading" in run for run in runs):
        return None
    ready = iter(exact)
    place, edited = 0, text
    for run in runs:
        if "reading" not in run:
            # A record, of all accelerometers.
            for _ in campaign.accelerometers:
                next(ready)
            continue
        old = _texts(run["reading"])
        new = []
        for texts in old:
            reading = next(ready)
            new.append([_with_value(text, campaign, reading, generator) for text in texts])
        run["reading"] = _like(run["reading"], new)
        for before, after in zip(chain(*old), chain(*new), strict=True):
            where = edited.find(f'"{before}"', place)
            if where >= 0:
                edited = f'{edited[:where]}"{after}"{edited[where + len(before) + 2 :]}'
                place = where + len(after)
    return edited if _reads_as(edited, document) else write_document(document)


def _description(campaign: Campaign) -> str:
    """Return a campaign's description as it is written."""
    if campaign.source is not None and campaign.source.in_memory:
        return campaign.source.text
    return read_file(campaign.path).decode("utf-8-sig")


def _texts(reading: Any) -> list[list[str]]:
    """Return the repeats of each accelerometer's reading as they are written."""
    each = list(reading.values()) if isinstance(reading, dict) else [reading]
    return [[one] if isinstance(one, str) else one for one in each]


def _like(reading: Any, new: list[list[str]]) -> Any:
    """Return new texts in the form of the old ones."""
    each = list(reading.values()) if isinstance(reading, dict) else [reading]
    written: list[Any] = [
        own[0] if isinstance(one, str) else own for one, own in zip(each, new, strict=True)
    ]
    return dict(zip(reading, written, strict=True)) if isinstance(reading, dict) else written[0]


def _reads_as(text: str, document: Mapping[str, Any]) -> bool:
    try:
        return tomllib.loads(text) == document
    except tomllib.TOMLDecodeError:
        return False


def _with_value(
    old: str, campaign: Campaign, reading: Reading, generator: np.random.Generator
) -> str:
    """Return the text of a reading with another value, in the unit and with the ± that it has."""
    output = campaign.accelerometers[reading.accelerometer].output
    match = _WRITTEN.fullmatch(old)
    assert match is not None
    rest = match[2] or (output.unit if output else "g")
    unit = re.sub(rf"^{PLUS_MINUS}{NUMBER}\s*", "", rest)
    if output is None:
        per_g = unit_factor("g", unit, gravity=campaign.gravity.value)
    else:
        per_g = unit_factor(output.unit, unit) * output.sensitivity
    stated = parse(f"0 {rest}", unit).u
    return f"{_read(campaign, reading, per_g, stated, generator)!r} {rest}"


def _read(
    campaign: Campaign,
    reading: Reading,
    per_g: float,
    stated: float,
    generator: np.random.Generator,
) -> float:
    """Return a reading with noise, in a unit of which `per_g` are a g.

    It has some digits more than its noise leaves it.
    """
    assert campaign.simulation is not None
    known = campaign.simulation.truth.reading_noise.get(reading.accelerometer)
    u = stated if known is None else known * abs(per_g)
    value = reading.value * per_g + u * float(generator.standard_normal())
    return round(value, _DIGITS - math.floor(math.log10(u))) if u > 0.0 else value


def filled_table(
    campaign: Campaign, exact: Sequence[Reading], generator: np.random.Generator
) -> tuple[Path, Any] | None:
    """Return the file that [readings] names, and the table, a polars frame, with values in it.

    Returns: none if there is no such section.
    """
    import polars as pl

    raw = campaign.source.document if campaign.source else load_document(campaign.path)
    if "readings" not in raw:
        return None
    settings = ReadingsSettings.model_validate(raw["readings"])
    path = campaign.folder / settings.file
    plain = settings.model_copy(update={"decimal": None, "sheet": None}).dialect
    said = [key for key, value in vars(plain).items() if value is not None]
    if said:
        raise CampaignError(
            str(campaign.path),
            [f"readings.{key}: a simulated table is plain; leave it out" for key in said],
        )
    frame = load_table(path, settings.dialect)[0].frame
    outputs = {name: a.output for name, a in campaign.accelerometers.items()}
    table = ReadingsTable(settings, outputs, Problems(raw))
    columns, beside = table.of("reading"), table.of("u")
    rows = [
        (place, row)
        for place, row in enumerate(frame.iter_rows(named=True))
        if not all(map(is_empty, row.values()))
    ]
    values = {
        column: [None if is_empty(cell) else cell for cell in frame[column].to_list()]
        for own in columns.values()
        for column in own
    }
    ready = iter(exact[len(exact) - len(rows) * len(columns) :])
    for place, row in rows:
        for name, own in columns.items():
            reading = next(ready)
            output = outputs[name]
            u: Any = row[beside[name][0]] if name in beside else None
            stated = 0.0 if is_empty(u) else float(u)
            for column in [c for c in own if not is_empty(row[c])] or own:
                per_g = output.sensitivity if output else 1.0
                values[column][place] = _read(campaign, reading, per_g, stated, generator)
    return path, frame.with_columns([pl.Series(c, cells) for c, cells in values.items()])
