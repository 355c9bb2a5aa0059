"""`counterspin apply`: write a corrected column of a file to a new file."""

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
from counterspin.correction.instrument import make_instrument
from counterspin.errors import CampaignError, CounterspinError, RecordError, UsageError
from counterspin.frozen import frozen
from counterspin.output import (
    FileType,
    check_writable,
    contains_bytes,
    write_atomically,
    write_binary,
)
from counterspin.physics.correction import NotInvertibleError
from counterspin.records.formats import locate, read_numbers, read_table
from counterspin.records.unit_notation import _CELSIUS_UNITS, bracketed_unit
from counterspin.units import ZERO_CELSIUS, is_convertible, is_same_unit, unit_factor

#: Option -> example of a constant.
_CONSTANT_EXAMPLES: Final = {"pendulous": "-1 g", "output_axis": "-1 g", "temperature": "23 degC"}

#: Suffix of the output -> delimiter of its cells; None for Parquet.
_SEPARATORS: Final[Mapping[str, str | None]] = {
    ".csv": ",",
    ".txt": ",",
    ".tsv": "\t",
    ".parquet": None,
}

#: Files written by this command, recognised by the names of the new columns.
_FILE_TYPE: Final = FileType("a file that counterspin corrected", contains_bytes(b"_corrected_u"))


@frozen
class CorrectedRow:
    """One row: indicated specific force, correction and its u, in the unit of the correction."""

    indicated: float
    correction: float
    u: float


@frozen
class CorrectedFile:
    """Summary of a corrected file."""

    path: Path  #: The file.
    column: str  #: The column that was corrected.
    #: Number of rows, and of rows that lack a necessary number.
    rows: int
    missing: int
    #: Smallest and largest indication.
    low: float
    high: float
    most: CorrectedRow  #: The row with the largest correction.
    at_one_g: CorrectedRow  #: The row nearest to 1 g or -1 g.
    at_largest: CorrectedRow  #: The row with the largest absolute indication.
    correction: Correction  #: The corrected values.
    found: str = ""  #: Format of the file, unless it is plain CSV.
    more: tuple[CorrectedFile, ...] = ()  #: Summaries of the other corrected columns.


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
    """Correct a column of a file and write a file with two additional columns.

    Parameters
    ----------
    result
        As `apply`.
    accelerometer
        As `apply`. None: the only accelerometer of the result; all accelerometers of
        `options.others`; or those of the triad of the result if none is named and the columns have
        their names, each with two more columns.
    source
        Record file of any format.
    output
        File to write, .csv or .parquet; not the source.
    column
        Column with the indication. None: the column with the name of the accelerometer, or the
        only column that is not named elsewhere.
    options
        As `apply`, with columns instead of arrays.
    overwrite
        Whether to replace an earlier corrected file; other files are never replaced.

    Returns
    -------
    CorrectedFile

    Raises
    ------
    CampaignError
        If arguments do not match the file or the result.
    RecordError
        If the file is not valid.
    ConvergenceError
        If a row is outside the range of the model; the message names the row.
    CounterspinError
        If the output cannot be written.
    """
    source, output = Path(source), Path(output)
    suffix = output.suffix.lower()
    if suffix not in _SEPARATORS:
        raise CampaignError(
            str(output), [f"must end in one of {', '.join(_SEPARATORS)}"], code="wrong-file-ending"
        )
    if output.exists() and source.exists() and output.samefile(source):
        raise CampaignError(
            str(output),
            ["this file is the input file, which is never overwritten"],
            code="file-exists",
        )
    check_writable(output, lambda: _FILE_TYPE, overwrite=overwrite)
    options = options or ApplyOptions()
    others: dict[str, Any] = dict(options.others)
    if accelerometer is None and not others and len(result.accelerometers) == 1:
        (accelerometer,) = result.accelerometers
    corrects_all = accelerometer is None
    if accelerometer is None:
        accelerometer, others = _select_all(result, others, column)
        column = others.pop(accelerometer)
    for name in (accelerometer, *others):
        make_instrument(result, name)  # refuse a wrong name before reading the file
    table = read_table(source, options.dialect)
    frame = table.frame
    inputs: dict[str, Any] = {
        name: text
        for name in ("pendulous", "output_axis", "temperature")
        if (text := getattr(options, name)) is not None
    }
    used_columns = [text for text in (*inputs.values(), *others.values()) if text in frame.columns]
    column = column or _guess_column(source, frame, accelerometer, used_columns)
    corrected_columns = {accelerometer: column, **(others if corrects_all else {})}
    names = sorted({column, *used_columns, *others.values()})
    values = read_numbers(source, names, options.dialect)
    units = {name: table.units.get(name) or bracketed_unit(name) for name in names}
    temperature_column = inputs.get("temperature")
    force_names = [name for name in names if name != temperature_column]
    _check_units(source, units, _stated_units(force_names, options))
    if temperature_column in values:
        values[temperature_column] = _convert_to_celsius(
            source, temperature_column, values[temperature_column], units[temperature_column]
        )
    for name in (
        f"{corrected_column}_corrected{ending}"
        for corrected_column in corrected_columns.values()
        for ending in ("", "_u")
    ):
        if name in frame.columns:
            raise CampaignError(
                str(source),
                [f"the file already has a column '{name}'; check whether it was corrected before"],
                code="duplicate-entry",
            )
    forces: dict[str, Any] = {
        name: values[text] if text in values else _check_constant(name, text, frame.columns)
        for name, text in inputs.items()
    }
    columns = {name: values[text] for name, text in others.items()}
    try:
        correction = apply(
            result, accelerometer, values[column], replace(options, others=columns, **forces)
        )
    except NotInvertibleError as error:
        location = locate(source, error.row, options.dialect)
        raise CounterspinError(
            f"{source}, {location}: the indication {error.reason}", code="not-invertible"
        ) from error
    new_columns, summaries = [], []
    for name, corrected_column in corrected_columns.items():
        column_correction = correction.others.get(name, correction)
        summaries.append(
            _summarise(output, corrected_column, column_correction, result.inputs.gravity)
        )
        for new_name, new_values in (
            (f"{corrected_column}_corrected", column_correction.corrected),
            (f"{corrected_column}_corrected_u", column_correction.u),
        ):
            new_columns.append(pl.Series(new_name, new_values).fill_nan(None))
    summary = replace(summaries[0], found=table.format_description, more=tuple(summaries[1:]))
    write_atomically(
        output,
        _make_writer(frame.with_columns(new_columns), suffix, table.decimal),
        lambda: _FILE_TYPE,
        overwrite=overwrite,
    )
    return summary


def _select_all(
    result: Result, others: dict[str, Any], column: str | None
) -> tuple[str, dict[str, Any]]:
    """Return the first of all accelerometers to be corrected, and the columns of all."""
    if not others and result.triad is not None:
        others = {name: name for name in result.triad.accelerometers}
    if not others or column is not None:
        problem = (
            "select the accelerometer to be corrected with `accelerometer`; the result has "
            f"{', '.join(result.accelerometers)}"
        )
        raise UsageError("apply", [problem])
    return next(iter(others)), others


def _stated_units(names: list[str], options: ApplyOptions) -> dict[str, str]:
    """Return the unit of each column; with outputs such as mA, cross-axis forces are in g."""
    unit = options.unit
    cross_unit = unit if is_convertible(unit, "g") else "g"
    cross_columns = [options.pendulous, options.output_axis]
    return {name: cross_unit if name in cross_columns else unit for name in names}


def _check_units(source: Path, units: Mapping[str, str], stated_units: Mapping[str, str]) -> None:
    """Raise RecordError if a unit in the file differs from the stated one."""
    for name, stated_unit in stated_units.items():
        if units[name] and not is_same_unit(units[name], stated_unit):
            raise RecordError(
                f"{source}: column '{name}' is in '{units[name]}' according to the file, but in "
                f"'{stated_unit}' according to `unit`; all forces must be in the same unit, which "
                "is stated with `unit`. With outputs such as mA, cross-axis forces are in g.",
                code="unit-mismatch",
            )


def _convert_to_celsius(source: Path, column: str, values: Array, unit: str) -> Array:
    """Return a column of temperatures in degC, the default unit."""
    if unit == "K":
        return values - ZERO_CELSIUS
    if unit in ("", *_CELSIUS_UNITS):
        return values
    raise RecordError(
        f"{source}: column '{column}' is in '{unit}' according to the file; a temperature "
        "must be in degC or K.",
        code="unit-mismatch",
    )


def _guess_column(
    source: Path, table: pl.DataFrame, accelerometer: str, used_columns: list[str]
) -> str:
    candidates = [name for name in table.columns if name not in used_columns]
    if accelerometer in candidates:
        return accelerometer
    if len(candidates) == 1:
        return candidates[0]
    raise CampaignError(
        str(source),
        [
            f"which column contains the indication of {accelerometer}? Select it with `column`; "
            f"the file has {', '.join(table.columns)}"
        ],
        code="ambiguous-selection",
    )


def _check_constant(name: str, text: str, columns: list[str]) -> str:
    """Return a text; CampaignError unless it contains a digit, like a quantity."""
    if not any(character.isdigit() for character in text):
        raise CampaignError(
            "apply",
            [
                f"`{name}`: {text!r} is neither a column of the file ({', '.join(columns)}) nor a "
                f'constant with its unit such as "{_CONSTANT_EXAMPLES[name]}"'
            ],
            code="missing-column",
        )
    return text


def _summarise(output: Path, column: str, correction: Correction, gravity: float) -> CorrectedFile:
    indicated = correction.indicated
    valid_rows = np.flatnonzero(np.isfinite(correction.corrected))
    if valid_rows.size == 0:
        raise RecordError(
            f"{output} was not written: no row has all required numbers.", code="no-rows"
        )
    values, corrected_values = indicated[valid_rows], correction.corrected[valid_rows]
    one_g = 1.0 / unit_factor(correction.unit, "g", gravity=gravity)

    def make_row(index: int) -> CorrectedRow:
        change = float(corrected_values[index] - values[index])
        return CorrectedRow(float(values[index]), change, float(correction.u[valid_rows[index]]))

    return CorrectedFile(
        path=output,
        column=column,
        rows=indicated.size,
        missing=indicated.size - valid_rows.size,
        low=float(values.min()),
        high=float(values.max()),
        most=make_row(int(np.argmax(np.abs(corrected_values - values)))),
        at_one_g=make_row(int(np.argmin(np.abs(np.abs(values) - one_g)))),
        at_largest=make_row(int(np.argmax(np.abs(values)))),
        correction=correction,
    )


def _make_writer(frame: pl.DataFrame, suffix: str, decimal: str) -> Callable[[Path], object]:
    """Return a function that writes a table; new numbers in text have the format of the file."""
    separator = _SEPARATORS[suffix]
    if separator is None:
        table = pl.DataFrame([_parse_column(column, decimal) for column in frame.get_columns()])
        return lambda path: write_binary(path, table.write_parquet)
    uses_comma = decimal == ","
    separator = ";" if uses_comma and separator == "," else separator
    write = partial(frame.write_csv, separator=separator, decimal_comma=uses_comma)
    return lambda path: write_binary(path, write)


def _parse_column(column: pl.Series, decimal: str) -> pl.Series:
    """Return a text column as numbers if all its cells are numbers."""
    if column.dtype != pl.String:
        return column
    stripped_column = column.str.strip_chars().replace("", None)
    if decimal == ",":
        stripped_column = stripped_column.str.replace(",", ".", literal=True)
    numbers = stripped_column.cast(pl.Float64, strict=False)
    return numbers if numbers.null_count() == stripped_column.null_count() else column
