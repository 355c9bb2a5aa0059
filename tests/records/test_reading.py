"""Reading records: what is refused, what is dropped and counted, and what comes out."""

import math
from itertools import pairwise
from pathlib import Path

import h5py
import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from counterspin.arrays import aligned
from counterspin.errors import RecordError
from counterspin.records.reading import ColumnSpec, Record, read_record
from counterspin.records.reduction import in_pieces
from counterspin.records.spikes import median

RATE = math.pi
RADIUS = 2.5
EAST = np.array([1.0, 0.0, 0.0])
TIME, ANGLE, SIGNAL = "time_s", "angle_rad", "east_m"


def table(
    n: int = 1000, step: float = 0.02, rate: float = RATE, seed: int = 1, noise: float = 0.01
) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    time = np.round(np.arange(n) * step, 9)
    angle = rate * time + 1e-6 * rng.standard_normal(n)
    signal = RADIUS * np.cos(rate * time) + 1e-3 * time**2 + noise * rng.standard_normal(n)
    return {TIME: time, ANGLE: angle, SIGNAL: signal}


def lines(columns: dict[str, np.ndarray], separator: str = ",") -> list[str]:
    rows = zip(*columns.values(), strict=True)
    return [separator.join(columns)] + [separator.join(repr(float(x)) for x in r) for r in rows]


def write(path: Path, columns: dict[str, np.ndarray] | list[str]) -> Path:
    if path.suffix == ".parquet":
        pl.DataFrame(columns).write_parquet(path)
    else:
        text = columns if isinstance(columns, list) else lines(columns)
        path.write_text("\n".join(text) + "\n", encoding="utf-8")
    return path


def read(path: Path, rate: float = RATE, **changed) -> Record:
    options = {
        "time": ColumnSpec(TIME),
        "angle": ColumnSpec(ANGLE),
        "signals": {"Qx": ColumnSpec(SIGNAL)},
        "radius": RADIUS,
        "input_axes": {"Qx": EAST},
    }
    return read_record(path, nominal_rate=rate, **(options | changed))


def refusal(path: Path, **options) -> str:
    with pytest.raises(RecordError) as caught:
        read(path, **options)
    assert path.name in str(caught.value)
    return str(caught.value)


# --- formats --------------------------------------------------------------------------------


def test_every_format_gives_the_same_record(tmp_path):
    columns = table()
    paths = [write(tmp_path / "a.csv", columns), write(tmp_path / "a.parquet", columns)]
    with h5py.File(tmp_path / "root.h5", "w") as file:
        for name, values in columns.items():
            file[name] = values
    with h5py.File(tmp_path / "group.hdf5", "w") as file:
        for name, values in columns.items():
            file[f"run/{name}"] = values
    savemat(tmp_path / "five.mat", columns, oned_as="row")
    with h5py.File(tmp_path / "seven.mat", "w") as file:  # MATLAB writes columns as (1, n)
        for name, values in columns.items():
            file[name] = values[None, :]
    paths += [tmp_path / name for name in ("root.h5", "group.hdf5", "five.mat", "seven.mat")]
    first, *others = [read(path) for path in paths]
    np.testing.assert_array_equal(first.time, columns[TIME])
    np.testing.assert_array_equal(first.angle, columns[ANGLE])
    np.testing.assert_array_equal(first.signals["Qx"], columns[SIGNAL])
    for other in others:
        np.testing.assert_array_equal(other.time, first.time)
        np.testing.assert_array_equal(other.signals["Qx"], first.signals["Qx"])


@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_dialects_of_csv(tmp_path, separator, end):
    columns = table(n=400)
    text = lines({"note": np.zeros(400), **columns}, separator)
    text[0] = separator.join(['"note"', f" {TIME}", f"{ANGLE} ", SIGNAL])
    text[9] = "# the operator sneezed here"
    path = tmp_path / "run.csv"
    path.write_bytes(("\ufeff# a comment" + end + end.join(text) + end).encode())
    record = read(path)
    assert record.report.rows == 399
    np.testing.assert_array_equal(record.signals["Qx"], np.delete(columns[SIGNAL], 8))


def test_comments_and_blanks_among_the_numbers(tmp_path):
    text = lines(table())
    text[3] = "  " + text[3].replace(",", " , ")
    text.insert(7, "# a comment")
    record = read(write(tmp_path / "run.csv", text))
    np.testing.assert_array_equal(record.signals["Qx"], table()[SIGNAL])


def test_units_become_si(tmp_path):
    columns = table()
    filed = {
        TIME: columns[TIME] * 1e3 + 5e6,
        ANGLE: np.degrees(columns[ANGLE]),
        SIGNAL: columns[SIGNAL] * 1e3,
    }
    record = read(
        write(tmp_path / "run.csv", filed),
        time=ColumnSpec(TIME, 1e-3),
        angle=ColumnSpec(ANGLE, math.pi / 180),
        signals={"Qx": ColumnSpec(SIGNAL, 1e-3)},
    )
    assert record.start_time == pytest.approx(5000.0)
    np.testing.assert_allclose(record.time, columns[TIME], atol=1e-9)
    np.testing.assert_allclose(record.angle, columns[ANGLE], atol=1e-12)
    np.testing.assert_allclose(record.signals["Qx"], columns[SIGNAL], rtol=1e-14)


# --- files that cannot be read --------------------------------------------------------------


def test_missing_file_directory_and_unknown_kind(tmp_path):
    assert "no such file" in refusal(tmp_path / "none.csv")
    (tmp_path / "folder.csv").mkdir()
    assert "directory" in refusal(tmp_path / "folder.csv")
    assert ".parquet" in refusal(tmp_path / "run.xlsx")


@pytest.mark.parametrize("name", ["run.csv", "run.parquet", "run.h5", "run.mat"])
def test_empty_and_damaged_files(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(b"")
    assert "empty" in refusal(path)
    path.write_bytes(b"\x00\x01 this is not a record \xff" * 40)
    refusal(path)


def test_blank_lines_after_the_header_and_at_the_end(tmp_path):
    text = lines(table())
    text[1:1] = ["", ""]
    record = read(write(tmp_path / "run.csv", [*text, ""]))
    np.testing.assert_array_equal(record.time, table()[TIME])
    text[500] = "10.0,x,1.0"
    message = refusal(write(tmp_path / "run.csv", text))
    assert "line 501: column 'angle_rad' holds the text 'x'" in message


def test_datasets_without_any_space(tmp_path):
    with h5py.File(tmp_path / "run.h5", "w") as file:
        for name in table():
            file[name] = h5py.Empty("f8")
    assert f"'{TIME}' has the shape None; one column is needed" in refusal(tmp_path / "run.h5")


def test_header_only(tmp_path):
    assert "no rows" in refusal(write(tmp_path / "run.csv", [f"{TIME},{ANGLE},{SIGNAL}"]))
    assert "no header" in refusal(write(tmp_path / "run.csv", ["# only this", ""]))


def test_a_file_without_a_header(tmp_path):
    message = refusal(write(tmp_path / "run.csv", lines(table())[1:]))
    assert "line 1" in message
    assert "name the columns" in message


@pytest.mark.parametrize("name", ["run.csv", "run.parquet"])
def test_missing_column_lists_those_present(tmp_path, name):
    path = write(tmp_path / name, table())
    message = refusal(path, signals={"Qx": ColumnSpec("eastt_m")})
    assert "'eastt_m'" in message
    assert f"'{TIME}', '{ANGLE}', '{SIGNAL}'" in message
    assert "Did you mean 'east_m'?" in message


@pytest.mark.parametrize("row", [1, 7, 999])
def test_text_in_a_numeric_cell(tmp_path, row):
    text = lines(table())
    text[row] = ",".join([*text[row].split(",")[:2], "abc"])
    text.insert(0, "# a comment line counts too")
    message = refusal(write(tmp_path / "run.csv", text))
    assert f"line {row + 2}:" in message
    assert "'east_m'" in message
    assert "'abc'" in message


def test_decimal_comma_and_too_many_cells(tmp_path):
    text = [row.replace(".", ",") for row in lines(table(), ";")]
    assert "decimal point" in refusal(write(tmp_path / "run.csv", text))
    text = lines(table())
    text[5] += ",7"
    assert "line 6: the line has 4 cells" in refusal(write(tmp_path / "run.csv", text))


def test_text_column_of_parquet(tmp_path):
    columns = {**table(), SIGNAL: ["x"] * 1000}
    assert "String" in refusal(write(tmp_path / "run.parquet", columns))


def test_columns_of_different_length(tmp_path):
    with h5py.File(tmp_path / "run.h5", "w") as file:
        for name, values in table().items():
            file[name] = values[: 900 if name == TIME else None]
    assert "length" in refusal(tmp_path / "run.h5")


# --- the clock ------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_time_running_backwards(tmp_path, suffix):
    columns = table()
    columns[TIME][500] -= 1.0
    message = refusal(write(tmp_path / f"run{suffix}", columns))
    assert ("line 502:" if suffix == ".csv" else "row 501:") in message
    assert "backwards" in message


def test_time_backwards_far_into_a_long_record(tmp_path):
    columns = table(n=200_000, step=0.005)
    columns[TIME][131_072] = columns[TIME][131_070]
    assert "row 131073:" in refusal(write(tmp_path / "run.parquet", columns))


def test_repeated_rows_are_dropped_and_counted(tmp_path):
    text = lines(table())
    other = text[20].split(",")
    other[2] = "2.0"
    text[300:300] = [text[299]] * 3
    text.insert(21, ",".join(other))
    record = read(write(tmp_path / "run.csv", text))
    assert (record.report.repeated, record.report.differing) == (4, 1)
    np.testing.assert_array_equal(record.time, table()[TIME])
    np.testing.assert_array_equal(record.signals["Qx"], table()[SIGNAL])


def test_clock_that_jumps(tmp_path):
    columns = table()
    columns[TIME][400:] += 0.5
    message = refusal(write(tmp_path / "run.csv", columns))
    assert "line 402:" in message
    assert "clock jumps" in message
    assert "0.52 s" in message


def test_short_record(tmp_path):
    message = refusal(write(tmp_path / "run.csv", table(n=290)))  # 5.78 s of 6 s
    assert "2.89 revolutions" in message


def test_infinite_values(tmp_path):
    for column in (TIME, ANGLE, SIGNAL):
        columns = table()
        columns[column][10] = math.inf
        message = refusal(write(tmp_path / "run.csv", columns))
        assert "line 12" in message
        assert "infinite" in message


def test_gaps_are_listed_and_not_refused(tmp_path):
    columns = {name: np.delete(values, slice(300, 450)) for name, values in table().items()}
    record = read(write(tmp_path / "run.csv", columns))
    assert record.report.gap_count == 1
    assert record.report.gaps[0].time == pytest.approx(299 * 0.02)
    assert record.report.gaps[0].length == pytest.approx(151 * 0.02)
    np.testing.assert_array_equal(record.angle, columns[ANGLE])


# --- empty cells ----------------------------------------------------------------------------


@pytest.mark.parametrize("word", ["", "nan", "NaN"])
def test_few_empty_cells_are_counted(tmp_path, word):
    text = lines(table())
    for place, row in ((2, 100), (2, 101), (1, 200), (0, 300)):
        cells = text[row + 1].split(",")
        cells[place] = word
        text[row + 1] = ",".join(cells)
    record = read(write(tmp_path / "run.csv", text))
    assert record.report.empty == {TIME: 1, ANGLE: 1, SIGNAL: 2}
    assert len(record.time) == 998
    assert np.flatnonzero(np.isnan(record.signals["Qx"])).tolist() == [100, 101]


@pytest.mark.parametrize("column", [TIME, ANGLE, SIGNAL])
def test_more_than_five_percent_empty(tmp_path, column):
    columns = table()
    columns[column][10:61] = np.nan
    path = write(tmp_path / "run.csv", columns)
    assert f"'{column}' has 51 empty cells in 1000 rows" in refusal(path)
    columns[column][60] = table()[column][60]
    read(write(path, columns))


# --- the angle ------------------------------------------------------------------------------

WRAPS = {
    "0 to 2 pi": lambda a: np.mod(a, 2 * math.pi),
    "-pi to pi": lambda a: math.pi - np.mod(math.pi - a, 2 * math.pi),
}


@pytest.mark.parametrize("wrap", WRAPS.values(), ids=WRAPS)
@pytest.mark.parametrize("rate", [RATE, -RATE])
@pytest.mark.parametrize("hole", [None, slice(300, 301), slice(300, 580)])
def test_wrapped_angles(tmp_path, wrap, rate, hole):
    columns = table(n=3000, rate=rate)
    expected = columns[ANGLE].copy()
    columns[ANGLE] = wrap(columns[ANGLE])
    if hole is not None:  # the second hole takes 2.8 revolutions
        columns = {name: np.delete(values, hole) for name, values in columns.items()}
        expected = np.delete(expected, hole)
    record = read(write(tmp_path / "run.csv", columns), rate=rate)
    assert record.report.wrapped
    turns = (record.angle - expected) / (2 * math.pi)
    np.testing.assert_allclose(turns, round(turns[0]), atol=1e-12)
    assert record.report.rate == pytest.approx(rate, rel=1e-6)


def test_wrapped_degrees_and_a_rate_a_little_off(tmp_path):
    columns = table(n=200_000, step=0.03, rate=1.03 * RATE)
    columns[ANGLE] = np.mod(np.degrees(columns[ANGLE]), 360.0)
    record = read(write(tmp_path / "run.parquet", columns), angle=ColumnSpec(ANGLE, math.pi / 180))
    np.testing.assert_allclose(record.angle, 1.03 * RATE * record.time, atol=1e-5)


@pytest.mark.parametrize("wrapped", [False, True])
@pytest.mark.parametrize("size", [1e-3, 1.0, math.pi, 5.0])
def test_an_outlying_angle_is_dropped(tmp_path, wrapped, size):
    columns = table()
    places = [0, 17, 400, 401, 999]
    columns[ANGLE][places] += size
    if wrapped:
        columns[ANGLE] = np.mod(columns[ANGLE], 2 * math.pi)
    record = read(write(tmp_path / "run.csv", columns))
    assert record.report.outliers[ANGLE] == 5
    np.testing.assert_array_equal(record.time, np.delete(columns[TIME], places))
    np.testing.assert_allclose(record.angle, RATE * record.time, atol=1e-5)


@pytest.mark.parametrize("noisy", [True, False])
@pytest.mark.parametrize("size", [0.01, 0.5])
@pytest.mark.parametrize("place", [100, 500, 990])
def test_angle_that_jumps(tmp_path, place, size, noisy):
    columns = table()
    if not noisy:
        # In an angle without noise the jump is the smallest step that there is.
        columns[ANGLE] = RATE * columns[TIME]
    columns[ANGLE][place:] += size
    message = refusal(write(tmp_path / "run.csv", columns))
    assert f"line {place + 2}:" in message
    assert "angle jumps" in message


def test_coarse_encoder(tmp_path):
    columns = table(n=20_000, step=0.001)
    columns[ANGLE] = np.floor(columns[ANGLE] / 0.01) * 0.01
    record = read(write(tmp_path / "run.csv", columns), block=None)
    assert record.report.outliers[ANGLE] == 0
    np.testing.assert_array_equal(record.angle, columns[ANGLE])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: c[ANGLE].__imul__(180 / math.pi), "in degrees?"),
        (lambda c: c[ANGLE].__itruediv__(2 * math.pi), "in revolutions?"),
        (lambda c: c[ANGLE].__imul__(-1), "opposite sense"),
        (lambda c: c[TIME].__imul__(1e3), "in milliseconds?"),
        (lambda c: c[ANGLE].__imul__(1.2), "within 5 %"),
    ],
)
def test_a_rate_that_is_not_the_runs(tmp_path, change, words):
    columns = table()
    change(columns)
    assert words in refusal(write(tmp_path / "run.csv", columns))


def test_without_an_angle(tmp_path):
    columns = table()
    record = read(write(tmp_path / "run.csv", columns), angle=None)
    assert record.angle is None
    assert record.report.rate is None
    np.testing.assert_array_equal(record.signals["Qx"], columns[SIGNAL])


# --- outliers of a signal -------------------------------------------------------------------


@pytest.mark.parametrize("block", [None, "auto"])
def test_gaussian_noise_loses_nothing(tmp_path, block):
    columns = table(n=100_000, step=0.005)
    record = read(write(tmp_path / "run.parquet", columns), block=block)
    assert record.report.outliers[SIGNAL] <= 1  # 2e-4 are expected beyond six deviations
    assert record.report.used == 100_000


@pytest.mark.parametrize("step", [0.02, 0.2, 0.005])
def test_gross_outliers_are_found(tmp_path, step):
    columns = table(n=20_000, step=step)
    rng = np.random.default_rng(3)
    places = np.sort(rng.choice(20_000, 100, replace=False))
    columns[SIGNAL][places] += rng.choice([-1, 1], 100) * rng.uniform(0.15, 5, 100)
    record = read(write(tmp_path / "run.parquet", columns), block=None)
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(record.signals["Qx"])), places)
    assert record.report.outliers[SIGNAL] == 100
    assert [found.row for found in record.report.listed] == (places + 1).tolist()


@pytest.mark.parametrize("filler", [-9.99e33, 9.969209968386869e36, 1e300])
def test_a_filler_in_place_of_an_empty_cell(tmp_path, filler):
    columns = table()
    columns[SIGNAL][[5, 400, 401, 999]] = filler
    record = read(write(tmp_path / "run.csv", columns))
    assert record.report.outliers[SIGNAL] == 4
    assert np.flatnonzero(np.isnan(record.signals["Qx"])).tolist() == [5, 400, 401, 999]


@pytest.mark.parametrize("bias", [0.0, 1.0])
def test_a_fifth_of_outliers(tmp_path, bias):
    columns = table(n=10_000)
    rng = np.random.default_rng(4)
    places = rng.random(10_000) < 0.2
    columns[SIGNAL][places] += bias + 3 * rng.standard_normal(places.sum())
    record = read(write(tmp_path / "run.parquet", columns), block=None)
    lost = np.isnan(record.signals["Qx"])
    gross = np.abs(columns[SIGNAL] - table(n=10_000)[SIGNAL]) > 0.15
    assert lost[gross].mean() > 0.99
    assert lost[~places].mean() < 1e-3


def test_the_harmonics_of_a_quiet_record_are_no_outliers(tmp_path):
    # Specific force at 16 ppm of noise: a drifting rate and a K_II stand out of it.
    columns = table(n=20_000)
    phase = np.pi / 2 * columns[TIME] * (1 + 5e-7 * columns[TIME])
    columns[ANGLE] = phase
    columns[SIGNAL] = -6.17 * np.cos(phase) + 5e-5 * np.cos(2 * phase)
    columns[SIGNAL] += 1e-4 * np.random.default_rng(6).standard_normal(phase.size)
    path = write(tmp_path / "run.parquet", columns)
    record = read(path, rate=np.pi / 2, input_axes=None)
    assert record.report.outliers[SIGNAL] == 0


@pytest.mark.parametrize("noise", [0.0, 1e-5, 1e-3])
def test_quantised_signals_keep_their_samples(tmp_path, noise):
    columns = table(n=20_000, noise=noise)
    columns[SIGNAL] = np.round(columns[SIGNAL], 3)
    record = read(write(tmp_path / "run.parquet", columns))
    assert record.report.outliers[SIGNAL] == 0


def test_noise_free_and_constant_signals(tmp_path):
    columns = {**table(n=20_000, noise=0.0), "up_m": np.zeros(20_000)}
    record = read(
        write(tmp_path / "run.parquet", columns),
        signals={"Qx": ColumnSpec(SIGNAL), "Qz": ColumnSpec("up_m")},
        input_axes={"Qx": EAST, "Qz": np.array([0.0, 0.0, 1.0])},
    )
    assert record.report.outliers == {ANGLE: 0, SIGNAL: 0, "up_m": 0}


def test_louder_noise_is_not_outlying(tmp_path):
    columns = table(n=20_000)
    columns[SIGNAL][8000:9000] += 0.02 * np.random.default_rng(1).standard_normal(1000)
    record = read(write(tmp_path / "run.parquet", columns))
    assert record.report.outliers[SIGNAL] <= 2


# --- blocks ---------------------------------------------------------------------------------


def dense(n: int = 300_000) -> dict[str, np.ndarray]:
    return table(n=n, step=2 / (64 * 50.5))  # 50 samples to a block


def test_blocks_are_the_exact_means(tmp_path):
    columns = dense()
    record = read(write(tmp_path / "run.parquet", columns))
    assert record.report.block == 50
    means = {name: values.reshape(-1, 50).mean(axis=1) for name, values in columns.items()}
    np.testing.assert_allclose(record.time, means[TIME], rtol=1e-13)
    np.testing.assert_allclose(record.angle, means[ANGLE], rtol=1e-13)
    np.testing.assert_allclose(record.signals["Qx"], means[SIGNAL], atol=1e-13)
    spread = columns[TIME].reshape(-1, 50).std(axis=1)
    np.testing.assert_allclose(record.time_sd, spread, rtol=1e-6)
    assert (record.count == 50).all()


def test_point_samples_on_request(tmp_path):
    record = read(write(tmp_path / "run.parquet", dense(20_000)), block=None)
    assert len(record.time) == 20_000
    assert (record.count == 1).all()
    assert (record.time_sd == 0).all()


def test_blocks_of_a_damaged_record(tmp_path):
    columns = dense()
    rng = np.random.default_rng(5)
    columns[ANGLE] = np.mod(columns[ANGLE], 2 * math.pi)
    gross = np.zeros(300_000, dtype=bool)
    gross[rng.choice(300_000, 3000, replace=False)] = True
    columns[SIGNAL][gross] += 5.0
    columns[SIGNAL][rng.choice(300_000, 3000, replace=False)] = np.nan
    keep = np.ones(300_000, dtype=bool)
    keep[rng.choice(300_000, 300, replace=False)] = False
    keep[150_000:163_000] = False
    columns = {name: values[keep] for name, values in columns.items()}
    record = read(write(tmp_path / "run.parquet", columns))
    assert record.report.outliers[SIGNAL] == np.sum(gross[keep] & ~np.isnan(columns[SIGNAL]))
    assert record.time_sd.max() < 1.05 * 50 * record.report.step / math.sqrt(12)
    assert (np.diff(record.time) > 0).all()
    # Mean of R cos over a block, to second order in its spread; the parabola likewise.
    middle = RADIUS * np.cos(record.angle) * (1 - (RATE * record.time_sd) ** 2 / 2)
    rest = record.signals["Qx"] - middle - 1e-3 * (record.time**2 + record.time_sd**2)
    normal = rest * np.sqrt(record.count) / 0.01
    assert np.nanmax(np.abs(normal)) < 6
    assert np.nanstd(normal) == pytest.approx(1.0, abs=0.05)


def test_two_accelerometers_share_a_blocks_rows(tmp_path):
    columns = dense()
    columns["north_m"] = RADIUS * np.sin(RATE * columns[TIME])
    columns["north_m"][1000:1200] = np.nan  # four whole blocks
    columns["north_m"][5003] = np.nan
    record = read(
        write(tmp_path / "run.parquet", columns),
        signals={"Qx": ColumnSpec(SIGNAL), "Qy": ColumnSpec("north_m")},
        input_axes={"Qx": EAST, "Qy": np.array([0.0, 1.0, 0.0])},
    )
    assert np.flatnonzero(np.isnan(record.signals["Qy"])).tolist() == [20, 21, 22, 23]
    assert not np.isnan(record.signals["Qx"]).any()
    assert record.count[20] == 50
    assert record.count[100] == 49
    expected = np.delete(columns[SIGNAL][5000:5050], 3).mean()
    assert record.signals["Qx"][100] == pytest.approx(expected, abs=1e-13)


@settings(max_examples=15, deadline=None)
@given(st.integers(1, 200_000), st.integers(0, 2**32 - 1))
def test_the_result_does_not_depend_on_the_batches(tmp_path_factory, batch, seed):
    # Row groups of any size hand the rows over in other batches; pieces stay the same.
    columns = dense(140_000)
    rng = np.random.default_rng(seed)
    columns[SIGNAL][rng.choice(140_000, 50, replace=False)] += 3.0
    columns[SIGNAL][rng.choice(140_000, 50, replace=False)] = np.nan
    path = tmp_path_factory.mktemp("batches") / "run.parquet"
    frame = pl.DataFrame(columns)
    frame.write_parquet(path, row_group_size=max(batch, 2000))
    one = read(path)
    frame.write_parquet(path)
    other = read(path)
    np.testing.assert_array_equal(one.time, other.time)
    np.testing.assert_array_equal(one.signals["Qx"], other.signals["Qx"])
    assert one.report == other.report


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.integers(0, 90_000), min_size=1, max_size=6),
    st.integers(1, 70_000),
    st.sampled_from([[0, 1], [1, 0, 1]]),
)
def test_pieces_hold_every_row_once_and_in_order(lengths, size, places):
    ends = np.cumsum([0, *lengths])
    columns = [np.arange(ends[-1], dtype=float), -np.arange(ends[-1], dtype=float)]
    batches = ([x[a:b] for x in columns] for a, b in pairwise(ends))
    pieces = [np.array(piece) for piece in in_pieces(batches, places, lambda _: size)]
    assert [piece.shape[1] for piece in pieces[:-1]] == [size] * (len(pieces) - 1)
    if pieces:
        expected = np.array([columns[place] for place in places])
        np.testing.assert_array_equal(np.concatenate(pieces, axis=1), expected)
    else:
        assert ends[-1] == 0


@pytest.mark.parametrize("shape", [(1,), (1000,), (3, 65), (511, 128)])
def test_working_arrays_begin_with_a_cache_line(shape):
    array = aligned(*shape)
    assert array.shape == shape
    rows = array.reshape(-1, shape[-1]) if array.flags.c_contiguous else array
    assert all(row.ctypes.data % 64 == 0 for row in rows)


def test_an_infinite_value_is_refused_wherever_it_stands(tmp_path):
    # In an even stretch, in an uneven one, and in the last window, which overlaps another.
    for row, late in [(500, 0.0), (500, 0.02), (20_010, 0.0)]:
        columns = dense(20_011)
        columns[TIME][480:] += late
        columns[ANGLE][480:] += RATE * late
        columns[SIGNAL][row] = -np.inf
        words = refusal(write(tmp_path / "run.parquet", columns))
        assert f"row {row + 1}: column '{SIGNAL}' holds an infinite value." in words


@pytest.mark.parametrize("size", [0.2, 3.0, 1e300])
@pytest.mark.parametrize("row", [3, 127, 128, 20_000, 20_010])
def test_an_outlier_is_found_wherever_it_stands(tmp_path, row, size):
    # The last window overlaps the one before; all others are clean.
    columns = dense(20_011)
    columns[SIGNAL][row] += size
    record = read(write(tmp_path / "run.parquet", columns), block=None)
    assert [outlier.row for outlier in record.report.listed] == [row + 1]


def test_the_last_window_is_judged_by_what_is_left_of_the_noise(tmp_path):
    # Many outliers in all windows but the last, which has small ones: these stand out only once
    # those are no longer counted as noise.
    columns = table(n=1000)
    columns[SIGNAL][np.arange(5, 880, 12)] += 3.0
    columns[SIGNAL][[930, 980]] += 0.12
    record = read(write(tmp_path / "run.parquet", columns), block=None)
    found = [outlier.row - 1 for outlier in record.report.listed]
    assert found == [*range(5, 880, 12), 930, 980]


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=40))
def test_the_median_is_numpys(values):
    assert median(np.array(values)) == np.median(values)


# --- units of a signal ----------------------------------------------------------------------


@pytest.mark.parametrize("factor", [1e3, 1e-3, 1e2])
@pytest.mark.parametrize("place", [300, 1500, 2700])
@pytest.mark.parametrize("start", [False, True])
def test_a_unit_that_changes_on_the_way(tmp_path, factor, place, start):
    columns = table(n=3000)
    part = slice(None, place) if start else slice(place, None)
    columns[SIGNAL][part] *= factor
    message = refusal(write(tmp_path / "run.csv", columns))
    assert "changes its unit" in message
    found = int(message.split("line ")[1].split(":")[0])
    # Where the wave crosses zero, one unit is as good as the other.
    assert abs(found - 2 - place) <= 2


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda s: 1e3 * s, "m and mm"),
        (lambda s: 0.0 * s, "swings by 0 m"),
        (lambda s: 0.2 * s, "make 2.5 m: check the column's unit, the radius and the input axis"),
        (lambda s: -s, "180 degrees"),
        (lambda s: np.roll(s, 25), "check the input axis"),
    ],
)
def test_a_displacement_that_is_not_the_motions(tmp_path, change, words):
    columns = table(n=3000)
    columns[SIGNAL] = change(columns[SIGNAL])
    assert words in refusal(write(tmp_path / "run.csv", columns))


def test_other_observables_are_not_held_to_the_radius(tmp_path):
    columns = table(n=3000)
    columns[SIGNAL] *= -RATE * 10
    read(write(tmp_path / "run.csv", columns), input_axes=None)


@pytest.mark.parametrize("content", [bytes(3000), bytes(range(256)) * 40, b"\x89PNG\r\n\x1a\n"])
def test_a_file_that_is_not_text_is_refused(tmp_path, content):
    path = tmp_path / "run.csv"
    path.write_bytes(content)
    assert "line 1: this is not text in UTF-8" in refusal(path)
