"""Plans of records or readings, and the best plan within changed limits."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

from pydantic import FiniteFloat

from counterspin.application.desk import Desk, plan_command
from counterspin.application.editing import with_value
from counterspin.application.jobs import Job, report_progress
from counterspin.campaign.documents import load_document, parse_document, table_of
from counterspin.campaign.quantity import BARE
from counterspin.errors import CampaignError, CounterspinError
from counterspin.frozen import frozen
from counterspin.output import make_folder
from counterspin.planning.page import plan_blocks
from counterspin.planning.plan import (
    Example,
    PlannedCampaign,
    plan,
    require_no_campaign,
    write_campaign,
    write_example,
)
from counterspin.planning.plan_file import Plan, is_plan
from counterspin.planning.stations import ReadingPlan, read_any_plan
from counterspin.readings.entries import MOST_READINGS
from counterspin.reports.html import html_fragment
from counterspin.reports.typography import typeset_block
from counterspin.units import unit_factor

#: Longest time that may be asked for, s: 30 days.
LONGEST_TIME: Final = 30 * 86400.0


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
    "total_time": LimitKey("Time at the centrifuge", "s", 0.25, 4.0),
    "highest_rate": LimitKey("Highest rate", "rad/s", 0.5, 2.0),
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
        "title": described.template.title or name,
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
    made = []
    for key, value in _values(described).items():
        how, (unit, factor) = keys[key], ("", 1.0)
        if key == "highest_rate":
            unit, factor = _rate_unit(document)
        elif how.unit:
            unit, factor = _unit_of(said.get(key), how.unit)
        low, high = value * how.low, value * how.high or 60.0
        if key == "total_time":
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


def _text_within(desk: Desk, name: str, text: str, moved: Mapping[str, float]) -> str:
    """Return the text of a plan with changed limits.

    moved: Key of [limits] -> value in SI.
    """
    file = desk.file(name)
    limits = {limit.key: limit for limit in _limits_of(_plan(desk, file), load_document(file))}
    for key, value in moved.items():
        if key not in limits:
            raise CounterspinError(f"{key}: there is no such limit")
        if not math.isclose(value, limits[key].value, rel_tol=1e-9):
            text = with_value(text, ["limits", key], limits[key].written(value))
    return text


def planned_page(
    desk: Desk, name: str, moved: dict[str, FiniteFloat] | None = None
) -> dict[str, Any]:
    """Return the best plan within changed limits as HTML, or the job that searches for it.

    name: The plan's file.
    """
    file = desk.file(name)
    key = ("planned", file, *sorted((moved or {}).items()))
    known, keep = desk.remembered.find(key, [file])
    if known is not None:
        return {"html": known}
    text = _text_within(desk, name, desk.folder.read(name).text, moved or {})
    document = parse_document(text.encode("utf-8"), name)

    def make(number: int) -> Job:
        return Job(number, name, "", plan_command(file, None), "plan")

    def show(planned: PlannedCampaign) -> None:
        blocks = list(map(typeset_block, plan_blocks(planned.result)))
        keep(desk.folder.spoken(html_fragment(blocks, title=planned.result.title)))

    return {"job": desk.jobs.begin(make, plan_into, document, file, then=show).shown()}


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
    require_no_campaign(place)
    before = desk.folder.read(name)
    text = _text_within(desk, name, before.text, moved or {})
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
    report_progress(there, lambda _: plan(document, file=file))
