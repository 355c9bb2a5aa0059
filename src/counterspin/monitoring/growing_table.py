"""A text table that grows: its new rows alone are read.

Whatever a recorder appends is read once. A last line without an end is waited for. What is kept is
the columns, in memory: all of it comes from the file again if the program is started anew.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from io import FileIO
from pathlib import Path
from typing import Final

import numpy as np

from counterspin.errors import RecordError
from counterspin.input import FileIdentity, open_file
from counterspin.records.csv_file import CsvFile
from counterspin.records.dialect import HEAD_LINES, TO_BE_FOUND, Dialect
from counterspin.records.formats import RECORD_FORMATS, open_columns
from counterspin.records.memory import MemoryTable
from counterspin.records.pieces import Columns

#: Endings of files to which rows are appended.
APPENDED: Final = tuple(e for e, opens in RECORD_FORMATS.items() if opens is CsvFile)

#: Rows that show how a file is written. They stand before new ones when these are read.
_FIRST_ROWS: Final = 20

#: A file that has this many lines and cannot be read has not just begun.
_BEGINNING: Final = HEAD_LINES + _FIRST_ROWS

#: Bytes before the new ones that must still be what they were.
_TAIL_BYTES: Final = 256

#: Bytes that are read at a time.
_PART_BYTES: Final = 1 << 24


@dataclass
class GrowingTable:
    """The columns of a growing file."""

    path: Path  #: The file.
    names: Sequence[str]  #: Of the columns that are read.
    dialect: Dialect = TO_BE_FOUND  #: How the file is written, as far as that is known.
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
        """Read what is new."""
        with open_file(self.path) as file:
            now = FileIdentity.of(file.fileno())
            if now == self._identity:
                return False, None
            event = self._what_happened(now, file)
            if event is not None:
                self._forget()
            self._identity = now
            changed = event is not None
            file.seek(self._done)
            # No further than the file was when it was looked at: a fast writer never ends.
            left = now.size - self._done
            rest = b""
            while left > 0 and (part := file.read(min(left, _PART_BYTES))):
                left -= len(part)
                whole, _, rest = (rest + part).rpartition(b"\n")
                if whole:
                    changed |= self._take(whole + b"\n")
            return changed, event

    def _what_happened(self, now: FileIdentity, file: FileIO) -> str | None:
        before = self._identity
        if before is None:
            return None
        if (now.device, now.inode) != (before.device, before.inode):
            return "was replaced by another file, which is now read from its start"
        if now.size < self._done:
            return "has become shorter, and is now read again from its start"
        file.seek(self._done - len(self._tail))
        if file.read(len(self._tail)) != self._tail:
            return "was rewritten, and is now read again from its start"
        return None

    def _forget(self) -> None:
        self._head = self._tail = b""
        self._done = self._rows = self._context = 0
        self._columns = {}

    def _take(self, lines: bytes) -> bool:
        """Read whole lines that follow those read so far; return whether there are rows in them."""
        text = self._head + lines
        with tempfile.TemporaryDirectory(prefix="counterspin-") as folder:
            part = Path(folder) / f"rows{self.path.suffix.lower()}"
            part.write_bytes(text)
            try:
                new, first = self._read(part)
            except RecordError:
                if not self._head and text.count(b"\n") < _BEGINNING:
                    return False  # the next time with more
                # Of the file itself it says the right name and line.
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
        """Return the columns of a file, and the line on which the last of its first rows stands."""
        with open_columns(path, self.dialect) as file:
            file.require(list(self.names))
            columns = file.whole(list(self.names))
            number = re.search(r"\d+", file.locate(_FIRST_ROWS - 1))
            return columns, int(number[0]) if number else 0

    def _append(self, new: dict[str, np.ndarray]) -> None:
        """Put rows below the others, in room that doubles as it is needed."""
        more = len(new[self.names[0]])
        for name, values in new.items():
            own = self._columns.get(name)
            if own is None or len(own) < self._rows + more:
                wider = np.empty(max(2 * (self._rows + more), 4096))
                if own is not None:
                    wider[: self._rows] = own[: self._rows]
                self._columns[name] = own = wider
            own[self._rows : self._rows + more] = values
        self._rows += more
