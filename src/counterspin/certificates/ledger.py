"""The append-only ledger of an instrument: results, certificates and amendments, one line each.

Each line is one entry as JSON, and contains the SHA-256 of the previous entry and its own. Whoever
changes, removes or moves an entry must therefore rewrite all later ones. A copy of the last hash,
kept elsewhere, shows even that. An entry is valid only with its newline on the disk.
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
_FIRST_PREVIOUS: Final = "0" * 64

#: Offset of the byte that Windows locks: beyond the largest ledger, so that others can read it.
_LOCKED_BYTE: Final = 0x7FFF_0000
#: Time between two attempts to lock a ledger on Windows, s.
_LOCK_PAUSE: Final = 0.05

_NO_LEDGER: Final = (
    "entry 1 was altered, or this file is not a ledger; do not rely on this file. Give the "
    "ledger, or the name of a new file"
)

#: Keys of an entry, in the order in which they are written; `hash` is last.
_KEYS: Final = ("number", "previous", "when", "who", "what", "why", "of", "hash")

#: Types of entries.
KINDS: Final = ("result", "certificate", "amendment")


@frozen
class Entry:
    """An entry of a ledger."""

    number: int  #: From 1 on.
    when: str  #: ISO 8601, UTC.
    #: Person, type and reason.
    who: str
    what: str  #: One of `KINDS`.
    why: str
    of: Mapping[str, str]  #: Names, identifiers and checksums.
    digest: str  #: SHA-256 of all this and of the previous entry's hash, hexadecimal.


@frozen
class VerifiedLedger:
    """A ledger whose entries were not altered."""

    entries: tuple[Entry, ...]  #: All entries, oldest first.
    #: Bytes after the last entry: the beginning of an interrupted one.
    partial_entry: bytes = b""

    @property
    def head(self) -> str:
        """Hash of the last entry, which identifies all of them."""
        return self.entries[-1].digest if self.entries else _FIRST_PREVIOUS


def verify_ledger(path: Path) -> VerifiedLedger:
    """Read a ledger and check it, to the last byte."""
    try:
        return _verify_content(read_file(path), str(path))
    except OSError as error:
        raise RecordError(
            f"{path}: {describe_read_error(error)}", code=read_error_code(error)
        ) from error


def append(path: Path, what: str, of: Mapping[str, str], *, who: str, why: str, when: str) -> Entry:
    """Append an entry; concurrent processes wait for each other.

    Parameters and errors as for `open_ledger` and `OpenLedger.append`.
    """
    with open_ledger(path) as ledger:
        return ledger.append(what, of, who=who, why=why, when=when)


def checksum_of(data: bytes) -> str:
    """Return the SHA-256 checksum of bytes, hexadecimal."""
    return hashlib.sha256(data).hexdigest()


class OpenLedger:
    """A locked ledger: other writers wait.

    file: The file, open for appending; RecordError if it was altered.
    """

    def __init__(self, path: Path, file: int) -> None:
        self._path, self._file = path, file
        self._size = os.fstat(file).st_size
        if self._size > MAX_DOCUMENT_BYTES:
            raise RecordError(
                f"{path} has more than {MAX_DOCUMENT_BYTES} bytes; start a new ledger",
                code="file-too-large",
            )
        complete = b""
        while partial_entry := os.read(file, self._size + 1):
            complete += partial_entry
        verified = _verify_content(complete, str(path))
        self.entries, self._unfinished = verified.entries, verified.partial_entry
        self._head = verified.head

    def append(self, what: str, of: Mapping[str, str], *, who: str, why: str, when: str) -> Entry:
        """Append an entry; it is on the disk when this returns.

        The remainder of an interrupted write is not an entry; it is removed, and the new entry
        keeps it in `of`, as ``unfinished``.
        """
        if self._unfinished:
            of = {**of, "unfinished": self._unfinished.decode("utf-8", "replace")}
        content = {
            "number": len(self.entries) + 1,
            "previous": self._head,
            "when": when,
            "who": who,
            "what": what,
            "why": why,
            "of": dict(of),
        }
        content["hash"] = _content_hash(content)
        line = _format_line(content)
        try:
            if self._unfinished:
                os.ftruncate(self._file, self._size - len(self._unfinished))
                self._unfinished = b""
            byte_count = 0
            while byte_count < len(line):
                byte_count += os.write(self._file, line[byte_count:])
            os.fsync(self._file)
        except OSError as error:
            raise _write_error(self._path, error) from error
        entry = _entry(content)
        self.entries, self._head = (*self.entries, entry), entry.digest
        return entry


@contextmanager
def open_ledger(path: Path) -> Iterator[OpenLedger]:
    """Lock a ledger; create it if it does not exist.

    Other writers wait; the lock ends with its process.
    """
    require_valid_name(path)
    is_new = not path.exists()
    flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | getattr(os, "O_BINARY", 0)
    try:
        # Opening a pipe would block until a writer connects.
        file = os.open(path, flags | getattr(os, "O_NONBLOCK", 0), 0o666)
    except OSError as error:
        raise _write_error(path, error) from error
    try:
        try:
            require_regular_file(path, os.fstat(file).st_mode)
            _lock(file)
            ledger = OpenLedger(path, file)
        except OSError as error:
            raise _write_error(path, error) from error
        yield ledger
        if is_new and hasattr(os, "O_DIRECTORY"):
            folder = os.open(path.resolve().parent, os.O_RDONLY)
            os.fsync(folder)
            os.close(folder)
    finally:
        _unlock(file)
        os.close(file)


def _unlock(file: int) -> None:
    """Unlock a ledger immediately; Windows unlocks it only some time after the process ends."""
    if sys.platform == "win32":
        import msvcrt

        with suppress(OSError):  # it was not locked
            os.lseek(file, _LOCKED_BYTE, os.SEEK_SET)
            msvcrt.locking(file, msvcrt.LK_UNLCK, 1)


def _lock(file: int) -> None:
    if sys.platform == "win32":
        import msvcrt

        # LK_LOCK gives up after ten attempts in ten seconds.
        os.lseek(file, _LOCKED_BYTE, os.SEEK_SET)
        while True:
            try:
                msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
                break
            except OSError as error:
                if error.errno not in (errno.EACCES, errno.EDEADLK):
                    raise
                time.sleep(_LOCK_PAUSE)
        os.lseek(file, 0, os.SEEK_SET)
    else:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX)


def _write_error(path: Path, error: OSError) -> CounterspinError:
    reason = error.strerror or str(error)
    return WriteError(f"{path}: the ledger cannot be written ({reason})")


# Lines


def _verify_content(content_bytes: bytes, source: str) -> VerifiedLedger:
    *lines, unfinished = content_bytes.split(b"\n")
    entries: list[Entry] = []
    previous = _FIRST_PREVIOUS
    for number, line in enumerate(lines, 1):
        content = _parse_line(line)
        problem, which = None, number
        if content is None or _format_line(content) != line + b"\n":
            problem = "was changed after it was written"
        elif content["hash"] != _content_hash(content):
            problem = "was altered: its hash does not match its content"
        elif content["number"] != number:
            problem = f"has the number {content['number']}: entries are missing or were moved"
        elif content["previous"] != previous:
            # The hash chain shows it only in the following entry.
            problem, which = "was altered after it was written, or removed", number - 1
        if problem is not None or content is None:
            if content is None and number == 1:
                raise RecordError(f"{source}: {_NO_LEDGER}", code="wrong-document")
            what = f"entry {which}" if which else "the beginning"
            raise RecordError(
                f"{source}: {what} {problem}; do not rely on this entry or on later entries",
                code="ledger-altered",
            )
        entries.append(_entry(content))
        previous = content["hash"]
    if unfinished and not entries and not _begins_entry(unfinished):
        # Bytes that do not begin an entry show that the file is not a ledger.
        raise RecordError(f"{source}: {_NO_LEDGER}", code="wrong-document")
    return VerifiedLedger(tuple(entries), unfinished)


def _begins_entry(line: bytes) -> bool:
    """Return whether a line may be the beginning of the first entry."""
    prefix = _canonical_json({"number": 1, "previous": _FIRST_PREVIOUS})[:-1].encode()
    return line.startswith(prefix) or prefix.startswith(line)


def _parse_line(line: bytes) -> dict[str, Any] | None:
    """Return the content of a line; None if it is not an entry."""
    try:
        content = parse_json(line)
    except ValueError:
        return None
    if not isinstance(content, dict) or tuple(content) != _KEYS:
        return None
    number, of, *words = (content[key] for key in ("number", "of", *_KEYS[1:6], "hash"))
    if type(number) is not int or not isinstance(of, dict):
        return None
    if not all(isinstance(word, str) for word in (*words, *of.values())):
        return None
    return content


def _format_line(content: Mapping[str, Any]) -> bytes:
    return (_canonical_json(content) + "\n").encode("utf-8", "surrogatepass")


def _canonical_json(content: Mapping[str, Any]) -> str:
    return json.dumps(content, ensure_ascii=True, separators=(",", ":"))


def _content_hash(content: Mapping[str, Any]) -> str:
    return checksum_of(_canonical_json({k: v for k, v in content.items() if k != "hash"}).encode())


def _entry(content: Mapping[str, Any]) -> Entry:
    return Entry(
        number=content["number"],
        when=content["when"],
        who=content["who"],
        what=content["what"],
        why=content["why"],
        of=content["of"],
        digest=content["hash"],
    )


@frozen
class IssueDetails:
    """The signatory of a certificate, the reason and date of issue, and the file of its result."""

    who: str
    why: str
    date: datetime
    result: Path | None = None


def check_ledger(ledger: Path) -> None:
    """Refuse a ledger that was altered, or whose folder does not exist."""
    if ledger.exists():
        verify_ledger(ledger)
    else:
        check_writable(ledger)


def record_result(ledger: Path, file: Path, *, who: str, why: str, date: datetime) -> Entry:
    """Append an entry for a result's file."""
    if not Result.read(file).sealed:
        why += "; the file has no seal"
    of = {"file": file.name, "sha256": _checksum(file)}
    return append(ledger, "result", of, who=who, why=why, when=_utc_text(date))


def record_certificate(
    ledger_path: Path, path: Path, data: bytes, of: Mapping[str, str], details: IssueDetails
) -> Entry | None:
    """Append a certificate's or amendment's entry, after its result's; then rename its file.

    All of it is done under the ledger's lock, and the entry comes first: every published
    certificate is in its ledger. The finished bytes are hidden next to their place, under a name
    that follows from their checksum. If the process is killed between entry and rename, the same
    command finds them.

    Returns: the entry of an interrupted command, whose certificate is published now instead of
    `data`; None if there was no such command.
    """
    checksum = checksum_of(data)
    with open_ledger(ledger_path) as ledger:
        check_writable(path)
        earlier = [e for e in ledger.entries if e.of.get("identifier") == of["identifier"]]
        if any(entry.of.get("sha256") != of["sha256"] for entry in earlier):
            for entry in earlier:
                if entry.of.get("file") == path.name and _is_staged(path, entry):
                    _publish(path, entry.of["file_sha256"])
                    return entry
            raise RecordError(
                f"{ledger_path} already contains certificate {of['identifier']} (entry "
                f"{earlier[-1].number}) with different content; issue an amendment (`amends`), "
                "or choose another certificate.identifier",
                code="ledger-conflict",
            )
        _check_amended(ledger, ledger_path, of)
        staged = _staging_path(path, checksum)
        write_atomically(staged, lambda place: _write_to_disk(place, data), overwrite=True)
        known_entries = {(entry.of.get("file"), entry.of.get("file_sha256")) for entry in earlier}
        if (path.name, checksum) not in known_entries:
            _append_entry(ledger, {"file": path.name, **of, "file_sha256": checksum}, details)
        _publish(path, checksum)
    return None


def _check_amended(ledger: OpenLedger, ledger_path: Path, of: Mapping[str, str]) -> None:
    """Refuse to amend a certificate whose content is not that of its entries, if it has entries."""
    if "amends" not in of:
        return
    amended = [entry for entry in ledger.entries if entry.of.get("identifier") == of["amends"]]
    if amended and all(entry.of.get("sha256") != of["amends_sha256"] for entry in amended):
        raise RecordError(
            f"{ledger_path}: entry {amended[-1].number} records certificate {of['amends']} "
            "with different content, so the file to be amended was changed after it was "
            "issued. Give the issued file",
            code="ledger-conflict",
        )


def _append_entry(ledger: OpenLedger, of: Mapping[str, str], details: IssueDetails) -> None:
    when = _utc_text(details.date)
    if details.result is not None:
        checksum = _checksum(details.result)
        if checksum not in {entry.of.get("sha256") for entry in ledger.entries}:
            result_checksum = {"file": details.result.name, "sha256": checksum}
            ledger.append(
                "result", result_checksum, who=details.who, why="to be certified", when=when
            )
        of = {**of, "result": checksum}
    what = "amendment" if "amends" in of else "certificate"
    ledger.append(what, of, who=details.who, why=details.why, when=when)


def _staging_path(path: Path, checksum: str) -> Path:
    """Return the hidden path of a certificate before its publication."""
    return path.resolve().parent / f".{checksum[:16]}{path.suffix}"


def _is_staged(path: Path, entry: Entry) -> bool:
    """Return whether the staging file of an entry exists next to a path."""
    expected = entry.of.get("file_sha256", "")
    try:
        return checksum_of(read_file(_staging_path(path, expected))) == expected
    except OSError:
        return False


def _write_to_disk(place: Path, data: bytes) -> None:
    # The entry precedes the rename, so the bytes of the file must be on the disk too.
    with place.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _publish(path: Path, checksum: str) -> None:
    try:
        move_into_place(_staging_path(path, checksum), path)
    except OSError as error:
        raise WriteError(f"{path} cannot be written ({error.strerror})") from error


def ledger_blocks(verified: VerifiedLedger) -> Iterator[Block]:
    """Yield the entries of a ledger, and the hash that identifies all of them."""
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
                entry.what,
                entry.of.get("identifier") or entry.of.get("file", ""),
                entry.who,
                entry.why,
            )
            for entry in verified.entries
        ),
    )
    yield Paragraph(
        f"{len(verified.entries)} entries, none of them altered. Hash of the last entry: "
        f"{verified.head}. Keep a copy of this hash elsewhere. If the last entries are "
        "removed or the whole ledger is rewritten, the hash will differ from your copy."
    )


def _checksum(file: Path) -> str:
    try:
        return checksum_of(read_file(file))
    except OSError as error:
        raise RecordError(
            f"{file}: {describe_read_error(error)}", code=read_error_code(error)
        ) from error


def _utc_text(date: datetime) -> str:
    return f"{date:%Y-%m-%dT%H:%M:%SZ}"
