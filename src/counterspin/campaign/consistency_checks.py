"""Checks across several tables of ``campaign.toml``: each check names the parts that it needs.

A check runs whenever these parts are valid, whatever else is wrong, and all mistakes are reported
together. `counterspin.campaign.resolution` defines the parts.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from inspect import signature
from typing import Any, Final

from counterspin.campaign.accelerometers import TRUTH_TABLES, Accelerometer
from counterspin.campaign.columns import RecordsSettings
from counterspin.campaign.documents import KeyPath, list_of, table_of
from counterspin.campaign.field_types import exact
from counterspin.campaign.frequency_response import response_problems
from counterspin.campaign.model import ErrorModel
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.reading import Reading
from counterspin.campaign.runs import Run, is_reading
from counterspin.campaign.settings import OBSERVABLES, CentrifugeSettings, NoiseSettings
from counterspin.campaign.terms import symbols_shown
from counterspin.campaign.validation import Problems
from counterspin.errors import Problem
from counterspin.physics.conditions import STATED_CONDITIONS
from counterspin.physics.effects import AttitudeError, TrajectoryError
from counterspin.physics.terms import CONDITION_TERMS, LEVER_ARM, SHARED_TERMS, affects_readings

#: Where mistakes are, and what they are.
Mistakes = Iterator[tuple[KeyPath, str]]

#: Entries of ``[[runs]]`` that are not left out, with their places.
Listed = Sequence[tuple[int, Any]]

_CHECKS: Final[dict[Callable[..., Mistakes], tuple[str, ...]]] = {}

#: Largest size of a table ratio for which a frequency response covers the harmonics of the force.
_LARGEST_RATIO_WITH_RESPONSE: Final = 2

_NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")


def check(function: Callable[..., Mistakes]) -> Callable[..., Mistakes]:
    """Have a check run where the parts are in order that its arguments name."""
    _CHECKS[function] = tuple(signature(function).parameters)
    return function


def run_checks(parts: Mapping[str, Any], problems: Problems) -> None:
    """Note what every check finds whose parts are in order.

    parts: Those of a description that are in order, by name; None of a table that is not there.
    """
    for function, names in _CHECKS.items():
        if parts.keys() >= set(names):
            for path, words in function(*(parts[name] for name in names)):
                problems.add(path, words)


@check
def _missing_sections(
    document: Mapping[str, Any], listed: Listed, right_readings: Sequence[Reading]
) -> Mistakes:
    """Yield sections that the present ones need."""
    entries = [entry for _, entry in listed]
    recorded = any(not is_reading(entry) or "record" in entry for entry in entries)
    without_machine = ("static", "vibration")
    turning = any(reading.motion not in without_machine for reading in right_readings) or any(
        not isinstance(entry, dict) or entry.get("motion") not in without_machine
        for entry in entries
    )
    for key, needed in (("centrifuge", turning), ("records", recorded)):
        if (needed or not (entries or "readings" in document)) and key not in document:
            yield (key,), Problem("is missing", "missing-key")


@check
def _missing_runs(document: Mapping[str, Any], listed: Listed) -> Mistakes:
    if not listed and "readings" not in document:
        message = "must have at least one entry" if "runs" in document else "is missing"
        message = "are all excluded by skip = true" if list_of(document, "runs") else message
        yield ("runs",), Problem(message, "missing-key")


@check
def _repeated_names_and_files(document: Mapping[str, Any], listed: Listed) -> Mistakes:
    """Yield names of runs that are used twice, and files; of a file each part is one."""
    names: dict[str, int] = {}
    files: dict[str, int] = {}
    runs_by_record: dict[str, list[Mapping[str, Any]]] = {}
    for _, entry in listed:
        if isinstance(entry, dict) and isinstance(entry.get("record"), str):
            runs_by_record.setdefault(entry["record"], []).append(entry)
    records = table_of(document, "records")
    for index, entry in listed:
        if not isinstance(entry, dict):
            continue
        yield from _check_unique(entry.get("name"), names, ("runs", index, "name"))
        for key, file in _files(entry):
            sharing = runs_by_record.get(file, []) if isinstance(file, str) else []
            if not _is_disjoint(entry, sharing, records):
                yield from _check_unique(file, files, ("runs", index, key))


def _check_unique(value: Any, seen: dict[str, int], path: KeyPath) -> Mistakes:
    index = path[1]
    assert isinstance(index, int)
    if isinstance(value, str) and seen.setdefault(value, index) != index:
        message = f'"{value}" is already used by runs[{seen[value]}]'
        yield path, Problem(message, "duplicate-entry")


def _files(entry: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Return the files that a run names, with their keys."""
    continuations = entry.get("continued_in")
    names = [
        ("continued_in", name)
        for name in (continuations if isinstance(continuations, list) else [])
    ]
    return [("record", entry.get("record")), *names, ("pulses", entry.get("pulses"))]


def _is_disjoint(
    entry: Mapping[str, Any], sharing: Sequence[Mapping[str, Any]], records: Mapping[str, Any]
) -> bool:
    """Return whether a run uses another part of a file than all other runs that name the file.

    sharing: The runs whose record is the file.
    """
    selection = _table_selection(entry, records)
    other_runs = [run for run in sharing if run is not entry]
    sharing_table = (
        run
        for run in other_runs
        if not _are_different_tables(selection, _table_selection(run, records))
    )
    if "start" not in entry and "stop" not in entry:
        return bool(other_runs) and next(sharing_table, None) is None
    range_start, range_stop = _time_range(entry)
    return bool(other_runs) and all(
        range_stop <= start or stop <= range_start
        for start, stop in map(_time_range, sharing_table)
    )


def _table_selection(entry: Mapping[str, Any], records: Mapping[str, Any]) -> list[Any]:
    """Return the sheet and the group that are read of a run's record; None: the only one."""
    run_section = entry.get("records")
    stated = {**records, **run_section} if isinstance(run_section, Mapping) else records
    return [stated.get("sheet"), stated.get("group")]


def _are_different_tables(first: Sequence[Any], second: Sequence[Any]) -> bool:
    return any(
        a is not None and b is not None and a != b for a, b in zip(first, second, strict=True)
    )


def _time_range(entry: Mapping[str, Any]) -> tuple[float, float]:
    """Return the part of its record that a run states; all of it if it states none that is one."""
    try:
        start = exact(entry["start"], "s") if "start" in entry else -math.inf
        stop = exact(entry["stop"], "s") if "stop" in entry else math.inf
    except ValueError:
        return -math.inf, math.inf
    return start, stop


@check
def _conflicting_clocks(runs: Mapping[int, Run]) -> Mistakes:
    """Yield recorders of which two runs state two clocks."""
    clocks: dict[str, tuple[str, Quantity | None]] = {}
    for run in runs.values():
        if run.recording is not None and run.recording.recorder:
            name_and_clock = run.name, run.recording.clock
            first_name, clock = clocks.setdefault(run.recording.recorder, name_and_clock)
            if clock != run.recording.clock:
                message = (
                    f'state different clocks for the recorder "{run.recording.recorder}"; state '
                    "only one clock"
                )
                yield ("runs",), f'"{first_name}" and "{run.name}" {message}'


@check
def _unusable_table_ratio(
    runs: Mapping[int, Run],
    centrifuge: CentrifugeSettings | None,
    records: RecordsSettings | None,
    observables: Mapping[str, str],
    accelerometers: Mapping[str, Accelerometer],
) -> Mistakes:
    """Yield ratios of the table for which the campaign lacks what they need."""
    for place, run in runs.items():
        if not run.turns_in_space:
            continue
        path = ("runs", place, "table_ratio")
        turns = "turns the instrument in space"
        if centrifuge is not None and not centrifuge.strapped:
            yield path, f"{turns} with the table; write strapped = true in [centrifuge]"
        others = sorted({name for name in observables.values() if name != "specific_force"})
        if others:
            yield (
                path,
                f"{turns}; record specific_force, because {' or '.join(others)} along a "
                "rotating axis is not evaluated",
            )
        responds = any(a.response is not None for a in accelerometers.values())
        if responds and abs(run.table_ratio) > _LARGEST_RATIO_WITH_RESPONSE:
            yield (
                path,
                f"is larger than {_LARGEST_RATIO_WITH_RESPONSE}; counterspin does not calculate "
                "the frequency response for the harmonics of such a force",
            )
        recording = run.recording or records
        if recording is not None and recording.angle is None:
            yield path, f"{turns}; record the angle of the spindle ([records] angle)"


@check
def _misplaced_lever_arm(model: ErrorModel, runs: Mapping[int, Run]) -> Mistakes:
    """Yield the lever arm where it is requested, or where no table turns in space."""
    symbols_by_key = {"terms": model.terms, "hold": model.considered, "priors": tuple(model.priors)}
    turns = any(run.turns_in_space for run in runs.values())
    for key, symbols in symbols_by_key.items():
        if LEVER_ARM not in symbols:
            continue
        if not turns:
            reason = "affects only runs with a table_ratio other than -1; omit it"
            yield ("model", key), f'"{LEVER_ARM}" {reason}'
        elif key == "terms":
            reason = "is always estimated in addition to the requested terms; omit it"
            yield ("model", key), f'"{LEVER_ARM}" {reason}'


@check
def _truth_without_simulation(document: Mapping[str, Any], runs: Mapping[int, Run]) -> Mistakes:
    for place, run in runs.items():
        if run.truth is not None and not {"simulation", "truth"} & document.keys():
            yield ("runs", place, "truth"), "requires [simulation] or [truth]"


@check
def _frequency_responses(
    accelerometers: Mapping[str, Accelerometer], runs: Mapping[int, Run]
) -> Mistakes:
    """Yield stated frequencies that are too low for the rotation."""
    fastest = max((abs(run.rate) for run in runs.values()), default=0.0)
    for name, accelerometer in accelerometers.items():
        if accelerometer.response is not None:
            for section, key, message in response_problems(accelerometer.response, fastest):
                path = (section, key) if section == "records" else (section, name, key)
                yield path, message


@check
def _names_of_accelerometers(tables: Mapping[str, Any]) -> Mistakes:
    """Yield names that [truth] could not tell from its other tables, or TOML would quote."""
    for name in tables:
        if name in TRUTH_TABLES or not _NAME.fullmatch(name):
            message = (
                "cannot be the name of an accelerometer; use letters, digits, - and _, but none of"
            )
            message += f" {', '.join(TRUTH_TABLES)}"
            yield ("accelerometers", name), Problem(message, "invalid-name")


@check
def _repeated_columns(
    records: RecordsSettings | None, accelerometers: Mapping[str, Accelerometer]
) -> Mistakes:
    """Yield columns that are used twice."""
    if records is None:
        return
    seen = {records.time.column or "": "records.time"}
    columns_by_key = {
        f"records.{key}": channel.column
        for key, channel in (("angle", records.angle), ("temperature", records.temperature))
        if channel
    }
    columns_by_key |= {
        f"accelerometers.{item.name}.{item.observable}": item.channel.name
        for item in accelerometers.values()
    }
    for key, column in columns_by_key.items():
        if column in seen:
            message = f'column "{column}" is already used by {seen[column]}'
            yield tuple(key.split(".")), Problem(message, "duplicate-entry")
        seen[column] = key


@check
def _invalid_noise_record(noise: NoiseSettings | None, listed: Listed) -> Mistakes:
    entries = [entry for _, entry in listed]
    if noise is not None and noise.rest is not None:
        if all(map(is_reading, entries)):
            yield ("noise", "from"), "applies only to records, but no run has a record"
        if noise.rest in [entry.get("record") for entry in entries if isinstance(entry, dict)]:
            yield ("noise", "from"), "is the record of a run, not a record at rest"


@check
def _unused_noise(noise: NoiseSettings | None, observables: Mapping[str, str]) -> Mistakes:
    for key in OBSERVABLES if noise and observables else ():
        if key not in observables.values() and getattr(noise, key) != 0.0:
            yield ("noise", key), f"no accelerometer has {key} records"


@check
def _encoder_without_angle(model: ErrorModel, records: RecordsSettings | None) -> Mistakes:
    """Yield terms of an encoder that records nothing."""
    for key, symbols in (("terms", model.terms), ("hold", model.considered)):
        if records and not records.angle and any(s.startswith("encoder.") for s in symbols):
            yield ("model", key), "contains encoder errors, but no angle is recorded"


@check
def _terms_that_cannot_act(
    model: ErrorModel,
    listed: Listed,
    right_readings: Sequence[Reading],
    centrifuge: CentrifugeSettings | None,
) -> Mistakes:
    """Yield named terms that neither a record nor a reading of the campaign can show."""
    recorded = any(not is_reading(entry) for _, entry in listed)
    strapped = centrifuge is not None and centrifuge.strapped
    symbols_by_key = {"terms": model.terms, "hold": model.considered, "priors": tuple(model.priors)}
    for key, symbols in symbols_by_key.items():
        for symbol in symbols:
            row = SHARED_TERMS.get(symbol)
            if row is None or symbol in symbols_shown(right_readings):
                continue
            if reason := _reason_without_effect(row.effect, strapped):
                yield ("model", key), f'"{symbol}" {reason}'
            elif not (recorded or key == "priors" or affects_readings(symbol)):
                reason = (
                    "affects only records from a double turntable, but no run uses one; omit this "
                    "term"
                )
                yield ("model", key), f'"{symbol}" {reason}'


def _reason_without_effect(effect: AttitudeError | TrajectoryError, strapped: bool) -> str:
    """Return why a term acts on no record of the double turntable; empty if it may act."""
    if effect.part == "table" and not strapped:
        return (
            "is an error of the counter-rotating table; if the accelerometers are strapped to the "
            "table, add strapped = true to [centrifuge], otherwise omit this term"
        )
    if effect.part == "gyros" and strapped:
        return (
            "is an error of the platform gyros; accelerometers strapped to the table (strapped = "
            "true in [centrifuge]) have no gyros; omit this term"
        )
    return ""


@check
def _missing_conditions(
    model: ErrorModel,
    runs: Mapping[int, Run],
    recorded_temperatures: set[str],
    centrifuge: CentrifugeSettings | None,
) -> Mistakes:
    """Yield what is missing for the slopes of a model, and slopes that nothing determines."""
    reference = centrifuge and centrifuge.reference_temperature
    used = [
        row
        for symbol, row in CONDITION_TERMS.items()
        if symbol in {*model.terms, *model.considered}
    ]
    for key in STATED_CONDITIONS:
        conditions = (key, "direction") if key == "temperature" else (key,)
        term_symbol = next((row.symbol for row in used if row.effect.condition in conditions), None)
        recorded_runs = recorded_temperatures if key == "temperature" else ()
        stated = [
            getattr(run, key) is not None or run.name in recorded_runs for run in runs.values()
        ]
        if term_symbol is None and (key != "time" or not any(stated)):
            continue
        reason = f"{term_symbol} is in the model" if term_symbol else "other runs state this value"
        (example,) = Run.model_fields[key].examples or ("",)
        for index, is_stated in zip(runs, stated, strict=True):
            if not is_stated:
                message = f'is missing: {reason}; write for example {key} = "{example}"'
                yield ("runs", index, key), Problem(message, "missing-key")
        if recorded_runs or reference is not None or not runs or not all(stated):
            continue
        if term_symbol and key == "temperature":
            temperatures = {
                temperature for run in runs.values() for temperature in run.temperature or ()
            }
            if len(temperatures) == 1:
                yield (
                    ("centrifuge", "reference_temperature"),
                    f"is missing: {term_symbol} is in the model, but all runs are at the same "
                    "temperature",
                )
