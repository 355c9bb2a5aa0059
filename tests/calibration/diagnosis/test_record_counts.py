"""How many rows a record lost, and from when on that is said."""

from pathlib import Path

import pytest

from counterspin.calibration.diagnosis.record_counts import counts_of, many_outliers, rejected_of
from counterspin.records.report import RecordReport


def report(outliers):
    return RecordReport(
        path=Path("r.csv"), rows=1000, used=900, repeated=3, differing=1, empty={"t": 1, "a": 2},
        outliers={"a": outliers, "b": 4}, lone=0, listed=(), gaps=(), gap_count=2, wrapped=False,
        step=0.1, rate=None, block=8,
    )  # fmt: skip


def test_counts_are_summed_over_the_columns():
    counts = counts_of(report(10), 6)
    assert counts == {
        "rows": 1000,
        "repeated": 3,
        "empty": 3,
        "outliers": 20,
        "gaps": 2,
        "block": 8,
    }
    assert rejected_of(counts) == 26


@pytest.mark.parametrize(
    ("outliers", "accelerometers", "said"), [(46, 1, 0), (47, 1, 1), (96, 2, 0), (97, 2, 1)]
)
def test_more_than_a_twentieth_is_said(outliers, accelerometers, said):
    found = many_outliers("A.r", counts_of(report(outliers)), accelerometers)
    assert [(f.code, f.subject) for f in found] == [("many-outliers", "A.r")] * said
