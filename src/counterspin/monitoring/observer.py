"""Incremental reading of growing records: only changed files, and only new rows of text tables.

Each appended row is read once. An incomplete last line is read when it is complete. The columns
stay in memory, and are read from the file again if the program restarts.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from io import FileIO
from pathlib import Path
from typing import Any, Final

import numpy as np

from counterspin.calibration.observed_runs import (
    ObservedRun,
    observe_run,
    read_run,
    record_columns,
    recorded_temperatures,
    temperature_columns,
)
from counterspin.campaign.conditions import run_conditions
from counterspin.campaign.description import Campaign
from counterspin.campaign.reading import PoseRecord
from counterspin.campaign.runs import Run
from counterspin.errors import RecordError
from counterspin.input import FileIdentity, open_file
from counterspin.monitoring.result import RunState
from counterspin.physics.conditions import RunConditions
from counterspin.records.column_file import Columns
from counterspin.records.dialect import AUTODETECT, Dialect
from counterspin.records.format_registry import RECORD_FORMATS
from counterspin.records.formats import open_columns
from counterspin.records.layout import HEAD_LINES
from counterspin.records.memory import MemoryTable
from counterspin.records.record import Record, RecordColumns
from counterspin.temporary_folders import temporary_folder
from counterspin.triads.record_poses import LocatedPose, extract_poses, pose_columns

#: Suffixes of files to which rows are appended.
GROWABLE_SUFFIXES: Final = tuple(e for e, form in RECORD_FORMATS.items() if form.can_grow)

#: Number of first rows from which the format is detected; they are prepended to new rows.
_N_CONTEXT_ROWS: Final = 20

#: Number of lines from which an unreadable file is an error instead of an incomplete beginning.
_MIN_LINES_FOR_FAILURE: Final = HEAD_LINES + _N_CONTEXT_ROWS

#: Number of bytes before the new ones that must be unchanged.
_N_TAIL_BYTES: Final = 256

#: Number of bytes read at a time.
_MAX_CHUNK_BYTES: Final = 1 << 24


@dataclass
class GrowingTable:
    """The columns of a growing file."""

    path: Path  #: The file.
    names: Sequence[str]  #: Names of the columns to read.
    dialect: Dialect = AUTODETECT  #: Known format of the file.
    _identity: FileIdentity | None = None
    _head: bytes = b""
    _tail: bytes = b""
    _bytes_read: int = 0
    _n_rows: int = 0
    _n_context_rows: int = 0
    _columns: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def n_rows(self) -> int:
        """Number of rows read so far."""
        return self._n_rows

    @property
    def table(self) -> MemoryTable:
        """Rows read so far; at least one."""
        columns = {}
        for name, values in self._columns.items():
            columns[name] = values[: self._n_rows]
            columns[name].flags.writeable = False
        return MemoryTable(str(self.path), columns)

    def read_new_rows(self) -> tuple[bool, str | None]:
        """Read new rows; return whether the table changed, and a description of file changes."""
        with open_file(self.path) as file:
            identity = FileIdentity.from_file(file.fileno())
            if identity == self._identity:
                return False, None
            event = self._describe_change(identity, file)
            if event is not None:
                self._reset()
            self._identity = identity
            has_changed = event is not None
            file.seek(self._bytes_read)
            # Read only up to the size at the start: a fast writer would never end.
            n_remaining_bytes = identity.size - self._bytes_read
            incomplete_line = b""
            while n_remaining_bytes > 0 and (
                chunk := file.read(min(n_remaining_bytes, _MAX_CHUNK_BYTES))
            ):
                n_remaining_bytes -= len(chunk)
                complete_lines, _, incomplete_line = (incomplete_line + chunk).rpartition(b"\n")
                if complete_lines:
                    has_changed |= self._read_lines(complete_lines + b"\n")
            return has_changed, event

    def _describe_change(self, identity: FileIdentity, file: FileIO) -> str | None:
        previous_identity = self._identity
        if previous_identity is None:
            return None
        if (identity.device, identity.inode) != (previous_identity.device, previous_identity.inode):
            return "was replaced by another file; counterspin now reads the new file from the start"
        if identity.size < self._bytes_read:
            return "became shorter; counterspin now reads the file again from the start"
        file.seek(self._bytes_read - len(self._tail))
        if file.read(len(self._tail)) != self._tail:
            return "was rewritten; counterspin now reads the file again from the start"
        return None

    def _reset(self) -> None:
        self._head = self._tail = b""
        self._bytes_read = self._n_rows = self._n_context_rows = 0
        self._columns = {}

    def _read_lines(self, lines: bytes) -> bool:
        """Read complete new lines; return whether they contain rows."""
        text = self._head + lines
        with temporary_folder("counterspin-rows-") as folder:
            rows_file = folder / f"rows{self.path.suffix.lower()}"
            rows_file.write_bytes(text)
            try:
                new_columns, header_lines = self._read_columns(rows_file)
            except RecordError:
                if not self._head and text.count(b"\n") < _MIN_LINES_FOR_FAILURE:
                    return False  # wait for more lines
                # Reading the file itself gives the right name and line in the error.
                self._read_columns(self.path)
                raise
        n_context_rows = self._n_context_rows
        if not self._head:
            if len(new_columns[self.names[0]]) < _N_CONTEXT_ROWS:
                return False
            self._n_context_rows = _N_CONTEXT_ROWS
            self._head = b"".join(text.splitlines(keepends=True)[:header_lines])
        self._append({name: values[n_context_rows:] for name, values in new_columns.items()})
        self._bytes_read += len(lines)
        self._tail = (self._tail + lines)[-_N_TAIL_BYTES:]
        return True

    def _read_columns(self, path: Path) -> tuple[Columns, int]:
        """Return the columns of a file, and the line number of its last context row."""
        with open_columns(path, self.dialect) as file:
            file.require(list(self.names))
            columns = file.read_columns(list(self.names))
            line_number_match = re.search(r"\d+", file.locate(_N_CONTEXT_ROWS - 1))
            return columns, int(line_number_match[0]) if line_number_match else 0

    def _append(self, new_columns: dict[str, np.ndarray]) -> None:
        """Append rows; the buffer doubles when it is full."""
        n_new_rows = len(new_columns[self.names[0]])
        for name, values in new_columns.items():
            column = self._columns.get(name)
            if column is None or len(column) < self._n_rows + n_new_rows:
                buffer = np.empty(max(2 * (self._n_rows + n_new_rows), 4096))
                if column is not None:
                    buffer[: self._n_rows] = column[: self._n_rows]
                self._columns[name] = column = buffer
            column[self._n_rows : self._n_rows + n_new_rows] = values
        self._n_rows += n_new_rows


#: Smallest number of revolutions of a usable record.
MIN_REVOLUTIONS: Final = 3.5


_NO_FILE_REASON: Final = "no file yet"

#: A run or a record of poses.
RecordedRun = Run | PoseRecord


def copy_record(run: RecordedRun, **values: Any) -> RecordedRun:
    """Return a run, or a record of poses, with changed fields."""
    return run.model_copy(update=values) if isinstance(run, Run) else replace(run, **values)


def recorded_runs(campaign: Campaign) -> tuple[RecordedRun, ...]:
    """Return the runs of a campaign, then its records of poses."""
    return (*campaign.runs, *(campaign.triad.records if campaign.triad else ()))


@dataclass
class _WatchedRun:
    """A run, its file, and the outcome of its last reading."""

    run: RecordedRun
    columns: RecordColumns
    table: GrowingTable | None
    identity: tuple[FileIdentity, ...] | None = None
    record: Record | None = None
    observed_run: ObservedRun | None = None
    poses: tuple[LocatedPose, ...] = ()
    temperature: tuple[float, ...] | None = None
    conditions: RunConditions | None = None
    is_stale: bool = True
    file_error: str | None = None  # error of the file
    record_error: str | None = None  # error of the record
    wait_reason: str | None = None

    @property
    def files(self) -> tuple[Path, ...]:
        return self.run.files if isinstance(self.run, Run) else (self.run.record,)

    def reset(self) -> None:
        self.record = self.observed_run = None
        self.poses = ()


class Observer:
    """Polls the records of a campaign.

    is_growing: Whether text tables grow, so that only new rows are read.
    """

    def __init__(self, campaign: Campaign, *, is_growing: bool = False) -> None:
        self._campaign = campaign
        self._watched_runs = []
        for run in recorded_runs(campaign):
            if isinstance(run, Run):
                columns = record_columns(campaign, run)
            else:
                columns = pose_columns(campaign, run)
            temperature_spec = temperature_columns(campaign, run)
            table = _make_growing_table(run, columns, temperature_spec) if is_growing else None
            self._watched_runs.append(_WatchedRun(run, columns, table))

    def poll(self) -> tuple[bool, list[str]]:
        """Poll all records; return whether any changed, and sentences on file changes."""
        has_changed, events = False, []
        for watched_run in self._watched_runs:
            if watched_run.run.record in self._campaign.frames:
                continue  # in memory: it does not change
            has_file_changed, event = _poll_file(watched_run)
            has_changed |= has_file_changed
            if event is not None:
                events.append(f"{watched_run.run.record.name} {event}.")
        return has_changed, events

    def read_usable_runs(self) -> tuple[Campaign, list[ObservedRun]]:
        """Read changed records; return the campaign with usable records only, and the runs."""
        durations: dict[str, float] = {}
        frames = dict(self._campaign.frames)
        for watched_run in self._watched_runs:
            self._read_record(watched_run)
            if watched_run.record is not None:
                durations[watched_run.run.name] = float(watched_run.record.time[-1])
            if watched_run.poses and watched_run.table is not None:
                frames[watched_run.run.record] = watched_run.table.table
        temperatures = {w.run.name: w.temperature for w in self._watched_runs}
        runs = tuple(
            r.model_copy(update={"temperature": temperatures[r.name]})
            for r in self._campaign.runs
            if r.name in durations
        )
        usable_campaign = replace(self._campaign, runs=runs, frames=frames)
        if usable_campaign.triad is not None:
            usable_records = tuple(
                replace(record, temperature=temperatures[record.name])
                for record in usable_campaign.triad.records
                if self.find_poses(record.name)
            )
            usable_campaign = replace(
                usable_campaign, triad=replace(usable_campaign.triad, records=usable_records)
            )
        conditions = run_conditions(usable_campaign, durations) if runs else {}
        observed_runs = []
        for watched_run in self._watched_runs:
            if watched_run.record is None or not isinstance(watched_run.run, Run):
                continue
            current_conditions = conditions[watched_run.run.name]
            if watched_run.observed_run is None or watched_run.conditions != current_conditions:
                watched_run.observed_run = observe_run(
                    usable_campaign, watched_run.run, watched_run.record, current_conditions
                )
                watched_run.conditions = current_conditions
            observed_runs.append(watched_run.observed_run)
        return usable_campaign, observed_runs

    def find_poses(self, name: str) -> tuple[LocatedPose, ...]:
        """Return the poses of a record; none if it is unusable."""
        return next(w for w in self._watched_runs if w.run.name == name).poses

    def read_status(self, name: str) -> tuple[str | None, str | None, int]:
        """Return the reason why a run waits, its error, and its number of rows."""
        watched_run = next(w for w in self._watched_runs if w.run.name == name)
        rows = watched_run.table.n_rows if watched_run.table else 0
        if watched_run.record is not None:
            rows = max(rows, watched_run.record.report.rows)
        if watched_run.poses and (record := watched_run.poses[0].record) is not None:
            rows = max(rows, record.report.rows)
        return watched_run.wait_reason, watched_run.file_error or watched_run.record_error, rows

    def unread_state(self, name: str) -> RunState:
        """Return the state of a run that is too short or unusable."""
        run = next(w.run for w in self._watched_runs if w.run.name == name)
        wait_reason, error, rows = self.read_status(name)
        return RunState(
            run=name,
            record=record_name(run.record, self._campaign.folder),
            state="failed" if error else "waiting",
            why=error or wait_reason,
            rows=rows,
            stated_seconds=run.duration if isinstance(run, Run) else None,
            nominal_rate=run.rate if isinstance(run, Run) else 0.0,
        )

    def _read_record(self, watched_run: _WatchedRun) -> None:
        """Read the record if its rows have changed."""
        if not watched_run.is_stale:
            return
        watched_run.reset()
        watched_run.record_error = watched_run.wait_reason = None
        watched_run.is_stale = False
        campaign = self._campaign
        if watched_run.table is not None:
            if not watched_run.table.n_rows:
                watched_run.wait_reason = "no rows yet"
                return
            watched_run.wait_reason = _find_wait_reason(
                watched_run.run, watched_run.columns, watched_run.table.table
            )
            if watched_run.wait_reason is not None:
                return
            frames = {**campaign.frames, watched_run.run.record: watched_run.table.table}
            campaign = replace(campaign, frames=frames)
        try:
            watched_run.temperature = recorded_temperatures(campaign, watched_run.run, {})
            run = copy_record(watched_run.run, temperature=watched_run.temperature)
            if isinstance(run, Run):
                watched_run.record = read_run(campaign, run)
            else:
                watched_run.poses = tuple(extract_poses(campaign, run))
        except RecordError as error:
            watched_run.record_error = str(error)


def _find_wait_reason(run: RecordedRun, columns: RecordColumns, table: MemoryTable) -> str | None:
    """Return the reason why a growing record is too short to read, or None."""
    time_column, n_rows = columns.time, len(next(iter(table.columns.values())))
    first_time, last_time = (
        (0.0, n_rows - 1.0)
        if time_column.is_derived_column
        else table.columns[time_column.name][[0, -1]]
    )
    seconds = float(last_time - first_time) * time_column.factor
    if isinstance(run, PoseRecord):
        return (
            None
            if seconds >= run.min_rest
            else f"only {seconds:.1f} of {run.min_rest:g} s at rest so far"
        )
    revolutions = abs(run.rate) * seconds / (2.0 * math.pi)
    if revolutions >= MIN_REVOLUTIONS:
        return None
    return f"only {revolutions:.1f} of at least {MIN_REVOLUTIONS} revolutions so far"


def _poll_file(watched_run: _WatchedRun) -> tuple[bool, str | None]:
    path = watched_run.run.record
    try:
        if watched_run.table is not None:
            has_changed, event = watched_run.table.read_new_rows()
            watched_run.identity = (FileIdentity.from_file(path),)
        else:
            identities = tuple(FileIdentity.from_file(file) for file in watched_run.files)
            has_changed, event = identities != watched_run.identity, None
            watched_run.identity = identities
    except FileNotFoundError:
        has_disappeared = watched_run.identity is not None
        watched_run.identity = None
        watched_run.reset()
        watched_run.is_stale, watched_run.wait_reason = False, _NO_FILE_REASON
        watched_run.file_error = watched_run.record_error = None
        if (table := watched_run.table) is not None:
            watched_run.table = GrowingTable(path, table.names, table.dialect)
        return has_disappeared, "has disappeared" if has_disappeared else None
    except (OSError, RecordError) as error:
        reason = error.strerror if isinstance(error, OSError) else None
        message = f"{path} cannot be read: {reason}." if reason else str(error)
        has_changed, watched_run.file_error = message != watched_run.file_error, message
        return has_changed, None
    watched_run.file_error = None
    watched_run.is_stale |= has_changed
    if has_changed:
        watched_run.wait_reason = None
    return has_changed, event


def _make_growing_table(
    run: RecordedRun, columns: RecordColumns, temperature_spec: RecordColumns | None
) -> GrowingTable | None:
    """Return the growing table of a run's record; None if the file must be read completely.

    Time stamps, pulses, units stated in the file, and runs that begin at a row number require the
    complete file.

    temperature_spec: Columns of the recorded temperature; None: not recorded.
    """
    temperature_signals = list(temperature_spec.signals.values()) if temperature_spec else []
    specs = [columns.time, *([columns.angle] if columns.angle else []), *columns.signals.values()]
    specs += temperature_signals
    accepted_types = ("numbers", "temperature", *(() if isinstance(run, Run) else ("rows",)))
    has_plain_columns = all(
        spec.kind in accepted_types and (spec.unit or not spec.target_unit) for spec in specs
    )
    if (
        run.record.suffix.lower() not in GROWABLE_SUFFIXES
        or not has_plain_columns
        or columns.continuation_files
        or columns.pulses
    ):
        return None
    names = [*columns.file_columns, *(spec.name for spec in temperature_signals)]
    return GrowingTable(run.record, names, columns.dialect)


def record_name(path: Path, folder: Path) -> str:
    """Return the displayed path of a record, relative to the campaign folder if inside."""
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else str(path)
