"""Temperatures in records: slopes of accelerometers against closed forms."""

import math

import numpy as np
import polars as pl
import pytest
from campaigns import write_and_read_campaign
from raising import raises

from counterspin.calibration.calibrate import calibrate
from counterspin.calibration.observed_runs import add_recorded_conditions
from counterspin.campaign.memory import make_campaign
from counterspin.errors import CampaignError
from counterspin.physics.motion import EARTH_RATE
from counterspin.simulation.simulate import simulate

GRAVITY, LATITUDE, RADIUS = 9.8066, 45.75, 2.5
UNITS = {"displacement": "m", "velocity": "m/s", "specific_force": "m/s^2"}
BIAS, SLOPE = 1.2e-3, 4e-5

#: From the reference: K = RISE t + WAVE sin(w t), over runs of this length, s.
RISE, WAVE, LENGTH = 0.02, 3.0, 300.0
SLOW = 2.0 * math.pi / LENGTH


def describe(observable, rates=(1.5, 3.0), **records):
    return {
        "site": {"gravity": f"{GRAVITY} m/s^2", "latitude": f"{LATITUDE} deg"},
        "centrifuge": {"radius": f"{RADIUS} m", "reference_temperature": "23 degC"},
        "records": {
            "time": {"column": "t", "unit": "s"},
            "angle": {"column": "a", "unit": "rad"},
            "temperature": {"column": "T", "unit": "degC"},
            **records,
        },
        "accelerometers": {
            "A": {
                "input_axis": "up",
                "pendulous_axis": "east",
                observable: {"column": "y", "unit": UNITS[observable]},
            }
        },
        "model": {"assume": "all", "terms": ["K_F", "K_F.temperature"]},
        "runs": [
            {"name": f"r{place}", "rate": f"{rate} rad/s", "record": f"r{place}.csv"}
            for place, rate in enumerate(rates)
        ],
    }


def record_upright(observable, rate, seed, noise):
    """Return the record of an upright accelerometer during warm-up by closed forms."""
    t = np.arange(0.0, LENGTH, 0.05)
    warm = RISE * t + WAVE * np.sin(SLOW * t)
    once = RISE * t**2 / 2.0 + WAVE / SLOW * (1.0 - np.cos(SLOW * t))
    twice = RISE * t**3 / 6.0 + WAVE / SLOW * (t - np.sin(SLOW * t) / SLOW)
    own = {
        "displacement": BIAS * t**2 / 2.0 + SLOPE * twice,
        "velocity": BIAS * t + SLOPE * once,
        "specific_force": BIAS + SLOPE * warm,
    }[observable]
    y = GRAVITY * own
    if observable == "specific_force":
        # Gravity and the Coriolis acceleration of the platform moving east and west.
        eastwards = -RADIUS * rate * np.sin(rate * t)
        y += GRAVITY - 2.0 * EARTH_RATE * math.cos(math.radians(LATITUDE)) * eastwards
    y += noise * np.random.default_rng(seed).standard_normal(t.size)
    return pl.DataFrame({"t": t, "a": rate * t, "T": 23.0 + warm, "y": y})


@pytest.mark.parametrize(
    ("observable", "noise"),
    [("displacement", 1e-2), ("velocity", 1e-3), ("specific_force", 1e-4)],
)
def test_slope_is_estimated_within_runs_of_equal_temperature(observable, noise):
    """Both runs have the same temperatures: only the variation within runs determines the slope."""
    records = {
        f"r{place}": record_upright(observable, rate, place, noise)
        for place, rate in enumerate((1.5, 3.0))
    }
    campaign = make_campaign(describe(observable), records=records)
    result = calibrate(campaign)
    assert result.state == "good", result.findings
    coefficients = result.accelerometers["A"].coefficients
    for symbol, true in (("K_F", BIAS), ("K_F.temperature", SLOPE)):
        coefficient = coefficients[symbol]
        assert abs(coefficient.value - true) < 4.0 * coefficient.u, (symbol, coefficient)
    assert coefficients["K_F.temperature"].u < 0.01 * SLOPE
    warmest = 273.15 + float(records["r0"]["T"].max())
    assert result.inputs.temperatures == pytest.approx([296.15, warmest], abs=0.05)
    assert result.inputs.reference_temperature == pytest.approx(296.15)


def test_slopes_are_recovered_from_simulated_temperature_profiles(tmp_path):
    """Two ramps and a return, with all slopes: 95 % within 2.4 u, all within 4 u."""
    text = """
schema = 1
[site]
gravity = "9.8066 m/s^2"
latitude = "45.75 deg"
[centrifuge]
radius = "2.5 m"
reference_temperature = "23 degC"
[records]
time = { column = "t", unit = "s" }
angle = { column = "a", unit = "rad" }
temperature = { column = "T", unit = "K" }
[accelerometers.Qx]
input_axis = "east"
pendulous_axis = "down"
velocity = { column = "v", unit = "m/s" }
[model]
assume = "all"
terms = ["K_F", "K_I", "K_II", "K_F.temperature", "K_F.temperature.2", "K_I.temperature"]
[simulation]
sampling_rate = "50 Hz"
revolutions = 60
seed = 12
[truth.Qx]
K_F = "1e-3 g"
K_I = "1.001 g/g"
K_II = "2e-5 g/g^2"
"K_F.temperature" = "2e-5 g/K"
"K_F.temperature.2" = "3e-7 g/K^2"
"K_I.temperature" = "3e-5 g/g/K"
[truth.noise]
velocity = "1e-3 m/s"
[[runs]]
name = "slow"
rate = "1.57 rad/s"
record = "slow.csv"
temperature = ["20 degC", "25 degC"]
[[runs]]
name = "middle"
rate = "3.1 rad/s"
record = "middle.csv"
temperature = ["25 degC", "26 degC", "27 degC", "27.5 degC", "27.7 degC", "27 degC"]
[[runs]]
name = "fast"
rate = "6.2 rad/s"
record = "fast.csv"
temperature = ["24 degC", "22 degC"]
"""
    campaign = simulate(write_and_read_campaign(tmp_path, text))
    # The column of the record is used, with or without stated temperatures.
    result = calibrate(campaign)
    alone = campaign.change(
        {
            "runs": [
                {key: value for key, value in run.items() if key != "temperature"}
                for run in campaign.source.document["runs"]
            ]
        }
    )
    calibration = calibrate(alone)
    truth = campaign.simulation.truth.coefficients["Qx"]
    assert calibration.state == "good"
    for symbol, coefficient in calibration.accelerometers["Qx"].coefficients.items():
        assert abs(coefficient.value - truth[symbol]) < 4.0 * coefficient.u, (symbol, coefficient)
        assert result.accelerometers["Qx"].coefficients[symbol].value == coefficient.value


def test_rejects_stated_temperature_that_differs_from_record():
    records = {f"r{place}": record_upright("velocity", 1.5, place, 1e-3) for place in (0, 1)}
    document = describe("velocity", rates=(1.5, 1.5))
    document["runs"][1]["temperature"] = "300 K"  # within 5 K of 23 to 32 degC
    campaign = make_campaign(document, records=records)
    assert add_recorded_conditions(campaign).runs[1].temperature[0] == pytest.approx(296.15)
    document["runs"][1]["temperature"] = "12 degC"
    campaign = make_campaign(document, records=records)
    with raises("temperature-mismatch", "23 to", "degC", '"r1"', "11 K"):
        add_recorded_conditions(campaign)


def test_run_may_override_temperature_column():
    document = describe("velocity")
    document["runs"][0]["records"] = {"temperature": {"column": "probe", "unit": "K"}}
    first, second = (record_upright("velocity", rate, 1, 1e-3) for rate in (1.5, 3.0))
    first = first.with_columns(probe=pl.col("T") + 274.15)
    campaign = make_campaign(document, records={"r0": first, "r1": second})
    one, other = add_recorded_conditions(campaign).runs
    assert np.subtract(one.temperature, other.temperature) == pytest.approx(1.0)
    del document["records"]["temperature"], document["runs"][0]["records"]
    document["model"]["terms"] = ["K_F"]
    bare = make_campaign(document, records={"r0": first, "r1": second})
    assert add_recorded_conditions(bare) is bare


def test_simulation_requires_true_temperature():
    document = describe("velocity")
    document |= {
        "truth": {"A": {"K_F": "1 mg"}, "noise": {"velocity": "1 mm/s"}},
        "simulation": {"revolutions": 10},
    }
    with pytest.raises(CampaignError) as caught:
        simulate(make_campaign(document))
    assert 'run "r0": temperature is missing; the record has a temperature column' in str(
        caught.value
    )
    document["runs"][0]["temperature"] = []
    with pytest.raises(CampaignError, match="at least one temperature"):
        make_campaign(document)
