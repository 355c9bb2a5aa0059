"""Checks across several tables of ``campaign.toml``: each check names the sections that it needs.

A check runs if these sections are valid, whatever else is wrong, and all mistakes are reported
together. `counterspin.campaign.resolution` defines the sections.
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
from counterspin.campaign.field_types import parse_exact
from counterspin.campaign.frequency_response import response_problems
from counterspin.campaign.model import ErrorModel
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.reading import Reading
from counterspin.campaign.runs import Run, is_reading
from counterspin.campaign.settings import OBSERVABLES, CentrifugeSettings, NoiseSettings
from counterspin.campaign.terms import shown_symbols
from counterspin.campaign.validation import Problems
from counterspin.errors import Problem
from counterspin.physics.conditions import STATED_CONDITIONS
from counterspin.physics.effects import AttitudeError, TrajectoryError
from counterspin.physics.terms import CONDITION_TERMS, LEVER_ARM, SHARED_TERMS, affects_readings

#: Key path and message of each mistake.
Mistakes = Iterator[tuple[KeyPath, str]]

#: Entries of ``[[runs]]`` that are not excluded, with their indices.
IndexedRuns = Sequence[tuple[int, Any]]

_CHECKS: Final[dict[Callable[..., Mistakes], tuple[str, ...]]] = {}

#: Largest absolute table ratio for which a frequency response covers the harmonics of the force.
_MAX_RATIO_WITH_RESPONSE: Final = 2

_NAME_PATTERN: Final = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")


def register_check(function: Callable[..., Mistakes]) -> Callable[..., Mistakes]:
    """Register a check; its parameter names are the sections that it needs."""
    _CHECKS[function] = tuple(signature(function).parameters)
    return function


def run_checks(sections: Mapping[str, Any], problems: Problems) -> None:
    """Report the mistakes found by all checks whose sections are valid.

    sections: Name -> valid section of a description; None if the table is missing.
    """
    for function, names in _CHECKS.items():
        if sections.keys() >= set(names):
            for path, message in function(*(sections[name] for name in names)):
                problems.add(path, message)


@register_check
def _missing_sections(
    document: Mapping[str, Any], indexed_runs: IndexedRuns, valid_readings: Sequence[Reading]
) -> Mistakes:
    """Yield sections that the present ones need."""
    entries = [entry for _, entry in indexed_runs]
    has_records = any(not is_reading(entry) or "record" in entry for entry in entries)
    machine_free_motions = ("static", "vibration")
    needs_centrifuge = any(
        reading.motion not in machine_free_motions for reading in valid_readings
    ) or any(
        not isinstance(entry, dict) or entry.get("motion") not in machine_free_motions
        for entry in entries
    )
    for key, is_needed in (("centrifuge", needs_centrifuge), ("records", has_records)):
        if (is_needed or not (entries or "readings" in document)) and key not in document:
            yield (key,), Problem("is missing", "missing-key")


@register_check
def _missing_runs(document: Mapping[str, Any], indexed_runs: IndexedRuns) -> Mistakes:
    if not indexed_runs and "readings" not in document:
        message = "must have at least one entry" if "runs" in document else "is missing"
        message = "are all excluded by skip = true" if list_of(document, "runs") else message
        yield ("runs",), Problem(message, "missing-key")


@register_check
def _repeated_names_and_files(document: Mapping[str, Any], indexed_runs: IndexedRuns) -> Mistakes:
    """Yield names and files that two runs use; runs may use different parts of one file."""
    index_by_name: dict[str, int] = {}
    index_by_file: dict[str, int] = {}
    runs_by_record: dict[str, list[Mapping[str, Any]]] = {}
    for _, entry in indexed_runs:
        if isinstance(entry, dict) and isinstance(entry.get("record"), str):
            runs_by_record.setdefault(entry["record"], []).append(entry)
    records = table_of(document, "records")
    for index, entry in indexed_runs:
        if not isinstance(entry, dict):
            continue
        yield from _check_unique(entry.get("name"), index_by_name, ("runs", index, "name"))
        for key, file in _list_files(entry):
            runs_with_file = runs_by_record.get(file, []) if isinstance(file, str) else []
            if not _is_disjoint(entry, runs_with_file, records):
                yield from _check_unique(file, index_by_file, ("runs", index, key))


def _check_unique(value: Any, index_by_value: dict[str, int], path: KeyPath) -> Mistakes:
    index = path[1]
    assert isinstance(index, int)
    if isinstance(value, str) and index_by_value.setdefault(value, index) != index:
        message = f'runs[{index_by_value[value]}] already uses "{value}"'
        yield path, Problem(message, "duplicate-entry")


def _list_files(entry: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Return the files that a run names, with their keys."""
    continuations = entry.get("continued_in")
    continuation_entries = [
        ("continued_in", name)
        for name in (continuations if isinstance(continuations, list) else [])
    ]
    return [("record", entry.get("record")), *continuation_entries, ("pulses", entry.get("pulses"))]


def _is_disjoint(
    entry: Mapping[str, Any],
    runs_with_file: Sequence[Mapping[str, Any]],
    records: Mapping[str, Any],
) -> bool:
    """Return whether no other run uses the same part of a file.

    runs_with_file: Runs whose record is the file.
    """
    selection = _table_selection(entry, records)
    other_runs = [run for run in runs_with_file if run is not entry]
    runs_with_table = (
        run
        for run in other_runs
        if not _are_different_tables(selection, _table_selection(run, records))
    )
    if "start" not in entry and "stop" not in entry:
        return bool(other_runs) and next(runs_with_table, None) is None
    range_start, range_stop = _time_range(entry)
    return bool(other_runs) and all(
        range_stop <= start or stop <= range_start
        for start, stop in map(_time_range, runs_with_table)
    )


def _table_selection(entry: Mapping[str, Any], records: Mapping[str, Any]) -> list[Any]:
    """Return sheet and group of a run's record; None: the only one."""
    run_section = entry.get("records")
    settings = {**records, **run_section} if isinstance(run_section, Mapping) else records
    return [settings.get("sheet"), settings.get("group")]


def _are_different_tables(first: Sequence[Any], second: Sequence[Any]) -> bool:
    return any(
        first_value is not None and second_value is not None and first_value != second_value
        for first_value, second_value in zip(first, second, strict=True)
    )


def _time_range(entry: Mapping[str, Any]) -> tuple[float, float]:
    """Return the stated time range of a run's record, s; infinite if it is missing or invalid."""
    try:
        start = parse_exact(entry["start"], "s") if "start" in entry else -math.inf
        stop = parse_exact(entry["stop"], "s") if "stop" in entry else math.inf
    except ValueError:
        return -math.inf, math.inf
    return start, stop


@register_check
def _conflicting_clocks(runs: Mapping[int, Run]) -> Mistakes:
    """Yield recorders for which two runs state different clocks."""
    clock_by_recorder: dict[str, tuple[str, Quantity | None]] = {}
    for run in runs.values():
        if run.recording is not None and run.recording.recorder:
            name_and_clock = run.name, run.recording.clock
            first_name, clock = clock_by_recorder.setdefault(run.recording.recorder, name_and_clock)
            if clock != run.recording.clock:
                message = (
                    f'state different clocks for the recorder "{run.recording.recorder}"; state '
                    "only one clock"
                )
                yield ("runs",), f'"{first_name}" and "{run.name}" {message}'


@register_check
def _unusable_table_ratio(
    runs: Mapping[int, Run],
    centrifuge: CentrifugeSettings | None,
    records: RecordsSettings | None,
    observables: Mapping[str, str],
    accelerometers: Mapping[str, Accelerometer],
) -> Mistakes:
    """Yield table ratios whose requirements the campaign does not meet."""
    for index, run in runs.items():
        if not run.turns_in_space:
            continue
        path = ("runs", index, "table_ratio")
        reason = "rotates the instrument in space"
        if centrifuge is not None and not centrifuge.strapped:
            yield path, f"{reason} with the table; write strapped = true in [centrifuge]"
        other_observables = sorted(
            {name for name in observables.values() if name != "specific_force"}
        )
        if other_observables:
            yield (
                path,
                f"{reason}; record specific_force, because {' or '.join(other_observables)} "
                "along a rotating axis is not evaluated",
            )
        has_response = any(
            accelerometer.response is not None for accelerometer in accelerometers.values()
        )
        if has_response and abs(run.table_ratio) > _MAX_RATIO_WITH_RESPONSE:
            yield (
                path,
                f"is larger than {_MAX_RATIO_WITH_RESPONSE}; counterspin does not calculate "
                "the frequency response at such high harmonics of the force",
            )
        recording = run.recording or records
        if recording is not None and recording.angle is None:
            yield path, f"{reason}; record the angle of the spindle ([records] angle)"


@register_check
def _misplaced_lever_arm(model: ErrorModel, runs: Mapping[int, Run]) -> Mistakes:
    """Yield the lever arm if it is requested, or if no table turns in space."""
    symbols_by_key = {"terms": model.terms, "hold": model.considered, "priors": tuple(model.priors)}
    has_turning_table = any(run.turns_in_space for run in runs.values())
    for key, symbols in symbols_by_key.items():
        if LEVER_ARM not in symbols:
            continue
        if not has_turning_table:
            reason = "affects only runs with a table_ratio other than -1; omit it"
            yield ("model", key), f'"{LEVER_ARM}" {reason}'
        elif key == "terms":
            reason = "is always estimated in addition to the requested terms; omit it"
            yield ("model", key), f'"{LEVER_ARM}" {reason}'


@register_check
def _truth_without_simulation(document: Mapping[str, Any], runs: Mapping[int, Run]) -> Mistakes:
    for index, run in runs.items():
        if run.truth is not None and not {"simulation", "truth"} & document.keys():
            yield ("runs", index, "truth"), "requires [simulation] or [truth]"


@register_check
def _low_frequencies(
    accelerometers: Mapping[str, Accelerometer], runs: Mapping[int, Run]
) -> Mistakes:
    """Yield stated frequencies that are too low for the rotation."""
    max_rate = max((abs(run.rate) for run in runs.values()), default=0.0)
    for name, accelerometer in accelerometers.items():
        if accelerometer.response is not None:
            for section, key, message in response_problems(accelerometer.response, max_rate):
                path = (section, key) if section == "records" else (section, name, key)
                yield path, message


@register_check
def _invalid_accelerometer_names(tables: Mapping[str, Any]) -> Mistakes:
    """Yield names that conflict with tables of [truth], or that TOML would quote."""
    for name in tables:
        if name in TRUTH_TABLES or not _NAME_PATTERN.fullmatch(name):
            message = (
                "cannot be the name of an accelerometer; use letters, digits, - and _, but not "
                "one of the names"
            )
            message += f" {', '.join(TRUTH_TABLES)}"
            yield ("accelerometers", name), Problem(message, "invalid-name")


@register_check
def _repeated_columns(
    records: RecordsSettings | None, accelerometers: Mapping[str, Accelerometer]
) -> Mistakes:
    """Yield columns that are used twice."""
    if records is None:
        return
    key_by_column = {records.time.column or "": "records.time"}
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
        if column in key_by_column:
            message = f'column "{column}" is already used by {key_by_column[column]}'
            yield tuple(key.split(".")), Problem(message, "duplicate-entry")
        key_by_column[column] = key


@register_check
def _invalid_noise_record(noise: NoiseSettings | None, indexed_runs: IndexedRuns) -> Mistakes:
    entries = [entry for _, entry in indexed_runs]
    if noise is not None and noise.rest is not None:
        if all(map(is_reading, entries)):
            yield ("noise", "from"), "applies only to records, but no run has a record"
        if noise.rest in [entry.get("record") for entry in entries if isinstance(entry, dict)]:
            yield ("noise", "from"), "is the record of a run, not a record at rest"


@register_check
def _unused_noise(noise: NoiseSettings | None, observables: Mapping[str, str]) -> Mistakes:
    for key in OBSERVABLES if noise and observables else ():
        if key not in observables.values() and getattr(noise, key) != 0.0:
            yield ("noise", key), f"no accelerometer has {key} records"


@register_check
def _encoder_without_angle(model: ErrorModel, records: RecordsSettings | None) -> Mistakes:
    """Yield encoder terms if no angle is recorded."""
    for key, symbols in (("terms", model.terms), ("hold", model.considered)):
        if (
            records
            and not records.angle
            and any(symbol.startswith("encoder.") for symbol in symbols)
        ):
            yield ("model", key), "contains encoder errors, but no angle is recorded"


@register_check
def _terms_without_effect(
    model: ErrorModel,
    indexed_runs: IndexedRuns,
    valid_readings: Sequence[Reading],
    centrifuge: CentrifugeSettings | None,
) -> Mistakes:
    """Yield named terms that affect neither a record nor a reading of the campaign."""
    has_records = any(not is_reading(entry) for _, entry in indexed_runs)
    is_strapped = centrifuge is not None and centrifuge.strapped
    symbols_by_key = {"terms": model.terms, "hold": model.considered, "priors": tuple(model.priors)}
    for key, symbols in symbols_by_key.items():
        for symbol in symbols:
            row = SHARED_TERMS.get(symbol)
            if row is None or symbol in shown_symbols(valid_readings):
                continue
            if reason := _explain_missing_effect(row.effect, is_strapped):
                yield ("model", key), f'"{symbol}" {reason}'
            elif not (has_records or key == "priors" or affects_readings(symbol)):
                reason = (
                    "affects only records from a double turntable, but no run uses one; omit this "
                    "term"
                )
                yield ("model", key), f'"{symbol}" {reason}'


def _explain_missing_effect(effect: AttitudeError | TrajectoryError, is_strapped: bool) -> str:
    """Explain why a term affects no record of the double turntable; empty if it may."""
    if effect.part == "table" and not is_strapped:
        return (
            "is an error of the counter-rotating table; if the accelerometers are strapped to the "
            "table, add strapped = true to [centrifuge]; otherwise, omit this term"
        )
    if effect.part == "gyros" and is_strapped:
        return (
            "is an error of the platform gyros; accelerometers strapped to the table (strapped = "
            "true in [centrifuge]) have no gyros; omit this term"
        )
    return ""


@register_check
def _missing_conditions(
    model: ErrorModel,
    runs: Mapping[int, Run],
    recorded_temperatures: set[str],
    centrifuge: CentrifugeSettings | None,
) -> Mistakes:
    """Yield missing conditions of the slopes in a model, and slopes that cannot be determined."""
    reference = centrifuge and centrifuge.reference_temperature
    symbols = {*model.terms, *model.considered}
    rows = [row for symbol, row in CONDITION_TERMS.items() if symbol in symbols]
    for key in STATED_CONDITIONS:
        condition_keys = (key, "direction") if key == "temperature" else (key,)
        symbol = next((row.symbol for row in rows if row.effect.condition in condition_keys), None)
        runs_with_record = recorded_temperatures if key == "temperature" else ()
        stated_flags = [
            getattr(run, key) is not None or run.name in runs_with_record for run in runs.values()
        ]
        if symbol is None and (key != "time" or not any(stated_flags)):
            continue
        reason = f"{symbol} is in the model" if symbol else "other runs state this value"
        (example,) = Run.model_fields[key].examples or ("",)
        for index, is_stated in zip(runs, stated_flags, strict=True):
            if not is_stated:
                message = f'is missing: {reason}; write for example {key} = "{example}"'
                yield ("runs", index, key), Problem(message, "missing-key")
        if runs_with_record or reference is not None or not runs or not all(stated_flags):
            continue
        if symbol and key == "temperature":
            temperatures = {value for run in runs.values() for value in run.temperature or ()}
            if len(temperatures) == 1:
                yield (
                    ("centrifuge", "reference_temperature"),
                    f"is missing: {symbol} is in the model, but all runs are at the same "
                    "temperature",
                )
