"""Where a sensor lay still, in records whose truth is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from posed_records import NOISE, STEP, PosedRecord, simulate_poses
from raising import raises

from counterspin.arrays import Array
from counterspin.errors import RecordError
from counterspin.records.memory import MemoryTable
from counterspin.records.record import ColumnSpec, RecordColumns
from counterspin.triads.static_intervals import find_poses, read_poses

#: Records of real sensors, beside the repository where there are any.
_REAL = next(filter(Path.exists, (up / "shared/real" for up in Path(__file__).parents)), None)


def assert_poses_found(
    truth: PosedRecord, poses, among: np.ndarray | None = None, slack: float = 0.5
) -> None:
    """Check that each rest is found within it, but for `slack` s at either end, with its mean."""
    there = np.ones(len(truth.start), dtype=bool) if among is None else among
    assert len(poses.start) == there.sum()
    assert (poses.start >= truth.start[there] - 2 * STEP).all()
    assert (poses.end <= truth.end[there] + 2 * STEP).all()
    assert (poses.start <= truth.start[there] + slack + 2 * STEP).all()
    assert (poses.end >= truth.end[there] - slack - 2 * STEP).all()
    off = (poses.mean - truth.force[there]) / (NOISE / np.sqrt(poses.count))[:, None]
    assert np.abs(off).max() < 5.0  # 36 values of a Gaussian


@pytest.mark.parametrize(
    ("rest_duration", "motion"), [(20.0, 1.0), (4.0, 1.5), (3.0, 9.0), (2.5, 20.0)], ids=str
)
def test_rests_are_found_for_any_duty_cycle(rest_duration: float, motion: float) -> None:
    truth = simulate_poses(rest_duration, motion)
    poses = find_poses(truth.time, truth.values)
    assert_poses_found(truth, poses)
    assert poses.warnings == ()
    assert poses.rejected == ()
    assert poses.scatter == pytest.approx(NOISE, rel=0.3)
    # Twice the noise of three axes together.
    assert poses.threshold == pytest.approx(2.0 * np.sqrt(3.0) * NOISE, rel=0.05)


def test_level_is_moving_standard_deviation() -> None:
    # Of a quiet instrument in a long record: sums over all of it would be off by some percent. What
    # rounding leaves is eps (10 m/s^2)^2 over twice the variance of three axes, 4e-5, at most.
    truth = simulate_poses(4.0, 1.5, count=120, noise=1e-5)
    poses = find_poses(truth.time, truth.values)
    assert len(poses.start) == 120
    assert poses.spikes.sum() == 0.0
    whole = np.isfinite(poses.level)
    for place in np.linspace(60, len(truth.time) - 61, 50).astype(int):
        window = slice(place - 50, place + 51)
        if whole[window].all():
            exact = np.sqrt(truth.values[window].var(axis=0, ddof=1).sum())
            assert poses.level[place] == pytest.approx(exact, rel=4e-5)


def test_decimated_level_preserves_motion() -> None:
    truth = simulate_poses(4.0, 1.5)
    poses = find_poses(truth.time, truth.values)
    time, level = poses.trace(100)
    assert len(time) == len(level) == 100
    assert level.max() == np.nanmax(poses.level)
    moving = [(time > end) & (time < end + 1.5) for end in truth.end[:-1]]
    assert all(level[at].max() > 5.0 * poses.threshold for at in moving)
    assert len(poses.trace(100_000)[0]) == np.isfinite(poses.level).sum()


def test_stated_threshold_and_rest_are_used() -> None:
    truth = simulate_poses(4.0, 1.5)
    assert len(find_poses(truth.time, truth.values, threshold=0.1).start) == 12
    poses = find_poses(truth.time, truth.values, threshold=50.0)
    assert len(poses.start) == 1
    assert poses.threshold == 50.0
    assert "The record contains no motion," in poses.warnings[0]
    with raises("no-rest", "5 s", "threshold"):
        find_poses(truth.time, truth.values, min_rest=5.0)
    with raises("no-rest", "1.5 s", "0.01"):
        find_poses(truth.time, truth.values, threshold=0.01)


def test_suggested_threshold_includes_quietest_interval() -> None:
    truth = simulate_poses(4.0, 1.5)
    with pytest.raises(RecordError) as error:
        find_poses(truth.time, truth.values, threshold=0.01)
    named = float(str(error.value).split("stays below ")[1].split(". ")[0])
    assert len(find_poses(truth.time, truth.values, threshold=1.002 * named).start) >= 1


@pytest.mark.parametrize("row", [0, 1, -2, -1])
@pytest.mark.parametrize("size", [1e9, 1e18, -1e90])
def test_outlier_at_either_end_changes_no_pose(row: int, size: float) -> None:
    truth = simulate_poses(4.0, 1.5)
    expected = find_poses(truth.time, truth.values).mean
    values = truth.values.copy()
    values[row, 1] = size
    poses = find_poses(truth.time, values)
    assert poses.mean == pytest.approx(expected, abs=NOISE)


def test_outliers_and_empty_cells_do_not_split_rest() -> None:
    truth = simulate_poses(4.0, 1.5)
    rng = np.random.default_rng(3)
    values = truth.values.copy()
    spikes = [round((start + 2.0) / STEP) for start in truth.start]
    values[spikes, 1] += 30.0
    values[np.array(spikes) + 40, 2] = -1e9
    values[rng.choice(len(values), 300, replace=False), 0] = np.nan
    poses = find_poses(truth.time, values)
    assert_poses_found(truth, poses)
    seen = ~np.isnan(values[:, 0])
    assert poses.spikes.tolist() == [0, seen[spikes].sum(), seen[np.array(spikes) + 40].sum()]
    assert np.isnan(poses.level[spikes]).all()


def test_gap_ends_pose() -> None:
    truth = simulate_poses(6.0, 1.5)
    keep = np.ones(len(truth.time), dtype=bool)
    middle = round((truth.start[3] + 3.0) / STEP)
    keep[middle - 40 : middle + 40] = False
    poses = find_poses(truth.time[keep], truth.values[keep])
    assert len(poses.start) == 13
    assert poses.end[3] == pytest.approx(truth.time[middle - 41])
    assert poses.start[4] == pytest.approx(truth.time[middle + 40])
    few = np.ones(len(truth.time), dtype=bool)
    few[middle - 10 : middle + 10] = False  # a fifth of a second is no gap
    assert len(find_poses(truth.time[few], truth.values[few]).start) == 12


def test_nonuniform_sampling_is_accepted() -> None:
    truth = simulate_poses(4.0, 1.5)
    rng = np.random.default_rng(4)
    keep = rng.random(len(truth.time)) < 0.4
    time = truth.time + rng.uniform(-0.004, 0.004, len(truth.time))
    poses = find_poses(time[keep], truth.values[keep])
    assert len(poses.start) == 12
    assert np.abs(poses.start - truth.start).max() < 0.7
    off = (poses.mean - truth.force) / (NOISE / np.sqrt(poses.count))[:, None]
    assert np.abs(off).max() < 5.0


def test_low_sampling_rate_is_sufficient_for_long_rests() -> None:
    truth = simulate_poses(60.0, 10.0)
    thin = slice(None, None, 100)
    poses = find_poses(truth.time[thin], truth.values[thin], min_rest=20.0)
    assert len(poses.start) == 12
    with raises("too-few-rows", "1 s"):
        find_poses(truth.time[thin], truth.values[thin])


def test_drift_is_not_motion_and_slow_rotation_warns() -> None:
    truth = simulate_poses(20.0, 1.5)
    drift = 0.002 * truth.time[:, None] * [1.0, -0.5, 0.2]
    assert len(find_poses(truth.time, truth.values + drift).start) == 12
    turned = np.array([9.81 * np.sin(0.01 * truth.time), 0.0 * truth.time, 0.0 * truth.time]).T
    noise = NOISE * np.random.default_rng(5).normal(size=turned.shape)
    poses = find_poses(truth.time, turned + noise)
    assert any("rotated slowly" in doubt for doubt in poses.warnings)


@pytest.mark.parametrize("digit", [0.005, 0.05, 0.2])
def test_coarse_resolution_preserves_poses(digit: float) -> None:
    truth = simulate_poses(4.0, 1.5)
    values = np.round(truth.values / digit) * digit
    poses = find_poses(truth.time, values)
    assert len(poses.start) == 12
    assert np.abs(poses.mean - truth.force).max() < 0.01 + 0.5 * digit
    assert poses.rejected == ()


def test_saturated_and_constant_rests_are_rejected() -> None:
    truth = simulate_poses(4.0, 1.5)
    top = np.sort(truth.force[:, 0])[-1] - 0.5
    cut = np.minimum(truth.values, [top, np.inf, np.inf])
    hit = truth.force[:, 0] > top
    poses = find_poses(truth.time, cut)
    assert_poses_found(truth, poses, ~hit)
    assert len(poses.rejected) == hit.sum()
    assert "along axis 1 are the largest or smallest of the record" in poses.rejected[0]
    held = truth.values.copy()
    first = round(truth.start[5] / STEP)
    held[first : first + 400] = held[first]
    poses = find_poses(truth.time, held)
    assert len(poses.start) == 11
    assert "all values are identical" in poses.rejected[0]
    # One axis hangs, from within one rest to within another: both are left out, and those between.
    hung = truth.values.copy()
    last = round(truth.start[7] / STEP) + 400
    hung[first:last, 1] = hung[first, 1]
    poses = find_poses(truth.time, hung)
    assert len(poses.start) == 9
    assert len(poses.rejected) == 3
    assert "axis 2 does not change" in poses.rejected[0]


def test_unclear_separation_of_rest_and_motion_warns() -> None:
    rng = np.random.default_rng(6)
    time = np.arange(6000) * STEP
    loud = np.where(np.sin(2.0 * np.pi * time / 10.0) > 0.0, 1.0, 2.2)[:, None]
    poses = find_poses(time, loud * rng.normal(size=(6000, 3)))
    assert any("not clearly separated" in doubt for doubt in poses.warnings)
    still = find_poses(time, NOISE * rng.normal(size=(6000, 3)))
    assert len(still.start) == 1
    assert "The record contains no motion, " in still.warnings[0]


@pytest.mark.parametrize(
    ("time", "values", "words"),
    [
        (np.arange(5.0), np.zeros((5, 3)), "5 rows have all three values"),
        (np.arange(50) * STEP, np.zeros((50, 3)), "lasts 0.49 s, which is less than one rest"),
        (np.r_[np.arange(400), 10] * STEP, np.zeros((401, 3)), "the time decreases after 3.99 s"),
        (np.arange(400) * STEP, np.full((400, 3), np.nan), "0 rows have all three"),
    ],
)
def test_invalid_record_raises(time: Array, values: Array, words: str) -> None:
    with pytest.raises(RecordError, match=words):
        find_poses(time, values)


def test_file_without_header_or_time_is_read(tmp_path: Path) -> None:
    truth = simulate_poses(4.0, 1.5)
    path = tmp_path / "imu.log"
    values = truth.values.copy()
    values[200, 2] = 1e6
    np.savetxt(path, np.column_stack([values, values]), fmt="%.5f")
    columns = RecordColumns(
        ColumnSpec("", STEP, kind="rows", target_unit="s"),
        None,
        {name: ColumnSpec(f"column {place}") for place, name in enumerate("XYZ", 1)},
    )
    poses, record = read_poses(path, columns)
    assert_poses_found(truth, poses)
    assert len(record.time) == len(truth.time)
    assert record.report.outliers == {"column 1": 0, "column 2": 0, "column 3": 1}
    with raises("no-rest", "imu.log:", "30 s"):
        read_poses(path, columns, min_rest=30.0)


def test_pose_times_are_times_of_file() -> None:
    truth = simulate_poses(4.0, 1.5)
    axes = dict(zip("xyz", truth.values.T, strict=True))
    table = MemoryTable("memory", {"t": truth.time + 1000.0} | axes)
    columns = RecordColumns(ColumnSpec("t"), None, {axis: ColumnSpec(axis) for axis in "xyz"})
    poses, _ = read_poses(table, columns)
    assert poses.start == pytest.approx(truth.start + 1000.0, abs=0.52)


def test_interleaved_empty_rows_are_ignored() -> None:
    truth = simulate_poses(4.0, 1.5)
    often = np.repeat(truth.values, 3, axis=0)
    often[np.arange(len(often)) % 3 > 0] = np.nan
    times = np.arange(len(often)) * STEP / 3.0
    table = MemoryTable("memory", {"t": times} | dict(zip("xyz", often.T, strict=True)))
    columns = RecordColumns(ColumnSpec("t"), None, {axis: ColumnSpec(axis) for axis in "xyz"})
    poses, record = read_poses(table, columns)
    assert_poses_found(truth, poses)
    assert record.report.empty["x"] == 2 * len(truth.values)


@pytest.mark.skipif(_REAL is None, reason="the real records are not here")
def test_measured_record_has_22_poses() -> None:
    values = np.loadtxt(_REAL / "mpu9150/imu0.log")[:, :3]
    poses = find_poses(np.arange(len(values)) * STEP, values)
    assert len(poses.start) == 22
    assert poses.warnings == poses.rejected == ()


@pytest.mark.skipif(_REAL is None, reason="the real records are not here")
def test_measured_record_contains_six_faces() -> None:
    import json

    folder = _REAL / "imucal"
    rows = np.loadtxt(folder / "session.csv", delimiter=",", skiprows=1)
    poses = find_poses(np.arange(len(rows)) / 204.8, rows[:, 4:7])
    sections = json.loads((folder / "sections.json").read_text())
    for name in ("x_p", "x_a", "y_p", "y_a", "z_p", "z_a"):
        start, end = (sections[name][key] / 204.8 for key in ("start", "end"))
        place = int(np.searchsorted(poses.start, 0.5 * (start + end))) - 1
        assert poses.start[place] <= start + 0.5
        assert poses.end[place] >= end - 0.5


def test_rows_with_same_time_are_accepted():
    """With two rows per time stamp, the median step is zero."""
    truth = simulate_poses(4.0, 1.5)
    coarse = np.floor(np.arange(len(truth.time)) / 5.0) * 0.05
    assert len(find_poses(coarse, truth.values).start) == 12
    with raises("no-rows"):
        find_poses(np.zeros(100), truth.values[:100])
