"""Record files as streams of columns: CSV, Parquet, HDF5 and MATLAB files look alike from here.

`open_columns` checks that the file and its columns exist and returns a `ColumnFile`, which yields
the columns in batches of float64 arrays (an empty cell is NaN) and tells where a row stands in
the file, in the words a person needs to find it: the line of a text editor for CSV, the row else.
Nothing here judges the numbers; `records` does.
"""

from __future__ import annotations

import csv
import difflib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from counterspin.errors import RecordError

if TYPE_CHECKING:
    import polars as pl

Columns = list[np.ndarray]

#: Rows read at a time from HDF5 (24 MB for three columns).
_HDF5_BATCH = 1_000_000
#: No line of column names is longer, in bytes.
_LONGEST_HEADER = 100_000
#: What counts as an empty cell of a CSV file, in lower case and without surrounding blanks.
_EMPTY_WORDS = ("", "nan")


def open_columns(path: Path, names: Sequence[str]) -> ColumnFile:
    """Open a record file to read the named columns.

    Parameters
    ----------
    path
        A file ending in .csv, .txt, .tsv, .parquet, .h5, .hdf5 or .mat.
    names
        The columns wanted, as the file calls them.

    Raises
    ------
    RecordError
        The file is missing, unreadable, empty, of an unknown kind, or lacks a column.
    """
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        known = ", ".join(sorted(_READERS))
        raise RecordError(f"{path}: a record file ends in one of {known}; this one does not.")
    try:
        if not path.exists():
            raise RecordError(f"{path}: there is no such file.")
        if path.is_dir():
            raise RecordError(f"{path}: this is a directory; a record is a file.")
        if path.stat().st_size == 0:
            raise RecordError(f"{path}: the file is empty.")
        return reader(path, names)
    except PermissionError:
        raise RecordError(f"{path}: the file cannot be read; check its permissions.") from None
    except OSError as error:
        reason = error.strerror or str(error).splitlines()[0]
        raise RecordError(f"{path}: the file cannot be read: {reason}.") from None


class ColumnFile(ABC):
    """The named columns of one record file."""

    def __init__(self, path: Path, names: Sequence[str]) -> None:
        self.path = path
        self.names = list(names)

    @abstractmethod
    def batches(self) -> Iterator[Columns]:
        """Yield the columns, in the order asked for, in consecutive batches of equal length."""

    def table(self) -> pl.DataFrame:
        """Return the whole file as it stands, cells of text remaining text.

        Raises
        ------
        RecordError
            The file is not a table.
        """
        raise RecordError(f"{self.path}: a table is needed here: a .csv or .parquet file.")

    def locate(self, row: int) -> str:
        """Say where data row `row` (counted from 0) stands in the file."""
        return f"row {row + 1}"

    def _require(self, present: Sequence[str]) -> None:
        missing = [name for name in self.names if name not in present]
        if not missing:
            return
        close = difflib.get_close_matches(missing[0], present, n=1)
        words = f"there is no column {_quoted(missing)}; the file has {_quoted(present)}."
        if close:
            words += f" Did you mean '{close[0]}'?"
        raise RecordError(f"{self.path}: {words}")


def _quoted(names: Sequence[str], cap: int = 20) -> str:
    listed = ", ".join(f"'{name}'" for name in names[:cap])
    return listed + (f" and {len(names) - cap} more" if len(names) > cap else "") or "none"


def _arrays(frame: pl.DataFrame) -> Columns:
    return [column.to_numpy() for column in frame.get_columns()]


class CsvFile(ColumnFile):
    """A text table with a header line; cells parted by comma, semicolon or tab; '#' comments."""

    def __init__(self, path: Path, names: Sequence[str]) -> None:
        super().__init__(path, names)
        self._find_header()
        self._require(self._header)
        # Looking out for comments takes the parser half as long again. A comment cannot pass for
        # a number, so where the first column is read the strict parser stops at it by itself.
        self._comments = self._header[0] not in names
        for name in self.names:
            if self._header.count(name) > 1:
                raise RecordError(f"{path}: two columns of the header are named '{name}'.")

    def _find_header(self) -> None:
        number = blank = 0
        with self.path.open("rb") as file:
            for raw in file:
                number += 1
                line = raw.decode("utf-8-sig", errors="replace").strip("\r\n")
                odd = "\ufffd" in line or any(c < " " and c != "\t" for c in line)
                if odd or len(raw) > _LONGEST_HEADER:
                    raise RecordError(
                        f"{self.path}, line {number}: this is not text in UTF-8; a .csv file holds "
                        "a line of column names and lines of numbers."
                    )
                if line.strip() and not line.startswith("#"):
                    break
            else:
                raise RecordError(f"{self.path}: the file has no header line and no rows.")
            for raw in file:
                # Among the rows a blank line is a row of empty cells; here it stops the parser.
                if raw.strip():
                    break
                blank += 1
        self._before_rows = number + blank
        # The delimiter is the one that the header uses most; a lone column has none.
        self._separator = max(",;\t", key=line.count)
        cells = next(csv.reader([line], delimiter=self._separator))
        self._header = [cell.strip() for cell in cells]
        if all(_is_number(cell) for cell in self._header):
            raise RecordError(
                f"{self.path}, line {number}: the first line must name the columns, "
                f"but it holds numbers: {line[:60]}"
            )

    def _scan(self, wanted: Any) -> pl.LazyFrame:
        import polars as pl

        # An explicit type for every column: a type guessed from the first lines breaks on a
        # column that looks whole at the start. Unwanted columns are never parsed.
        schema = {
            name if name not in self._header[:place] else f"{name} ({place})": (
                wanted if name in self.names else pl.String()
            )
            for place, name in enumerate(self._header)
        }
        return pl.scan_csv(
            self.path,
            separator=self._separator,
            has_header=False,  # read above: blanks around the names are no part of them
            skip_lines=self._before_rows,
            comment_prefix="#" if self._comments else None,
            schema=schema,
            encoding="utf8-lossy",
        ).select(self.names)

    def table(self) -> pl.DataFrame:
        """Return every column of the file as text; comments are left out."""
        import polars as pl

        whole = CsvFile(self.path, self._header)
        whole._comments = True
        return whole._scan(pl.String()).collect()

    def batches(self) -> Iterator[Columns]:
        """Yield batches of the columns; text in a cell raises `RecordError` with its line."""
        import polars as pl

        done = 0
        try:
            for frame in self._scan(pl.Float64()).collect_batches(maintain_order=True):
                yield _arrays(frame)
                done += frame.height
        except pl.exceptions.NoDataError:
            return
        except pl.exceptions.PolarsError:
            # The strict parser says no more than the cell's text. Find out where it stands; if it
            # is a comment, or blanks around the numbers, go on from there with the tolerant one.
            self._comments = True
            self._refuse_bad_cells()
            cells = pl.all().str.strip_chars().cast(pl.Float64(), strict=False)
            frames = self._scan(pl.String()).select(cells).slice(done)
            for frame in frames.collect_batches(maintain_order=True):
                yield _arrays(frame)

    def _refuse_bad_cells(self) -> None:
        import polars as pl

        number, width = self._widest_line()
        if width > len(self._header):
            raise RecordError(
                f"{self.path}, line {number}: the line has {width} cells, "
                f"the header names {len(self._header)}."
            )
        text = pl.all().str.strip_chars()
        bad = text.cast(pl.Float64(), strict=False).is_null() & ~text.str.to_lowercase().is_in(
            list(_EMPTY_WORDS)
        )
        marks = self._scan(pl.String()).select(bad.fill_null(False))
        rows = (
            marks.with_row_index("#row")
            .filter(pl.any_horizontal(self.names))
            .head(1)
            .collect(engine="streaming")
        )
        if rows.is_empty():
            return
        row = int(rows["#row"][0])
        column = next(name for name in self.names if rows[name][0])
        cell = str(self._scan(pl.String()).select(column).slice(row, 1).collect().item())
        hint = ""
        if _is_number(cell.replace(",", ".")):
            hint = " Write numbers with a decimal point, not a comma."
        raise RecordError(
            f"{self.path}, {self.locate(row)}: column '{column}' holds the text '{cell[:40]}' "
            f"where a number belongs.{hint}"
        )

    def _widest_line(self) -> tuple[int, int]:
        """Return the first line with more cells than the header, or the last line."""
        number, width = 0, 0
        with self.path.open(encoding="utf-8", errors="replace", newline="") as file:
            for number, line in enumerate(file, start=1):
                if line.count(self._separator) < len(self._header) or line.startswith("#"):
                    continue
                width = len(next(csv.reader([line.rstrip("\r\n")], delimiter=self._separator)))
                if width > len(self._header):
                    return number, width
        return number, 0

    def locate(self, row: int) -> str:
        """Say on which line, as a text editor counts them, data row `row` stands."""
        # A comment takes a line and is no row; only a pass over the file tells where they are.
        with self.path.open("rb") as file:
            body = islice(enumerate(file, start=1), self._before_rows, None)
            data = (number for number, line in body if not line.startswith(b"#"))
            number = next(islice(data, row, None), row + self._before_rows + 1)
        return f"line {number}"


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


class ParquetFile(ColumnFile):
    """A Parquet file with numeric columns."""

    def __init__(self, path: Path, names: Sequence[str]) -> None:
        import polars as pl

        super().__init__(path, names)
        try:
            schema = pl.scan_parquet(path).collect_schema()
        except pl.exceptions.PolarsError:
            raise RecordError(f"{path}: this is not a readable Parquet file.") from None
        self._require(schema.names())
        for name in names:
            if not schema[name].is_numeric():
                raise RecordError(
                    f"{path}: column '{name}' is of type {schema[name]}; numbers belong there."
                )

    def table(self) -> pl.DataFrame:
        """Return every column of the file with its type."""
        import polars as pl

        return pl.read_parquet(self.path)

    def batches(self) -> Iterator[Columns]:
        """Yield batches of the columns as the streaming engine decodes them."""
        import polars as pl

        frames = pl.scan_parquet(self.path).select(pl.col(self.names).cast(pl.Float64()))
        try:
            for frame in frames.collect_batches(maintain_order=True):
                yield _arrays(frame)
        except pl.exceptions.PolarsError as error:
            reason = str(error).splitlines()[0]
            raise RecordError(f"{self.path}: the Parquet file is damaged: {reason}") from None


class ArraysFile(ColumnFile):
    """A file of named one-dimensional arrays: HDF5, or MATLAB in either of its formats.

    HDF5 datasets stand at the root or in one group (`group/name` names any other). MATLAB keeps
    its arrays as columns or rows; both are read as they stand.
    """

    def __init__(self, path: Path, names: Sequence[str]) -> None:
        import h5py

        super().__init__(path, names)
        self._hdf5 = bool(h5py.is_hdf5(path))
        if not self._hdf5 and path.suffix.lower() != ".mat":
            raise RecordError(f"{path}: this is not an HDF5 file.")
        with self._arrays() as arrays:
            self._require(list(arrays))
            lengths = {}
            for name in names:
                array = arrays[name]
                if array.dtype.kind not in "fiu":
                    raise RecordError(f"{path}: '{name}' does not hold numbers.")
                # HDF5 has datasets without any space, whose shape is None.
                if array.shape is None or array.size != max(array.shape, default=0):
                    raise RecordError(
                        f"{path}: '{name}' has the shape {array.shape}; one column is needed."
                    )
                lengths[name] = array.size
        if len(set(lengths.values())) > 1:
            listed = ", ".join(f"'{name}' {length}" for name, length in lengths.items())
            raise RecordError(f"{path}: the columns differ in length: {listed}.")
        self._length = max(lengths.values(), default=0)

    def _arrays(self) -> Any:
        return _hdf5_arrays(self.path) if self._hdf5 else _matlab_arrays(self.path, self.names)

    def batches(self) -> Iterator[Columns]:
        """Yield slices of the arrays."""
        with self._arrays() as arrays:
            for start in range(0, self._length, _HDF5_BATCH):
                stop = min(start + _HDF5_BATCH, self._length)
                yield [_slice(arrays[name], start, stop) for name in self.names]


def _slice(array: Any, start: int, stop: int) -> np.ndarray:
    index = tuple(slice(start, stop) if size > 1 else 0 for size in array.shape)
    return np.atleast_1d(np.asarray(array[index], dtype=float))


class _hdf5_arrays:  # noqa: N801 - used as a function
    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> dict[str, Any]:
        import h5py

        self._file = h5py.File(self._path, "r")
        found: dict[str, Any] = {}
        self._file.visititems(
            lambda name, item: found.update({name: item}) if hasattr(item, "dtype") else None
        )
        groups = {name.rpartition("/")[0] for name in found}
        if len(groups) == 1:
            return {name.rpartition("/")[2]: item for name, item in found.items()}
        return found

    def __exit__(self, *_: object) -> None:
        self._file.close()


class _matlab_arrays:  # noqa: N801 - used as a function
    def __init__(self, path: Path, names: Sequence[str]) -> None:
        self._path, self._names = path, names

    def __enter__(self) -> dict[str, Any]:
        from scipy.io import loadmat, whosmat

        try:
            present = [name for name, _, _ in whosmat(self._path)]
            arrays = loadmat(self._path, variable_names=self._names)
        except (ValueError, TypeError, NotImplementedError) as error:
            raise RecordError(f"{self._path}: this is not a MATLAB file: {error}.") from None
        return {name: arrays.get(name) for name in present}

    def __exit__(self, *_: object) -> None: ...


_READERS: dict[str, Callable[[Path, Sequence[str]], ColumnFile]] = {
    ".csv": CsvFile,
    ".txt": CsvFile,
    ".tsv": CsvFile,
    ".parquet": ParquetFile,
    ".h5": ArraysFile,
    ".hdf5": ArraysFile,
    ".mat": ArraysFile,
}
