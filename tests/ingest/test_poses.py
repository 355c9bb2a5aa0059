"""From a record of a sensor in many poses to a description."""

import json
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from posed_records import simulate_poses
from raising import raises

from counterspin.calibration.calibrate import calibrate
from counterspin.campaign.description import read_campaign
from counterspin.errors import RecordError
from counterspin.ingest.contents import read_files
from counterspin.ingest.description import make_draft, write_description
from counterspin.ingest.overview import explain_unknown_test, guess_test
from counterspin.ingest.poses import make_poses_draft
from counterspin.toml_text import format_document

REAL = Path(__file__).parents[3] / "shared" / "real" / "imucal"
PLACE = {"gravity": "9.81 m/s^2", "latitude": "45 deg"}
ANSWERS = {**PLACE, "sampling_rate": "100 Hz"}
BIAS = np.array([0.1, -0.2, 0.3])


@pytest.fixture(scope="module")
def values():
    truth = simulate_poses(4.0, 1.5)
    return truth.values + BIAS


def write_log(folder, values):
    """Write a log with space delimiters, angular rates in the last columns, no header, no time."""
    rates = 0.01 * np.random.default_rng(1).normal(size=values.shape)
    np.savetxt(folder / "imu.log", np.column_stack([values, rates]), fmt="%.5f")
    return folder / "imu.log"


def test_log_without_header_and_time_is_understood(tmp_path, values):
    looks = read_files([write_log(tmp_path, values)])
    assert guess_test(looks) == "poses"
    draft = make_draft(looks, ANSWERS, "poses")
    assert draft.open_questions == []
    assert draft.column_names == ("column 1", "column 2", "column 3")
    assert any(
        statement.startswith("12 poses in imu.log: rest intervals of at least")
        for statement in draft.statements
    )
    document = draft.make_document(tmp_path / "camp")
    assert document["records"] == {"time": {"sampling_rate": "100 Hz"}}
    assert document["triad"] == {"accelerometers": ["X", "Y", "Z"]}
    # A noise of 0.02 m/s^2 at 100 Hz is 0.3 mg/Hz^0.5.
    assert document["accelerometers"]["Y"] == {
        "input_axis": "north",
        "pendulous_axis": "up",
        "grade": "consumer",
        "specific_force": {"column": "column 2", "unit": "m/s^2"},
    }
    assert document["runs"] == [
        {
            "name": "imu",
            "motion": "static",
            "attitude": "unknown",
            "record": "../imu.log",
            "poses": {"rest": "1.5 s"},
        }
    ]
    campaign = read_campaign(write_description(draft, tmp_path / "camp"))
    assert campaign.triad is not None


def test_temperature_column_determines_slopes(tmp_path):
    """The sensor warms by 8 K over 40 poses; its X axis reads 2 mm/s^2 more for each."""
    truth = simulate_poses(3.0, 1.0, 40, noise=0.005, seed=3)
    warm = 22.0 + 8.0 * (1.0 - np.exp(-truth.time / 60.0))
    values = truth.values + BIAS
    values[:, 0] += 0.002 * (warm - 25.0)
    rows = np.column_stack([truth.time, values, np.round(warm, 1)])
    names = "t_s,ax,ay,az,Temp (°C)"
    np.savetxt(tmp_path / "imu.csv", rows, "%.5f", ",", header=names, comments="", encoding="utf-8")
    draft = make_draft(read_files([tmp_path / "imu.csv"]), PLACE, "poses")
    assert "temperature: column 'Temp (°C)', in degC" in draft.statements
    document = draft.make_document(tmp_path)
    assert document["records"]["temperature"] == {"column": "Temp (°C)", "unit": "degC"}
    campaign = read_campaign(write_description(draft, tmp_path / "camp"))
    slopes = campaign.change(
        {"model": {"terms": ["K_F", "K_I", "delta_O", "delta_P", "K_F.temperature"]}}
    )
    result = calibrate(slopes)
    for name, true in (("X", 0.002 / 9.81), ("Y", 0.0), ("Z", 0.0)):
        coefficient = result.accelerometers[name].coefficients["K_F.temperature"]
        assert coefficient.u < 2e-5
        assert abs(coefficient.value - true) < 4.0 * coefficient.u
    assert result.inputs.temperatures == pytest.approx([295.15, 273.15 + warm.max()], abs=0.1)


def test_temperature_in_counts_is_not_used(tmp_path, values):
    time = 0.01 * np.arange(len(values))
    counts = np.full(len(values), 3120.0)
    rows = np.column_stack([time, values, counts])
    np.savetxt(tmp_path / "i.csv", rows, "%.5f", ",", header="t_s,ax,ay,az,temp", comments="")
    document = make_draft(read_files([tmp_path / "i.csv"]), PLACE, "poses").make_document(tmp_path)
    assert set(document["records"]) == {"time"}


def test_answers_override_guesses(tmp_path, values):
    looks = read_files([write_log(tmp_path, values)])
    more = {"X": "column 3", "Z": "column 1", "grade": "tactical", "rest": "3", "unit": "m/s^2"}
    poses_draft = make_poses_draft(looks, ANSWERS | more)
    document = poses_draft.make_document(tmp_path)
    assert poses_draft.problems == ()
    assert document["accelerometers"]["X"]["specific_force"]["column"] == "column 3"
    assert document["accelerometers"]["X"]["grade"] == "tactical"
    assert document["runs"][0]["poses"] == {"rest": "3 s"}
    with raises("duplicate-entry", "axis"):
        make_poses_draft(looks, ANSWERS | {"X": "column 2"}).make_document(tmp_path)
    # The kind itself, too.
    keys = [question.key for question in make_draft(looks, {}, "double-turntable").questions]
    assert "radius" in keys


def test_missing_information_is_asked(tmp_path, values):
    poses_draft = make_poses_draft(read_files([write_log(tmp_path, values)]))
    keys = [question.key for question in poses_draft.open_questions]
    assert keys == ["gravity", "latitude", "sampling_rate"]
    with raises("missing-answer", "sampling_rate:", "no time column"):
        poses_draft.make_document(tmp_path)


@pytest.mark.parametrize(("unit", "factor"), [("g", 1 / 9.81), ("mg", 1000 / 9.81)])
def test_magnitude_at_rest_determines_unit(tmp_path, values, unit, factor):
    time = np.arange(len(values)) * 10.0
    columns = {"t_ms": time} | {f"a{n}": factor * values[:, n] for n in range(3)}
    pl.DataFrame(columns).write_csv(tmp_path / "imu.csv")
    looks = read_files([tmp_path / "imu.csv"])
    assert guess_test(looks) == "poses"
    poses_draft = make_poses_draft(
        looks, {k: v for k, v in ANSWERS.items() if k != "sampling_rate"}
    )
    document = poses_draft.make_document(tmp_path)
    assert document["records"] == {"time": {"column": "t_ms", "unit": "ms"}}
    assert document["accelerometers"]["X"]["specific_force"] == {"column": "a0", "unit": unit}


def test_counts_require_sensitivity(tmp_path, values):
    field = np.cross(values, [0.3, 0.5, 0.1])  # what a magnetometer beside them might show
    columns = {f"a{n}": np.round(1670.0 * values[:, n]) for n in range(3)}
    columns |= {f"m{n}": field[:, n] for n in range(3)}
    pl.DataFrame(columns).write_csv(tmp_path / "imu.csv")
    looks = read_files([tmp_path / "imu.csv"])
    poses_draft = make_poses_draft(looks, ANSWERS)
    assert poses_draft.column_names == ("a0", "a1", "a2")
    assert poses_draft.open_questions == []
    document = poses_draft.make_document(tmp_path)
    output = document["accelerometers"]["Z"]["output"]
    assert output["unit"] == "count"
    assert float(output["sensitivity"].split()[0]) == pytest.approx(1670.0 * 9.81, rel=0.02)
    assert "count/g" in format_document(document, {})
    named = make_poses_draft(looks, ANSWERS | {"unit": "count", "sensitivity": "16384 count/g"})
    write_description(named, tmp_path / "camp")


MIDDLE = np.array([33124.0, 33275.0, 32364.0])


def write_raw(file, values, *, counts=415.0, middle=MIDDLE):
    """Write numbers of a converter as MATLAB does in ASCII: the time first, and no names."""
    time = np.arange(len(values)) / 100.0
    raw = np.round(middle + counts * values)
    np.savetxt(file, np.column_stack([time, raw]), fmt="%16.7e")
    return read_files([file])


def test_counts_with_offset_have_zero_and_sensitivity(tmp_path):
    looks = write_raw(tmp_path / "imu_acc.txt", simulate_poses(4.0, 1.5, count=24).values + BIAS)
    assert guess_test(looks) == "poses"
    draft = make_draft(looks, {"gravity": "9.81 m/s^2", "latitude": "52 deg"}, "poses")
    assert draft.open_questions == []
    document = draft.make_document(tmp_path / "camp")
    assert document["records"] == {"time": {"column": "column 1", "unit": "s"}}
    for name, middle, bias in zip("XYZ", MIDDLE, BIAS, strict=True):
        output = document["accelerometers"][name]["output"]
        assert float(output["sensitivity"].split()[0]) == pytest.approx(415.0 * 9.81, rel=0.02)
        # Four digits of it, and sensitivities that are not alike.
        assert float(output["zero"].split()[0]) == pytest.approx(middle + 415.0 * bias, abs=60.0)
    result = calibrate(read_campaign(write_description(draft, tmp_path / "camp")))
    assert result.state == "good"
    for name, middle, bias in zip("XYZ", MIDDLE, BIAS, strict=True):
        read = result.accelerometers[name].output["bias"]
        assert abs(read.value - (middle + 415.0 * bias)) < 3.0 * read.u < 30.0


def test_few_poses_do_not_determine_offset(tmp_path, values):
    """The four parameters of a sphere need more than a few poses."""
    looks = write_raw(tmp_path / "imu.txt", values[: int(8 * 5.5 * 100)])
    assert guess_test(looks) is None


def test_row_numbers_are_not_time(tmp_path, values):
    columns = {"n_samples": np.arange(len(values))}
    columns |= {f"acc_{n}": values[:, n] for n in range(3)}
    pl.DataFrame(columns).write_csv(tmp_path / "session.csv")
    looks = read_files([tmp_path / "session.csv"])
    assert guess_test(looks) == "poses"
    keys = [question.key for question in make_poses_draft(looks).open_questions]
    assert keys == ["gravity", "latitude", "sampling_rate"]
    document = make_poses_draft(looks, ANSWERS).make_document(tmp_path / "camp")
    assert document["records"] == {"time": {"sampling_rate": "100 Hz"}}


def test_separate_files_are_poses(tmp_path):
    rng = np.random.default_rng(4)
    forces = rng.normal(size=(16, 3))
    forces *= 9.81 / np.linalg.norm(forces, axis=1)[:, None]
    files = []
    for number, force in enumerate(forces, 1):
        files.append(tmp_path / f"pos{number:02d}.csv")
        noisy = force + BIAS + 0.02 * rng.normal(size=(400, 3))
        columns = {"time_s": np.arange(400) / 100.0, "x": noisy[:, 0], "y": noisy[:, 1]}
        pl.DataFrame(columns | {"z": noisy[:, 2]}).write_csv(files[-1])
    looks = read_files(files)
    assert guess_test(looks) == "poses"
    draft = make_draft(looks, {"gravity": "9.81 m/s^2", "latitude": "52 deg"}, "poses")
    assert any(
        statement.startswith("16 poses in 16 files: rest intervals")
        for statement in draft.statements
    )
    result = calibrate(read_campaign(write_description(draft, tmp_path / "camp")))
    assert len(result.triad.poses) == 16
    for name, bias in zip("XYZ", BIAS, strict=True):
        c = result.accelerometers[name].coefficients["K_F"]
        assert abs(c.value - bias / 9.81) < 3.0 * c.u < 3e-3
    # One of them alone shows nothing of the kind.
    assert guess_test(looks[:1]) is None


@pytest.mark.parametrize(("unit", "size"), [("m/s^2", 9.81), ("g", 1.0), ("count", 4096.0)])
def test_table_rows_are_poses(tmp_path, unit, size):
    rng = np.random.default_rng(6)
    forces = rng.normal(size=(24, 3))
    forces /= np.linalg.norm(forces, axis=1)[:, None]
    values = size * (forces * [1.01, 0.99, 1.0] + BIAS / 10.0 + 1e-3 * rng.normal(size=(24, 3)))
    values = np.round(values + 40000.0) if unit == "count" else values
    columns = {"No": np.arange(1, 25)} | {f"a{n} ({unit})": values[:, n] for n in range(3)}
    pl.DataFrame(columns).write_csv(tmp_path / "poses.csv")
    looks = read_files([tmp_path / "poses.csv"])
    assert guess_test(looks) == "poses"
    draft = make_draft(looks, {"gravity": "9.81 m/s^2", "latitude": "52 deg"}, "poses")
    assert [question.key for question in draft.open_questions] == []
    assert "24 poses, one per row; the attitudes are unknown" in draft.statements
    result = calibrate(read_campaign(write_description(draft, tmp_path / "camp")))
    assert len(result.triad.poses) == 24
    for name, own, bias in zip("XYZ", (1.01, 0.99, 1.0), BIAS, strict=True):
        c, b = (result.accelerometers[name].output[key] for key in ("scale_factor", "bias"))
        middle = 40000.0 if unit == "count" else 0.0
        assert abs(c.value - size * own) < 3.5 * c.u < 0.01 * size
        assert abs(b.value - size * bias / 10.0 - middle) < 3.5 * b.u < 0.01 * size


def test_single_supply_voltage_has_zero(tmp_path, values):
    time = np.arange(len(values)) * 10.0
    columns = {"t_ms": time} | {f"U{n}": 1.65 + 0.0337 * values[:, n] for n in range(3)}
    pl.DataFrame(columns).write_csv(tmp_path / "imu.csv")
    vs = {k: v for k, v in ANSWERS.items() if k != "sampling_rate"} | {"unit": "V"}
    poses_draft = make_poses_draft(read_files([tmp_path / "imu.csv"]), vs)
    guess = {question.key: question.guess for question in poses_draft.questions}
    assert float(guess["Y zero"].split()[0]) == pytest.approx(1.65, abs=0.02)
    document = make_poses_draft(
        read_files([tmp_path / "imu.csv"]), vs | {"Y zero": "1.5 V"}
    ).make_document(tmp_path)
    assert document["accelerometers"]["Y"]["output"]["zero"] == "1.5 V"


def test_other_records_are_not_poses(tmp_path, values):
    rng = np.random.default_rng(2)
    still = 9.81 * np.tile([0.0, 0.6, 0.8], (len(values), 1)) + 0.02 * rng.normal(size=values.shape)
    for name, these in (("still", still), ("few", values[:2000]), ("rates", 0.01 * values)):
        columns = {f"a{n}": these[:, n] for n in range(3)}
        pl.DataFrame(columns).write_csv(tmp_path / f"{name}.csv")
        assert guess_test(read_files([tmp_path / f"{name}.csv"])) is None


# As loggers write them


def layouts(time, values):
    """Yield name, lines before the rows, rows and the columns of the axes, of several makes."""
    ns = 1617181920123456789 + np.round(time * 1e9).astype(np.int64)
    cells = [",".join(f"{one:.6f}" for one in row) for row in values]
    yield (
        "a robot's bag",
        ["%time,field.header.seq,field.header.stamp,w.x,w.y,w.z,a.x,a.y,a.z"],
        [
            f"{t},{n},{t},0.0,0.0,0.0,{row}"
            for n, (t, row) in enumerate(zip(ns, cells, strict=True))
        ],
        ("a.x", "a.y", "a.z"),
    )
    yield (
        "a drone's inertial unit",
        ["#timestamp [ns],w_x [rad s^-1],a_x [m s^-2],a_y [m s^-2],a_z [m s^-2]"],
        [f"{t},0.001,{row}" for t, row in zip(ns, cells, strict=True)],
        ("a_x [m s^-2]", "a_y [m s^-2]", "a_z [m s^-2]"),
    )
    yield (
        "a wearable with a row of units",
        ['"sep=,"', "Unix_CAL,Accel_X_CAL,Accel_Y_CAL,Accel_Z_CAL,", "ms,m/(s^2),m/(s^2),m/(s^2),"],
        [f"{t / 1e6:.3f},{row}," for t, row in zip(ns, cells, strict=True)],
        ("Accel_X_CAL", "Accel_Y_CAL", "Accel_Z_CAL"),
    )
    yield (
        "an autopilot's arrays",
        ["timestamp,accel_m_s2[0],accel_m_s2[1],accel_m_s2[2]"],
        [f"{int(t * 1e6) + 99000123},{row}" for t, row in zip(time, cells, strict=True)],
        ("accel_m_s2[0]", "accel_m_s2[1]", "accel_m_s2[2]"),
    )
    yield (
        "dates without names",
        [],
        [
            f"2024-01-01 14:{int(t) // 60:02d}:{t % 60:06.3f},{row}"
            for t, row in zip(time, cells, strict=True)
        ],
        ("column 2", "column 3", "column 4"),
    )


NAMES_OF_LAYOUTS = [name for name, *_ in layouts(np.zeros(1), np.zeros((1, 3)))]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES_OF_LAYOUTS)
def test_logger_layouts_are_understood(tmp_path, name):
    truth = simulate_poses(2.6, 0.8, 12)
    values = truth.values + BIAS
    _, head, rows, axes = next(
        actual_layout for actual_layout in layouts(truth.time, values) if actual_layout[0] == name
    )
    (tmp_path / "log.csv").write_text("\n".join([*head, *rows]) + "\n", encoding="utf-8")
    looks = read_files([tmp_path / "log.csv"])
    assert guess_test(looks) == "poses"
    draft = make_draft(looks, PLACE, "poses")
    assert draft.column_names == axes
    campaign = read_campaign(write_description(draft, tmp_path / "camp"))
    assert len(calibrate(campaign).triad.poses) == 12


def write_rows(folder, time, values, head="t,ax,ay,az"):
    rows = np.column_stack([time, values])
    np.savetxt(folder / "log.csv", rows, "%.6g", ",", header=head, comments="")
    return read_files([folder / "log.csv"])


def test_packet_counter_is_not_time(tmp_path, values):
    looks = write_rows(tmp_path, 12000 + np.arange(len(values)), values, "PacketCounter,x,y,z")
    assert [
        open_question.key for open_question in make_poses_draft(looks, PLACE).open_questions
    ] == ["sampling_rate"]


def test_unnamed_time_after_row_counter_is_found(tmp_path, values):
    count = np.arange(len(values))
    looks = write_rows(
        tmp_path, np.column_stack([count, count / 100.0]), values, "index,v0,v1,v2,v3"
    )
    draft = make_poses_draft(looks, PLACE)
    assert draft.open_questions == []
    assert draft.make_document(tmp_path)["records"]["time"]["column"] == "v0"


def test_one_second_rests_are_found(tmp_path):
    truth = simulate_poses(1.0, 0.6, 20)
    draft = make_draft(write_rows(tmp_path, truth.time, truth.values + BIAS), PLACE, "poses")
    assert any(
        statement.startswith("20 poses in log.csv: rest intervals of at least 0.5 s")
        for statement in draft.statements
    )
    assert draft.make_document(tmp_path)["runs"][0]["poses"] == {"rest": "0.5 s"}


def test_short_poses_after_long_rest_are_found(tmp_path):
    """Two thirds of the poses are shorter than the default rest interval plus 1 s."""
    rng = np.random.default_rng(5)
    force = rng.normal(size=(30, 3))
    force *= 9.81 / np.linalg.norm(force, axis=1)[:, None]
    parts = []
    for place, one in enumerate(force):
        length = 50.0 if place == 0 else rng.uniform(1.2, 4.0)
        parts.append(np.tile(one, (round(100.0 * length), 1)))
        parts.append(one + rng.normal(0.0, 1.5, (100, 3)).cumsum(axis=0) / 5.0)
    values = np.concatenate(parts[:-1])
    values += 0.02 * rng.normal(size=values.shape) + BIAS
    looks = write_rows(tmp_path, 0.01 * np.arange(len(values)), values)
    assert make_poses_draft(looks, {"rest": "1.5 s"}).triad.means.shape[0] < 20
    draft = make_draft(looks, PLACE, "poses")
    assert draft.triad.means.shape[0] == 30
    result = calibrate(read_campaign(write_description(draft, tmp_path / "camp")))
    for name, bias in zip("XYZ", BIAS, strict=True):
        one = result.accelerometers[name].coefficients["K_F"]
        assert abs(one.value - bias / 9.81) < 4.0 * one.u


def test_axes_are_ordered_by_name(tmp_path, values):
    """Sensor Logger writes z, y, x, in nanoseconds since 1970."""
    time = np.arange(len(values))
    rows = [
        f"{1_700_000_000_000_000_000 + 10_000_000 * k},{0.01 * k:.4f},{z:.6f},{y:.6f},{x:.6f}\n"
        for k, (x, y, z) in zip(time, values, strict=True)
    ]
    (tmp_path / "log.csv").write_text("time,seconds_elapsed,z,y,x\n" + "".join(rows))
    draft = make_draft(read_files([tmp_path / "log.csv"]), PLACE, "poses")
    assert draft.column_names == ("x", "y", "z")
    assert len(calibrate(write_description(draft, tmp_path / "camp").parent).triad.poses) == 12


def test_irregular_rows_of_phone_are_read(tmp_path, values):
    kept = np.sort(np.random.default_rng(3).permutation(len(values))[: len(values) * 2 // 3])
    looks = write_rows(tmp_path, kept, values[kept], "timestamp_ms,ax,ay,az")
    answers = {"time unit": "s"}  # 1 s for 10 ms
    assert make_poses_draft(looks, PLACE | answers).guesses[0].time.column == "timestamp_ms"
    looks = write_rows(tmp_path, 0.01 * kept, values[kept], "Time (s),ax,ay,az")
    draft = make_draft(looks, PLACE, "poses")
    assert draft.open_questions == []
    assert draft.triad.means.shape[0] == 12


def test_stepwise_clock_is_not_time(tmp_path, values):
    time = np.floor(np.arange(len(values)) / 5.0) / 20.0
    looks = write_rows(tmp_path, time, values)
    assert guess_test(looks) == "poses"
    assert [
        open_question.key for open_question in make_poses_draft(looks, PLACE).open_questions
    ] == ["sampling_rate"]


def test_filtered_gravity_is_not_sensor(tmp_path, values):
    both = np.column_stack([values - BIAS, values])
    head = "t,gravity_x,gravity_y,gravity_z,acc_x,acc_y,acc_z"
    looks = write_rows(tmp_path, 0.01 * np.arange(len(values)), both, head)
    assert make_draft(looks, PLACE, "poses").column_names == ("acc_x", "acc_y", "acc_z")


def test_forces_without_gravity_are_reported(tmp_path):
    truth = simulate_poses(4.0, 1.5)
    smooth = np.repeat(truth.force, 550, axis=0)[: len(truth.values)]
    rests = np.arange(len(truth.values)) % 550 < 400
    values = np.where(rests[:, None], truth.values - smooth, truth.values - smooth.mean(axis=0))
    axes = [f"Linear Acceleration {axis} (m/s^2)" for axis in "xyz"]
    looks = write_rows(tmp_path, truth.time, values, ",".join(["Time (s)", *axes]))
    assert guess_test(looks) is None
    reasons = explain_unknown_test(looks)
    assert any(
        "are nearly zero at rest, so a filter must have removed gravity" in s for s in reasons
    )


def faces(count, tilt=0.005, seed=6):
    """Simulate a sensor that is set by hand on its six faces in turn."""
    rng = np.random.default_rng(seed)
    truth = simulate_poses(4.0, 1.0, count, noise=0.01, seed=seed)
    axes = np.concatenate([np.eye(3), -np.eye(3)])[np.arange(count) % 6]
    axes = axes + rng.normal(0.0, tilt, axes.shape)
    force = 9.81 * axes / np.linalg.norm(axes, axis=1)[:, None]
    values = truth.values.copy()
    for place, one in enumerate(force):
        values[500 * place : 500 * place + 400] += one - truth.force[place]
    return truth.time, values + BIAS


def test_six_faces_set_twice_do_not_determine_angles(tmp_path):
    """Only products of tilts would determine an angle, so it is undetermined."""
    draft = make_draft(write_rows(tmp_path, *faces(13)), PLACE, "poses")
    assert draft.make_document(tmp_path)["model"] == {"terms": ["K_F", "K_I"]}
    assert any(
        "poses near the six faces do not determine the angles" in s for s in draft.statements
    )
    result = calibrate(read_campaign(write_description(draft, tmp_path / "camp")))
    for name, bias in zip("XYZ", BIAS, strict=True):
        own = result.accelerometers[name].coefficients
        assert abs(own["K_F"].value - bias / 9.81) < 4.0 * own["K_F"].u
        assert abs(own["K_I"].value - 1.0) < 4.0 * own["K_I"].u


@pytest.mark.skipif(not REAL.exists(), reason="the real records are not here")
def test_measured_six_faces_match_sums_and_differences(tmp_path):
    """Half the sum and half the difference of opposite faces tell the same, but for their tilts."""
    answers = {"gravity": "9.8066 m/s^2", "latitude": "49.6 deg", "sampling_rate": "204.8 Hz"}
    draft = make_draft(read_files([REAL / "session.csv"]), answers, "poses")
    assert draft.column_names == ("acc_x", "acc_y", "acc_z")
    assert draft.make_document(tmp_path)["model"] == {"terms": ["K_F", "K_I"]}
    result = calibrate(read_campaign(write_description(draft, tmp_path / "camp")))
    assert result.state == "good" or {f.code for f in result.findings} == {"unjudged-readings"}
    rows = np.loadtxt(REAL / "session.csv", delimiter=",", skiprows=1)[:, 4:7] / 9.8066
    sections = json.loads((REAL / "sections.json").read_text())
    for place, name in enumerate("XYZ"):
        up, down = (
            rows[slice(*sections[f"{name.lower()}_{side}"].values()), place].mean() for side in "pa"
        )
        own = result.accelerometers[name].coefficients
        assert abs(own["K_F"].value - 0.5 * (up + down)) < 2.0 * own["K_F"].u
        # A tilt of 1.5 deg takes 3.4e-4 of a face.
        assert abs(own["K_I"].value - 0.5 * (up - down)) < 2.0 * own["K_I"].u + 3.4e-4


@pytest.mark.parametrize("in_table", [False, True])
def test_six_faces_require_stated_uncertainty(tmp_path, in_table):
    time, values = faces(6)
    looks = write_rows(tmp_path, time, values)
    if in_table:
        means = [values[500 * place :][:400].mean(axis=0) for place in range(6)]
        looks = write_rows(tmp_path, np.arange(1, 7), means, "pose,x,y,z")
    (open_question,) = make_draft(looks, PLACE, "poses").open_questions
    assert open_question.key == "u"
    assert "cannot be estimated from only 6 poses" in open_question.text
    draft = make_draft(looks, PLACE | {"u": "0.003 m/s^2", "grade": "consumer"}, "poses")
    result = calibrate(read_campaign(write_description(draft, tmp_path / "camp")))
    for name, bias in zip("XYZ", BIAS, strict=True):
        k_f = result.accelerometers[name].coefficients["K_F"]
        assert abs(k_f.value - bias / 9.81) < 4.0 * k_f.u


def test_unit_of_unnamed_volts_is_asked(tmp_path, values):
    looks = write_rows(tmp_path, 0.01 * np.arange(len(values)), 1.65 + values / 9.81 / 3.0)
    assert guess_test(looks) == "poses"
    assert [
        open_question.key for open_question in make_poses_draft(looks, PLACE).open_questions
    ] == ["unit"]
    document = make_poses_draft(looks, PLACE | {"unit": "V"}).make_document(tmp_path)
    size, unit = document["accelerometers"]["X"]["output"]["sensitivity"].split(" ")
    assert (float(size), unit) == (pytest.approx(1.0 / 3.0, rel=0.01), "V/g")


def test_unsigned_numbers_raise(tmp_path, values):
    counts = np.mod(np.round(values / 9.81 * 16384.0), 65536.0)
    looks = write_rows(tmp_path, 0.01 * np.arange(len(values)), counts)
    with raises("unsigned-numbers", "16-bit", "65536", "32768"):
        guess_test(looks)


def test_second_sensor_in_file_is_reported(tmp_path, values):
    both = np.column_stack([values, 1.02 * values + 0.05])
    looks = write_rows(tmp_path, 0.01 * np.arange(len(values)), both, "t,a1,a2,a3,b1,b2,b3")
    draft = make_draft(looks, PLACE, "poses")
    assert draft.column_names == ("a1", "a2", "a3")
    assert (
        "three further axes are at rest at the same times. They belong to a second sensor and "
        "are not used; to calibrate that sensor, answer X=b1, Y=b2, Z=b3"
    ) in draft.statements
    other = make_draft(looks, PLACE | {"X": "b1", "Y": "b2", "Z": "b3"}, "poses")
    assert other.column_names == ("b1", "b2", "b3")


def test_words_between_numbers_raise(tmp_path):
    (tmp_path / "log.txt").write_text("AcX = -8272 | AcY = -14018 | AcZ = -2056\n" * 40)
    with pytest.raises(RecordError, match="Remove words between the numeric cells"):
        read_files([tmp_path / "log.txt"])


@pytest.mark.parametrize("count", [9, 10])
def test_nine_poses_have_model_of_bias_and_scale_factor(tmp_path, count):
    truth = simulate_poses(4.0, 1.0, count, noise=0.01, seed=4)
    looks = write_rows(tmp_path, truth.time, truth.values + BIAS)
    draft = make_draft(looks, PLACE | {"grade": "consumer"}, "poses")
    few = count == 9
    assert draft.make_document(tmp_path).get("model") == (
        {"terms": ["K_F", "K_I"]} if few else None
    )
    assert any("nine poses or fewer" in statement for statement in draft.statements) is few
    result = calibrate(read_campaign(write_description(draft, tmp_path / "camp")))
    for name, bias in zip("XYZ", BIAS, strict=True):
        k_f = result.accelerometers[name].coefficients["K_F"]
        assert abs(k_f.value - bias / 9.81) < 4.0 * k_f.u


def test_stated_uncertainty_of_poses_is_used(tmp_path):
    """Nine poses have no degree of freedom left beside nine parameters: u is the stated one's."""
    truth = simulate_poses(4.0, 1.0, 9, noise=0.01, seed=8)
    draft = make_draft(write_rows(tmp_path, truth.time, truth.values + BIAS), PLACE, "poses")
    document = draft.make_document(tmp_path / "camp")
    document["model"] = {"terms": ["K_F", "K_I", "delta_O", "delta_P"], "assume": "all"}
    u = {}
    for stated in (0.01, 0.02):
        document["runs"][0]["poses"]["u"] = f"{stated} m/s^2"
        folder = tmp_path / f"u{stated}"
        folder.mkdir()
        text = format_document(document).replace("../log.csv", str(tmp_path / "log.csv"))
        (folder / "campaign.toml").write_text(text, encoding="utf-8")
        result = calibrate(folder)
        u[stated] = result.accelerometers["Z"].coefficients["K_F"].u
    assert u[0.02] == pytest.approx(2.0 * u[0.01], rel=1e-2)
    document["runs"][0]["poses"]["u"] = "0 m/s^2"
    (folder / "campaign.toml").write_text(format_document(document), encoding="utf-8")
    with raises("value-out-of-range", "u:"):
        read_campaign(folder)
