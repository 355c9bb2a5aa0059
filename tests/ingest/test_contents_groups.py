"""Tables within HDF5, MATLAB and TDMS files: compound data, runs, channels of any length."""

import h5py
import numpy as np
import pytest
from posed_files import COLUMNS, POSED, write_compound_file, write_waveform_file
from raising import raises
from scipy.io import savemat

from counterspin.calibration.observed_runs import read_run
from counterspin.campaign.description import read_campaign
from counterspin.ingest.contents import read_files
from counterspin.ingest.description import make_draft, write_description
from counterspin.ingest.overview import describe_files, guess_test
from counterspin.triads.record_poses import campaign_poses

PLACE = {"gravity": "9.81", "latitude": "48"}


def pytables(path):
    """Write a PyTables table: a compound dataset with an index in the same group."""
    kind = [("index", np.int64), ("time", float), ("acc", float, (3,))]
    rows = np.empty(len(POSED.time), dtype=kind)
    rows["index"], rows["time"], rows["acc"] = np.arange(len(rows)), POSED.time, POSED.values
    with h5py.File(path, "w") as file:
        group = file.create_group("sensor")
        group.create_dataset("table", data=rows).attrs["CLASS"] = b"TABLE"


def two_rates(path):
    """Write a sensor and a slower receiver, each with a time column."""
    with h5py.File(path, "w") as file:
        slow = np.arange(0.0, POSED.time[-1], 1.0)
        file["gps/time"], file["gps/lat"] = slow, 48.0 + 0.0 * slow
        file["imu/time"] = POSED.time
        for name, values in COLUMNS.items():
            file[f"imu/{name}"] = values


@pytest.mark.parametrize("write", [write_compound_file, pytables, two_rates])
def test_hdf5_tables_are_read_as_poses(tmp_path, write):
    write(tmp_path / "a.h5")
    contents = read_files([tmp_path / "a.h5"])
    assert guess_test(contents) == "poses"
    draft = make_draft(contents, PLACE, "poses")
    assert draft.open_questions == []
    assert draft.guesses[0].time.column.rpartition("/")[2] == "time"
    assert len(draft.triad.poses.start) == 12
    read_campaign(write_description(draft, tmp_path / "camp"))


TIME = np.arange(800) * 0.05
TURNS = {1: np.pi * TIME, 2: 0.5 * np.pi * TIME}


def path_of(theta):
    return np.column_stack([2.5 * np.cos(theta), 2.5 * np.sin(theta)])


def structures(path):
    """Write an array with a structure per run."""
    runs = np.empty((1, 2), dtype=[("time_s", object), ("angle_rad", object), ("pos", object)])
    for n, theta in TURNS.items():
        runs[0, n - 1] = (TIME[:, None], theta[:, None], path_of(theta))
    savemat(path, {"runs": runs})


def groups(path):
    with h5py.File(path, "w") as file:
        for n, theta in TURNS.items():
            group = file.create_group(f"run{n}")
            group["time_s"], group["angle_rad"], group["pos"] = TIME, theta, path_of(theta)


@pytest.mark.parametrize(
    ("name", "write", "names", "mark"),
    [("a.mat", structures, ["runs(1)", "runs(2)"], "."), ("a.h5", groups, ["run1", "run2"], "/")],
)
def test_structures_and_groups_are_runs(tmp_path, name, write, names, mark):
    write(tmp_path / name)
    contents = read_files([tmp_path / name])
    assert [run.group for run in contents] == names
    assert any(f"group '{names[1]}': 800 rows" in line for line in describe_files(contents))
    answers = PLACE | {"radius": "2.5 m", "sense": "counterclockwise"}
    for n, axis in ((1, "east"), (2, "north")):
        key = f"pos{mark}{n}"
        answers |= {f"{key} is": "displacement", f"{key} unit": "m", f"{key} axis": axis}
    draft = make_draft(contents, answers, "double-turntable")
    campaign = read_campaign(write_description(draft, tmp_path / "camp"))
    assert [run.rate for run in campaign.runs] == pytest.approx([np.pi, 0.5 * np.pi])
    for run, theta in zip(campaign.runs, TURNS.values(), strict=True):
        record = read_run(campaign, run)
        np.testing.assert_allclose(record.angle, theta, atol=1e-9)


def test_pose_groups_are_runs(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for n in range(2):
            file[f"run{n}/time"], file[f"run{n}/acc"] = POSED.time, POSED.values + n
    draft = make_draft(read_files([tmp_path / "a.h5"]), PLACE, "poses")
    document = draft.make_document(tmp_path)
    assert [run["records"] for run in document["runs"]] == [{"group": "run0"}, {"group": "run1"}]
    campaign = read_campaign(write_description(draft, tmp_path / "c"))
    poses = campaign_poses(campaign)
    half = len(poses) // 2
    values = np.array([[reading.value for reading in pose.pose] for pose in poses])
    shift = (values[half:] - values[:half]) * campaign.gravity.value
    np.testing.assert_allclose(shift, 1.0, atol=1e-9)
    path = campaign.path
    path.write_text(path.read_text("utf-8").replace('group = "run1"', 'clock = "1 ppm"'), "utf-8")
    with raises("conflicting-keys", "clock:"):
        read_campaign(path)


def test_sensor_groups_are_not_runs(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for n in range(2):
            file[f"imu{n}/time"], file[f"imu{n}/acc"] = POSED.time, POSED.values
    (contents,) = read_files([tmp_path / "a.h5"])
    assert contents.group is None


@pytest.mark.parametrize(
    ("ends", "late", "note"),
    [
        ((0, 1, 2), (0, 0, 0), "channels truncated to the length of the shortest"),
        ((0, 0, 0), (0, 0, 200), "channels aligned by start time; up to 200 samples omitted"),
    ],
)
def test_channels_are_truncated_or_aligned_with_note(tmp_path, ends, late, note):
    write_waveform_file(tmp_path / "a.tdms", ends, late)
    contents = read_files([tmp_path / "a.tdms"])
    assert note in describe_files(contents)[0]
    start, stop = max(late), len(POSED.time) - max(ends)
    for column, values in zip(contents[0].columns, COLUMNS.values(), strict=True):
        np.testing.assert_array_equal(column.values, values[start:stop])
    assert guess_test(contents) == "poses"
