"""Checksums of a campaign's files, taken on threads of their own while all else goes on."""

from __future__ import annotations

import hashlib
import os
import sys
import threading
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Final

from counterspin.campaign.documents import description_file, load_document
from counterspin.errors import CampaignError
from counterspin.input import FileIdentity, open_file
from counterspin.records.isolation import prepare

#: How much nicer the threads are than the process: what is read for the result comes first, but on
#: a machine that is busy with other work the end must not have to wait for them.
_NICENESS: Final = 10
#: Files at a time once all records are read: then every core is free, and a file takes but one.
#: Before that it is one, for more would keep the interpreter from what is loaded meanwhile.
_THREADS: Final = 4
#: Bytes between two requests for the interpreter's lock, for which imports let others wait; few
#: enough to remain in a processor's cache between the system's copy and the checksum.
_BUFFER_BYTES: Final = 1 << 21


class Checksums:
    """SHA-256 of files, each computed once; on exit, unrequested computations are cancelled."""

    def __init__(self) -> None:
        self._workers = ThreadPoolExecutor(_THREADS, initializer=_lower_priority)
        self._turns = threading.Semaphore(1)
        self._hurried = False
        self._taken: dict[Path, Future[tuple[str, FileIdentity | None]]] = {}
        self._given_up = threading.Event()

    def __enter__(self) -> Checksums:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._given_up.set()
        self._workers.shutdown(cancel_futures=True)

    def prefetch(self, where: Path | str) -> list[Path]:
        """Begin with the files that a campaign seems to have, before its description is checked.

        where: The campaign's folder or its description; what is wrong with it is for others to say.
        """
        with suppress(CampaignError, OSError, TypeError, ValueError, LookupError, AttributeError):
            file = description_file(where).absolute()
            runs = load_document(file)["runs"]
            records = [file.parent / run["record"] for run in runs if not run.get("skip")]
            self._begin([file, *records])
            return records
        return []

    def run_parallel(self) -> None:
        """Compute several checksums at a time from now on: nothing else needs all cores."""
        if not self._hurried:
            self._hurried = True
            self._turns.release(_THREADS - 1)

    def checksums(self, files: Iterable[Path]) -> list[str]:
        """Return the checksums of files, such as ``sha256:9f86...``, or ``unreadable``."""
        requested = list(files)
        self._begin(requested)
        self.run_parallel()
        return [self._taken[file].result()[0] for file in requested]

    def identity(self, file: Path) -> FileIdentity | None:
        """Return the identity of a file's content; None if it is unreadable or was changed."""
        self._begin([file])
        self.run_parallel()
        return self._taken[file].result()[1]

    def _begin(self, files: Iterable[Path]) -> None:
        for file in files:
            if file not in self._taken:
                self._taken[file] = self._workers.submit(self._compute, file)

    def _compute(self, path: Path) -> tuple[str, FileIdentity | None]:
        digest = hashlib.sha256()
        try:
            with self._turns, open_file(path) as file:
                before = FileIdentity.from_file(file.fileno())
                buffer = memoryview(bytearray(_BUFFER_BYTES))
                while (read := file.readinto(buffer)) and not self._given_up.is_set():
                    digest.update(buffer[:read])
                after = FileIdentity.from_file(file.fileno())
        except OSError:
            # Reading the record says what is wrong with the file, and says it better.
            return "unreadable", None
        return f"sha256:{digest.hexdigest()}", before if before == after else None


def _lower_priority() -> None:
    if sys.platform == "linux":
        niceness = os.getpriority(os.PRIO_PROCESS, 0)
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), min(niceness + _NICENESS, 19))


#: The campaign that was begun with and is not asked for yet, as it was named.
_STARTED: dict[Path, Checksums] = {}


@contextmanager
def prefetch_campaign(where: str) -> Iterator[None]:
    """Start on a campaign that is about to be requested; on exit, cancel the remaining work."""
    with Checksums() as checksums:
        _begin(checksums, where)
        _STARTED[Path(where)] = checksums
        try:
            yield
        finally:
            _STARTED.clear()


@contextmanager
def checksums_of(where: object) -> Iterator[Checksums]:
    """Return a campaign's checksums, with its files started.

    where: The campaign's folder or its description; nothing is started for a campaign that is read.
    """
    path = Path(where) if isinstance(where, Path | str) else None
    if path is not None and path in _STARTED:
        yield _STARTED.pop(path)
        return
    with Checksums() as checksums:
        if path is not None:
            _begin(checksums, path)
        yield checksums


def _begin(checksums: Checksums, where: Path | str) -> None:
    for record in checksums.prefetch(where):
        prepare(record)
