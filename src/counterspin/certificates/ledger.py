"""The append-only ledger of an instrument: results, certificates and amendments, one line each.

Each line is a JSON entry with its own SHA-256 hash and the hash of the previous entry. To change,
remove or move an entry, all later entries must be rewritten. A separate copy of the last hash
reveals even that. An entry is valid only if its newline is on the disk.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from counterspin.calibration.result import Result
from counterspin.errors import (
    CounterspinError,
    RecordError,
    WriteError,
    describe_read_error,
    read_error_code,
)
from counterspin.frozen import frozen
from counterspin.input import MAX_DOCUMENT_BYTES, parse_json, read_file, require_regular_file
from counterspin.output import check_writable, move_into_place, require_valid_name, write_atomically
from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Table

#: Hash of the previous entry in the first entry.
_INITIAL_HASH: Final = "0" * 64

#: Offset of the byte that is locked on Windows: beyond the largest ledger, so it stays readable.
_LOCKED_BYTE: Final = 0x7FFF_0000
#: Time between two attempts to lock a ledger on Windows, s.
_LOCK_PAUSE: Final = 0.05

_NOT_A_LEDGER_MESSAGE: Final = (
    "entry 1 was altered, or this file is not a ledger; do not rely on this file. Give the "
    "ledger, or the name of a new file"
)

#: Keys of an entry, in the order in which they are written; `hash` is last.
_ENTRY_KEYS: Final = ("number", "previous", "when", "who", "what", "why", "of", "hash")

#: Types of entries.
ENTRY_TYPES: Final = ("result", "certificate", "amendment")


@frozen
class Entry:
    """An entry of a ledger."""

    number: int  #: Number of the entry, from 1.
    when: str  #: Time, ISO 8601, UTC.
    who: str  #: Person.
    entry_type: str  #: One of `ENTRY_TYPES`.
    why: str  #: Reason.
    subject: Mapping[str, str]  #: Names, identifiers and checksums.
    digest: str  #: SHA-256 of the entry and of the previous hash, hexadecimal.


@frozen
class VerifiedLedger:
    """A ledger whose entries were not altered."""

    entries: tuple[Entry, ...]  #: All entries, oldest first.
    #: Bytes after the last entry, from an interrupted write.
    partial_entry: bytes = b""

    @property
    def head(self) -> str:
        """Hash of the last entry, which identifies all entries."""
        return self.entries[-1].digest if self.entries else _INITIAL_HASH


def verify_ledger(path: Path) -> VerifiedLedger:
    """Read and verify a ledger."""
    try:
        return _verify_content(read_file(path), str(path))
    except OSError as error:
        raise RecordError(
            f"{path}: {describe_read_error(error)}", code=read_error_code(error)
        ) from error


def append_entry(
    path: Path, entry_type: str, subject: Mapping[str, str], *, who: str, why: str, when: str
) -> Entry:
    """Append an entry; concurrent processes wait for each other.

    Parameters and errors as for `open_ledger` and `OpenLedger.append`.
    """
    with open_ledger(path) as ledger:
        return ledger.append(entry_type, subject, who=who, why=why, when=when)


def sha256_hex(content: bytes) -> str:
    """Return the SHA-256 checksum of bytes, hexadecimal."""
    return hashlib.sha256(content).hexdigest()


class OpenLedger:
    """A locked ledger, for which other writers wait.

    descriptor: File descriptor, open for appending; RecordError if the ledger was altered.
    """

    def __init__(self, path: Path, descriptor: int) -> None:
        self._path, self._file = path, descriptor
        self._size = os.fstat(descriptor).st_size
        if self._size > MAX_DOCUMENT_BYTES:
            raise RecordError(
                f"{path} has more than {MAX_DOCUMENT_BYTES} bytes; start a new ledger",
                code="file-too-large",
            )
        content = b""
        while chunk := os.read(descriptor, self._size + 1):
            content += chunk
        verified_ledger = _verify_content(content, str(path))
        self.entries, self._unfinished = verified_ledger.entries, verified_ledger.partial_entry
        self._head = verified_ledger.head

    def append(
        self, entry_type: str, subject: Mapping[str, str], *, who: str, why: str, when: str
    ) -> Entry:
        """Append an entry and flush it to the disk.

        The remainder of an interrupted write is removed and kept in the `subject` of the new entry,
        as ``unfinished``.
        """
        if self._unfinished:
            subject = {**subject, "unfinished": self._unfinished.decode("utf-8", "replace")}
        content = {
            "number": len(self.entries) + 1,
            "previous": self._head,
            "when": when,
            "who": who,
            "what": entry_type,
            "why": why,
            "of": dict(subject),
        }
        content["hash"] = _content_hash(content)
        line = _format_line(content)
        try:
            if self._unfinished:
                os.ftruncate(self._file, self._size - len(self._unfinished))
                self._unfinished = b""
            n_written = 0
            while n_written < len(line):
                n_written += os.write(self._file, line[n_written:])
            os.fsync(self._file)
        except OSError as error:
            raise _write_error(self._path, error) from error
        entry = _make_entry(content)
        self.entries, self._head = (*self.entries, entry), entry.digest
        return entry


@contextmanager
def open_ledger(path: Path) -> Iterator[OpenLedger]:
    """Lock a ledger; create it if it does not exist.

    Other writers wait until the lock is released or the process ends.
    """
    require_valid_name(path)
    is_new = not path.exists()
    flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | getattr(os, "O_BINARY", 0)
    try:
        # Opening a pipe would block until a writer connects.
        descriptor = os.open(path, flags | getattr(os, "O_NONBLOCK", 0), 0o666)
    except OSError as error:
        raise _write_error(path, error) from error
    try:
        try:
            require_regular_file(path, os.fstat(descriptor).st_mode)
            _lock_file(descriptor)
            ledger = OpenLedger(path, descriptor)
        except OSError as error:
            raise _write_error(path, error) from error
        yield ledger
        if is_new and hasattr(os, "O_DIRECTORY"):
            folder_descriptor = os.open(path.resolve().parent, os.O_RDONLY)
            os.fsync(folder_descriptor)
            os.close(folder_descriptor)
    finally:
        _unlock_file(descriptor)
        os.close(descriptor)


def _unlock_file(descriptor: int) -> None:
    """Unlock a ledger immediately; Windows unlocks it only some time after the process ends."""
    if sys.platform == "win32":
        import msvcrt

        with suppress(OSError):  # it was not locked
            os.lseek(descriptor, _LOCKED_BYTE, os.SEEK_SET)
            msvcrt.locking(descriptor, msvcrt.LK_UNLCK, 1)


def _lock_file(descriptor: int) -> None:
    if sys.platform == "win32":
        import msvcrt

        # LK_LOCK gives up after ten attempts in ten seconds.
        os.lseek(descriptor, _LOCKED_BYTE, os.SEEK_SET)
        while True:
            try:
                msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
                break
            except OSError as error:
                if error.errno not in (errno.EACCES, errno.EDEADLK):
                    raise
                time.sleep(_LOCK_PAUSE)
        os.lseek(descriptor, 0, os.SEEK_SET)
    else:
        import fcntl

        fcntl.flock(descriptor, fcntl.LOCK_EX)


def _write_error(path: Path, error: OSError) -> CounterspinError:
    reason = error.strerror or str(error)
    return WriteError(f"{path}: the ledger cannot be written ({reason})")


# Lines


def _verify_content(ledger_content: bytes, source: str) -> VerifiedLedger:
    *lines, partial_entry = ledger_content.split(b"\n")
    entries: list[Entry] = []
    previous_hash = _INITIAL_HASH
    for number, line in enumerate(lines, 1):
        entry_content = _parse_line(line)
        problem, entry_number = None, number
        if entry_content is None or _format_line(entry_content) != line + b"\n":
            problem = "was changed after it was written"
        elif entry_content["hash"] != _content_hash(entry_content):
            problem = "was altered: its hash does not match its content"
        elif entry_content["number"] != number:
            problem = f"has the number {entry_content['number']}: entries are missing or were moved"
        elif entry_content["previous"] != previous_hash:
            # The hash chain shows it only in the following entry.
            problem, entry_number = "was altered after it was written, or removed", number - 1
        if problem is not None or entry_content is None:
            if entry_content is None and number == 1:
                raise RecordError(f"{source}: {_NOT_A_LEDGER_MESSAGE}", code="wrong-document")
            entry_text = f"entry {entry_number}" if entry_number else "the beginning"
            raise RecordError(
                f"{source}: {entry_text} {problem}; do not rely on this entry or on later entries",
                code="ledger-altered",
            )
        entries.append(_make_entry(entry_content))
        previous_hash = entry_content["hash"]
    if partial_entry and not entries and not _begins_entry(partial_entry):
        # Bytes that do not begin an entry show that the file is not a ledger.
        raise RecordError(f"{source}: {_NOT_A_LEDGER_MESSAGE}", code="wrong-document")
    return VerifiedLedger(tuple(entries), partial_entry)


def _begins_entry(line: bytes) -> bool:
    """Return whether a line can be the beginning of the first entry."""
    prefix = _canonical_json({"number": 1, "previous": _INITIAL_HASH})[:-1].encode()
    return line.startswith(prefix) or prefix.startswith(line)


def _parse_line(line: bytes) -> dict[str, Any] | None:
    """Return the content of a line; None if it is not an entry."""
    try:
        content = parse_json(line)
    except ValueError:
        return None
    if not isinstance(content, dict) or tuple(content) != _ENTRY_KEYS:
        return None
    number, subject, *texts = (content[key] for key in ("number", "of", *_ENTRY_KEYS[1:6], "hash"))
    if type(number) is not int or not isinstance(subject, dict):
        return None
    if not all(isinstance(text, str) for text in (*texts, *subject.values())):
        return None
    return content


def _format_line(content: Mapping[str, Any]) -> bytes:
    return (_canonical_json(content) + "\n").encode("utf-8", "surrogatepass")


def _canonical_json(content: Mapping[str, Any]) -> str:
    return json.dumps(content, ensure_ascii=True, separators=(",", ":"))


def _content_hash(content: Mapping[str, Any]) -> str:
    return sha256_hex(
        _canonical_json({key: value for key, value in content.items() if key != "hash"}).encode()
    )


def _make_entry(content: Mapping[str, Any]) -> Entry:
    return Entry(
        number=content["number"],
        when=content["when"],
        who=content["who"],
        entry_type=content["what"],
        why=content["why"],
        subject=content["of"],
        digest=content["hash"],
    )


@frozen
class IssueDetails:
    """Signatory, reason and date of issue of a certificate, and its result file."""

    who: str
    why: str
    date: datetime
    result: Path | None = None


def check_ledger(ledger: Path) -> None:
    """Raise an error if a ledger was altered or its folder does not exist."""
    if ledger.exists():
        verify_ledger(ledger)
    else:
        check_writable(ledger)


def record_result(ledger: Path, file: Path, *, who: str, why: str, date: datetime) -> Entry:
    """Append an entry for a result file."""
    if not Result.read(file).sealed:
        why += "; the file has no seal"
    subject = {"file": file.name, "sha256": _file_checksum(file)}
    return append_entry(ledger, "result", subject, who=who, why=why, when=_utc_text(date))


def record_certificate(
    ledger_path: Path, path: Path, content: bytes, subject: Mapping[str, str], details: IssueDetails
) -> Entry | None:
    """Append the entry of a certificate or amendment, then publish its file.

    The ledger is locked, and the entry precedes the file, so that every published certificate is
    in its ledger. The file is staged in the same folder under a hidden name derived from its
    checksum. If the process is interrupted after the entry, the same command publishes the file.

    Returns: Entry of an interrupted command, whose staged certificate is published instead of
        `content`; otherwise None.
    """
    checksum = sha256_hex(content)
    with open_ledger(ledger_path) as ledger:
        check_writable(path)
        earlier_entries = [
            entry
            for entry in ledger.entries
            if entry.subject.get("identifier") == subject["identifier"]
        ]
        if any(entry.subject.get("sha256") != subject["sha256"] for entry in earlier_entries):
            for entry in earlier_entries:
                if entry.subject.get("file") == path.name and _is_staged(path, entry):
                    _publish_file(path, entry.subject["file_sha256"])
                    return entry
            raise RecordError(
                f"{ledger_path} already contains certificate {subject['identifier']} (entry "
                f"{earlier_entries[-1].number}) with different content; issue an amendment "
                "(`amends`), or choose another certificate.identifier",
                code="ledger-conflict",
            )
        _check_amended_entry(ledger, ledger_path, subject)
        staging_path = _staging_path(path, checksum)
        write_atomically(staging_path, lambda path: _write_to_disk(path, content), overwrite=True)
        recorded_files = {
            (entry.subject.get("file"), entry.subject.get("file_sha256"))
            for entry in earlier_entries
        }
        if (path.name, checksum) not in recorded_files:
            _append_certificate_entry(
                ledger, {"file": path.name, **subject, "file_sha256": checksum}, details
            )
        _publish_file(path, checksum)
    return None


def _check_amended_entry(ledger: OpenLedger, ledger_path: Path, subject: Mapping[str, str]) -> None:
    """Raise RecordError if the amended certificate differs from its entries in the ledger."""
    if "amends" not in subject:
        return
    amended_entries = [
        entry for entry in ledger.entries if entry.subject.get("identifier") == subject["amends"]
    ]
    if amended_entries and all(
        entry.subject.get("sha256") != subject["amends_sha256"] for entry in amended_entries
    ):
        raise RecordError(
            f"{ledger_path}: entry {amended_entries[-1].number} records certificate "
            f"{subject['amends']} with different content, so the file to be amended was changed "
            "after it was issued. Give the issued file",
            code="ledger-conflict",
        )


def _append_certificate_entry(
    ledger: OpenLedger, subject: Mapping[str, str], details: IssueDetails
) -> None:
    when = _utc_text(details.date)
    if details.result is not None:
        checksum = _file_checksum(details.result)
        if checksum not in {entry.subject.get("sha256") for entry in ledger.entries}:
            result_subject = {"file": details.result.name, "sha256": checksum}
            ledger.append(
                "result", result_subject, who=details.who, why="to be certified", when=when
            )
        subject = {**subject, "result": checksum}
    entry_type = "amendment" if "amends" in subject else "certificate"
    ledger.append(entry_type, subject, who=details.who, why=details.why, when=when)


def _staging_path(path: Path, checksum: str) -> Path:
    """Return the hidden path of a certificate before publication."""
    return path.resolve().parent / f".{checksum[:16]}{path.suffix}"


def _is_staged(path: Path, entry: Entry) -> bool:
    """Return whether the staged file of an entry exists in the folder of a path."""
    expected_checksum = entry.subject.get("file_sha256", "")
    try:
        return sha256_hex(read_file(_staging_path(path, expected_checksum))) == expected_checksum
    except OSError:
        return False


def _write_to_disk(path: Path, content: bytes) -> None:
    # The entry precedes the rename, so the bytes of the file must be on the disk too.
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _publish_file(path: Path, checksum: str) -> None:
    try:
        move_into_place(_staging_path(path, checksum), path)
    except OSError as error:
        raise WriteError(f"{path} cannot be written ({error.strerror})") from error


def ledger_blocks(verified_ledger: VerifiedLedger) -> Iterator[Block]:
    """Yield a table of the entries of a ledger, and the hash of the last entry."""
    yield Heading("Ledger", 1)
    yield Table(
        (
            Column("", "right"),
            Column("When"),
            Column("What"),
            Column("Of", wraps=True),
            Column("Who", wraps=True),
            Column("Why", wraps=True),
        ),
        tuple(
            (
                str(entry.number),
                entry.when,
                entry.entry_type,
                entry.subject.get("identifier") or entry.subject.get("file", ""),
                entry.who,
                entry.why,
            )
            for entry in verified_ledger.entries
        ),
    )
    yield Paragraph(
        f"Number of entries: {len(verified_ledger.entries)}. No entry was altered. Hash of the "
        "last entry: "
        f"{verified_ledger.head}. Keep a copy of this hash elsewhere. If the last entries are "
        "removed or the whole ledger is rewritten, the hash will differ from your copy."
    )


def _file_checksum(file: Path) -> str:
    try:
        return sha256_hex(read_file(file))
    except OSError as error:
        raise RecordError(
            f"{file}: {describe_read_error(error)}", code=read_error_code(error)
        ) from error


def _utc_text(date: datetime) -> str:
    return f"{date:%Y-%m-%dT%H:%M:%SZ}"
