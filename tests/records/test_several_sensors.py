"""Rows of several sensors in one file, told apart by a column."""

import numpy as np
import polars as pl
import pytest
from raising import raises

from counterspin.errors import CampaignError, RecordError
from counterspin.ingest.contents import read_contents, read_files
from counterspin.ingest.overview import UndecidedDraft, make_sensor_question
from counterspin.records.dialect import Dialect
from counterspin.records.formats import read_numbers
from counterspin.records.several_sensors import (
    find_interleaved_sensors,
    find_sensor_columns,
    find_stacked_sensors,
)

VALUES = {"A": 1.0, "B": 2.0, "C": 3.0}


@pytest.mark.parametrize(
    ("name", "cells", "found"),
    [
        ("device", ["A", "B", "C"], True),
        ("Sensor ID", ["3", "5"], True),
        ("instance", ["0", "1"], True),
        ("whatever", ["left", "right"], True),
        ("temperature", ["24", "25"], False),
        ("Temperatur", ["22,30", "22,31"], False),
        ("device", ["A"], False),
        ("type", ["24.1", "25.2"], False),
    ],
)
def test_sensor_columns_are_detected(name, cells, found):
    actual_sensor_columns = list(find_sensor_columns({name: cells * 50}))
    assert actual_sensor_columns == ([(name, sorted(cells))] if found else [])


def test_labels_of_poses_and_states_are_not_sensors():
    poses = [f"P{n}" for n in range(12) for _ in range(30)]
    state = ["rest"] * 100 + ["move"] * 60 + ["rest"] * 100
    assert (
        list(find_sensor_columns({"pose name": poses, "state": state, "device": ["A"] * 99})) == []
    )


def write_interleaved_sensors(path, numbered=False):
    """Write interleaved rows of three sensors, each with a constant value."""
    names = list(VALUES) * 200
    frame = pl.DataFrame(
        {
            "time_s": np.repeat(np.arange(200) * 0.01, 3),
            "device": list(range(3)) * 200 if numbered else names,
            "a_m/s^2": [VALUES[name] for name in names],
        }
    )
    {".csv": frame.write_csv, ".parquet": frame.write_parquet}[path.suffix](path)
    return path


@pytest.mark.parametrize("name", ["log.csv", "log.parquet"])
@pytest.mark.parametrize("numbered", [False, True])
def test_rows_of_sensor_are_selected(tmp_path, name, numbered):
    path = write_interleaved_sensors(tmp_path / name, numbered)
    value = "1" if numbered else "B"
    numbers = read_numbers(path, ["time_s", "a_m/s^2"], Dialect(select=("device", value)))
    assert set(numbers["a_m/s^2"].tolist()) == {2.0}
    assert len(numbers["time_s"]) == 200
    with raises("no-rows", "'Q'"):
        read_numbers(path, ["time_s"], Dialect(select=("device", "Q")))


def test_several_sensors_require_selection(tmp_path):
    import counterspin as cs

    path = write_interleaved_sensors(tmp_path / "log.csv")
    contents = read_files([path])
    assert make_sensor_question(contents).choices == ("A", "B", "C")
    with raises("missing-answer", "select:", "'device'", "log.csv", "3"):
        UndecidedDraft.from_contents(contents).complete()
    (chosen,) = read_files([path], {"select": "C"})
    assert make_sensor_question([chosen]) is None
    assert chosen.dialect_keys == {"select": {"column": "device", "value": "C"}}
    assert set(chosen.columns[1].values.tolist()) == {3.0}
    with raises("several-sensors", "3 different values", "`select`", '"device=A"'):
        cs.noise(path)
    assert read_contents(path).selected_sensor is None


def write_stacked_sensors(path, names):
    """Write the records of two sensors one after the other; the second is five times as noisy."""
    rng = np.random.default_rng(3)
    rows = [
        (i * 0.01, name, scale * rng.standard_normal())
        for name, scale in zip(names, (0.01, 0.05), strict=True)
        for i in range(3000)
    ]
    pl.DataFrame(rows, ["time_s", "device", "ax_m/s^2"], orient="row").write_csv(path)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("names", [("A", "B"), (1, 2)])
def test_stacked_records_require_selection(tmp_path, names):
    import counterspin as cs

    path = write_stacked_sensors(tmp_path / "log.csv", names)
    with pytest.raises(RecordError, match="column 'device' has 2 different values"):
        cs.noise(path, sampling_rate="100 Hz")
    (chosen,) = read_files([path], {"select": str(names[1])})
    assert chosen.dialect_keys == {"select": {"column": "device", "value": str(names[1])}}
    for name, scale in zip(names, (0.01, 0.05), strict=True):
        (signal,) = cs.noise(path, select=f"device={name}", columns=["ax_m/s^2"]).signals
        white = signal.components["acceleration"]
        assert white.low < scale * 0.1 < white.high
        assert signal.rows == 3000


def test_stacked_sensors_are_detected():
    """The time decreases at each change, or the column is named like a sensor."""
    cells = [f"P{n}" for n in range(3) for _ in range(50)]
    time = np.tile(np.arange(50.0), 3)
    assert list(find_stacked_sensors({"device": ["A"] * 150}, {"time": time})) == []
    assert list(find_stacked_sensors({"zone": cells}, {"time": np.arange(150.0)})) == []
    assert list(find_stacked_sensors({"sensor temp": cells}, {"time": np.arange(150.0)})) == []
    known = [("device", ["P0", "P1", "P2"])]
    assert list(find_stacked_sensors({"device": cells}, {"time": np.arange(150.0)})) == known
    blocks = ["left", "right"] * 3
    named = [word for word in blocks for _ in range(50)]
    steps = np.concatenate([np.arange(50.0) + 50 * (n // 2) for n in range(6)])
    assert list(find_stacked_sensors({"name": named}, {"time": steps})) == [
        ("name", ["left", "right"])
    ]
    assert list(find_stacked_sensors({"device": cells}, {"time": time})) == [
        ("device", ["P0", "P1", "P2"])
    ]


def test_invalid_selection_raises(tmp_path):
    import counterspin as cs

    path = write_interleaved_sensors(tmp_path / "log.csv")
    for select, message in (("device=Q", "does not contain the value 'Q'"), ("dev=A", "select")):
        with pytest.raises(RecordError, match=message):
            cs.noise(path, select=select)
    with pytest.raises(CampaignError, match=r"write COLUMN=VALUE, such as device=A$"):
        cs.noise(path, select="A")
    with pytest.raises(CampaignError, match="filter the data frame"):
        cs.noise({"time_s": [0.0, 1.0], "Qx_g": [1.0, 1.1]}, select="device=A")


@pytest.mark.parametrize("labels", [("wrist", "ankle"), ("1", "2"), ("L", "R", "M")])
def test_interleaved_sensors_are_detected_by_time(labels):
    """Interleave rows of sensors with uniform sampling at random."""
    rng = np.random.default_rng(2)
    time = np.add.outer(np.arange(400) * 0.01, 3e-4 * np.arange(len(labels))).ravel()
    order = np.argsort(time + rng.uniform(0.0, 9e-3, time.size))
    cells = np.tile(labels, 400)[order].tolist()
    numbers = {"t": time[order], "a": rng.standard_normal(time.size)}
    sensors = list(find_interleaved_sensors({"at": cells}, numbers))
    assert sensors == [("at", sorted(labels))]
    # A state does not part the rows of one sensor into records with even times.
    state = rng.choice(labels, time.size).tolist()
    assert not list(find_interleaved_sensors({"at": state}, numbers | {"t": np.sort(time)}))
    assert not list(find_interleaved_sensors({"at": cells}, {"t": np.arange(time.size) * 0.01}))
