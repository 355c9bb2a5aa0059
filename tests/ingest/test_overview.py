"""What is seen in files, and the kind of test that they look like."""

import math

import numpy as np
import pytest
from raising import raises

from counterspin.cli import main
from counterspin.errors import CampaignError
from counterspin.ingest.column_roles import guess_file
from counterspin.ingest.contents import FileColumn, FileContents, read_files
from counterspin.ingest.description import make_draft
from counterspin.ingest.overview import UndecidedDraft, describe_files, guess_test


def contents_of(columns, units=None, words=None):
    """Return the contents of a file with these columns."""
    file_columns = tuple(
        FileColumn(name, (units or {}).get(name, ""), np.asarray(values, dtype=float))
        for name, values in columns.items()
    )

    class Named:
        name = "log.csv"

    return FileContents(Named, file_columns, tuple(words or ()), "", first_text_cells=words or {})


def test_overview_shows_range_unit_and_role():
    time = np.arange(400) * 0.05
    angle = 2.0 * math.pi * 0.5 * time
    columns = {
        "t": time,
        "th": np.degrees(angle) % 360.0,
        "E": 2.5 * np.cos(angle),
        "k": time * 0 + 3,
    }
    lines = describe_files(
        [contents_of(columns, {"t": "s", "th": "deg", "E": "m"}, {"mode": ["a", "b"]})]
    )
    assert lines[0] == "log.csv: 400 rows, about 20 rows per second"
    assert lines[1] == "  t [s]: 0 to 19.95, the time"
    assert lines[2] == "  th [deg]: 0 to 351, advances at a steady rate, like an angle"
    assert lines[3].endswith("oscillates at a steady frequency")
    assert lines[4:] == ["  k: always 3", "  mode: text (a, b)"]


def test_nominal_orientations_are_not_measurements():
    """The table of six faces has nominal directions and readings."""
    faces = np.vstack([np.eye(3), -np.eye(3)] * 2)
    readings = faces * 1.01 + np.random.default_rng(1).normal(0.0, 2e-3, faces.shape)
    columns = {f"n{axis}": faces[:, k] for k, axis in enumerate("xyz")}
    columns |= {f"a{axis}": readings[:, k] for k, axis in enumerate("xyz")}
    contents = contents_of(columns)
    assert "nominal orientations (values -1, 0 and 1 only)" in describe_files([contents])[1]
    assert guess_test([contents]) == "poses"
    assert guess_test([contents_of(dict(list(columns.items())[:3]))]) is None


@pytest.mark.parametrize("unit", ["", "rad/s"])
def test_waves_without_axis_or_angle_have_unknown_test(unit):
    """Examples are the elements of an attitude matrix and rates of hand motion."""
    time = np.arange(600) * 0.02
    swing = np.sin(2.0 * math.pi * 0.8 * time)
    contents = contents_of({"time": time, "M33": swing}, {"time": "s", "M33": unit})
    assert guess_test([contents]) is None
    draft = UndecidedDraft.from_contents([contents])
    assert [question.key for question in draft.open_questions] == ["test"]
    with raises("missing-answer"):
        draft.complete()


def test_missing_answers_are_counted_as_answers():
    time = np.arange(400) * 0.05
    columns = {"t": time, "th": 180.0 * time % 360.0, "E": 2.5 * np.cos(np.pi * time)}
    draft = make_draft([contents_of(columns, {"t": "s"})], {}, "double-turntable")
    with pytest.raises(CampaignError, match=r"init: \d answers are still needed\n  gravity: "):
        draft.complete()


def test_file_of_unknown_test_is_not_asked_for_radius(tmp_path, capsys):
    rows = "".join(f"{k},{k % 7},{(k * k) % 11}\n" for k in range(200))
    (tmp_path / "log.csv").write_text("a,b,c\n" + rows)
    assert main(["init", str(tmp_path / "c"), "--yes", "--from", str(tmp_path / "log.csv")]) == 2
    output = capsys.readouterr()
    assert "Detected in the files:" in output.out
    assert "What is the test type?" in output.err
    assert "radius" not in output.out + output.err.replace("radius of a centrifuge", "")


def test_rate_of_alternating_sensors_counts_all_rows(tmp_path):
    """Rows of a sensor every 20 ms, and of another 3 ms after each: 100 rows per second."""
    rows = [
        f"{9 * 10**13 + 20_000_000 * n + d};{s};{n % 7}"
        for n in range(400)
        for d, s in ((0, "ACC"), (3_000_000, "GYR"))
    ]
    (tmp_path / "log.csv").write_text("\n".join(["timestamp;sensor;x", *rows]) + "\n")
    contents = read_files([tmp_path / "log.csv"])
    assert "about 100.1 rows per second from all sensors together" in describe_files(contents)[0]
    assert "swings" not in " ".join(describe_files(contents))


def test_constant_and_nominal_columns_are_unused(tmp_path):
    angle = np.arange(0.0, 360.0, 30.0)
    up = np.cos(np.radians(angle))
    rows = [
        f"{a:g},{np.sign(round(u, 9)):g},0,{1.25 * u + 0.003:.6f}"
        for a, u in zip(angle, up, strict=True)
    ]
    (tmp_path / "t.csv").write_text(
        "\n".join(["position_deg,nominal,residual,out_mA", *rows]) + "\n"
    )
    contents = read_files([tmp_path / "t.csv"])
    assert guess_test(contents) == "tumble"
    roles = make_draft(contents, {}, "tumble").roles
    assert (roles["nominal"], roles["residual"], roles["out_mA"]) == ("unused", "unused", "reading")
    time = np.arange(400) * 0.05
    east = 2.5 * np.cos(np.pi * time)
    rows = [f"{t:.2f},{e:.6f},0" for t, e in zip(time, east, strict=True)]
    (tmp_path / "r.csv").write_text("\n".join(["time_s,east_m,north residual_m", *rows]) + "\n")
    (signal,) = make_draft(
        read_files([tmp_path / "r.csv"]), {}, "double-turntable"
    ).common_guess.signals
    assert signal.column == "east_m"


def test_lost_samples_and_bursts_are_reported(tmp_path):
    rng = np.random.default_rng(1)
    time = np.arange(2000) * 0.01
    keep = np.append(rng.random(1999) > 0.2, True)
    lost = contents_of({"time_s": time[keep], "a": rng.normal(size=int(keep.sum()))})
    assert f"missing samples: about {2000 - keep.sum()} (" in " ".join(describe_files([lost]))
    packet = np.arange(2000) // 8
    stamps = 0.01 * (8 * packet + rng.random(250)[packet])
    burst = contents_of({"time_s": stamps, "a": rng.normal(size=2000)})
    lines = describe_files([burst])
    assert "times or bursts" in lines[1]
    assert "time is calculated from the row count" in lines[-1]
    assert guess_file(burst).unused_columns[0] == "time_s"
    assert guess_file(burst).sampling_rate == pytest.approx(100.0, rel=2e-3)


def test_rows_with_repeated_times_are_counted(tmp_path):
    rng = np.random.default_rng(2)
    time, values = np.arange(2000) * 0.01, rng.normal(size=2000)
    time[2::3] = time[1::3][: time[2::3].size]
    repeated = contents_of({"time_s": time, "a": values})
    assert "2000 rows of column 'time_s' have 1334 distinct times" in describe_files([repeated])[-1]
    assert guess_file(repeated).sampling_rate == pytest.approx(100.0, rel=1e-3)
    keep = rng.random(2000) > 0.2
    lost = guess_file(contents_of({"time_s": time[keep], "a": values[keep]}))
    assert (lost.time, lost.sampling_rate) == (None, None)
    assert "samples are missing" in lost.uncounted_reason
    twice = np.sort(np.append(np.arange(2000), np.arange(0, 2000, 5)))
    doubled = {"time_s": 0.01 * twice, "a": values[twice], "no": np.arange(2400.0)}
    guess = guess_file(contents_of(doubled))
    assert guess.time is not None
    assert guess.time.column == "time_s"
