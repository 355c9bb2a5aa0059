"""Plots of records in a time window: decimation keeps visible outliers."""

import numpy as np
import pytest

from counterspin.application.record_plots import MAX_WINDOW_SEGMENTS, segment_extrema

RUN = {"name": "three", "run": "fast"}


def test_chunk_extremes_match_loop():
    values = np.random.default_rng(1).normal(size=1000)
    values[[3, 500]] = np.nan
    values[600:700] = np.nan
    edges = np.linspace(7, 991, 38).astype(int)
    extremes = segment_extrema(values, edges)
    for (low, high), begin, end in zip(extremes, edges[:-1], edges[1:], strict=True):
        part = values[begin:end][~np.isnan(values[begin:end])]
        if len(part):
            assert (low, high) == (part.min(), part.max())
        else:
            assert np.isnan([low, high]).all()


@pytest.fixture
def spiked_record(folder):
    """Return the stored record of the fast run with one outlier in its middle."""
    file = folder / "three" / "fast.csv"
    header, *rows = file.read_text().splitlines()
    cells = rows[60].split(",")
    cells[header.split(",").index("east_m")] = "99.5"
    rows[60] = ",".join(cells)
    file.write_text("\n".join([header, *rows]) + "\n")
    return np.genfromtxt(file, delimiter=",", names=True)


def test_record_summary_has_rows_times_and_columns(page, spiked_record):
    overview = page.get("/api/record-about", params=RUN).json()["overview"]
    assert overview["rows"] == len(spiked_record)
    assert (overview["first"], overview["last"]) == (
        spiked_record["time_s"][0],
        spiked_record["time_s"][-1],
    )
    assert overview["columns"] == [
        {"name": "angle_rad", "unit": "rad"},
        {"name": "Qx: east_m", "unit": "m"},
        {"name": "Qy: north_m", "unit": "m"},
    ]
    assert overview["used"] == [None, None]


def test_short_window_has_all_rows_and_long_window_keeps_outlier(page, spiked_record):
    time, east = spiked_record["time_s"], spiked_record["east_m"]
    whole = RUN | {"low": time[0], "high": time[-1]}
    body = page.get("/api/record", params=whole | {"parts": 1000}).json()
    assert body["is_complete"]
    assert body["time"] == pytest.approx(time)
    assert body["columns"][1] == pytest.approx(east, rel=1e-6)
    body = page.get("/api/record", params=whole | {"parts": 10}).json()
    assert not body["is_complete"]
    assert len(body["time"]) == len(body["columns"][1]) == 20
    assert np.all(np.diff(body["time"]) > 0.0)
    assert max(body["columns"][1]) == 99.5
    assert min(body["columns"][1]) == pytest.approx(east.min(), rel=1e-6)
    # A zoomed window has the rows and one additional row on each side.
    near = RUN | {"low": time[58], "high": time[62], "parts": 10}
    body = page.get("/api/record", params=near).json()
    assert body["time"] == pytest.approx(time[57:64])
    assert body["columns"][1][3] == 99.5


@pytest.mark.parametrize(
    ("query", "status"),
    [
        (RUN | {"run": "none", "low": 0, "high": 1}, 404),
        (RUN | {"low": "nan", "high": 1}, 400),
        (RUN | {"low": 5, "high": -5, "parts": -7}, 200),
        (RUN | {"low": -1e300, "high": 1e300, "parts": 10 * MAX_WINDOW_SEGMENTS}, 200),
    ],
)
def test_window_query_status(page, query, status):
    assert page.get("/api/record", params=query).status_code == status


def test_unreadable_record_states_cause(page, folder):
    (folder / "three" / "fast.csv").write_text("time_s,angle_rad,east_m,north_m\n1,2,three,4\n")
    response = page.get("/api/record-about", params=RUN)
    assert response.status_code == 422
    assert response.json()["error"].startswith("three/fast.csv")
