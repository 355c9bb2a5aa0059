"""The mean of a record: whole revolutions only, waves beside it, an uncertainty that covers."""

import math

import numpy as np
import pytest

from counterspin.errors import RecordError
from counterspin.records.mean import mean_of_record
from counterspin.records.record import ColumnSpec

TIME, SIGNAL = ColumnSpec("t"), ColumnSpec("f", 2.0)


def write(folder, t, f, name="r.csv"):
    rows = "".join(f"{a!r},{b!r}\n" for a, b in zip(t.tolist(), f.tolist(), strict=True))
    (folder / name).write_text("t,f\n" + rows.replace("nan", ""), encoding="utf-8")
    return folder / name


def test_waves_of_the_revolution_do_not_reach_the_mean(tmp_path):
    rate, t = 3.0, np.arange(0.0, 7.3, 0.013)
    wave = 0.7 * np.cos(rate * t + 1.0) + 0.1 * np.sin(2 * rate * t)
    mean = mean_of_record(write(tmp_path, t, 5.0 + wave), TIME, SIGNAL, rate)
    assert mean.value == pytest.approx(10.0, abs=1e-12)
    assert mean.revolutions == 3
    assert mean.samples == math.ceil(3 * 2 * math.pi / rate / 0.013)


@pytest.mark.parametrize("correlated", [False, True], ids=["white", "walk in stretches"])
def test_u_covers_the_scatter_of_means(tmp_path, correlated):
    """400 records: z rms within four standard errors of that of Student's t with 31 dof."""
    rng = np.random.default_rng(1)
    t, trials, z = np.arange(0.0, 32.0, 0.02), 200, []
    for _ in range(trials):
        noise = rng.normal(0.0, 1.0, t.size)
        if correlated:
            noise = np.convolve(noise, np.ones(5) / 5.0, "same")
        mean = mean_of_record(write(tmp_path, t, noise), TIME, SIGNAL, 2.0 * math.pi)
        z.append(mean.value / mean.u)
    rms = math.sqrt(np.mean(np.square(z)))
    assert rms == pytest.approx(math.sqrt(31 / 29), abs=4.0 / math.sqrt(2.0 * trials) * 1.1)


@pytest.mark.parametrize(
    ("t", "f", "rate", "message"),
    [
        ([0.0, 1.0, 0.5], [1.0, 1.0, 1.0], 0.0, "line 4: time does not run forward"),
        (np.arange(50) * 0.01, np.ones(50), 1.0, "shorter than a revolution at 1 rad/s"),
        (np.arange(5) * 1.0, np.ones(5), 0.0, "5 samples are too few"),
        (np.arange(50) * 1.0, np.where(np.arange(50) % 5, 1.0, np.nan), 0.0, "20% of the rows"),
    ],
)
def test_what_cannot_be_averaged_is_told(tmp_path, t, f, rate, message):
    path = write(tmp_path, np.asarray(t), np.asarray(f))
    with pytest.raises(RecordError, match=message):
        mean_of_record(path, TIME, SIGNAL, rate)


def test_the_line_of_a_fault_counts_empty_cells(tmp_path):
    t = np.arange(100) * 0.1
    t[60] = 0.0
    f = np.ones(100)
    f[[10, 20]] = np.nan
    with pytest.raises(RecordError, match="line 62: time does not run forward"):
        mean_of_record(write(tmp_path, t, f), TIME, SIGNAL, 0.0)


def test_a_record_without_rows_and_one_with_comments(tmp_path):
    path = write(tmp_path, np.arange(100) * 0.1, np.ones(100))
    path.write_text("# before\n" + path.read_text("utf-8").replace("5.0,", "# here\n5.0,"), "utf-8")
    assert mean_of_record(path, TIME, SIGNAL, 0.0).samples == 100
    with pytest.raises(RecordError, match="no rows"):
        mean_of_record(write(tmp_path, np.empty(0), np.empty(0)), TIME, SIGNAL, 0.0)
