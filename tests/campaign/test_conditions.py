"""Conditions of runs in a campaign: parsing and requirements of the slope terms."""

import math

import numpy as np
import pytest
from campaigns import SMALL, remove_table, replace_parts, write_and_read_campaign

from counterspin.calibration.calibrate import calibrate
from counterspin.campaign.conditions import reference_point, run_conditions, temperature_directions
from counterspin.campaign.memory import make_campaign
from counterspin.errors import CampaignError
from counterspin.physics.conditions import RunConditions

#: A campaign to which tests add a model.
BARE = remove_table(SMALL, "model")

STATED = {
    "slow": ("21 degC", "90 s"),
    "middle": ("296.15 K", "11.5 min"),
    "fast": ("22 degC", "-30 s"),
}


def add_conditions(text, keys=("temperature", "time"), runs=STATED):
    for name in runs:
        lines = dict(zip(("temperature", "time"), STATED[name], strict=True))
        added = "".join(f'{key} = "{lines[key]}"\n' for key in keys)
        text = replace_parts(text, (f'record = "{name}.csv"\n', f'record = "{name}.csv"\n{added}'))
    return text


def model_table(terms="", hold="", priors=""):
    return (
        f'[model]\nassume = "all"\nterms = ["K_F", "K_I", "K_II"{terms}]\nhold = [{hold}]\n'
        f"[model.priors]\n{priors}\n"
    )


def list_problems(folder, text):
    with pytest.raises(CampaignError) as caught:
        write_and_read_campaign(folder, text)
    return list(caught.value.problems)


def test_conditions_are_relative_to_first_run_and_reference(tmp_path):
    campaign = write_and_read_campaign(tmp_path, add_conditions(SMALL))
    conditions = run_conditions(campaign)
    assert conditions["slow"].start == 120.0
    assert conditions["middle"].start == 720.0
    assert conditions["fast"].start == 0.0
    # Without a stated reference, the mean of the recorded temperatures is used.
    assert [conditions[name].temperature_offset for name in STATED] == pytest.approx(
        [-1.0, 1.0, 0.0]
    )
    text = replace_parts(
        add_conditions(SMALL),
        ('radius = "2.5 m"', 'radius = "2.5 m"\nreference_temperature = "20 degC"'),
    )
    campaign = write_and_read_campaign(tmp_path, text)
    assert reference_point(campaign).temperature == pytest.approx(293.15)
    assert run_conditions(campaign)["slow"].temperature_offset == pytest.approx(1.0)


def test_runs_without_time_are_consecutive(tmp_path):
    campaign = write_and_read_campaign(tmp_path, SMALL)
    lengths = {"slow": 81.0, "middle": 41.0}
    starts = [c.start for c in run_conditions(campaign, lengths).values()]
    assert starts == [0.0, 81.0, 122.0]
    # Twenty revolutions at 0.25 and 0.5 rev/s.
    assert [c.start for c in run_conditions(campaign).values()] == pytest.approx([0.0, 80.0, 120.0])


def test_default_temperature_rises_by_1_k_over_runs(tmp_path):
    warmths = [
        c.temperature_offset
        for c in run_conditions(write_and_read_campaign(tmp_path, SMALL)).values()
    ]
    assert warmths == [-0.5, 0.0, 0.5]
    before, _, after = SMALL.partition("[[runs]]")
    text = f"{before}[[runs]]{after.partition('[[runs]]')[0]}{after[after.index('[simulation]') :]}"
    alone = write_and_read_campaign(tmp_path / "one", text)
    assert list(run_conditions(alone).values()) == [RunConditions(0.0, 0.0)]


def test_slopes_require_conditions_of_all_runs(tmp_path):
    text = add_conditions(BARE, runs=("slow",)) + model_table(', "K_F.trend", "K_I.temperature"')
    assert list_problems(tmp_path, text) == [
        f"runs[{place}].{key}: is missing: {symbol} is in the model; write for example "
        f'{key} = {example} (run "{name}")'
        for place, name in ((1, "middle"), (2, "fast"))
        for key, symbol, example in (
            ("temperature", "K_I.temperature", '"23.4 degC"'),
            ("time", "K_F.trend", '"12 min"'),
        )
    ]


def test_time_of_some_runs_only_is_an_error(tmp_path):
    (problem,) = list_problems(
        tmp_path, add_conditions(SMALL, keys=("time",), runs=("slow", "fast"))
    )
    assert problem.startswith(
        "runs[1].time: is missing: other runs state this value; write for example time = "
    )


def test_slope_at_single_temperature_requires_reference(tmp_path):
    text = add_conditions(BARE).replace("296.15 K", "21 degC").replace("22 degC", "21 degC")
    (problem,) = list_problems(tmp_path, text + model_table(', "K_F.temperature"'))
    assert problem.startswith("centrifuge.reference_temperature: is missing")


@pytest.mark.parametrize("stated", ["23 C", "warm", "", "23 °C ± 1 °C"])
def test_rejects_reference_that_is_not_a_temperature(stated, tmp_path):
    text = replace_parts(SMALL, ('"2.5 m"', f'"2.5 m"\nreference_temperature = "{stated}"'))
    (problem,) = list_problems(tmp_path, text)
    assert problem.startswith("centrifuge.reference_temperature: ")
    if stated:
        assert f"'{stated}' is not a temperature" in problem


def test_heating_cannot_be_estimated(tmp_path):
    (problem,) = list_problems(tmp_path, BARE + model_table(', "K_F.heating"'))
    assert '"K_F.heating" cannot be separated from K_II' in problem
    known = '"K_F.heating" = "0 ± 0.1 ug/g^2"'
    for hold in ("", '"K_F.heating"'):
        campaign = write_and_read_campaign(tmp_path, BARE + model_table(hold=hold, priors=known))
        for accelerometer in campaign.accelerometers.values():
            assert accelerometer.priors["K_F.heating"].u == pytest.approx(1e-7)
    (problem,) = list_problems(tmp_path, BARE + model_table(hold='"K_F.heating"'))
    assert "no prior is stated for Qx, Qy" in problem


def test_slope_prior_of_single_accelerometer(tmp_path):
    priors = '"K_F.trend" = "0 ± 1e-9 g/s"\n"Qy.K_F.trend" = "1e-9 ± 2e-9 g/s"'
    text = add_conditions(BARE) + model_table(', "K_F.trend"', priors=priors)
    campaign = write_and_read_campaign(tmp_path, text)
    known = {name: a.priors["K_F.trend"] for name, a in campaign.accelerometers.items()}
    assert (known["Qx"].value, known["Qx"].u) == (0.0, 1e-9)
    assert (known["Qy"].value, known["Qy"].u) == (1e-9, 2e-9)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ('temperature = "21"', "'21' is not a temperature"),
        ('temperature = "1e4 degC"', "10000 degC is not plausible for an accelerometer"),
        ('temperature = "20 K"', "20 K is not plausible for an accelerometer; check the unit"),
        ('temperature = ["20 degC", "1e18 K"]', "1e+18 K is not plausible for an accelerometer"),
        ('time = "12"', "has no unit"),
        ("temprature = 1", 'did you mean "temperature"'),
    ],
)
def test_invalid_conditions_are_reported(line, message, tmp_path):
    text = replace_parts(SMALL, ('record = "fast.csv"\n', f'record = "fast.csv"\n{line}\n'))
    assert any(message in problem for problem in list_problems(tmp_path, text))


def add_temperatures(*courses):
    """Return `SMALL` with several temperatures in each run, degC."""
    text = SMALL
    for name, course in zip(STATED, courses, strict=True):
        listed = ", ".join(f'"{one} degC"' for one in course)
        line = f'record = "{name}.csv"\n'
        text = replace_parts(text, (line, f"{line}temperature = [{listed}]\n"))
    return text


def test_temperatures_are_spread_evenly_over_run(tmp_path):
    campaign = write_and_read_campaign(tmp_path, add_temperatures([20, 24, 22], [23], [26, 27]))
    lengths = {"slow": 80.0, "middle": 40.0, "fast": 20.0}
    slow, middle, fast = run_conditions(campaign, lengths).values()
    # The ends have half the weight: (20/2 + 24 + 22/2)/2; the reference is the mean of all runs.
    mean = (22.5 + 23.0 + 26.5) / 3.0
    assert [
        slow.temperature_offset,
        middle.temperature_offset,
        fast.temperature_offset,
    ] == pytest.approx([22.5 - mean, 23 - mean, 2.5])
    offsets = slow.at(np.array([0.0, 20.0, 40.0, 60.0, 99.0]), 0.0)["temperature"]
    assert offsets + mean == pytest.approx([20.0, 22.0, 24.0, 23.0, 22.0])
    assert not middle.temperature_profile
    assert middle.at(np.array([3.0]), 0.0)["temperature"] == pytest.approx([23.0 - mean])


def test_reversal_within_run(tmp_path):
    """The temperature rises to 24 degC in mid-run 1, falls until the end of run 2, then rises."""
    text = add_temperatures([20, 22, 24, 23, 22, 21], [21, 19, 18], [19, 25])
    campaign = write_and_read_campaign(tmp_path, text)
    lengths = {"slow": 50.0, "middle": 40.0, "fast": 20.0}
    slow, middle, fast = run_conditions(campaign, lengths).values()
    assert [slow.direction, middle.direction, fast.direction] == [0.5, -0.5, 0.5]
    # The lines 20 + 2 x and 24 - (x - 2) meet at 2.
    assert slow.reversal_times == pytest.approx([20.0])
    assert middle.reversal_times == fast.reversal_times == ()
    directions = slow.at(np.array([0.0, 19.9, 20.1, 50.0]), 0.0)["direction"]
    assert directions.tolist() == [0.5, 0.5, -0.5, -0.5]


def test_reversal_between_temperatures_is_intersection_of_lines(tmp_path):
    """4 K per step until step 2.5, then -3 K per step: no sample is at the maximum."""
    course = [20, 24, 28, 28.5, 25.5, 22.5]
    campaign = write_and_read_campaign(tmp_path, add_temperatures(course, [21], [20]))
    slow = run_conditions(campaign, {"slow": 50.0})["slow"]
    assert slow.reversal_times == pytest.approx([25.0])


@pytest.mark.parametrize(
    ("temperatures", "ways"),
    [
        ([20, 30, 40, 30, 20], [1, 1, 1, -1, -1]),
        ([40, 20, 20, 35], [-1, -1, -1, 1]),
        # A turning point requires 2 K; the samples after it belong to the opposite direction.
        ([20, 25, 24, 23.5, 26, 22], [1, 1, 1, 1, 1, -1]),
        ([20, 25, 24, 23, 22, 24.5], [1, 1, -1, -1, -1, 1]),
        ([20, 25, 23.5, 30, 31.5], [0, 0, 0, 0, 0]),
        ([20.0, 21.5, 20.2, 21.9], [0, 0, 0, 0]),
        ([23], [0]),
    ],
)
def test_direction_follows_from_turning_points(temperatures, ways, tmp_path):
    described = {
        "site": {"gravity": "9.8 m/s^2", "latitude": "45 deg"},
        "centrifuge": {"radius": "1 m"},
        "records": {"time": {"column": "t", "unit": "s"}},
        "accelerometers": {"A": {"input_axis": "up", "pendulous_axis": "east"}},
        "model": {"assume": "all", "terms": ["K_F"]},
        "runs": [
            {
                "name": f"{place}",
                "motion": "static",
                "attitude": f"{30 * place} deg about north",
                "reading": "1 ± 1e-6 g",
                "temperature": f"{temperature} degC",
            }
            for place, temperature in enumerate(temperatures)
        ],
    }
    directions = temperature_directions(make_campaign(described))
    assert [2 * directions.get(str(place), (0,))[0] for place in range(len(ways))] == ways
    # Ordered by time if all runs state it.
    for place, run in enumerate(described["runs"]):
        run["time"] = f"{-place} min"
    back = temperature_directions(make_campaign(described))
    mirrored = _reverse_temperatures(temperatures)
    assert [2 * back.get(str(place), (0,))[0] for place in range(len(ways))] == mirrored
    del described["runs"][0]["time"]
    assert temperature_directions(make_campaign(described)) == directions


def _reverse_temperatures(temperatures):
    """Return the directions of the reversed temperatures."""
    known = {
        (20, 30, 40, 30, 20): [-1, -1, 1, 1, 1],
        (40, 20, 20, 35): [1, -1, -1, -1],
        (20, 25, 24, 23.5, 26, 22): [-1, -1, -1, -1, 1, 1],
        (20, 25, 24, 23, 22, 24.5): [-1, 1, 1, 1, -1, -1],
    }
    return known.get(tuple(temperatures), [0] * len(temperatures))


def test_hysteresis_acts_after_temperature_reversal(tmp_path):
    """The bias of two tumbles at 20 degC, with one at 30 degC between, shows the hysteresis."""
    rng = np.random.default_rng(6)
    angles = np.arange(0.0, 360.0, 30.0)
    warm = np.repeat([20.0, 30.0, 20.0], angles.size)
    bias = 1e-3 + 2e-6 * (warm - 70.0 / 3.0) + 5e-5 * np.repeat([0.5, 0.5, -0.5], angles.size)
    frame = {
        "deg": np.tile(angles, 3),
        "g": bias + np.cos(np.deg2rad(np.tile(angles, 3))) + 1e-6 * rng.standard_normal(36),
        "u": np.full(36, 1e-6),
        "degC": warm,
    }
    described = {
        "site": {"gravity": "9.8 m/s^2", "latitude": "45 deg"},
        "centrifuge": {"radius": "1 m"},
        "records": {"time": {"column": "t", "unit": "s"}},
        "accelerometers": {"A": {"input_axis": "up", "pendulous_axis": "east"}},
        "model": {"assume": "all", "terms": ["K_F", "K_I", "K_F.temperature", "K_F.hysteresis"]},
        "readings": {
            "columns": {"attitude": "deg", "reading": "g", "u": "u", "temperature": "degC"}
        },
    }
    coefficients = (
        calibrate(make_campaign(described, readings=frame)).accelerometers["A"].coefficients
    )
    for symbol, truth in (("K_F", 1e-3), ("K_F.temperature", 2e-6), ("K_F.hysteresis", 5e-5)):
        assert abs(coefficients[symbol].value - truth) < 4 * coefficients[symbol].u, symbol
    # The means of the first and third twelve readings differ only by the hysteresis.
    assert coefficients["K_F.hysteresis"].u == pytest.approx(1e-6 * math.sqrt(2 / 12), rel=1e-3)
    del described["model"]["assume"]
    described["model"]["terms"] = ["K_F", "K_I"]
    unstated = calibrate(make_campaign(described, readings=frame))
    known = {prior.name: prior for prior in unstated.rests_on}
    assert known["A.K_F.hysteresis"].u == 2e-5
    assert abs(known["A.K_F.hysteresis"].found - 5e-5) < 3e-6
    frame["degC"] = np.repeat([20.0, 21.0, 20.0], angles.size)
    steady = calibrate(make_campaign(described, readings=frame))
    assert "A.K_F.hysteresis" not in {prior.name for prior in steady.rests_on}
