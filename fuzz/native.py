"""Files of the formats that native code reads: valid, unusual and damaged ones.

Some mutations use the structure of the format: types, shapes and filters are changed with the
library that writes the file, and compressed streams before compression.

- `draw_parquet`, `draw_hdf5`, `draw_mat5`, `draw_mat73`, `draw_tdms`: draw a record
- `draw_readings`, `draw_workbook`: draw a table as Parquet or Excel; some workbooks are zip bombs
- `draw_numpy_archive`: draw the saved progress of a study; `damage`: change bytes of a file
"""

from __future__ import annotations

import contextlib
import io
import struct
import zipfile
import zlib
from collections.abc import Callable
from functools import cache
from random import Random
from typing import Any

import h5py
import numpy as np
import polars as pl
import record_files
from nptdms import ChannelObject, TdmsWriter
from scipy import sparse
from scipy.io import savemat
from workbooks import write_workbook

from fuzz.mutations import HOSTILE_VALUES, mutate_bytes, mutate_text

_N_ROWS = 330


def _draw_columns(rng: Random) -> dict[str, Any]:
    """Return the columns of a record, some of them mutated."""
    columns: dict[str, Any] = dict(record_files.simulate_columns(n=_N_ROWS))
    while rng.random() < 0.5:
        name = rng.choice(list(columns))
        values = np.asarray(columns[name])
        if values.dtype.kind not in "fiu" or values.ndim != 1 or not len(values):
            break
        columns[name] = rng.choice(_COLUMN_MUTATIONS)(rng, values)
    if rng.random() < 0.1:
        columns.pop(rng.choice(list(columns)))
    if rng.random() < 0.1:
        columns[rng.choice(("x" * 300, "x" * 60_000, "ü", "a b", "time_s2"))] = np.arange(_N_ROWS)
    return columns


def _overwrite_some(rng: Random, values: np.ndarray, value: float) -> np.ndarray:
    values = values.astype(float)
    start = rng.randrange(len(values))
    values[start : start + rng.choice((1, 2, 50, _N_ROWS))] = value
    return values


_COLUMN_MUTATIONS: list[Callable[[Random, np.ndarray], Any]] = [
    lambda rng, v: v[: rng.randrange(len(v) + 1)],
    lambda rng, v: np.concatenate([v] * 2),
    lambda rng, v: v[:, None] if rng.random() < 0.5 else v[None, :],
    lambda rng, v: v.reshape(-1, 2) if len(v) % 2 == 0 else v,
    lambda rng, v: v[rng.randrange(len(v))],
    lambda rng, v: v.astype(rng.choice(("f2", "f4", ">f8", "i1", "i2", ">i4", "i8", "u1", "?"))),
    lambda rng, v: v.astype(complex),
    lambda rng, v: v.astype(str),
    lambda rng, v: v.astype("S8"),
    lambda rng, v: _overwrite_some(
        rng, v, rng.choice((np.nan, np.inf, -np.inf, 0.0, 1e300, -1e-300))
    ),
    lambda rng, v: v[::-1],
    lambda rng, v: v * rng.choice((-1.0, 0.0, 1e-6, 1e6, 1e200)),
    lambda rng, v: np.where(np.arange(len(v)) == len(v) - 1, v * 1e3 + 1e5, v),
    lambda rng, v: np.zeros(0),
    lambda rng, v: np.arange(len(v)).astype("M8[s]"),
    lambda rng, v: [],
    lambda rng, v: "text",
    lambda rng, v: {"a": v},
    lambda rng, v: sparse.csc_matrix(v[None, :]),
]


def damage(rng: Random, content: bytes, byte_range: tuple[int, int] | None) -> bytes:
    """Return a file, with changed bytes in three of four cases."""
    if rng.random() < 0.25:
        return content
    if rng.random() < 0.1:
        return content[: rng.randrange(1, len(content) + 1)]
    return mutate_bytes(rng, content, byte_range if rng.random() < 0.7 else None)


def draw_parquet(rng: Random) -> bytes:
    """Return a record as Parquet."""
    columns = {}
    for name, values in _draw_columns(rng).items():
        try:
            columns[name] = pl.Series(name, values)
        except Exception:  # polars has no type for the values
            columns[name] = pl.Series(name, [1.0, None, 2.0])
    return _write_parquet(rng, _change_column_type(rng, pl.DataFrame(_pad_columns(columns))))


#: Columns of numbers in other types of Parquet.
_PARQUET_TYPES: list[Callable[[pl.Series], pl.Series]] = [
    lambda s: s.cast(pl.Decimal(38, 10)),
    lambda s: s.cast(pl.Decimal(5, 2)),
    lambda s: s.cast(pl.Int128),
    lambda s: s.cast(pl.Boolean),
    lambda s: s.cast(pl.String),
    lambda s: s.cast(pl.String).cast(pl.Categorical),
    lambda s: s.cast(pl.String).cast(pl.Binary),
    lambda s: s.cast(pl.Int64).cast(pl.Datetime("ns", "Europe/Berlin")),
    lambda s: s.cast(pl.Int64).cast(pl.Duration("us")),
    lambda s: s.abs().cast(pl.Int64).cast(pl.Time),
    lambda s: pl.Series([[value] for value in s]),
    lambda s: pl.Series([[value, value] for value in s], dtype=pl.Array(pl.Float64, 2)),
    lambda s: pl.Series([{"a": value} for value in s]),
    lambda s: pl.Series([{"a": [{"b": [value]}]} for value in s]),
    lambda s: pl.Series([None] * len(s)),
]


def _change_column_type(rng: Random, frame: pl.DataFrame) -> pl.DataFrame:
    """Return a table, with a column of another type in one of three cases."""
    if rng.random() < 0.67 or not frame.width:
        return frame
    name = rng.choice(frame.columns)
    return frame.with_columns(rng.choice(_PARQUET_TYPES)(frame[name]).alias(name))


def draw_readings(rng: Random, rows: list[list[str]]) -> bytes:
    """Return a table of readings as Parquet."""
    header, *body_rows = rows
    columns = {}
    for index, name in enumerate(header):
        cells: list[Any] = [row[index] for row in body_rows]
        with contextlib.suppress(ValueError):
            cells = [float(cell) for cell in cells]
        choice = rng.random()
        if choice < 0.1:
            cells = [rng.choice((None, cell)) for cell in cells]
        elif choice < 0.15:
            cells = [str(cell) for cell in cells]
        elif choice < 0.2:
            cells = [[cell] for cell in cells]
        elif choice < 0.25:
            cells = [rng.choice((cell, float("nan"), float("inf"), 1e300)) for cell in cells]
        elif choice < 0.28:
            cells = [{"a": cell} for cell in cells]
        try:
            columns[name] = pl.Series(name, cells)
        except Exception:
            columns[name] = pl.Series(name, [str(cell) for cell in cells])
        if columns[name].dtype == pl.Float64 and rng.random() < 0.1:
            types = (pl.Float32, pl.Int8, pl.Datetime, pl.Duration, pl.Boolean, pl.Date, pl.Binary)
            columns[name] = columns[name].cast(rng.choice(types), strict=False)
    return _write_parquet(rng, _change_column_type(rng, pl.DataFrame(columns)))


def _pad_columns(columns: dict[str, pl.Series]) -> dict[str, pl.Series]:
    max_length = max((len(series) for series in columns.values()), default=0)
    return {
        name: series.extend_constant(None, max_length - len(series))
        for name, series in columns.items()
    }


def _write_parquet(rng: Random, frame: pl.DataFrame) -> bytes:
    file = io.BytesIO()
    frame.write_parquet(
        file,
        compression=rng.choice(("uncompressed", "snappy", "gzip", "zstd", "lz4")),
        row_group_size=rng.choice((None, 100)),
    )
    content = file.getvalue()
    footer_length = int.from_bytes(content[-8:-4], "little")
    return damage(rng, content, (len(content) - 8 - footer_length, len(content)))


def draw_hdf5(rng: Random) -> bytes:
    """Return a record as HDF5."""
    return _draw_hdf5(rng, "")


def draw_mat73(rng: Random) -> bytes:
    """Return a record as a MATLAB 7.3 file: HDF5 after a user block of 512 bytes."""
    return _draw_hdf5(rng, "MATLAB 7.3 MAT-file".ljust(512))


def _draw_hdf5(rng: Random, userblock: str) -> bytes:
    file = io.BytesIO()
    options = {"userblock_size": 512} if userblock else {}
    with h5py.File(file, "w", libver=rng.choice(("earliest", "latest")), **options) as h5:
        group = h5.create_group("run/1") if rng.random() < 0.2 else h5
        for name, values in _draw_columns(rng).items():
            if sparse.issparse(values):
                group.create_group(name)["data"] = values.data
            elif isinstance(values, dict):
                group.create_group(name)
            else:
                _write_dataset(rng, group, name, np.asarray(values))
        if rng.random() < 0.1:
            group[record_files.TIME + "2"] = rng.choice(
                (h5py.SoftLink("/x"), h5py.ExternalLink("other.h5", "/x"))
            )
    content = bytearray(file.getvalue())
    content[: len(userblock)] = userblock.encode()
    return damage(rng, bytes(content), (len(userblock), len(userblock) + 2500))


#: Columns of numbers in other types of HDF5.
_HDF5_TYPES: list[Callable[[np.ndarray], np.ndarray]] = [
    lambda v: v.astype(">f4"),
    lambda v: v.astype("g"),
    lambda v: v.astype(">u8"),
    lambda v: v > 0,
    lambda v: (v > 0).astype(h5py.enum_dtype({"off": 0, "on": 1})),
    lambda v: v.astype([("a", "f8"), ("b", ">i2")]),
    lambda v: v.astype([("a", [("b", "f8")])]),
    lambda v: v.astype(str).astype(h5py.string_dtype()),
    lambda v: v.astype("S20").astype(h5py.string_dtype("utf-8", 20)),
    lambda v: v.astype("V8"),
    lambda v: v.astype("M8[s]").astype(h5py.opaque_dtype("M8[s]")),
]


def _write_dataset(rng: Random, group: Any, name: str, values: np.ndarray) -> None:
    if values.dtype.kind == "U":
        values = values.astype("S")
    if values.dtype.kind == "M":
        values = values.astype("i8")
    if values.dtype.kind == "f" and values.ndim == 1 and rng.random() < 0.1:
        values = rng.choice(_HDF5_TYPES)(values)
    options: dict[str, Any] = {}
    if values.ndim and values.size and rng.random() < 0.4:
        options = rng.choice(
            (
                {"chunks": True, "compression": "gzip"},
                {"chunks": True, "shuffle": True, "fletcher32": True},
                {"maxshape": (None,) * values.ndim},
                {"chunks": True, "compression": "lzf"},
            )
        )
    dataset = group.create_dataset(name.replace("/", "_"), data=values, **options)
    if "maxshape" in options and rng.random() < 0.3:  # longer than its data
        dataset.resize((rng.choice((10**4, 10**9, 10**15)), *values.shape[1:]))


def draw_mat5(rng: Random) -> bytes:
    """Return a record as a MATLAB file of version 5 to 7."""
    file = io.BytesIO()
    columns = {name[:31]: values for name, values in _draw_columns(rng).items()}
    columns = {name: values for name, values in columns.items() if name.isidentifier()}
    for name, values in columns.items():
        if np.asarray(values).dtype.kind == "M":
            columns[name] = np.asarray(values).astype("i8")
    savemat(file, columns, do_compression=rng.random() < 0.6, oned_as=rng.choice(("row", "column")))
    content = file.getvalue()
    if rng.random() < 0.5:
        content = _mutate_mat5_elements(rng, content)
    if rng.random() < 0.3:
        return content
    return damage(rng, content, (0, 400))


def _mutate_mat5_elements(rng: Random, content: bytes) -> bytes:
    """Return a file with mutated elements; compressed elements are mutated before compression."""
    mutated, position = content[:128], 128
    while position + 8 <= len(content):
        element_type, size = struct.unpack("<II", content[position : position + 8])
        body = content[position + 8 : position + 8 + size]
        position += 8 + size
        if element_type == 15:
            body = zlib.decompress(body)
        if rng.random() < 0.5:
            body = mutate_bytes(rng, body, (0, 80))
        if element_type == 15:
            body = zlib.compress(body * rng.choice((1,) * 9 + (50,)))
        mutated += struct.pack("<II", element_type, len(body)) + body
    return mutated


def draw_tdms(rng: Random) -> bytes:
    """Return a record as a LabVIEW file with two segments."""
    file = io.BytesIO()
    columns = _draw_columns(rng)
    with TdmsWriter(file) as writer:
        for segment_rows in (slice(0, 200), slice(200, None)):
            channels = []
            for name, values in columns.items():
                array = (
                    np.atleast_1d(np.asarray(values)) if isinstance(values, np.ndarray) else None
                )
                if array is not None and array.ndim == 1 and array.dtype.kind in "fiuU":
                    increment = {"wf_increment": rng.choice((0.01, 0.0, 1e-300, "x"))}
                    properties = increment if rng.random() < 0.1 else {}
                    channels.append(ChannelObject("run", name, array[segment_rows], properties))
            if channels:
                writer.write_segment(channels)
    content = file.getvalue()
    segment_start = rng.choice((0, content.rfind(b"TDSm")))
    if rng.random() < 0.2:  # the recorder stopped within a segment
        return content[: rng.randrange(segment_start, len(content))]
    return damage(rng, content, (segment_start, segment_start + 600))


#: Replacements in a sheet: distant cells, wrong dimensions, missing shared strings, entities.
_SHEET_TRICKS: list[tuple[str, str]] = [
    ('r="B5"', 'r="XFD1048576"'),
    ('r="5"', 'r="1048576"'),
    ('r="5"', 'r="4294967296"'),
    ('r="B5"', 'r=""'),
    ('r="B5"', 'r="5B"'),
    ('r="B5"', 'r="AAAAAAAAAA9"'),
    ("<sheetData>", '<dimension ref="A1:XFD1048576"/><sheetData>'),
    ("<sheetData>", '<dimension ref="B9:A1"/><sheetData>'),
    ('t="inlineStr"', 't="s"'),
    ('t="inlineStr"', 't="e"'),
    ('t="inlineStr"', 't="b"'),
    ("<v>", "<v>99999999999999999999"),
    ("<v>", "<f>A1</f><v>"),
    ("<is>", "<is><r>"),
    ("<row", "<row><row"),
    ("<worksheet", '<!DOCTYPE x [<!ENTITY a "b">]><worksheet'),
]


def draw_workbook(rng: Random, rows: list[list[str]]) -> bytes:
    """Return a table of readings as an Excel workbook."""
    hostile_probability = 0.5 / sum(map(len, rows))
    cells: list[list[Any]] = [
        [_draw_cell(rng, text, hostile_probability) for text in row] for row in rows
    ]
    sheets = {"Tumble": cells}
    if rng.random() < 0.1:
        sheets[rng.choice(("", "Notes", "x" * 300, "\u202e"))] = rng.choice(([], [["a"]], cells))
    file = io.BytesIO()
    write_workbook(file, sheets)
    if rng.random() < 0.1:
        return damage(rng, file.getvalue(), None)
    return _mutate_workbook(rng, file)


def _draw_cell(rng: Random, text: str, hostile_probability: float) -> Any:
    if rng.random() < hostile_probability:
        return _to_storable(rng.choice(HOSTILE_VALUES))
    try:
        return float(text)
    except ValueError:
        return text


def _to_storable(value: Any) -> Any:
    return value if isinstance(value, int | float) else str(value)


def _mutate_workbook(rng: Random, source_file: io.BytesIO) -> bytes:
    """Return a workbook with mutated parts, or a zip bomb."""
    mutated_file = io.BytesIO()
    with (
        zipfile.ZipFile(source_file) as source,
        zipfile.ZipFile(mutated_file, "w", zipfile.ZIP_DEFLATED) as target,
    ):
        for name in source.namelist():
            content = source.read(name)
            is_sheet = name.startswith("xl/worksheets")
            if is_sheet and rng.random() < 0.3:
                old, replacement = rng.choice(_SHEET_TRICKS)
                content = content.replace(
                    old.encode(), replacement.encode(), rng.choice((1, 1, -1))
                )
            if rng.random() < (0.3 if is_sheet else 0.08):
                content = mutate_text(rng, content.decode()).encode("utf-8", "replace")
            if rng.random() < 0.97:
                target.writestr(name, content)
        if rng.random() < 0.05:
            target.writestr("xl/sharedStrings.xml", mutate_text(rng, _SHARED_STRINGS))
    content = mutated_file.getvalue()
    if rng.random() < 0.02:
        content = _make_bomb(rng.choice(_BOMB_PIECES))
    return damage(rng, content, None) if rng.random() < 0.3 else content


_SHARED_STRINGS = (
    '<sst xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main" count="4294967295" '
    'uniqueCount="4294967295"><si><t>a</t></si></sst>'
)


#: Repeated content of the sheet of a bomb: blanks, rows, strings, formulas, nested elements.
_BOMB_PIECES = (
    b" ",
    b"<row><c><v>1</v></c></row>",
    b'<row><c t="inlineStr"><is><t>a</t></is></c></row>',
    b"<row><c><f>A1+1</f></c></row>",
    b"<a>",
)


@cache
def _make_bomb(piece: bytes) -> bytes:
    """Return a small workbook with a large sheet, just below the accepted size."""
    source_file, bomb_file = io.BytesIO(), io.BytesIO()
    write_workbook(source_file, {"Tumble": [["a"], [1.0]]})
    with (
        zipfile.ZipFile(source_file) as source,
        zipfile.ZipFile(bomb_file, "w", zipfile.ZIP_DEFLATED) as target,
    ):
        for name in source.namelist():
            content = source.read(name)
            if name.startswith("xl/worksheets"):
                filling = piece * (60_000_000 // len(piece))
                content = content.replace(b"</sheetData>", filling + b"</sheetData>")
            target.writestr(name, content)
    return bomb_file.getvalue()


def draw_numpy_archive(rng: Random, archive: bytes) -> bytes:
    """Return the saved progress of a study with mutated arrays, or with changed bytes."""
    if rng.random() < 0.4:
        return damage(rng, archive, None)
    with np.load(io.BytesIO(archive)) as saved:
        arrays = dict(saved)
    name = rng.choice(list(arrays))
    mutation = rng.randrange(6)
    if mutation == 0:
        del arrays[name]
    elif mutation == 1:
        arrays[name] = np.array("x" * 50)
    elif mutation == 2 and arrays[name].dtype.kind in "fib":
        arrays[name] = arrays[name].astype(rng.choice(("f4", "i1", "c16", "U5", "?", "M8[s]")))
    elif mutation == 3:
        arrays[name] = arrays[name][None]
    elif mutation == 4 and arrays[name].ndim:
        arrays[name] = np.concatenate([arrays[name]] * 2)
    elif arrays[name].dtype.kind == "f":
        arrays[name] = arrays[name] * rng.choice((np.nan, 1e300, -1.0))
    else:
        arrays[name] = np.zeros((), dtype=arrays[name].dtype)
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()
