"""`counterspin watch`: a campaign while its records grow."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from counterspin.cli.words import say
from counterspin.errors import CampaignError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from counterspin.monitoring.result import WatchState


def watch(
    directory: Path,
    /,
    *,
    goal: tuple[str, ...] = (),
    plan: Path | None = None,
    interval: float = 1.0,
    once: bool = False,
    json: Annotated[bool, Parameter(name="--json-lines")] = False,
) -> None:
    """Follow records as they grow: rate, ripple, residuals and the uncertainty reached so far.

    Ends when every run is as long as the campaign states, or with Ctrl-C. Nothing is saved: when
    started again, it reads the records again and continues.

    Parameters
    ----------
    directory
        The campaign's folder, or its campaign.toml.
    goal
        Report when this is reached, such as "K_II 1e-8 g/g^2" or "Qx.K_II 0.01 ug/g^2".
    plan
        Take the goals from the target of this PLAN.toml.
    interval
        Seconds between two readings of the files.
    once
        Print the current state, and end.
    json
        Print each state as one line of JSON.
    """
    from counterspin.monitoring.watch import Pace
    from counterspin.monitoring.watch import watch as follow

    if plan is not None and goal:
        raise CampaignError("watch", ["give `goal` or `plan`, not both"])
    states = follow(directory, goals=goal if plan is None else plan, pace=Pace(interval), once=once)
    if json:
        for state in states:
            say(state.model_dump_json(by_alias=True))
            sys.stdout.flush()
    elif sys.stdout.isatty() and not once:
        _live(states)
    else:
        _lines(states, once=once)


def _live(states: Iterator[WatchState]) -> None:
    from rich.live import Live

    from counterspin.reports.text import report_console

    console = report_console()
    with Live(console=console, auto_refresh=False) as live:
        for state in states:
            live.update(state, refresh=True)


def _lines(states: Iterator[WatchState], *, once: bool) -> None:
    from counterspin.monitoring.page import watch_line
    from counterspin.reports.text import report_console

    for state in states:
        if once:
            report_console().print(state)
            return
        clock = time.strftime("%H:%M:%S")
        told = [f"{clock} {event}" for event in state.events]
        said = [f"{clock} {run.run}: {run.why}" for run in state.runs if run.state == "failed"]
        say(*told, *said, f"{clock} {watch_line(state)}")
        sys.stdout.flush()
