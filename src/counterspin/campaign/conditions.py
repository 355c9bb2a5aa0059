"""Under which conditions runs were made: how warm, and when."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Final

from counterspin.campaign.checking import Problems
from counterspin.campaign.error_model import ErrorModel
from counterspin.campaign.readings import Reading
from counterspin.campaign.resolved import Campaign, Run
from counterspin.frozen import frozen
from counterspin.physics.effects import RunConditions
from counterspin.physics.terms import CONDITION_TERMS

#: By how much it is assumed to become warmer in a campaign that records no temperature, K.
UNKNOWN_WARMING: Final = 1.0


@frozen
class Origin:
    """From where the campaign's temperatures (K) and times (s) count."""

    temperature: float
    time: float


def check_conditions(
    model: ErrorModel,
    also: Iterable[str],
    runs: Sequence[tuple[int, Run]],
    reference: float | None,
    problems: Problems,
) -> None:
    """Note what is missing for the slopes of a model, and slopes that nothing determines.

    reference: The reference temperature, K, if there is one.
    """
    for symbol, row in CONDITION_TERMS.items():
        if row.effect.condition == "force" and symbol in model.terms:
            problems.add(
                ("model", "terms"),
                f'"{symbol}" cannot be told from K_II; state what is known of it in [model.priors]',
            )
    used = [row for s, row in CONDITION_TERMS.items() if s in {*model.terms, *model.considered}]
    used += [row for s, row in CONDITION_TERMS.items() if s in set(also)]
    for key in ("temperature", "time"):
        asking = next((row.symbol for row in used if row.effect.condition == key), None)
        stated = [getattr(run, key) is not None for _, run in runs]
        if asking is None and (key == "temperature" or not any(stated)):
            continue
        why = f"{asking} is in the model" if asking else "other runs state theirs"
        for (place, _), there in zip(runs, stated, strict=True):
            if not there:
                example = '"23.4 degC"' if key == "temperature" else '"12 min"'
                problems.add(
                    ("runs", place, key), f"is missing: {why}; write {key} = {example}, or the like"
                )
        if asking and key == "temperature" and reference is None and runs and all(stated):
            temperatures = {run.temperature for _, run in runs}
            if len(temperatures) == 1:
                problems.add(
                    ("centrifuge", "reference_temperature"),
                    f"is missing: {asking} is in the model, and all runs are at one temperature",
                )


def origin_of(campaign: Campaign) -> Origin:
    """Return the reference temperature, or the mean of all; and the time of what came first."""
    dated: list[Run | Reading] = [*campaign.runs, *campaign.readings]
    warmths = [one.temperature for one in dated if one.temperature is not None]
    temperature = campaign.reference_temperature
    if temperature is None:
        temperature = sum(warmths) / len(warmths) if warmths else 0.0
    time = min((one.time for one in dated if one.time is not None), default=0.0)
    return Origin(temperature, time)


def conditions_of(
    campaign: Campaign, lengths: Mapping[str, float] | None = None
) -> dict[str, RunConditions]:
    """Return the conditions of every run with a record.

    Where the runs do not say when they were made, they count as made one after the other, without
    a pause: the least that a trend can have done between them. Where none of them says how warm it
    was, it counts as having become warmer from run to run, by `UNKNOWN_WARMING` from the first to
    the last.

    lengths: Run -> length of its record, s; those that are not there are taken from the
        description.
    """
    origin = origin_of(campaign)
    conditions, elapsed = {}, 0.0
    for run in campaign.runs:
        start = elapsed if run.time is None else run.time - origin.time
        warmth = 0.0 if run.temperature is None else run.temperature - origin.temperature
        conditions[run.name] = RunConditions(start, warmth)
        elapsed += (lengths or {}).get(run.name, run.duration or 0.0)
    if all(run.temperature is None for run in campaign.runs):
        return _warming(conditions)
    return conditions


def _warming(conditions: Mapping[str, RunConditions]) -> dict[str, RunConditions]:
    """Return conditions with temperatures that nobody took: the same step from run to run."""
    last = len(conditions) - 1
    if last < 1:
        return dict(conditions)
    return {
        name: replace(of_run, warmth=UNKNOWN_WARMING * (place / last - 0.5))
        for place, (name, of_run) in enumerate(conditions.items())
    }
