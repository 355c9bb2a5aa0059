"""Studies of readings: unbiased, their intervals hold the truth, and they claim what is claimed."""

import math
import os

import mixed_campaign
import numpy as np
import pytest
from mixed_campaign import MODEL, RUNS, SIMULATION
from raising import raises
from reading_descriptions import format_arm_run, format_rest_run
from scipy import stats

import counterspin as cs
from counterspin.errors import CampaignError
from counterspin.studies.description import read_study
from counterspin.studies.engine_selection import prepare_study
from counterspin.studies.study import study

HEAD = """schema = 1
site = { gravity = "9.8066 m/s^2", latitude = "45.75 deg" }
[centrifuge]
radius = "1.0 m"
[accelerometers.A]
input_axis = "up"
pendulous_axis = "west"
output = { unit = "mA", sensitivity = "1.25 mA/g" }
specific_force = { column = "mA", unit = "mA" }
[truth.A]
K_F = "2e-3 g"
K_I = "1.0005 g/g"
K_II = "15 ug/g^2"
"""


def tumble(u=" ± 2e-6 mA", count=12):
    step = 360 // count
    return "".join(
        format_rest_run(f"{i * step} deg", f"{i * step} ± 2e-5 deg about north", f"?{u}")
        for i in range(count)
    )


def arm(u=" ± 2e-6 mA", rates=(3.1, 7.0, 10.0, 14.0)):
    return "".join(
        format_arm_run(f"{side} {rate}", f"{rate} rad/s", f"?{u}", side=side, mounting=side)
        for side in ("inward", "outward")
        for rate in rates
    )


NOISE = '[truth.noise]\nreading = "2e-6 mA"\n'
AT_REST = """[model]
assume = "all"
terms = ["K_F", "K_I", "K_II", "delta_O"]
considered = ["head.zero", "K_PP"]
[model.priors]
"head.zero" = "0 ± 1 arcsec"
"K_PP" = "0 ± 2 ug/g^2"
[study.vary]
"head.zero" = { normal = "0 ± 1 arcsec" }
"K_PP" = { normal = "0 ± 2 ug/g^2" }
"""
ON_ARM = """[model]
assume = "all"
terms = ["K_F", "K_I", "K_II"]
considered = ["centrifuge.stretch", "fixture.misalignment.inward.forward"]
[model.priors]
"centrifuge.stretch" = "0 ± 5e-9 s^2/m"
"fixture.misalignment.inward.forward" = "0 ± 2 arcsec"
[study.vary]
"centrifuge.stretch" = { normal = "0 ± 5e-9 s^2/m" }
"fixture.misalignment.inward.forward" = { normal = "0 ± 2 arcsec" }
"""
ESTIMATED = ON_ARM.replace('K_II"]\nconsidered = [', 'K_II", ')
SET_BY_HAND = """[fixture]
position = "0 ± 20 arcsec"
[model]
assume = "all"
terms = ["K_F", "K_I", "K_II", "delta_O"]
hold = ["K_PP"]
[model.priors]
"K_PP" = "0 ± 2 ug/g^2"
[study.vary]
"K_PP" = { normal = "0 ± 2 ug/g^2" }
"""
BOTH = """[model]
assume = "all"
terms = ["K_F", "K_I", "K_II", "delta_O", "centrifuge.radius"]
[model.priors]
"centrifuge.radius" = "0 ± 1e-4 m"
[study.vary]
"centrifuge.radius.inward" = { normal = "0 ± 1e-4 m" }
"centrifuge.radius.outward" = { normal = "0 ± 1e-4 m" }
"""

STUDIES = {
    "tumble, noise stated": (AT_REST, tumble()),
    "tumble, noise estimated": (AT_REST + NOISE, tumble("")),
    "tumble, positions set by hand": (SET_BY_HAND, tumble()),
    "tumble, set by hand, noise estimated": (
        SET_BY_HAND + NOISE,
        tumble(", ?").replace('"?, ?"', '["?", "?"]'),
    ),
    "arm, noise stated": (ON_ARM, arm()),
    "arm, noise estimated": (ESTIMATED + NOISE, arm("")),
    "arm, considered, noise estimated": (ON_ARM + NOISE, arm("")),
    "both, noise stated": (BOTH, tumble() + arm(rates=(7.0, 14.0))),
    "both, noise estimated": (BOTH + NOISE, tumble("", 8) + arm("", (7.0, 14.0))),
}
TRIALS = 1000 if os.environ.get("COUNTERSPIN_FULL") else 16


def described(folder, *parts):
    folder.mkdir(exist_ok=True)
    (folder / "campaign.toml").write_text(HEAD + "".join(parts), encoding="utf-8")
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("name", STUDIES)
def test_estimates_are_unbiased_and_intervals_have_coverage(tmp_path, name):
    """All bounds together fail by chance once in some thousand changes of the random numbers."""
    result = study(described(tmp_path, *STUDIES[name]), trials=TRIALS, seed=5)
    check_coverage(result.analyses["joint"], "readings")


def test_default_priors_of_readings_have_coverage(tmp_path):
    text = AT_REST.replace('assume = "all"\n', "").partition("[study.vary]")[0]
    folder = described(tmp_path, text.replace('considered = ["head.zero", "K_PP"]\n', ""), tumble())
    drawn = {v.symbol for v in read_study(folder).varied_quantities}
    assert {"K_OO", "K_IP", "K_IO", "delta_P"} <= drawn
    assert {"head.zero", "K_PP"} <= drawn  # stated
    assert "K_II" not in drawn  # asked for
    result = study(folder, trials=TRIALS, seed=5)
    check_coverage(result.analyses["joint"], "readings")


def check_coverage(analysis, engine):
    """Check bias, both intervals and efficiency of the coefficients, each by its own scatter."""
    assert analysis.engine == engine
    assert {"A.K_F", "A.K_I", "A.K_II"} <= set(analysis.coefficients)
    for coefficient in analysis.coefficients.values():
        trials = coefficient.trials
        assert abs(coefficient.bias) < 4.5 * coefficient.se_bias
        for covered, level in zip(coefficient.covered, (0.68, 0.95), strict=False):
            low, high = stats.binom.interval(1.0 - 1e-5, trials, level)
            assert low <= round(covered * trials) <= high
        assert coefficient.efficiency is None or coefficient.efficiency < 1.0 + 5.0 / math.sqrt(
            trials / 2
        )


def describe_records_and_readings(folder, varying):
    """Describe records of a double turntable with readings at rest and on the arm beside them."""
    resting = "".join(
        format_rest_run(f"rest {angle}", f"{angle} deg about north", "? ± 2.5e-6 mA")
        for angle in range(0, 360, 30)
    )
    carried = "".join(
        format_arm_run(f"{side} {rate}", f"{rate} rad/s", "? ± 5e-5 mA", side=side)
        for side in ("inward", "outward")
        for rate in (3.1, 7.0, 14.0)
    )
    short = SIMULATION.replace("revolutions = 20", "revolutions = 5")
    description = (
        mixed_campaign.DESCRIPTION_HEAD + MODEL + short + varying + RUNS + resting + carried
    )
    folder.mkdir(exist_ok=True)
    (folder / "campaign.toml").write_text(description, encoding="utf-8")
    return folder


TILTED = "[study.vary]\n" + "".join(
    f'"platform.tilt.{about}" = {{ normal = "0 ± 0.5 arcsec" }}\n' for about in ("north", "east")
)


def test_records_and_readings_of_same_accelerometer_have_coverage(tmp_path):
    """The tilt that the records share with nothing at rest or on the arm varies as it is known."""
    describe_records_and_readings(tmp_path, TILTED)
    result = study(tmp_path, trials=max(TRIALS // 3, 20), seed=5)
    check_coverage(result.analyses["joint"], "full records and readings")


def test_varying_noise_applies_to_records_beside_readings(tmp_path):
    """The true noise is a hundred times the assumed noise, with the same random numbers."""
    noisy = TILTED + '"noise.displacement" = { fixed = "0.1 m" }\n'
    trials = [
        prepare_study(
            read_study(describe_records_and_readings(tmp_path / name, varying)), 5
        ).run_batch(0, 1, keep_trials=True)
        for name, varying in (("stated", TILTED), ("varied", noisy))
    ]
    (truth, estimate, u), (_, varied, _) = (values[:, :, 0].T for _, values in trials)
    assert np.all(np.abs(estimate - truth) < 4.0 * u)
    assert np.max(np.abs(varied - truth) / u) > 5.0


def test_u_of_trial_matches_calibration(tmp_path):
    parts = STUDIES["both, noise stated"]
    folder = described(tmp_path / "own", *parts)
    result = cs.study(folder, trials=8)
    cs.simulate(folder, tmp_path / "made")
    actual_result = cs.calibrate(tmp_path / "made")
    for symbol in ("K_F", "K_I", "K_II", "delta_O"):
        claimed = result.analyses["joint"].coefficients[f"A.{symbol}"].u
        assert claimed == pytest.approx(
            actual_result.accelerometers["A"].coefficients[symbol].u, rel=1e-3
        )
    radius = result.analyses["joint"].coefficients["centrifuge.radius.inward"]
    assert radius.u == pytest.approx(actual_result.platform["centrifuge.radius.inward"].u, rel=1e-4)
    assert radius.unit == "m"


def test_record_readings_have_u_of_mean(tmp_path):
    """White noise of 20 Hz over 100 s: the mean's standard deviation is the sample's over 44.7."""
    record = (
        '[[runs]]\nname = "rest"\nmotion = "static"\nattitude = "level"\n'
        'record = "rest.csv"\nduration = "100 s"\n'
        '[records]\ntime = { column = "t", unit = "s" }\n'
        '[simulation]\nsampling_rate = "20 Hz"\n'
        '[model]\nassume = "all"\nterms = ["K_F"]\n[truth.noise]\nspecific_force = "1 mg"\n'
    )
    text = HEAD.replace('K_II = "15 ug/g^2"\n', "").replace('K_I = "1.0005 g/g"\n', "")
    (tmp_path / "campaign.toml").write_text(text + record, encoding="utf-8")
    coefficient = study(tmp_path, trials=400).analyses["joint"].coefficients["A.K_F"]
    expected = 1e-3 / math.sqrt(2000)
    assert coefficient.sd == pytest.approx(expected, rel=5.0 / math.sqrt(800))
    assert coefficient.bound == pytest.approx(expected, rel=1e-9)


def test_machine_radius_may_vary(tmp_path):
    vary = (
        '[model]\nassume = "all"\nterms = ["K_I"]\n'
        '[study.vary]\n"centrifuge.radius" = { fixed = "1.001 m" }\n'
    )
    text = HEAD.replace('K_F = "2e-3 g"\n', "").replace('K_II = "15 ug/g^2"\n', "")
    (tmp_path / "campaign.toml").write_text(text + vary + arm(), encoding="utf-8")
    coefficient = study(tmp_path, trials=4).analyses["joint"].coefficients["A.K_I"]
    assert coefficient.bias == pytest.approx(1.0005e-3, rel=1e-3)
    assert not coefficient.trustworthy


def test_undetermined_coefficients_are_named(tmp_path):
    text = '[model]\nassume = "all"\nterms = ["K_F", "K_I", "K_II", "delta_O"]\n'
    (tmp_path / "campaign.toml").write_text(HEAD + text + tumble(), encoding="utf-8")
    analysis = study(tmp_path, trials=2).analyses["joint"]
    assert analysis.undetermined == ["A.K_II"]


def test_trial_does_not_depend_on_worker(tmp_path):
    parts = STUDIES["arm, noise estimated"]
    engine = prepare_study(read_study(described(tmp_path, *parts)), 7)
    batch, again = (
        engine.run_batch(3, 5, keep_trials=True),
        engine.run_batch(3, 5, keep_trials=True),
    )
    np.testing.assert_array_equal(batch[1], again[1])


SLIPS = {
    "two-stage": (
        '[study.analyses.old]\nmethod = "two-stage"\n',
        "study.analyses.old.method: the two-stage method requires records",
    ),
    "a spindle": (
        '[study.vary]\n"spindle.drift" = { fixed = "1e-6 1/s" }\n',
        "requires double-turntable records, but the campaign contains none",
    ),
    "another mounting": (
        '[study.vary]\n"centrifuge.radius.inn" = { fixed = "1 mm" }\n',
        'cannot be varied in a study; did you mean "centrifuge.radius"?',
    ),
    "no noise": ("", "truth.noise.reading: missing"),
}


@pytest.mark.parametrize("slip", SLIPS)
def test_invalid_study_raises(tmp_path, slip):
    more, message = SLIPS[slip]
    runs = arm("") if slip == "no noise" else arm()
    model = '[model]\nassume = "all"\nterms = ["K_F", "K_I"]\n'
    with pytest.raises(CampaignError) as caught:
        read_study(described(tmp_path, model, more, runs))
    assert any(message in line for line in caught.value.problems), caught.value.problems


def test_linear_engine_raises_for_readings(tmp_path):
    described(tmp_path, *STUDIES["arm, noise stated"])
    with raises("method-not-applicable", '`engine="linear"`'):
        study(tmp_path, engine="linear")
