"""Conversion of ``PLAN.toml`` to a `Plan`: check every key and report all errors together.

Most sections of a plan are those of a campaign without runs. They are checked as a template
campaign with one run in each attitude.
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

#: Default lowest rate, as a fraction of the highest.
_MIN_RATE_FRACTION: Final = 0.125

#: Default number of distinct rates of a plan, if the limits allow it.
_N_DEFAULT_RATES: Final = 2

#: Minimum number of samples of a run, and maximum number of revolutions.
_MIN_SAMPLES: Final = 3.0
_MAX_REVOLUTIONS: Final = 1e9

#: Default columns of the records.
_DEFAULT_RECORDS: Final[Mapping[str, Any]] = {
    "time": {"column": "time_s", "unit": "s"},
    "angle": {"column": "angle_rad", "unit": "rad"},
}

#: Short names of keys of a plan.
SHORT_KEYS: Final[Mapping[str, KeyPath]] = {
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

    path: Path  #: Absolute path of the file.
    #: Document of the planned campaign without runs; ``truth`` has the expected values.
    document: Mapping[str, Any]
    template: Campaign  #: Campaign with one run for each attitude, with the name of the attitude.
    attitudes: Mapping[str, Any]  #: Attitudes by name, as written in a campaign.
    limits: Limits  #: Limits of the machine and the laboratory.
    sampling_rate: float  #: Sampling rate, Hz.
    goal: GoalResult  #: Goal of the plan.


def load_plan(where: Mapping[str, Any] | Path | str) -> dict[str, Any]:
    """Return a plan's document; CampaignError if it cannot be read."""
    if isinstance(where, Mapping):
        problems = Problems(where)
        document: dict[str, Any] = {"schema": 1} | to_toml_value(where, (), problems.add)
        if problems.lines:
            raise CampaignError(str(plan_name(where)), problems.lines)
        return document
    advice = "`planning.plan.write_example` writes a starter plan"
    return load_document(Path(where), advice, "plan")


def change_plan(document: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return a plan's document with named changes; see `counterspin.PlannedCampaign.change`."""
    new_document = dict(document)
    for name, value in changes.items():
        if name in LimitsSettings.model_fields:
            path: tuple[str | int, ...] = ("limits", name)
        elif name in GoalSettings.model_fields:
            path = ("goal", name)
        else:
            path = tuple(SHORT_KEYS.get(name) or name.split("."))
        patch = value
        for path_key in reversed(path):
            patch = {path_key: patch}
        new_document = merge_patch(new_document, patch)
        # A plan either reaches a target in the least time, or minimises u in the available time.
        excluded_key = {"target": "minimise", "minimise": "target"}.get(str(path[-1]))
        if path[0] == "goal" and excluded_key is not None and value is not None:
            new_document = merge_patch(new_document, {"goal": {excluded_key: None}})
    return new_document


def is_plan(document: Mapping[str, Any]) -> bool:
    """Check for the sections of a plan, of records or of readings, in a document."""
    return {"limits", "goal"} <= document.keys()


def plan_name(where: Mapping[str, Any] | Path | str) -> Path:
    """Return the name of a plan for messages: its file, if any."""
    return Path("plan in memory") if isinstance(where, Mapping) else Path(where)


def read_plan(where: Mapping[str, Any] | Path | str, file: Path | None = None) -> Plan:
    """Read and check a plan.

    file: File of a plan in memory, whose folder contains the files that it names; None: no file.
    """
    file, raw = file or plan_name(where), load_plan(where)
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
    goal_settings = problems.check(GoalSettings, table_of(raw, "goal"), ("goal",))
    attitudes = _name_attitudes(settings.attitudes if settings else ["level"], problems)
    document = _campaign_document(raw, settings)
    document["noise"] = _reject_estimated_noise(table_of(document, "noise"), problems)
    if _reject_time_dependence(document, problems):
        raise campaign_error(file, problems.lines)
    template_runs = [
        {"name": name, "rate": "1 rad/s", "record": f"run{i}.csv", "attitude": attitude}
        for i, (name, attitude) in enumerate(attitudes.items())
    ]
    campaign = resolve_campaign({**document, "runs": template_runs}, file, problems)
    if campaign is not None and campaign.noise is not None and campaign.rest is not None:
        document["noise"] = _static_record_sizes(campaign, campaign.noise, problems)
        campaign = resolve_campaign({**document, "runs": template_runs}, file, problems)
    plan = None
    if campaign is not None:
        _check_noise(campaign, problems)
        limits = _resolve_limits(settings, attitudes, campaign, problems) if settings else None
        goal = resolve_goal(goal_settings, campaign, problems) if goal_settings else None
        if settings is not None and limits is not None and goal is not None:
            plan = Plan(
                file.absolute(),
                {**document, "truth": _complete_truth(document, campaign)},
                campaign,
                attitudes,
                limits,
                settings.sampling_rate,
                goal,
            )
    if problems.lines or plan is None:
        raise campaign_error(file, problems.lines)
    return plan


def _reject_time_dependence(document: Mapping[str, Any], problems: Problems) -> bool:
    """Report terms that depend on the time or temperature of runs, which are not known yet.

    Return True if there are any such terms.
    """
    model, n_errors = table_of(document, "model"), len(problems.lines)
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
    return len(problems.lines) > n_errors


def _campaign_document(raw: Mapping[str, Any], settings: LimitsSettings | None) -> dict[str, Any]:
    """Return the document of the planned campaign with default channels."""
    campaign_sections = {key: value for key, value in raw.items() if key not in ("limits", "goal")}
    document = {"records": dict(_DEFAULT_RECORDS), **campaign_sections}
    tables = raw.get("accelerometers")
    if isinstance(tables, dict):
        document["accelerometers"] = {
            name: {**table, "displacement": {"column": f"{name}_m", "unit": "m"}}
            if isinstance(table, dict) and not set(table) & set(OBSERVABLES)
            else table
            for name, table in tables.items()
        }
    sampling_rate = settings.sampling_rate if settings else 50.0
    document["simulation"] = {"sampling_rate": f"{sampling_rate!r} Hz", "seed": 1}
    return document


def _name_attitudes(attitudes: Sequence[Any], problems: Problems) -> dict[str, Any]:
    """Return the attitudes by their names in reports."""
    attitudes_by_name: dict[str, Any] = {}
    for index, attitude in enumerate(attitudes):
        name = (
            attitude
            if isinstance(attitude, str)
            else ", ".join(f"{axis} {direction}" for axis, direction in attitude.items())
        )
        if name in attitudes_by_name:
            problems.add(
                ("limits", "attitudes", index), f'"{name}" is listed twice', "duplicate-entry"
            )
        attitudes_by_name[name] = attitude
    return attitudes_by_name


def _complete_truth(document: Mapping[str, Any], campaign: Campaign) -> dict[str, Any]:
    """Return [truth], completed with the prior values of terms that it does not name."""
    truth = dict(table_of(document, "truth"))
    for name, accelerometer in campaign.accelerometers.items():
        prior_values = {
            symbol: f"{prior.value!r} {prior.unit}"
            for symbol, prior in accelerometer.priors.items()
            if prior.value != term(symbol).nominal
        }
        truth[name] = {**prior_values, **table_of(truth, name)}
    return truth


def _reject_estimated_noise(noise: Mapping[str, Any], problems: Problems) -> dict[str, Any]:
    """Report noise to be estimated, which requires records; return [noise] without it."""
    estimated_keys = [key for key, size in noise.items() if size == ESTIMATE]
    for key in estimated_keys:
        problems.add(
            ("noise", key),
            "the noise cannot be estimated from a plan; give its value",
            "missing-value",
        )
    return {key: size for key, size in noise.items() if key not in estimated_keys}


def _static_record_sizes(
    campaign: Campaign, noise: NoiseSettings, problems: Problems
) -> dict[str, str]:
    """Return [noise] with the values of a record at rest, as strings with units."""
    sizes = {key: size for key, size in complete_noise_sizes(campaign, noise).items() if size}
    for key in sizes.keys() & set(BIAS_COMPONENTS_BY_KEY) - noise.model_fields_set:
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
                "the search for runs cannot model a drifting bias; omit this component here, add "
                "it to the planned campaign, and run a forecast of that campaign",
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
    settings: LimitsSettings, attitudes: Iterable[str], campaign: Campaign, problems: Problems
) -> Limits | None:
    """Return the limits, or None after reporting their contradictions."""
    n_errors = len(problems.lines)
    rates = _resolve_rates(settings, campaign, problems)
    if rates is None:
        return None
    (low, high), rate_settings = rates
    senses = (1, -1) if settings.senses == "both" else (1,)
    spin_up = sum(
        1.0 / acceleration
        for acceleration in (settings.spin_up, settings.spin_down)
        if acceleration is not None
    )
    max_duration = settings.longest_run or settings.total_time
    min_revolutions = settings.fewest_revolutions
    min_duration = min_revolutions * 2.0 * math.pi / high
    if min_duration > max_duration * (1.0 + 1e-9):
        problems.add(
            ("limits", "longest_run"),
            f"{min_revolutions:g} revolutions take {min_duration:.4g} s even at the "
            "highest rate; allow longer runs or fewer revolutions",
            "plan-infeasible",
        )
    n_samples = min_duration * settings.sampling_rate
    if n_samples < _MIN_SAMPLES:
        problems.add(
            ("limits", "sampling_rate"),
            f"{min_revolutions:g} revolutions at {high:.6g} rad/s have {n_samples:.3g} samples at "
            f"{settings.sampling_rate:.6g} Hz; give a higher sampling rate, or a lower "
            "highest_rate",
            "plan-infeasible",
        )
    if max_duration * high > 2.0 * math.pi * _MAX_REVOLUTIONS:
        problems.add(
            ("limits", "total_time"),
            f"a run of {max_duration:.4g} s at {high:.6g} rad/s is longer than the longest "
            "possible record",
            "plan-infeasible",
        )
    limits = Limits(
        types=tuple(RunType(name, sense) for name in attitudes for sense in senses),
        rate_range=(low, high),
        rate_settings=rate_settings,
        total_time=settings.total_time,
        settling=settings.settling,
        spin_up=spin_up,
        attitude_change=settings.attitude_change,
        min_revolutions=min_revolutions,
        max_duration=min(max_duration, settings.total_time),
        max_runs=settings.runs,
        min_rates=settings.fewest_rates or _N_DEFAULT_RATES,
    )
    if settings.fewest_rates is None and (_rate_shortage_reason(limits) or not limits.is_feasible):
        limits = replace(limits, min_rates=1)
    if reason := _rate_shortage_reason(limits):
        problems.add(("limits", "fewest_rates"), reason, "plan-infeasible")
    if limits.total_time < limits.min_time:
        problems.add(
            ("limits", "total_time"),
            f"no run fits, because the shortest run takes {limits.min_time:.4g} s with "
            f"spin-up, settling and {min_revolutions:g} revolutions"
            if limits.min_rates == 1
            else f"{limits.min_rates} runs at different rates do not fit: even the shortest "
            f"runs take {limits.min_time:.4g} s, with spin-up, settling and "
            f"{min_revolutions:g} revolutions each",
            "plan-infeasible",
        )
    return limits if len(problems.lines) == n_errors else None


def _rate_shortage_reason(limits: Limits) -> str:
    """Return the reason why the limits allow too few distinct rates; empty if they allow enough."""
    min_rates = limits.min_rates
    if min_rates > limits.max_runs:
        return (
            f"{min_rates} rates require at least {min_rates} runs, but limits.runs is "
            f"{limits.max_runs}"
        )
    low, high = limits.rate_range
    rates = limits.distinct_rates(high)
    if len(rates) < min_rates and limits.rate_settings:
        return f"the limits allow only {len(rates)} settings of the rate"
    if len(rates) < min_rates:
        return (
            f"between {low:.6g} and {high:.6g} rad/s, there are only "
            f"{len(rates)} rates with a ratio of at least {limits.min_rate_ratio:g}"
        )
    if limits.min_revolutions * 2.0 * math.pi / rates[-1] > limits.max_duration * (1.0 + 1e-9):
        rate_text = f"lowest of {min_rates} different rates" if min_rates > 1 else "highest rate"
        return (
            f"{limits.min_revolutions:g} revolutions at the {rate_text}, "
            f"{rates[-1]:.6g} rad/s, take longer than the limit longest_run"
        )
    return ""


def _resolve_rates(
    settings: LimitsSettings, campaign: Campaign, problems: Problems
) -> tuple[tuple[float, float], tuple[float, ...]] | None:
    """Return the rate range, and the rate settings (empty: any rate); None after an error."""
    upper_bounds = {}
    if settings.highest_rate is not None:
        upper_bounds["highest_rate"] = settings.highest_rate
    if settings.specific_force is not None:
        acceleration = settings.specific_force * campaign.site.gravity
        upper_bounds["specific_force"] = math.sqrt(acceleration / campaign.radius.value)
    if settings.rates is not None:
        upper_bounds["rates"] = max(settings.rates)
    if not upper_bounds:
        problems.add(("limits",), "give highest_rate, specific_force or rates", "missing-key")
        return None
    key, high = min(upper_bounds.items(), key=lambda bound: bound[1])
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
    rate_settings = tuple(
        sorted({rate for rate in settings.rates if (low or 0.0) <= rate <= high * (1.0 + 1e-12)})
    )
    if not rate_settings:
        problems.add(
            ("limits", "rates"),
            f"no rate is between lowest_rate and the limit of {key}",
            "plan-infeasible",
        )
        return None
    return (rate_settings[0], rate_settings[-1]), rate_settings


def resolve_goal(
    settings: GoalSettings, campaign: Campaign, problems: Problems
) -> GoalResult | None:
    """Return the goal of a plan, or None after reporting its errors."""
    if settings.minimise is not None and settings.target is not None:
        problems.add(("goal",), "has both minimise and target; keep only one of them")
        return None
    if settings.target is not None and settings.criterion != "sum":
        problems.add(("goal", "criterion"), "does not apply to a target; omit it")
    kind: Literal["target", "minimise"] = "minimise" if settings.target is None else "target"
    entries = settings.target if settings.target is not None else settings.minimise
    if entries is None:
        entries = ["K_II"]
    shared_unknowns = [
        unknown
        for unknown in make_unknowns(campaign).of_interest
        if unknown.owner not in _run_names(campaign)
    ]
    n_errors = len(problems.lines)
    sizes: dict[str, float] = {}
    units: set[str] = set()
    names = list(entries)
    if not names:
        problems.add(("goal", kind), "does not name a coefficient", "unknown-term")
    for index, name in enumerate(names):
        path = ("goal", kind, name if isinstance(entries, Mapping) else index)
        matches = [unknown for unknown in shared_unknowns if name in (unknown.name, unknown.symbol)]
        if not matches:
            known_names = dict.fromkeys(
                known_name
                for unknown in shared_unknowns
                for known_name in (unknown.symbol, unknown.name)
            )
            problems.add(
                path, f'"{name}" is not estimated' + suggest_name(name, known_names), "unknown-term"
            )
            continue
        u_target: float | None = 1.0
        if isinstance(entries, Mapping):
            u_target = _resolve_size(entries[name], matches[0], campaign, path, problems)
        sizes |= {unknown.name: u_target for unknown in matches if u_target is not None}
        units |= {unit_of(unknown.symbol) for unknown in matches}
    if not isinstance(entries, Mapping) and settings.criterion == "sum" and len(units) > 1:
        problems.add(
            ("goal", kind),
            "the coefficients have different units; state equally important values of u, one for "
            'each coefficient, such as minimise = { K_II = "1e-8 g/g^2" }',
            "missing-value",
        )
    if len(problems.lines) > n_errors:
        return None
    return GoalResult(kind=kind, criterion=settings.criterion, sizes=sizes)


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
    """Return the campaign of a document from a plan."""
    problems = Problems(document)
    campaign = resolve_campaign(document, path, problems)
    if campaign is None:
        raise CampaignError(str(path), problems.lines)
    return campaign


def campaign_document(plan: Plan, runs: Sequence[Mapping[str, Any]], title: str) -> dict[str, Any]:
    """Return the document of the planned campaign with `runs`."""
    document = dict(plan.document)
    campaign_section = {"title": title, **table_of(document, "campaign")}
    sections = {key: value for key, value in document.items() if key not in ("schema", "campaign")}
    # The sections in the order of the example that `counterspin init` writes.
    order = ("site", "centrifuge", "records", "accelerometers", "noise", "model", "runs")
    sections["runs"] = [dict(run) for run in runs]
    ordered_sections = {key: sections[key] for key in (*order, *sections) if key in sections}
    return {"schema": document["schema"], "campaign": campaign_section, **ordered_sections}
