"""What reading a record found, as a result states it: of a run, and of a reading that is a mean."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from counterspin.calibration.result_parts import Finding
from counterspin.records.report import RecordReport

#: More outliers than this part of a record's samples are worth a warning.
OUTLIER_SHARE: Final = 0.05


def counts_of(report: RecordReport, outliers: int = 0) -> dict[str, int]:
    """Return how many rows of each kind there are; `outliers`: found beside those of reading."""
    return {
        "rows": report.rows,
        "repeated": report.repeated,
        "empty": sum(report.empty.values()),
        "outliers": outliers + sum(report.outliers.values()),
        "gaps": report.gap_count,
        "block": report.block,
    }


def rejected_of(counts: Mapping[str, int]) -> int:
    """Return how many samples were recorded but not used."""
    return counts["repeated"] + counts["empty"] + counts["outliers"]


def many_outliers(
    subject: str, counts: Mapping[str, int], accelerometers: int = 1
) -> list[Finding]:
    """Return a finding where outliers are more than `OUTLIER_SHARE` of a record's samples."""
    samples = counts["rows"] * accelerometers
    share = counts["outliers"] / samples
    if share <= OUTLIER_SHARE:
        return []
    text = (
        f"{subject}: {counts['outliers']} samples of {samples} were left out as "
        "outliers. Find out why: the remaining samples may be affected too."
    )
    return [Finding(code="many-outliers", subject=subject, text=text, size=share)]
