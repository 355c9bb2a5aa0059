"""`counterspin plan`: the best campaign within limits, and its active limits."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import field, replace
from importlib.resources import files
from pathlib import Path
from typing import Any, Final, Literal

from counterspin.campaign.description import Campaign, read_campaign
from counterspin.campaign.documents import DESCRIPTION_NAME
from counterspin.campaign.quantity import describe_attitude
from counterspin.errors import ExistingFileError, NotIdentifiableError
from counterspin.frozen import frozen
from counterspin.input import to_path
from counterspin.output import make_folder, write_text
from counterspin.planning.design import Design, Limits
from counterspin.planning.faults import Requirement, fault_requirements
from counterspin.planning.forecast import Forecast, forecast
from counterspin.planning.limits import active_limits
from counterspin.planning.plan_file import change_plan, load_plan, read_plan
from counterspin.planning.reading_plan import ReadingSearch
from counterspin.planning.recorded import add_pose_noise, apply_records, needs_records
from counterspin.planning.result import OtherPlan, PlanResult, other_plan, result_of
from counterspin.planning.search import Search, require_determined, unreachable
from counterspin.planning.stations import read_reading_plan
from counterspin.threads import single_blas_thread
from counterspin.toml_text import format_document

#: How often a plan for a target is changed after its forecast has missed it.
_MAX_CHANGES: Final = 5


@frozen(eq=False)
class PlannedCampaign:
    """A plan and the campaign that it makes.

    Attributes
    ----------
    result
        The plan itself, its uncertainties and its limits.
    document
        The campaign's description, as TOML.
    source
        The source of the plan: limits, goal and the rest of its file.
    file
        The plan's file; files that it names are in the same folder. None for a plan in memory.
    """

    result: PlanResult
    document: str
    source: Mapping[str, Any] = field(default_factory=dict)
    file: Path | None = None

    def __repr__(self) -> str:
        """Return the first lines of the printed report, at most 20."""
        return repr(self.result)

    def _repr_html_(self) -> str:
        return self.result._repr_html_()

    @property
    def u(self) -> dict[str, float]:
        """Standard uncertainty of each coefficient by name, such as ``Qx.K_II``."""
        owners = {
            name: accelerometer.coefficients
            for name, accelerometer in self.result.accelerometers.items()
        }
        named = {
            f"{name}.{symbol}": c
            for name, coefficients in owners.items()
            for symbol, c in coefficients.items()
        }
        named |= self.result.platform
        return {name: c.u for name, c in named.items() if c.u is not None}

    def change(self, **changes: Any) -> PlannedCampaign:
        """Return the plan that is found after named changes.

        Parameters
        ----------
        **changes
            Keys of ``[limits]`` and ``[goal]``, such as ``total_time`` or ``target``, the names
            that `Campaign.change` knows, a section, or any key with dots,
            ``**{"noise.displacement": "5 mm"}``: new value. A mapping changes the keys
            it has; None takes a key away. ``target`` takes the place of ``minimise``, and the other
            way round.

        Raises
        ------
        CampaignError
            With every mistake, as for a file.
        """
        return plan(change_plan(self.source, changes), file=self.file)

    def sweep(self, name: str, values: Iterable[Any]) -> list[PlannedCampaign]:
        """Return the plan for each value of a key, found one after the other.

        Parameters
        ----------
        name
            As in `change`, such as ``"total_time"``.
        values
            What stands there, such as ``["10 min", "20 min"]``.
        """
        return [self.change(**{name: value}) for value in values]


@single_blas_thread()
def plan(
    where: Mapping[str, Any] | Path | str,
    *,
    file: Path | None = None,
) -> PlannedCampaign:
    """Find the best campaign for a plan's goal within its limits.

    Parameters
    ----------
    where
        The plan's file, or its content as nested mappings.
    file
        The file whose content nested mappings are; files that they name are in its folder.

    Returns
    -------
    PlannedCampaign

    Raises
    ------
    CampaignError
        If the file is missing or wrong, or its limits contradict each other.
    NotIdentifiableError
        If no allowed attitude and rate determines a coefficient of the goal.
    CounterspinError
        If no plan within the limits reaches the target.
    """
    file = file if isinstance(where, Mapping) else to_path(where, "a plan, or a plan file")
    if "stations" in load_plan(where):
        return _plan_readings(where, file)
    plan_data = read_plan(where, file)
    search = Search(plan_data)
    require_determined(search)
    optimum = search.best()
    if optimum is None:
        raise unreachable(search)
    design, prediction = _round_to_targets(search, search.in_order(optimum.design))
    campaign = prediction.campaign
    total_time = search.limits.time(design)
    goal_name = next(iter(plan_data.goal.sizes))
    basis, requirements = _accelerometer_requirements(
        prediction, goal_name, plan_data.sampling_rate
    )
    result = result_of(
        prediction,
        plan_data.sampling_rate,
        total_time,
        _run_attitudes(campaign, design),
        _start_times(campaign, design, search.limits),
    )
    result = result.model_copy(
        update={
            "goal": plan_data.goal.met(optimum.efficiency if search.bounded else None),
            "others": _alternative_plans(search, design, prediction, total_time),
            "limits": active_limits(search, optimum.design),
            "requirements": requirements,
            "requirements_for": basis,
        }
    )
    document = format_document(search.document(design), _COMMENTS)
    return PlannedCampaign(result, document, load_plan(where), file)


def _plan_readings(where: Mapping[str, Any] | Path | str, file: Path | None) -> PlannedCampaign:
    """Return a plan of readings, with their values left blank in its campaign."""
    plan_data = read_reading_plan(where, file)
    result, readings = ReadingSearch(plan_data).best()
    document = format_document(plan_data.campaign_document(readings), _COMMENTS)
    return PlannedCampaign(result, document, load_plan(where), file)


def _round_to_targets(search: Search, design: Design) -> tuple[Design, Forecast]:
    """Return a plan as it is written, and its forecast, which meets the targets."""
    goal = search.plan.goal
    if goal.kind == "minimise":
        rounded_design = search.rounded(design)
        return rounded_design, forecast(search.campaign(rounded_design))
    sizes = goal.sizes
    for _ in range(_MAX_CHANGES):
        new_design = search.meeting(design, sizes)
        if new_design is None:
            break
        prediction = forecast(search.campaign(new_design))
        u_ratios = {name: prediction.u[name] / size for name, size in goal.sizes.items()}
        if max(u_ratios.values()) <= 1.0:
            return new_design, prediction
        # The search's predictions differ by a few 1e-5 from the forecast where the noise walks.
        sizes = {name: size * min(1.0, 0.99999 / u_ratios[name]) for name, size in sizes.items()}
    raise unreachable(search)


_COMMENTS: Final = {
    "simulation": (
        "The following section is only for `counterspin simulate`. A calibration ignores it."
    ),
}


def check(
    where: Path | str, *, sampling_rate: float | None = None, revolutions: float | None = None
) -> PlanResult:
    """Forecast the uncertainties of a campaign without its records.

    Data missing in the description (lengths, sampling rates, noise) are taken from the records if
    all records exist.

    Parameters
    ----------
    where
        The campaign's folder or its description.
    sampling_rate
        Hz; None: that of its [simulation], or of the records.
    revolutions
        Length of runs without duration and revolutions in the campaign; None: the length of
        the records.

    Raises
    ------
    CampaignError
        If the description is wrong, or lacks data that a forecast needs.
    """
    campaign = add_pose_noise(read_campaign(where))
    unsized_runs = [run for run in campaign.runs if run.duration is None]
    if revolutions is not None:
        lengths = {run.name: 2.0 * math.pi * revolutions / abs(run.rate) for run in unsized_runs}
        runs = tuple(
            r.model_copy(update={"duration": lengths.get(r.name, r.duration)})
            for r in campaign.runs
        )
        campaign = replace(campaign, runs=runs)
    rates: float | Mapping[str, float] | None = sampling_rate
    if revolutions is None and needs_records(campaign, sampling_rate):
        campaign, recorded = apply_records(campaign)
        if sampling_rate is None:
            # That of the slowest recorder is the one that a requirement may rest on.
            rates, sampling_rate = recorded, min(recorded.values())
    prediction = forecast(campaign, sampling_rate=rates)
    if sampling_rate is None and campaign.simulation is not None:
        sampling_rate = campaign.simulation.sampling_rate
    attitudes = {run.name: describe_attitude(run.attitude) for run in campaign.runs}
    total_time = sum(run.duration or 0.0 for run in campaign.runs)
    result = result_of(prediction, sampling_rate, total_time, attitudes, None)
    symbol = "K_II" if "K_II" in campaign.model.terms else campaign.model.terms[0]
    name = f"{next(iter(campaign.accelerometers))}.{symbol}"
    basis: str = ""
    requirements: list[Requirement] = []
    if sampling_rate is not None and not campaign.readings:
        basis, requirements = _accelerometer_requirements(prediction, name, sampling_rate)
    warnings = [
        f"{run.name}: counterspin assumes {revolutions:g} revolutions, because the campaign "
        "does not state the length of the record."
        for run in (unsized_runs if revolutions is not None else ())
    ]
    return result.model_copy(
        update={
            "requirements": requirements,
            "requirements_for": basis,
            "warnings": [*result.warnings, *warnings],
        }
    )


def require_no_campaign(folder: Path) -> Path:
    """Return the description's path in a folder; raise CounterspinError if it exists already."""
    target = folder / DESCRIPTION_NAME
    if target.exists():
        raise ExistingFileError(f"{target} already exists; choose another folder")
    return target


def write_campaign(planned: PlannedCampaign, folder: Path) -> Path:
    """Write the campaign's description into a folder."""
    target = require_no_campaign(folder)
    make_folder(folder)
    write_text(target, planned.document)
    return target


#: What an example plans: records of a double turntable, or poses of a triad.
Example = Literal["records", "poses"]


def write_example(file: Path, example: Example = "records") -> Path:
    """Write a commented plan to start from; raises as `write_campaign` does."""
    if file.exists():
        raise ExistingFileError(f"{file} already exists; edit it, or choose another name")
    starter = "starter.toml" if example == "records" else f"starter_{example}.toml"
    write_text(file, (files("counterspin.planning") / starter).read_text("utf-8"))
    return file


def _run_attitudes(campaign: Campaign, design: Design) -> dict[str, str]:
    return {
        run.name: run_type.attitude
        for run, run_type in zip(campaign.runs, design.types, strict=True)
    }


def _start_times(campaign: Campaign, design: Design, limits: Limits) -> dict[str, float]:
    """Return the start time of each record, after spin-up, spin-down and settling."""
    time, starts = 0.0, {}
    before = None
    overhead = limits.overhead(design.rate)
    for index, run in enumerate(campaign.runs):
        attitude = design.types[index].attitude
        if before is not None and attitude != before:
            time += limits.attitude_change
        before = attitude
        time += float(overhead[index])
        starts[run.name] = time
        time += float(design.duration[index])
    return starts


def _accelerometer_requirements(
    prediction: Forecast, name: str, sampling_rate: float
) -> tuple[str, list[Requirement]]:
    if prediction.campaign.angle is None:
        return "", []  # the rotation is an unknown then
    return fault_requirements(prediction, name, sampling_rate)


def _alternative_plans(
    search: Search, design: Design, prediction: Forecast, total_time: float
) -> list[OtherPlan]:
    """Return plans for three rates as in the paper, equally spaced rates, and half of the time.

    Half of the time applies to plans that minimise u; a plan of least time has none to spare.
    """
    half = replace(search.limits, total_time=0.5 * total_time)
    shorter = None
    if search.plan.goal.kind == "minimise" and half.is_feasible:
        # The best rates may leave no time for a record.
        with suppress(NotIdentifiableError):
            start = search.smallest(half).design
            shorter = search.rounded(search.in_order(start), half)
    plans = []
    for text, alternative in (
        (
            (
                "plan of the paper: 1/4, 1/2 and 1 times the highest rate, with equal numbers of "
                "revolutions"
            ),
            search.three_rates(design, total_time),
        ),
        ("equally spaced rates, equal durations", search.even_rates(design, total_time)),
        ("best plan in half the time", shorter),
    ):
        if alternative is None:
            continue
        u = forecast(search.campaign(alternative)).u
        time = search.limits.time(alternative)
        label = f"{text} ({len(alternative.types)} runs)"
        plans.append(other_plan(label, time, prediction.u, u, search.plan.goal.sizes))
    return plans
