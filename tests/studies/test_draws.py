"""Inputs that are not what is stated of them: every engine, and what u says of them."""

import os
import re
from importlib.resources import files

import numpy as np
import pytest
from campaigns import replace_parts, write_description
from raising import raises

from counterspin.calibration.calibrate import calibrate
from counterspin.errors import CampaignError
from counterspin.simulation.simulate import simulate
from counterspin.studies.description import read_study
from counterspin.studies.draws import StudyTruth, random_stream
from counterspin.studies.engine_selection import choose_engine, list_analyses
from counterspin.studies.simulation_setup import make_setup
from counterspin.studies.study import study

FULL = bool(os.environ.get("COUNTERSPIN_FULL"))

#: The paper's plan, short, with nothing known beforehand and an encoder without noise.
PLAN = replace_parts(
    (files("counterspin.reproduction") / "paper.toml").read_text(encoding="utf-8"),
    ("revolutions = 100", "revolutions = 12"),
    ('"50 Hz"', '"8 Hz"'),
    ('bias = "0.004 ± 2e-6 g"', "#"),
    ('scale_factor = "1.001 ± 5e-6 g/g"', "#"),
    ('K_IP = "0 ± 1e-5 g/g^2"', "#"),
    ('hold = ["K_IP"]', "#"),
    ('K_IP = "6e-6 g/g^2"', ""),
    ('angle = "1e-6 rad"', ""),
)
JOINT = '\n[study.analyses.joint]\nmethod = "joint"\n'
TWO_STAGE = '\n[study.analyses.two]\nmethod = "two-stage"\nterms = ["K_F", "K_II"]\n'


def varied(**fixed):
    lines = (f'"{key}" = {{ fixed = "{value}" }}' for key, value in fixed.items())
    return "\n[study.vary]\n" + "\n".join(lines) + "\n"


def made(folder, text, engine):
    """Return engine, estimates and u by symbol, of one trial without noise."""
    description = read_study(write_description(folder, text))
    setup, truth = (
        make_setup(description.campaign),
        StudyTruth.from_campaign(description.campaign, description.varied_quantities),
    )
    (analysis,) = list_analyses(description)
    part = choose_engine(setup, truth, analysis, engine)
    draws = truth.draw(random_stream(1, 0, 0), 1)
    draws.white_noise[:] = 0.0
    trials = part.engine.run_trials(draws, random_stream(1, 0, 1))
    names = [coefficient.symbol for coefficient in part.coefficients]
    rows = list(part.rows)
    values = zip(trials.estimate[rows, 0], trials.u[rows, 0], strict=True)
    return part.cost_class, dict(zip(names, values, strict=True))


# K_F shows as g t^2/2, K_I - 1 as R cos wt beside the reference R cos wt, K_II as
# R^2 w^4 t^2/(4 g). A clock that is fast by f shows t (1 + f) and w/(1 + f); a delay turns the
# reference by w times it.
CLOSED_FORMS = [
    ("centrifuge.radius", "2.50005 m", {"K_I": 1.001 * 2e-5, "K_II": 2e-5 * 4e-5}),
    ("site.gravity", "9.80098 m/s^2", {"K_F": 0.004 * 1e-4, "K_II": -2e-5 * 1e-4}),
    ("records.clock", "100 ppm", {"K_F": -0.004 * 2e-4, "K_II": 2e-5 * 2e-4}),
    ("records.timing_offset", "1e-5 s", {"K_F": 0.0, "K_II": 0.0}),
    ("site.latitude", "45.01 deg", {"K_F": 0.0, "K_II": 0.0}),
]


@pytest.mark.slow
@pytest.mark.parametrize("analysis", [JOINT, TWO_STAGE], ids=["joint", "two-stage"])
@pytest.mark.parametrize(("name", "true", "shifts"), CLOSED_FORMS)
def test_engines_agree_on_effect_of_true_input(tmp_path, name, true, shifts, analysis):
    text = PLAN + analysis
    estimates, u = {}, {}
    for engine in ("auto", "full"):
        kind, perfect = made(tmp_path / f"{engine} stated", text, engine)
        _, off = made(tmp_path / engine, text + varied(**{name: true}), engine)
        assert (kind == "full") is (engine == "full")
        estimates[engine] = {symbol: off[symbol][0] - perfect[symbol][0] for symbol in perfect}
        u |= {symbol: own for symbol, (_, own) in perfect.items()}
    for own in estimates.values():
        for symbol, expected in shifts.items():
            if symbol in own:
                # Parts of the Coriolis force, and what K_III and ripple make of it.
                bound = 2e-3 * abs(expected) + 2e-3 * u[symbol]
                assert own[symbol] == pytest.approx(expected, abs=bound), symbol
    for symbol, fast in estimates["auto"].items():
        bound = 1e-3 * abs(fast) + 1e-3 * u[symbol]
        assert estimates["full"][symbol] == pytest.approx(fast, abs=bound), symbol


def test_tilt_is_multiplied_by_scale_factor(tmp_path):
    text = replace_parts(PLAN, ('K_I = "1.001 g/g"', 'K_I = "1.05 g/g"')) + TWO_STAGE
    tilted = text + varied(**{"platform.tilt.north": "3 arcsec"})
    for engine in ("auto", "full"):
        _, level = made(tmp_path / f"{engine} level", text, engine)
        _, off = made(tmp_path / engine, tilted, engine)
        expected = -1.05 * np.deg2rad(3.0 / 3600.0)
        bound = 1e-3 * abs(expected)
        assert off["K_F"][0] - level["K_F"][0] == pytest.approx(expected, abs=bound), engine


#: Inputs that u rests on: radius and gravity to 1e-4, and a poor clock.
UNCERTAIN = replace_parts(
    PLAN,
    ('"9.8 m/s^2"', '"9.8 ± 9.8e-4 m/s^2"'),
    ('"2.5 m"', '"2.5 ± 2.5e-4 m"'),
    ("[records]", '[records]\nclock = "0 ± 100 ppm"'),
    ('displacement = "0.01 m"', 'displacement = "1 mm"'),
)
#: The same with two recorders, each with a clock of its own.
TWO_CLOCKS = replace_parts(
    UNCERTAIN, ('record = "run1.csv"', 'record = "run1.csv"\nrecords = { recorder = "B" }')
)


@pytest.mark.slow
@pytest.mark.parametrize("text", [UNCERTAIN, TWO_CLOCKS], ids=["one clock", "two clocks"])
def test_stated_input_uncertainties_have_coverage(tmp_path, text):
    n = 200_000 if FULL else 20_000
    folder = write_description(tmp_path / "campaign", text + JOINT)
    result = study(folder, trials=n)
    joint = result.analyses["joint"]
    assert joint.engine == "linear"
    for symbol in ("K_F", "K_I", "K_II"):
        coefficient = joint.coefficients[f"Qx.{symbol}"]
        assert coefficient.covered[1] == pytest.approx(0.95, abs=4.0 * np.sqrt(0.95 * 0.05 / n))
        assert coefficient.sd == pytest.approx(coefficient.u, rel=5.0 / np.sqrt(2 * n))
        assert abs(coefficient.bias) < 4.0 * coefficient.se_bias
    # The radius alone makes this of K_I, and of K_F gravity and clock (of both recorders less).
    assert joint.coefficients["Qx.K_I"].u == pytest.approx(1e-4, rel=0.1)
    clock = 0.004 * 1e-4
    low, high = np.hypot(clock, 1.4 * clock), np.hypot(clock, 2.0 * clock)
    assert low <= joint.coefficients["Qx.K_F"].u <= 1.01 * high
    simulate(read_study(folder).campaign, tmp_path / "made")
    calibrated = calibrate(tmp_path / "made")
    for symbol in ("K_F", "K_I", "K_II"):
        expected = joint.coefficients[f"Qx.{symbol}"].u
        assert calibrated.coefficient(f"Qx.{symbol}").u == pytest.approx(expected, rel=2e-3)
    # Whole records scatter alike: 20 trials know that to 16 %.
    whole = study(folder, trials=20, engine="full").analyses["joint"]
    for symbol in ("K_F", "K_I", "K_II"):
        coefficient = whole.coefficients[f"Qx.{symbol}"]
        assert coefficient.sd / coefficient.u == pytest.approx(1.0, abs=0.64)


def test_recorders_may_have_separate_clocks(tmp_path):
    text = replace_parts(TWO_CLOCKS, ("[records]", '[records]\nrecorder = "A"')) + JOINT
    vary = '[study.vary.B]\nrecords.clock = { fixed = "7 ppm" }\n'
    vary += '[study.vary.A]\nrecords.clock = { fixed = "0 ppm" }'
    read = read_study(write_description(tmp_path / "named", f"{text}\n{vary}\n"))
    clocks = {
        v.owner: v.first_parameter for v in read.varied_quantities if v.symbol == "records.clock"
    }
    assert clocks == {"B": 7e-6, "": 0.0}
    both = '[study.vary]\nrecords.clock = { normal = "0 ± 5 ppm" }'
    read = read_study(write_description(tmp_path / "both", f"{text}\n{both}\n"))
    assert {v.owner for v in read.varied_quantities if v.symbol == "records.clock"} == {"", "B"}
    true = '[truth.records]\nclock = { B = "7 ppm" }\n'
    read = read_study(write_description(tmp_path / "true", text + true))
    truth = StudyTruth.from_campaign(read.campaign, read.varied_quantities)
    assert truth.fixed_inputs["B", "records.clock"] == 7e-6
    assert ("", "records.clock") not in truth.fixed_inputs
    assert truth.draw(random_stream(3, 0, 0), 2).input_errors["", "records.clock"].any()


def test_response_inputs_vary_by_accelerometer(tmp_path):
    stated = '[accelerometers.Qx]\nnatural_frequency = "400 ± 20 Hz"\ndamping = "0.7 ± 0.1"\n'
    text = replace_parts(UNCERTAIN, ("[accelerometers.Qx]\n", stated)) + JOINT
    vary = '[study.vary]\n"Qx.sensor.damping" = { fixed = "0.6 1" }\n'
    read = read_study(write_description(tmp_path / "named", f"{text}\n{vary}"))
    truth = StudyTruth.from_campaign(read.campaign, read.varied_quantities)
    response = make_setup(read.campaign).true_mounting("Qx", truth.mean_draw()).response
    assert (response.natural_frequency, response.damping) == (400.0, pytest.approx(0.6))
    unstated = re.sub(r"(\[truth\.Qx\].*\n)", r"\1damping = 0.6\n", UNCERTAIN) + JOINT
    campaign = read_study(write_description(tmp_path / "unstated", unstated)).campaign
    with raises("not-simulable", "truth.Qx.damping:"):
        make_setup(campaign)


def test_large_input_deviation_requires_full_records(tmp_path):
    """K_II goes as the square of the radius: 4 % of it are 30 of its u."""
    text = replace_parts(UNCERTAIN, ("± 2.5e-4 m", "± 0.1 m")) + JOINT
    result = study(write_description(tmp_path, text), trials=2)
    assert "not linear" in result.analyses["joint"].engine


@pytest.mark.parametrize(
    ("vary", "words"),
    [
        (
            '"site.gravity" = { normal = "9.8 ± 1e-4 m/s^2", per = "run" }',
            "is the same in all runs",
        ),
        ('"site.gravity" = { fixed = "8 m/s^2" }', "must be between 9.76 and 9.84 m/s^2"),
        (
            '"C.records.clock" = { fixed = "1 ppm" }',
            "does not apply to any record or reading of this campaign",
        ),
    ],
)
def test_invalid_variation_of_input_raises(tmp_path, vary, words):
    with pytest.raises(CampaignError, match=re.escape(words)):
        read_study(write_description(tmp_path, f"{PLAN}{JOINT}[study.vary]\n{vary}\n"))


def on_the_arm(rate, unit):
    run = f'[[runs]]\nname = "{rate}"\nmotion = "arm"\nrate = "{rate} rad/s"\n'
    axes = 'axes = { input = "inward", pendulous = "down" }\n'
    return f'{run}{axes}reading = "{rate**2 / 10.0} ± 1e-6 {unit}"\n'


@pytest.mark.slow
@pytest.mark.parametrize("unit", ["g", "m/s^2"])
def test_arm_readings_use_inputs_of_trial(tmp_path, unit):
    """In g, K_I is known to radius and gravity; in m/s^2 to the radius alone."""
    text = """
schema = 1
[site]
gravity = "9.8066 ± 1.96e-3 m/s^2"
latitude = "45 deg"
[centrifuge]
radius = "1 ± 1e-4 m"
[accelerometers.A]
input_axis = "up"
pendulous_axis = "east"
[model]
terms = ["K_F", "K_I"]
assume = "all"
[simulation]
[truth.A]
K_I = "1.002 g/g"
"""
    text += "".join(on_the_arm(rate, unit) for rate in (3, 5, 7, 9, 11))
    n = 1000 if FULL else 100
    joint = study(write_description(tmp_path, text), trials=n).analyses["joint"]
    k_i = joint.coefficients["A.K_I"]
    expected = np.hypot(1e-4, 2e-4 if unit == "g" else 0.0)
    assert k_i.u == pytest.approx(1.002 * expected, rel=1e-2)
    assert k_i.sd == pytest.approx(k_i.u, rel=5.0 / np.sqrt(2 * n))
    assert abs(k_i.bias) < 4.0 * k_i.se_bias
