"""What goes into an instrument's ledger, and how its entries are shown.

- `check_ledger`: whether anything can be entered, before there is a result to lose
- `enter_result`: a result's file
- `enter_certificate`: a certificate that was issued, and the result that it certifies
- `ledger_blocks`: the entries as a table
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import datetime
from pathlib import Path

from counterspin.calibration.result import Result
from counterspin.certificates.ledger import (
    Entry,
    VerifiedLedger,
    append,
    checksum_of,
    verify_ledger,
)
from counterspin.errors import CounterspinError, RecordError
from counterspin.input import read_file
from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Table


def check_ledger(ledger: Path) -> None:
    """Refuse a ledger that was altered, or whose folder is not there.

    Raises
    ------
    RecordError
        If there is one that was altered or cannot be read.
    CounterspinError
        If there is none, and no folder to make it in.
    """
    if ledger.exists():
        verify_ledger(ledger)
    elif not ledger.resolve().parent.is_dir():
        raise CounterspinError(
            f"{ledger}: the ledger cannot be written: there is no folder {ledger.parent}"
        )


def enter_result(ledger: Path, file: Path, *, who: str, why: str, date: datetime) -> Entry:
    """Enter a result's file.

    Parameters
    ----------
    ledger
        The ledger.
    file
        The result; it must be one that can be read.
    who, why, date
        Who enters it, why and when.

    Raises
    ------
    RecordError
        If the result cannot be read, or the ledger was altered.
    CounterspinError
        If the ledger cannot be written.
    """
    Result.read(file)
    of = {"file": file.name, "sha256": _checksum(file)}
    return append(ledger, "result", of, who=who, why=why, when=_moment(date))


def enter_certificate(
    ledger: Path,
    of: Mapping[str, str],
    result: Path | None,
    *,
    who: str,
    why: str,
    date: datetime,
) -> Entry:
    """Enter a certificate or an amendment, and before it its result if that is not there.

    Parameters
    ----------
    ledger
        The ledger.
    of
        Of the certificate: its file, identifier and checksums; ``amends`` makes it an amendment.
    result
        The file of the result that it certifies; None if there is no such file.
    who, why, date
        Who answers for it, why it was issued, and when.

    Raises
    ------
    RecordError
        If the ledger was altered.
    CounterspinError
        If it cannot be written.
    """
    if result is not None:
        checksum = _checksum(result)
        of = {**of, "result": checksum}
        known = verify_ledger(ledger).entries if ledger.exists() else ()
        if checksum not in {entry.of.get("sha256") for entry in known}:
            enter_result(ledger, result, who=who, why="to be certified", date=date)
    what = "amendment" if "amends" in of else "certificate"
    return append(ledger, what, of, who=who, why=why, when=_moment(date))


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
        f"{len(verified.entries)} entries, none altered since. Hash of the last: {verified.head}. "
        "Kept elsewhere, it shows whether the last ones were taken off, or all were written anew."
    )


def _checksum(file: Path) -> str:
    try:
        return checksum_of(read_file(file))
    except OSError as error:
        raise RecordError(f"{file}: cannot be read ({error.strerror})") from error


def _moment(date: datetime) -> str:
    return f"{date:%Y-%m-%dT%H:%M:%SZ}"
