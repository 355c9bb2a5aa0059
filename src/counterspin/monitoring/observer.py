"""Incremental reading of growing records: changed files only, and new rows only for tables.

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
GROWING_SUFFIXES: Final = tuple(e for e, form in RECORD_FORMATS.items() if form.can_grow)

#: Number of first rows that show the format; they precede new rows when these are parsed.
_FIRST_ROWS: Final = 20

#: Number of lines from which an unreadable file is an error, not a beginning.
_MIN_LINES: Final = HEAD_LINES + _FIRST_ROWS

#: Number of bytes before the new ones that must be unchanged.
_TAIL_BYTES: Final = 256

#: Number of bytes read at a time.
_CHUNK_BYTES: Final = 1 << 24


@dataclass
class GrowingTable:
    """The columns of a growing file."""

    path: Path  #: The file.
    names: Sequence[str]  #: Names of the columns to read.
    dialect: Dialect = AUTODETECT  #: Known format of the file.
    _identity: FileIdentity | None = None
    _head: bytes = b""
    _tail: bytes = b""
    _done: int = 0
    _rows: int = 0
    _context: int = 0
    _columns: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def rows(self) -> int:
        """Rows read so far."""
        return self._rows

    @property
    def table(self) -> MemoryTable:
        """The rows read so far; at least one."""
        columns = {}
        for name, values in self._columns.items():
            columns[name] = values[: self._rows]
            columns[name].flags.writeable = False
        return MemoryTable(str(self.path), columns)

    def follow(self) -> tuple[bool, str | None]:
        """Read the new data; return whether they changed, and the events."""
        with open_file(self.path) as file:
            now = FileIdentity.from_file(file.fileno())
            if now == self._identity:
                return False, None
            event = self._change_event(now, file)
            if event is not None:
                self._reset()
            self._identity = now
            changed = event is not None
            file.seek(self._done)
            # Read only up to the size at the start: a fast writer would never end.
            remaining = now.size - self._done
            rest = b""
            while remaining > 0 and (part := file.read(min(remaining, _CHUNK_BYTES))):
                remaining -= len(part)
                complete, _, rest = (rest + part).rpartition(b"\n")
                if complete:
                    changed |= self._read_lines(complete + b"\n")
            return changed, event

    def _change_event(self, now: FileIdentity, file: FileIO) -> str | None:
        before = self._identity
        if before is None:
            return None
        if (now.device, now.inode) != (before.device, before.inode):
            return "was replaced by another file; counterspin now reads the new file from the start"
        if now.size < self._done:
            return "became shorter; counterspin now reads the file again from the start"
        file.seek(self._done - len(self._tail))
        if file.read(len(self._tail)) != self._tail:
            return "was rewritten; counterspin now reads the file again from the start"
        return None

    def _reset(self) -> None:
        self._head = self._tail = b""
        self._done = self._rows = self._context = 0
        self._columns = {}

    def _read_lines(self, lines: bytes) -> bool:
        """Read complete new lines; return whether they contain rows."""
        text = self._head + lines
        with temporary_folder("counterspin-rows-") as folder:
            part = folder / f"rows{self.path.suffix.lower()}"
            part.write_bytes(text)
            try:
                new, first = self._read(part)
            except RecordError:
                if not self._head and text.count(b"\n") < _MIN_LINES:
                    return False  # wait for more lines
                # Reading the file itself gives the right name and line in the error.
                self._read(self.path)
                raise
        before = self._context
        if not self._head:
            if len(new[self.names[0]]) < _FIRST_ROWS:
                return False
            self._context = _FIRST_ROWS
            self._head = b"".join(text.splitlines(keepends=True)[:first])
        self._append({name: values[before:] for name, values in new.items()})
        self._done += len(lines)
        self._tail = (self._tail + lines)[-_TAIL_BYTES:]
        return True

    def _read(self, path: Path) -> tuple[Columns, int]:
        """Return the columns of a file, and the line number of the last of its first rows."""
        with open_columns(path, self.dialect) as file:
            file.require(list(self.names))
            columns = file.read_columns(list(self.names))
            number = re.search(r"\d+", file.locate(_FIRST_ROWS - 1))
            return columns, int(number[0]) if number else 0

    def _append(self, new: dict[str, np.ndarray]) -> None:
        """Append rows; the buffer doubles when it is full."""
        more = len(new[self.names[0]])
        for name, values in new.items():
            column = self._columns.get(name)
            if column is None or len(column) < self._rows + more:
                wider = np.empty(max(2 * (self._rows + more), 4096))
                if column is not None:
                    wider[: self._rows] = column[: self._rows]
                self._columns[name] = column = wider
            column[self._rows : self._rows + more] = values
        self._rows += more


#: Smallest number of revolutions of a usable record.
MIN_REVOLUTIONS: Final = 3.5


_NO_FILE: Final = "no file yet"

#: Parts of a campaign with a record.
Recorded = Run | PoseRecord


def copy_record(run: Recorded, **values: Any) -> Recorded:
    """Return a run, or a record of poses, with changed fields."""
    return run.model_copy(update=values) if isinstance(run, Run) else replace(run, **values)


def recordings(campaign: Campaign) -> tuple[Recorded, ...]:
    """Return the runs of a campaign, then its records of poses."""
    return (*campaign.runs, *(campaign.triad.records if campaign.triad else ()))


@dataclass
class _WatchedRun:
    """A run, its file, and the outcome of its last reading."""

    run: Recorded
    columns: RecordColumns
    table: GrowingTable | None
    identity: tuple[FileIdentity, ...] | None = None
    record: Record | None = None
    observed: ObservedRun | None = None
    found: tuple[LocatedPose, ...] = ()
    temperature: tuple[float, ...] | None = None
    conditions: RunConditions | None = None
    stale: bool = True
    fault: str | None = None  # error of the file
    trouble: str | None = None  # error of the record
    waits: str | None = None

    @property
    def files(self) -> tuple[Path, ...]:
        return self.run.files if isinstance(self.run, Run) else (self.run.record,)

    def reset(self) -> None:
        self.record = self.observed = None
        self.found = ()


class Observer:
    """Poller of a campaign's records.

    grow: Whether text tables grow, so that only new rows are read.
    """

    def __init__(self, campaign: Campaign, *, grow: bool = False) -> None:
        self._campaign = campaign
        self._watched = []
        for run in recordings(campaign):
            if isinstance(run, Run):
                columns = record_columns(campaign, run)
            else:
                columns = pose_columns(campaign, run)
            warm = temperature_columns(campaign, run)
            table = _growing_table(run, columns, warm) if grow else None
            self._watched.append(_WatchedRun(run, columns, table))

    def poll(self) -> tuple[bool, list[str]]:
        """Read the new data; return whether they changed, and the events."""
        changed, events = False, []
        for watched in self._watched:
            if watched.run.record in self._campaign.frames:
                continue  # in memory: it does not change
            different, event = _poll_file(watched)
            changed |= different
            if event is not None:
                events.append(f"{watched.run.record.name} {event}.")
        return changed, events

    def usable_runs(self) -> tuple[Campaign, list[ObservedRun]]:
        """Return the campaign with the usable runs and pose records only, and the observed runs."""
        lengths: dict[str, float] = {}
        frames = dict(self._campaign.frames)
        for watched in self._watched:
            self._read(watched)
            if watched.record is not None:
                lengths[watched.run.name] = float(watched.record.time[-1])
            if watched.found and watched.table is not None:
                frames[watched.run.record] = watched.table.table
        warm = {watched.run.name: watched.temperature for watched in self._watched}
        runs = tuple(
            r.model_copy(update={"temperature": warm[r.name]})
            for r in self._campaign.runs
            if r.name in lengths
        )
        part = replace(self._campaign, runs=runs, frames=frames)
        if part.triad is not None:
            usable = tuple(
                replace(record, temperature=warm[record.name])
                for record in part.triad.records
                if self.poses_of(record.name)
            )
            part = replace(part, triad=replace(part.triad, records=usable))
        conditions = run_conditions(part, lengths) if runs else {}
        observed = []
        for watched in self._watched:
            if watched.record is None or not isinstance(watched.run, Run):
                continue
            under = conditions[watched.run.name]
            if watched.observed is None or watched.conditions != under:
                watched.observed = observe_run(part, watched.run, watched.record, under)
                watched.conditions = under
            observed.append(watched.observed)
        return part, observed

    def poses_of(self, name: str) -> tuple[LocatedPose, ...]:
        """Return the poses of a record; none if it is unusable."""
        return next(w for w in self._watched if w.run.name == name).found

    def of(self, name: str) -> tuple[str | None, str | None, int]:
        """Return why a run waits, its error, and its number of rows."""
        watched = next(w for w in self._watched if w.run.name == name)
        rows = watched.table.rows if watched.table else 0
        if watched.record is not None:
            rows = max(rows, watched.record.report.rows)
        if watched.found and (record := watched.found[0].record) is not None:
            rows = max(rows, record.report.rows)
        return watched.waits, watched.fault or watched.trouble, rows

    def unread_state(self, name: str) -> RunState:
        """Return the state of a run that is too short or unusable."""
        run = next(w.run for w in self._watched if w.run.name == name)
        waits, trouble, rows = self.of(name)
        return RunState(
            run=name,
            record=record_name(run.record, self._campaign.folder),
            state="failed" if trouble else "waiting",
            why=trouble or waits,
            rows=rows,
            stated_seconds=run.duration if isinstance(run, Run) else None,
            nominal_rate=run.rate if isinstance(run, Run) else 0.0,
        )

    def _read(self, watched: _WatchedRun) -> None:
        """Read the record of the existing rows if they have changed."""
        if not watched.stale:
            return
        watched.reset()
        watched.trouble = watched.waits = None
        watched.stale = False
        source = self._campaign
        if watched.table is not None:
            if not watched.table.rows:
                watched.waits = "no rows yet"
                return
            watched.waits = _wait_reason(watched.run, watched.columns, watched.table.table)
            if watched.waits is not None:
                return
            frames = {**source.frames, watched.run.record: watched.table.table}
            source = replace(source, frames=frames)
        try:
            watched.temperature = recorded_temperatures(source, watched.run, {})
            run = copy_record(watched.run, temperature=watched.temperature)
            if isinstance(run, Run):
                watched.record = read_run(source, run)
            else:
                watched.found = tuple(extract_poses(source, run))
        except RecordError as error:
            watched.trouble = str(error)


def _wait_reason(run: Recorded, columns: RecordColumns, table: MemoryTable) -> str | None:
    """Return the reason why a growing record is too short to read, or None."""
    clock, rows = columns.time, len(next(iter(table.columns.values())))
    first, last = (
        (0.0, rows - 1.0) if clock.is_derived_column else table.columns[clock.name][[0, -1]]
    )
    seconds = float(last - first) * clock.factor
    if isinstance(run, PoseRecord):
        return (
            None
            if seconds >= run.rest
            else (f"only {seconds:.1f} of {run.rest:g} s at rest so far")
        )
    turned = abs(run.rate) * seconds / (2.0 * math.pi)
    if turned >= MIN_REVOLUTIONS:
        return None
    return f"only {turned:.1f} of at least {MIN_REVOLUTIONS} revolutions so far"


def _poll_file(watched: _WatchedRun) -> tuple[bool, str | None]:
    path = watched.run.record
    try:
        if watched.table is not None:
            changed, event = watched.table.follow()
            watched.identity = (FileIdentity.from_file(path),)
        else:
            now = tuple(FileIdentity.from_file(file) for file in watched.files)
            changed, event = now != watched.identity, None
            watched.identity = now
    except FileNotFoundError:
        gone = watched.identity is not None
        watched.identity = None
        watched.reset()
        watched.stale, watched.waits = False, _NO_FILE
        watched.fault = watched.trouble = None
        if watched.table is not None:
            watched.table = GrowingTable(path, watched.table.names, watched.table.dialect)
        return gone, "has disappeared" if gone else None
    except (OSError, RecordError) as error:
        reason = error.strerror if isinstance(error, OSError) else None
        trouble = f"{path} cannot be read: {reason}." if reason else str(error)
        changed, watched.fault = trouble != watched.fault, trouble
        return changed, None
    watched.fault = None
    watched.stale |= changed
    if changed:
        watched.waits = None
    return changed, event


def _growing_table(
    run: Recorded, columns: RecordColumns, warm: RecordColumns | None
) -> GrowingTable | None:
    """Return the growing table of a run's record; None if it must be read completely.

    Time stamps, pulses, units stated by the file, and the start of a run with counted rows need the
    complete file.

    warm: Its time and temperature, if recorded.
    """
    more = list(warm.signals.values()) if warm else []
    specs = [columns.time, *([columns.angle] if columns.angle else []), *columns.signals.values()]
    specs += more
    kinds = ("numbers", "temperature", *(() if isinstance(run, Run) else ("rows",)))
    plain = all(spec.kind in kinds and (spec.unit or not spec.target_unit) for spec in specs)
    if (
        run.record.suffix.lower() not in GROWING_SUFFIXES
        or not plain
        or columns.continuation_files
        or columns.pulses
    ):
        return None
    names = [*columns.file_columns, *(spec.name for spec in more)]
    return GrowingTable(run.record, names, columns.dialect)


def record_name(path: Path, folder: Path) -> str:
    """Return a record's displayed path, relative to its campaign's folder if inside."""
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else str(path)
