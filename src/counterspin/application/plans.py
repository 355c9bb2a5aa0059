"""Plans of records or readings, and the optimal plan within adjusted limits."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

from pydantic import FiniteFloat

from counterspin.application.answers import JobEntry, Limit, NameAnswer, PlanOverview, PlanPage
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
from counterspin.readings.entries import MAX_READINGS
from counterspin.reports.html import render_fragment
from counterspin.reports.typography import typeset_block
from counterspin.units import unit_factor

#: Upper end of the slider for the total time, s: 30 days.
MAX_TIME: Final = 30 * 86400.0


@frozen
class SliderSpec:
    """Properties of the slider of a limit."""

    #: Label, and SI unit.
    label: str
    unit: str
    #: Range, as factors of the value in the plan.
    low_factor: float
    high_factor: float
    is_integer: bool = False
    minimum: float = 0.0  #: Smallest possible value.


#: Key of [limits] -> slider, for plans of records and plans of readings.
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
    """A limit of a plan with its range and its unit in the file."""

    key: str  #: Key in [limits].
    spec: SliderSpec
    #: Value and range in SI.
    value: float
    low: float
    high: float
    #: Unit in the file (default: SI), and its conversion factor to SI.
    unit: str
    factor: float

    def to_dict(self) -> Limit:
        """Return the state for the page."""
        return {
            "key": self.key,
            "words": self.spec.label,
            "is_integer": self.spec.is_integer,
            "unit": self.unit,
            "factor": self.factor,
            "value": self.value,
            "low": self.low,
            "high": self.high,
        }

    def format_value(self, value: float) -> str | int | float:
        """Return a value, given in SI, in the unit of the file."""
        if self.spec.is_integer:
            return round(value)
        rounded_value = float(f"{value / self.factor:.6g}")
        return f"{rounded_value:g} {self.unit}" if self.unit else rounded_value


def plan_overview(app: AppState, name: str) -> PlanOverview:
    """Return title and limits of a plan, with the ranges of the limits.

    name: The plan file.
    """
    file = app.file(name)
    stated_plan = _read_plan(app, file)
    return {
        "name": name,
        "title": stated_plan.template.title or name,
        "limits": [slider.to_dict() for slider in _make_sliders(stated_plan, load_document(file))],
        "command": plan_command(file, None),
    }


def begin_plan(app: AppState, name: str, example: Example = "records") -> NameAnswer:
    """Write an example plan; CounterspinError if the file exists."""
    if not Path(name).suffix:
        name = f"{name}.toml"
    path = app.folder.path(name)
    if path.suffix.lower() != ".toml":
        raise RequestError(
            f"{name} is not a valid name for a plan file; use a name such as PLAN.toml"
        )
    write_example(path, example)
    return {"name": name}


def _read_plan(app: AppState, file: Path) -> Plan | ReadingPlan:
    def parse() -> Plan | ReadingPlan:
        document = load_document(file)
        app.require_inside(file.parent, document)
        if not is_plan(document):
            raise CampaignError(
                str(file), ["not a plan: [limits] and [goal] are missing"], code="wrong-document"
            )
        return read_any_plan(file)

    return app.cache.get(("plan", file), [file], parse)


# Adjustable limits


def _make_sliders(stated_plan: Plan | ReadingPlan, document: Mapping[str, Any]) -> list[Slider]:
    """Return the sliders of a plan."""
    limits = table_of(document, "limits")
    slider_specs = PLAN_SLIDERS if isinstance(stated_plan, Plan) else READING_PLAN_SLIDERS
    sliders = []
    for key, value in _stated_limits(stated_plan).items():
        spec, (unit, factor) = slider_specs[key], ("", 1.0)
        if key == "highest_rate":
            unit, factor = _detect_rate_unit_and_factor(document)
        elif spec.unit:
            unit, factor = _detect_unit_and_factor(limits.get(key), spec.unit)
        low, high = value * spec.low_factor, value * spec.high_factor or 60.0
        if key == "total_time":
            high = max(high, MAX_TIME)
        if spec.is_integer:
            low, high = round(low), min(high, MAX_READINGS)
        sliders.append(Slider(key, spec, value, max(spec.minimum, low), high, unit, factor))
    return sliders


def _stated_limits(stated_plan: Plan | ReadingPlan) -> dict[str, float]:
    """Return the adjustable limits stated in a plan, in SI."""
    if isinstance(stated_plan, Plan):
        limits = stated_plan.limits
        return {
            "total_time": limits.total_time,
            "highest_rate": limits.rate_range[1],
            "settling": limits.settling,
            "runs": limits.max_runs,
            "fewest_revolutions": limits.min_revolutions,
        }
    limit_values = {"readings": stated_plan.max_readings, "total_time": stated_plan.total_time}
    return {key: value for key, value in limit_values.items() if math.isfinite(value)}


def _detect_unit_and_factor(value: Any, unit: str) -> tuple[str, float]:
    """Return the unit in which a quantity is written, and its conversion factor to `unit`."""
    text = value.strip() if isinstance(value, str) else ""
    number = re.match(BARE_NUMBER, text)
    written_unit = text[number.end() :].strip() if number else ""
    return (written_unit, unit_factor(written_unit, unit)) if written_unit else (unit, 1.0)


def _detect_rate_unit_and_factor(document: Mapping[str, Any]) -> tuple[str, float]:
    """Return the unit of rates in a plan, and its conversion factor to rad/s."""
    limits = table_of(document, "limits")
    rates = limits.get("rates")
    values = [limits.get("highest_rate"), *(rates if isinstance(rates, list) else ())]
    first_value = next((text for text in (*values, limits.get("lowest_rate")) if text), None)
    return _detect_unit_and_factor(first_value, "rad/s")


def _set_limits(app: AppState, name: str, text: str, new_values: Mapping[str, float]) -> str:
    """Return the text of a plan with changed limits.

    new_values: Key of [limits] -> value in SI.
    """
    file = app.file(name)
    sliders = {
        slider.key: slider for slider in _make_sliders(_read_plan(app, file), load_document(file))
    }
    for key, value in new_values.items():
        if key not in sliders:
            raise RequestError(f"{key} is not a limit of this plan")
        if not math.isclose(value, sliders[key].value, rel_tol=1e-9):
            text = set_value(text, ["limits", key], sliders[key].format_value(value))
    return text


def make_planned_page(
    app: AppState, name: str, moved: dict[str, FiniteFloat] | None = None
) -> PlanPage:
    """Return the optimal plan within adjusted limits as HTML, or the job that computes it.

    name: The plan file.
    """
    file = app.file(name)
    key = ("planned", file, *sorted((moved or {}).items()))
    cached_html, store = app.cache.lookup(key, [file])
    if cached_html is not None:
        return {"job": None, "html": cached_html}
    text = _set_limits(app, name, app.folder.read(name).text, moved or {})
    document = parse_document(text.encode("utf-8"), name)

    def make_job(number: int) -> Job:
        return Job(number, name, "", plan_command(file, None), "plan")

    def store_page(planned_campaign: PlannedCampaign) -> None:
        result = planned_campaign.result
        blocks = list(map(typeset_block, plan_blocks(result)))
        store(app.folder.relative_paths(render_fragment(blocks, title=result.title)))

    job = app.jobs.begin(make_job, run_plan, document, file, on_done=store_page)
    return {"job": job.to_dict(), "html": ""}


def begin_planned(
    app: AppState, name: str, folder: str, moved: dict[str, FiniteFloat] | None = None
) -> JobEntry:
    """Start planning within adjusted limits; return the job.

    At the end, the job writes the limits to the plan file, and the campaign to a new folder.

    name: The plan file.
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

    def write_plan(planned_campaign: PlannedCampaign) -> None:
        # Files are written only after the plan has been computed.
        make_folder(target)
        if text != plan_text.text:
            app.folder.write(name, text, plan_text.version)
        write_campaign(planned_campaign, target)

    return app.jobs.begin(make_job, run_plan, document, file, on_done=write_plan).to_dict()


def run_plan(connection: Connection, document: Mapping[str, Any], file: Path) -> None:
    """Compute the optimal plan; report to `connection` as in `report_progress`."""
    report_progress(connection, lambda _: plan(document, file=file))
