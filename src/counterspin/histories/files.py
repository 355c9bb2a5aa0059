"""Result files, their instruments and dates, and the followed value of each."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, Literal

from counterspin.calibration.findings import judge_result, refusal
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import Coefficient
from counterspin.errors import CampaignError, RecordError
from counterspin.frozen import frozen
from counterspin.histories.result import UnusedResult
from counterspin.inference.joint.summary import BudgetLine
from counterspin.inference.verdicts import Conformity
from counterspin.input import parse_json, read_file
from counterspin.physics.effects import Product
from counterspin.physics.terms import TERMS, Term, is_term, term

#: Common sources in a budget: an input of the campaign -> the key of its value in the result.
_INPUTS: Final = {
    "site.gravity": "gravity",
    "site.latitude": "latitude",
    "centrifuge.radius": "radius",
}

#: Scopes of terms that differ between the runs, readings or fixtures of one machine.
_RANDOM: Final = ("run", "reading", "mounting", "position")

#: The parts of a budget do not exceed u^2, except for rounding.
_MAX_BUDGET_SUM: Final = 1.01

#: Kind of a triad's parameter -> a term of its unit, and of as many specific forces.
KINDS: Final = {"offset": "K_F", "sensitivity": "K_I", "angle": "delta_O"}


@frozen
class FollowedValue:
    """The followed value in a result."""

    accelerometers: tuple[str, ...]  #: Whose it is: an angle is that of two.
    coefficient: Coefficient | None  #: None where the result has none.
    budget: Sequence[BudgetLine]  #: Of it.
    conformity: Conformity | None  #: With its specification; None without one.


def term_like(followed: str) -> Term[Product]:
    """Return the term that is followed, or one in the unit of a parameter that is."""
    return TERMS[KINDS.get(followed, followed)]


def followed_in(result: Result, followed: str) -> Iterator[FollowedValue]:
    """Yield a term of each accelerometer of a result, or a parameter of its triad.

    Angles are given minus 90 deg.
    """
    if followed not in KINDS:
        for name, accelerometer in result.accelerometers.items():
            coefficient = accelerometer.coefficients.get(followed)
            lines, judged = (
                accelerometer.budget.get(followed, ()),
                accelerometer.conformity.get(followed),
            )
            yield FollowedValue((name,), coefficient, lines, judged)
        return
    triad = result.triad
    if triad is None:
        for name in result.accelerometers:
            yield FollowedValue((name,), None, (), None)
        return
    for parameter, c in triad.parameters.items():
        kind, *names = parameter.split(".")
        if kind != followed or not set(names) <= set(triad.accelerometers):
            continue
        if kind == "angle" and c.value is not None:
            c = c.model_copy(update={"value": c.value - 0.5 * math.pi})  # noqa: PLW2901
        of_bias = result.accelerometers[names[0]].conformity.get("K_F")
        judged = of_bias if kind == "offset" else None
        yield FollowedValue(tuple(names), c, triad.budget.get(parameter, ()), judged)


#: Keys of every result, whatever its schema; other JSON files in a folder are not results.
_RESULT_KEYS: Final = {"method", "accelerometers", "provenance"}

_HIDDEN_REASON: Final = "is a hidden file left by an interrupted command; delete it"

_SUMMARY_REASON: Final = "is a summary of several campaigns; write a result for each"


@frozen
class DatedResult:
    """The followed value of one accelerometer in a result, with its date."""

    #: As in `counterspin.histories.result.InstrumentHistory`.
    serial_number: str
    stated_by: Literal["accelerometer", "campaign"]
    campaign_serial_number: str | None  #: What the campaign states, or None.
    date: datetime  #: Without a zone; UTC where one is stated.
    file: str  #: As it was found.
    #: Its name there; the result's method.
    accelerometer: str
    method: str
    #: In the term's unit, in g-units of `gravity`.
    value: float
    u: float
    dof: float | None
    gravity: float  #: m/s^2.
    records: frozenset[str]  #: Checksums of the record files that it rests on.
    #: As of `shared_sources`.
    shared: dict[tuple[str, str], float] = field(default_factory=dict)
    #: Specification: lower and upper limit, and its words; None without one.
    limits: tuple[float | None, float | None, str] | None = None
    #: As the campaign states them.
    laboratory: str | None = None
    mounting: str | None = None
    turn_on: str | None = None


@dataclass
class CollectedResults:
    """The contents of the files; the parts as in `counterspin.histories.result.History`."""

    records: list[DatedResult] = field(default_factory=list)
    left_out: list[UnusedResult] = field(default_factory=list)
    damaged: list[UnusedResult] = field(default_factory=list)
    passed_over: list[str] = field(default_factory=list)
    unsealed: list[str] = field(default_factory=list)  #: Names of the results without a seal.


def collect(given: Sequence[Path | Result], term: str) -> CollectedResults:
    """Read all results that are named or lie in the folders named, whatever their schema."""
    paths = [path for path in given if isinstance(path, Path)]
    missing = [f"{path}: no such file or folder" for path in paths if not path.exists()]
    if missing:
        raise CampaignError("history", missing)
    collected, seen = CollectedResults(), dict[str, str]()
    for file, named in _files(paths):
        if not named and file.name.startswith("."):
            collected.left_out.append(UnusedResult(file=str(file), reason=_HIDDEN_REASON))
            continue
        try:
            content = read_file(file)
        except OSError as error:
            collected.damaged.append(
                UnusedResult(file=str(file), reason=f"cannot be read ({error.strerror})")
            )
            continue
        if not named and (reason := _reason_not_a_result(content)):
            if reason == _SUMMARY_REASON:
                collected.left_out.append(UnusedResult(file=str(file), reason=reason))
            else:
                collected.passed_over.append(str(file))
            continue
        first = seen.setdefault(hashlib.sha256(content).hexdigest(), str(file))
        if first != str(file):
            collected.left_out.append(
                UnusedResult(file=str(file), reason=f"the same file as {first}")
            )
        else:
            _enter(file, term, collected)
    for place, result in enumerate(given, 1):
        if isinstance(result, Result):
            name = f"result {place}" + (f" ({result.title})" if result.title else "")
            _enter_result(judge_result(result), name, term, collected)
    return collected


def _files(paths: Sequence[Path]) -> Iterator[tuple[Path, bool]]:
    """Yield each file once, and whether it was named itself."""
    seen = set()
    for path in paths:
        inside = sorted(_results_inside(path)) if path.is_dir() else [path]
        for file in inside:
            if file.is_dir() or file.resolve() in seen:
                continue
            seen.add(file.resolve())
            yield file, not path.is_dir()


def _results_inside(folder: Path) -> Iterator[Path]:
    """Yield the JSON files of a folder and of its subfolders, without those that are hidden."""
    for file in folder.rglob("*.json"):
        if not any(part.startswith(".") for part in file.relative_to(folder).parts[:-1]):
            yield file


def _reason_not_a_result(content: bytes) -> str | None:
    """Return the reason against a readable document as a result; a damaged one may be one."""
    try:
        document = parse_json(content)
    except ValueError:
        return None
    if not isinstance(document, dict):
        return "other"
    if "campaigns" in document:
        return _SUMMARY_REASON
    return None if set(document) >= _RESULT_KEYS else "other"


def _enter(file: Path, term: str, collected: CollectedResults) -> None:
    try:
        result = judge_result(Result.read(file))
    except RecordError as error:
        reason = str(error).removeprefix(f"{file}: ")
        collected.damaged.append(UnusedResult(file=str(file), reason=reason))
        return
    _enter_result(result, str(file), term, collected)


def _enter_result(result: Result, file: str, term: str, collected: CollectedResults) -> None:
    date = _date(result.details.get("date"))
    if not result.sealed:
        collected.unsealed.append(file)
    for value in followed_in(result, term):
        outcome = _record(result, value, term, file, date)
        if isinstance(outcome, str):
            names = ", ".join(value.accelerometers)
            collected.left_out.append(UnusedResult(file=file, accelerometer=names, reason=outcome))
        else:
            collected.records.append(outcome)


def _record(
    result: Result, followed: FollowedValue, term: str, file: str, date: datetime | str
) -> DatedResult | str:
    """Return a record, or the reason for its absence."""
    names, coefficient = followed.accelerometers, followed.coefficient
    campaign_serial = result.details.get("serial_number")
    serial_numbers = [result.accelerometers[name].serial_number for name in names]
    by_campaign = None in serial_numbers
    if coefficient is None:
        return f"has no {term}"
    if not coefficient.estimated or coefficient.value is None or not coefficient.u:
        return f"does not determine {term}"
    if (wrong := _reason_unusable(result, names)) is not None:
        return wrong
    if by_campaign and campaign_serial is None:
        return "has no serial number; state it in [accelerometers] or [campaign]"
    if isinstance(date, str):
        return date
    stated = [campaign_serial, *names] if by_campaign else serial_numbers
    return DatedResult(
        serial_number=" ".join(map(str, stated)),
        stated_by="campaign" if by_campaign else "accelerometer",
        campaign_serial_number=campaign_serial,
        date=date,
        file=file,
        accelerometer=", ".join(names),
        method=result.method,
        value=coefficient.value,
        u=coefficient.u,
        dof=coefficient.dof,
        gravity=result.inputs.gravity,
        records=frozenset(
            checksum
            for input_file, checksum in result.provenance.inputs.items()
            if not input_file.endswith(".toml") and checksum.startswith("sha256:")
        ),
        shared=shared_sources(result, coefficient.u, followed.budget),
        limits=_limits(followed.conformity),
        laboratory=result.details.get("laboratory"),
        mounting=result.details.get("mounting"),
        turn_on=result.details.get("turn_on"),
    )


def _limits(stated: Conformity | None) -> tuple[float | None, float | None, str] | None:
    return None if stated is None else (stated.low, stated.high, stated.specification)


def _reason_unusable(result: Result, names: Sequence[str]) -> str | None:
    """Return the reason against any use of a result, or None."""
    if result.model == "as-printed":
        return "comes from the equations as printed, which return half the true K_II"
    for name in names:
        if refusal(result, [name]) is not None:
            return f"its records contradict it: {result.accelerometers[name].findings[0].text}"
    return None


def _date(text: str | None) -> datetime | str:
    """Return a campaign's date, or the reason for its absence."""
    if text is None:
        return "has no date; state it in [campaign]"
    try:
        date = datetime.fromisoformat(text.strip())
    except ValueError:
        return f'its date "{text}" cannot be read; write it as 2026-03-01'
    return date.astimezone(UTC).replace(tzinfo=None) if date.tzinfo else date


def shared_sources(
    result: Result, u: float, lines: Sequence[BudgetLine]
) -> dict[tuple[str, str], float]:
    """Return the shift of the coefficient by each source that another result may share.

    Two results share an input if both have the same value and uncertainty of it, and a term of the
    accelerometer, the platform or the machine if both have the same uncertainty, stated or not: it
    is then taken to be the same measurement, or the same lack of one. That of another accelerometer
    must be of the same one. What belongs to a run or to a mounting is not shared.

    u, lines: Of the coefficient, and its budget.
    """
    shifts: dict[tuple[str, str], float] = {}
    if sum(line.contribution**2 for line in lines) > _MAX_BUDGET_SUM * u**2:
        return shifts  # a budget of another uncertainty
    for line in lines:
        source = line.source
        if line.kind == "noise" or line.u is None or line.sensitivity is None:
            continue
        owner, _, symbol = source.partition(".")
        if source in _INPUTS:
            identity = f"{getattr(result.inputs, _INPUTS[source])!r} ± {line.u!r}"
        elif is_term(source) and term(source).scope not in _RANDOM:
            identity = repr(line.u)
        elif owner in result.accelerometers and is_term(symbol):
            whose = result.accelerometers[owner].serial_number
            identity = f"{line.u!r} of {whose or result.details.get('serial_number')}"
        else:
            continue
        shifts[source, identity] = line.sensitivity * line.u
    return shifts
