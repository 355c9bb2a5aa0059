"""The records of a campaign that are there, read again only where they have changed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from counterspin.calibration.observed import ObservedRun, observe_run, read_run, record_columns
from counterspin.campaign.conditions import conditions_of
from counterspin.campaign.description import Campaign
from counterspin.campaign.resolved import Run
from counterspin.errors import RecordError
from counterspin.input import FileIdentity
from counterspin.monitoring.following import APPENDED, FollowedTable
from counterspin.physics.effects import RunConditions
from counterspin.records.record import Record

#: Revolutions of a record before anything can be said of it.
FEWEST_REVOLUTIONS: Final = 3.5


_NO_FILE: Final = "no file yet"


@dataclass
class _Watched:
    """A run, its file, and what was made of it when it was last read."""

    run: Run
    table: FollowedTable | None
    identity: tuple[FileIdentity, ...] | None = None
    record: Record | None = None
    observed: ObservedRun | None = None
    conditions: RunConditions | None = None
    stale: bool = True
    fault: str | None = None  # of the file
    trouble: str | None = None  # of the record that its rows make
    waits: str | None = None


class Observer:
    """Looks at the records of a campaign.

    grow: Whether tables of text are expected to grow: their new rows alone are read then.
    """

    def __init__(self, campaign: Campaign, *, grow: bool = False) -> None:
        self._campaign = campaign
        self._watched = [
            _Watched(run, _table_of(campaign, run) if grow else None) for run in campaign.runs
        ]

    def look(self) -> tuple[bool, list[str]]:
        """Read what is new."""
        changed, events = False, []
        for watched in self._watched:
            if watched.run.record in self._campaign.frames:
                continue  # in memory, and as it will be
            different, event = _look_at(watched)
            changed |= different
            if event is not None:
                events.append(f"{watched.run.record.name} {event}.")
        return changed, events

    def present(self) -> tuple[Campaign, list[ObservedRun]]:
        """Return the campaign of the runs that can be used, and these."""
        lengths: dict[str, float] = {}
        for watched in self._watched:
            self._read(watched)
            if watched.record is not None:
                lengths[watched.run.name] = float(watched.record.time[-1])
        runs = tuple(w.run for w in self._watched if w.record is not None)
        part = replace(self._campaign, runs=runs)
        conditions = conditions_of(part, lengths) if runs else {}
        observed = []
        for watched in self._watched:
            if watched.record is None:
                continue
            under = conditions[watched.run.name]
            if watched.observed is None or watched.conditions != under:
                watched.observed = observe_run(part, watched.run, watched.record, under)
                watched.conditions = under
            observed.append(watched.observed)
        return part, observed

    def of(self, name: str) -> tuple[str | None, str | None, int]:
        """Return what a run waits for, what is wrong with it, and how many rows it has."""
        watched = next(w for w in self._watched if w.run.name == name)
        rows = watched.table.rows if watched.table else 0
        if watched.record is not None:
            rows = max(rows, watched.record.report.rows)
        return watched.waits, watched.fault or watched.trouble, rows

    def _read(self, watched: _Watched) -> None:
        """Make a record of the rows that there are, if they are others than before."""
        if not watched.stale:
            return
        watched.record = watched.observed = None
        watched.trouble = watched.waits = None
        watched.stale = False
        source = self._campaign
        if watched.table is not None:
            if not watched.table.rows:
                watched.waits = "no rows yet"
                return
            table = watched.table.table
            clock = record_columns(self._campaign, watched.run).time
            time = table.columns[clock.name] * clock.factor
            seconds = float(time[-1] - time[0]) if len(time) > 1 else 0.0
            turned = abs(watched.run.rate) * seconds / (2.0 * math.pi)
            if turned < FEWEST_REVOLUTIONS:
                watched.waits = f"{turned:.1f} revolutions of {FEWEST_REVOLUTIONS} that are needed"
                return
            source = replace(source, frames={**source.frames, watched.run.record: table})
        try:
            watched.record = read_run(source, watched.run)
        except RecordError as error:
            watched.trouble = str(error)


def _look_at(watched: _Watched) -> tuple[bool, str | None]:
    path = watched.run.record
    try:
        if watched.table is not None:
            changed, event = watched.table.follow()
            watched.identity = (FileIdentity.of(path),)
        else:
            now = tuple(FileIdentity.of(file) for file in watched.run.files)
            changed, event = now != watched.identity, None
            watched.identity = now
    except FileNotFoundError:
        gone = watched.identity is not None
        watched.identity = watched.record = watched.observed = None
        watched.stale, watched.waits = False, _NO_FILE
        watched.fault = watched.trouble = None
        if watched.table is not None:
            watched.table = FollowedTable(path, watched.table.names, watched.table.dialect)
        return gone, "is no longer there" if gone else None
    except (OSError, RecordError) as error:
        reason = error.strerror if isinstance(error, OSError) else None
        trouble = f"{path}: cannot be read: {reason}." if reason else str(error)
        changed, watched.fault = trouble != watched.fault, trouble
        return changed, None
    watched.fault = None
    watched.stale |= changed
    if changed:
        watched.waits = None
    return changed, event


def _table_of(campaign: Campaign, run: Run) -> FollowedTable | None:
    """Return the growing table that a run's record is; None if it has to be read whole.

    Time stamps, counted rows, pulses and units that the file itself states are told from the file
    as a whole.
    """
    columns = record_columns(campaign, run)
    specs = [columns.time, *([columns.angle] if columns.angle else []), *columns.signals.values()]
    plain = all(spec.kind == "numbers" and (spec.unit or not spec.wanted) for spec in specs)
    if run.record.suffix.lower() not in APPENDED or not plain or columns.more or columns.pulses:
        return None
    return FollowedTable(run.record, columns.names, columns.dialect)


def record_name(path: Path, folder: Path) -> str:
    """Return a record's path as it is shown: inside its campaign's folder without that."""
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else str(path)
