"""Plans whose limits are moved like sliders, and whose uncertainty answers at once.

- `plan_overview`: the limits of a plan, each with its range; `PLAN_KEYS`: which there are
- `tried_plan`: the best plan within other limits, in a fraction of a second
- `begin_planned`: writes limits into the file, and the planned campaign into a folder
- `begin_plan`: an example to start from
- `is_plan`: whether a document is a plan
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from counterspin.application.commands import plan_command
from counterspin.application.desk import Desk, Remembered
from counterspin.application.editing import changed
from counterspin.calibration.joint_parts import unit_of
from counterspin.campaign.toml_file import load_document, parse_document
from counterspin.errors import CampaignError, CounterspinError
from counterspin.frozen import frozen
from counterspin.output import make_folder
from counterspin.physics.accelerometer import TERMS
from counterspin.planning.design import Limits
from counterspin.planning.plan import plan, refuse_other_campaign, write_campaign, write_example
from counterspin.planning.plan_file import read_plan
from counterspin.planning.search import Search
from counterspin.reports.numbers import field_unit, format_uncertainty
from counterspin.reports.typography import typeset
from counterspin.workers import one_blas_thread

#: How far limits on time and rate can be moved, as factors of what the plan says.
LIMIT_FACTORS: Final = (4.0, 2.0)

_MAX_SEARCHES: Final = 6
_SEARCHES: Final = Remembered(_MAX_SEARCHES)


@frozen
class LimitKey:
    """A limit that can be moved.

    Attributes
    ----------
    words, unit
        What it is called, and its unit in the file.
    low, high
        Its range, as factors of what the plan says.
    whole
        Whether it is a whole number.
    """

    words: str
    unit: str
    low: float
    high: float
    whole: bool = False


#: Key of [limits] -> how it is moved.
PLAN_KEYS: Final[Mapping[str, LimitKey]] = {
    "total_time": LimitKey("Time at the centrifuge", "s", 0.25, LIMIT_FACTORS[0]),
    "highest_rate": LimitKey("Highest rate", "rad/s", 0.5, LIMIT_FACTORS[1]),
    "settling": LimitKey("Settling of each run", "s", 0.0, 4.0),
    "runs": LimitKey("Runs at most", "", 0.25, 2.0, whole=True),
    "fewest_revolutions": LimitKey("Revolutions of a run at least", "", 0.5, 4.0),
}


def is_plan(document: Mapping[str, Any]) -> bool:
    """Tell whether a document is a plan of records."""
    return {"limits", "goal"} <= document.keys() and "stations" not in document


def plan_overview(desk: Desk, name: str) -> dict[str, Any]:
    """Return a plan's title, goal and limits with their ranges.

    Parameters
    ----------
    name
        The plan's file.
    """
    file = desk.file(name)
    search = _search(desk, file)
    values = _values(search.limits)
    return {
        "name": name,
        "title": search.plan.stand_in.title or name,
        "goal": search.plan.goal.kind,
        "names": list(search.plan.goal.sizes),
        "limits": [
            {
                "key": key,
                "words": limit.words,
                "unit": limit.unit,
                "value": values[key],
                "low": _low(limit, values[key]),
                "high": values[key] * limit.high or 60.0,
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
    return max(1.0, round(low)) if limit.whole else low


def _values(limits: Limits) -> dict[str, float]:
    return {
        "total_time": limits.total_time,
        "highest_rate": limits.rate[1],
        "settling": limits.settling,
        "runs": limits.runs,
        "fewest_revolutions": limits.revolutions,
    }


def _search(desk: Desk, file: Path) -> Search:
    def make() -> Search:
        document = load_document(file)
        desk.require_inside(file.parent, document)
        if not is_plan(document):
            raise CampaignError(str(file), ["no plan of records: it has no [limits] and [goal]"])
        return Search(read_plan(file), LIMIT_FACTORS)

    return _SEARCHES.get(file, [file], make)


@one_blas_thread()
def tried_plan(desk: Desk, name: str, moved: Mapping[str, float]) -> dict[str, Any]:
    """Return what the best plan within other limits would tell, and its runs.

    Parameters
    ----------
    name
        The plan's file.
    moved
        Key of `PLAN_KEYS` -> value, SI; those that are not named are as the plan says.

    Raises
    ------
    CounterspinError
        If no plan keeps within them, or reaches the target.
    """
    file = desk.file(name)
    search = _search(desk, file)
    limits = _moved(search.limits, moved)
    if limits.total_time < limits.shortest:
        raise CounterspinError("No run fits into these limits: it would take longer than there is.")
    optimum = search.best(limits)
    if optimum is None:
        raise CounterspinError("No plan within these limits reaches the target.")
    u = dict(zip(search.predictor.names, search.predictor.u(optimum.design), strict=True))
    return {
        "u": [_line(term, float(u[term])) for term in search.plan.goal.sizes],
        "time": limits.time(optimum.design),
        "efficiency": optimum.efficiency,
        "runs": [
            {"rate": float(rate) * kind.sense, "attitude": kind.attitude, "seconds": float(length)}
            for kind, rate, length in zip(
                optimum.design.types, optimum.design.rate, optimum.design.duration, strict=True
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


def _moved(limits: Limits, moved: Mapping[str, float]) -> Limits:
    values = _values(limits)
    for key, value in moved.items():
        limit = PLAN_KEYS.get(key)
        if limit is None:
            raise CounterspinError(f"{key}: there is no such limit to move")
        low, high = _low(limit, values[key]), values[key] * limit.high or 60.0
        values[key] = min(max(value, low), high)
    total = values["total_time"]
    longest = limits.longest_run
    if longest >= limits.total_time:
        longest = total
    return replace(
        limits,
        total_time=total,
        rate=(limits.rate[0], max(values["highest_rate"], limits.rate[0])),
        settling=values["settling"],
        runs=max(1, round(values["runs"])),
        revolutions=values["fewest_revolutions"],
        longest_run=min(longest, total),
    )


def begin_planned(desk: Desk, name: str, moved: Mapping[str, float], folder: str) -> dict[str, Any]:
    """Write limits into a plan's file, plan, and write the campaign into a new folder.

    Parameters
    ----------
    name
        The plan's file.
    moved
        As for `tried_plan`.
    folder
        Of the campaign.

    Raises
    ------
    CounterspinError
        If there is a campaign already, or the file cannot be changed.
    """
    file = desk.file(name)
    place = desk.place(folder)
    if not folder:
        raise CounterspinError("give the campaign's folder a name")
    refuse_other_campaign(place)
    before = desk.folder.read(name)
    text, values = before.text, _values(_search(desk, file).limits)
    for key, value in moved.items():
        if key in PLAN_KEYS and not math.isclose(value, values[key], rel_tol=1e-9):
            limit = PLAN_KEYS[key]
            written: Any = round(value) if limit.whole else float(f"{value:.6g}")
            text = changed(
                text, ["limits", key], f"{written:g} {limit.unit}" if limit.unit else written
            )
    # Planned before anything is written: a plan that cannot be made changes no file.
    planned = plan(parse_document(text.encode("utf-8"), name))
    make_folder(place)
    if text != before.text:
        desk.folder.write(name, text, before.version)
    write_campaign(planned, place)
    return {"name": desk.folder.name(place), "command": plan_command(file, place)}
