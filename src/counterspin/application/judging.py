"""Runs judged while the centrifuge turns, as the page asks for them."""

from __future__ import annotations

from typing import Any

from counterspin.application.commands import check_command, watch_command
from counterspin.application.desk import Desk
from counterspin.application.folder import NotThereError
from counterspin.monitoring.check import check
from counterspin.monitoring.goals import goals_of
from counterspin.reports.html import part
from counterspin.reports.typography import typeset_block


def judged(desk: Desk, name: str, run: str) -> dict[str, Any]:
    """Return the judgement of a run's record as HTML, whether it is good, and the command."""
    campaign = desk.campaign(name)
    records = [found.record for found in campaign.runs if found.name == run]
    if not records:
        raise NotThereError(f"{name}: there is no run {run!r} with a record")
    checked = check(records[0], campaign, run=run)
    blocks = list(map(typeset_block, checked.blocks()))
    return {
        "html": part(blocks, title=f"Check of {run}"),
        "good": checked.good,
        "command": check_command(records[0], campaign.folder, run),
    }


def followed(desk: Desk, name: str, goal: str = "") -> dict[str, Any]:
    """Return the newest state of a campaign whose records grow, and the command.

    name: The campaign's folder.
    goal: Such as ``K_II 1e-8 g/g^2``; empty: none.
    """
    campaign = desk.campaign(name)
    goals_of(campaign, [goal] if goal else [])  # a mistake is told before anything is begun
    told = desk.live.look(campaign.path, goal)
    if "error" in told:
        told = told | {"error": desk.folder.spoken(told["error"])}
    return told | {"command": watch_command(campaign.folder, goal)}
