"""Times of the rows of a static record, from its time column or its sampling rate."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.errors import CampaignError, RecordError
from counterspin.ingest.column_roles import FileGuess, explain_missing_time
from counterspin.ingest.contents import FileColumn
from counterspin.records.memory import MemoryTable

#: Largest ratio of the stated sampling rate to that of the rows, or its inverse.
_MAX_RATE_RATIO: Final = 1.25
#: Deviation of a time from an integer number of steps above which times follow from row counts.
_MAX_STEP_DEVIATION: Final = 0.3


def compute_row_times(
    source: Path | MemoryTable,
    file_guess: FileGuess,
    columns: Sequence[FileColumn],
    sampling_rate: float | None,
) -> Array:
    """Return the time of each row, s.

    sampling_rate: Stated sampling rate, Hz; used with row counts if the times are not uniform.
    """
    row_indices = np.arange(max(len(column.values) for column in columns))
    if file_guess.time is not None:
        if file_guess.time.unit is None and sampling_rate is None:
            raise RecordError(
                f"{source}: column '{file_guess.time.column}' seems to be the time, but its unit "
                "is unknown; rename it, for example to 'time_s', or give `sampling_rate` or "
                "`campaign`.",
                code="missing-unit",
            )
        column = next(c for c in columns if c.name == file_guess.time.column)
        seconds = np.asarray(column.values * file_guess.time.factor)
        decreasing_rows = np.flatnonzero(np.diff(seconds) < 0.0)
        if decreasing_rows.size and sampling_rate is None:
            previous_time, next_time = seconds[decreasing_rows[0] : decreasing_rows[0] + 2]
            raise RecordError(
                f"{source}: column '{column.name}': the time decreases in row "
                f"{decreasing_rows[0] + 2}, from {previous_time:.9g} s to {next_time:.9g} s. End "
                "the record before this row.",
                code="time-backwards",
            )
        if sampling_rate is None:
            return seconds
        if file_guess.time.unit is None:
            return row_indices / sampling_rate
        _check_sampling_rate(column.name, seconds, sampling_rate)
        steps = np.diff(seconds[np.isfinite(seconds)]) * sampling_rate
        step_deviations = np.abs(steps - np.round(steps))
        is_uniform = bool((step_deviations < _MAX_STEP_DEVIATION).all() and (steps >= 0.0).all())
        return seconds if is_uniform else row_indices / sampling_rate
    if file_guess.shared_times is not None and sampling_rate is None:
        return file_guess.shared_times.values
    if file_guess.sampling_rate is None:
        problem = (
            f"{source}: {explain_missing_time(file_guess.contents)}. Give the sampling rate as "
            '`sampling_rate`, such as "100 Hz".'
        )
        unread_reasons = [
            f"Not read: {reason}"
            for reason in file_guess.contents.unread_reasons
            if reason.rstrip(".") not in problem
        ]
        raise RecordError(" ".join([problem, *unread_reasons]), code="missing-column")
    return row_indices / file_guess.sampling_rate


def _check_sampling_rate(time_column: str, seconds: Array, sampling_rate: float) -> None:
    """Raise CampaignError if a stated sampling rate contradicts the times of the rows, s."""
    duration = float(np.nanmax(seconds) - np.nanmin(seconds))
    if not duration:
        return
    row_rate = (seconds.size - 1) / duration
    if not 1.0 / _MAX_RATE_RATIO < sampling_rate / row_rate < _MAX_RATE_RATIO:
        raise CampaignError(
            "noise",
            [
                f"`sampling_rate`: {sampling_rate:.6g} Hz contradicts column "
                f"'{time_column}', which has {row_rate:.4g} rows per second; correct the "
                "rate, or omit it"
            ],
            code="conflicting-values",
        )
