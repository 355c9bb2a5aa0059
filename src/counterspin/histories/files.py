"""Result files: search, dates, serial numbers and tracked values."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, Literal

from counterspin.calibration.findings import judge_result, refusal_reason
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import Coefficient, NominalOutput
from counterspin.comparability import source_value
from counterspin.errors import CampaignError, RecordError, describe_read_error
from counterspin.frozen import frozen
from counterspin.histories.result import UnusedResult
from counterspin.inference.joint.summary import BudgetLine
from counterspin.inference.verdicts import Conformity
from counterspin.input import parse_json, read_file
from counterspin.physics.effects import SpecificForceProduct
from counterspin.physics.terms import TERMS, Term, is_term, term

#: Input of the campaign in a budget -> key of its value in the result.
_INPUT_FIELDS: Final = {
    "site.gravity": "gravity",
    "site.latitude": "latitude",
    "centrifuge.radius": "radius",
}

#: Scopes of terms that vary between the runs, readings or fixtures of one machine.
_RUN_SCOPES: Final = ("run", "reading", "mounting", "position")

#: Largest sum of squared contributions of a budget, relative to u^2: 1, except for rounding.
_MAX_BUDGET_SUM: Final = 1.01

#: Parameter of triads -> a term with the same unit and number of specific forces.
TRIAD_PARAMETERS: Final = {"offset": "K_F", "sensitivity": "K_I", "angle": "delta_O"}


@frozen
class TrackedValue:
    """Value of the tracked quantity in a result."""

    accelerometers: tuple[str, ...]  #: Names of the accelerometers; an angle has two.
    coefficient: Coefficient | None  #: None if the result does not contain the quantity.
    budget: Sequence[BudgetLine]  #: Uncertainty budget of the coefficient.
    conformity: Conformity | None  #: Conformity; None without a specification.


def equivalent_term(quantity: str) -> Term[SpecificForceProduct]:
    """Return the term of a quantity; for a parameter of triads, a term with the same unit."""
    return TERMS[TRIAD_PARAMETERS.get(quantity, quantity)]


def tracked_values(result: Result, quantity: str) -> Iterator[TrackedValue]:
    """Yield the values of a term for each accelerometer, or of a parameter of the triad.

    Angles are given minus 90 deg.
    """
    if quantity not in TRIAD_PARAMETERS:
        for name, accelerometer in result.accelerometers.items():
            coefficient = accelerometer.coefficients.get(quantity)
            lines = accelerometer.budget.get(quantity, ())
            conformity = accelerometer.conformity.get(quantity)
            yield TrackedValue((name,), coefficient, lines, conformity)
        return
    triad = result.triad
    if triad is None:
        for name in result.accelerometers:
            yield TrackedValue((name,), None, (), None)
        return
    for parameter, triad_coefficient in triad.parameters.items():
        parameter_type, *names = parameter.split(".")
        if parameter_type != quantity or not set(names) <= set(triad.accelerometers):
            continue
        coefficient = triad_coefficient
        if parameter_type == "angle" and coefficient.value is not None:
            coefficient = coefficient.model_copy(
                update={"value": coefficient.value - 0.5 * math.pi}
            )
        bias_conformity = result.accelerometers[names[0]].conformity.get("K_F")
        conformity = bias_conformity if parameter_type == "offset" else None
        yield TrackedValue(tuple(names), coefficient, triad.budget.get(parameter, ()), conformity)


#: Keys of every result of any schema; JSON files without them are not results.
_RESULT_KEYS: Final = {"method", "accelerometers", "provenance"}

_HIDDEN_FILE_REASON: Final = "this hidden file was left by an interrupted command; delete it"

_SUMMARY_FILE_REASON: Final = (
    "this file is a summary of several campaigns; write a separate result file for each campaign"
)


@frozen
class DatedResult:
    """Tracked value of one accelerometer in a result, with its date."""

    #: As in `counterspin.histories.result.InstrumentHistory`.
    serial_number: str
    stated_by: Literal["accelerometer", "campaign"]
    campaign_serial_number: str | None  #: Serial number in the campaign, or None.
    date: datetime  #: Date without a time zone; converted to UTC if the campaign states a zone.
    file: str  #: Path of the result's file.
    #: Name of the accelerometer in the result; method of the result.
    accelerometer: str
    method: str
    #: Estimate in the unit of the term, in g-units of `gravity`.
    value: float
    u: float
    dof: float | None
    gravity: float  #: m/s^2.
    record_checksums: frozenset[str]  #: Checksums of the record files.
    #: Shifts by sources that other results may share, see `source_shifts`.
    source_shifts: dict[tuple[str, str], float] = field(default_factory=dict)
    #: Lower limit, upper limit and text of the specification; None without a specification.
    limits: tuple[float | None, float | None, str] | None = None
    #: Conditions that the campaign states.
    laboratory: str | None = None
    mounting: str | None = None
    turn_on: str | None = None
    nominal: NominalOutput | None = None  #: Nominal output of which `value` is a multiple.


@dataclass
class ResultSet:
    """Usable results, and files and results that are not used, each with the reason."""

    records: list[DatedResult] = field(default_factory=list)
    omitted_results: list[UnusedResult] = field(default_factory=list)
    damaged_files: list[UnusedResult] = field(default_factory=list)
    ignored_files: list[str] = field(default_factory=list)
    unsealed_results: list[str] = field(default_factory=list)  #: Results without a seal.


def collect_results(inputs: Sequence[Path | Result], term: str) -> ResultSet:
    """Read results of any schema from named files and folders."""
    paths = [path for path in inputs if isinstance(path, Path)]
    missing_paths = [str(path) for path in paths if not path.exists()]
    if len(missing_paths) == 1:
        raise CampaignError(missing_paths[0], ["file not found"], code="file-not-found")
    if missing_paths:
        problems = [f"{name}: file not found" for name in missing_paths]
        raise CampaignError("history", problems, code="file-not-found")
    result_set, path_by_checksum = ResultSet(), dict[str, str]()
    for file, is_named in _iter_files(paths):
        if not is_named and file.name.startswith("."):
            result_set.omitted_results.append(
                UnusedResult(file=str(file), reason=_HIDDEN_FILE_REASON)
            )
            continue
        try:
            content = read_file(file)
        except OSError as error:
            result_set.damaged_files.append(
                UnusedResult(file=str(file), reason=describe_read_error(error))
            )
            continue
        if not is_named and (reason := _non_result_reason(content)):
            if reason == _SUMMARY_FILE_REASON:
                result_set.omitted_results.append(UnusedResult(file=str(file), reason=reason))
            else:
                result_set.ignored_files.append(str(file))
            continue
        first_path = path_by_checksum.setdefault(hashlib.sha256(content).hexdigest(), str(file))
        if first_path != str(file):
            result_set.omitted_results.append(
                UnusedResult(file=str(file), reason=f"this file is the same as {first_path}")
            )
        else:
            _add_file(file, term, result_set)
    for number, result in enumerate(inputs, 1):
        if isinstance(result, Result):
            name = f"result {number}" + (f" ({result.title})" if result.title else "")
            _add_result(judge_result(result), name, term, result_set)
    return result_set


def _iter_files(paths: Sequence[Path]) -> Iterator[tuple[Path, bool]]:
    """Yield each file once, and whether it was named explicitly."""
    visited_paths = set()
    for path in paths:
        files = sorted(_json_files(path)) if path.is_dir() else [path]
        for file in files:
            if file.is_dir() or file.resolve() in visited_paths:
                continue
            visited_paths.add(file.resolve())
            yield file, not path.is_dir()


def _json_files(folder: Path) -> Iterator[Path]:
    """Yield the JSON files of a folder and its subfolders, except hidden ones."""
    for file in folder.rglob("*.json"):
        if not any(part.startswith(".") for part in file.relative_to(folder).parts[:-1]):
            yield file


def _non_result_reason(content: bytes) -> str | None:
    """Return the reason why a JSON document is not a result; None if it may be one."""
    try:
        document = parse_json(content)
    except ValueError:
        return None
    if not isinstance(document, dict):
        return "other"
    if "campaigns" in document:
        return _SUMMARY_FILE_REASON
    return None if set(document) >= _RESULT_KEYS else "other"


def _add_file(file: Path, term: str, result_set: ResultSet) -> None:
    try:
        result = judge_result(Result.read(file))
    except RecordError as error:
        reason = str(error).removeprefix(str(file)).lstrip(": ")
        result_set.damaged_files.append(UnusedResult(file=str(file), reason=reason))
        return
    _add_result(result, str(file), term, result_set)


def _add_result(result: Result, file: str, term: str, result_set: ResultSet) -> None:
    date = _parse_date(result.details.get("date"))
    if not result.sealed:
        result_set.unsealed_results.append(file)
    for tracked_value in tracked_values(result, term):
        record_or_reason = _make_dated_result(result, tracked_value, term, file, date)
        if isinstance(record_or_reason, str):
            names = ", ".join(tracked_value.accelerometers)
            result_set.omitted_results.append(
                UnusedResult(file=file, accelerometer=names, reason=record_or_reason)
            )
        else:
            result_set.records.append(record_or_reason)


def _make_dated_result(
    result: Result, tracked_value: TrackedValue, term: str, file: str, date: datetime | str
) -> DatedResult | str:
    """Return the dated result, or the reason why it is unusable."""
    names, coefficient = tracked_value.accelerometers, tracked_value.coefficient
    campaign_serial = result.details.get("serial_number")
    serial_numbers = [result.accelerometers[name].serial_number for name in names]
    uses_campaign_serial = None in serial_numbers
    if coefficient is None:
        return f"the result has no {term}"
    if not coefficient.estimated or coefficient.value is None or not coefficient.u:
        return f"the result does not determine {term}"
    if (unusable_reason := _unusable_reason(result, names)) is not None:
        return unusable_reason
    if uses_campaign_serial and campaign_serial is None:
        return (
            "the result has no serial number; state the serial number in [accelerometers] or "
            "[campaign]"
        )
    if isinstance(date, str):
        return date
    identifiers = [campaign_serial, *names] if uses_campaign_serial else serial_numbers
    return DatedResult(
        serial_number=" ".join(map(str, identifiers)),
        stated_by="campaign" if uses_campaign_serial else "accelerometer",
        campaign_serial_number=campaign_serial,
        date=date,
        file=file,
        accelerometer=", ".join(names),
        method=result.method,
        value=coefficient.value,
        u=coefficient.u,
        dof=coefficient.dof,
        gravity=result.inputs.gravity,
        record_checksums=frozenset(
            checksum
            for input_file, checksum in result.provenance.inputs.items()
            if not input_file.endswith(".toml") and checksum.startswith("sha256:")
        ),
        source_shifts=source_shifts(result, coefficient.u, tracked_value.budget, names[0]),
        limits=_specification_limits(tracked_value.conformity),
        laboratory=result.details.get("laboratory"),
        mounting=result.details.get("mounting"),
        turn_on=result.details.get("turn_on"),
        nominal=None if term in TRIAD_PARAMETERS else result.accelerometers[names[0]].nominal,
    )


def _specification_limits(
    conformity: Conformity | None,
) -> tuple[float | None, float | None, str] | None:
    return (
        None if conformity is None else (conformity.low, conformity.high, conformity.specification)
    )


def _unusable_reason(result: Result, names: Sequence[str]) -> str | None:
    """Return the reason why a result is unusable, or None."""
    if result.model == "as-printed":
        return (
            "the result was computed with the equations as printed, which yield half the true K_II"
        )
    for name in names:
        if refusal_reason(result, [name]) is not None:
            return (
                f"the records contradict the result: {result.accelerometers[name].findings[0].text}"
            )
    return None


def _parse_date(text: str | None) -> datetime | str:
    """Parse the date of a campaign; return the reason if it is unusable."""
    if text is None:
        return "the result has no date; state the date in [campaign]"
    try:
        date = datetime.fromisoformat(text.strip())
    except ValueError:
        return f'the date of the result, "{text}", is not valid; use the form 2026-03-01'
    return date.astimezone(UTC).replace(tzinfo=None) if date.tzinfo else date


def source_shifts(
    result: Result, u: float, budget: Sequence[BudgetLine], name: str = ""
) -> dict[tuple[str, str], float]:
    """Return (source, identity) -> shift of the coefficient by sources that results may share.

    Two results share an input, or a term of the accelerometer, the platform or the machine, if
    its value and uncertainty, stated or default, are equal in both. A term of another
    accelerometer is shared only with the same serial number. Terms of a run or a mounting are not
    shared.

    u, budget: Standard uncertainty of the coefficient, and its budget.
    name: Name of the accelerometer, to find the values of its terms.
    """
    shifts: dict[tuple[str, str], float] = {}
    if sum(line.contribution**2 for line in budget) > _MAX_BUDGET_SUM * u**2:
        return shifts  # the budget does not belong to this u
    for line in budget:
        source = line.source
        if line.kind == "noise" or line.u is None or line.sensitivity is None:
            continue
        accelerometer_name, _, symbol = source.partition(".")
        if source in _INPUT_FIELDS:
            identity = f"{getattr(result.inputs, _INPUT_FIELDS[source])!r} ± {line.u!r}"
        elif is_term(source) and term(source).scope not in _RUN_SCOPES:
            identity = repr(line.u)
            if name in result.accelerometers and (value := source_value(result, name, source)):
                identity = f"{value!r} ± {identity}"  # another value is another measurement
        elif accelerometer_name in result.accelerometers and is_term(symbol):
            serial_number = result.accelerometers[accelerometer_name].serial_number
            identity = f"{line.u!r} of {serial_number or result.details.get('serial_number')}"
        else:
            continue
        shifts[source, identity] = line.sensitivity * line.u
    return shifts
