"""Observed runs: records are checked against the described motion."""

import math
import re

import numpy as np
import polars as pl
import pytest
from campaigns import PLACE, SMALL, format_runs, replace_parts, write_and_read_campaign
from raising import raises

from counterspin.calibration.calibrate import calibrate
from counterspin.calibration.observed_runs import observe_runs
from counterspin.errors import RecordError
from counterspin.simulation.simulate import simulate

#: Keys of the columns of an observable in the description, and its noise.
OBSERVED = {"velocity": ("m/s", "0.01 m/s"), "specific_force": ("g", "1e-4 g")}


def describe(observable):
    """Return the small campaign with another observable."""
    unit, noise = OBSERVED[observable]
    pairs = [
        (
            f'displacement = {{ column = "{axis}_m", unit = "m" }}',
            f'{observable} = {{ column = "{axis}", unit = "{unit}" }}',
        )
        for axis in ("east", "north")
    ]
    return replace_parts(SMALL, *pairs, ('displacement = "0.01 m"', f'{observable} = "{noise}"'))


@pytest.fixture(scope="module", params=OBSERVED)
def recorded_run(request, tmp_path_factory):
    """Return the folder, the description and an original record of the campaign."""
    folder = tmp_path_factory.mktemp(request.param)
    text = describe(request.param)
    simulate(write_and_read_campaign(folder, text), folder)
    return folder, text, pl.read_csv(folder / "slow.csv")


def test_record_of_described_motion_is_read(recorded_run):
    folder, text, _ = recorded_run
    assert len(list(observe_runs(write_and_read_campaign(folder, text)))) == 3


def test_block_means_preserve_ripple(tmp_path):
    """The error of a perfect instrument is zero, also with rate ripple."""
    perfect = replace_parts(
        describe("specific_force"),
        ('sampling_rate = "20 Hz"', 'sampling_rate = "250 Hz"'),
        ("revolutions = 20", "revolutions = 4"),
        ("ratio = 1e-5", "ratio = 5e-4"),
        ('angle = "1e-6 rad"', ""),
    )
    head, truth = perfect.split("[truth.Qx]")
    truth = "[truth.spindle]" + truth.split("[truth.spindle]")[1].replace("1e-4 g", "0 g")
    campaign = write_and_read_campaign(tmp_path, f"{head}[truth.Qx]\n[truth.Qy]\n{truth}")
    simulate(campaign, tmp_path)
    slow = next(iter(observe_runs(campaign)))
    assert slow.record.count[10] > 10
    for signal in slow.signals.values():
        # Tangential force of the ripple is 3e-3 m/s^2, of which means over 1/64 revolution lose
        # 4e-4: 1.2e-6 m/s^2. The rule of two points leaves 1e-7 of the force of 6 m/s^2.
        # Without noise the ends of the record are rejected as outliers.
        assert np.count_nonzero(np.isfinite(signal.error)) > 0.9 * signal.error.size
        assert np.nanmax(np.abs(signal.error)) < 3e-7


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (pl.col("east") * -1.0, "180 degrees"),
        (pl.col("north").alias("east"), "check the input axis"),
        (
            pl.col("east") * 1000.0,
            "check the unit of the column, the unit of the time and the sampling rate",
        ),
        (pl.col("east") * 16.0, "the unit of the time, the sampling rate, the radius"),
        (pl.col("east") * 9.80665, "ratio of g and m/s^2"),
        (pl.col("angle_rad") + math.pi / 2, "90 degrees"),
        (pl.col("angle_rad") * -1.0, "opposite sense"),
    ],
    ids=["sign", "axes", "thousand", "time", "gravity", "zero", "sense"],
)
def test_rejects_record_of_other_motion(recorded_run, tmp_path, change, words):
    folder, text, record = recorded_run
    for file in folder.glob("*.csv"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    record.with_columns(change).write_csv(tmp_path / "slow.csv")
    with pytest.raises(RecordError, match=re.escape(words)) as caught:
        list(observe_runs(write_and_read_campaign(tmp_path, text)))
    assert "slow.csv" in str(caught.value)


@pytest.mark.parametrize("radius", ["0.9 m", "25 m"])
def test_rejects_wrong_radius(recorded_run, radius):
    folder, text, _ = recorded_run
    with pytest.raises(RecordError, match="the radius"):
        list(
            observe_runs(
                write_and_read_campaign(folder, replace_parts(text, ('"2.5 m"', f'"{radius}"')))
            )
        )


@pytest.fixture(scope="module")
def plain_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plain")
    simulate(write_and_read_campaign(folder, SMALL), folder)
    return folder


@pytest.mark.parametrize("name", ["copy.csv", "copy.parquet", "later.csv", "sub/../slow.csv"])
def test_rejects_duplicate_record(plain_folder, tmp_path, name):
    (tmp_path / "sub").mkdir()
    record = pl.read_csv(plain_folder / "slow.csv")
    for file in plain_folder.glob("*.csv"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    record.write_csv(tmp_path / "copy.csv")
    record.write_parquet(tmp_path / "copy.parquet")
    record.with_columns(pl.col("time_s") + 1000.0).write_csv(tmp_path / "later.csv")
    again = f'[[runs]]\nname = "again"\nrate = "0.25 rev/s"\nrecord = "{name}"\n\n[simulation]'
    with raises("duplicate-record", "slow.csv"):
        list(
            observe_runs(
                write_and_read_campaign(tmp_path, replace_parts(SMALL, ("[simulation]", again)))
            )
        )


TRUTH = {
    "Qx": {"K_F": 0.005, "K_I": 1.002, "K_II": 2.7e-5},
    "Qy": {"K_F": -0.0037, "K_I": 0.9988, "K_II": -3.3e-5},
    "Qz": {"K_F": 0.004, "K_I": 1.0007},
}
UNITS = {"K_F": "g", "K_I": "g/g", "K_II": "g/g^2"}
REFERENCE = 'reference = "own velocity"\n'
AXES = (("Qx", "east", "down"), ("Qy", "north", "down"), ("Qz", "up", "east"))


def describe_three_axes(observable, unit, noise):
    """Describe a computer that uses its own velocity, with errors of all three axes."""
    accelerometers = "".join(
        f'[accelerometers.{name}]\ninput_axis = "{axis}"\npendulous_axis = "{pendulous}"\n'
        f'{observable} = {{ column = "{name}", unit = "{unit}" }}\n'
        for name, axis, pendulous in AXES
    )
    truth = "".join(
        f"[truth.{name}]\n" + "".join(f'{k} = "{v} {UNITS[k]}"\n' for k, v in values.items())
        for name, values in TRUTH.items()
    )
    return f"""{PLACE}{REFERENCE}
{accelerometers}
[noise]
{observable} = "{noise}"
[model]
assume = "all"
terms = ["K_F", "K_I", "K_II"]
[model.priors]
"Qz.K_I" = "1.0007 ± 1e-7 g/g"
"Qz.K_II" = "0 ± 1e-9 g/g^2"
{format_runs("run1", "run2", "run3", rates=("90 deg/s", "180 deg/s", "360 deg/s"))}
[simulation]
sampling_rate = "20 Hz"
seed = 7
revolutions = 30
{truth}
[truth.noise]
{observable} = "{noise}"
angle = "1e-6 rad"
"""


@pytest.fixture(
    scope="module", params=[("displacement", "m", "0.01 m"), ("velocity", "m/s", "0.001 m/s")]
)
def own_velocity(request, tmp_path_factory):
    """Return the description and the folder of its records."""
    folder = tmp_path_factory.mktemp(request.param[0])
    text = describe_three_axes(*request.param)
    simulate(write_and_read_campaign(folder, text), folder)
    return folder, text


def biased_coefficients(result):
    """Return the coefficients that differ from the truth by more than 3 u."""
    return {
        f"{name}.{symbol}"
        for name, values in TRUTH.items()
        for symbol, true in values.items()
        for c in [result.accelerometers[name].coefficients[symbol]]
        if abs(c.value - true) > 3.0 * c.u
    }


def test_correction_by_own_velocity_is_reversed(own_velocity):
    folder, text = own_velocity
    result = calibrate(write_and_read_campaign(folder, text))
    assert biased_coefficients(result) == set()
    assert result.accelerometers["Qx"].coefficients["K_F"].u < 1e-7
    assert "own-velocity" not in {f.code for f in result.findings}
    for accelerometer in result.accelerometers.values():
        left = accelerometer.residual
        assert abs(left.chi2 - left.dof) < 5.0 * math.sqrt(2.0 * left.dof)


def test_uncertainty_of_latitude_propagates_through_own_velocity(own_velocity):
    folder, text = own_velocity
    latitudes = ("45.75 ± 0.05 deg", "45.8 ± 0.05 deg")
    here, there = (
        calibrate(
            write_and_read_campaign(
                folder,
                replace_parts(
                    text,
                    ('"45.75 deg"', f'"{latitude}"'),
                    # With a prior it would be estimated from the records.
                    ('assume = "all"\n', 'assume = "all"\nhold = ["site.latitude"]\n'),
                ),
            )
        )
        for latitude in latitudes
    )
    for name in ("Qx", "Qy"):
        before, after = (r.accelerometers[name].coefficients["K_F"] for r in (here, there))
        budget = here.accelerometers[name].budget["K_F"]
        (line,) = (line for line in budget if line.source == "site.latitude")
        moved = line.sensitivity * math.radians(0.05)
        assert abs(moved) > 5e-9  # no change without it
        assert after.value - before.value == pytest.approx(moved, rel=0.02)


def test_unstated_own_velocity_is_named(own_velocity):
    folder, text = own_velocity
    result = calibrate(write_and_read_campaign(folder, replace_parts(text, (REFERENCE, ""))))
    assert {"Qx.K_F", "Qx.K_II", "Qy.K_F", "Qz.K_F"} <= biased_coefficients(result)
    (finding,) = (f for f in result.findings if f.code == "own-velocity")
    assert result.findings[0] == finding
    assert finding.contradicts
    assert {"lack-of-fit"} <= {f.code for f in finding.explains}
    assert "the computer uses its own velocity" in finding.text
    assert 'enter reference = "own velocity"' in finding.text


def test_wrongly_stated_own_velocity_is_named(own_velocity, tmp_path):
    _, text = own_velocity
    simulate(
        write_and_read_campaign(tmp_path / "given", replace_parts(text, (REFERENCE, ""))), tmp_path
    )
    result = calibrate(write_and_read_campaign(tmp_path, text))
    (finding,) = (f for f in result.findings if f.code == "own-velocity")
    assert 'enter reference = "platform"' in finding.text
    assert (
        biased_coefficients(
            calibrate(write_and_read_campaign(tmp_path, replace_parts(text, (REFERENCE, ""))))
        )
        == set()
    )


def test_remaining_gravity_acts_through_own_velocity(tmp_path):
    """A remaining 3e-4 m/s^2 upwards gives 2 Omega cos L 3e-4 t^3/6 towards east."""
    site = ('"9.8066 m/s^2"', '"9.8066 m/s^2"\nremoved_gravity = "9.8063 m/s^2"')
    text = replace_parts(describe_three_axes("displacement", "m", "1e-5 m"), site)
    simulate(write_and_read_campaign(tmp_path, text), tmp_path)
    result = calibrate(write_and_read_campaign(tmp_path, text))
    assert biased_coefficients(result) == set()
    assert not {"own-velocity", "lack-of-fit"} & {f.code for f in result.findings}


def detrend_records(folder, text, count, tmp_path, files=("slow", "middle", "fast")):
    """Return the campaign with records from which the first `count` of 1, t and t^2 are removed."""
    for name in ("slow", "middle", "fast"):
        record = pl.read_csv(folder / f"{name}.csv")
        column = record.columns[2]
        t, x = record["time_s"].to_numpy(), record[column].to_numpy()
        powers = np.vander(t / t[-1], count, increasing=True)
        if name in files and count:
            x = x - powers @ np.linalg.lstsq(powers, x, rcond=None)[0]
        record = record.with_columns(pl.Series(column, x.round(9)))
        record.write_csv(tmp_path / f"{name}.csv")
    return write_and_read_campaign(tmp_path, text)


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_rejects_detrended_record_if_relevant(recorded_run, tmp_path, count):
    folder, text, _ = recorded_run
    campaign = detrend_records(folder, text, count, tmp_path)
    # The start velocity, an unknown of a velocity record, absorbs the mean.
    harmless = 1 if "velocity = {" in text else 0
    if count <= harmless:
        assert len(list(observe_runs(campaign))) == 3
        return
    word = ("mean", "line", "parabola")[count - 1]
    with pytest.raises(RecordError, match=f"slow, middle, fast: a {word} was removed .* 'east'"):
        list(observe_runs(campaign))


@pytest.fixture(scope="module")
def displacement_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("displacement")
    simulate(write_and_read_campaign(folder, SMALL), folder)
    return folder


@pytest.mark.parametrize("count", [1, 2, 3])
def test_only_parabola_removed_from_displacement_is_an_error(displacement_folder, tmp_path, count):
    campaign = detrend_records(displacement_folder, SMALL, count, tmp_path)
    if count < 3:
        result = calibrate(campaign)
        codes = [
            finding.code
            for finding in calibrate(write_and_read_campaign(displacement_folder, SMALL)).findings
        ]
        assert [finding.code for finding in result.findings] == codes
        word = ("mean", "line")[count - 1]
        assert any(f"A {word} was removed" in text for text in result.warnings)
        return
    with raises("detrended-record", "1, t, t^2"):
        calibrate(campaign)


def test_rejects_single_record_without_parabola(displacement_folder, tmp_path):
    # All rows of the file are tested, whichever rows are used.
    text = SMALL.replace('record = "fast.csv"', 'record = "fast.csv"\nstart = "3 s"')
    campaign = detrend_records(displacement_folder, text, 3, tmp_path, files=("fast",))
    with pytest.raises(RecordError, match=r"^fast: a parabola was removed"):
        list(observe_runs(campaign))


def test_good_campaign_has_no_detrending_finding(displacement_folder):
    parts = {
        run.run.name: run.record.polynomials
        for run in observe_runs(write_and_read_campaign(displacement_folder, SMALL))
    }
    # Rounding gives less than 0.02; noise gives about 1, and a bias of 5 mg 1e5.
    assert min(abs(part[0]) for own in parts.values() for part in own.values()) > 1e3
    warnings = calibrate(write_and_read_campaign(displacement_folder, SMALL)).warnings
    assert not any("removed" in text for text in warnings)
