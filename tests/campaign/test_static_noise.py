"""Noise from a record at rest, for simulation, planning and studies."""

import numpy as np
import polars as pl
import pytest
from campaigns import SMALL, find_runs, replace_parts, write_description
from raising import raises
from recorded_campaigns import WHITE_NOISE, write_static_record
from static_noise_sizes import disable_intervals

import counterspin as cs
from counterspin.calibration.joint_problem import make_noise
from counterspin.campaign.description import read_campaign
from counterspin.campaign.memory import make_campaign
from counterspin.campaign.static_noise import simulated_noise
from counterspin.planning.forecast import forecast
from counterspin.planning.plan import plan
from counterspin.toml_text import format_document

STATED = '[noise]\ndisplacement = "0.01 m"'
TRUE_NOISE = '[truth.noise]\ndisplacement = "0.01 m"\nangle = "1e-6 rad"\n'
FROM = '[noise]\nfrom = "rest.csv"\nangle = "1e-6 rad"'


@pytest.fixture(scope="module", autouse=True)
def skip_intervals():
    """Estimate noise without intervals, which these tests do not use."""
    with disable_intervals():
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with the description of a simulation, and a record at rest."""
    static_record = write_static_record(tmp_path_factory.mktemp("described"), rows=2000)
    write_description(static_record, replace_parts(SMALL, (STATED, FROM), (TRUE_NOISE, "")))
    return static_record


@pytest.fixture(scope="module")
def largest_white_noise(folder):
    """Return the larger estimated white noise of the two accelerometers, m."""
    estimate = cs.noise(folder / "rest.csv", campaign=folder).signals
    sizes = [signal.components["displacement"].value for signal in estimate]
    # The standard deviation of 2000 samples has a relative error of 1.6 %.
    assert sizes == pytest.approx(list(WHITE_NOISE.values()), rel=0.06)
    assert sizes[0] != sizes[1]
    return max(sizes)


def state_noise(folder, largest_white_noise):
    """Return the campaign with the [noise] table that `counterspin noise` prints."""
    return read_campaign(folder).change(
        {"noise": {"from": None, "displacement": f"{largest_white_noise!r} m"}}
    )


def test_largest_estimated_noise_is_simulated(folder, largest_white_noise):
    estimated, stated = (
        cs.simulate(c) for c in (read_campaign(folder), state_noise(folder, largest_white_noise))
    )
    for first, second in zip(estimated.runs, stated.runs, strict=True):
        frames = estimated.record_at(first.record).frame(), stated.record_at(second.record).frame()
        assert frames[0].equals(frames[1])
    assert cs.calibrate(estimated).accelerometers["Qy"].noise["displacement"].record == "rest.csv"


def test_stated_true_noise_overrides_estimate(folder, tmp_path):
    write_static_record(tmp_path, rows=2000)
    own = read_campaign(write_description(tmp_path, replace_parts(SMALL, (STATED, FROM))))
    assert simulated_noise(own)["displacement"] == 0.01
    wanted = read_campaign(folder).change({"noise": {"acceleration": "estimate"}})
    with raises("not-simulable", "noise.acceleration:"):
        cs.simulate(wanted)


def test_simulated_folder_contains_record_at_rest(folder, tmp_path):
    cs.simulate(folder, tmp_path / "there")
    assert (tmp_path / "there/rest.csv").read_bytes() == (folder / "rest.csv").read_bytes()
    campaign = read_campaign(tmp_path / "there")
    assert make_noise(campaign) == make_noise(read_campaign(folder))
    cs.simulate(folder, tmp_path / "there", overwrite=True)
    with pytest.raises(cs.CounterspinError, match="exists"):
        cs.simulate(folder, tmp_path / "there")
    outside = read_campaign(folder).change({"noise": {"from": "../rest.csv"}})
    with raises("path-outside-folder", "noise.from:", "../rest.csv"):
        cs.simulate(outside, tmp_path / "elsewhere")


def test_forecast_assumes_undetected_noise_is_zero(folder, largest_white_noise):
    campaign, stated = read_campaign(folder), state_noise(folder, largest_white_noise)
    runs = find_runs(campaign, "slow", "middle")
    alone = {"accelerometers": {"Qx": None}, "truth": {"Qx": None}, "runs": runs}
    longer = {"runs": [run | {"revolutions": 20} for run in runs]}
    without_truth = campaign.change(alone | longer | {"truth": None, "simulation": None})
    stated = stated.change(alone)
    first, second = (forecast(c, sampling_rate=20.0).u["Qy.K_II"] for c in (without_truth, stated))
    assert first == pytest.approx(second, rel=1e-12)


#: The merge patch that leaves only Qy.
ONLY_QY = {"accelerometers": {"Qx": None}, "truth": {"Qx": None}}


def test_study_uses_noise_of_record(folder, largest_white_noise):
    beside = {"acceleration": "0 g/Hz^0.5"}  # otherwise the trials would estimate it
    of_rest = read_campaign(folder).change(ONLY_QY | {"noise": beside})
    stated = state_noise(folder, largest_white_noise).change(ONLY_QY)
    first, second = (
        cs.study(c, trials=50, seed=1).analyses["joint"].coefficients["Qy.K_II"]
        for c in (of_rest, stated)
    )
    assert (first.bias, first.se_bias) == pytest.approx((second.bias, second.se_bias), rel=1e-9)


PLAN = """
schema = 1
[site]
gravity = "9.8 m/s^2"
latitude = "45.75 deg"
[centrifuge]
radius = "2.5 m"
[accelerometers.Qx]
input_axis = "east"
pendulous_axis = "down"
displacement = { column = "east_m", unit = "m" }
[noise]
from = "rest.csv"
[model]
assume = "all"
[limits]
total_time = "120 s"
highest_rate = "1 rev/s"
sampling_rate = "50 Hz"
runs = 2
[goal]
minimise = ["K_II"]
"""


@pytest.mark.slow
def test_plan_uses_and_states_estimated_noise(tmp_path):
    write_static_record(tmp_path, rows=2000)
    file = tmp_path / "PLAN.toml"
    file.write_text(PLAN, encoding="utf-8")
    (signal,) = cs.noise(
        tmp_path / "rest.csv",
        campaign=read_campaign(write_description(tmp_path, SMALL)),
        columns=["east_m"],
    ).signals
    size = f"{signal.components['displacement'].value!r} m"
    planned = plan(file)
    file.write_text(replace_parts(PLAN, ('from = "rest.csv"', f'displacement = "{size}"')), "utf-8")
    stated = plan(file)
    assert planned.document == stated.document
    assert f'displacement = "{size}"' in planned.document
    assert planned.u == stated.u
    # A campaign changed in memory also names files next to the plan.
    changed_campaign = planned.change(total_time=planned.source["limits"]["total_time"])
    assert (changed_campaign.document, changed_campaign.file) == (planned.document, file)


def test_plan_rejects_bias_walk(tmp_path):
    """A bias walk of 1 mm/s^2 in 1 s, in samples at 20 Hz."""
    rng = np.random.default_rng(1)
    walk = np.cumsum(1e-3 * np.sqrt(0.05) * rng.standard_normal(1000))
    frame = pl.DataFrame({"time_s": np.arange(1000) / 20.0, "east": walk})
    frame.write_csv(tmp_path / "rest.csv")
    file = tmp_path / "PLAN.toml"
    force = 'specific_force = { column = "east", unit = "m/s^2" }'
    text = replace_parts(PLAN, ('displacement = { column = "east_m", unit = "m" }', force))
    file.write_text(text, encoding="utf-8")
    with raises("conflicting-keys", "noise.from:", "bias_walk, 0.00") as e:
        plan(file)
    assert 'add bias_walk = "0 m/s^2/s^0.5"' in str(e.value)


@pytest.mark.slow
def test_record_at_rest_may_be_in_memory(folder, tmp_path):
    frame, recorded = pl.read_csv(folder / "rest.csv"), cs.simulate(read_campaign(folder))
    of_file = make_noise(recorded)
    document = {**recorded.source.document, "noise": {"angle": "1e-6 rad"}}
    records = {run.name: recorded.record_at(run.record).frame() for run in recorded.runs}
    held = make_campaign(document, {**records, "noise.from": frame}, folder=tmp_path / "nowhere")
    assert make_noise(held) == of_file
    result = cs.calibrate(held)
    assert result.accelerometers["Qx"].noise["displacement"].record == "rest.parquet"
    assert result.provenance.in_memory["rest.parquet"] == "arrays"
    campaign = read_campaign(held.write(tmp_path / "written"))
    assert campaign.rest == tmp_path / "written" / "rest.parquet"
    assert make_noise(campaign) == of_file
    other = held.change({}, records={"noise.from": frame.with_columns(pl.col("east_m") * 2.0)})
    assert make_noise(other)["Qx"].white == pytest.approx(2.0 * of_file["Qx"].white, rel=1e-6)


def test_path_may_be_given_for_record_at_rest(folder, tmp_path):
    described = state_noise(folder, 0.01).source.document
    given = make_campaign(
        {**described, "noise": {}}, {"noise.from": folder / "rest.csv"}, folder=tmp_path
    )
    assert make_noise(given) == make_noise(read_campaign(folder))
    assert format_document(given.source.document["noise"]).strip() == f'from = "{folder}/rest.csv"'
