"""`counterspin apply`: a file's column of indicated specific force, corrected in a new file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars as pl

from counterspin.arrays import Array
from counterspin.calibration.result import Result
from counterspin.correction.apply import ApplyOptions, Correction, apply
from counterspin.correction.instrument import instrument_of
from counterspin.errors import CampaignError, CounterspinError, RecordError
from counterspin.frozen import frozen
from counterspin.output import FileType, holds, reserve, write_open, write_whole
from counterspin.physics.correction import NotInvertibleError
from counterspin.records.formats import locate, read_numbers, read_table
from counterspin.records.unit_words import TEMPERATURES
from counterspin.units import ZERO_CELSIUS, same_unit, unit_factor

#: What a constant in the place of a column may be.
_EXAMPLES: Final = {"pendulous": "-1 g", "output_axis": "-1 g", "temperature": "23 degC"}

#: Ending of the output -> what parts its cells; None for Parquet.
_SEPARATORS: Final[Mapping[str, str | None]] = {
    ".csv": ",",
    ".txt": ",",
    ".tsv": "\t",
    ".parquet": None,
}

#: What is written is known again by the names of its new columns.
_CORRECTED: Final = FileType("a file that counterspin corrected", holds(b"_corrected_u"))


@frozen
class Level:
    """One row: its indicated specific force, its correction, its u, in the correction's unit."""

    indicated: float
    correction: float
    u: float


@frozen
class CorrectedFile:
    """The files and samples that were written."""

    path: Path  #: The file.
    column: str  #: The column that was corrected.
    #: Rows of the file, and how many of them lack a number that was needed.
    rows: int
    missing: int
    #: Least and largest indication.
    low: float
    high: float
    most: Level  #: The row with the largest correction.
    at_one_g: Level  #: The row nearest to 1 g or -1 g.
    at_largest: Level  #: The row with the largest indication in size.
    correction: Correction  #: The corrected values themselves.
    found: str = ""  #: How the file is written, where that is not plain.
    more: tuple[CorrectedFile, ...] = ()  #: Likewise of columns that were corrected with it.


def apply_file(
    result: Result,
    accelerometer: str | None,
    source: Path | str,
    output: Path | str,
    *,
    column: str | None = None,
    options: ApplyOptions | None = None,
    overwrite: bool = False,
) -> CorrectedFile:
    """Correct a column of a file and write the file's columns and two more.

    Parameters
    ----------
    result
        As `apply`.
    accelerometer
        As `apply`. None: all that `options.others` names, or the accelerometers of the result's
        triad where it names none and the columns have their names, each with two more columns.
    source
        A record file of any format.
    output
        The file to write, .csv or .parquet; not the source.
    column
        The column with the indication. None: the one that is named as the accelerometer, or the
        only one that is named nowhere else.
    options
        As `apply`, with columns in the place of arrays.
    overwrite
        Whether an earlier corrected file may be replaced; nothing else is.

    Returns
    -------
    CorrectedFile

    Raises
    ------
    CampaignError
        If what is asked does not fit the file or the result.
    RecordError
        If the file cannot be used.
    ConvergenceError
        If a row lies outside of what the model can indicate; the row is named.
    CounterspinError
        If the output cannot be written.
    """
    source, output = Path(source), Path(output)
    suffix = output.suffix.lower()
    if suffix not in _SEPARATORS:
        raise CampaignError(str(output), [f"must end in one of {', '.join(_SEPARATORS)}"])
    if output.exists() and source.exists() and output.samefile(source):
        raise CampaignError(str(output), ["is the input, which is never overwritten"])
    reserve(output, lambda: _CORRECTED, overwrite=overwrite)
    options = options or ApplyOptions()
    others: dict[str, Any] = dict(options.others)
    together = accelerometer is None
    if accelerometer is None:
        if not others and result.triad is not None:
            others = {name: name for name in result.triad.accelerometers}
        accelerometer = next(iter(others), None)
        if accelerometer is None or column is not None:
            raise CampaignError("apply", ["name the one to be corrected with `accelerometer`"])
        column = others.pop(accelerometer)
    for name in (accelerometer, *others):
        instrument_of(result, name)  # a wrong name is refused before the file is searched for it
    table = read_table(source, options.dialect)
    frame = table.frame
    given: dict[str, Any] = {
        name: text
        for name in ("pendulous", "output_axis", "temperature")
        if (text := getattr(options, name)) is not None
    }
    used = [text for text in (*given.values(), *others.values()) if text in frame.columns]
    column = column or _guessed(source, frame, accelerometer, used)
    corrected = {accelerometer: column, **(others if together else {})}
    names = sorted({column, *used, *others.values()})
    values = read_numbers(source, names, options.dialect)
    units = {name: table.units.get(name, "") for name in names}
    warm = given.get("temperature")
    _check_units(source, {n: u for n, u in units.items() if n != warm}, options.unit)
    if warm in values:
        values[warm] = _in_celsius(source, warm, values[warm], units[warm])
    for name in (f"{one}_corrected{u}" for one in corrected.values() for u in ("", "_u")):
        if name in frame.columns:
            raise CampaignError(
                str(source), [f"has a column '{name}' already; was it corrected before?"]
            )
    forces: dict[str, Any] = {
        name: values[text] if text in values else _constant(name, text, frame.columns)
        for name, text in given.items()
    }
    columns = {name: values[text] for name, text in others.items()}
    try:
        correction = apply(
            result, accelerometer, values[column], replace(options, others=columns, **forces)
        )
    except NotInvertibleError as error:
        where = locate(source, error.row, options.dialect)
        raise CounterspinError(f"{source}, {where}: the indication {error.reason}") from error
    added, reports = [], []
    for name, one in corrected.items():
        done = correction.others.get(name, correction)
        reports.append(_report(output, one, done, result.inputs.gravity))
        for new, array in ((f"{one}_corrected", done.corrected), (f"{one}_corrected_u", done.u)):
            added.append(pl.Series(new, array).fill_nan(None))
    report = replace(reports[0], found=table.found, more=tuple(reports[1:]))
    write_whole(
        output,
        _writer(frame.with_columns(added), suffix, table.decimal),
        lambda: _CORRECTED,
        overwrite=overwrite,
    )
    return report


def _check_units(source: Path, units: Mapping[str, str], stated: str) -> None:
    """Raise RecordError where the file's row of units has another unit than the one stated."""
    for name, own in units.items():
        if own and not same_unit(own, stated):
            raise RecordError(
                f"{source}: column '{name}' is in '{own}' by the file's row of units, but in "
                f"'{stated}' by `unit`; all forces must be in one unit, stated with `unit`."
            )


def _in_celsius(source: Path, column: str, values: Array, unit: str) -> Array:
    """Return a column of temperatures in degC, which is the unit if its file states none."""
    if unit == "K":
        return values - ZERO_CELSIUS
    if unit in ("", *TEMPERATURES):
        return values
    raise RecordError(
        f"{source}: column '{column}' is in '{unit}' by the file's row of units; a temperature is "
        "in degC or K."
    )


def _guessed(source: Path, table: pl.DataFrame, accelerometer: str, used: list[str]) -> str:
    free = [name for name in table.columns if name not in used]
    if accelerometer in free:
        return accelerometer
    if len(free) == 1:
        return free[0]
    raise CampaignError(
        str(source),
        [
            f"which column is the indication of {accelerometer}? Name it with `column`; the file "
            f"has {', '.join(table.columns)}"
        ],
    )


def _constant(name: str, text: str, columns: list[str]) -> str:
    """Return a text that looks like a quantity."""
    if not any(mark.isdigit() for mark in text):
        raise CampaignError(
            "apply",
            [
                f"`{name}`: {text!r} is neither a column of the file ({', '.join(columns)}) nor a "
                f'constant with its unit such as "{_EXAMPLES[name]}"'
            ],
        )
    return text


def _report(output: Path, column: str, correction: Correction, gravity: float) -> CorrectedFile:
    indicated = correction.indicated
    present = np.flatnonzero(np.isfinite(correction.corrected))
    if present.size == 0:
        raise RecordError(f"{output}: not written: no row has all the necessary numbers.")
    given, corrected = indicated[present], correction.corrected[present]
    one_g = 1.0 / unit_factor(correction.unit, "g", gravity=gravity)

    def level(place: int) -> Level:
        change = float(corrected[place] - given[place])
        return Level(float(given[place]), change, float(correction.u[present[place]]))

    return CorrectedFile(
        path=output,
        column=column,
        rows=indicated.size,
        missing=indicated.size - present.size,
        low=float(given.min()),
        high=float(given.max()),
        most=level(int(np.argmax(np.abs(corrected - given)))),
        at_one_g=level(int(np.argmin(np.abs(np.abs(given) - one_g)))),
        at_largest=level(int(np.argmax(np.abs(given)))),
        correction=correction,
    )


def _writer(frame: pl.DataFrame, suffix: str, decimal: str) -> Callable[[Path], object]:
    """Return a function that writes a table; new numbers in text have the others' format."""
    separator = _SEPARATORS[suffix]
    if separator is None:
        typed = pl.DataFrame([_typed(column, decimal) for column in frame.get_columns()])
        return lambda path: write_open(path, typed.write_parquet)
    comma = decimal == ","
    separator = ";" if comma and separator == "," else separator
    write = partial(frame.write_csv, separator=separator, decimal_comma=comma)
    return lambda path: write_open(path, write)


def _typed(column: pl.Series, decimal: str) -> pl.Series:
    """Return a column of text as numbers if it has only numbers; CSV cells are text so far."""
    if column.dtype != pl.String:
        return column
    clean = column.str.strip_chars().replace("", None)
    if decimal == ",":
        clean = clean.str.replace(",", ".", literal=True)
    numbers = clean.cast(pl.Float64, strict=False)
    return numbers if numbers.null_count() == clean.null_count() else column
