"""Plans of records or readings, and the best plan within changed limits."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

from pydantic import FiniteFloat

from counterspin.application.answers import JobEntry, Limit, Named, PlanOverview, PlanPage
from counterspin.application.app_state import AppState
from counterspin.application.commands import plan_command
from counterspin.application.editing import set_value
from counterspin.application.jobs import Job, report_progress
from counterspin.application.served_folder import RequestError
from counterspin.campaign.documents import load_document, parse_document, table_of
from counterspin.campaign.quantity import BARE_NUMBER
from counterspin.errors import CampaignError
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
from counterspin.reports.html import render_fragment
from counterspin.reports.typography import typeset_block
from counterspin.units import unit_factor

#: Longest time that may be asked for, s: 30 days.
MAX_TIME: Final = 30 * 86400.0


@frozen
class SliderSpec:
    """A limit that can be moved."""

    #: What it is called, and its unit in SI.
    label: str
    unit: str
    #: Its range, as factors of what the plan says.
    low_factor: float
    high_factor: float
    is_integer: bool = False  #: Whether it is a whole number.
    minimum: float = 0.0  #: Below which it never is.


#: Key of [limits] -> how it is moved, of a plan of records and of one of readings.
PLAN_SLIDERS: Final[Mapping[str, SliderSpec]] = {
    "total_time": SliderSpec("Centrifuge time", "s", 0.25, 4.0),
    "highest_rate": SliderSpec("Highest rate", "rad/s", 0.5, 2.0),
    "settling": SliderSpec("Settling time per run", "s", 0.0, 4.0),
    "runs": SliderSpec("Maximum number of runs", "", 0.25, 2.0, is_integer=True, minimum=1.0),
    "fewest_revolutions": SliderSpec(
        "Minimum number of revolutions per run", "", 0.5, 4.0, minimum=1.0
    ),
}
READING_PLAN_SLIDERS: Final[Mapping[str, SliderSpec]] = {
    "readings": SliderSpec(
        "Maximum number of readings", "", 0.25, 4.0, is_integer=True, minimum=1.0
    ),
    "total_time": SliderSpec("Total time for all readings", "s", 0.25, 4.0),
}


@frozen
class Slider:
    """A limit of a plan, its range, and the unit in which its file states it."""

    key: str  #: Of [limits].
    spec: SliderSpec  #: How it is moved.
    #: In SI.
    value: float
    low: float
    high: float
    #: As written in the file, or SI; and how much of SI one of it is.
    unit: str
    factor: float

    def to_dict(self) -> Limit:
        """Return the state for the page."""
        return {
            "key": self.key,
            "words": self.spec.label,
            "whole": self.spec.is_integer,
            "unit": self.unit,
            "factor": self.factor,
            "value": self.value,
            "low": self.low,
            "high": self.high,
        }

    def format_value(self, value: float) -> str | int | float:
        """Return a value, in SI, in the unit of the file."""
        if self.spec.is_integer:
            return round(value)
        number = float(f"{value / self.factor:.6g}")
        return f"{number:g} {self.unit}" if self.unit else number


def plan_overview(app: AppState, name: str) -> PlanOverview:
    """Return a plan's title, goal and limits with their ranges.

    name: The plan's file.
    """
    file = app.file(name)
    stated_plan = _read_plan(app, file)
    return {
        "name": name,
        "title": stated_plan.template.title or name,
        "limits": [limit.to_dict() for limit in _sliders(stated_plan, load_document(file))],
        "command": plan_command(file, None),
    }


def begin_plan(app: AppState, name: str, example: Example = "records") -> Named:
    """Write an example of a plan; CounterspinError if the file exists already."""
    path = app.folder.path(name)
    if path.suffix.lower() != ".toml":
        raise RequestError(
            f"{name} is not a valid name for a plan file; use a name such as PLAN.toml"
        )
    write_example(path, example)
    return {"name": name}


def _read_plan(app: AppState, file: Path) -> Plan | ReadingPlan:
    def read() -> Plan | ReadingPlan:
        document = load_document(file)
        app.require_inside(file.parent, document)
        if not is_plan(document):
            raise CampaignError(
                str(file), ["not a plan: [limits] and [goal] are missing"], code="wrong-document"
            )
        return read_any_plan(file)

    return app.cache.get(("plan", file), [file], read)


# Limits, as they stand in the file and as they are moved


def _sliders(stated_plan: Plan | ReadingPlan, document: Mapping[str, Any]) -> list[Slider]:
    """Return the limits of a plan that can be moved."""
    limits = table_of(document, "limits")
    keys = PLAN_SLIDERS if isinstance(stated_plan, Plan) else READING_PLAN_SLIDERS
    sliders = []
    for key, value in _stated_limits(stated_plan).items():
        spec, (unit, factor) = keys[key], ("", 1.0)
        if key == "highest_rate":
            unit, factor = _rate_unit(document)
        elif spec.unit:
            unit, factor = _written_unit(limits.get(key), spec.unit)
        low, high = value * spec.low_factor, value * spec.high_factor or 60.0
        if key == "total_time":
            high = max(high, MAX_TIME)
        if spec.is_integer:
            low, high = round(low), min(high, MOST_READINGS)
        sliders.append(Slider(key, spec, value, max(spec.minimum, low), high, unit, factor))
    return sliders


def _stated_limits(stated_plan: Plan | ReadingPlan) -> dict[str, float]:
    """Return the movable limits that a plan states, in SI."""
    if isinstance(stated_plan, Plan):
        limits = stated_plan.limits
        return {
            "total_time": limits.total_time,
            "highest_rate": limits.rate_range[1],
            "settling": limits.settling,
            "runs": limits.max_runs,
            "fewest_revolutions": limits.min_revolutions,
        }
    stated = {"readings": stated_plan.max_readings, "total_time": stated_plan.total_time}
    return {key: value for key, value in stated.items() if math.isfinite(value)}


def _written_unit(value: Any, unit: str) -> tuple[str, float]:
    """Return the unit in which a quantity is written, and its size in `unit`."""
    text = value.strip() if isinstance(value, str) else ""
    number = re.match(BARE_NUMBER, text)
    own_unit = text[number.end() :].strip() if number else ""
    return (own_unit, unit_factor(own_unit, unit)) if own_unit else (unit, 1.0)


def _rate_unit(document: Mapping[str, Any]) -> tuple[str, float]:
    """Return the unit in which a plan writes rates, and its size in rad/s."""
    limits = table_of(document, "limits")
    rates = limits.get("rates")
    values = [limits.get("highest_rate"), *(rates if isinstance(rates, list) else ())]
    first_value = next((text for text in (*values, limits.get("lowest_rate")) if text), None)
    return _written_unit(first_value, "rad/s")


def _set_limits(app: AppState, name: str, text: str, moved: Mapping[str, float]) -> str:
    """Return the text of a plan with changed limits.

    moved: Key of [limits] -> value in SI.
    """
    file = app.file(name)
    limits = {limit.key: limit for limit in _sliders(_read_plan(app, file), load_document(file))}
    for key, value in moved.items():
        if key not in limits:
            raise RequestError(f"{key} is not a limit of this plan")
        if not math.isclose(value, limits[key].value, rel_tol=1e-9):
            text = set_value(text, ["limits", key], limits[key].format_value(value))
    return text


def planned_page(app: AppState, name: str, moved: dict[str, FiniteFloat] | None = None) -> PlanPage:
    """Return the best plan within changed limits as HTML, or the job that searches for it.

    name: The plan's file.
    """
    file = app.file(name)
    key = ("planned", file, *sorted((moved or {}).items()))
    cached, store = app.cache.lookup(key, [file])
    if cached is not None:
        return {"job": None, "html": cached}
    text = _set_limits(app, name, app.folder.read(name).text, moved or {})
    document = parse_document(text.encode("utf-8"), name)

    def make_job(number: int) -> Job:
        return Job(number, name, "", plan_command(file, None), "plan")

    def store_page(planned: PlannedCampaign) -> None:
        blocks = list(map(typeset_block, plan_blocks(planned.result)))
        store(app.folder.relative_paths(render_fragment(blocks, title=planned.result.title)))

    job = app.jobs.begin(make_job, run_plan, document, file, on_done=store_page)
    return {"job": job.to_dict(), "html": ""}


def begin_planned(
    app: AppState, name: str, folder: str, moved: dict[str, FiniteFloat] | None = None
) -> JobEntry:
    """Start to plan within other limits; return the job.

    When it is done, the limits are in the plan's file, and the campaign in a new folder.

    name: The plan's file.
    """
    file = app.file(name)
    target = app.target_path(folder)
    if not folder:
        raise RequestError("enter a folder name for the campaign")
    require_no_campaign(target)
    plan_text = app.folder.read(name)
    text = _set_limits(app, name, plan_text.text, moved or {})
    document = parse_document(text.encode("utf-8"), name)

    def make_job(number: int) -> Job:
        return Job(number, name, app.folder.name(target), plan_command(file, target), "plan")

    def write_plan(planned: PlannedCampaign) -> None:
        # Planned before anything is written: a plan that cannot be made changes no file.
        make_folder(target)
        if text != plan_text.text:
            app.folder.write(name, text, plan_text.version)
        write_campaign(planned, target)

    return app.jobs.begin(make_job, run_plan, document, file, on_done=write_plan).to_dict()


def run_plan(connection: Connection, document: Mapping[str, Any], file: Path) -> None:
    """Find the best plan; report to `connection` as `report_progress` does."""
    report_progress(connection, lambda _: plan(document, file=file))
