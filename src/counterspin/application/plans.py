"""Plans of records or readings with movable limits and immediate uncertainties."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

from pydantic import FiniteFloat

from counterspin.application.desk import Desk, plan_command
from counterspin.application.editing import with_value
from counterspin.application.jobs import Job, Progress, report_progress
from counterspin.campaign.documents import load_document, parse_document, table_of
from counterspin.campaign.quantity import BARE
from counterspin.campaign.readings import MOST_READINGS
from counterspin.campaign.runs import MOST_ROWS
from counterspin.errors import CampaignError, CounterspinError
from counterspin.frozen import frozen
from counterspin.inference.joint.unknowns import unit_of
from counterspin.output import make_folder
from counterspin.physics.terms import TERMS
from counterspin.planning.design import Limits
from counterspin.planning.plan import (
    Example,
    PlannedCampaign,
    plan,
    refuse_other_campaign,
    write_campaign,
    write_example,
)
from counterspin.planning.plan_file import Plan, is_plan
from counterspin.planning.reading_plan import ReadingSearch
from counterspin.planning.search import Search
from counterspin.planning.stations import ReadingPlan, read_any_plan
from counterspin.records.reduction import BLOCKS_PER_REVOLUTION
from counterspin.reports.numbers import field_unit, format_number
from counterspin.reports.typography import typeset
from counterspin.threads import one_blas_thread
from counterspin.units import unit_factor

#: How far limits on time and rate can be moved, as factors of what the plan says.
LIMIT_FACTORS: Final = (4.0, 2.0)

#: Longest time that may be asked for, s: 30 days.
LONGEST_TIME: Final = 30 * 86400.0

#: A search looks no less far beyond its limits: so much more of them is tried by itself.
_LEAST_FACTOR: Final = 1.11


@frozen
class LimitKey:
    """A limit that can be moved."""

    #: What it is called, and its unit in SI.
    words: str
    unit: str
    #: Its range, as factors of what the plan says.
    low: float
    high: float
    whole: bool = False  #: Whether it is a whole number.
    least: float = 0.0  #: Below which it never is.


#: Key of [limits] -> how it is moved, of a plan of records and of one of readings.
PLAN_KEYS: Final[Mapping[str, LimitKey]] = {
    "total_time": LimitKey("Time at the centrifuge", "s", 0.25, LIMIT_FACTORS[0]),
    "highest_rate": LimitKey("Highest rate", "rad/s", 0.5, LIMIT_FACTORS[1]),
    "settling": LimitKey("Settling of each run", "s", 0.0, 4.0),
    "runs": LimitKey("Runs at most", "", 0.25, 2.0, whole=True, least=1.0),
    "fewest_revolutions": LimitKey("Revolutions of a run at least", "", 0.5, 4.0, least=1.0),
}
READING_PLAN_KEYS: Final[Mapping[str, LimitKey]] = {
    "readings": LimitKey("Readings at most", "", 0.25, 4.0, whole=True, least=1.0),
    "total_time": LimitKey("Time of all readings", "s", 0.25, 4.0),
}


@frozen
class MovableLimit:
    """A limit of a plan, its range, and the unit in which its file states it."""

    key: str  #: Of [limits].
    how: LimitKey  #: How it is moved.
    #: In SI.
    value: float
    low: float
    high: float
    #: As written in the file, or SI; and how much of SI one of it is.
    unit: str
    factor: float

    def shown(self) -> dict[str, Any]:
        """Return the state for the page."""
        return {
            "key": self.key,
            "words": self.how.words,
            "whole": self.how.whole,
            "unit": self.unit,
            "factor": self.factor,
            "value": self.value,
            "low": self.low,
            "high": self.high,
        }

    def written(self, value: float) -> str | int | float:
        """Return a value, in SI, in the unit of the file."""
        if self.how.whole:
            return round(value)
        number = float(f"{value / self.factor:.6g}")
        return f"{number:g} {self.unit}" if self.unit else number


def plan_overview(desk: Desk, name: str) -> dict[str, Any]:
    """Return a plan's title, goal and limits with their ranges.

    name: The plan's file.
    """
    file = desk.file(name)
    described = _plan(desk, file)
    return {
        "name": name,
        "title": described.stand_in.title or name,
        "of": "records" if isinstance(described, Plan) else "readings",
        "names": list(described.goal.sizes),
        "rate": dict(zip(("unit", "factor"), _rate_unit(load_document(file)), strict=True)),
        "limits": [limit.shown() for limit in _limits_of(described, load_document(file))],
        "command": plan_command(file, None),
    }


def begin_plan(desk: Desk, name: str, example: Example = "records") -> dict[str, Any]:
    """Write an example of a plan; CounterspinError if the file exists already."""
    path = desk.folder.path(name)
    if path.suffix.lower() != ".toml":
        raise CounterspinError(f"{name}: name the plan's file, such as PLAN.toml")
    write_example(path, example)
    return {"name": name}


def _plan(desk: Desk, file: Path) -> Plan | ReadingPlan:
    def make() -> Plan | ReadingPlan:
        document = load_document(file)
        desk.require_inside(file.parent, document)
        if not is_plan(document):
            raise CampaignError(str(file), ["not a plan: it has no [limits] and [goal]"])
        return read_any_plan(file)

    return desk.remembered.get(("plan", file), [file], make)


# Limits, as they stand in the file and as they are moved


def _limits_of(described: Plan | ReadingPlan, document: Mapping[str, Any]) -> list[MovableLimit]:
    """Return the limits of a plan that can be moved."""
    said = table_of(document, "limits")
    keys = PLAN_KEYS if isinstance(described, Plan) else READING_PLAN_KEYS
    made, reach = [], _reach(described) if isinstance(described, Plan) else {}
    for key, value in _values(described).items():
        how, (unit, factor) = keys[key], ("", 1.0)
        if key == "highest_rate":
            unit, factor = _rate_unit(document)
        elif how.unit:
            unit, factor = _unit_of(said.get(key), how.unit)
        low, high = value * how.low, value * reach.get(key, how.high) or 60.0
        if key == "total_time":  # beyond the reach of what is tabulated, a search tabulates anew
            high = max(high, LONGEST_TIME)
        if how.whole:
            low, high = round(low), min(high, MOST_READINGS)
        made.append(MovableLimit(key, how, value, max(how.least, low), high, unit, factor))
    return made


def _values(described: Plan | ReadingPlan) -> dict[str, float]:
    """Return the movable limits that a plan states, in SI."""
    if isinstance(described, Plan):
        limits = described.limits
        return {
            "total_time": limits.total_time,
            "highest_rate": limits.rate[1],
            "settling": limits.settling,
            "runs": limits.runs,
            "fewest_revolutions": limits.revolutions,
        }
    stated = {"readings": described.readings, "total_time": described.total_time}
    return {key: value for key, value in stated.items() if math.isfinite(value)}


def _unit_of(said: Any, unit: str) -> tuple[str, float]:
    """Return the unit in which a quantity is written, and its size in `unit`."""
    text = said.strip() if isinstance(said, str) else ""
    number = re.match(BARE, text)
    own = text[number.end() :].strip() if number else ""
    return (own, unit_factor(own, unit)) if own else (unit, 1.0)


def _rate_unit(document: Mapping[str, Any]) -> tuple[str, float]:
    """Return the unit in which a plan writes rates, and its size in rad/s."""
    said = table_of(document, "limits")
    some = said.get("rates")
    stated = [said.get("highest_rate"), *(some if isinstance(some, list) else ())]
    first = next((text for text in (*stated, said.get("lowest_rate")) if text), None)
    return _unit_of(first, "rad/s")


def _reach(described: Plan) -> dict[str, float]:
    """Return the range of time and rate; it is smaller if runs become too long."""
    limits = described.limits
    turns = min(limits.longest_run, limits.total_time) * limits.rate[1] / (2.0 * math.pi)
    room = MOST_ROWS / BLOCKS_PER_REVOLUTION / (turns * LIMIT_FACTORS[0] * LIMIT_FACTORS[1])
    shrunk = min(1.0, math.sqrt(room))
    names = ("total_time", "highest_rate")
    return {
        name: max(_LEAST_FACTOR, factor * shrunk)
        for name, factor in zip(names, LIMIT_FACTORS, strict=True)
    }


def _moved(
    described: Plan | ReadingPlan, document: Mapping[str, Any], moved: Mapping[str, float]
) -> dict[str, float]:
    """Return the limits, in SI, with the moved ones; none is out of its range."""
    limits = {limit.key: limit for limit in _limits_of(described, document)}
    for key in moved:
        if key not in limits:
            raise CounterspinError(f"{key}: there is no such limit")
    return {
        key: min(max(moved.get(key, one.value), one.low), one.high) for key, one in limits.items()
    }


# The best plan within moved limits, by a process that is kept while it is asked


def tried_plan(
    desk: Desk, name: str, moved: dict[str, FiniteFloat] | None = None
) -> dict[str, Any]:
    """Return the uncertainties of the best plan within other limits, and its runs or readings.

    A process that is kept between requests searches it, as `LiveViews.ask` does.

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
    """End the process that searches a plan; the next question starts another."""
    desk.live.end(desk.file(name))
    return {"name": name}


def search_into(there: Connection, file: Path) -> None:
    """Search plans within requested limits; report to `there` as `LiveViews.ask` expects."""

    @one_blas_thread()
    def work(_: Progress) -> None:
        described, document = read_any_plan(file), load_document(file)
        within = _records_within(described) if isinstance(described, Plan) else None
        while True:
            moved = there.recv()
            try:
                values = _moved(described, document, dict(moved))
                if isinstance(described, ReadingPlan):
                    found = _readings_within(described, values)
                else:
                    assert within is not None
                    found = within(values)
            except CounterspinError as error:
                found = {"error": str(error)}
            there.send(("told", moved, found))

    report_progress(there, work)


def _records_within(described: Plan) -> Callable[[Mapping[str, float]], dict[str, Any]]:
    """Return a function that finds the best plan of records within limits; it keeps its tables."""
    reach = _reach(described)
    usual = Search(described, (reach["total_time"], reach["highest_rate"]))

    def find(values: Mapping[str, float]) -> dict[str, Any]:
        total = values["total_time"]
        far = total > described.limits.total_time * reach["total_time"]
        search = _longer(described, total, reach["highest_rate"]) if far else usual
        return _best_records(search, _limits_within(search.plan.limits, values))

    return find


def _longer(described: Plan, total: float, reach: float) -> Search:
    """Return a search that covers more time than a usual one."""
    limits = described.limits
    longest = limits.longest_run if limits.longest_run < limits.total_time else total
    limits = replace(limits, total_time=total, longest_run=longest)
    return Search(replace(described, limits=limits), (_LEAST_FACTOR, reach))


def _limits_within(limits: Limits, values: Mapping[str, float]) -> Limits:
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


def _best_records(search: Search, limits: Limits) -> dict[str, Any]:
    if not limits.possible:
        raise CounterspinError(
            "No campaign is possible within these limits: its runs would take too long."
        )
    optimum = search.best(limits)
    if optimum is None:
        raise CounterspinError("No plan within these limits reaches the target.")
    u = dict(zip(search.predictor.names, search.predictor.u(optimum.choice), strict=True))
    return {
        "u": list(_lines(search.plan.goal.sizes, u)),
        "time": limits.time(optimum.choice),
        "runs": [
            {"rate": float(rate) * kind.sense, "attitude": kind.attitude, "seconds": float(length)}
            for kind, rate, length in zip(
                optimum.choice.types, optimum.choice.rate, optimum.choice.duration, strict=True
            )
        ],
    }


def _readings_within(described: ReadingPlan, values: Mapping[str, float]) -> dict[str, Any]:
    """Return the best plan of readings within limits: each reading, and its repeats."""
    number = values.get("readings", math.inf)
    number = round(number) if math.isfinite(number) else number
    limited = replace(described, readings=number, total_time=values.get("total_time", math.inf))
    result, readings = ReadingSearch(limited).best()
    often = Counter(reading.name for reading in readings)
    return {
        "u": list(_lines(described.goal.sizes, PlannedCampaign(result, "").u)),
        "time": sum(reading.time for reading in readings),
        "readings": [
            {"name": one.name, "number": often[one.name]}
            for one in described.possible
            if one.name in often
        ],
    }


def _lines(names: Mapping[str, float], u: Mapping[str, float]) -> Iterator[dict[str, Any]]:
    """Yield uncertainties, each in the unit of the result and as text."""
    for name in names:
        owner, _, symbol = name.partition(".")
        unit, factor = field_unit(unit_of(symbol if symbol in TERMS else name))
        size = float(u.get(name, math.inf))
        text = format_number(size * factor, 3) if math.isfinite(size) else "not determined"
        yield {
            "name": f"{symbol} of {owner}" if symbol in TERMS else name,
            "u": size,
            "text": typeset(f"{text} {unit}"),
        }


def begin_planned(
    desk: Desk, name: str, folder: str, moved: dict[str, FiniteFloat] | None = None
) -> dict[str, Any]:
    """Start to plan within other limits; return the job.

    When it is done, the limits are in the plan's file, and the campaign in a new folder.

    name: The plan's file.
    """
    file = desk.file(name)
    place = desk.place(folder)
    if not folder:
        raise CounterspinError("give the campaign's folder a name")
    refuse_other_campaign(place)
    before = desk.folder.read(name)
    text = before.text
    for limit in _limits_of(_plan(desk, file), load_document(file)):
        value = (moved or {}).get(limit.key, limit.value)
        if not math.isclose(value, limit.value, rel_tol=1e-9):
            text = with_value(text, ["limits", limit.key], limit.written(value))
    document = parse_document(text.encode("utf-8"), name)

    def make(number: int) -> Job:
        return Job(number, name, desk.folder.name(place), plan_command(file, place), "plan")

    def write(planned: PlannedCampaign) -> None:
        # Planned before anything is written: a plan that cannot be made changes no file.
        make_folder(place)
        if text != before.text:
            desk.folder.write(name, text, before.version)
        write_campaign(planned, place)

    return desk.jobs.begin(make, plan_into, document, file, then=write).shown()


def plan_into(there: Connection, document: Mapping[str, Any], file: Path) -> None:
    """Find the best plan; report to `there` as `processes.report_progress` does."""
    report_progress(there, lambda progress: plan(document, progress=progress, file=file))
