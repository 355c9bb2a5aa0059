"""Calibrating readings: a tumble, an arm, both together; what they say and what they cannot."""

import math

import numpy as np
import pytest
from reading_campaigns import TRUTH, arm, simulated, tumble

from counterspin.calibration.calibrate import calibrate
from counterspin.calibration.options import TwoStageOptions
from counterspin.campaign.simulation import simulate
from counterspin.cli import main
from counterspin.errors import CampaignError

SIGMA = 2e-6
HEAD = """schema = 1
site = { gravity = "9.80665 m/s^2", latitude = "0.8 rad" }
[accelerometers.A]
input_axis = "up"
pendulous_axis = "west"
output = { unit = "mA", sensitivity = "1.25 mA/g" }
[centrifuge]
radius = "1.0 ± 1e-6 m"
"""


def tumble_runs(values, u=SIGMA):
    step = 360 / len(values)
    return "".join(
        f'[[runs]]\nname = "tumble {i}"\nmotion = "static"\n'
        f'attitude = "{i * step!r} deg about north"\n'
        f'reading = "{float(1.25 * value)!r}{spread(u)} mA"\n'
        for i, value in enumerate(values)
    )


def arm_runs(test, values, u=SIGMA):
    return "".join(
        f'[[runs]]\nname = "{side} {i}"\nmotion = "arm"\nrate = "{float(station.rate)!r} rad/s"\n'
        f'mounting = "{side}"\naxes = {{ input = "{side}", pendulous = "forward" }}\n'
        f'reading = "{float(1.25 * value)!r}{spread(u)} mA"\n'
        for i, (station, side, value) in enumerate(zip(test[0], test[1], values, strict=True))
    )


def spread(u):
    return f" ± {1.25 * u!r}" if u else ""


def calibrated(folder, *parts):
    (folder / "campaign.toml").write_text("".join([HEAD, *parts]), encoding="utf-8")
    return calibrate(folder)


def model(*terms, more=""):
    return f"[model]\nterms = {list(terms)}\n{more}".replace("'", '"')


LEVEL_TERMS = {"K_F": 2e-3, "K_I": 1.0005, "delta_O": 3e-5}


def test_a_tumble(tmp_path):
    values = simulated(tumble(), np.random.default_rng(1), SIGMA, truth=LEVEL_TERMS)
    result = calibrated(tmp_path, model(*LEVEL_TERMS), tumble_runs(values))
    a = result.accelerometers["A"]
    assert result.state == "good"
    assert result.warnings == []
    for symbol, truth in LEVEL_TERMS.items():
        c = a.coefficients[symbol]
        assert abs(c.value - truth) < 4.0 * c.u
    expected = SIGMA * np.array([1 / math.sqrt(12), 1 / math.sqrt(6), 1 / math.sqrt(6)])
    np.testing.assert_allclose([c.u for c in a.coefficients.values()], expected, rtol=1e-6)
    bias = a.output["bias"]
    assert (bias.unit, bias.value) == ("mA", pytest.approx(1.25 * a.coefficients["K_F"].value))
    assert a.output["scale_factor"].unit == "mA/g"
    assert len(a.readings) == 12


def test_the_arm_tells_k_ii_and_the_machine_is_in_its_budget(tmp_path):
    test = arm()
    values = simulated(test, np.random.default_rng(2), SIGMA)
    stretch = '[model.priors]\n"centrifuge.stretch" = "0 ± 5e-9 s^2/m"\n'
    result = calibrated(tmp_path, model(*TRUTH, more=stretch), arm_runs(test, values))
    k_ii = result.accelerometers["A"].coefficients["K_II"]
    assert k_ii.estimated
    assert abs(k_ii.value - TRUTH["K_II"]) < 4.0 * k_ii.u
    sources = {line.source for line in result.accelerometers["A"].budget["K_III"]}
    assert "centrifuge.stretch (considered)" in sources


def test_tumble_and_arm_together_are_surer_than_each(tmp_path):
    rng = np.random.default_rng(3)
    test = arm()
    runs = {
        "tumble": tumble_runs(simulated(tumble(), rng, SIGMA, truth={**TRUTH})),
        "arm": arm_runs(test, simulated(test, rng, SIGMA)),
    }
    asked = model("K_F", "K_I", "K_II", "K_III", "delta_O")
    both = calibrated(tmp_path, asked, *runs.values()).accelerometers["A"].coefficients
    alone = calibrated(tmp_path, asked, runs["arm"]).accelerometers["A"].coefficients
    for symbol in ("K_F", "K_I", "K_II"):
        assert both[symbol].u < alone[symbol].u
    assert abs(both["K_II"].value - TRUTH["K_II"]) < 4.0 * both["K_II"].u


def test_at_one_g_k_ii_is_not_determined(tmp_path):
    values = simulated(tumble(24), np.random.default_rng(4), SIGMA, truth=TRUTH)
    result = calibrated(tmp_path, model("K_F", "K_I", "K_II", "delta_O"), tumble_runs(values))
    k_ii = result.accelerometers["A"].coefficients["K_II"]
    assert not k_ii.estimated
    assert k_ii.value is None


@pytest.mark.parametrize("stated", [True, False], ids=["noise stated", "noise estimated"])
def test_a_mistake_in_one_position_is_named(tmp_path, stated):
    values = simulated(tumble(), np.random.default_rng(5), SIGMA, truth=LEVEL_TERMS)
    values[7] += 160e-6
    u = SIGMA if stated else None
    result = calibrated(tmp_path, model(*LEVEL_TERMS), tumble_runs(values, u))
    assert result.state == ("contradicted" if stated else "reservations")
    outlying = [f for f in result.findings if f.code == "outlying-reading"]
    assert outlying[0].subject == "A.tumble 7"


def test_readings_that_fit_have_no_outlier(tmp_path):
    """At the level of 1 % a campaign, in 60 campaigns no more than 4 (p = 0.003)."""
    rng = np.random.default_rng(6)
    false = 0
    for _ in range(60):
        values = simulated(tumble(), rng, SIGMA, truth=LEVEL_TERMS)
        result = calibrated(tmp_path, model(*LEVEL_TERMS), tumble_runs(values, None))
        false += any(f.code == "outlying-reading" for f in result.findings)
    assert false <= 4


def test_radius_of_a_mounting_is_shown_as_a_radius(tmp_path):
    rng = np.random.default_rng(7)
    test = arm()
    values = simulated(test, rng, SIGMA, {"centrifuge.radius.inward": 3e-5})
    prior = '[model.priors]\n"centrifuge.radius" = "1.0 ± 1e-4 m"\n'
    terms = ("K_F", "K_I", "K_II", "K_III", "centrifuge.radius")
    tumbled = tumble_runs(simulated(tumble(), rng, SIGMA, truth=TRUTH))
    result = calibrated(
        tmp_path, model(*terms, "delta_O", more=prior), tumbled, arm_runs(test, values)
    )
    radius = result.platform["centrifuge.radius.inward"]
    assert abs(radius.value - 1.00003) < 4.0 * radius.u
    assert radius.u < 1e-5


def test_records_on_the_arm_are_averaged(tmp_path):
    rng, test = np.random.default_rng(9), arm()
    values = simulated(test, rng, 0.0)
    runs = arm_runs(test, values)
    t = np.arange(0.0, 10.0, 0.05)
    for i, value in enumerate(values):
        current = 1.25 * (value + rng.normal(0.0, 1e-5, t.size))
        rows = "".join(f"{a!r},{b!r}\n" for a, b in zip(t.tolist(), current.tolist(), strict=True))
        (tmp_path / f"r{i}.csv").write_text("t,mA\n" + rows, encoding="utf-8")
        given = f'reading = "{float(1.25 * value)!r}{spread(SIGMA)} mA"'
        assert given in runs
        runs = runs.replace(given, f'record = "r{i}.csv"', 1)
    column = 'specific_force = { column = "mA", unit = "mA" }\n[centrifuge]'
    records = '[records]\ntime = { column = "t", unit = "s" }\n'
    text = HEAD.replace("[centrifuge]", column) + records + model(*TRUTH) + runs
    (tmp_path / "campaign.toml").write_text(text, encoding="utf-8")
    result = calibrate(tmp_path)
    for symbol, truth in TRUTH.items():
        c = result.accelerometers["A"].coefficients[symbol]
        assert abs(c.value - truth) < 4.0 * c.u
    assert set(result.provenance.inputs) == {"campaign.toml", *(f"r{i}.csv" for i in range(24))}


def test_what_needs_records_says_so(tmp_path, capsys):
    values = simulated(tumble(), np.random.default_rng(8), SIGMA, truth=LEVEL_TERMS)
    calibrated(tmp_path, model(*LEVEL_TERMS), tumble_runs(values))
    for command in (
        lambda: simulate(tmp_path, tmp_path / "out"),
        lambda: calibrate(tmp_path, method="two-stage", options=TwoStageOptions()),
    ):
        with pytest.raises(CampaignError, match="this campaign has readings"):
            command()
    assert main(["calibrate", str(tmp_path), "--budget", "--details"]) == 0
    assert "tumble 11" in capsys.readouterr().out
