"""Plans whose limits are moved like sliders, and whose uncertainty answers at once."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

from pydantic import FiniteFloat

from counterspin.application.desk import Desk, plan_command
from counterspin.application.editing import with_value
from counterspin.application.jobs import Job, Progress, report_progress
from counterspin.campaign.documents import load_document, parse_document
from counterspin.campaign.runs import MOST_ROWS
from counterspin.errors import CampaignError, CounterspinError
from counterspin.frozen import frozen
from counterspin.inference.joint.unknowns import unit_of
from counterspin.output import make_folder
from counterspin.physics.terms import TERMS
from counterspin.planning.design import Limits
from counterspin.planning.plan import (
    PlannedCampaign,
    plan,
    refuse_other_campaign,
    write_campaign,
    write_example,
)
from counterspin.planning.plan_file import Plan, read_plan
from counterspin.planning.search import Search
from counterspin.records.reduction import BLOCKS_PER_REVOLUTION
from counterspin.reports.numbers import field_unit, format_uncertainty
from counterspin.reports.typography import typeset
from counterspin.workers import one_blas_thread

#: How far limits on time and rate can be moved, as factors of what the plan says.
LIMIT_FACTORS: Final = (4.0, 2.0)

#: Longest time at the centrifuge that may be asked for, s: 30 days.
LONGEST_TIME: Final = 30 * 86400.0

#: A search looks no less far beyond its limits: so much more of them is tried by itself.
_LEAST_FACTOR: Final = 1.11


@frozen
class LimitKey:
    """A limit that can be moved."""

    #: What it is called, and its unit in the file.
    words: str
    unit: str
    #: Its range, as factors of what the plan says.
    low: float
    high: float
    whole: bool = False  #: Whether it is a whole number.
    least: float = 0.0  #: Below which it never is.


#: Key of [limits] -> how it is moved.
PLAN_KEYS: Final[Mapping[str, LimitKey]] = {
    "total_time": LimitKey("Time at the centrifuge", "s", 0.25, LIMIT_FACTORS[0]),
    "highest_rate": LimitKey("Highest rate", "rad/s", 0.5, LIMIT_FACTORS[1]),
    "settling": LimitKey("Settling of each run", "s", 0.0, 4.0),
    "runs": LimitKey("Runs at most", "", 0.25, 2.0, whole=True, least=1.0),
    "fewest_revolutions": LimitKey("Revolutions of a run at least", "", 0.5, 4.0, least=1.0),
}


def is_plan(document: Mapping[str, Any]) -> bool:
    """Tell whether a document is a plan of records."""
    return {"limits", "goal"} <= document.keys() and "stations" not in document


def plan_overview(desk: Desk, name: str) -> dict[str, Any]:
    """Return a plan's title, goal and limits with their ranges.

    name: The plan's file.
    """
    file = desk.file(name)
    described = _plan(desk, file)
    values, highs = _values(described.limits), _highs(described)
    return {
        "name": name,
        "title": described.stand_in.title or name,
        "goal": described.goal.kind,
        "names": list(described.goal.sizes),
        "limits": [
            {
                "key": key,
                "words": limit.words,
                "unit": limit.unit,
                "value": values[key],
                "low": _low(limit, values[key]),
                "high": highs[key],
                "whole": limit.whole,
            }
            for key, limit in PLAN_KEYS.items()
        ],
        "command": plan_command(file, None),
    }


def begin_plan(desk: Desk, name: str) -> dict[str, Any]:
    """Write an example of a plan; CounterspinError if there is a file already."""
    path = desk.folder.path(name)
    if path.suffix.lower() != ".toml":
        raise CounterspinError(f"{name}: name the plan's file, such as PLAN.toml")
    write_example(path)
    return {"name": name}


def _low(limit: LimitKey, value: float) -> float:
    low = value * limit.low
    return max(limit.least, round(low) if limit.whole else low)


def _values(limits: Limits) -> dict[str, float]:
    return {
        "total_time": limits.total_time,
        "highest_rate": limits.rate[1],
        "settling": limits.settling,
        "runs": limits.runs,
        "fewest_revolutions": limits.revolutions,
    }


def _plan(desk: Desk, file: Path) -> Plan:
    def make() -> Plan:
        document = load_document(file)
        desk.require_inside(file.parent, document)
        if not is_plan(document):
            raise CampaignError(str(file), ["not a plan of records: it has no [limits] and [goal]"])
        return read_plan(file)

    return desk.remembered.get(("plan", file), [file], make)


def _reach(described: Plan) -> tuple[float, float]:
    """Return how far time and rate can be moved: less far where runs become too long."""
    limits = described.limits
    turns = min(limits.longest_run, limits.total_time) * limits.rate[1] / (2.0 * math.pi)
    room = MOST_ROWS / BLOCKS_PER_REVOLUTION / (turns * LIMIT_FACTORS[0] * LIMIT_FACTORS[1])
    shrunk = min(1.0, math.sqrt(room))
    return (
        max(_LEAST_FACTOR, LIMIT_FACTORS[0] * shrunk),
        max(_LEAST_FACTOR, LIMIT_FACTORS[1] * shrunk),
    )


def _highs(described: Plan) -> dict[str, float]:
    """Return the highest value to which each limit can be moved."""
    reach = dict(zip(("total_time", "highest_rate"), _reach(described), strict=True))
    values = _values(described.limits)
    highs = {
        key: values[key] * reach.get(key, limit.high) or 60.0 for key, limit in PLAN_KEYS.items()
    }
    # Beyond the reach of what is tabulated, a search tabulates anew.
    return highs | {"total_time": max(highs["total_time"], LONGEST_TIME)}


def _longer(described: Plan, total: float) -> Search:
    """Return a search that has more time than a usual one reaches."""
    limits = described.limits
    longest = limits.longest_run if limits.longest_run < limits.total_time else total
    limits = replace(limits, total_time=total, longest_run=longest)
    return Search(replace(described, limits=limits), (_LEAST_FACTOR, _reach(described)[1]))


def tried_plan(
    desk: Desk, name: str, moved: dict[str, FiniteFloat] | None = None
) -> dict[str, Any]:
    """Return what the best plan within other limits would tell, and its runs.

    It is searched in a process that is kept while it is asked, as `LiveViews.ask` has it.

    name: The plan's file.
    """
    file = desk.file(name)
    _plan(desk, file)
    told: dict[str, Any] | None = desk.live.ask(
        file, search_into, tuple(sorted((moved or {}).items()))
    )
    if told is None:
        return {"busy": True}
    if "error" in told:
        raise CounterspinError(told["error"])
    return told


def end_trying(desk: Desk, name: str) -> dict[str, Any]:
    """End the process that searches a plan; the next question begins another."""
    desk.live.end(desk.file(name))
    return {"name": name}


def search_into(there: Connection, file: Path) -> None:
    """Search plans within the limits that are asked for; `there` is told as of `LiveViews.ask`."""

    @one_blas_thread()
    def work(_: Progress) -> None:
        described = read_plan(file)
        reach = _reach(described)
        usual = Search(described, reach)
        while True:
            moved = there.recv()
            try:
                limits = dict(moved)
                total = min(limits.get("total_time", 0.0), LONGEST_TIME)
                far = total > described.limits.total_time * reach[0]
                found = _tried(_longer(described, total) if far else usual, limits)
            except CounterspinError as error:
                found = {"error": str(error)}
            there.send(("told", moved, found))

    report_progress(there, work)


def _tried(search: Search, moved: Mapping[str, float]) -> dict[str, Any]:
    limits = _moved(search.plan, moved)
    if not limits.possible:
        raise CounterspinError(
            "No campaign is possible within these limits: its runs would take too long."
        )
    optimum = search.best(limits)
    if optimum is None:
        raise CounterspinError("No plan within these limits reaches the target.")
    u = dict(zip(search.predictor.names, search.predictor.u(optimum.choice), strict=True))
    return {
        "u": [_line(term, float(u[term])) for term in search.plan.goal.sizes],
        "time": limits.time(optimum.choice),
        "runs": [
            {"rate": float(rate) * kind.sense, "attitude": kind.attitude, "seconds": float(length)}
            for kind, rate, length in zip(
                optimum.choice.types, optimum.choice.rate, optimum.choice.duration, strict=True
            )
        ],
    }


def _line(name: str, u: float) -> dict[str, Any]:
    """Return an uncertainty, in the unit of the result and as text."""
    owner, _, symbol = name.partition(".")
    unit, factor = field_unit(unit_of(symbol if symbol in TERMS else name))
    text = format_uncertainty(u * factor) if math.isfinite(u) else "not determined"
    return {
        "name": f"{symbol} of {owner}" if symbol in TERMS else name,
        "u": u,
        "text": typeset(f"{text} {unit}"),
    }


def _moved(described: Plan, moved: Mapping[str, float]) -> Limits:
    limits = described.limits
    values, highs = _values(limits), _highs(described)
    for key, value in (moved or {}).items():
        limit = PLAN_KEYS.get(key)
        if limit is None:
            raise CounterspinError(f"{key}: there is no such limit")
        values[key] = min(max(value, _low(limit, values[key])), highs[key])
    total = values["total_time"]
    longest = limits.longest_run
    if longest >= limits.total_time:
        longest = total
    return replace(
        limits,
        total_time=total,
        rate=(limits.rate[0], max(values["highest_rate"], limits.rate[0])),
        settling=values["settling"],
        runs=(runs := max(1, round(values["runs"]))),
        fewest_rates=min(limits.fewest_rates, runs),
        revolutions=values["fewest_revolutions"],
        longest_run=min(longest, total),
    )


def begin_planned(
    desk: Desk, name: str, folder: str, moved: dict[str, FiniteFloat] | None = None
) -> dict[str, Any]:
    """Begin to plan within other limits; return the job.

    When it is done, the limits stand in the plan's file, and the campaign in a new folder.

    name: The plan's file.
    """
    file = desk.file(name)
    place = desk.place(folder)
    if not folder:
        raise CounterspinError("give the campaign's folder a name")
    refuse_other_campaign(place)
    before = desk.folder.read(name)
    text, values = before.text, _values(_plan(desk, file).limits)
    for key, value in (moved or {}).items():
        if key in PLAN_KEYS and not math.isclose(value, values[key], rel_tol=1e-9):
            limit = PLAN_KEYS[key]
            written: Any = round(value) if limit.whole else float(f"{value:.6g}")
            text = with_value(
                text, ["limits", key], f"{written:g} {limit.unit}" if limit.unit else written
            )
    document = parse_document(text.encode("utf-8"), name)

    def make(number: int) -> Job:
        return Job(number, name, desk.folder.name(place), plan_command(file, place), "plan")

    def write(planned: PlannedCampaign) -> None:
        # Planned before anything is written: a plan that cannot be made changes no file.
        make_folder(place)
        if text != before.text:
            desk.folder.write(name, text, before.version)
        write_campaign(planned, place)

    return desk.jobs.begin(make, plan_into, document, then=write).shown()


def plan_into(there: Connection, where: Mapping[str, Any] | Path) -> None:
    """Find the best plan, and tell it; `there` is told as of `processes.report_progress`."""
    report_progress(there, lambda progress: plan(where, progress=progress))
