"""Poses that are taken already, and state no uncertainty, count in plans by the noise they show."""

import numpy as np
import pytest

import triads
from counterspin.calibration.calibrate import calibrate
from counterspin.planning.plan import PlannedCampaign, check, plan

NOISE = 3e-4
MORE = """
[[stations]]
attitude = "unknown"
u = "3e-4 g"
[limits]
readings = 6
[goal]
minimise = ["X.K_F"]
"""


def write_random_poses(folder, count, u=None):
    """Write a campaign of poses at random, with or without their uncertainty."""
    generator = np.random.default_rng(5)
    values = triads.compute_indications(triads.draw_directions(count, generator))
    return triads.write_pose_campaign(
        folder, values + NOISE * generator.standard_normal(values.shape), u
    )


def test_forecast_of_existing_poses_matches_calibration(tmp_path):
    folder = write_random_poses(tmp_path, 80)
    stated = calibrate(folder)
    expected = PlannedCampaign(check(folder), "").u
    for name in ("X.K_F", "Y.K_I", "Z.delta_O"):
        # Students' factor of the noise's 71 degrees of freedom is no part of a forecast.
        assert expected[name] == pytest.approx(stated[name].u, rel=0.03), name


def test_further_poses_complement_existing_poses(tmp_path):
    u_by_count = {}
    for name, u in (("shown", None), ("stated", NOISE)):
        folder = write_random_poses(tmp_path / name, 24, u)
        file = folder / "campaign.toml"
        file.write_text(file.read_text(encoding="utf-8") + MORE, encoding="utf-8")
        u_by_count[name] = plan(file)
    before = PlannedCampaign(check(write_random_poses(tmp_path / "before", 24, NOISE)), "").u[
        "X.K_F"
    ]
    assert u_by_count["stated"].u["X.K_F"] < 0.95 * before
    # 24 poses beside 9 unknowns tell their noise to 18 %; three times that is not exceeded.
    assert u_by_count["shown"].u["X.K_F"] == pytest.approx(
        u_by_count["stated"].u["X.K_F"], rel=0.55
    )
    assert len(u_by_count["shown"].result.readings) == 6
