"""Record files of the formats that native code reads: sound ones, odd ones and damaged ones.

Some are changed where the format's own structure says what matters: types, shapes and filters
through the library that writes them, and compressed streams before they are compressed.

- `parquet`, `hdf5`, `mat5`, `mat73`, `tdms`: a record; `readings`: a table of readings as Parquet
- `workbook`: the same as Excel writes it, with bombs among them
- `numpy_archive`: what a study keeps; `damaged`: a whole file with changed bytes
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

from fuzz.mutations import HOSTILE, mutate_bytes, mutate_text

_ROWS = 330


def _columns(rng: Random) -> dict[str, Any]:
    """Return a record's columns, some of them odd."""
    columns: dict[str, Any] = dict(record_files.simulate_columns(n=_ROWS))
    while rng.random() < 0.5:
        name = rng.choice(list(columns))
        values = np.asarray(columns[name])
        if values.dtype.kind not in "fiu" or values.ndim != 1 or not len(values):
            break
        columns[name] = rng.choice(_ODD)(rng, values)
    if rng.random() < 0.1:
        columns.pop(rng.choice(list(columns)))
    if rng.random() < 0.1:
        columns[rng.choice(("x" * 300, "x" * 60_000, "ü", "a b", "time_s2"))] = np.arange(_ROWS)
    return columns


def _with(rng: Random, values: np.ndarray, value: float) -> np.ndarray:
    values = values.astype(float)
    start = rng.randrange(len(values))
    values[start : start + rng.choice((1, 2, 50, _ROWS))] = value
    return values


_ODD: list[Callable[[Random, np.ndarray], Any]] = [
    lambda rng, v: v[: rng.randrange(len(v) + 1)],
    lambda rng, v: np.concatenate([v] * 2),
    lambda rng, v: v[:, None] if rng.random() < 0.5 else v[None, :],
    lambda rng, v: v.reshape(-1, 2) if len(v) % 2 == 0 else v,
    lambda rng, v: v[rng.randrange(len(v))],
    lambda rng, v: v.astype(rng.choice(("f2", "f4", ">f8", "i1", "i2", ">i4", "i8", "u1", "?"))),
    lambda rng, v: v.astype(complex),
    lambda rng, v: v.astype(str),
    lambda rng, v: v.astype("S8"),
    lambda rng, v: _with(rng, v, rng.choice((np.nan, np.inf, -np.inf, 0.0, 1e300, -1e-300))),
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


def damaged(rng: Random, content: bytes, near: tuple[int, int] | None) -> bytes:
    """Return a file, three times in four with changed bytes."""
    if rng.random() < 0.25:
        return content
    if rng.random() < 0.1:
        return content[: rng.randrange(1, len(content) + 1)]
    return mutate_bytes(rng, content, near if rng.random() < 0.7 else None)


def parquet(rng: Random) -> bytes:
    """Return a record as Parquet; the footer says what is where."""
    frame = {}
    for name, values in _columns(rng).items():
        try:
            frame[name] = pl.Series(name, values)
        except Exception:  # what polars has no type for
            frame[name] = pl.Series(name, [1.0, None, 2.0])
    return _parquet(rng, _with_other_type(rng, pl.DataFrame(_levelled(frame))))


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


def _with_other_type(rng: Random, frame: pl.DataFrame) -> pl.DataFrame:
    """Return a table, one time in three with a column of another type."""
    if rng.random() < 0.67 or not frame.width:
        return frame
    name = rng.choice(frame.columns)
    return frame.with_columns(rng.choice(_PARQUET_TYPES)(frame[name]).alias(name))


def readings(rng: Random, rows: list[list[str]]) -> bytes:
    """Return a table of readings as Parquet."""
    head, *body = rows
    frame = {}
    for place, name in enumerate(head):
        cells: list[Any] = [row[place] for row in body]
        with contextlib.suppress(ValueError):
            cells = [float(cell) for cell in cells]
        kind = rng.random()
        if kind < 0.1:
            cells = [rng.choice((None, cell)) for cell in cells]
        elif kind < 0.15:
            cells = [str(cell) for cell in cells]
        elif kind < 0.2:
            cells = [[cell] for cell in cells]
        elif kind < 0.25:
            cells = [rng.choice((cell, float("nan"), float("inf"), 1e300)) for cell in cells]
        elif kind < 0.28:
            cells = [{"a": cell} for cell in cells]
        try:
            frame[name] = pl.Series(name, cells)
        except Exception:
            frame[name] = pl.Series(name, [str(cell) for cell in cells])
        if frame[name].dtype == pl.Float64 and rng.random() < 0.1:
            kinds = (pl.Float32, pl.Int8, pl.Datetime, pl.Duration, pl.Boolean, pl.Date, pl.Binary)
            frame[name] = frame[name].cast(rng.choice(kinds), strict=False)
    return _parquet(rng, _with_other_type(rng, pl.DataFrame(frame)))


def _levelled(frame: dict[str, pl.Series]) -> dict[str, pl.Series]:
    longest = max((len(series) for series in frame.values()), default=0)
    return {
        name: series.extend_constant(None, longest - len(series)) for name, series in frame.items()
    }


def _parquet(rng: Random, frame: pl.DataFrame) -> bytes:
    file = io.BytesIO()
    frame.write_parquet(
        file,
        compression=rng.choice(("uncompressed", "snappy", "gzip", "zstd", "lz4")),
        row_group_size=rng.choice((None, 100)),
    )
    content = file.getvalue()
    length = int.from_bytes(content[-8:-4], "little")
    return damaged(rng, content, (len(content) - 8 - length, len(content)))


def hdf5(rng: Random) -> bytes:
    """Return a record as HDF5."""
    return _hdf5(rng, "")


def mat73(rng: Random) -> bytes:
    """Return a record as MATLAB writes it since version 7.3: HDF5 after 512 bytes of its own."""
    return _hdf5(rng, "MATLAB 7.3 MAT-file".ljust(512))


def _hdf5(rng: Random, head: str) -> bytes:
    file = io.BytesIO()
    options = {"userblock_size": 512} if head else {}
    with h5py.File(file, "w", libver=rng.choice(("earliest", "latest")), **options) as h5:
        group = h5.create_group("run/1") if rng.random() < 0.2 else h5
        for name, values in _columns(rng).items():
            if sparse.issparse(values):
                group.create_group(name)["data"] = values.data
            elif isinstance(values, dict):
                group.create_group(name)
            else:
                _dataset(rng, group, name, np.asarray(values))
        if rng.random() < 0.1:
            group[record_files.TIME + "2"] = rng.choice(
                (h5py.SoftLink("/x"), h5py.ExternalLink("other.h5", "/x"))
            )
    content = bytearray(file.getvalue())
    content[: len(head)] = head.encode()
    return damaged(rng, bytes(content), (len(head), len(head) + 2500))


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


def _dataset(rng: Random, group: Any, name: str, values: np.ndarray) -> None:
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
    if "maxshape" in options and rng.random() < 0.3:  # says that it is longer than it is
        dataset.resize((rng.choice((10**4, 10**9, 10**15)), *values.shape[1:]))


def mat5(rng: Random) -> bytes:
    """Return a record as MATLAB writes it up to version 7."""
    file = io.BytesIO()
    columns = {name[:31]: values for name, values in _columns(rng).items()}
    columns = {name: values for name, values in columns.items() if name.isidentifier()}
    for name, values in columns.items():
        if np.asarray(values).dtype.kind == "M":
            columns[name] = np.asarray(values).astype("i8")
    savemat(file, columns, do_compression=rng.random() < 0.6, oned_as=rng.choice(("row", "column")))
    content = file.getvalue()
    if rng.random() < 0.5:
        content = _inside(rng, content)
    if rng.random() < 0.3:
        return content
    return damaged(rng, content, (0, 400))


def _inside(rng: Random, content: bytes) -> bytes:
    """Return a file with the elements changed, compressed ones before they were compressed."""
    made, at = content[:128], 128
    while at + 8 <= len(content):
        kind, size = struct.unpack("<II", content[at : at + 8])
        body = content[at + 8 : at + 8 + size]
        at += 8 + size
        if kind == 15:
            body = zlib.decompress(body)
        if rng.random() < 0.5:
            body = mutate_bytes(rng, body, (0, 80))
        if kind == 15:
            body = zlib.compress(body * rng.choice((1,) * 9 + (50,)))
        made += struct.pack("<II", kind, len(body)) + body
    return made


def tdms(rng: Random) -> bytes:
    """Return a record as LabVIEW writes it, in segments."""
    file = io.BytesIO()
    columns = _columns(rng)
    with TdmsWriter(file) as writer:
        for part in (slice(0, 200), slice(200, None)):
            channels = []
            for name, values in columns.items():
                kept = np.atleast_1d(np.asarray(values)) if isinstance(values, np.ndarray) else None
                if kept is not None and kept.ndim == 1 and kept.dtype.kind in "fiuU":
                    step = {"wf_increment": rng.choice((0.01, 0.0, 1e-300, "x"))}
                    given = step if rng.random() < 0.1 else {}
                    channels.append(ChannelObject("run", name, kept[part], given))
            if channels:
                writer.write_segment(channels)
    content = file.getvalue()
    place = rng.choice((0, content.rfind(b"TDSm")))
    if rng.random() < 0.2:  # as a recorder leaves it that stops in the middle of a segment
        return content[: rng.randrange(place, len(content))]
    return damaged(rng, content, (place, place + 600))


#: What is put into a sheet: cells far out, dimensions that are lies, numbers of texts that are not
#: there, entities.
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


def workbook(rng: Random, rows: list[list[str]]) -> bytes:
    """Return a table of readings as Excel writes it."""
    rate = 0.5 / sum(map(len, rows))
    table: list[list[Any]] = [[_cell(rng, text, rate) for text in row] for row in rows]
    sheets = {"Tumble": table}
    if rng.random() < 0.1:
        sheets[rng.choice(("", "Notes", "x" * 300, "\u202e"))] = rng.choice(([], [["a"]], table))
    file = io.BytesIO()
    write_workbook(file, sheets)
    if rng.random() < 0.1:
        return damaged(rng, file.getvalue(), None)
    return _repacked(rng, file)


def _cell(rng: Random, text: str, rate: float) -> Any:
    if rng.random() < rate:
        return _storable(rng.choice(HOSTILE))
    try:
        return float(text)
    except ValueError:
        return text


def _storable(value: Any) -> Any:
    return value if isinstance(value, int | float) else str(value)


def _repacked(rng: Random, file: io.BytesIO) -> bytes:
    """Return a workbook with some of its parts changed."""
    made = io.BytesIO()
    with zipfile.ZipFile(file) as whole, zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as new:
        for name in whole.namelist():
            content = whole.read(name)
            is_sheet = name.startswith("xl/worksheets")
            if is_sheet and rng.random() < 0.3:
                old, changed = rng.choice(_SHEET_TRICKS)
                content = content.replace(old.encode(), changed.encode(), rng.choice((1, 1, -1)))
            if rng.random() < (0.3 if is_sheet else 0.08):
                content = mutate_text(rng, content.decode()).encode("utf-8", "replace")
            if rng.random() < 0.97:
                new.writestr(name, content)
        if rng.random() < 0.05:
            new.writestr("xl/sharedStrings.xml", mutate_text(rng, _STRINGS))
    content = made.getvalue()
    if rng.random() < 0.02:
        content = _bomb(rng.choice(_FILLINGS))
    return damaged(rng, content, None) if rng.random() < 0.3 else content


_STRINGS = (
    '<sst xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main" count="4294967295" '
    'uniqueCount="4294967295"><si><t>a</t></si></sst>'
)


#: What fills the sheet of a bomb: blanks, rows, rows of texts and of formulas, a deep tree.
_FILLINGS = (
    b" ",
    b"<row><c><v>1</v></c></row>",
    b'<row><c t="inlineStr"><is><t>a</t></is></c></row>',
    b"<row><c><f>A1+1</f></c></row>",
    b"<a>",
)


@cache
def _bomb(piece: bytes) -> bytes:
    """Return a small workbook whose sheet is large, but not as large as would be refused."""
    file, made = io.BytesIO(), io.BytesIO()
    write_workbook(file, {"Tumble": [["a"], [1.0]]})
    with zipfile.ZipFile(file) as whole, zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as new:
        for name in whole.namelist():
            content = whole.read(name)
            if name.startswith("xl/worksheets"):
                filling = piece * (60_000_000 // len(piece))
                content = content.replace(b"</sheetData>", filling + b"</sheetData>")
            new.writestr(name, content)
    return made.getvalue()


def numpy_archive(rng: Random, whole: bytes) -> bytes:
    """Return what a study keeps: with other arrays in it, or with changed bytes."""
    if rng.random() < 0.4:
        return damaged(rng, whole, None)
    with np.load(io.BytesIO(whole)) as kept:
        arrays = dict(kept)
    name = rng.choice(list(arrays))
    kind = rng.randrange(6)
    if kind == 0:
        del arrays[name]
    elif kind == 1:
        arrays[name] = np.array("x" * 50)
    elif kind == 2 and arrays[name].dtype.kind in "fib":
        arrays[name] = arrays[name].astype(rng.choice(("f4", "i1", "c16", "U5", "?", "M8[s]")))
    elif kind == 3:
        arrays[name] = arrays[name][None]
    elif kind == 4 and arrays[name].ndim:
        arrays[name] = np.concatenate([arrays[name]] * 2)
    elif arrays[name].dtype.kind == "f":
        arrays[name] = arrays[name] * rng.choice((np.nan, 1e300, -1.0))
    else:
        arrays[name] = np.zeros((), dtype=arrays[name].dtype)
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()
