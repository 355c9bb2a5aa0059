"""`counterspin ledger`: what was found, certified and amended of an instrument."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from counterspin.cli.words import say
from counterspin.errors import CampaignError


def ledger(
    action: Literal["verify", "add"],
    ledger: Path,
    results: tuple[Path, ...] = (),
    /,
    *,
    who: str | None = None,
    why: str | None = None,
) -> None:
    """Verify that no entry of an instrument's ledger was altered, or add results to it.

    Parameters
    ----------
    action
        verify: check every entry and list them; add: enter results.
    ledger
        The ledger, an append-only file.
    results
        With add: result files.
    who
        With add: name of the person who makes the entry.
    why
        With add: reason for the entry.
    """
    from counterspin.certificates.ledger import ledger_blocks, verify_ledger
    from counterspin.errors import RecordError
    from counterspin.reports.text import Report, report_console

    if action == "add":
        if not results or not who or not why:
            raise CampaignError("ledger", ["give RESULT.json, --who NAME and --why REASON"])
        for file in results:
            add(ledger, file, who=who, why=why)
        return
    if results or who or why:
        raise CampaignError("ledger", ["with verify, give only the ledger"])
    verified = verify_ledger(ledger)
    report_console().print(Report(list(ledger_blocks(verified))))
    if verified.unfinished:
        raise RecordError(
            f"{ledger}: after entry {len(verified.entries)} comes an incomplete line of "
            f"{len(verified.unfinished)} bytes, left by an interrupted command or altered "
            "at its end; the entries before it are intact, and the next entry will preserve it"
        )


def add(ledger: Path, result: Path, *, who: str, why: str) -> None:
    """Enter a result's file, and say so."""
    from counterspin.certificates.ledger import enter_result
    from counterspin.reports.publication import issue_date

    entered = enter_result(ledger, result, who=who, why=why, date=issue_date())
    say(f"{ledger}: entry {entered.number} is result {result}, hash {entered.digest}.")
