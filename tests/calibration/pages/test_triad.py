"""Plots of the poses of a triad."""

import numpy as np
import pytest
from posed_records import NOISE, STEP, simulate_poses

import counterspin as cs
import triads
from counterspin.calibration.pages.document import full_report_blocks
from counterspin.calibration.pages.triad import pose_pictures
from counterspin.reports.blocks import Plot, Sphere
from counterspin.reports.charts import render_svg

RUN = """
[records]
time = { sampling_rate = "100 Hz" }

[[runs]]
name = "by hand"
motion = "static"
attitude = "unknown"
record = "imu.log"
"""


@pytest.fixture(scope="module")
def truth():
    return simulate_poses(4.0, 1.5, count=16)


@pytest.fixture(scope="module")
def result(truth, tmp_path_factory):
    folder = tmp_path_factory.mktemp("posed")
    text = triads.format_description(RUN.partition("[[runs]]")[0])
    for name, column in zip("XYZ", ("column 1", "column 2", "column 3"), strict=True):
        table = f'specific_force = {{ column = "{column}", unit = "m/s^2" }}\n'
        text = text.replace(
            triads.format_accelerometer(name), triads.format_accelerometer(name, table)
        )
    (folder / "campaign.toml").write_text(text + "[[runs]]" + RUN.partition("[[runs]]")[2])
    felt = truth.values @ triads.ROWS.T + 9.81 * triads.BIAS
    np.savetxt(folder / "imu.log", felt, fmt="%.6f")
    return cs.calibrate(folder)


def test_sphere_plot_shows_directions_and_residuals_of_poses(result, truth):
    sphere = next(picture for picture in pose_pictures(result) if isinstance(picture, Sphere))
    along = truth.force / 9.81
    assert np.array(sphere.points) == pytest.approx(along, abs=3e-3)
    assert sphere.names == tuple(map(str, range(1, 17)))
    assert sphere.value_label == "residual, mm/s^2"
    residuals = [9810.0 * pose.residual for pose in result.triad.poses]
    assert sphere.values == pytest.approx(residuals)
    # Scatter of means of about 300 rows.
    assert np.std(sphere.values) == pytest.approx(1e3 * NOISE / np.sqrt(300.0), rel=0.6)
    assert sphere.highlighted_points == frozenset()


def test_residuals_before_and_after_calibration(result, truth):
    before, after = (
        p for p in pose_pictures(result) if isinstance(p, Plot) and p.x_label == "pose"
    )
    felt = truth.force @ triads.ROWS.T + 9.81 * triads.BIAS
    off = 1e3 * (np.linalg.norm(felt, axis=1) - 9.81)
    assert before.series[0].y == pytest.approx(off, abs=6.0)
    assert np.std(after.series[0].y) < 0.05 * np.std(off)
    low, high = (np.array(each) for each in (after.series[0].low, after.series[0].high))
    spread = [9810.0 * pose.u for pose in result.triad.poses]
    assert 0.5 * (high - low) == pytest.approx(spread)


def test_rest_detection_plot_has_threshold_and_poses(result, truth):
    (actual_pose_picture,) = (
        p for p in pose_pictures(result) if p.title == "Rest intervals of by hand"
    )
    shaded, level = actual_pose_picture.series
    (threshold,) = actual_pose_picture.levels
    assert threshold == result.triad.records["by hand"].threshold
    starts, ends = np.array(shaded.x[::3]), np.array(shaded.x[1::3])
    assert starts == pytest.approx(truth.start, abs=0.5 + 3 * STEP)
    assert ends == pytest.approx(truth.end, abs=0.5 + 3 * STEP)
    time, height = np.array(level.x), np.array(level.y)
    for start, end in zip(starts, ends, strict=True):
        inside = (time > start + 0.2) & (time < end - 0.2)
        assert (height[inside] <= threshold).all()
    assert height.max() > 10.0 * threshold


def test_report_has_all_triad_plots(result):
    pictures = list(pose_pictures(result))
    assert len(pictures) == 4
    blocks = full_report_blocks(result)
    assert sum(isinstance(block, Sphere) for block in blocks) == 1
    assert all(render_svg(picture) for picture in pictures)


def test_single_readings_have_no_rest_detection_plot(tmp_path):
    values = triads.compute_indications(triads.draw_directions(15, np.random.default_rng(1)))
    result = cs.calibrate(triads.write_pose_campaign(tmp_path, values, u=1e-4))
    assert [type(p) for p in pose_pictures(result)] == [Sphere, Plot, Plot]
    assert list(pose_pictures(result.model_copy(update={"triad": None}))) == []
