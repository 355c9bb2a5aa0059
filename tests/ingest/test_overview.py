"""What is seen in files, and the kind of test that they look like."""

import math

import numpy as np
import pytest

from counterspin.cli import main
from counterspin.errors import CampaignError
from counterspin.ingest.contents import FileColumn, FileContents
from counterspin.ingest.overview import UndecidedDraft, likely_test, overview


def contents_of(columns, units=None, words=None):
    """Return the contents of a file with these columns."""
    made = tuple(
        FileColumn(name, (units or {}).get(name, ""), np.asarray(values, dtype=float))
        for name, values in columns.items()
    )

    class Named:
        name = "log.csv"

    return FileContents(Named, made, tuple(words or ()), "", first_words=words or {})


def test_columns_are_shown_with_range_unit_and_looks():
    time = np.arange(400) * 0.05
    angle = 2.0 * math.pi * 0.5 * time
    columns = {
        "t": time,
        "th": np.degrees(angle) % 360.0,
        "E": 2.5 * np.cos(angle),
        "k": time * 0 + 3,
    }
    lines = overview(
        [contents_of(columns, {"t": "s", "th": "deg", "E": "m"}, {"mode": ["a", "b"]})]
    )
    assert lines[0] == "log.csv: 400 rows, about 20 rows a second"
    assert lines[1] == "  t [s]: 0 to 19.95, the time"
    assert lines[2] == "  th [deg]: 0 to 351, advances evenly as an angle"
    assert lines[3].endswith("swings at a steady rate")
    assert lines[4:] == ["  k: always 3", "  mode: words, a, b"]


def test_nominal_orientations_are_no_measurements():
    """A table of six faces, the nominal direction beside what was read."""
    faces = np.vstack([np.eye(3), -np.eye(3)] * 2)
    read = faces * 1.01 + np.random.default_rng(1).normal(0.0, 2e-3, faces.shape)
    columns = {f"n{axis}": faces[:, k] for k, axis in enumerate("xyz")}
    columns |= {f"a{axis}": read[:, k] for k, axis in enumerate("xyz")}
    contents = contents_of(columns)
    assert "nominal orientations, not measurements" in overview([contents])[1]
    assert likely_test([contents]) == "poses"
    assert likely_test([contents_of(dict(list(columns.items())[:3]))]) is None


@pytest.mark.parametrize("unit", ["", "rad/s"])
def test_what_swings_without_an_axis_or_an_angle_is_no_turntable(unit):
    """Elements of an attitude matrix do, and rates of a hand."""
    time = np.arange(600) * 0.02
    swing = np.sin(2.0 * math.pi * 0.8 * time)
    contents = contents_of({"time": time, "M33": swing}, {"time": "s", "M33": unit})
    assert likely_test([contents]) is None
    draft = UndecidedDraft.of([contents])
    assert [question.key for question in draft.open_questions] == ["test"]
    with pytest.raises(CampaignError, match="Which kind of test is it"):
        draft.complete()


def test_a_file_of_no_known_kind_is_never_asked_for_a_radius(tmp_path, capsys):
    rows = "".join(f"{k},{k % 7},{(k * k) % 11}\n" for k in range(200))
    (tmp_path / "log.csv").write_text("a,b,c\n" + rows)
    assert main(["init", str(tmp_path / "c"), "--yes", "--from", str(tmp_path / "log.csv")]) == 2
    told = capsys.readouterr()
    assert "Seen in the files:" in told.out
    assert "Which kind of test is it?" in told.err
    assert "radius" not in told.out + told.err.replace("radius of a centrifuge", "")
