"""Interface of record files of all formats, and their columns in chunks.

A chunk is a number of consecutive rows that fits the processor's cache.
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

#: Rows in a chunk, about: three columns of them fit the processor's second cache.
_CHUNK_ROWS = 65536


@frozen
class Chunk:
    """Consecutive rows of a record, arrays (n,), NaN where a cell is empty."""

    time: np.ndarray  #: s since the record's first sample.
    angle: np.ndarray | None  #: rad; None when the file has no angle column.
    signals: list[np.ndarray]  #: One array for each accelerometer, in the unit of its column.

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.time)

    def __getitem__(self, rows: np.ndarray) -> Chunk:
        """Return the rows at (m,) places, or those that a (n,) mask marks."""
        angle = None if self.angle is None else self.angle[rows]
        return Chunk(self.time[rows], angle, [signal[rows] for signal in self.signals])

    @property
    def columns(self) -> list[np.ndarray]:
        """Time, the angle if there is one, and the signals."""
        return [self.time, *([] if self.angle is None else [self.angle]), *self.signals]


def chunk_size(block: int) -> int:
    """Return the rows of a chunk: a whole number of blocks."""
    return block * max(1, _CHUNK_ROWS // block)


def iter_chunks(
    batches: Iterator[Columns], choose_rows: Callable[[Columns], int]
) -> Iterator[Columns]:
    """Yield columns in chunks of a fixed number of rows, whatever the file's batches.

    batches: Consecutive batches of the file's columns.
    """
    head: list[Columns] = []
    for batch in batches:
        head.append(batch)
        if sum(map(row_count, head)) >= chunk_size(1):
            break
    if not sum(map(row_count, head)):
        return
    first = concatenate_batches(head)
    chunk_rows = choose_rows(first)
    # What lies across two batches is brought together in a buffer; the rest are views.
    buffer = dict(zip(first, empty_aligned(len(first), chunk_rows), strict=True))
    filled = 0
    for batch in chain([first], batches):
        rows = row_count(batch)
        start = 0
        while start < rows:
            stop = min(start + chunk_rows - filled, rows)
            if stop - start == chunk_rows:
                yield {name: column[start:stop] for name, column in batch.items()}
            else:
                for name, column in batch.items():
                    buffer[name][filled : filled + stop - start] = column[start:stop]
                filled += stop - start
            if filled == chunk_rows:
                yield buffer
                filled = 0
            start = stop
    if filled:
        yield {name: column[:filled] for name, column in buffer.items()}


def concatenate_batches(batches: list[Columns]) -> Columns:
    """Return the columns of several batches, one batch after the other."""
    if len(batches) == 1:
        return batches[0]
    return {name: np.concatenate([batch[name] for batch in batches]) for name in batches[0]}


def row_count(columns: Columns) -> int:
    """Return the length of the columns."""
    return len(next(iter(columns.values())))


#: A cell's values of 8 bytes may take this many times the file's size, packed as they may be: an
#: even clock packs into nothing, but noise does not.
_UNPACKED_RATIO = 200
#: Bytes that the values of any file may take.
_UNPACKED_BYTES = 64_000_000


#: Names of months begin with these, and durations as MATLAB writes them end in these units, s.
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_DURATIONS = {"us|usecs?": 1e-6, "ms|msecs?": 1e-3, "s|secs?": 1.0, "min": 60.0, "hr": 3600.0}
#: A day, ns.
_DAY = 86_400_000_000_000
#: What SCPI instruments write for more than they measure, and for no number (SCPI-99, 7.2.1.4).
_OVERFLOW = 9.9e37
_NOT_A_NUMBER = 9.91001e37


@contextmanager
def record_errors(path: Path, where: Callable[[], str] = str) -> Iterator[None]:
    """Turn whatever a reader raises into a `RecordError` that names the file.

    The words of libraries are left out: they name calls and options that a user does not have.

    where: Says how far reading has come, such as ``" after row 12"``; nothing as long as is
        unknown.
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
        if error.errno is None:  # a library's
            raise DamagedFileError(_damage_message(path, where())) from error
        raise RecordError(
            f"{path}: the file cannot be read{where()}: {error.strerror}.", code="file-not-readable"
        ) from None
    except MemoryError:
        raise DamagedFileError(
            f"{path}: reading the file requires more memory than is available{where()}.",
            code="out-of-memory",
        ) from None
    # Polars turns a panic into an exception that is no `Exception`.
    except BaseException as error:
        raise DamagedFileError(_damage_message(path, where())) from error


def _damage_message(path: Path, where: str) -> str:
    return (
        f"{path}: the file is damaged{where}, or it contains data that counterspin cannot read. "
        "Export the file again, or export it as CSV."
    )


class NoRowsError(RecordError):
    """No rows of numbers stand below names in a sheet."""

    code = "no-rows"


class ColumnFile(ABC):
    """The named columns of one record file, opened.

    A context manager: on leaving, what was read must still be the file's content.
    """

    delimiter = ","
    decimal = "."
    #: Column -> its unit by the file itself, in plain signs; empty text where it states none.
    units: dict[str, str]
    interval: float | None  #: Time between rows by the file, s; None where it states none.
    #: Whether they stand in a row of their own, or else in brackets behind the names.
    units_row: bool
    #: Columns that are to be read as time stamps: seconds after the first one. Set it before
    #: reading.
    timestamp_columns: frozenset[str]
    first_timestamp: int | None  #: The first time stamp, ns; None as long as it is unknown.
    format_description: str  #: How the file is written, where that is not plain.
    footer: tuple[str, ...] = ()  #: Lines at the end that are not rows.
    runs: tuple[str, ...] = ()  #: Groups with the same columns, each of which holds a run.
    selection: np.ndarray | None = None  #: Rows that are selected, as a mask; None: all.

    def __init__(self, path: Path, stream: BinaryIO) -> None:
        self.path = path
        self.names: list[str] = []
        self.identity: FileIdentity | None = FileIdentity.from_file(stream.fileno())
        self.units, self.units_row = {}, False
        self.timestamp_columns, self.format_description = frozenset(), ""
        self.first_timestamp, self.interval = None, None
        self._midnights: dict[str, tuple[int, int]] = {}
        self._stream = stream

    def __enter__(self) -> Self:
        """Return the file."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the file; RecordError if it is no longer what it was when it was opened."""
        self._stream.close()
        if isinstance(error, Exception) or error is None:
            with record_errors(self.path):
                if FileIdentity.from_file(self.path) != self.identity:
                    raise RecordError(
                        f"{self.path}: the file was changed while counterspin was reading it. "
                        "Wait until the file is complete.",
                        code="file-changed",
                    )

    def require(self, wanted: Sequence[str]) -> None:
        """Raise `RecordError` unless the file has the wanted columns and they can hold numbers."""
        wanted = self._columns_in_file(wanted)
        missing_names = [name for name in wanted if not self.has_column(name)]
        if missing_names:
            raise RecordError(
                f"{self.path}: {self._missing_columns_message(missing_names)}",
                code="missing-column",
            )
        with record_errors(self.path):
            self._require(wanted)

    def has_column(self, name: str) -> bool:
        """Return True if the file has a column of this name."""
        return name in self.names

    def batches(self, wanted: Sequence[str]) -> Iterator[Columns]:
        """Yield the wanted columns, which `require` has passed, in consecutive batches."""
        rows = 0
        with record_errors(self.path, lambda: f" after row {rows}" if rows else ""):
            for batch in self._batches(self._columns_in_file(wanted)):
                count = row_count(batch)
                batch = {name: self._derive_column(batch, name) for name in wanted}  # noqa: PLW2901
                if self.selection is not None:
                    mask = self.selection[rows : rows + count]
                    batch = {name: values[mask] for name, values in batch.items()}  # noqa: PLW2901
                yield {name: mask_overflow(values) for name, values in batch.items()}
                rows += count

    def _columns_in_file(self, wanted: Sequence[str]) -> list[str]:
        """Return the columns of the file that make the wanted ones: of a split time, two."""
        file_columns: list[str] = []
        for name in wanted:
            split_time = None if self.has_column(name) else _split_time(name)
            file_columns += [split_time.coarse, split_time.fine] if split_time else [name]
        return list(dict.fromkeys(file_columns))

    def _derive_column(self, batch: Columns, name: str) -> np.ndarray:
        """Return a column of a batch; a split time as seconds after the first one."""
        split_time = None if name in batch else _split_time(name)
        if split_time is None:
            return batch[name]
        import polars as pl

        times, is_valid = split_time.nanoseconds(batch)
        return self.seconds(
            pl.select(pl.when(pl.Series(is_valid)).then(pl.Series(times))).to_series()
        )

    def read_columns(self, wanted: Sequence[str]) -> Columns:
        """Return whole columns, which `require` has passed; with the strict parser if needed."""
        try:
            batches = list(self.batches(wanted))
        except RecordError:
            if not self.use_strict_parser():
                raise
            batches = list(self.batches(wanted))
        if not batches:
            raise RecordError(f"{self.path}: the file has no rows.", code="no-rows")
        return concatenate_batches(batches)

    def table(self) -> pl.DataFrame:
        """Return the whole file as it stands, cells of text remaining text."""
        with record_errors(self.path):
            table = self._table()
            return table if self.selection is None else table.filter(self.selection)

    def select(self, column: str, value: str) -> None:
        """Read from now on the rows alone in which a column has a value."""
        import numpy as np

        if not self.has_column(column):
            raise RecordError(
                f"{self.path}: select: {self._missing_columns_message([column])}",
                code="missing-column",
            )
        cells = [cell.strip() for cell in self.all_cells(column)]
        mask = np.array([_same_cell(cell, value) for cell in cells])
        if not mask.any():
            values = format_names(sorted(set(cells)), 8)
            raise RecordError(
                f"{self.path}: select: column '{column}' does not contain the value '{value}'; "
                f"it contains {values}.",
                code="no-rows",
            )
        self.selection = mask
        note = f"rows with {value} in column '{column}'"
        self.format_description = (
            f"{self.format_description}, {note}" if self.format_description else note
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
        """Say where a row that was read stands in the file, counted among those selected."""
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
        """Say where data row `row` (counted from 0) stands in the file."""
        return f"row {row + 1}"

    def row_locations(self, rows: int) -> list[str]:
        """Say where each of the data rows stands in the file."""
        return [self.locate_row(row) for row in range(rows)]

    def use_strict_parser(self) -> bool:
        """Switch to the strict parser; return False if there is none or it is in use."""
        return False

    def single_numbers(self) -> dict[str, float]:
        """Return the single numbers that stand beside the columns, by name."""
        return {}

    def first_cells(self, names: Sequence[str], count: int) -> dict[str, list[str]]:
        """Return the first cells of columns, as text; columns that cannot be read are left out."""
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
        """Say what a text's first lines look like, a line each; empty text of other files."""
        return ""

    def seconds(self, stamps: pl.Series) -> np.ndarray:
        """Return time stamps, ns with gaps, as seconds after the first one of the file.

        Times of day without a date go on after midnight.
        """
        import numpy as np

        known_stamps = stamps.drop_nulls().to_numpy()
        if self.first_timestamp is None and len(known_stamps):
            self.first_timestamp = int(known_stamps[0])
            self._midnights = {}
        # Whole numbers first: seconds since 1970 have digits for no more than microseconds.
        elapsed = (stamps - (self.first_timestamp or 0)).to_numpy().astype(float)
        if (
            len(known_stamps) and known_stamps.min() >= 0 and known_stamps.max() < _DAY
        ):  # times without dates
            last_stamp, days = self._midnights.get(stamps.name, (int(known_stamps[0]), 0))
            days_passed = days + np.cumsum(np.diff(known_stamps, prepend=last_stamp) < -_DAY // 2)
            elapsed[stamps.is_not_null().to_numpy()] += days_passed * float(_DAY)
            self._midnights[stamps.name] = int(known_stamps[-1]), int(days_passed[-1])
        return elapsed * 1e-9

    def _require(self, wanted: Sequence[str]) -> None:  # noqa: B027
        """As `require`, of columns that are there."""

    @abstractmethod
    def _batches(self, wanted: Sequence[str]) -> Iterator[Columns]:
        """As `batches`."""

    @abstractmethod
    def _table(self) -> pl.DataFrame:
        """As `table`."""

    def _missing_columns_message(self, missing: Sequence[str]) -> str:
        from difflib import get_close_matches

        message = (
            f"the file has no column {format_names(missing)}; it has {format_names(self.names)}."
        )
        similar = get_close_matches(missing[0], self.names, n=1)
        return message + (f" Did you mean '{similar[0]}'?" if similar else "")

    def _check_size(self, needed: int) -> None:
        """Refuse columns of numbers, before they are read, that no file of this size can hold."""
        size = self.identity.size if self.identity else 0
        if needed > _UNPACKED_BYTES + _UNPACKED_RATIO * size:
            raise DamagedFileError(
                f"{self.path}: the file is damaged. It contains {size} bytes, but its header "
                f"specifies {needed} bytes of data."
            )


def _split_time(name: str) -> SplitTime | None:
    """Return the two columns of a time that a name such as ``sec [s] + nanosec [ns]`` states."""
    if "] + " not in name:
        return None
    from counterspin.records.sampling import SplitTime

    return SplitTime.parse(name)


def _same_cell(cell: str, value: str) -> bool:
    """Return True if a cell equals a value, as text or as a number."""
    if cell == value.strip():
        return True
    try:
        return float(cell) == float(value)
    except ValueError:
        return False


def mask_overflow(values: np.ndarray) -> np.ndarray:
    """Return numbers with NaN for those that instruments write where they measured none."""
    import numpy as np

    if values.max(initial=0.0) < _OVERFLOW and values.min(initial=0.0) > -_OVERFLOW:
        return values  # NaN fails both tests
    is_overflow = np.abs(values) >= _OVERFLOW
    if not is_overflow.any() or (np.abs(values[is_overflow]) > _NOT_A_NUMBER).any():
        return values
    return np.where(is_overflow, np.nan, values)


def format_names(names: Sequence[str], max_names: int = 20) -> str:
    """Return column names for a message, in quotation marks, the first ones of many."""
    quoted_names = ", ".join(f"'{name}'" for name in names[:max_names])
    return (
        quoted_names + (f" and {len(names) - max_names} more" if len(names) > max_names else "")
        or "none"
    )


def frame_columns(frame: pl.DataFrame) -> Columns:
    """Return the columns of a frame as arrays."""
    return {column.name: column.to_numpy() for column in frame.get_columns()}


def plain_path(path: Path) -> str:
    """Return a path as polars takes it literally; RecordError if it is no text in UTF-8."""
    text = str(path.absolute())
    try:
        text.encode()
    except UnicodeEncodeError:
        printable = text.encode(errors="replace").decode()
        raise RecordError(
            f"{printable}: the path is not valid UTF-8; rename the folder.", code="invalid-name"
        ) from None
    return text


def nanoseconds(name: str) -> pl.Expr:
    """Return the stamps of a column of text as integers, ns; null where there is none.

    With a date, since 1970 (UTC, or the place's own time where no zone is stated); without one,
    since midnight. Fractions may have a comma or a colon; a blank may stand in the place of the T.
    Of 1/2/2026 the month is first, unless there is none of its number; of 1.2.2026 the day. Months
    may have English names, `05-Mar-2024 10:00:00.02`, `Tue Mar  5 10:00:00 2024`, and durations
    their unit, `0.02 sec`.
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
    for mark, size in _DURATIONS.items():
        length = text.str.extract(rf"^(\d+(?:\.\d+)?(?:[eE][-+]?\d+)?) ?(?:{mark})$")
        duration = pl.coalesce(duration, length.cast(pl.Float64, strict=False) * (size * 1e9))
    text = text.str.replace(r"^(\d\d?)\.(\d\d?)\.(\d{4})", "${3}-${2}-${1}")
    text = text.str.replace(r"^(1[3-9]|[23]\d)/(\d\d?)/(\d{4})", "${3}-${2}-${1}")
    text = text.str.replace(r"^(\d\d?)/(\d\d?)/(\d{4})", "${3}-${1}-${2}")
    text = text.str.replace(r" ?([AaPp][Mm])$", "${1}")
    text = text.str.replace(" ", "T", literal=True).str.replace(r"(Z| ?UTC| ?GMT)$", "+00:00")
    iso_dates = pl.when(text.str.contains(r"^\d{4}-")).then(text)
    text = iso_dates.otherwise(pl.concat_str([pl.lit("1970-01-01T"), text]))
    has_zone = text.str.contains(r"[+-]\d\d:?\d\d$")
    form = "%Y-%m-%dT%H:%M:%S%.f"
    has_am_pm = text.str.contains(r"[AaPp][Mm]$")
    of_day = pl.when(~has_zone & ~has_am_pm).then(text).str
    of_half = pl.when(has_am_pm).then(text).str
    normalised = pl.coalesce(
        of_day.to_datetime(form, time_unit="ns", strict=False),
        of_half.to_datetime("%Y-%m-%dT%I:%M:%S%.f%p", time_unit="ns", strict=False),
    )
    with_zone = pl.when(has_zone).then(text)
    utc_times = with_zone.str.to_datetime(
        f"{form}%z", time_unit="ns", time_zone="UTC", strict=False
    )
    moment = pl.coalesce(utc_times.dt.replace_time_zone(None), normalised).cast(pl.Int64())
    return pl.coalesce(moment, duration.round().cast(pl.Int64, strict=False)).alias(name)
