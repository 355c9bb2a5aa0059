"""Common interface of record files of all formats, and their columns in chunks.

A chunk contains consecutive rows, few enough for the processor cache.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import chain
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, BinaryIO, Self

import numpy as np

from counterspin.arrays import empty_aligned
from counterspin.errors import CounterspinError, DamagedFileError, RecordError
from counterspin.frozen import frozen
from counterspin.input import FileIdentity

if TYPE_CHECKING:
    import numpy as np
    import polars as pl

    from counterspin.records.sampling import SplitTime


Columns = dict[str, np.ndarray]

#: Approximate rows of a chunk: three columns fit into the second-level cache.
_CHUNK_ROWS = 65536


@frozen
class Chunk:
    """Consecutive rows of a record, arrays (n,), NaN for empty cells."""

    time: np.ndarray  #: s since the record's first sample.
    angle: np.ndarray | None  #: rad; None when the file has no angle column.
    signals: list[np.ndarray]  #: One array for each accelerometer, in the unit of its column.

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.time)

    def __getitem__(self, rows: np.ndarray) -> Chunk:
        """Return the rows at (m,) indices, or of an (n,) mask."""
        angle = None if self.angle is None else self.angle[rows]
        return Chunk(self.time[rows], angle, [signal[rows] for signal in self.signals])

    @property
    def columns(self) -> list[np.ndarray]:
        """Time, the angle if there is one, and the signals."""
        return [self.time, *([] if self.angle is None else [self.angle]), *self.signals]


def chunk_size(block: int) -> int:
    """Return the number of rows of a chunk, a multiple of the block."""
    return block * max(1, _CHUNK_ROWS // block)


def iter_chunks(
    batches: Iterator[Columns], choose_rows: Callable[[Columns], int]
) -> Iterator[Columns]:
    """Yield columns in chunks of a fixed number of rows, independent of the file's batches.

    batches: Consecutive batches of the file's columns.
    choose_rows: Function of the first rows that returns the number of rows of a chunk.
    """
    first_batches: list[Columns] = []
    for batch in batches:
        first_batches.append(batch)
        if sum(map(row_count, first_batches)) >= chunk_size(1):
            break
    if not sum(map(row_count, first_batches)):
        return
    first_batch = concatenate_batches(first_batches)
    chunk_rows = choose_rows(first_batch)
    # A chunk across two batches is copied to a buffer; other chunks are views.
    buffer = dict(zip(first_batch, empty_aligned(len(first_batch), chunk_rows), strict=True))
    filled_rows = 0
    for batch in chain([first_batch], batches):
        rows = row_count(batch)
        start = 0
        while start < rows:
            stop = min(start + chunk_rows - filled_rows, rows)
            if stop - start == chunk_rows:
                yield {name: column[start:stop] for name, column in batch.items()}
            else:
                for name, column in batch.items():
                    buffer[name][filled_rows : filled_rows + stop - start] = column[start:stop]
                filled_rows += stop - start
            if filled_rows == chunk_rows:
                yield buffer
                filled_rows = 0
            start = stop
    if filled_rows:
        yield {name: column[:filled_rows] for name, column in buffer.items()}


def concatenate_batches(batches: list[Columns]) -> Columns:
    """Concatenate the columns of several batches."""
    if len(batches) == 1:
        return batches[0]
    return {name: np.concatenate([batch[name] for batch in batches]) for name in batches[0]}


def row_count(columns: Columns) -> int:
    """Return the length of the columns."""
    return len(next(iter(columns.values())))


#: Largest ratio of the values' bytes to the file size: an even clock compresses well, noise does
#: not.
_UNPACKED_RATIO = 200
#: Bytes of values that are accepted for any file size.
_UNPACKED_BYTES = 64_000_000


#: Beginnings of month names; units of MATLAB durations -> s.
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_SECONDS_BY_UNIT = {"us|usecs?": 1e-6, "ms|msecs?": 1e-3, "s|secs?": 1.0, "min": 60.0, "hr": 3600.0}
#: Length of a day, ns.
_DAY_NS = 86_400_000_000_000
#: Values of SCPI instruments for overflow and for not-a-number (SCPI-99, 7.2.1.4).
_SCPI_OVERFLOW = 9.9e37
_SCPI_NAN = 9.91001e37


@contextmanager
def record_errors(path: Path, describe_position: Callable[[], str] = str) -> Iterator[None]:
    """Convert all exceptions of a reader to a `RecordError` that names the file.

    Messages of libraries are omitted, because they name calls that users do not make.

    describe_position: Returns the position of the reader, such as ``" after row 12"``; or empty.
    """
    try:
        yield
    except (CounterspinError, KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    except PermissionError:
        raise RecordError(
            f"{path}: the file cannot be read. Check the permissions of the file.",
            code="file-not-readable",
        ) from None
    except FileNotFoundError:
        raise RecordError(f"{path}: file not found", code="file-not-found") from None
    except OSError as error:
        if error.errno is None:  # raised by a library
            raise DamagedFileError(_damage_message(path, describe_position())) from error
        raise RecordError(
            f"{path}: the file cannot be read{describe_position()}: {error.strerror}.",
            code="file-not-readable",
        ) from None
    except MemoryError:
        raise DamagedFileError(
            f"{path}: reading the file requires more memory than is available"
            f"{describe_position()}.",
            code="out-of-memory",
        ) from None
    # Polars raises a panic as an exception that is not an `Exception`.
    except BaseException as error:
        raise DamagedFileError(_damage_message(path, describe_position())) from error


def _damage_message(path: Path, position: str) -> str:
    return (
        f"{path}: the file is damaged{position}, or it contains data that counterspin cannot read. "
        "Export the file again, or export it as CSV."
    )


class NoRowsError(RecordError):
    """Error for a sheet without rows of numbers below column names."""

    code = "no-rows"


class ColumnFile(ABC):
    """The named columns of an open record file, as a context manager.

    On exit, RecordError if the file has changed since it was opened.
    """

    delimiter = ","
    decimal = "."
    #: Column -> normalised unit in the file; empty if not stated.
    units: dict[str, str]
    interval: float | None  #: Sampling interval stated in the file, s; or None.
    #: Whether the units are in a separate row, and not in brackets after the names.
    units_row: bool
    #: Columns to read as time stamps: seconds since the first one. Set it before reading.
    timestamp_columns: frozenset[str]
    first_timestamp: int | None  #: First time stamp, ns; None: unknown.
    format_description: str  #: Detected format, if it is not plain.
    footer: tuple[str, ...] = ()  #: Lines at the end that are not rows.
    runs: tuple[str, ...] = ()  #: Groups with the same columns, one run each.
    selection: np.ndarray | None = None  #: Mask of the selected rows; None: all.

    def __init__(self, path: Path, stream: BinaryIO) -> None:
        self.path = path
        self.names: list[str] = []
        self.identity: FileIdentity | None = FileIdentity.from_file(stream.fileno())
        self.units, self.units_row = {}, False
        self.timestamp_columns, self.format_description = frozenset(), ""
        self.first_timestamp, self.interval = None, None
        self._midnight_counts: dict[str, tuple[int, int]] = {}
        self._stream = stream

    def __enter__(self) -> Self:
        """Return the file."""
        return self

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close the file; RecordError if it has changed since it was opened."""
        self._stream.close()
        if isinstance(error, Exception) or error is None:
            with record_errors(self.path):
                if FileIdentity.from_file(self.path) != self.identity:
                    raise RecordError(
                        f"{self.path}: the file was changed while counterspin was reading it. "
                        "Wait until the file is complete.",
                        code="file-changed",
                    )

    def require(self, names: Sequence[str]) -> None:
        """Raise `RecordError` unless the file has the columns and they can contain numbers."""
        names = self._columns_in_file(names)
        missing_names = [name for name in names if not self.has_column(name)]
        if missing_names:
            raise RecordError(
                f"{self.path}: {self._missing_columns_message(missing_names)}",
                code="missing-column",
            )
        with record_errors(self.path):
            self._require(names)

    def has_column(self, name: str) -> bool:
        """Return True if the file has a column of this name."""
        return name in self.names

    def batches(self, names: Sequence[str]) -> Iterator[Columns]:
        """Yield columns that `require` has accepted in consecutive batches."""
        rows = 0
        with record_errors(self.path, lambda: f" after row {rows}" if rows else ""):
            for batch in self._batches(self._columns_in_file(names)):
                count = row_count(batch)
                batch = {name: self._derive_column(batch, name) for name in names}  # noqa: PLW2901
                if self.selection is not None:
                    mask = self.selection[rows : rows + count]
                    batch = {name: values[mask] for name, values in batch.items()}  # noqa: PLW2901
                yield {name: mask_overflow(values) for name, values in batch.items()}
                rows += count

    def _columns_in_file(self, names: Sequence[str]) -> list[str]:
        """Return the file's columns from which columns are derived: two for a split time."""
        file_columns: list[str] = []
        for name in names:
            split_time = None if self.has_column(name) else _parse_split_time(name)
            file_columns += [split_time.coarse, split_time.fine] if split_time else [name]
        return list(dict.fromkeys(file_columns))

    def _derive_column(self, batch: Columns, name: str) -> np.ndarray:
        """Return a column of a batch; a split time as seconds since the first one."""
        split_time = None if name in batch else _parse_split_time(name)
        if split_time is None:
            return batch[name]
        import polars as pl

        times, is_valid = split_time.nanoseconds(batch)
        return self.elapsed_seconds(
            pl.select(pl.when(pl.Series(is_valid)).then(pl.Series(times))).to_series()
        )

    def read_columns(self, names: Sequence[str]) -> Columns:
        """Return whole columns that `require` has accepted, with the strict parser if needed."""
        try:
            batches = list(self.batches(names))
        except RecordError:
            if not self.use_strict_parser():
                raise
            batches = list(self.batches(names))
        if not batches:
            raise RecordError(f"{self.path}: the file has no rows of data.", code="no-rows")
        return concatenate_batches(batches)

    def table(self) -> pl.DataFrame:
        """Return the whole file; text cells remain text."""
        with record_errors(self.path):
            table = self._table()
            return table if self.selection is None else table.filter(self.selection)

    def select(self, column: str, value: str) -> None:
        """Select the rows in which a column has a value."""
        import numpy as np

        if not self.has_column(column):
            raise RecordError(
                f"{self.path}: select: {self._missing_columns_message([column])}",
                code="missing-column",
            )
        cells = [cell.strip() for cell in self.all_cells(column)]
        mask = np.array([_is_same_cell(cell, value) for cell in cells])
        if not mask.any():
            values = format_names(sorted(set(cells)), 8)
            raise RecordError(
                f"{self.path}: select: column '{column}' does not contain the value '{value}'; "
                f"it contains {values}.",
                code="no-rows",
            )
        self.selection = mask
        description = f"rows with {value} in column '{column}'"
        self.format_description = (
            f"{self.format_description}, {description}" if self.format_description else description
        )

    def all_cells(self, column: str) -> list[str]:
        """Return all cells of a column, as text."""
        with record_errors(self.path):
            return self._cells(column)

    def _cells(self, column: str) -> list[str]:
        """Return all cells of a column as text."""
        batches = self._batches([column])
        return [f"{value:.12g}" for batch in batches for value in batch[column].tolist()]

    def locate_row(self, row: int) -> str:
        """Return the location of a row in the file, such as ``row 12``; rows as selected."""
        if self.selection is None:
            return self.locate(row)
        import numpy as np

        indices = np.flatnonzero(self.selection)
        return self.locate(int(indices[min(row, len(indices) - 1)]))

    def content(self) -> bytes:
        """Return the bytes of the file."""
        with record_errors(self.path):
            self._stream.seek(0)
            return self._stream.read()

    def locate(self, row: int) -> str:
        """Return the location in the file of a data row, counted from 0."""
        return f"row {row + 1}"

    def row_locations(self, rows: int) -> list[str]:
        """Return the locations of the data rows in the file."""
        return [self.locate_row(row) for row in range(rows)]

    def use_strict_parser(self) -> bool:
        """Switch to the strict parser; return False if there is none or it is in use."""
        return False

    def single_numbers(self) -> dict[str, float]:
        """Return name -> scalar value in addition to the columns."""
        return {}

    def first_cells(self, names: Sequence[str], count: int) -> dict[str, list[str]]:
        """Return the first cells of columns, as text; unreadable columns are omitted."""
        cells = {}
        for name in names:
            with suppress(RecordError), record_errors(self.path):
                self._require([name])
                cells[name] = self._first_cells(name, count)
        return cells

    def _first_cells(self, name: str, count: int) -> list[str]:
        """Return the first cells of a column of numbers, as text."""
        batch = next(self._batches([name]), None)
        return [] if batch is None else [f"{value:.12g}" for value in batch[name][:count]]

    def preview(self) -> str:
        """Describe the first lines of a text file, one line each; empty for other files."""
        return ""

    def elapsed_seconds(self, timestamps: pl.Series) -> np.ndarray:
        """Return time stamps, ns with gaps, as seconds since the first one of the file.

        Times of day without a date continue after midnight.
        """
        import numpy as np

        stamps = timestamps.drop_nulls().to_numpy()
        if self.first_timestamp is None and len(stamps):
            self.first_timestamp = int(stamps[0])
            self._midnight_counts = {}
        # Integers keep nanoseconds; seconds since 1970 in floating point do not.
        elapsed = (timestamps - (self.first_timestamp or 0)).to_numpy().astype(float)
        if len(stamps) and stamps.min() >= 0 and stamps.max() < _DAY_NS:  # times without dates
            last_stamp, days = self._midnight_counts.get(timestamps.name, (int(stamps[0]), 0))
            days_passed = days + np.cumsum(np.diff(stamps, prepend=last_stamp) < -_DAY_NS // 2)
            elapsed[timestamps.is_not_null().to_numpy()] += days_passed * float(_DAY_NS)
            self._midnight_counts[timestamps.name] = int(stamps[-1]), int(days_passed[-1])
        return elapsed * 1e-9

    def _require(self, names: Sequence[str]) -> None:  # noqa: B027
        """Implement `require` for existing columns."""

    @abstractmethod
    def _batches(self, names: Sequence[str]) -> Iterator[Columns]:
        """Implement `batches`."""

    @abstractmethod
    def _table(self) -> pl.DataFrame:
        """Implement `table`."""

    def _missing_columns_message(self, missing_names: Sequence[str]) -> str:
        from difflib import get_close_matches

        missing_text, existing_text = format_names(missing_names), format_names(self.names)
        noun = "column" if len(missing_names) == 1 else "columns"
        message = f"the file has no {noun} {missing_text}; it has {existing_text}."
        matches = get_close_matches(missing_names[0], self.names, n=1)
        return message + (f" Did you mean '{matches[0]}'?" if matches else "")

    def _check_size(self, required_bytes: int) -> None:
        """Raise DamagedFileError for more values than a file of this size can contain."""
        file_bytes = self.identity.size if self.identity else 0
        if required_bytes > _UNPACKED_BYTES + _UNPACKED_RATIO * file_bytes:
            raise DamagedFileError(
                f"{self.path}: the file is damaged. It contains {file_bytes} bytes, but its header "
                f"specifies {required_bytes} bytes of data."
            )


def _parse_split_time(name: str) -> SplitTime | None:
    """Return the columns of a split time, ``sec [s] + nanosec [ns]``; None for other names."""
    if "] + " not in name:
        return None
    from counterspin.records.sampling import SplitTime

    return SplitTime.parse(name)


def _is_same_cell(cell: str, value: str) -> bool:
    """Return True if a cell equals a value, as text or as a number."""
    if cell == value.strip():
        return True
    try:
        return float(cell) == float(value)
    except ValueError:
        return False


def mask_overflow(values: np.ndarray) -> np.ndarray:
    """Replace the overflow values of SCPI instruments by NaN."""
    import numpy as np

    if values.max(initial=0.0) < _SCPI_OVERFLOW and values.min(initial=0.0) > -_SCPI_OVERFLOW:
        return values  # NaN fails both tests
    is_overflow = np.abs(values) >= _SCPI_OVERFLOW
    if not is_overflow.any() or (np.abs(values[is_overflow]) > _SCPI_NAN).any():
        return values
    return np.where(is_overflow, np.nan, values)


def format_names(names: Sequence[str], max_names: int = 20) -> str:
    """Format column names for a message, in quotation marks, and abbreviate a long list."""
    quoted_names = ", ".join(f"'{name}'" for name in names[:max_names])
    return (
        quoted_names + (f" and {len(names) - max_names} more" if len(names) > max_names else "")
        or "none"
    )


def frame_columns(frame: pl.DataFrame) -> Columns:
    """Return the columns of a frame as arrays."""
    return {column.name: column.to_numpy() for column in frame.get_columns()}


def polars_path(path: Path) -> str:
    """Return an absolute path as text for polars; RecordError if it is not valid UTF-8."""
    text = str(path.absolute())
    try:
        text.encode()
    except UnicodeEncodeError:
        path_text = text.encode(errors="replace").decode()
        raise RecordError(
            f"{path_text}: the path is not valid UTF-8; rename the folder.", code="invalid-name"
        ) from None
    return text


def parse_nanoseconds(name: str) -> pl.Expr:
    """Parse the time stamps of a text column to integers, ns; null for other text.

    With a date, they count since 1970 (UTC, or local time without a zone); without one, since
    midnight. Fractions may follow a comma or a colon; a blank may replace the T. In 1/2/2026 the
    month is first, unless it is above 12; in 1.2.2026 the day. Months may have English names,
    `05-Mar-2024 10:00:00.02`, `Tue Mar  5 10:00:00 2024`, and durations a unit, `0.02 sec`.
    """
    import polars as pl

    text = pl.col(name).str.strip_chars().str.replace(",", ".", literal=True)
    text = text.str.replace(r"(:\d\d:\d\d):(\d+)$", "${1}.${2}")
    text = text.str.replace(r"^(\d{1,3}:\d\d\.\d+)$", "00:${1}")
    text = text.str.replace(r"^(\d{4})/(\d\d?)/", "${1}-${2}-")
    text = text.str.replace(
        r"^(\d{4})(\d\d)(\d\d)[T ](\d\d)(\d\d)(\d\d)", "${1}-${2}-${3} ${4}:${5}:${6}"
    )
    text = text.str.replace(r"(?i)^[a-z]{3}[,.]? ([a-z]{3}|\d\d?) ", "${1} ")
    text = text.str.replace(r"(?i)^([a-z]{3})[a-z]* +(\d\d?)[,.]? +(\d{4})", "${2} ${1} ${3}")
    text = text.str.replace(r"(?i)^([a-z]{3}) +(\d\d?) ([\d:.]+) (\d{4})$", "${2} ${1} ${4} ${3}")
    for number, month in enumerate(_MONTHS, 1):
        date_pattern = rf"(?i)^(\d\d?)[- ]{month}[a-z]*[- ](\d{{4}})"
        text = text.str.replace(date_pattern, f"${{2}}-{number:02}-${{1}}")
    duration = pl.lit(None, pl.Float64)
    for unit_pattern, unit_seconds in _SECONDS_BY_UNIT.items():
        number_text = text.str.extract(rf"^(\d+(?:\.\d+)?(?:[eE][-+]?\d+)?) ?(?:{unit_pattern})$")
        duration = pl.coalesce(
            duration, number_text.cast(pl.Float64, strict=False) * (unit_seconds * 1e9)
        )
    text = text.str.replace(r"^(\d\d?)\.(\d\d?)\.(\d{4})", "${3}-${2}-${1}")
    text = text.str.replace(r"^(1[3-9]|[23]\d)/(\d\d?)/(\d{4})", "${3}-${2}-${1}")
    text = text.str.replace(r"^(\d\d?)/(\d\d?)/(\d{4})", "${3}-${1}-${2}")
    text = text.str.replace(r" ?([AaPp][Mm])$", "${1}")
    text = text.str.replace(" ", "T", literal=True).str.replace(r"(Z| ?UTC| ?GMT)$", "+00:00")
    iso_dates = pl.when(text.str.contains(r"^\d{4}-")).then(text)
    text = iso_dates.otherwise(pl.concat_str([pl.lit("1970-01-01T"), text]))
    has_zone = text.str.contains(r"[+-]\d\d:?\d\d$")
    datetime_format = "%Y-%m-%dT%H:%M:%S%.f"
    has_am_pm = text.str.contains(r"[AaPp][Mm]$")
    text_24h = pl.when(~has_zone & ~has_am_pm).then(text).str
    text_12h = pl.when(has_am_pm).then(text).str
    local_times = pl.coalesce(
        text_24h.to_datetime(datetime_format, time_unit="ns", strict=False),
        text_12h.to_datetime("%Y-%m-%dT%I:%M:%S%.f%p", time_unit="ns", strict=False),
    )
    zoned_text = pl.when(has_zone).then(text)
    utc_times = zoned_text.str.to_datetime(
        f"{datetime_format}%z", time_unit="ns", time_zone="UTC", strict=False
    )
    timestamps = pl.coalesce(utc_times.dt.replace_time_zone(None), local_times).cast(pl.Int64())
    return pl.coalesce(timestamps, duration.round().cast(pl.Int64, strict=False)).alias(name)
