"""What speaks against poses at unknown attitudes."""

from dataclasses import replace

import numpy as np
import pytest

import triads
from counterspin.readings.joint_data import estimate_with_groups
from counterspin.triads.checks import pose_findings

NOISE = 1e-4  # g


def findings_of_poses(seed, count=30, drift=0.0, squares=(0.0, 0.0, 0.0), minutes=5.0):
    """Return the findings of poses: of a bias of Y that drifts by so much in all, g."""
    generator = np.random.default_rng(seed)
    values = triads.compute_indications(triads.draw_directions(count, generator), squares=squares)
    values += NOISE * generator.standard_normal((count, 3))
    values += np.outer(np.linspace(0.0, drift, count), [0.0, 1.0, 0.0])
    poses = triads.make_poses(values)
    times = np.linspace(0.0, 60.0 * minutes, count)
    poses = replace(poses, conditions={**poses.conditions, "time": times})
    estimated, parts = estimate_with_groups(None, triads.make_unknowns(), [poses])
    return pose_findings(estimated.fit, parts)


@pytest.mark.parametrize(
    ("minutes", "cure"), [(5.0, "add K_F.trend"), (0.0, "the time of each pose")]
)
def test_drift_of_accelerometer_is_named(minutes, cure):
    findings = [findings_of_poses(seed, drift=20.0 * NOISE, minutes=minutes) for seed in range(5)]
    for own in findings:
        (finding,) = [one for one in own if one.code == "lack-of-fit"]
        assert finding.subject == "triad"
        assert "drift with the" in finding.text
        assert "mainly in Y" in finding.text
        assert cure in finding.text
        assert finding.contradicts


def test_missing_term_is_named():
    (finding,) = findings_of_poses(1, count=60, squares=(0.0, 0.0, 20.0 * NOISE))
    assert finding.code == "lack-of-fit"
    assert "follow Z.K_II" in finding.text


def test_false_alarms_of_good_poses_are_rare():
    # The tests share a level of 1 %, so that of 30 triads three or more with a finding have a
    # probability of 0.003.
    alarms = sum(bool(findings_of_poses(seed)) for seed in range(100, 130))
    assert alarms < 3
