"""Noise of records at rest, from recorder files to table, report and plot."""

import datetime
import json
import math
from functools import cache

import numpy as np
import polars as pl
import pytest
from campaigns import write_description
from raising import raises
from reading_descriptions import ACCELEROMETER, format_rest_run, format_site
from static_noise_sizes import disable_intervals

import counterspin as cs
from counterspin.campaign.documents import load_document
from counterspin.cli import main
from counterspin.errors import CampaignError, RecordError
from counterspin.inference.noise.model import Noise
from counterspin.inference.noise.simulation import draw_accelerometer_noise, draw_bias_noise

STEP, G = 0.01, 9.80665
N, B = 5e-5, 3e-4


def make_columns(n=6_000, order=0, seed=1):
    rng = np.random.default_rng(seed)
    time = np.arange(n) * STEP
    values = draw_accelerometer_noise(rng, time, N, order)
    values = values + draw_bias_noise(rng, time, Noise(0.0, flicker=B), order)
    return np.round(time, 4), values


@cache
def estimate_from_frame(n=6_000):
    """Return the noise estimated from a frame of these columns."""
    time, values = make_columns(n)
    (signal,) = cs.noise({"time_s": time, "Qx_g": values / G}).signals
    return signal


def write_record(folder, name="rest.csv", **more):
    time, values = make_columns()
    file = folder / name
    pl.DataFrame({"time_s": time, "Qx_g": 1.0 + values / G, **more}).write_csv(file)
    return file


@pytest.fixture
def skip_intervals():
    """Estimate noise components without their intervals."""
    with disable_intervals():
        yield


def find_component(signal, key):
    return signal.components[key]


def test_components_are_estimated_from_file_and_frame(tmp_path):
    file = write_record(tmp_path, temperature_degC=np.full(6_000, 23.0))
    estimate = cs.noise(file)
    (signal,) = estimate.signals
    assert (signal.name, signal.observable, signal.in_g) == ("Qx_g", "specific_force", True)
    assert estimate.unused == ["temperature_degC"]
    assert estimate.checksum.startswith("sha256:")
    for key, true in (("acceleration", N), ("flicker", B)):
        assert find_component(signal, key).low < true < find_component(signal, key).high
    assert find_component(signal, "bias_walk").value is None
    assert find_component(signal, "bias_walk").low == 0.0
    assert any("bias random walk" in remark for remark in signal.remarks)
    assert find_component(estimate_from_frame(), "flicker").value == pytest.approx(
        find_component(signal, "flicker").value, rel=1e-6
    )


@pytest.mark.parametrize(
    ("observable", "unit", "order", "white"),
    [("velocity", "m/s", 1, 2e-5), ("displacement", "mm", 2, 2e-6)],
)
def test_velocities_and_displacements_are_differenced(observable, unit, order, white):
    time, values = make_columns(order=order)
    values = values + white * np.random.default_rng(9).standard_normal(time.size)
    frame = {"time_s": time, "channel": values * (1e3 if unit == "mm" else 1.0)}
    (signal,) = cs.noise(frame, columns=["channel"], unit=unit).signals
    assert signal.observable == observable
    assert find_component(signal, observable).low < white < find_component(signal, observable).high
    assert (
        find_component(signal, observable).unit
        == {"velocity": "m/s", "displacement": "m"}[observable]
    )
    assert (
        find_component(signal, "acceleration").low < N < find_component(signal, "acceleration").high
    )


def test_spectrum_and_allan_deviation_match_components():
    """Nearly all 95 % intervals contain the value computed from the components."""
    signal = estimate_from_frame()
    for points, name in ((signal.allan, "deviation"), (signal.spectrum, "density")):
        held = [p.low <= p.expected <= p.high for p in points]
        assert sum(held) >= 0.8 * len(held)
        assert all(p.low < getattr(p, name) < p.high for p in points)
    longest = signal.allan[-1]
    assert longest.expected == pytest.approx(math.sqrt(2.0 * math.log(2.0) / math.pi) * B, rel=0.3)


def test_spectral_lines_are_named():
    time, values = make_columns()
    values = values + 1e-3 * np.cos(2 * np.pi * 10.0 * time)
    values += 1e-3 * np.cos(2 * np.pi * 7.77 * time)
    # Harmonic 2 of 60 Hz, which aliases to 20 Hz at 100 samples per second.
    values += 1e-3 * np.cos(2 * np.pi * 120.0 * time)
    frame = {"time_s": time, "a": values}
    (signal,) = cs.noise(frame, columns=["a"], unit="m/s^2", rate="2.59 rev/s").signals
    names = {round(line.frequency, 2): line.name for line in signal.lines}
    assert names[7.77] == "spindle, harmonic 3"
    assert names[10.0] is None
    assert "mains" in names[20.0]
    assert (
        find_component(signal, "acceleration").low < N < find_component(signal, "acceleration").high
    )


def test_noise_table_is_valid_in_campaign(tmp_path, folder):
    estimate = cs.noise(write_record(tmp_path))
    (tmp_path / "noise.toml").write_text(estimate.table, encoding="utf-8")
    stated = load_document(tmp_path / "noise.toml")["noise"]
    assert set(stated) == {"acceleration", "flicker"}
    campaign = cs.read_campaign(folder).change({"noise": None})
    campaign = campaign.change({"noise": stated})
    assert campaign.noise.flicker == pytest.approx(
        find_component(estimate.signals[0], "flicker").value, rel=6e-3
    )


@pytest.mark.parametrize(
    ("name", "start", "factor"),
    [
        ("timestamp", 1764459000.0, 1.0),
        ("timestamp", 1764459000.0, 1e3),
        ("time", 1764459000.0, 1e9),
        ("seconds_elapsed", 0.0, 1.0),
        ("millis", 0.0, 1e3),
        ("micros", 12.0, 1e6),
    ],
)
def test_unit_of_time_follows_from_epoch_or_first_word(name, start, factor, skip_intervals):
    time, values = make_columns(2_000)
    columns = {name: np.round((start + time) * factor, 3), "Qx_g": 1.0 + values / G}
    (signal,) = cs.noise(columns).signals
    assert signal.sampling_rate == pytest.approx(1.0 / STEP, rel=1e-3)


def test_sampling_rate_contradicting_the_times_raises(skip_intervals):
    time, values = make_columns(2_000)
    columns = {"time_s": time, "Qx_g": 1.0 + values / G}
    with raises("conflicting-values", "50 Hz contradicts column 'time_s'", "100 rows per second"):
        cs.noise(columns, sampling_rate="50 Hz")
    (signal,) = cs.noise(columns, sampling_rate="99 Hz").signals
    assert signal.sampling_rate == pytest.approx(100.0)


def test_campaign_of_readings_has_no_columns(tmp_path):
    run = format_rest_run("up", "0 deg about north", "1.25 ± 1e-6 mA")
    write_description(tmp_path, format_site() + ACCELEROMETER + run)
    with raises("missing-column", "contains only readings", "`columns` and `unit`"):
        cs.noise(write_record(tmp_path), campaign=tmp_path)


def test_campaign_identifies_columns(folder, tmp_path):
    time, values = make_columns(order=2)
    values += 1e-5 * np.random.default_rng(3).standard_normal(time.size)
    pl.DataFrame({"time_s": time, "east_m": values}).write_csv(tmp_path / "rest.csv")
    for argument in ({"unit": "g"}, {"sampling_rate": "50 Hz"}, {"gravity": "9.8 m/s^2"}):
        with pytest.raises(CampaignError, match=f"`{next(iter(argument))}`: already stated in"):
            cs.noise(tmp_path / "rest.csv", campaign=folder, **argument)
    estimate = cs.noise(tmp_path / "rest.csv", campaign=folder)
    (signal,) = estimate.signals
    assert (signal.name, signal.column, signal.observable) == ("Qx", "east_m", "displacement")
    assert estimate.gravity == cs.read_campaign(folder).gravity.value
    assert (
        find_component(signal, "displacement").low
        < 1e-5
        < find_component(signal, "displacement").high
    )


@pytest.mark.usefixtures("skip_intervals")
def test_gaps_outliers_and_resolution_are_reported():
    time, values = make_columns()
    rounded = 2e-3 * np.round(values / 2e-3)
    rounded[500] += 0.5
    keep = (time < 40.0) | (time > 41.0)
    (signal,) = cs.noise(
        {"time_s": time[keep], "a": rounded[keep]}, columns=["a"], unit="m/s^2"
    ).signals
    assert (signal.outliers, signal.gaps) == (1, 1)
    assert signal.resolution == pytest.approx(2e-3)
    text = " ".join(signal.remarks)
    for words in ("outliers: 1 sample.", "split at 1 gap.", "multiples of 0.002"):
        assert words in text


@pytest.mark.slow
@pytest.mark.usefixtures("skip_intervals")
def test_motion_during_record_is_reported():
    rng = np.random.default_rng(8)
    time = np.arange(20_000) / 100.0
    values = 1.0 + 1e-3 * rng.standard_normal(time.size)
    moved = values.copy()
    moved[12_000:12_400] += 0.1 * np.sin(2.0 * np.pi * 0.5 * time[:400])
    (remark,) = [
        r for r in cs.noise({"t_s": time, "Q_g": moved}).signals[0].remarks if "quiet" in r
    ]
    assert remark.startswith("From 118.8 s to 125 s, the scatter is ")
    assert "moved during part of the record" in remark
    # Neither white noise nor the largest bias walk counts as motion.
    for own in (values, 1.0 + 1e-3 * rng.standard_normal(time.size).cumsum()):
        remarks = cs.noise({"t_s": time, "Q_g": own}).signals[0].remarks
        assert not any("moved during" in remark for remark in remarks)


@pytest.mark.usefixtures("skip_intervals")
def test_low_pass_filter_is_reported():
    time, values = make_columns()
    smooth = np.convolve(values, np.full(4, 0.25), mode="valid")
    (signal,) = cs.noise({"time_s": time[3:], "a": smooth}, columns=["a"], unit="m/s^2").signals
    assert any("times the power" in remark for remark in signal.remarks)


def test_unreadable_time_cell_is_located(tmp_path):
    rows = [f"17,{n * 10_000_000},{n % 7}" for n in range(99)]
    rows[40] = "17,late,5"
    (tmp_path / "a.csv").write_text("\n".join(["sec,nanosec,a_m", *rows, ""]))
    message = (
        r"The file has no time column.*a\.csv, line 42: column 'nanosec' contains the text 'late'"
    )
    with pytest.raises(RecordError, match=message):
        cs.noise(tmp_path / "a.csv")


@pytest.mark.parametrize(
    ("frame", "words", "message"),
    [
        ({"a": np.arange(100.0) % 7}, {}, "The file has no time column"),
        (
            {"time_s": [0.0, 2.0, 1.0] * 33, "a_m": np.arange(99.0) % 7},
            {},
            r"it decreases in row 3 \(number of decreases: 65\)",
        ),
        ({"time_s": np.zeros(99), "a_m": np.arange(99.0) % 7}, {}, "most rows"),
        (
            {"time_s": np.arange(99) // 66, "a_m": np.arange(99.0) % 7},
            {},
            "too few rows have different times",
        ),
        ({"time_s": np.arange(100.0), "a": np.arange(100.0) % 7}, {}, "no column has a unit"),
        ({"time_s": np.arange(100.0), "a_m": np.zeros(100)}, {}, "all samples are equal"),
        ({"time_s": np.arange(9.0), "a_m": np.arange(9.0) % 4}, {}, "too few"),
    ],
)
def test_rejects_unusable_frame(frame, words, message):
    with pytest.raises(RecordError, match=message):
        cs.noise(frame, **words)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"columns": ["Qy"]}, "column 'Qy' does not exist"),
        ({"columns": ["temp"]}, "has no unit"),
        ({"columns": ["temp"], "unit": "degC"}, "is in 'degC'"),
        ({"unit": "kg"}, "`unit`: 'kg': a unit of length, velocity"),
        ({"rate": "1 Hz"}, "rate"),
        ({"gravity": "9.8 s"}, "gravity"),
        ({"gravity": "50 m/s^2"}, "`gravity`: 50 m/s.2 is not a possible value"),
        ({"gravity": "0 m/s^2"}, "`gravity`: must be greater than zero"),
        ({"sampling_rate": "0 Hz"}, "`sampling_rate`: must be greater than zero"),
        ({"sampling_rate": "-5 Hz"}, "`sampling_rate`: must be greater than zero"),
    ],
)
def test_rejects_invalid_arguments(words, message):
    frame = {"time_s": np.arange(100.0), "Qx_g": np.arange(100.0) % 7, "temp": np.arange(100.0)}
    with pytest.raises(CampaignError, match=message):
        cs.noise(frame, **words)


def write_german(file, time, force):
    """Write semicolons, decimal commas and a row of units."""
    rows = [f"{t:.4f};{f:.12g}".replace(".", ",") for t, f in zip(time, force, strict=True)]
    file.write_text("\n".join(["Zeit;Ausgang", "s;mg", *rows]) + "\n", encoding="utf-8")


def write_without_names(file, time, force):
    """Write space-delimited columns without names."""
    rows = [f"{t:.4f} {1e-3 * f:.15g}" for t, f in zip(time, force, strict=True)]
    file.write_text("\n".join(rows) + "\n", encoding="utf-8")


def write_matlab(file, time, force):
    from scipy.io import savemat

    savemat(file, {"time_s": time, "force_mg": force})


def write_parquet(file, time, force):
    pl.DataFrame({"time_s": time, "force_mg": force}).write_parquet(file)


@pytest.mark.slow
@pytest.mark.usefixtures("skip_intervals")
@pytest.mark.parametrize(
    ("name", "write", "words"),
    [
        ("a.txt", write_german, {}),
        (
            "a.log",
            write_without_names,
            {"columns": ["column 2"], "unit": "g", "sampling_rate": "100 Hz"},
        ),
        ("a.mat", write_matlab, {}),
        ("a.parquet", write_parquet, {}),
    ],
)
def test_recorder_file_formats_are_read(tmp_path, name, write, words):
    time, values = make_columns(2000)
    write(tmp_path / name, time, 1e3 * values / G)
    (signal,) = cs.noise(tmp_path / name, **words).signals
    for key in ("acceleration", "flicker"):
        assert find_component(signal, key).value == pytest.approx(
            find_component(estimate_from_frame(2000), key).value, rel=1e-4
        )


@pytest.mark.usefixtures("skip_intervals")
def test_sampling_rate_replaces_time_column():
    _, values = make_columns()
    frame = {"Qx_g": values / G}
    (signal,) = cs.noise(frame, sampling_rate="100 Hz").signals
    component_values, expected = (
        {key: component.value for key, component in each.components.items()}
        for each in (signal, estimate_from_frame())
    )
    assert component_values == expected


@pytest.mark.slow
@pytest.mark.usefixtures("skip_intervals")
def test_stuck_samples_are_reported_and_excluded():
    time, values = make_columns(3000)
    stuck = values.copy()
    stuck[1000:1300] = stuck[999]
    (signal,) = cs.noise({"time_s": time, "Qx_g": stuck / G}).signals
    assert any(
        remark.startswith("300 of 3000 rows belong to long sequences") for remark in signal.remarks
    )
    expected = find_component(
        cs.noise({"time_s": time, "Qx_g": values / G}).signals[0], "acceleration"
    )
    assert find_component(signal, "acceleration").value == pytest.approx(expected.value, rel=0.02)
    for resolution in (1.0, 4.0):  # standard deviations of the samples
        step = resolution * np.std(values)
        coarse = {"time_s": time, "Qx_g": np.round(values / step) * step / G}
        (signal,) = cs.noise(coarse).signals
        assert not any("long sequences" in remark for remark in signal.remarks)


@pytest.mark.usefixtures("skip_intervals")
def test_constant_parts_of_a_coarse_record_are_not_quiet_parts():
    """Most values are equal; the scatter elsewhere is that of rounding, not of motion."""
    values = 0.02 * (np.random.default_rng(0).random(8_000) < 1 / 130)
    values[:4_500] = 0.0
    (signal,) = cs.noise({"time_s": np.arange(8_000) * STEP, "Qx_g": values / G}).signals
    assert signal.resolution == pytest.approx(0.02)
    assert not any("sensor moved" in remark for remark in signal.remarks)
    assert any("rounding error" in remark for remark in signal.remarks)


@pytest.mark.usefixtures("skip_intervals")
@pytest.mark.parametrize("name", ["time_s", "time"])
def test_stated_rate_overrides_unusable_times(name):
    time, values = make_columns(2000)
    late = time + np.random.default_rng(1).uniform(0.0, 0.006, time.size)
    frame = {name: late, "Qx_g": values / G}
    with pytest.raises(RecordError, match="`sampling_rate`"):
        cs.noise(frame)
    counted, expected = (
        find_component(cs.noise(data, sampling_rate="100 Hz").signals[0], "acceleration").value
        for data in (frame, {"Qx_g": values / G})
    )
    assert counted == expected


def test_command_writes_json_report_and_plot(tmp_path, capsys):
    file = write_record(tmp_path)
    names = [tmp_path / name for name in ("n.json", "n.html", "n.svg")]
    words = ["noise", str(file), "--json", names[0], "--report", names[1], "--plot", names[2]]
    assert main([str(word) for word in words]) == 0
    shown = capsys.readouterr().out
    assert "[noise]" in shown
    assert "ug/Hz^0.5" in shown
    read = cs.NoiseResult.read(names[0])
    assert read.signals[0].components["flicker"].value is not None
    assert json.loads(names[0].read_text())["table"] == read.table
    assert "Allan deviation" in names[1].read_text(encoding="utf-8")
    assert main(["report", str(names[0])]) == 0
    assert main([str(word) for word in words]) == 1  # no file is overwritten without --overwrite
    assert main([*(str(word) for word in words), "--overwrite"]) == 0


def test_missing_file_raises_error(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["noise", "none.csv"]) != 0
    assert "counterspin: none.csv: file not found" in capsys.readouterr().err


@pytest.mark.usefixtures("skip_intervals")
def test_column_of_zeros_is_unused(tmp_path):
    frame = {
        "time_s": make_columns()[0],
        "a_g": make_columns()[1] / G,
        "residual_g": np.zeros(6_000),
    }
    estimate = cs.noise(frame)
    assert [signal.column for signal in estimate.signals] == ["a_g"]
    assert estimate.unused == ["residual_g"]
    with pytest.raises(RecordError, match="all samples are equal"):
        cs.noise(frame, columns=["residual_g"])


START = datetime.datetime(2024, 3, 5, 23, 59, 30)


@pytest.mark.slow
@pytest.mark.usefixtures("skip_intervals")
@pytest.mark.parametrize(
    ("name", "stamp"),
    [
        ("GPS TOW (s)", lambda seconds: f"{345600 + seconds:.2f}"),
        ("Time", lambda seconds: f"{45356.4 + seconds / 86400:.10f}"),
        (
            "time",
            lambda seconds: (START + datetime.timedelta(seconds=seconds)).strftime(
                "%d %B %Y %H:%M:%S.%f"
            ),
        ),
        ("# Sampling rate: 100 Hz", None),
    ],
)
def test_time_formats_of_recorders_are_read(tmp_path, name, stamp):
    time, values = make_columns()
    rows = [f"{value:.12g}" for value in values / G]
    if stamp is None:
        lines = [name, "a (g),b (count)", *(f"{row},1" for row in rows)]
    else:
        seconds = time.tolist()
        lines = [f"{name},a (g)", *(f"{stamp(s)},{r}" for s, r in zip(seconds, rows, strict=True))]
    (tmp_path / "rest.csv").write_text("\n".join(lines))
    (signal,) = cs.noise(tmp_path / "rest.csv").signals
    assert signal.sampling_rate == pytest.approx(100.0, rel=1e-4)
    expected = find_component(estimate_from_frame(), "acceleration").value
    assert find_component(signal, "acceleration").value == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("names", ["time,ax ay,az", "time\tax ay\taz"])
def test_missing_delimiter_in_header_is_located(tmp_path, names):
    delimiter = "\t" if "\t" in names else ","
    values = np.random.default_rng(2).normal(size=(400, 3))
    rows = [[0.01 * n, *row] for n, row in enumerate(values)]
    text = "\n".join(delimiter.join(f"{v:.6f}" for v in row) for row in rows)
    (tmp_path / "a.txt").write_text(f"{names}\n{text}\n", encoding="utf-8")
    with raises("missing-column", "'ax'", "line 1", "3 names", "4 columns"):
        cs.noise(tmp_path / "a.txt", columns=["ax"], unit="m/s^2")
