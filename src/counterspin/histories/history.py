"""`counterspin history`: a coefficient in all results of each instrument."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from datetime import datetime
from itertools import combinations
from pathlib import Path

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.result import Result
from counterspin.campaign.validation import suggest_name
from counterspin.comparability import (
    are_different,
    g_units_ratio,
    is_instrument_source,
    output_conversion,
)
from counterspin.errors import CampaignError, CounterspinError, UsageError
from counterspin.histories.consistency import (
    MAX_YEARS,
    YEAR,
    Drift,
    Mean,
    en_score,
    evaluate_repeatability,
    find_shared_inputs,
    fit_drift,
    individuals_chart,
    next_due_date,
    weighted_mean,
)
from counterspin.histories.files import (
    TRIAD_PARAMETERS,
    DatedResult,
    ResultSet,
    collect_results,
    equivalent_term,
)
from counterspin.histories.result import (
    DueDate,
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
    """Collect and evaluate the results of each instrument, oldest first.

    Parameters
    ----------
    paths
        Results, result files, and folders that are searched for result files.
    term
        Symbol of the coefficient; for triads ``offset``, ``sensitivity`` or ``angle``.
    serial
        Serial number of the instrument, stated for the accelerometer or the campaign; None: all
        instruments.
    reliability
        Required probability that the instrument is in specification until the due date.

    Returns
    -------
    History
        Values in g-units of the gravity of the latest result.

    Raises
    ------
    CampaignError
        If a path does not exist, the term is unknown, or no result has the serial number.
    CounterspinError
        If no result can be used; the message gives the reasons.
    """
    if not 0.5 < reliability < 1.0:
        raise UsageError("`reliability`", [f"{reliability} is not between 0.5 and 1"])
    if term not in TERMS and term not in TRIAD_PARAMETERS:
        raise CampaignError("`term`", [_unknown_term_message(term)], code="unknown-term")
    if isinstance(paths, str | os.PathLike | Result) or not isinstance(paths, Iterable):
        raise TypeError(
            f"give a list of results, their files or folders, not {describe_argument(paths)}"
        )
    inputs = [
        path if isinstance(path, Result) else to_path(path, "results, their files or folders")
        for path in paths
    ]
    result_set = collect_results(inputs, term)
    _remove_duplicate_results(result_set)
    if not result_set.records:
        raise CounterspinError(_no_results_message(paths, result_set), code="no-results")
    gravity = max(result_set.records, key=_date_and_file).gravity
    records_by_serial: dict[str, list[DatedResult]] = {}
    for record in sorted(result_set.records, key=_date_and_file):
        if serial in (None, record.serial_number, record.campaign_serial_number):
            records_by_serial.setdefault(record.serial_number, []).append(record)
    if not records_by_serial:
        serial_numbers = {record.serial_number for record in result_set.records}
        raise CampaignError(
            "`serial`",
            [
                f"no result has the serial number "
                f'"{serial}"{suggest_name(str(serial), sorted(serial_numbers))}'
            ],
            code="no-results",
        )
    return History(
        term=term,
        unit=equivalent_term(term).unit,
        gravity=gravity,
        converted=any(record.gravity != gravity for record in result_set.records),
        instruments=[
            _make_instrument_history(
                [_convert_units(record, records[-1], gravity, term) for record in records],
                reliability,
            )
            for _, records in sorted(records_by_serial.items())
        ],
        left_out=result_set.omitted_results,
        damaged=result_set.damaged_files,
        passed_over=result_set.ignored_files,
        notes=[
            *unsealed_sentences(result_set.unsealed_results),
            *_shared_record_notes(records_by_serial),
            *_output_notes(records_by_serial),
        ],
    )


# Selection of results


def _unknown_term_message(term: str) -> str:
    if term in SHARED_TERMS:
        return f'"{term}" is a machine term; a history tracks only accelerometer terms'
    parameter_type, _, accelerometer_names = term.partition(".")
    if accelerometer_names and parameter_type in TRIAD_PARAMETERS:
        return (
            f'"{term}" is a parameter of a triad; use "{parameter_type}", which tracks it for '
            "all accelerometers of the triad"
        )
    return f'unknown term "{term}"{suggest_name(term, [*TERMS, *TRIAD_PARAMETERS])}'


def _remove_duplicate_results(result_set: ResultSet) -> None:
    """Keep one of several results from the same records and accelerometer.

    A result of the joint method takes precedence, then the first one read.
    """
    record_by_key: dict[tuple[str, str, frozenset[str]], DatedResult] = {}
    for record in sorted(result_set.records, key=lambda record: record.method != "joint"):
        # Without checksums, the input files of the result are unknown.
        key = (record.serial_number, record.accelerometer, record.record_checksums or {record.file})
        first_record = record_by_key.setdefault((*key[:2], frozenset(key[2])), record)
        if first_record is not record:
            result_set.records.remove(record)
            result_set.omitted_results.append(
                UnusedResult(
                    file=record.file,
                    accelerometer=record.accelerometer,
                    reason=f"the result uses the same records as {first_record.file}",
                )
            )


def _no_results_message(paths: Sequence[Path | str | Result], result_set: ResultSet) -> str:
    names = ["memory" if isinstance(path, Result) else str(path) for path in paths]
    inputs_text = ", ".join(names) or "`paths`"
    unused_results = [*result_set.damaged_files, *result_set.omitted_results]
    if not unused_results:
        return f"{inputs_text} contains no results. Write a result with `write_result`" + (
            f" (number of other JSON files: {len(result_set.ignored_files)})"
            if result_set.ignored_files
            else ""
        )
    names_by_reason: dict[str, list[str]] = {}
    for unused_result in unused_results[:5]:
        name = (
            f"{unused_result.accelerometer} of {unused_result.file}"
            if unused_result.accelerometer
            else unused_result.file
        )
        names_by_reason.setdefault(unused_result.reason, []).append(name)
    reasons_text = "; ".join(
        f"{', '.join(names)}: {reason}" for reason, names in names_by_reason.items()
    )
    remainder_text = f"; and {len(unused_results) - 5} more" if len(unused_results) > 5 else ""
    return f"no usable results: {reasons_text}{remainder_text}"


def _shared_record_notes(records_by_serial: dict[str, list[DatedResult]]) -> list[str]:
    """Return a note for each pair of results that share records and are not independent."""
    notes = []
    for serial, records in records_by_serial.items():
        for i, later_record in enumerate(records):
            for earlier_record in records[:i]:
                checksums = later_record.record_checksums
                if n_shared := len(checksums & earlier_record.record_checksums):
                    notes.append(
                        f"{serial}: {later_record.file} shares {n_shared} of {len(checksums)} "
                        f"records with {earlier_record.file}, so the two results are not "
                        "independent."
                    )
    return notes


def _output_notes(records_by_serial: dict[str, list[DatedResult]]) -> Iterator[str]:
    """Yield a note on each instrument whose results state different nominal outputs."""
    for serial, records in records_by_serial.items():
        words = dict.fromkeys(record.nominal.words if record.nominal else "g" for record in records)
        if len(words) > 1:
            latest = records[-1].nominal
            yield (
                f"{serial}: the nominal outputs of the results differ ({', '.join(words)}). The "
                f"history converts the values to {latest.words if latest else 'g'} if the units "
                "are convertible. Otherwise, an error of a nominal sensitivity appears as a "
                "change."
            )


# From results to a history


def _date_and_file(record: DatedResult) -> tuple[datetime, str]:
    return record.date, record.file


def _convert_units(
    record: DatedResult, latest: DatedResult, gravity: float, term: str
) -> DatedResult:
    """Convert a result to g-units of a gravity and to the nominal output of the latest result."""
    conversion = output_conversion(record.nominal, record.gravity, latest.nominal, gravity)
    symbol = equivalent_term(term).symbol
    factor = conversion.ratio * g_units_ratio(symbol, record.gravity, gravity)
    shift = conversion.shift(symbol)
    limits = record.limits
    if limits is not None:
        low, high = (None if limit is None else limit * factor + shift for limit in limits[:2])
        limits = (low, high, limits[2])
    return replace(
        record,
        value=record.value * factor + shift,
        u=record.u * factor,
        gravity=gravity,
        source_shifts={key: shift * factor for key, shift in record.source_shifts.items()},
        limits=limits,
    )


def _make_instrument_history(
    records: Sequence[DatedResult], reliability: float
) -> InstrumentHistory:
    values, u = [record.value for record in records], [record.u for record in records]
    shared_inputs = find_shared_inputs(u, [*_shifts_by_laboratory(records)])
    covariance = None if shared_inputs is None else shared_inputs.covariance
    mean = weighted_mean(values, u, covariance)
    start = records[0].date
    drift = fit_drift([(record.date - start) / YEAR for record in records], values, u, covariance)
    verdict = _judge_agreement(mean, drift)
    return InstrumentHistory(
        serial_number=records[0].serial_number,
        # The accelerometer's serial number takes precedence over the campaign's.
        stated_by=min(record.stated_by for record in records),
        points=[_make_point(i, records, mean, covariance) for i in range(len(records))],
        mean=mean.value,
        u_mean=mean.u,
        scatter=mean.scatter,
        drift=None if drift is None else _make_trend(drift, start),
        verdict=verdict,
        shared=[] if shared_inputs is None else list(shared_inputs.names),
        correlation=None if shared_inputs is None else shared_inputs.largest_correlation,
        control=individuals_chart(values, [record.file for record in records]),
        specification=_latest_specification(records),
        due=_make_due_date(records, drift, verdict, reliability),
        repeatability=evaluate_repeatability(records, covariance, has_drift=verdict == "drifts"),
        laboratories=_compare_laboratories(records, covariance),
    )


def _shifts_by_laboratory(
    records: Sequence[DatedResult],
) -> Iterator[dict[tuple[str, str], float]]:
    """Yield the shifts of each result by shared sources; each laboratory has its own machine."""
    is_one_machine = not are_different([record.laboratory for record in records])
    for record in records:
        yield {
            (
                source,
                identity
                if is_one_machine or is_instrument_source(source)
                else f"{identity} in {record.laboratory}",
            ): shift
            for (source, identity), shift in record.source_shifts.items()
        }


def _latest_specification(records: Sequence[DatedResult]) -> SpecificationLimits | None:
    """Return the specification of the latest result that has one."""
    for record in reversed(records):
        if record.limits is not None:
            low, high, words = record.limits
            return SpecificationLimits(low=low, high=high, words=words)
    return None


def _make_due_date(
    records: Sequence[DatedResult], drift: Drift | None, verdict: Verdict, reliability: float
) -> DueDate:
    specification_limits = _latest_specification(records)
    if specification_limits is None:
        reason = "none of the results states a specification"
    elif drift is None:
        reason = "a straight line requires results from at least two dates"
    elif verdict in {"differ", "disagree"}:
        reason = (
            "the results are not consistent with a straight line, so they cannot be extrapolated"
        )
    else:
        limits = (specification_limits.low, specification_limits.high)
        date = next_due_date(drift, records[0].date, records[-1].date, limits, reliability)
        if date is not None:
            return DueDate(date=date.date().isoformat(), reliability=reliability)
        reason = (
            f"the straight line stays within the specification for {MAX_YEARS:g} years; set a "
            "recalibration interval"
        )
    return DueDate(date=None, reliability=reliability, reason=reason)


def _compare_laboratories(
    records: Sequence[DatedResult], covariance: Array | None
) -> list[LaboratoryPair]:
    """Compare the weighted means of all pairs of laboratories."""
    u = np.array([record.u for record in records])
    full_covariance = np.diag(u**2) if covariance is None else covariance
    values = np.array([record.value for record in records])
    weights_by_laboratory: dict[str, tuple[Array, float | None]] = {}
    for name in dict.fromkeys(record.laboratory for record in records):
        if name is None:
            continue
        indices = [i for i, record in enumerate(records) if record.laboratory == name]
        weights = np.zeros(len(records))
        weights[indices] = np.linalg.solve(
            full_covariance[np.ix_(indices, indices)], np.ones(len(indices))
        )
        dofs = [dof for i in indices if (dof := records[i].dof) is not None]
        weights_by_laboratory[name] = weights / weights.sum(), min(dofs, default=None)
    pairs = []
    for (first, (first_weights, first_dof)), (second, (second_weights, second_dof)) in combinations(
        weights_by_laboratory.items(), 2
    ):
        estimates = [
            (float(weights @ values), float(np.sqrt(weights @ full_covariance @ weights)), dof)
            for weights, dof in ((first_weights, first_dof), (second_weights, second_dof))
        ]
        pairs.append(
            LaboratoryPair(
                first=first,
                second=second,
                difference=estimates[1][0] - estimates[0][0],
                e_n=en_score(
                    estimates[0],
                    estimates[1],
                    float(first_weights @ full_covariance @ second_weights),
                ),
            )
        )
    return pairs


def _make_point(
    index: int, records: Sequence[DatedResult], mean: Mean, covariance: Array | None
) -> Point:
    record = records[index]
    is_single, z = len(records) == 1, float(mean.z[index])
    previous_record = records[index - 1] if index else None
    return Point(
        date=_format_date(record.date),
        file=record.file,
        accelerometer=record.accelerometer,
        method=record.method,
        value=record.value,
        u=record.u,
        dof=record.dof,
        difference=None if is_single else float(mean.differences[index]),
        z=z if math.isfinite(z) else None,
        e_n=None
        if previous_record is None
        else en_score(
            (previous_record.value, previous_record.u, previous_record.dof),
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


def _make_trend(drift: Drift, first_date: datetime) -> Trend:
    return Trend(
        value=drift.slope,
        u=drift.u,
        p=drift.p,
        date=(first_date + drift.time * YEAR).date().isoformat(),
        level=drift.value,
        u_level=drift.u_value,
        scatter=drift.scatter,
    )


def _judge_agreement(mean: Mean, drift: Drift | None) -> Verdict:
    if mean.scatter.p is None:
        return "single"
    agrees_with_mean = mean.scatter.p >= SIGNIFICANCE
    if drift is None or drift.p >= SIGNIFICANCE:
        return "constant" if agrees_with_mean else "disagree"
    if drift.scatter.p is None:
        return "differ"
    return "drifts" if drift.scatter.p >= SIGNIFICANCE else "disagree"
