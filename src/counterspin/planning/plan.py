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
from counterspin.errors import ExistingFileError, NotIdentifiableError, UsageError
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
from counterspin.planning.result import OtherPlan, PlanResult, compare_plan, make_plan_result
from counterspin.planning.search import Search, require_determined, unreachable_target_error
from counterspin.planning.stations import read_reading_plan
from counterspin.threads import single_blas_thread
from counterspin.toml_text import format_document

#: Maximum number of corrections of a plan whose forecast misses its target.
_MAX_CHANGES: Final = 5


@frozen(eq=False)
class PlannedCampaign:
    """A plan and its campaign.

    Attributes
    ----------
    result
        The plan itself, its uncertainties and its limits.
    document
        The campaign's description, as TOML.
    source
        The document of the plan: limits, goal and all other sections.
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
        coefficients_by_accelerometer = {
            name: accelerometer.coefficients
            for name, accelerometer in self.result.accelerometers.items()
        }
        coefficients_by_name = {
            f"{name}.{symbol}": coefficient
            for name, coefficients in coefficients_by_accelerometer.items()
            for symbol, coefficient in coefficients.items()
        }
        coefficients_by_name |= self.result.platform
        return {
            name: coefficient.u
            for name, coefficient in coefficients_by_name.items()
            if coefficient.u is not None
        }

    def change(self, **changes: Any) -> PlannedCampaign:
        """Return the plan after named changes.

        Parameters
        ----------
        **changes
            Keys of ``[limits]`` and ``[goal]``, such as ``total_time`` or ``target``, the names
            of `Campaign.change`, a section, or any key with dots,
            ``**{"noise.displacement": "5 mm"}``: new value. A mapping changes the keys
            it has; None removes a key. ``target`` replaces ``minimise``, and vice versa.

        Raises
        ------
        CampaignError
            With every mistake, as for a file.
        """
        return plan(change_plan(self.source, changes), file=self.file)

    def sweep(self, name: str, values: Iterable[Any]) -> list[PlannedCampaign]:
        """Return the plan for each value of a key.

        Parameters
        ----------
        name
            Name as in `change`, such as ``"total_time"``.
        values
            Values of the key, such as ``["10 min", "20 min"]``.
        """
        return [self.change(**{name: value}) for value in values]


@single_blas_thread()
def plan(where: Mapping[str, Any] | Path | str, *, file: Path | None = None) -> PlannedCampaign:
    """Find the best campaign for a plan's goal within its limits.

    Parameters
    ----------
    where
        The plan's file, or its content as nested mappings.
    file
        The file of nested mappings; files that they name are in its folder.

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
    parsed_plan = read_plan(where, file)
    search = Search(parsed_plan)
    require_determined(search)
    optimum = search.find_optimum()
    if optimum is None:
        raise unreachable_target_error(search)
    design, prediction = _round_to_targets(search, search.order_runs(optimum.design))
    campaign = prediction.campaign
    total_time = search.limits.campaign_time(design)
    goal_name = next(iter(parsed_plan.goal.sizes))
    basis, requirements = _find_requirements(prediction, goal_name, parsed_plan.sampling_rate)
    result = make_plan_result(
        prediction,
        parsed_plan.sampling_rate,
        total_time,
        _run_attitudes(campaign, design),
        _start_times(campaign, design, search.limits),
    )
    result = result.model_copy(
        update={
            "goal": parsed_plan.goal.with_efficiency(
                optimum.efficiency if search.has_bound else None
            ),
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
    parsed_plan = read_reading_plan(where, file)
    result, readings = ReadingSearch(parsed_plan).find_plan()
    document = format_document(parsed_plan.campaign_document(readings), _COMMENTS)
    return PlannedCampaign(result, document, load_plan(where), file)


def _round_to_targets(search: Search, design: Design) -> tuple[Design, Forecast]:
    """Return the rounded plan and its forecast, which meets the targets."""
    goal = search.plan.goal
    if goal.kind == "minimise":
        rounded_design = search.round_design(design)
        return rounded_design, forecast(search.campaign(rounded_design))
    targets = goal.sizes
    for _ in range(_MAX_CHANGES):
        new_design = search.lengthen_to_targets(design, targets)
        if new_design is None:
            break
        prediction = forecast(search.campaign(new_design))
        u_ratios = {name: prediction.u[name] / target for name, target in goal.sizes.items()}
        if max(u_ratios.values()) <= 1.0:
            return new_design, prediction
        # With a random walk, the search and the forecast differ by a few 1e-5.
        targets = {
            name: target * min(1.0, 0.99999 / u_ratios[name]) for name, target in targets.items()
        }
    raise unreachable_target_error(search)


_COMMENTS: Final = {
    "simulation": (
        "The following section is only for `counterspin simulate`. A calibration ignores it."
    )
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
    UsageError
        If an argument is not greater than zero.
    """
    for argument, value in (("sampling_rate", sampling_rate), ("revolutions", revolutions)):
        if value is not None and not value > 0.0:
            raise UsageError(f"`{argument}`", ["must be greater than zero"])
    campaign = add_pose_noise(read_campaign(where))
    runs_without_duration = [run for run in campaign.runs if run.duration is None]
    if revolutions is not None:
        durations = {
            run.name: 2.0 * math.pi * revolutions / abs(run.rate) for run in runs_without_duration
        }
        runs = tuple(
            run.model_copy(update={"duration": durations.get(run.name, run.duration)})
            for run in campaign.runs
        )
        campaign = replace(campaign, runs=runs)
    sampling_rates: float | Mapping[str, float] | None = sampling_rate
    if revolutions is None and needs_records(campaign, sampling_rate):
        campaign, recorded_rates = apply_records(campaign)
        if sampling_rate is None:
            # Requirements use the sampling rate of the slowest recorder.
            sampling_rates, sampling_rate = recorded_rates, min(recorded_rates.values())
    prediction = forecast(campaign, sampling_rate=sampling_rates)
    if sampling_rate is None and campaign.simulation is not None:
        sampling_rate = campaign.simulation.sampling_rate
    attitudes = {run.name: describe_attitude(run.attitude) for run in campaign.runs}
    total_time = sum(run.duration or 0.0 for run in campaign.runs)
    result = make_plan_result(prediction, sampling_rate, total_time, attitudes, None)
    symbol = "K_II" if "K_II" in campaign.model.terms else campaign.model.terms[0]
    name = f"{next(iter(campaign.accelerometers))}.{symbol}"
    basis: str = ""
    requirements: list[Requirement] = []
    if sampling_rate is not None and not campaign.readings:
        basis, requirements = _find_requirements(prediction, name, sampling_rate)
    warnings = [
        f"{run.name}: counterspin assumes {revolutions:g} revolutions, because the campaign "
        "does not state the length of the record."
        for run in (runs_without_duration if revolutions is not None else ())
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


def write_campaign(planned_campaign: PlannedCampaign, folder: Path) -> Path:
    """Write the campaign's description into a folder."""
    target = require_no_campaign(folder)
    make_folder(folder)
    write_text(target, planned_campaign.document)
    return target


#: What an example plans: records of a double turntable, or poses of a triad.
Example = Literal["records", "poses"]


def write_example(file: Path, example: Example = "records") -> Path:
    """Write a commented plan to start from; raises as `write_campaign` does."""
    if file.exists():
        raise ExistingFileError(f"{file} already exists; edit it, or choose another name")
    starter_name = "starter.toml" if example == "records" else f"starter_{example}.toml"
    write_text(file, (files("counterspin.planning") / starter_name).read_text("utf-8"))
    return file


def _run_attitudes(campaign: Campaign, design: Design) -> dict[str, str]:
    return {
        run.name: run_type.attitude
        for run, run_type in zip(campaign.runs, design.types, strict=True)
    }


def _start_times(campaign: Campaign, design: Design, limits: Limits) -> dict[str, float]:
    """Return the start time of each record, after spin-up, spin-down and settling."""
    time, starts = 0.0, {}
    previous_attitude = None
    overhead = limits.overhead(design.rate)
    for index, run in enumerate(campaign.runs):
        attitude = design.types[index].attitude
        if previous_attitude is not None and attitude != previous_attitude:
            time += limits.attitude_change
        previous_attitude = attitude
        time += float(overhead[index])
        starts[run.name] = time
        time += float(design.duration[index])
    return starts


def _find_requirements(
    prediction: Forecast, name: str, sampling_rate: float
) -> tuple[str, list[Requirement]]:
    if prediction.campaign.angle is None:
        return "", []  # the rotation is an unknown then
    return fault_requirements(prediction, name, sampling_rate)


def _alternative_plans(
    search: Search, design: Design, prediction: Forecast, total_time: float
) -> list[OtherPlan]:
    """Return plans for three rates as in the paper, equally spaced rates, and half of the time.

    Half of the time applies only to plans that minimise u.
    """
    half_time_limits = replace(search.limits, total_time=0.5 * total_time)
    half_time_design = None
    if search.plan.goal.kind == "minimise" and half_time_limits.is_feasible:
        # No time may remain for a record.
        with suppress(NotIdentifiableError):
            start = search.minimise_u(half_time_limits).design
            half_time_design = search.round_design(search.order_runs(start), half_time_limits)
    plans = []
    for text, alternative_design in (
        (
            (
                "plan of the paper: 1/4, 1/2 and 1 times the highest rate, with equal numbers of "
                "revolutions"
            ),
            search.three_rate_design(design, total_time),
        ),
        ("equally spaced rates, equal durations", search.even_rate_design(design, total_time)),
        ("best plan in half the time", half_time_design),
    ):
        if alternative_design is None:
            continue
        u = forecast(search.campaign(alternative_design)).u
        time = search.limits.campaign_time(alternative_design)
        label = f"{text} ({len(alternative_design.types)} runs)"
        plans.append(compare_plan(label, time, prediction.u, u, search.plan.goal.sizes))
    return plans
