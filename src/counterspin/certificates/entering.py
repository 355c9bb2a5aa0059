"""What goes into an instrument's ledger, and how its entries are shown."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from datetime import datetime
from pathlib import Path

from counterspin.calibration.result import Result
from counterspin.certificates.ledger import (
    Entry,
    OpenLedger,
    VerifiedLedger,
    append,
    checksum_of,
    opened,
    verify_ledger,
)
from counterspin.errors import CounterspinError, RecordError
from counterspin.frozen import frozen
from counterspin.input import read_file
from counterspin.output import finish, reserve, write_whole
from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Table


@frozen
class IssueDetails:
    """Who answers for a certificate, why it is issued and when, and the file of its result."""

    who: str
    why: str
    date: datetime
    result: Path | None = None


def check_ledger(ledger: Path) -> None:
    """Refuse a ledger that was altered, or whose folder is not there."""
    if ledger.exists():
        verify_ledger(ledger)
    else:
        reserve(ledger)


def enter_result(ledger: Path, file: Path, *, who: str, why: str, date: datetime) -> Entry:
    """Enter a result's file."""
    Result.read(file)
    of = {"file": file.name, "sha256": _checksum(file)}
    return append(ledger, "result", of, who=who, why=why, when=_moment(date))


def enter_certificate(
    kept: Path, path: Path, data: bytes, of: Mapping[str, str], said: IssueDetails
) -> Entry | None:
    """Enter a certificate or an amendment, before it its result, and then give its file its name.

    All of it under the ledger's lock, and the entry first: so a certificate that stands is in its
    ledger. The finished bytes lie hidden beside their place, under a name that follows from their
    checksum; if a kill comes between the entry and the name, the same command again finds them.

    Returns: of an interrupted command, whose certificate was found and has its name now, in place
        of `data`, which differ from it; else None.
    """
    checksum = checksum_of(data)
    with opened(kept) as ledger:
        reserve(path)
        earlier = [e for e in ledger.entries if e.of.get("identifier") == of["identifier"]]
        if any(entry.of.get("sha256") != of["sha256"] for entry in earlier):
            for entry in earlier:
                if entry.of.get("file") == path.name and _stands_by(path, entry):
                    _finish(path, entry.of["file_sha256"])
                    return entry
            raise RecordError(
                f"{kept}: has certificate {of['identifier']} already (entry {earlier[-1].number}), "
                "with different content; issue an amendment (`amends`), or "
                "choose another certificate.identifier"
            )
        part = _hidden(path, checksum)
        write_whole(part, lambda place: _write_to_disk(place, data), overwrite=True)
        known = {(entry.of.get("file"), entry.of.get("file_sha256")) for entry in earlier}
        if (path.name, checksum) not in known:
            _enter(ledger, {"file": path.name, **of, "file_sha256": checksum}, said)
        _finish(path, checksum)
    return None


def _enter(ledger: OpenLedger, of: Mapping[str, str], said: IssueDetails) -> None:
    when = _moment(said.date)
    if said.result is not None:
        checksum = _checksum(said.result)
        if checksum not in {entry.of.get("sha256") for entry in ledger.entries}:
            own = {"file": said.result.name, "sha256": checksum}
            ledger.append("result", own, who=said.who, why="to be certified", when=when)
        of = {**of, "result": checksum}
    what = "amendment" if "amends" in of else "certificate"
    ledger.append(what, of, who=said.who, why=said.why, when=when)


def _hidden(path: Path, checksum: str) -> Path:
    """Return where a certificate lies until it has its name."""
    return path.resolve().parent / f".{checksum[:16]}{path.suffix}"


def _stands_by(path: Path, entry: Entry) -> bool:
    """Return whether the bytes of an entry lie hidden beside a place."""
    expected = entry.of.get("file_sha256", "")
    try:
        return checksum_of(read_file(_hidden(path, expected))) == expected
    except OSError:
        return False


def _write_to_disk(place: Path, data: bytes) -> None:
    # The entry is on the disk before the file has its name: its bytes must be there too.
    with place.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _finish(path: Path, checksum: str) -> None:
    try:
        finish(_hidden(path, checksum), path)
    except OSError as error:
        raise CounterspinError(f"{path}: cannot be written ({error.strerror})") from error


def ledger_blocks(verified: VerifiedLedger) -> Iterator[Block]:
    """Yield the entries of a ledger, and the hash that stands for all of them."""
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
        f"{len(verified.entries)} entries, none altered. Hash of the last: {verified.head}. Keep a "
        "copy elsewhere: it reveals whether entries were removed at the end, or the whole ledger "
        "was rewritten."
    )


def _checksum(file: Path) -> str:
    try:
        return checksum_of(read_file(file))
    except OSError as error:
        raise RecordError(f"{file}: cannot be read ({error.strerror})") from error


def _moment(date: datetime) -> str:
    return f"{date:%Y-%m-%dT%H:%M:%SZ}"
