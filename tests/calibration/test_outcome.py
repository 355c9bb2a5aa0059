"""Statements of a result on its runs and records."""

from dataclasses import replace
from pathlib import Path

import pytest
from campaigns import SMALL, replace_parts, write_and_read_campaign

from counterspin.calibration.joint import fit_jointly
from counterspin.calibration.joint_problem import JointProblem
from counterspin.calibration.observed_runs import observe_runs
from counterspin.calibration.outcome import check_outlier_share
from counterspin.records.record import RecordReport, rejected_count
from counterspin.simulation.simulate import simulate


def test_rejected_blocks_are_counted_in_samples(tmp_path):
    dense = replace_parts(SMALL, ('sampling_rate = "20 Hz"', 'sampling_rate = "200 Hz"'))
    campaign = write_and_read_campaign(tmp_path, dense)
    simulate(campaign, tmp_path)
    slow, *others = observe_runs(campaign)
    place = 500
    assert slow.record.count[place] > 1
    before = fit_jointly(JointProblem(campaign, (slow, *others))).runs["slow"].counts["outliers"]
    error = slow.signals["Qx"].error.copy()
    error[place] += 1.0
    spoilt = replace(slow, signals={**slow.signals, "Qx": replace(slow.signals["Qx"], error=error)})
    after = fit_jointly(JointProblem(campaign, (spoilt, *others))).runs["slow"].counts["outliers"]
    assert after - before == slow.record.count[place]


def make_report(outliers):
    return RecordReport(
        path=Path("r.csv"), rows=1000, used=900, repeated=3, differing=1, empty={"t": 1, "a": 2},
        outliers={"a": outliers, "b": 4}, isolated=0, listed=(), gaps=(), n_gaps=2,
        wrapped=False, step=0.1, rate=None, block=8,
    )  # fmt: skip


def test_counts_are_summed_over_columns():
    counts = make_report(10).counts(6)
    assert counts == {
        "rows": 1000,
        "repeated": 3,
        "empty": 3,
        "outliers": 20,
        "gaps": 2,
        "block": 8,
    }
    assert rejected_count(counts) == 26


@pytest.mark.parametrize(
    ("outliers", "accelerometers", "message"), [(46, 1, 0), (47, 1, 1), (96, 2, 0), (97, 2, 1)]
)
def test_more_than_5_percent_outliers_is_finding(outliers, accelerometers, message):
    outlier_share = check_outlier_share("A.r", make_report(outliers).counts(), accelerometers)
    assert [(f.code, f.subject) for f in outlier_share] == [("many-outliers", "A.r")] * message
