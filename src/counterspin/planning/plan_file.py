"""Conversion of ``PLAN.toml`` to a `Plan`: check every key and report all errors together.

Most of a plan is a campaign without runs, and is checked as one: a template campaign with one run
in each attitude.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Literal

from counterspin.calibration.model import make_unknowns
from counterspin.campaign.description import Campaign, resolve_campaign
from counterspin.campaign.documents import (
    KeyPath,
    campaign_error,
    list_of,
    load_document,
    merge_patch,
    table_of,
    to_toml_value,
)
from counterspin.campaign.field_types import ESTIMATE
from counterspin.campaign.quantity import parse_quantity
from counterspin.campaign.settings import NOISE_UNITS, OBSERVABLES, NoiseSettings
from counterspin.campaign.static_noise import complete_noise_sizes
from counterspin.campaign.validation import Problems, suggest_name
from counterspin.errors import CampaignError
from counterspin.frozen import frozen
from counterspin.inference.joint.unknowns import Unknown, unit_of
from counterspin.inference.noise.components import BIAS_COMPONENTS_BY_KEY
from counterspin.physics.terms import condition_of, term
from counterspin.planning.design import Limits, RunType
from counterspin.planning.plan_sections import GoalSettings, LimitsSettings, PlanDocument
from counterspin.planning.result import GoalResult

#: Lowest rate where none is given, as a part of the highest.
_MIN_RATE_FRACTION: Final = 0.125

#: Default number of different rates of a plan, if that many are possible.
_DEFAULT_RATES: Final = 2

#: Fewest samples of the shortest run, and most revolutions of the longest.
_MIN_SAMPLES: Final = 3.0
_MAX_REVOLUTIONS: Final = 1e9

#: Columns of the records, where the plan does not say them.
_RECORDS: Final[Mapping[str, Any]] = {
    "time": {"column": "time_s", "unit": "s"},
    "angle": {"column": "angle_rad", "unit": "rad"},
}

#: Short names of keys of a plan.
SHORT: Final[Mapping[str, KeyPath]] = {
    "title": ("campaign", "title"),
    "gravity": ("site", "gravity"),
    "latitude": ("site", "latitude"),
    "radius": ("centrifuge", "radius"),
    "terms": ("model", "terms"),
    "assume": ("model", "assume"),
    "hold": ("model", "hold"),
    "considered": ("model", "considered"),
    "priors": ("model", "priors"),
    "seed": ("simulation", "seed"),
    "sampling_rate": ("simulation", "sampling_rate"),
}


@frozen(eq=False)
class Plan:
    """A plan's description, checked and resolved."""

    path: Path  #: Of the file, absolute.
    #: The campaign to be, as a document without runs; ``truth`` has the expected values.
    document: Mapping[str, Any]
    template: Campaign  #: The campaign with one run for each attitude, named as the attitude is.
    attitudes: Mapping[str, Any]  #: Name -> attitude as it is written in a campaign.
    limits: Limits  #: What the machine and the laboratory allow.
    sampling_rate: float  #: Hz.
    goal: GoalResult  #: What it is for.


def load_plan(path: Mapping[str, Any] | Path | str) -> dict[str, Any]:
    """Return a plan's document; CampaignError if it cannot be read."""
    if isinstance(path, Mapping):
        problems = Problems(path)
        document: dict[str, Any] = {"schema": 1} | to_toml_value(path, (), problems.add)
        if problems.lines:
            raise CampaignError(str(plan_name(path)), problems.lines)
        return document
    advice = "`planning.plan.write_example` writes a starter plan"
    return load_document(Path(path), advice, "plan")


def change_plan(document: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return a plan's document with named changes; see `counterspin.PlannedCampaign.change`."""
    new_document = dict(document)
    for name, value in changes.items():
        if name in LimitsSettings.model_fields:
            path: tuple[str | int, ...] = ("limits", name)
        elif name in GoalSettings.model_fields:
            path = ("goal", name)
        else:
            path = tuple(SHORT.get(name) or name.split("."))
        patch = value
        for path_key in reversed(path):
            patch = {path_key: patch}
        new_document = merge_patch(new_document, patch)
        # A plan either reaches a target or makes u least in the time there is.
        excluded_key = {"target": "minimise", "minimise": "target"}.get(str(path[-1]))
        if path[0] == "goal" and excluded_key is not None and value is not None:
            new_document = merge_patch(new_document, {"goal": {excluded_key: None}})
    return new_document


def is_plan(document: Mapping[str, Any]) -> bool:
    """Check for the sections of a plan, of records or of readings, in a document."""
    return {"limits", "goal"} <= document.keys()


def plan_name(path: Mapping[str, Any] | Path | str) -> Path:
    """Return the name of a plan for messages: its file, if any."""
    return Path("plan in memory") if isinstance(path, Mapping) else Path(path)


def read_plan(path: Mapping[str, Any] | Path | str, file: Path | None = None) -> Plan:
    """Read and check a plan.

    file: As whose content a plan in memory counts, for the files that it names; None: nothing's.
    """
    file, raw = file or plan_name(path), load_plan(path)
    problems = Problems(raw)
    if "runs" in raw:
        raw = {key: value for key, value in raw.items() if key != "runs"}
        problems.add(
            ("runs",),
            "the plan selects the runs, so [[runs]] must not be given; "
            "state the limits in [limits]",
        )
    problems.check(PlanDocument, raw, ())
    settings = problems.check(LimitsSettings, table_of(raw, "limits"), ("limits",), gravity=None)
    goal = problems.check(GoalSettings, table_of(raw, "goal"), ("goal",))
    attitudes = _named_attitudes(settings.attitudes if settings else ["level"], problems)
    document = _campaign_document(raw, settings)
    document["noise"] = _stated_sizes(table_of(document, "noise"), problems)
    if _refuse_time_dependence(document, problems):
        raise campaign_error(file, problems.lines)
    template_runs = [
        {"name": name, "rate": "1 rad/s", "record": f"run{i}.csv", "attitude": attitude}
        for i, (name, attitude) in enumerate(attitudes.items())
    ]
    campaign = resolve_campaign({**document, "runs": template_runs}, file, problems)
    if campaign is not None and campaign.noise is not None and campaign.rest is not None:
        document["noise"] = _record_sizes(campaign, campaign.noise, problems)
        campaign = resolve_campaign({**document, "runs": template_runs}, file, problems)
    plan = None
    if campaign is not None:
        _check_noise(campaign, problems)
        limits = _resolve_limits(settings, attitudes, campaign, problems) if settings else None
        goal_settings = resolve_goal(goal, campaign, problems) if goal else None
        if settings is not None and limits is not None and goal_settings is not None:
            plan = Plan(
                file.absolute(),
                {**document, "truth": _expected_truth(document, campaign)},
                campaign,
                attitudes,
                limits,
                settings.sampling_rate,
                goal_settings,
            )
    if problems.lines or plan is None:
        raise campaign_error(file, problems.lines)
    return plan


def _refuse_time_dependence(document: Mapping[str, Any], problems: Problems) -> bool:
    """Report terms that depend on the time or temperature of runs, which are not known yet.

    Return True if there are any.
    """
    model, error_count = table_of(document, "model"), len(problems.lines)
    for key in ("terms", "hold", "considered"):
        for index, name in enumerate(list_of(model, key)):
            condition = condition_of(name) if isinstance(name, str) else ""
            if condition not in ("", "force"):
                problems.add(
                    ("model", key, index),
                    f'"{name}" depends on the {condition} of each run, which is unknown in a '
                    "plan; omit the term here, add it to the planned campaign, and run a forecast "
                    "of that campaign",
                )
    return len(problems.lines) > error_count


def _campaign_document(raw: Mapping[str, Any], settings: LimitsSettings | None) -> dict[str, Any]:
    """Return the document of the campaign to be, its channels filled in."""
    shared = {key: value for key, value in raw.items() if key not in ("limits", "goal")}
    document = {"records": dict(_RECORDS), **shared}
    tables = raw.get("accelerometers")
    if isinstance(tables, dict):
        document["accelerometers"] = {
            name: {**table, "displacement": {"column": f"{name}_m", "unit": "m"}}
            if isinstance(table, dict) and not set(table) & set(OBSERVABLES)
            else table
            for name, table in tables.items()
        }
    sampling = settings.sampling_rate if settings else 50.0
    document["simulation"] = {"sampling_rate": f"{sampling!r} Hz", "seed": 1}
    return document


def _named_attitudes(attitudes: Sequence[Any], problems: Problems) -> dict[str, Any]:
    """Return the attitudes by the name under which reports show them."""
    named: dict[str, Any] = {}
    for index, attitude in enumerate(attitudes):
        name = (
            attitude
            if isinstance(attitude, str)
            else ", ".join(f"{axis} {where}" for axis, where in attitude.items())
        )
        if name in named:
            problems.add(
                ("limits", "attitudes", index), f'"{name}" is listed twice', "duplicate-entry"
            )
        named[name] = attitude
    return named


def _expected_truth(document: Mapping[str, Any], campaign: Campaign) -> dict[str, Any]:
    """Return [truth], completed by the prior values of the terms that it does not name."""
    truth = dict(table_of(document, "truth"))
    for name, accelerometer in campaign.accelerometers.items():
        known_values = {
            symbol: f"{prior.value!r} {prior.unit}"
            for symbol, prior in accelerometer.priors.items()
            if prior.value != term(symbol).nominal
        }
        truth[name] = {**known_values, **table_of(truth, name)}
    return truth


def _stated_sizes(noise: Mapping[str, Any], problems: Problems) -> dict[str, Any]:
    """Return [noise] without noise to be estimated, and report that: no record exists yet."""
    unknown = [key for key, size in noise.items() if size == ESTIMATE]
    for key in unknown:
        problems.add(
            ("noise", key), "a plan cannot estimate the noise; state a number", "missing-value"
        )
    return {key: size for key, size in noise.items() if key not in unknown}


def _record_sizes(campaign: Campaign, stated: NoiseSettings, problems: Problems) -> dict[str, str]:
    """Return [noise] as it is written with the sizes that a record at rest says."""
    sizes = {key: size for key, size in complete_noise_sizes(campaign, stated).items() if size}
    for key in sizes.keys() & set(BIAS_COMPONENTS_BY_KEY) - stated.model_fields_set:
        unit = NOISE_UNITS[key]
        problems.add(
            ("noise", "from"),
            f"the record shows {key}, {sizes[key]:.3g} {unit}, but the search for runs cannot "
            f'model a drifting bias; add {key} = "0 {unit}" here, and run a forecast of the '
            "planned campaign with this noise",
        )
    return {key: f"{size!r} {NOISE_UNITS[key]}" for key, size in sizes.items()}


def _check_noise(campaign: Campaign, problems: Problems) -> None:
    noise = campaign.noise
    if noise is None or any(line.startswith("noise.") for line in problems.lines):
        return
    for key in BIAS_COMPONENTS_BY_KEY:
        if getattr(noise, key) != 0.0:
            problems.add(
                ("noise", key),
                "the search for runs cannot model a drifting bias; omit this noise here, add it "
                "to the planned campaign, and run a forecast of that campaign",
            )
    for name, accelerometer in campaign.accelerometers.items():
        sizes = (getattr(noise, accelerometer.observable), noise.acceleration, noise.quantisation)
        if sizes == (0.0, 0.0, 0.0):
            problems.add(
                ("noise",),
                f"{name} has no noise; state {accelerometer.observable}",
                "missing-value",
            )


def _resolve_limits(
    settings: LimitsSettings,
    attitudes: Iterable[str],
    campaign: Campaign,
    problems: Problems,
) -> Limits | None:
    """Return the limits, or None with their contradictions noted."""
    error_count = len(problems.lines)
    rates = _resolve_rates(settings, campaign, problems)
    if rates is None:
        return None
    (low, high), available = rates
    senses = (1, -1) if settings.senses == "both" else (1,)
    spin_up = sum(1.0 / a for a in (settings.spin_up, settings.spin_down) if a is not None)
    longest = settings.longest_run or settings.total_time
    fewest = settings.fewest_revolutions
    if fewest * 2.0 * math.pi / high > longest * (1.0 + 1e-9):
        problems.add(
            ("limits", "longest_run"),
            f"{fewest:g} revolutions take {fewest * 2.0 * math.pi / high:.4g} s even at the "
            "highest rate; allow longer runs or fewer revolutions",
            "plan-infeasible",
        )
    samples = fewest * 2.0 * math.pi / high * settings.sampling_rate
    if samples < _MIN_SAMPLES:
        problems.add(
            ("limits", "sampling_rate"),
            f"{fewest:g} revolutions at {high:.6g} rad/s have {samples:.3g} samples at "
            f"{settings.sampling_rate:.6g} Hz; give a higher sampling rate, or a lower "
            "highest_rate",
            "plan-infeasible",
        )
    if longest * high > 2.0 * math.pi * _MAX_REVOLUTIONS:
        problems.add(
            ("limits", "total_time"),
            f"a run of {longest:.4g} s at {high:.6g} rad/s is longer than the longest possible "
            f"record",
            "plan-infeasible",
        )
    limits = Limits(
        types=tuple(RunType(name, sense) for name in attitudes for sense in senses),
        rate=(low, high),
        settings=available,
        total_time=settings.total_time,
        settling=settings.settling,
        spin_up=spin_up,
        attitude_change=settings.attitude_change,
        revolutions=fewest,
        longest_run=min(longest, settings.total_time),
        runs=settings.runs,
        fewest_rates=settings.fewest_rates or _DEFAULT_RATES,
    )
    if settings.fewest_rates is None and (_rate_shortage(limits) or not limits.is_feasible):
        limits = replace(limits, fewest_rates=1)
    if reason := _rate_shortage(limits):
        problems.add(("limits", "fewest_rates"), reason, "plan-infeasible")
    if limits.total_time < limits.shortest_time:
        problems.add(
            ("limits", "total_time"),
            f"no run fits, because the shortest run takes {limits.shortest_time:.4g} s with "
            f"spin-up, settling and {fewest:g} revolutions"
            if limits.fewest_rates == 1
            else f"{limits.fewest_rates} runs at different rates do not fit: even the shortest "
            f"runs take {limits.shortest_time:.4g} s, with spin-up, settling and "
            f"{fewest:g} revolutions each",
            "plan-infeasible",
        )
    return limits if len(problems.lines) == error_count else None


def _rate_shortage(limits: Limits) -> str:
    """Return the reason why too few different rates are possible; empty if enough are."""
    count = limits.fewest_rates
    if count > limits.runs:
        return f"{count} rates require at least {count} runs, but limits.runs is {limits.runs}"
    rates = limits.different_rates(limits.rate[1])
    if len(rates) < count and limits.settings:
        return f"the limits allow only {len(rates)} settings of the rate"
    if len(rates) < count:
        return (
            f"between {limits.rate[0]:.6g} and {limits.rate[1]:.6g} rad/s, there are only "
            f"{len(rates)} rates with a ratio of at least {limits.min_rate_ratio:g}"
        )
    if limits.revolutions * 2.0 * math.pi / rates[-1] > limits.longest_run * (1.0 + 1e-9):
        return (
            f"{limits.revolutions:g} revolutions at the lowest of {count} different rates, "
            f"{rates[-1]:.6g} rad/s, take longer than the longest run"
        )
    return ""


def _resolve_rates(
    settings: LimitsSettings, campaign: Campaign, problems: Problems
) -> tuple[tuple[float, float], tuple[float, ...]] | None:
    """Return smallest and largest rate, and the settings where not all between are available."""
    bounds = {}
    if settings.highest_rate is not None:
        bounds["highest_rate"] = settings.highest_rate
    if settings.specific_force is not None:
        force = settings.specific_force * campaign.site.gravity
        bounds["specific_force"] = math.sqrt(force / campaign.radius.value)
    if settings.rates is not None:
        bounds["rates"] = max(settings.rates)
    if not bounds:
        problems.add(("limits",), "give highest_rate, specific_force or rates", "missing-key")
        return None
    key, high = min(bounds.items(), key=lambda item: item[1])
    low = settings.lowest_rate
    if low is not None and low > high:
        problems.add(
            ("limits", "lowest_rate"),
            f"{low:.6g} rad/s is above the {high:.6g} rad/s that {key} allows",
            "plan-infeasible",
        )
        return None
    if settings.rates is None:
        return (low or _MIN_RATE_FRACTION * high, high), ()
    available = tuple(
        sorted({w for w in settings.rates if (low or 0.0) <= w <= high * (1.0 + 1e-12)})
    )
    if not available:
        problems.add(
            ("limits", "rates"),
            f"no rate is between lowest_rate and the limit of {key}",
            "plan-infeasible",
        )
        return None
    return (available[0], available[-1]), available


def resolve_goal(
    settings: GoalSettings, campaign: Campaign, problems: Problems
) -> GoalResult | None:
    """Return the goal of a plan, or None after reporting its errors."""
    if settings.minimise is not None and settings.target is not None:
        problems.add(("goal",), "has both minimise and target; keep only one of them")
        return None
    if settings.target is not None and settings.criterion != "sum":
        problems.add(("goal", "criterion"), "does not apply to a target; omit it")
    key: Literal["target", "minimise"] = "minimise" if settings.target is None else "target"
    settings_path = settings.target if settings.target is not None else settings.minimise
    if settings_path is None:
        settings_path = ["K_II"]
    shared = [u for u in make_unknowns(campaign).of_interest if u.owner not in _run_names(campaign)]
    error_count = len(problems.lines)
    sizes: dict[str, float] = {}
    units: set[str] = set()
    names = list(settings_path)
    if not names:
        problems.add(("goal", key), "does not name a coefficient", "unknown-term")
    for index, name in enumerate(names):
        path = ("goal", key, name if isinstance(settings_path, Mapping) else index)
        matches = [u for u in shared if name in (u.name, u.symbol)]
        if not matches:
            known_names = dict.fromkeys(n for u in shared for n in (u.symbol, u.name))
            problems.add(
                path, f'"{name}" is not estimated' + suggest_name(name, known_names), "unknown-term"
            )
            continue
        size: float | None = 1.0
        if isinstance(settings_path, Mapping):
            size = _resolve_size(settings_path[name], matches[0], campaign, path, problems)
        sizes |= {u.name: size for u in matches if size is not None}
        units |= {unit_of(u.symbol) for u in matches}
    if not isinstance(settings_path, Mapping) and settings.criterion == "sum" and len(units) > 1:
        problems.add(
            ("goal", key),
            "the coefficients have different units; give the u that counts as 1 for each "
            'coefficient, such as minimise = { K_II = "1e-8 g/g^2" }',
            "missing-value",
        )
    if len(problems.lines) > error_count:
        return None
    return GoalResult(kind=key, criterion=settings.criterion, sizes=sizes)


def _resolve_size(
    text: Any, unknown: Unknown, campaign: Campaign, path: tuple[str | int, ...], problems: Problems
) -> float | None:
    unit = unit_of(unknown.symbol)
    quantity = problems.collect(path, parse_quantity, text, unit, gravity=campaign.site.gravity)
    if quantity is None:
        return None
    if quantity.value <= 0.0 or quantity.u != 0.0:
        problems.add(
            path,
            "a target uncertainty must be a single number greater than zero",
            "value-out-of-range",
        )
        return None
    return quantity.value


def _run_names(campaign: Campaign) -> set[str]:
    return {run.name for run in campaign.runs}


def resolve_plan_campaign(document: Mapping[str, Any], path: Path) -> Campaign:
    """Return the campaign of a document that a plan has made."""
    problems = Problems(document)
    campaign = resolve_campaign(document, path, problems)
    if campaign is None:
        raise CampaignError(str(path), problems.lines)
    return campaign


def campaign_document(plan: Plan, runs: Sequence[Mapping[str, Any]], title: str) -> dict[str, Any]:
    """Return the document of the campaign with given runs."""
    document = dict(plan.document)
    about = {"title": title, **table_of(document, "campaign")}
    other_keys = {
        key: value for key, value in document.items() if key not in ("schema", "campaign")
    }
    # The sections in the order of the example that `counterspin init` writes.
    order = ("site", "centrifuge", "records", "accelerometers", "noise", "model", "runs")
    other_keys["runs"] = [dict(run) for run in runs]
    ordered_keys = {key: other_keys[key] for key in (*order, *other_keys) if key in other_keys}
    return {"schema": document["schema"], "campaign": about, **ordered_keys}
