"""The joint method's outcome, on observed runs that are changed in memory."""

from dataclasses import replace

from campaigns import SMALL, campaign_of, changed

from counterspin.calibration.joint import joint
from counterspin.calibration.joint_problem import JointProblem
from counterspin.calibration.observed import observe
from counterspin.simulation.simulate import simulate


def test_outliers_of_the_fit_are_counted_in_samples(tmp_path):
    dense = changed(SMALL, ('sampling_rate = "20 Hz"', 'sampling_rate = "200 Hz"'))
    campaign = campaign_of(tmp_path, dense)
    simulate(campaign, tmp_path)
    slow, *others = observe(campaign)
    place = 500
    assert slow.record.count[place] > 1
    before = joint(JointProblem(campaign, (slow, *others))).runs["slow"].counts["outliers"]
    error = slow.signals["Qx"].error.copy()
    error[place] += 1.0
    spoilt = replace(slow, signals={**slow.signals, "Qx": replace(slow.signals["Qx"], error=error)})
    after = joint(JointProblem(campaign, (spoilt, *others))).runs["slow"].counts["outliers"]
    assert after - before == slow.record.count[place]
