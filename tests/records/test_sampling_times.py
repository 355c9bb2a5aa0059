"""Times in two columns."""

import numpy as np
import pytest

import counterspin as cs
from counterspin.ingest.contents import read_contents
from counterspin.records.dialect import AUTODETECT
from counterspin.records.formats import read_scaled
from counterspin.records.record import ColumnSpec
from counterspin.records.sampling import SplitTime, find_split_time

RATE, ROWS = 64.0, 4096
TIME = np.arange(ROWS) / RATE
SECONDS, REST = np.floor(TIME) + 1_700_000_000, np.round((TIME % 1.0) * 1e9)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("coarse", "fine", "name"),
    [
        (("sec", SECONDS), ("nanosec", REST), "sec [s] + nanosec [ns]"),
        (("stamp.secs", SECONDS), ("stamp.nsecs", REST), "stamp.secs [s] + stamp.nsecs [ns]"),
        (("tv_sec", SECONDS), ("tv_usec", REST / 1e3), "tv_sec [s] + tv_usec [us]"),
        (("GPSWeek", 0.0 * TIME + 2300), ("GPS TOW (ms)", 3e8 + 1e3 * TIME), None),
        (("week", 0.0 * TIME + 2300), ("tow", 345600.0 + TIME), "week [week] + tow [s]"),
        (("GWk", 0.0 * TIME + 2300), ("GMS", 3e8 + 1e3 * TIME), "GWk [week] + GMS [ms]"),
    ],
)
def test_two_columns_are_combined_to_time(tmp_path, coarse, fine, name):
    file = tmp_path / "record.csv"
    signal = np.random.default_rng(1).normal(size=ROWS)
    columns = [coarse[1], fine[1], signal]
    rows = "\n".join(",".join(f"{v:.12g}" for v in row) for row in zip(*columns, strict=True))
    file.write_text(f"{coarse[0]},{fine[0]},a\n{rows}\n", encoding="utf-8")
    first = read_contents(file).columns[0]
    assert name is None or first.name == name
    assert first.is_timestamp
    np.testing.assert_allclose(first.values, TIME, atol=1e-9)
    # The reader of records, by the name that a description states.
    spec = ColumnSpec(first.name, unit="iso", target_unit="s", kind="stamps")
    (read,) = read_scaled(file, [spec], AUTODETECT)
    np.testing.assert_allclose(read, TIME, atol=1e-9)
    (noise,) = cs.noise(file, columns=["a"], unit="m/s^2").signals
    assert noise.sampling_rate == pytest.approx(RATE)


def test_unrelated_columns_are_not_time():
    assert find_split_time({"sec": SECONDS, "nanosec": REST[::-1]}) is None
    assert find_split_time({"sec": TIME, "nanosec": REST}) is None
    assert find_split_time({"sec": SECONDS, "ns": 1e9 * TIME}) is None
    assert SplitTime.parse("sec [s] + nanosec") is None
