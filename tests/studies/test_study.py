"""Studies: what they find of the paper's plan, and that it does not matter who does the work."""

import json
import math
import os
import signal
from dataclasses import replace
from importlib.resources import files

import numpy as np
import polars as pl
import pytest
from clusters import start_dask_cluster
from raising import raises
from scipy import stats

from counterspin import workers
from counterspin.calibration.calibrate import calibrate
from counterspin.campaign.description import read_campaign
from counterspin.cli import main
from counterspin.errors import CampaignError, CounterspinError, NotIdentifiableError
from counterspin.inference.joint.estimation import estimate
from counterspin.physics.terms import term
from counterspin.reports.blocks import Heading
from counterspin.simulation.simulate import simulate
from counterspin.studies import batch_runner, full_simulation
from counterspin.studies.batch_runner import StudyEngine
from counterspin.studies.description import read_study
from counterspin.studies.draws import StudyTruth, random_stream
from counterspin.studies.engine_selection import choose_engine, list_analyses, prepare_study
from counterspin.studies.folder import StudyFolder
from counterspin.studies.page import study_blocks
from counterspin.studies.result import StudyResult
from counterspin.studies.simulation_setup import make_setup
from counterspin.studies.study import study
from counterspin.workers import Workers

FULL = bool(os.environ.get("COUNTERSPIN_FULL"))

PAPER = (files("counterspin.reproduction") / "paper.toml").read_text(encoding="utf-8")

VARYING = """
[study]
trials = 6000
seed = 3
[study.vary]
"Qx.K_II" = { normal = "2e-5 ± 1e-6 g/g^2" }
spindle.drift = { uniform = ["-5e-7 1/s", "5e-7 1/s"], per = "run" }
spindle.ripple.ratio = { uniform = ["0 ppm", "500 ppm"], per = "run" }
spindle.ripple.phase = { uniform = ["0 deg", "360 deg"], per = "run" }
centrifuge.radius = { normal = "2.5 ± 1e-5 m" }
[study.analyses.exact]
method = "two-stage"
[study.analyses.residuals]
method = "two-stage"
sigma = "residuals"
"""

#: A plan whose whole records take milliseconds.
SHORT = PAPER.replace("revolutions = 100", "revolutions = 12").replace('"50 Hz"', '"8 Hz"')


def write(folder, text):
    folder.mkdir(exist_ok=True)
    (folder / "campaign.toml").write_text(text, encoding="utf-8")
    return folder


@pytest.fixture
def paper(tmp_path):
    return write(tmp_path / "paper", PAPER)


def coefficient(result, analysis, name):
    return result.analyses[analysis].coefficients[name]


# What it finds


def test_paper_plan_is_unbiased_and_as_printed_method_is_half(paper):
    n = 10_000_000 if FULL else 200_000
    result = study(paper, trials=n)
    exact = coefficient(result, "two-stage", "Qx.K_II")
    # K_III and the ripple of Table 2 add 4e-11, which the method does not know.
    assert abs(exact.bias) < 4e-11 + 4.0 * exact.se_bias
    assert exact.sd == pytest.approx(5.312e-9, rel=5.0 / np.sqrt(2 * n) + 1e-3)  # physics.md 6
    assert exact.u == pytest.approx(5.312e-9, rel=1e-3)
    assert exact.covered[1] == pytest.approx(0.95, abs=4.0 * np.sqrt(0.95 * 0.05 / n) + 2e-4)
    printed = coefficient(result, "as-printed", "Qx.K_II")
    assert printed.covered == (0.0, 0.0, 0.0)
    assert 1.0 + printed.bias / printed.truth == pytest.approx(0.5, rel=1e-3)
    assert printed.sd == pytest.approx(3.223e-9, rel=5.0 / np.sqrt(2 * n) + 1e-3)
    joint = coefficient(result, "joint", "Qx.K_II")
    assert joint.covered[1] == pytest.approx(0.95, abs=4.0 * np.sqrt(0.95 * 0.05 / n) + 1e-4)
    good = {name: analyse.trustworthy for name, analyse in result.analyses.items()}
    assert good == {"joint": True, "two-stage": True, "as-printed": False}
    assert result.verdict[0].startswith("joint: no fault found, and the smallest errors")
    assert "0.5 times the true value" in result.verdict[-1]
    assert "K_II of Qx is unbiased" in result.verdict[0]
    # The answer comes first, and all that varied last.
    headings = [block.text for block in study_blocks(result) if isinstance(block, Heading)]
    assert (headings[1], headings[-1]) == ("Verdict", "Varied quantities")
    first = next(iter(result.analyses))
    assert coefficient(result, first, "Qx.K_II").efficiency == pytest.approx(1.0, abs=0.02)


# Each shortcut against the slower one


def setup_and_truth(description):
    campaign = description.campaign
    return make_setup(campaign), StudyTruth.from_campaign(campaign, description.varied_quantities)


def engines(folder, *names):
    description = read_study(folder)
    setup, truth = setup_and_truth(description)
    analyses = list_analyses(description)
    return truth, [
        [choose_engine(setup, truth, analyse, name).engine for analyse in analyses]
        for name in names
    ]


def test_linear_trials_match_full_records(tmp_path):
    """Compare noise-free trials that the engine did not use for its own comparison."""
    analyses = VARYING[: VARYING.index("[study.analyses")] + (
        '[study.analyses.exact]\nmethod = "two-stage"\n'
        '[study.analyses.printed]\nmethod = "two-stage"\nmodel = "as-printed"\n'
    )
    truth, analysis_engines = engines(write(tmp_path / "a", SHORT + analyses), "linear", "full")
    draws = replace(truth.draw(random_stream(3, 0, 0), 12), white_noise=np.zeros(1))
    for fast, slow in zip(*analysis_engines, strict=True):
        a, b = (one.run_trials(draws, random_stream(3, 0, 1)) for one in (fast, slow))
        # K_II is the first unknown of each; what is printed beside it is not reported.
        assert np.abs((a.estimate - b.estimate) / b.u)[0].max() < 0.1
        assert np.abs(a.u / b.u - 1.0)[0].max() < 2e-3


def with_observable(text, observable, unit, noise):
    """Return a campaign whose records hold velocity or specific force."""
    column = f'{observable} = {{ column = "output", unit = "{unit}" }}'
    return (
        text.replace('displacement = { column = "east_m", unit = "m" }', column)
        .replace('displacement = "0.01 m"', f'{observable} = "{noise}"')
        .replace('angle = "1e-6 rad"', 'angle = "1e-9 rad"')
    )


def chi_square_bounds(n):
    """Return the bounds of a sum of n squares that one in a thousand leaves."""
    return stats.chi2.ppf([5e-4, 1.0 - 5e-4], n)


def test_velocity_records_have_coverage(tmp_path):
    text = with_observable(SHORT.replace('assume = "all" ', "# "), "velocity", "m/s", "0.01 m/s")
    folder = write(tmp_path / "a", text)
    n, few = 4000, 8
    result = study(folder, trials=n)
    assert {name: analyse.engine for name, analyse in result.analyses.items()} == {
        "joint": "linear"
    }
    whole = study(folder, trials=few, engine="full")
    low, high = chi_square_bounds(few)
    for name in ("Qx.K_II", "Qx.K_III"):
        c, other = (coefficient(one, "joint", name) for one in (result, whole))
        assert c.covered[1] == pytest.approx(0.95, abs=4.0 * np.sqrt(0.95 * 0.05 / n))
        assert c.sd == pytest.approx(c.u, rel=5.0 / np.sqrt(2 * n))
        # Beyond first order, a tenth of u at most.
        assert abs(c.bias) < 4.0 * c.se_bias + 0.1 * c.u
        assert other.u == pytest.approx(c.u, rel=1e-3)
        assert low < few * other.mse / c.u**2 < high


@pytest.mark.parametrize(("unit", "noise"), [("m/s^2", "0.01 m/s^2"), ("g", "1 mg")])
def test_specific_force_records_have_coverage(tmp_path, unit, noise):
    """Whole records scatter as u states: the sum of squares of a few trials is a chi-square."""
    text = with_observable(SHORT.replace('assume = "all" ', "# "), "specific_force", unit, noise)
    few = 8
    result = study(write(tmp_path / "a", text), trials=few)
    low, high = chi_square_bounds(few)
    for name in ("Qx.K_II", "Qx.K_III"):
        c = coefficient(result, "joint", name)
        assert low < few * c.mse / c.u**2 < high


def test_two_stage_method_requires_displacement(tmp_path):
    text = with_observable(SHORT, "velocity", "m/s", "0.01 m/s")
    text += '[study.analyses.old]\nmethod = "two-stage"\n'
    with raises("method-not-applicable"):
        read_study(write(tmp_path / "a", text))


@pytest.mark.slow
def test_sufficient_statistics_have_distribution_of_full_records(tmp_path):
    joint = '[study.analyses.joint]\nmethod = "joint"\n'
    varying = '[study.vary]\n"platform.tilt.north" = { normal = "0 ± 3 arcsec", per = "run" }\n'
    analyses = VARYING[VARYING.index("[study.analyses.exact]") :]
    folder = write(tmp_path / "a", SHORT + varying + analyses + joint)
    n = 2000 if FULL else 25
    truth, analysis_engines = engines(folder, "auto", "full")
    few, many = truth.draw(random_stream(3, 0, 0), n), truth.draw(random_stream(4, 0, 0), 20 * n)
    for fast, slow in zip(*analysis_engines, strict=True):
        a, b = (
            fast.run_trials(many, random_stream(4, 0, 1)),
            slow.run_trials(few, random_stream(3, 0, 1)),
        )
        for row in range(b.estimate.shape[0]):
            # Each is one in a thousand, and there are a dozen.
            assert stats.ks_2samp(a.estimate[row], b.estimate[row]).pvalue > 1e-3
            sd = a.estimate[row].std()
            assert abs(a.estimate[row].mean() - b.estimate[row].mean()) < 4.0 * sd / np.sqrt(n)
            assert b.estimate[row].std() == pytest.approx(sd, rel=4.0 / np.sqrt(2 * n))
            off = abs(np.mean(b.u[row]) - np.mean(a.u[row]))
            assert off <= 4.0 * a.u[row].std() / np.sqrt(n) + 1e-3 * np.mean(a.u[row])


#: So far from what is stated that the square of its deviation shows in K_II.
_FAR = '[study.vary]\ncentrifuge.radius = { normal = "2.5 ± 0.1 m" }\n'


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (("[truth.noise]", '[truth.noise]\nquantisation = "0.01 m"'), "quantisation"),
        (('angle = "1e-6 rad"', 'angle = "1e-3 rad"'), "noise of the recorded angle"),
        (("[truth.noise]", '[truth.noise]\nacceleration = "1e-5 g/Hz^0.5"'), "not white"),
        (("[truth.noise]", _FAR + "[truth.noise]"), "not linear"),
    ],
)
def test_linear_engine_raises_outside_validity(tmp_path, change, reason):
    folder = write(tmp_path / "a", change[1].join(PAPER.rsplit(change[0], 1)))
    description = read_study(folder)
    setup, truth = setup_and_truth(description)
    two_stage = next(
        analyse for analyse in list_analyses(description) if analyse.name == "two-stage"
    )
    with pytest.raises(NotIdentifiableError, match=reason):
        choose_engine(setup, truth, two_stage, "linear")
    assert choose_engine(setup, truth, two_stage, "auto").cost_class == "full"


@pytest.mark.parametrize("engine", ["auto", "full"])
def test_u_includes_gravity_and_radius_like_calibration(tmp_path, engine):
    analysis = '[study.analyses.exact]\nmethod = "two-stage"\n'
    # A prior of K_F would hold it against what another gravity makes of b2.
    sure = SHORT.replace('bias = "0.004 ± 2e-6 g"', "")
    sure += '[truth.site]\ngravity = "9.80 m/s^2"\n[truth.centrifuge]\nradius = "2.50 m"\n'
    u_values = []
    for name, text in (("sure", sure), ("unsure", with_uncertain_inputs(sure))):
        truth, ((analysis_engine,),) = engines(write(tmp_path / name, text + analysis), engine)
        u_values.append(
            analysis_engine.run_trials(
                truth.draw(random_stream(3, 0, 0), 1), random_stream(3, 0, 1)
            )
        )
    without, with_inputs = u_values
    assert np.array_equal(with_inputs.estimate, without.estimate)
    # b2 is K_II R^2 w^4/(4 g) + K_F g/2, with 1e-3 of R and 5e-4 of g.
    # The linear engine states u at the mean true values, whole records that of their estimate.
    k_ii, k_f = np.abs(analysis_engine.estimate if engine == "auto" else with_inputs.estimate[:, 0])
    expected = [np.hypot(2e-3, 5e-4) * k_ii, 5e-4 * k_f]
    # Of a small share of u^2, by a forward difference of 1e-6.
    assert np.sqrt(with_inputs.u**2 - without.u**2)[:, 0] == pytest.approx(expected, rel=3e-6)


def test_engines_combine_bias_prior_with_wrong_gravity(tmp_path):
    analysis = '[study.analyses.exact]\nmethod = "two-stage"\n'
    results = []
    for engine in ("auto", "full"):
        folder = write(tmp_path / engine, with_uncertain_inputs(SHORT) + analysis)
        truth, ((analysis_engine,),) = engines(folder, engine)
        results.append(
            analysis_engine.run_trials(
                truth.draw(random_stream(3, 0, 0), 1), random_stream(3, 0, 1)
            )
        )
    fast, whole = results
    off = np.abs(fast.u / whole.u - 1.0)
    # The two have other noise, and what inputs do goes with the estimates.
    noise = np.hypot(fast.u, whole.u) / np.abs(whole.estimate)
    assert (off < 4.0 * noise).all()
    assert noise[1] < 1e-3  # of K_F, which gravity moves most


def with_uncertain_inputs(text):
    text = text.replace('"9.8 m/s^2"', '"9.8 ± 4.9e-3 m/s^2"')
    return text.replace('"2.5 m"', '"2.5 ± 2.5e-3 m"')


def two_stage_part(folder, noise):
    """Return the setup, the truth and the engine of the two-stage analysis of a short plan."""
    given = '[noise]\ndisplacement = "0.01 m"'
    assert given in SHORT
    analysis = '[study.analyses.two-stage]\nmethod = "two-stage"\n'
    description = read_study(write(folder, SHORT.replace(given, noise) + analysis))
    setup, truth = setup_and_truth(description)
    (analysis,) = list_analyses(description)
    return setup, truth, choose_engine(setup, truth, analysis, "auto")


@pytest.mark.parametrize(
    ("noise", "reason"),
    [
        ('acceleration = "1e-5 g/Hz^0.5"', "the noise assumed in the analysis is not white"),
        ('acceleration = "estimate"', "the noise of the accelerometer must be estimated"),
        ('timing = "1e-3 s"', "time-stamp jitter assumed in the analysis"),
    ],
)
def test_coloured_noise_requires_full_records(tmp_path, noise, reason):
    _, truth, part = two_stage_part(tmp_path / "a", f'[noise]\ndisplacement = "0.01 m"\n{noise}')
    assert part.cost_class == "full"
    assert reason in part.description
    draws = truth.draw(random_stream(3, 0, 0), 2)
    results = part.engine.run_trials(draws, random_stream(3, 0, 1))
    assert np.all(np.abs(results.estimate[0] - draws.mean("Qx", "K_II")) < 5.0 * results.u[0])
    plain = two_stage_part(tmp_path / "b", '[noise]\ndisplacement = "0.01 m"')[2].engine
    ratio = results.u[1] / plain.run_trials(draws, random_stream(3, 0, 1)).u[1]
    if "timing" in noise:
        # The angle corrects the time stamps: only the encoder's noise is left.
        np.testing.assert_allclose(ratio, 1.0, atol=1e-2)
    else:
        assert np.all(ratio > 1.01)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["two-stage", "joint"])
def test_time_jitter_shifts_angle_and_output_together(tmp_path, method):
    """By 1 ms, at which the output alone would have 1.6 times its noise at the fastest rate."""
    timing, trials = 'timing = "1e-3 s"', 40
    text = SHORT
    for section in ("[noise]", "[truth.noise]"):
        text = text.replace(section, f"{section}\n{timing}")
    assert text.count(timing) == 2
    analysis = f'[study.analyses.{method}]\nmethod = "{method}"\n'
    description = read_study(write(tmp_path / "a", text + analysis))
    setup, truth = setup_and_truth(description)
    (analysis,) = list_analyses(description)
    part = choose_engine(setup, truth, analysis, "full")
    draws = truth.draw(random_stream(3, 0, 0), trials)
    results = part.engine.run_trials(draws, random_stream(3, 0, 1))
    place = 0 if method == "two-stage" else 1
    z = (results.estimate[place] - draws.mean("Qx", "K_II")) / results.u[place]
    assert math.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=4.0 / math.sqrt(2 * trials))


def test_u_of_study_matches_joint_fit(tmp_path, monkeypatch):
    """The uncertainty includes noise that the records do not reveal."""
    unstated = SHORT.replace('[noise]\ndisplacement = "0.01 m"', "")
    text = unstated + '[study.analyses.joint]\nmethod = "joint"\n'
    truth, ((analysis_engine,),) = engines(write(tmp_path / "a", text), "auto")
    estimates = []

    def remembered(*arguments):
        estimates.append(estimate(*arguments))
        return estimates[-1]

    monkeypatch.setattr(full_simulation, "estimate", remembered)
    results = analysis_engine.run_trials(
        truth.draw(random_stream(3, 0, 0), 1), random_stream(3, 0, 1)
    )
    (fit,) = (estimate.fit for estimate in estimates)
    assert fit.undetected_walks
    assert results.u[:, 0] == pytest.approx(fit.solution.u[list(analysis_engine.rows)], rel=1e-12)


def test_noise_levels_vary(tmp_path):
    levels = """[study.vary]
noise.angle = { uniform = ["1 urad", "3 urad"] }
noise.quantisation = { fixed = "30 mm" }
noise.acceleration = { fixed = "1e-5 g/Hz^0.5" }
noise.timing = { normal = "1 ± 0.1 us" }
[study.analyses.two-stage]
method = "two-stage"
sigma = "residuals"
"""
    description = read_study(write(tmp_path / "a", SHORT + levels))
    setup, truth = setup_and_truth(description)
    (analysis,) = list_analyses(description)
    part = choose_engine(setup, truth, analysis, "auto")
    assert (
        "noise.angle, noise.quantisation, noise.acceleration, noise.timing varies"
        in part.description
    )
    draws = truth.draw(random_stream(3, 0, 0), 40)
    assert draws.noise_levels["noise.acceleration"] == pytest.approx(9.8e-5)
    assert np.all(
        (draws.noise_levels["noise.angle"] >= 1e-6) & (draws.noise_levels["noise.angle"] <= 3e-6)
    )
    results = part.engine.run_trials(draws, random_stream(3, 0, 1))
    quiet = replace(draws, noise_levels={})
    still = part.engine.run_trials(quiet, random_stream(3, 0, 1))
    # Steps of 30 mm add 30/sqrt(12) = 8.7 mm to 10 mm of noise: sigma grows by sqrt(1 + 0.75).
    assert np.median(results.u[0] / still.u[0]) == pytest.approx(np.sqrt(1.75), rel=0.15)


def joint_part(folder, text):
    """Return the truth and the engine of the joint analysis of a short plan."""
    description = read_study(write(folder, text + '[study.analyses.joint]\nmethod = "joint"\n'))
    (analysis,) = list_analyses(description)
    setup, truth = setup_and_truth(description)
    return truth, choose_engine(setup, truth, analysis, "auto")


TILTED = '[model.priors]\n"platform.tilt.north" = "0 ± 1 deg"\n[[runs]]'


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        # Ripple makes K_II and K_III distinct, and u three times as large or small.
        (("[[runs]]", VARYING[: VARYING.index("[study.analyses")] + "[[runs]]"), "rotation varies"),
        # The fit attributes part of the angle's residuals to the time stamps.
        (("[noise]", '[noise]\ntiming = "1e-3 s"'), "u from full records differs"),
        # The cosine of such a tilt is not linear, and moves K_I and K_F by many times their noise.
        (("[[runs]]", TILTED), "the estimates from full records differ by"),
    ],
)
def test_nonlinear_joint_fit_requires_full_records(tmp_path, change, reason):
    text = change[1].join(SHORT.split(change[0], 1))
    if "differ by" in reason:
        text = text.replace('"0.01 m"', '"1e-4 m"').replace('"1e-6 rad"', '"1e-9 rad"')
        text = text.replace('assume = "all" ', "# ")
    _, part = joint_part(tmp_path / "a", text)
    assert part.cost_class == "full"
    assert reason in part.description


@pytest.mark.parametrize("assumed", ['assume = "all" ', "# "])
def test_constant_of_linear_trials_is_mean_truth(tmp_path, assumed):
    """Without noise the estimate of mean true values that equal their priors has no error."""
    text = SHORT.replace('assume = "all" ', assumed).replace('K_IP = "6e-6', 'K_IP = "0')
    truth, part = joint_part(tmp_path / "a", text)
    assert part.cost_class == "linear"
    mean = [truth.mean(c.owner, c.symbol) for c in part.coefficients]
    assert np.abs((part.engine.mean_estimate - mean) / part.engine.u).max() < 1e-4


# Who does the work


@pytest.fixture(scope="module")
def varying(tmp_path_factory):
    return write(tmp_path_factory.mktemp("studies") / "varying", SHORT + VARYING)


@pytest.fixture(scope="module")
def engine(varying):
    return prepare_study(read_study(varying), 3)


def test_considered_self_heating_has_coverage(tmp_path):
    """Both methods include its uncertainty, with full records and sufficient statistics."""
    text = SHORT.replace('hold = ["K_IP"]', 'hold = ["K_IP", "K_F.heating"]')
    text = text.replace("[[runs]]", '[model.priors]\n"K_F.heating" = "0 ± 2e-6 g/g^2"\n[[runs]]', 1)
    varying = '\n[study.vary]\n"Qx.K_F.heating" = { normal = "0 ± 2e-6 g/g^2" }\n'
    result = study(write(tmp_path / "heated", text + varying), trials=50)
    for analysis in ("two-stage", "joint"):
        k_ii = coefficient(result, analysis, "Qx.K_II")
        # u is all but that of the heating, twice: 50 trials know a scatter to 10 %.
        assert k_ii.u == pytest.approx(4e-6, rel=0.05)
        assert k_ii.sd / k_ii.u == pytest.approx(1.0, abs=0.4)


#: The same without anything that is assumed to be perfect.
UNSTATED = SHORT.replace('assume = "all" ', "# ") + '\n[study.analyses.joint]\nmethod = "joint"\n'


@pytest.mark.slow
def test_default_priors_have_coverage(tmp_path):
    """Each trial draws all default priors, and u equals that of calibrate."""
    n = 200_000 if FULL else 20_000
    folder = write(tmp_path / "unstated", UNSTATED)
    result = study(folder, trials=n)
    assert result.analyses["joint"].engine == "linear"
    coefficient_results = {
        name: coefficient(result, "joint", f"Qx.{name}") for name in ("K_II", "K_III")
    }
    for c in coefficient_results.values():
        assert c.covered[1] == pytest.approx(0.95, abs=4.0 * np.sqrt(0.95 * 0.05 / n))
        assert c.sd == pytest.approx(c.u, rel=5.0 / np.sqrt(2 * n))
        assert abs(c.bias) < 4.0 * c.se_bias
    simulate(read_study(folder).campaign, tmp_path / "made")
    calibrated = calibrate(tmp_path / "made")
    assert calibrated.coefficient("Qx.K_II").u == pytest.approx(
        coefficient_results["K_II"].u, rel=1e-4
    )
    # Whole records, without any shortcut, scatter alike: 20 trials know that to 16 %.
    whole = coefficient(study(folder, trials=20, engine="full"), "joint", "Qx.K_II")
    assert whole.u == pytest.approx(coefficient_results["K_II"].u, rel=1e-4)
    assert whole.sd / whole.u == pytest.approx(1.0, abs=0.64)


def test_only_priors_without_true_value_are_drawn(tmp_path):
    def drawn(name, text):
        return {
            (v.owner, v.symbol): v
            for v in read_study(write(tmp_path / name, text)).varied_quantities
        }

    assert drawn("assumed", SHORT) == {}
    varying = drawn("unstated", UNSTATED)
    assert {"K_OO", "K_OQ", "K_F.trend"} <= {symbol for owner, symbol in varying if owner == "Qx"}
    k_oo = varying["Qx", "K_OO"]
    assert (k_oo.distribution, k_oo.first_parameter, k_oo.second_parameter) == (
        "normal",
        0.0,
        term("K_OO").typical,
    )
    radius = varying["", "centrifuge.radius"]
    assert (radius.first_parameter, radius.second_parameter) == (
        2.5,
        term("centrifuge.radius").typical,
    )
    assert varying["", "platform.tilt.north"].is_per_run
    gravity = varying["", "site.gravity"]
    assert (gravity.first_parameter, gravity.second_parameter) == (
        9.8,
        term("site.gravity").typical,
    )
    delay, clock = varying["", "records.timing_offset"], varying["", "records.clock"]
    assert (
        delay.first_parameter,
        delay.second_parameter,
        clock.first_parameter,
        clock.second_parameter,
    ) == (0.0, 1e-5, 0.0, 2e-5)
    # Asked for, or of a value that is true.
    assert not {"K_F", "K_I", "K_II", "K_III", "K_IP"} & {symbol for _, symbol in varying}
    stated = UNSTATED.replace('K_IP = "6e-6 g/g^2"', 'K_IP = "6e-6 g/g^2"\nK_OO = "0 g/g^2"')
    known = '[model.priors]\nK_PP = "3e-6 ± 1e-6 g/g^2"\n[model.typical]\nK_IO = "1e-7 g/g^2"\n'
    stated = stated.replace("[[runs]]", f"{known}[[runs]]", 1)
    stated = stated.replace('"2.5 m"', '"2.5 ± 2e-6 m"')
    stated += '[truth.site]\nlatitude = "45 deg"\n[truth.platform]\ntilt.north = "0 arcsec"\n'
    stated += '[study.vary]\nK_PO = { uniform = ["0 g/g^2", "1e-6 g/g^2"] }\n'
    changed = drawn("stated", stated)
    true = {"K_OO", "site.latitude", "platform.tilt.north"}
    assert {symbol for _, symbol in set(varying) - set(changed)} == true
    assert changed["Qx", "K_PO"].distribution == "uniform"
    assert changed["Qx", "K_IO"].second_parameter == 1e-7
    k_pp, radius = changed["Qx", "K_PP"], changed["", "centrifuge.radius"]
    assert (k_pp.first_parameter, k_pp.second_parameter, radius.second_parameter) == (
        3e-6,
        1e-6,
        2e-6,
    )


def test_analysis_may_assume_and_hold_different_terms(tmp_path):
    text = SHORT + (
        '\n[study.analyses.perfect]\nmethod = "joint"\nterms = ["K_F", "K_II"]\nassume = ["K_OO"]\n'
        '[study.analyses.held]\nmethod = "joint"\nconsidered = ["K_I"]\n'
        'terms = ["K_F", "K_II"]\nassume = "all"\n'
    )
    perfect, held = (a.campaign.model for a in read_study(write(tmp_path / "a", text)).analyses)
    assert (perfect.terms, perfect.assume, perfect.considered) == (("K_F", "K_II"), ("K_OO",), ())
    assert (held.assume, held.considered) == (("all",), ("K_I",))


def test_wandering_bias_has_coverage_in_full_records(tmp_path):
    text = SHORT.replace("[noise]\n", '[noise]\nflicker = "100 ug"\n').replace(
        "[truth.noise]\n", '[truth.noise]\nflicker = "100 ug"\n'
    )
    # Known beforehand, the bias would say all that the wander leaves open.
    text = text.replace('bias = "0.004 ± 2e-6 g"', "")
    text += '\n[study.analyses.joint]\nmethod = "joint"\n'
    result = study(write(tmp_path / "wandering", text), trials=30)
    k_f = coefficient(result, "joint", "Qx.K_F")
    assert k_f.u > 5e-5
    # The scatter of 30 is known to 13 %.
    assert k_f.sd / k_f.u == pytest.approx(1.0, abs=0.5)


@pytest.mark.slow
def test_result_does_not_depend_on_worker_count(varying):
    assert study(varying) == study(varying, workers=Workers(2))


@pytest.mark.parametrize("size", [1, 2, 64])
def test_result_does_not_depend_on_task_size(engine, size):
    whole, parts = (batch_runner.BatchResults(engine, 5000) for _ in range(2))
    batch_runner.run_batches(engine, whole)
    batch_runner.run_batches(engine, parts, batches_per_task=size)
    assert np.array_equal(whole.sums, parts.sums)


def test_trial_does_not_depend_on_trial_count(varying, tmp_path):
    for n, name in ((2500, "few"), (5000, "many")):
        study(varying, trials=n, output=StudyFolder(tmp_path / name, keep_trials=True))
    few, many = (pl.read_parquet(tmp_path / name / "trials.parquet") for name in ("few", "many"))
    assert few.equals(many.head(2500))
    assert many["trial"].to_list() == list(range(5000))
    assert "exact.Qx.K_II.estimate" in many.columns


@pytest.mark.slow
def test_dask_workers_return_same_result(varying):
    with start_dask_cluster() as cluster:
        result = study(varying, trials=50_000, workers=Workers(cluster=cluster.scheduler_address))
    assert result == study(varying, trials=50_000)


def test_unreachable_cluster_raises(varying, monkeypatch):
    monkeypatch.setattr(workers, "_SCHEDULER_TIMEOUT", 0.5)
    pytest.importorskip("distributed", reason="Dask is not installed ([cluster])")
    with pytest.raises(CounterspinError, match="no Dask scheduler responds at this address"):
        study(varying, workers=Workers(cluster="tcp://127.0.0.1:9"))


@pytest.mark.slow
def test_killed_worker_loses_and_repeats_no_trial(engine):
    whole, other = (batch_runner.BatchResults(engine, 100_000) for _ in range(2))
    batch_runner.run_batches(engine, whole)
    killed = []

    def kill_one(done, total):
        if done and not killed:
            import multiprocessing

            worker = multiprocessing.active_children()[0]
            os.kill(worker.pid, signal.SIGKILL)
            killed.append(worker.pid)

    batch_runner.run_batches(
        engine, other, workers=Workers(2), progress=kill_one, batches_per_task=2
    )
    assert killed
    assert other.trials_done == 100_000
    assert np.array_equal(whole.sums, other.sums)


def test_interrupted_study_is_valid_and_can_resume(varying, tmp_path):
    out = tmp_path / "out"

    def stop(done, total):
        if done >= 4000:
            raise KeyboardInterrupt

    part = study(varying, trials=120_000, output=StudyFolder(out, keep_trials=True), progress=stop)
    assert not part.complete
    assert 4000 <= part.trials < 120_000
    assert StudyResult.read(out / "study.json") == part
    assert len(pl.read_parquet(out / "trials.parquet")) == part.trials
    done = study(varying, trials=120_000, output=StudyFolder(out, keep_trials=True, resume=True))
    assert done == study(varying, trials=120_000)
    assert len(pl.read_parquet(out / "trials.parquet")) == 120_000
    assert sorted(path.name for path in out.iterdir()) == ["study.json", "trials.parquet"]


def test_resuming_different_study_raises(varying, paper, tmp_path):
    out = tmp_path / "out"

    def stop(done, total):
        if done:
            raise KeyboardInterrupt

    study(varying, trials=120_000, output=out, progress=stop)
    with pytest.raises(CounterspinError, match="with a different"):
        study(paper, trials=120_000, output=StudyFolder(out, resume=True))
    with pytest.raises(CounterspinError, match="contains no study"):
        study(varying, output=StudyFolder(tmp_path / "new", resume=True))


def test_engine_survives_pickling(engine):
    import pickle

    travelled = pickle.loads(pickle.dumps(engine))
    assert isinstance(travelled, StudyEngine)
    assert np.array_equal(travelled.run_batch(1, 50)[0], engine.run_batch(1, 50)[0])


# The description


def test_all_errors_are_reported_at_once(tmp_path):
    text = (
        PAPER
        + """
[study]
trials = 1
[study.vary]
K_IX = { fixed = "1 g" }
K_II = { normal = "1e-5 g/g^2" }
K_III = { uniform = ["1e-5 g/g^3", "1e-6 g/g^3"] }
"centrifuge.radius" = { normal = "2 ± 1 s" }
"noise.displacement" = { fixed = "1 mm", uniform = ["1 mm", "2 mm"] }
[study.analyses.one]
method = "joint"
weighted = true
[study.analyses.two]
method = "two-stage"
terms = ["K_XX"]
"""
    )
    folder = write(tmp_path / "a", text.replace("trials = 1\n", ""))
    with pytest.raises(CampaignError) as caught:
        read_study(folder)
    for words in (
        "study.vary.K_IX: cannot be varied in a study",
        'study.vary.K_II: write a normal distribution as "MEAN ± SD UNIT"',
        "study.vary.K_III: the lowest value must be below the highest",
        "study.vary.\"centrifuge.radius\": 's' is not a unit of",
        'study.vary."noise.displacement": give one of normal, uniform and fixed',
        "study.analyses.one.weighted: applies only to the two-stage method",
        'study.analyses.two: model.terms[0]: unknown term "K_XX"',
    ):
        assert words in str(caught.value)
    write(folder, text)
    with pytest.raises(CampaignError, match=r"study\.trials"):
        read_study(folder)


def test_study_file_names_campaign(paper, tmp_path):
    file = tmp_path / "study.toml"
    file.write_text('schema = 1\ncampaign = "paper"\n[study]\ntrials = 50\n', encoding="utf-8")
    assert read_study(file).trials == 50
    assert read_study(file).campaign.title == "The paper's plan"
    file.write_text('schema = true\ncampaign = "paper"\nstudies = 1\n', encoding="utf-8")
    with pytest.raises(CampaignError, match="did you mean"):
        read_study(file)


def test_chosen_terms_replace_terms_of_model(tmp_path):
    text = PAPER + '[study.analyses.few]\nmethod = "joint"\nterms = ["K_F", "K_II"]\n'
    (analyse,) = read_study(write(tmp_path / "a", text)).analyses
    assert analyse.campaign.model.terms == ("K_F", "K_II")
    assert analyse.campaign.model.considered == ()


def test_campaign_without_truth_raises(tmp_path):
    text = PAPER[: PAPER.index("# The remaining sections are only for `counterspin simulate`.")]
    with pytest.raises(CampaignError, match=r"truth: missing; a study requires"):
        read_study(write(tmp_path / "a", text))


def test_unsupported_records_raise(tmp_path):
    text = PAPER.replace('angle = { column = "angle_rad", unit = "rad" }', "")
    with raises("method-not-applicable"):
        study(write(tmp_path / "angle", text))


def test_joint_fit_without_angle_uses_full_records(tmp_path):
    text = SHORT.replace('angle = { column = "angle_rad", unit = "rad" }', "")
    text += '[study.analyses.joint]\nmethod = "joint"\n'
    (analyse,) = study(write(tmp_path / "angle", text), trials=4).analyses.values()
    assert (
        analyse.engine == "full records (no angle is recorded, so the rotation must be estimated)"
    )


# The command


def test_command_prints_verdict_and_writes_files(varying, tmp_path, capsys):
    out = tmp_path / "out"
    status = main(["study", str(varying), "--trials", "3000", "-o", str(out)])
    shown = capsys.readouterr()
    assert status == 0, shown.err
    assert "linear" in shown.out
    assert "Verdict" in shown.out
    assert {path.name for path in out.iterdir()} == {
        "study.json",
        "z.svg",
        "coverage.svg",
        "bias-spindle.drift.svg",
        "bias-spindle.ripple.ratio.svg",
    }
    kept = json.loads((out / "study.json").read_text())
    assert kept["trials"] == 3000
    assert set(kept["analyses"]) == {"exact", "residuals"}


@pytest.mark.slow
def test_study_of_campaign_in_memory_matches_file(tmp_path):
    (tmp_path / "campaign.toml").write_text(PAPER, encoding="utf-8")
    campaign = read_campaign(tmp_path)
    of_file, in_memory = (study(where, trials=50, seed=2) for where in (tmp_path, campaign))
    assert in_memory.analyses == of_file.analyses
    changed = campaign.change({"study": {"vary": {"Qx.K_II": {"fixed": "5e-5 g/g^2"}}}})
    assert len(study(changed, trials=50, seed=2).varying) == 1
    with raises("unknown-key", "campaign.toml", "study.trails"):
        study(campaign.change({"study": {"trails": 5}}))
    with pytest.raises(CounterspinError, match="its description is unknown"):
        study(replace(campaign, title="other"))
