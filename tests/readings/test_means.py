"""The mean of a record: whole revolutions only, waves beside it, an uncertainty that covers."""

import math

import numpy as np
import pytest

from counterspin.errors import RecordError
from counterspin.readings.means import mean_of_record, read_rows, stated_rotation, u_of_mean
from counterspin.records.memory import make_memory_table
from counterspin.records.record import ColumnSpec, RecordColumns

TIME, SIGNAL = ColumnSpec("t"), ColumnSpec("f", 2.0)


def write_record(folder, t, f, name="r.csv"):
    rows = "".join(f"{a!r},{b!r}\n" for a, b in zip(t.tolist(), f.tolist(), strict=True))
    (folder / name).write_text("t,f\n" + rows.replace("nan", ""), encoding="utf-8")
    return folder / name


def make_table(t, f):
    return make_memory_table("r", {"t": t, "f": f})


def mean_record(source, rate):
    record = read_rows(source, RecordColumns(TIME, None, {"A": SIGNAL}), rate)
    return mean_of_record(record, SIGNAL.name, stated_rotation(record.time, rate))[0]


def test_harmonics_of_revolution_cancel_in_mean(tmp_path):
    rate, t = 3.0, np.arange(0.0, 7.3, 0.013)
    wave = 0.7 * np.cos(rate * t + 1.0) + 0.1 * np.sin(2 * rate * t)
    mean_result = mean_record(write_record(tmp_path, t, 5.0 + wave), rate)
    assert mean_result.value == pytest.approx(10.0, abs=1e-12)
    assert mean_result.revolutions == 3
    assert mean_result.samples == math.ceil(3 * 2 * math.pi / rate / 0.013)


def test_u_covers_scatter_of_means(tmp_path):
    """Of 200 records of white noise and of noise alike over five samples; 95 % at 2 u at least."""
    rng = np.random.default_rng(1)
    t, trials = np.arange(0.0, 32.0, 0.02), 100
    for width in (1, 5):
        covered = 0
        for _ in range(trials):
            noise = np.convolve(rng.normal(0.0, 1.0, t.size), np.ones(width) / width, "same")
            mean_result = mean_record(make_table(t, noise), 2.0 * math.pi)
            covered += abs(mean_result.value) < 2.0 * mean_result.u
        assert covered > trials * 0.95 - 4.0 * math.sqrt(trials * 0.95 * 0.05)


@pytest.mark.parametrize("rate", [0.0, 9.0], ids=["at rest", "on the arm"])
@pytest.mark.parametrize("size", [10.0, 1e3, 1e6, 1e30])
def test_rare_outliers_do_not_change_mean(rate, size):
    """Beside a level that wanders and the waves of a revolution; less than a tenth of u."""
    rng = np.random.default_rng(2)
    t = np.arange(20_000) * 0.01
    f = 9.0 + rng.normal(0.0, 1e-3, t.size) + np.cumsum(rng.normal(0.0, 1e-5, t.size))
    f += 0.01 * np.cos(rate * t) if rate else 0.0
    clean = mean_record(make_table(t, f), rate)
    f[500::1000] += size * 1e-3
    mean_result = mean_record(make_table(t, f), rate)
    assert abs(mean_result.value - clean.value) < 0.1 * clean.u
    assert mean_result.u == pytest.approx(clean.u, rel=0.1)
    left_out = mean_result.report.outliers["f"]
    assert left_out - clean.report.outliers["f"] == 20
    assert f"{left_out} outliers in column 'f' were rejected." in mean_result.report.notes()


def test_single_gross_outlier_is_rejected(tmp_path):
    rng = np.random.default_rng(3)
    t, f = np.arange(1000) * 0.01, 4.5 + rng.normal(0.0, 5e-5, 1000)
    f[400] = 450.0
    for source in (write_record(tmp_path, t, f), make_table(t, f)):
        mean_result = mean_record(source, 0.0)
        assert mean_result.value == pytest.approx(9.0, abs=1e-5)
        assert mean_result.u < 1e-5
        assert mean_result.report.outliers == {"f": 1}


def test_dropout_is_rejected():
    rng = np.random.default_rng(4)
    t, f = np.arange(20_000) * 0.01, 4.5 + rng.normal(0.0, 1e-3, 20_000)
    f[7000:7200] = 0.0
    for rate in (0.0, 6.0):
        mean_result = mean_record(make_table(t, f), rate)
        assert mean_result.value == pytest.approx(9.0, abs=5.0 * mean_result.u)
        assert mean_result.u < 1e-4
        assert 200 <= mean_result.report.outliers["f"] <= 400


def test_repeated_rows_gaps_and_empty_cells_are_counted(tmp_path):
    rng = np.random.default_rng(5)
    t, f = np.arange(1000) * 0.01, 4.5 + rng.normal(0.0, 1e-3, 1000)
    t[600:] += 5.0
    f[[10, 20]] = np.nan
    t, f = np.insert(t, 300, t[299]), np.insert(f, 300, f[299])
    for source in (write_record(tmp_path, t, f), make_table(t, f)):
        mean_result = mean_record(source, 0.0)
        report = mean_result.report
        assert (report.rows, report.repeated, report.differing, report.n_gaps) == (1001, 1, 0, 1)
        assert report.empty["f"] == 2
        assert report.gaps[0].length == pytest.approx(5.01)
        assert mean_result.samples == 998
        assert mean_result.value == pytest.approx(9.0, abs=5.0 * mean_result.u)


def test_nonuniform_time_stamps_are_accepted():
    rng = np.random.default_rng(6)
    t = np.cumsum(rng.uniform(0.005, 0.015, 4000))
    wave = 0.3 * np.cos(3.0 * t) + 0.05 * np.sin(6.0 * t)
    noise = rng.normal(0.0, 1e-3, t.size)
    for rate, f in ((0.0, 5.0 + noise), (3.0, 5.0 + wave + noise)):
        mean_result = mean_record(make_table(t, f), rate)
        assert mean_result.value == pytest.approx(10.0, abs=4.0 * mean_result.u)
        assert mean_result.u == pytest.approx(2e-3 / math.sqrt(mean_result.samples), rel=1.0)
        assert not mean_result.report.outliers["f"]


def test_records_of_same_samples_have_same_digest(tmp_path):
    rng = np.random.default_rng(7)
    t, f = np.arange(100) * 0.1, rng.normal(0.0, 1.0, 100)
    first, again, other = (
        mean_record(source, 0.0).digest
        for source in (write_record(tmp_path, t, f), make_table(t, f), make_table(t, f[::-1]))
    )
    assert first is not None
    assert first == again
    assert first != other
    assert mean_record(make_table(t, np.ones(100)), 0.0).digest is None


@pytest.mark.parametrize(
    ("t", "f", "rate", "message"),
    [
        ([0.0, 1.0, 0.5], [1.0, 1.0, 1.0], 0.0, "line 4: the time decreases"),
        (
            np.arange(50) * 0.01,
            np.ones(50),
            1.0,
            "0.078 revolutions at the stated rate; the minimum is 1",
        ),
        (np.arange(5) * 1.0, np.ones(5), 0.0, "5 samples are too few"),
        (
            np.arange(50.0),
            np.where(np.arange(50) % 5, 1.0, np.nan),
            0.0,
            "'f' has 10 empty cells in 50 rows",
        ),
    ],
)
def test_invalid_record_raises(tmp_path, t, f, rate, message):
    path = write_record(tmp_path, np.asarray(t), np.asarray(f))
    with pytest.raises(RecordError, match=message):
        mean_record(path, rate)


def test_line_number_counts_empty_cells(tmp_path):
    t = np.arange(100) * 0.1
    t[60] = 0.0
    f = np.ones(100)
    f[[10, 20]] = np.nan
    with pytest.raises(RecordError, match="line 62: the time decreases"):
        mean_record(write_record(tmp_path, t, f), 0.0)


def test_empty_record_raises_and_comments_are_ignored(tmp_path):
    path = write_record(tmp_path, np.arange(100) * 0.1, np.ones(100))
    path.write_text("# before\n" + path.read_text("utf-8").replace("5.0,", "# here\n5.0,"), "utf-8")
    assert mean_record(path, 0.0).samples == 100
    with pytest.raises(RecordError, match="no rows"):
        mean_record(write_record(tmp_path, np.empty(0), np.empty(0)), 0.0)


# u of a mean: what the next record differs by, whatever the noise

TRIALS, STRETCHES, EACH = 400, 64, 16


def white_noise(rng):
    return rng.normal(size=2 * STRETCHES * EACH)


def flicker_noise(rng):
    """1/f noise by fractional integration of white noise (Kasdin 1995)."""
    steps = np.arange(1.0, 2 * STRETCHES * EACH)
    response = np.append(1.0, np.cumprod((steps - 0.5) / steps))
    size = 2 * response.size
    return np.fft.irfft(np.fft.rfft(white_noise(rng), size) * np.fft.rfft(response, size))[
        : size // 2
    ]


def random_walk(rng):
    return np.cumsum(white_noise(rng))


@pytest.mark.parametrize(
    ("noise", "least"),
    [
        (white_noise, 0.95),
        (flicker_noise, 0.95),
        (random_walk, 0.88),
        (lambda rng: 3.0 * white_noise(rng) + flicker_noise(rng), 0.93),
        (lambda rng: white_noise(rng) + 0.005 * random_walk(rng), 0.77),
    ],
    ids=["white", "flicker", "walk", "white and flicker", "a walk that hardly shows"],
)
def test_u_covers_mean_of_next_record(noise, least):
    """Differences within 2 u sqrt 2 at least as often as stated, less 3 standard errors of 400."""
    rng = np.random.default_rng(1)
    covered, sizes, differences = 0, [], []
    for _ in range(TRIALS):
        first, then = noise(rng).reshape(2, STRETCHES, EACH).mean(axis=2)
        u, difference = u_of_mean(first), first.mean() - then.mean()
        covered += abs(difference) < 2.0 * math.sqrt(2.0) * u
        sizes.append(u)
        differences.append(difference)
    assert covered > TRIALS * least - 3.0 * math.sqrt(TRIALS * least * (1.0 - least))
    # And it is of the size of what it covers, not as large as would cover anything.
    true = math.sqrt(np.mean(np.square(differences)) / 2.0)
    assert 0.5 < np.median(sizes) / true < 1.9


def test_u_of_white_noise_is_at_most_60_percent_too_large():
    rng = np.random.default_rng(2)
    u_of_mean_results = [u_of_mean(rng.normal(size=STRETCHES)) for _ in range(TRIALS)]
    assert 1.0 < np.median(u_of_mean_results) * math.sqrt(STRETCHES) < 1.6


def test_u_is_proportional_to_scale_and_independent_of_level():
    means = np.random.default_rng(3).normal(size=20)
    assert u_of_mean(5.0 + 1e-6 * means) == pytest.approx(1e-6 * u_of_mean(means), rel=1e-6)
    assert u_of_mean(np.full(20, 9.8)) == 0.0
