"""`counterspin history`: a coefficient of each instrument through all its results."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import replace
from datetime import datetime
from itertools import combinations
from pathlib import Path

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.result import Result
from counterspin.campaign.validation import suggest_name
from counterspin.errors import CampaignError, CounterspinError, UsageError
from counterspin.histories.consistency import (
    MAX_YEARS,
    YEAR,
    Drift,
    Mean,
    en_score,
    find_shared_inputs,
    fit_drift,
    individuals_chart,
    next_due_date,
    repeatability,
    weighted_mean,
)
from counterspin.histories.files import (
    TRIAD_QUANTITIES,
    DatedResult,
    ResultSet,
    collect_results,
    term_of,
)
from counterspin.histories.result import (
    Due,
    History,
    InstrumentHistory,
    LaboratoryPair,
    Point,
    SpecificationLimits,
    Trend,
    UnusedResult,
    Verdict,
)
from counterspin.inference.diagnostics import SIGNIFICANCE
from counterspin.input import describe_argument, to_path
from counterspin.physics.terms import SHARED_TERMS, TERMS
from counterspin.results import unsealed_sentences
from counterspin.threads import single_blas_thread


@single_blas_thread()
def history(
    paths: Sequence[Path | str | Result],
    *,
    term: str = "K_II",
    serial: str | None = None,
    reliability: float = 0.95,
) -> History:
    """Collect the results of each instrument, oldest first.

    Parameters
    ----------
    paths
        Results, their files, and folders in which all are found.
    term
        Symbol of the coefficient; or ``offset``, ``sensitivity`` or ``angle`` of triads.
    serial
        Serial number of the instrument, as its accelerometers or its campaigns state it; None
        takes all.
    reliability
        Probability with which it is to be in specification until it is due again.

    Returns
    -------
    History
        In g-units of the latest result's gravity.

    Raises
    ------
    CampaignError
        If a path does not exist, the term is unknown, or no result is of this serial number.
    CounterspinError
        If no result can be used; the reasons are given.
    """
    if not 0.5 < reliability < 1.0:
        raise UsageError("`reliability`", [f"{reliability} is not between 0.5 and 1"])
    if term not in TERMS and term not in TRIAD_QUANTITIES:
        raise CampaignError("`term`", [_unknown_term_message(term)], code="unknown-term")
    if isinstance(paths, str | os.PathLike | Result) or not isinstance(paths, Iterable):
        raise TypeError(
            f"give a list of results, their files or folders, not {describe_argument(paths)}"
        )
    inputs = [
        p if isinstance(p, Result) else to_path(p, "results, their files or folders") for p in paths
    ]
    collected = collect_results(inputs, term)
    _remove_duplicates(collected)
    if not collected.records:
        raise CounterspinError(_no_results_message(paths, collected), code="no-results")
    gravity = max(collected.records, key=lambda record: (record.date, record.file)).gravity
    by_serial: dict[str, list[DatedResult]] = {}
    for record in sorted(collected.records, key=lambda record: (record.date, record.file)):
        if serial in (None, record.serial_number, record.campaign_serial_number):
            by_serial.setdefault(record.serial_number, []).append(record)
    if not by_serial:
        known = {record.serial_number for record in collected.records}
        raise CampaignError(
            "`serial`",
            [
                f"no result has the serial number "
                f'"{serial}"{suggest_name(str(serial), sorted(known))}'
            ],
            code="no-results",
        )
    return History(
        term=term,
        unit=term_of(term).unit,
        gravity=gravity,
        converted=any(record.gravity != gravity for record in collected.records),
        instruments=[
            _instrument_history([_convert_gravity(gravity, r, term) for r in records], reliability)
            for _, records in sorted(by_serial.items())
        ],
        left_out=collected.left_out,
        damaged=collected.damaged,
        passed_over=collected.passed_over,
        notes=[*unsealed_sentences(collected.unsealed), *_shared_record_notes(by_serial)],
    )


# Selection of results


def _unknown_term_message(term: str) -> str:
    if term in SHARED_TERMS:
        return f'"{term}" is a machine term; a history tracks an accelerometer term'
    kind, _, owner = term.partition(".")
    if owner and kind in TRIAD_QUANTITIES:
        return (
            f'"{term}" is a parameter of a triad; "{kind}" tracks this parameter for all '
            "accelerometers of the triad"
        )
    return f'unknown term "{term}"{suggest_name(term, [*TERMS, *TRIAD_QUANTITIES])}'


def _remove_duplicates(collected: ResultSet) -> None:
    """Keep one result of the same records and accelerometer: a measurement counts once.

    A result of the joint method takes precedence, then the first one read.
    """
    unique: dict[tuple[str, str, frozenset[str]], DatedResult] = {}
    for record in sorted(collected.records, key=lambda record: record.method != "joint"):
        # Without checksums, the input files of the result are unknown.
        key = (record.serial_number, record.accelerometer, record.records or {record.file})
        first = unique.setdefault((*key[:2], frozenset(key[2])), record)
        if first is not record:
            collected.records.remove(record)
            collected.left_out.append(
                UnusedResult(
                    file=record.file,
                    accelerometer=record.accelerometer,
                    reason=f"the result uses the same records as {first.file}",
                )
            )


def _no_results_message(paths: Sequence[Path | str | Result], collected: ResultSet) -> str:
    places = ", ".join("memory" if isinstance(p, Result) else str(p) for p in paths)
    unused = [*collected.damaged, *collected.left_out]
    if not unused:
        return f"{places} contains no results. Write a result with `write_result`" + (
            f" ({len(collected.passed_over)} other JSON files)" if collected.passed_over else ""
        )
    names_by_reason: dict[str, list[str]] = {}
    for item in unused[:5]:
        name = f"{item.accelerometer} of {item.file}" if item.accelerometer else item.file
        names_by_reason.setdefault(item.reason, []).append(name)
    reasons = "; ".join(
        f"{', '.join(names)}: {reason}" for reason, names in names_by_reason.items()
    )
    more = f"; and {len(unused) - 5} more" if len(unused) > 5 else ""
    return f"no usable results: {reasons}{more}"


def _shared_record_notes(by_serial: dict[str, list[DatedResult]]) -> list[str]:
    """Return a note for each pair of results that share records and are not independent."""
    notes = []
    for serial, records in by_serial.items():
        for i, later in enumerate(records):
            for earlier in records[:i]:
                if common := len(earlier.records & later.records):
                    notes.append(
                        f"{serial}: {later.file} shares {common} of {len(later.records)} "
                        f"records with {earlier.file}, so the two results are not independent."
                    )
    return notes


# From results to a history


def _convert_gravity(gravity: float, record: DatedResult, term: str) -> DatedResult:
    """Return the record in g-units of another gravity.

    A coefficient of n factors is in g/g^n, and so proportional to g^(1 - n).
    """
    factor = (record.gravity / gravity) ** (1 - len(term_of(term).effect.factors))
    limits = record.limits
    if limits is not None:
        low, high = (None if end is None else end * factor for end in limits[:2])
        limits = (low, high, limits[2])
    return replace(
        record,
        value=record.value * factor,
        u=record.u * factor,
        gravity=gravity,
        shared={key: moved * factor for key, moved in record.shared.items()},
        limits=limits,
    )


def _instrument_history(records: Sequence[DatedResult], reliability: float) -> InstrumentHistory:
    values, u = [record.value for record in records], [record.u for record in records]
    common = find_shared_inputs(u, [record.shared for record in records])
    covariance = None if common is None else common.covariance
    mean = weighted_mean(values, u, covariance)
    start = records[0].date
    line = fit_drift([(record.date - start) / YEAR for record in records], values, u, covariance)
    verdict = _verdict(mean, line)
    return InstrumentHistory(
        serial_number=records[0].serial_number,
        # The accelerometer's serial number takes precedence over the campaign's.
        stated_by=min(record.stated_by for record in records),
        points=[_make_point(i, records, mean, covariance) for i in range(len(records))],
        mean=mean.value,
        u_mean=mean.u,
        scatter=mean.scatter,
        drift=None if line is None else _make_trend(line, start),
        verdict=verdict,
        shared=[] if common is None else list(common.names),
        correlation=None if common is None else common.largest,
        control=individuals_chart(values, [record.file for record in records]),
        specification=_latest_specification(records),
        due=_due_date(records, line, verdict, reliability),
        repeatability=repeatability(records, covariance, drifts=verdict == "drifts"),
        laboratories=_compare_laboratories(records, covariance),
    )


def _latest_specification(records: Sequence[DatedResult]) -> SpecificationLimits | None:
    """Return the specification of the latest result that has one."""
    for record in reversed(records):
        if record.limits is not None:
            low, high, words = record.limits
            return SpecificationLimits(low=low, high=high, words=words)
    return None


def _due_date(
    records: Sequence[DatedResult], line: Drift | None, verdict: Verdict, reliability: float
) -> Due:
    limits = _latest_specification(records)
    if limits is None:
        reason = "none of the results states a specification"
    elif line is None:
        reason = "a straight line requires results of at least two dates"
    elif verdict in {"differ", "disagree"}:
        reason = (
            "the results are not consistent with a straight line, so they cannot be extrapolated"
        )
    else:
        ends = (limits.low, limits.high)
        date = next_due_date(line, records[0].date, records[-1].date, ends, reliability)
        if date is not None:
            return Due(date=date.date().isoformat(), reliability=reliability)
        reason = (
            f"the straight line stays within the specification for {MAX_YEARS:g} years; set a "
            "recalibration interval"
        )
    return Due(date=None, reliability=reliability, reason=reason)


def _compare_laboratories(
    records: Sequence[DatedResult], covariance: Array | None
) -> list[LaboratoryPair]:
    """Compare the weighted means of all pairs of laboratories."""
    u = np.array([record.u for record in records])
    full_covariance = np.diag(u**2) if covariance is None else covariance
    values = np.array([record.value for record in records])
    weights_by_name: dict[str, tuple[Array, float | None]] = {}
    for name in dict.fromkeys(record.laboratory for record in records):
        if name is None:
            continue
        indices = [i for i, record in enumerate(records) if record.laboratory == name]
        weights = np.zeros(len(records))
        weights[indices] = np.linalg.solve(
            full_covariance[np.ix_(indices, indices)], np.ones(len(indices))
        )
        dofs = [dof for i in indices if (dof := records[i].dof) is not None]
        weights_by_name[name] = weights / weights.sum(), min(dofs, default=None)
    pairs = []
    for (first, (first_weights, dof)), (second, (second_weights, other_dof)) in combinations(
        weights_by_name.items(), 2
    ):
        means = [
            (float(w @ values), float(np.sqrt(w @ full_covariance @ w)), d)
            for w, d in ((first_weights, dof), (second_weights, other_dof))
        ]
        pairs.append(
            LaboratoryPair(
                first=first,
                second=second,
                difference=means[1][0] - means[0][0],
                e_n=en_score(
                    means[0], means[1], float(first_weights @ full_covariance @ second_weights)
                ),
            )
        )
    return pairs


def _make_point(
    index: int, records: Sequence[DatedResult], mean: Mean, covariance: Array | None
) -> Point:
    record = records[index]
    alone, z = len(records) == 1, float(mean.z[index])
    before = records[index - 1] if index else None
    return Point(
        date=_format_date(record.date),
        file=record.file,
        accelerometer=record.accelerometer,
        method=record.method,
        value=record.value,
        u=record.u,
        dof=record.dof,
        difference=None if alone else float(mean.difference[index]),
        z=z if math.isfinite(z) else None,
        e_n=None
        if before is None
        else en_score(
            (before.value, before.u, before.dof),
            (record.value, record.u, record.dof),
            0.0 if covariance is None else float(covariance[index - 1, index]),
        ),
        laboratory=record.laboratory,
        mounting=record.mounting,
        turn_on=record.turn_on,
    )


def _format_date(date: datetime) -> str:
    """Format a date, with the time of day if it has one."""
    return (date.date() if date.time() == datetime.min.time() else date).isoformat()


def _make_trend(line: Drift, start: datetime) -> Trend:
    return Trend(
        value=line.slope,
        u=line.u,
        p=line.p,
        date=(start + line.time * YEAR).date().isoformat(),
        level=line.value,
        u_level=line.u_value,
        scatter=line.scatter,
    )


def _verdict(mean: Mean, line: Drift | None) -> Verdict:
    if mean.scatter.p is None:
        return "single"
    agree = mean.scatter.p >= SIGNIFICANCE
    if line is None or line.p >= SIGNIFICANCE:
        return "constant" if agree else "disagree"
    if line.scatter.p is None:
        return "differ"
    return "drifts" if line.scatter.p >= SIGNIFICANCE else "disagree"
