"""Checksums of a campaign's files, computed on background threads."""

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
from counterspin.records.isolation import prepare_reader

#: Increase of the threads' niceness relative to the process. Reading for the result takes priority,
#: but the checksums must also make progress on a busy machine.
_NICENESS_INCREMENT: Final = 10
#: Number of files hashed in parallel after all records are read. Before that, files are hashed one
#: at a time, because more threads would delay the imports.
_THREADS: Final = 4
#: Bytes read between two acquisitions of the interpreter lock; they fit into the processor cache.
_BUFFER_BYTES: Final = 1 << 21


class Checksums:
    """SHA-256 of files, each computed once; on exit, unrequested computations are cancelled."""

    def __init__(self) -> None:
        self._workers = ThreadPoolExecutor(_THREADS, initializer=_lower_priority)
        self._slots = threading.Semaphore(1)
        self._is_parallel = False
        self._futures: dict[Path, Future[tuple[str, FileIdentity | None]]] = {}
        self._cancelled = threading.Event()

    def __enter__(self) -> Checksums:
        return self

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._cancelled.set()
        self._workers.shutdown(cancel_futures=True)

    def prefetch(self, path: Path | str) -> list[Path]:
        """Start hashing the files of a campaign before its description is checked.

        path: Folder or description of the campaign. Errors in it are ignored here.
        Returns: The record files; empty if the description cannot be read.
        """
        with suppress(CampaignError, OSError, TypeError, ValueError, LookupError, AttributeError):
            file = description_file(path).absolute()
            runs = load_document(file)["runs"]
            records = [file.parent / run["record"] for run in runs if not run.get("skip")]
            self._submit([file, *records])
            return records
        return []

    def run_parallel(self) -> None:
        """Compute several checksums in parallel from now on."""
        if not self._is_parallel:
            self._is_parallel = True
            self._slots.release(_THREADS - 1)

    def checksums(self, files: Iterable[Path]) -> list[str]:
        """Return the checksums of files, such as ``sha256:9f86...``, or ``unreadable``."""
        requested_files = list(files)
        self._submit(requested_files)
        self.run_parallel()
        return [self._futures[file].result()[0] for file in requested_files]

    def identity(self, file: Path) -> FileIdentity | None:
        """Return the identity of a file's content; None if it is unreadable or was changed."""
        self._submit([file])
        self.run_parallel()
        return self._futures[file].result()[1]

    def _submit(self, files: Iterable[Path]) -> None:
        for file in files:
            if file not in self._futures:
                self._futures[file] = self._workers.submit(self._compute_checksum, file)

    def _compute_checksum(self, path: Path) -> tuple[str, FileIdentity | None]:
        digest = hashlib.sha256()
        try:
            with self._slots, open_file(path) as file:
                identity_before = FileIdentity.from_file(file.fileno())
                buffer = memoryview(bytearray(_BUFFER_BYTES))
                while (n_bytes := file.readinto(buffer)) and not self._cancelled.is_set():
                    digest.update(buffer[:n_bytes])
                identity_after = FileIdentity.from_file(file.fileno())
        except OSError:
            # The reader of the record reports the error with more detail.
            return "unreadable", None
        return (
            f"sha256:{digest.hexdigest()}",
            identity_before if identity_before == identity_after else None,
        )


def _lower_priority() -> None:
    if sys.platform == "linux":
        niceness = os.getpriority(os.PRIO_PROCESS, 0)
        os.setpriority(
            os.PRIO_PROCESS, threading.get_native_id(), min(niceness + _NICENESS_INCREMENT, 19)
        )


#: Campaign path -> prefetched checksums that have not been requested yet.
_CHECKSUMS_BY_PATH: dict[Path, Checksums] = {}


@contextmanager
def prefetch_campaign(path: str) -> Iterator[None]:
    """Start hashing and reading a campaign's files; on exit, cancel the remaining work."""
    with Checksums() as checksums:
        _start_reading(checksums, path)
        _CHECKSUMS_BY_PATH[Path(path)] = checksums
        try:
            yield
        finally:
            _CHECKSUMS_BY_PATH.clear()


@contextmanager
def checksums_of(campaign: object) -> Iterator[Checksums]:
    """Return the checksums of a campaign, whose files are being hashed.

    campaign: Folder or description of the campaign. For any other object, such as a campaign that
        has been read, no file is started.
    """
    path = Path(campaign) if isinstance(campaign, Path | str) else None
    if path is not None and path in _CHECKSUMS_BY_PATH:
        yield _CHECKSUMS_BY_PATH.pop(path)
        return
    with Checksums() as checksums:
        if path is not None:
            _start_reading(checksums, path)
        yield checksums


def _start_reading(checksums: Checksums, path: Path | str) -> None:
    for record in checksums.prefetch(path):
        prepare_reader(record)
