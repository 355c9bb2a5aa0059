"""`calibrate --method two-stage` on simulated folders: results, texts and warnings."""

import json
import math
import os
import re
from dataclasses import fields

import polars as pl
import pytest
from campaigns import SMALL, remove_table, replace_parts, write_and_read_campaign, write_description
from raising import raises
from scipy.special import chdtrc, stdtrit

from counterspin.calibration.calibrate import calibrate
from counterspin.calibration.checks import residuals
from counterspin.calibration.joint_problem import JointProblem
from counterspin.calibration.observed_runs import observe_runs
from counterspin.calibration.options import TwoStageOptions, command_arguments
from counterspin.calibration.result import Result
from counterspin.calibration.two_stage.method import calibrate_accelerometer, two_stage_view
from counterspin.campaign.description import read_campaign
from counterspin.cli import main
from counterspin.errors import NotIdentifiableError
from counterspin.simulation.simulate import simulate

TRIALS = 200 if os.environ.get("COUNTERSPIN_FULL") else 5

K_II = {"Qx": 2.7e-5, "Qy": -3.2e-5}
PRIORS = (
    'scale_factor = "1.002 g/g"',
    'bias = "0.005 ± 2e-6 g"\nscale_factor = "1.002 ± 5e-6 g/g"',
)
MODEL = '[model]\nassume = "all"\n'


NO_ANGLE = ('angle = { column = "angle_rad", unit = "rad" }\n', "")


def extend_model(model):
    """Return the replacement that adds lines to [model]."""
    return (MODEL, f"{MODEL}{model}\n")


def make_records(folder, *pairs, text=SMALL):
    simulate(write_description(folder, replace_parts(text, *pairs)), folder / "made")
    return folder / "made"


def calibrate_records(folder, *pairs, text=SMALL, **options):
    return calibrate(
        make_records(folder, *pairs, text=text),
        method="two-stage",
        options=TwoStageOptions(**options),
    )


def qx(result):
    return result.accelerometers["Qx"]


# --- values and their uncertainty -----------------------------------------------------------------


def test_json_follows_contract(tmp_path, capsys):
    folder, file = make_records(tmp_path, PRIORS), tmp_path / "result.json"
    assert main(["calibrate", str(folder), "--method", "two-stage", "--json", str(file)]) == 0
    assert "K_II of Qx = " in capsys.readouterr().out
    document = json.loads(file.read_text(encoding="utf-8"))
    assert (document["schema"], document["method"], document["model"]) == (2, "two-stage", "exact")
    qx = document["accelerometers"]["Qx"]
    k_ii = qx["coefficients"]["K_II"]
    assert set(k_ii) == {
        *("value", "u", "u_noise", "u_stated", "u_unstated"),
        *("dof", "unit", "estimated"),
    }
    assert k_ii["u"] ** 2 == pytest.approx(
        k_ii["u_noise"] ** 2 + k_ii["u_stated"] ** 2 + k_ii["u_unstated"] ** 2, rel=1e-12
    )
    assert (k_ii["dof"], k_ii["unit"], k_ii["estimated"]) == (None, "g/g^2", True)
    for name, truth in K_II.items():
        c = document["accelerometers"][name]["coefficients"]["K_II"]
        assert abs(c["value"] - truth) < 4 * c["u"]
    assert qx["correlation"]["terms"] == ["K_II", "K_F"]
    assert qx["correlation"]["matrix"][0][0] == pytest.approx(1.0, rel=1e-12)
    residual = qx["residual"]
    assert residual["unit"] == "m"
    assert residual["dof"] == 3 * 20 - 9
    assert residual["rms"] == pytest.approx(0.01, rel=0.4)
    assert residual["lack_of_fit_p"] == pytest.approx(chdtrc(51, residual["chi2"]), rel=1e-12)
    run = document["runs"]["middle"]
    assert run["rate"] == pytest.approx(math.pi, rel=1e-6)
    assert (run["rate_unit"], run["drift_unit"]) == ("rad/s", "1/s")
    assert run["drift"] == pytest.approx(1e-6, abs=5 * run["u_drift"])
    assert (run["samples"], run["rejected"]) == (801, 0)
    assert run["parabolas"]["Qx"]["sigma_from_residuals"] is False
    assert run["parabolas"]["Qx"]["strobes"] == 20
    assert set(document["provenance"]["inputs"]) == {
        *("campaign.toml", "slow.csv", "middle.csv", "fast.csv")
    }
    assert Result.read(file).accelerometers["Qx"].coefficients["K_II"].value == k_ii["value"]


def test_undetermined_coefficient_has_prior_or_no_value(tmp_path):
    known = qx(calibrate_records(tmp_path / "a", PRIORS)).coefficients
    assert list(known) == ["K_II", "K_F", "K_I", "K_III"]
    assert (known["K_I"].estimated, known["K_I"].value, known["K_I"].u) == (False, 1.002, 5e-6)
    assert (known["K_III"].estimated, known["K_III"].value, known["K_III"].u) == (False, None, None)
    assert known["K_F"].estimated
    unknown = qx(
        calibrate_records(tmp_path / "b", ('scale_factor = "1.002 g/g"\n', ""))
    ).coefficients
    assert (unknown["K_I"].estimated, unknown["K_I"].value, unknown["K_I"].u) == (False, None, None)


def test_bias_is_estimated_or_held(tmp_path):
    folder = make_records(tmp_path, PRIORS)
    free = qx(calibrate(folder, method="two-stage"))
    taken = qx(calibrate(folder, method="two-stage", options=TwoStageOptions(fit_bias=False)))
    assert free.coefficients["K_F"].estimated
    k_f = taken.coefficients["K_F"]
    assert (k_f.estimated, k_f.value, k_f.u) == (False, 0.005, 2e-6)
    # 2e-6 g of K_F equal 2e-6 g/g^2 (g/2)/(R^2 w^4/4g) of K_II, mostly of the fast run.
    assert taken.coefficients["K_II"].u_stated > 2e-8
    of_bias = [
        line.kind for a in (free, taken) for line in a.budget["K_II"] if line.source == "K_F"
    ]
    assert of_bias == ["stated", "held"]


def test_prior_of_k_ii_is_combined(tmp_path):
    prior = (
        'scale_factor = "1.002 g/g"',
        'scale_factor = "1.002 g/g"\nK_II = "2.8e-5 ± 2e-7 g/g^2"',
    )
    plain = qx(calibrate_records(tmp_path / "a")).coefficients["K_II"]
    c = qx(calibrate_records(tmp_path / "b", prior)).coefficients["K_II"]
    weight = plain.u**2 / (plain.u**2 + 2e-7**2)
    assert c.value == pytest.approx(plain.value + weight * (2.8e-5 - plain.value), rel=1e-9)
    assert c.u == pytest.approx(math.sqrt(weight) * 2e-7, rel=1e-6)
    assert c.u_stated == pytest.approx(weight * 2e-7, rel=1e-6)
    tight = replace_parts(prior[1], ("2e-7", "1e-12"))
    held = qx(calibrate_records(tmp_path / "c", (prior[0], tight))).coefficients["K_II"]
    assert (held.estimated, held.value, held.u) == (False, 2.8e-5, 1e-12)


def test_uncertain_radius_and_gravity_are_held(tmp_path):
    inputs = (
        ('"2.5 m"', '"2.5 ± 2.5e-3 m"'),
        ('"9.8066 m/s^2"', '"9.8066 ± 4.9033e-3 m/s^2"'),
    )
    sure = qx(calibrate_records(tmp_path / "a")).coefficients
    unsure = qx(calibrate_records(tmp_path / "b", *inputs)).coefficients
    # b2 is K_II R^2 w^4/(4 g) + K_F g/2.
    u = unsure["K_II"].u_stated
    assert u == pytest.approx(math.hypot(2 * 1e-3, 5e-4) * unsure["K_II"].value, rel=1e-6)
    assert unsure["K_F"].u_stated == pytest.approx(5e-4 * unsure["K_F"].value, rel=1e-6)
    assert sure["K_II"].u_stated < 1e-12
    assert unsure["K_II"].value == sure["K_II"].value


def test_tilt_is_held_per_run(tmp_path):
    tilt = extend_model('hold = ["platform.tilt"]\npriors = { "platform.tilt" = "0 ± 0.5 arcsec" }')
    folder = make_records(tmp_path, tilt)
    campaign = read_campaign(folder)
    problem = JointProblem(campaign, list(observe_runs(campaign)))
    outcome = calibrate_accelerometer(
        problem, campaign.accelerometers["Qx"], TwoStageOptions(), {}, problem.series
    )
    gain = outcome.second_stage.gain[0]
    size = 0.5 * math.pi / 648000 * 1.002 * 9.8066 / 2
    c = outcome.result.coefficients["K_II"]
    assert c.u_stated == pytest.approx(size * math.hypot(*gain), rel=1e-4)


@pytest.mark.parametrize("options", [{}, {"weighted": False}, {"model": "as-printed"}])
def test_budget_contains_all_sources_of_u(tmp_path, options):
    tilt = extend_model('hold = ["platform.tilt"]\npriors = { "platform.tilt" = "0 ± 0.5 arcsec" }')
    radius = ('"2.5 m"', '"2.5 ± 2.5e-3 m"')
    accelerometer = qx(calibrate_records(tmp_path, PRIORS, tilt, radius, **options))
    estimated = {symbol for symbol, c in accelerometer.coefficients.items() if c.estimated}
    assert "K_II" in estimated
    for symbol in estimated:
        c, lines = accelerometer.coefficients[symbol], accelerometer.budget[symbol]
        assert math.hypot(*(line.contribution for line in lines)) == pytest.approx(c.u, rel=1e-9)
        noise = next(line for line in lines if line.source == "noise of Qx")
        assert noise.contribution == pytest.approx(c.u_noise, rel=1e-9)
    sources = {line.source: line for line in accelerometer.budget["K_II"]}
    c = accelerometer.coefficients["K_II"]
    assert sources["centrifuge.radius"].contribution == pytest.approx(2e-3 * abs(c.value), rel=1e-4)
    if not options:
        psi = [sources[f"{run}.platform.tilt.north"] for run in ("slow", "fast")]
        assert {(line.unit, line.kind) for line in psi} == {("rad", "held")}
        assert sources["K_F"].kind == "stated"
        stated = [
            line.contribution for line in accelerometer.budget["K_II"] if line.kind != "noise"
        ]
        assert math.hypot(*stated) == pytest.approx(c.u_stated, rel=1e-9)


def test_stated_noise_is_total_noise(tmp_path):
    noise = 'displacement = "0.01 m"\nquantisation = "0.02 m"\nacceleration = "1e-6 g/Hz^0.5"'
    accelerometer = qx(
        calibrate_records(tmp_path, ('[noise]\ndisplacement = "0.01 m"', f"[noise]\n{noise}"))
    )
    assert accelerometer.noise["displacement"].value == pytest.approx(
        math.hypot(0.01, 0.02 / 12**0.5)
    )
    assert accelerometer.noise["acceleration"].value == pytest.approx(9.8066e-6)
    plain = qx(calibrate_records(tmp_path / "b"))
    assert accelerometer.coefficients["K_II"].u_noise > 1.15 * plain.coefficients["K_II"].u_noise
    assert accelerometer.residual.lack_of_fit_p > 1e-3


@pytest.mark.parametrize("how", ["asked", "estimate"])
def test_sigma_is_estimated_from_residuals(tmp_path, capsys, how):
    noise = '[noise]\ndisplacement = "0.01 m"\n'
    given = {"asked": noise, "estimate": replace_parts(noise, ("0.01 m", "estimate"))}
    folder = make_records(tmp_path, (noise, given[how]))
    sigma = ["--sigma", "residuals"] if how == "asked" else []
    file = tmp_path / "result.json"
    command = ["calibrate", str(folder), "--method", "two-stage", "--json", str(file), *sigma]
    assert main(command) == 0
    text = capsys.readouterr().out
    assert "estimated from the residuals" in text
    result = Result.read(file)
    for run in result.runs.values():
        assert run.parabolas["Qx"].sigma_from_residuals
        assert run.parabolas["Qx"].sigma == pytest.approx(0.01, rel=0.6)
    c = qx(result).coefficients["K_II"]
    assert 17 <= c.dof <= 51  # between the degrees of freedom of one run and of all runs
    assert qx(result).residual.chi2 is None


WALK = 1e-4 * 9.8066  #: Accelerometer noise, m/s^2/Hz^0.5, which dominates u(K_F)


def add_walk(noise):
    """Return the replacements for records with a walk and for the [noise] table."""
    stated = '[noise]\ndisplacement = "0.01 m"\n'
    truth = '[truth.noise]\ndisplacement = "0.01 m"'
    return (stated, noise), (truth, truth + '\nacceleration = "1e-4 g/Hz^0.5"')


ESTIMATED = [
    '[noise]\ndisplacement = "0.01 m"\nacceleration = "estimate"\n',
    '[noise]\ndisplacement = "estimate"\nacceleration = "estimate"\n',
    "",
]


@pytest.mark.slow
@pytest.mark.parametrize(
    "noise", [*ESTIMATED, "[noise]\n"], ids=["walk", "both", "nothing stated", "an empty table"]
)
def test_unstated_accelerometer_noise_is_taken_from_joint_fit(tmp_path, noise):
    folder = make_records(tmp_path, *add_walk(noise))
    jointly = qx(calibrate(folder))
    accelerometer = qx(calibrate(folder, method="two-stage"))
    assert accelerometer.noise == jointly.noise
    walk = accelerometer.noise["acceleration"]
    assert walk.estimated
    assert abs(walk.value - WALK) < 4 * walk.u
    stated = noise or ESTIMATED[0]
    known = replace_parts(stated, ("estimate", "1e-4 g/Hz^0.5")) if noise == ESTIMATED[0] else None
    if known:
        sure = qx(calibrate_records(tmp_path / "sure", *add_walk(known))).coefficients["K_F"]
        c = accelerometer.coefficients["K_F"]
        assert c.u == pytest.approx(sure.u, rel=0.3)
        assert sure.dof is None
        assert 3 < c.dof < 1000
    # The comparison in the joint result is the same estimate, except for its estimate of K_III.
    comparison, c = jointly.two_stage, accelerometer.coefficients["K_II"]
    assert comparison.value == pytest.approx(c.value, abs=0.01 * c.u)
    assert comparison.u == pytest.approx(c.u, rel=1e-4)


def test_comparison_in_joint_result_uses_joint_estimates(tmp_path):
    folder = make_records(tmp_path)
    jointly = qx(calibrate(folder))
    k_iii = jointly.coefficients["K_III"]
    text = (folder / "campaign.toml").read_text(encoding="utf-8")
    actual_text = f'{PRIORS[0]}\nK_III = "{k_iii.value!r} ± {k_iii.u!r} g/g^3"'
    write_description(folder, replace_parts(text, (PRIORS[0], actual_text)))
    c = qx(calibrate(folder, method="two-stage")).coefficients["K_II"]
    comparison = jointly.two_stage
    assert (comparison.value, comparison.u) == pytest.approx((c.value, c.u), rel=1e-9)


def test_undetected_noise_is_in_u(tmp_path):
    estimated = ('[noise]\ndisplacement = "0.01 m"\n', ESTIMATED[0])
    accelerometer = qx(calibrate_records(tmp_path / "a", estimated))
    none = qx(calibrate_records(tmp_path / "b"))
    assert accelerometer.noise["acceleration"].value == 0.0
    assert accelerometer.noise["acceleration"].estimated
    for symbol in ("K_II", "K_F"):
        c, without = accelerometer.coefficients[symbol], none.coefficients[symbol]
        assert c.value == without.value
        assert c.u_noise > without.u_noise
        assert c.dof is not None
    assert accelerometer.coefficients["K_F"].u_noise > 1.05 * none.coefficients["K_F"].u_noise


def test_undetected_noise_has_remark(tmp_path, monkeypatch):
    folder = make_records(tmp_path, ('[noise]\ndisplacement = "0.01 m"\n', ESTIMATED[0]))
    u = qx(calibrate(folder, method="two-stage")).coefficients["K_II"].u
    known = qx(calibrate_records(tmp_path / "known")).coefficients["K_II"].u
    share = 1.0 - (known / u) ** 2
    for part, count in ((0.9, 1), (1.1, 0)):
        monkeypatch.setattr(residuals, "_MAX_UNDETECTED_SHARE", part * share)
        result = calibrate(folder, method="two-stage")
        remarks = [
            remark for remark in result.warnings if "comes from accelerometer white noise" in remark
        ]
        assert len(remarks) == count
        assert "hidden-noise" not in {finding.code for finding in result.findings}


def test_contradicted_prior_is_named(tmp_path):
    """K_F is stated with an error of 40 ug and u of 2 ug: it explains the misfit of the runs."""
    wrong = (PRIORS[0], replace_parts(PRIORS[1], ("0.005 ± 2e-6 g", "0.00504 ± 2e-6 g")))
    result = calibrate_records(tmp_path, wrong)
    first = qx(result).findings[0]
    assert (first.code, first.subject, first.contradicts) == ("prior-conflict", "Qx.K_F", True)
    assert "Qx.K_F is stated as 5040.0 ± 2.0 ug, but the records and all other" in first.text
    assert first.size > 6.0
    assert [below.code for below in first.explains] == ["lack-of-fit"]
    assert "lack-of-fit" not in {finding.code for finding in qx(result).findings}
    right = qx(calibrate_records(tmp_path / "right", PRIORS))
    assert "prior-conflict" not in {finding.code for finding in right.findings}


def test_timing_noise_is_in_u(tmp_path):
    noise = '[noise]\ndisplacement = "0.01 m"\n'
    stated = (noise, noise + 'timing = "1e-3 s"\n')
    # The velocity at a strobe is R w: 2.5 m times the rate. The angle gives its location.
    for run in calibrate_records(tmp_path / "angle", stated).runs.values():
        assert run.parabolas["Qx"].sigma == pytest.approx(0.01, rel=1e-3)
    without = ('angle = { column = "angle_rad", unit = "rad" }\n', "")
    for run in calibrate_records(tmp_path, stated, without).runs.values():
        expected = math.hypot(0.01, 2.5 * run.rate * 1e-3)
        assert run.parabolas["Qx"].sigma == pytest.approx(expected, rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [ESTIMATED[0], ""], ids=["walk", "nothing stated"])
def test_trials_with_walk_have_stated_uncertainty(tmp_path, noise):
    count = TRIALS
    z, covered = [], 0
    for trial in range(count):
        folder = tmp_path / str(trial)
        changes = (("seed = 1", f"seed = {trial}"), *add_walk(noise))
        campaign = write_and_read_campaign(folder, replace_parts(SMALL, *changes))
        simulate(campaign, folder)
        for name, c in calibrate(folder, method="two-stage").accelerometers.items():
            truth = campaign.simulation.truth.coefficients[name]
            for symbol in ("K_II", "K_F"):
                coefficient = c.coefficients[symbol]
                z.append((coefficient.value - truth[symbol]) / coefficient.u)
                covered += abs(z[-1]) < stdtrit(coefficient.dof, 0.975)
    assert 1e-4 < chdtrc(len(z), sum(x * x for x in z)) < 1 - 1e-4
    assert covered / len(z) == pytest.approx(0.95, abs=4 * math.sqrt(0.95 * 0.05 / len(z)))


def test_degrees_of_freedom_follow_welch_satterthwaite(tmp_path):
    folder = make_records(tmp_path, ('"2.5 m"', '"2.5 ± 5e-3 m"'))
    c = qx(
        calibrate(folder, method="two-stage", options=TwoStageOptions(from_residuals=True))
    ).coefficients["K_II"]
    # GUM G.4.1: u^4 over the sum of u_i^4/dof_i, of the noise alone.
    alone = c.dof * (c.u_noise / c.u) ** 4
    assert 17 <= alone <= 51
    assert c.u_stated > 0.1 * c.u_noise


@pytest.mark.parametrize(
    "asked",
    [
        PRIORS,
        extend_model('terms = ["K_F", "K_II", "K_OO"]'),  # which are confounded
        extend_model('hold = ["K_OO"]\npriors = { "K_OO" = "1e-6 ± 2e-6 g/g^2" }'),
        ('angle = { column = "angle_rad", unit = "rad" }\n', ""),
    ],
    ids=["plain", "alike", "held", "nominal angle"],
)
def test_k_ii_alone_equals_full_result(tmp_path, asked):
    campaign = read_campaign(make_records(tmp_path, asked))
    problem = JointProblem(campaign, list(observe_runs(campaign)))
    for accelerometer in campaign.accelerometers.values():
        whole = calibrate_accelerometer(
            problem, accelerometer, TwoStageOptions(), {}, problem.series
        )
        view, second = two_stage_view(problem, accelerometer, TwoStageOptions(), {}, problem.series)
        expected = whole.result.coefficients["K_II"]
        assert view.assessment.determined[f"{accelerometer.name}.K_II"] == expected.estimated
        assert second.estimate("K_II") == pytest.approx(
            whole.second_stage.estimate("K_II"), rel=1e-9
        )
        assert len(second.fit.model.considered) == len(whole.second_stage.fit.model.considered)


# --- confounded terms -----------------------------------------------------------------------------


def test_confounded_terms_are_reported_with_combination(tmp_path, capsys):
    folder, file = make_records(tmp_path, PRIORS), tmp_path / "result.json"
    main(["calibrate", str(folder), "--method", "two-stage", "--json", str(file)])
    text = " ".join(capsys.readouterr().out.split())
    accelerometer = qx(Result.read(file))
    second, bias = accelerometer.confounded
    assert second.terms == ["K_II", "K_OO", "K_F.heating", "platform.compliance.zy"]
    assert second.determined == "K_II + K_OO + 2 K_F.heating + 1.002 platform.compliance.zy"
    alike = ["platform.tilt.north", "platform.compliance.yz"]
    assert bias.terms == ["K_F", "K_PP", "delta_O", *alike]
    assert bias.determined == "K_F + K_PP - delta_O" + "".join(f" - 1.002 {s}" for s in alike)
    for item in (second, bias):
        c = accelerometer.coefficients[item.terms[0]]
        assert (item.value, item.u) == (c.value, c.u)
        assert item.correlation == -1.0
        assert f"the records determine only {item.determined} = " in text


def test_default_priors_are_in_u(tmp_path):
    unassumed = (MODEL, "")
    accelerometer = qx(calibrate_records(tmp_path, PRIORS, unassumed))
    c = accelerometer.coefficients["K_II"]
    lines = {line.source: line for line in accelerometer.budget["K_II"]}
    assert {line.kind for line in lines.values()} == {"noise", "stated", "unstated", "held"} - {
        "unstated",
    }
    assert lines["K_OO"].contribution == pytest.approx(2e-6, rel=1e-6)
    # Equivalent K_II of 1 deg/h/g, at the fast run 0.77e-6 (physics.md, section 7).
    per_degree = math.radians(1) / 3600
    g_sensitive = lines["platform.g_sensitivity.zx"]
    assert abs(g_sensitive.sensitivity) * per_degree == pytest.approx(0.78e-6, rel=0.03)
    assert c.u == pytest.approx(math.hypot(c.u_noise, c.u_stated, c.u_unstated), rel=1e-12)
    assert c.u_unstated > 2e-6


def test_undetermined_requested_term_is_in_u(tmp_path):
    """A simulated typical K_III shifts K_II by the contribution of K_III to u(K_II)."""
    requested = extend_model('terms = ["K_F", "K_I", "K_II", "K_III"]')
    ripple = ("ratio = 1e-5", "ratio = 1e-3")
    ideal, cubic = (
        qx(calibrate_records(tmp_path / size, requested, ripple, ("3e-6 g/g^3", f"{size} g/g^3")))
        for size in ("0", "1e-6")
    )
    assert (ideal.coefficients["K_III"].value, ideal.findings) == (None, [])
    moved = cubic.coefficients["K_II"].value - ideal.coefficients["K_II"].value
    (line,) = (line for line in ideal.budget["K_II"] if line.source == "K_III")
    assert (line.kind, line.u) == ("held", 1e-6)
    assert line.contribution == pytest.approx(abs(moved), rel=1e-3)
    prior = ('scale_factor = "1.002 g/g"', 'scale_factor = "1.002 g/g"\nK_III = "0 ± 5e-7 g/g^3"')
    stated = qx(calibrate_records(tmp_path / "stated", requested, ripple, prior)).coefficients[
        "K_II"
    ]
    assert stated.u_stated == pytest.approx(abs(moved) / 2.0, rel=1e-3)


def test_combination_equals_sum_of_true_terms(tmp_path):
    truth = (
        'K_II = "2.7e-5 g/g^2"',
        'K_II = "2.7e-5 g/g^2"\nK_OO = "5e-6 g/g^2"\nK_PP = "4e-6 g/g^2"',
    )
    second, bias = qx(calibrate_records(tmp_path, truth)).confounded
    assert abs(second.value - 3.2e-5) < 4 * second.u
    assert abs(bias.value - (0.005 + 4e-6)) < 4 * bias.u
    assert second.u < 1e-6


def test_two_confounded_requested_terms_are_undetermined(tmp_path):
    extend_model_result = extend_model('terms = ["K_F", "K_II", "K_OO"]')
    accelerometer = qx(calibrate_records(tmp_path, extend_model_result))
    for symbol in ("K_II", "K_OO"):
        c = accelerometer.coefficients[symbol]
        assert (c.estimated, c.value) == (False, None)
    assert accelerometer.correlation.terms == ["K_F"]
    assert abs(accelerometer.confounded[0].value - 2.7e-5) < 4 * accelerometer.confounded[0].u
    assert any("do not determine K_II" in warning for warning in accelerometer.warnings)


def test_prior_of_confounded_term_is_in_u(tmp_path):
    known = extend_model('hold = ["K_OO"]\npriors = { "K_OO" = "1e-6 ± 2e-6 g/g^2" }')
    plain = qx(calibrate_records(tmp_path / "a"))
    accelerometer = qx(calibrate_records(tmp_path / "b", known))
    # The platform compliance acts like K_OO and has no prior.
    assert accelerometer.confounded[0].terms == ["K_II", "K_F.heating", "platform.compliance.zy"]
    c = accelerometer.coefficients["K_II"]
    assert c.u_stated == pytest.approx(2e-6, rel=1e-4)
    assert c.value == pytest.approx(plain.coefficients["K_II"].value - 1e-6, rel=1e-6)


def test_rejects_fewer_rates_than_unknowns(tmp_path, capsys):
    folder = make_records(tmp_path, ('"0.25 rev/s"', '"1 rev/s"'), ('"0.5 rev/s"', '"-1 rev/s"'))
    assert main(["calibrate", str(folder), "--method", "two-stage"]) == 1
    error = capsys.readouterr().err
    assert "K_II, K_F" in error
    assert "only 1" in error
    assert "Traceback" not in error


def test_method_requires_horizontal_displacement(tmp_path):
    force = (
        'displacement = { column = "north_m", unit = "m" }',
        'specific_force = { column = "f", unit = "g" }',
    )
    with raises("method-not-applicable", "Qy:", "specific force"):
        calibrate_records(tmp_path / "a", force)
    up = (
        'input_axis = "north"\npendulous_axis = "down"',
        'input_axis = "up"\npendulous_axis = "east"',
    )
    with pytest.raises(NotIdentifiableError, match=r"90\.000 deg above the horizontal"):
        calibrate_records(tmp_path / "b", up)


# --- options and warnings -------------------------------------------------------------------------


def test_as_printed_model_returns_half_with_warning(tmp_path):
    folder = make_records(tmp_path, PRIORS)
    for ripple, unit in (("amplitude", "rad/s"), ("ratio", "1")):
        options = TwoStageOptions(model="as-printed", weighted=False, ripple=ripple)
        accelerometer = qx(calibrate(folder, method="two-stage", options=options))
        c = accelerometer.coefficients["K_II"]
        assert c.value == pytest.approx(2.7e-5 / 2, abs=4 * c.u)
        assert abs(c.value - 2.7e-5) > 10 * c.u
        assert accelerometer.second_unknown["spindle.ripple"].unit == unit
        assert "the estimate is half the true K_II" in accelerometer.warnings[0]


def test_drift_is_estimated_without_angle(tmp_path, capsys):
    ripple = ('ripple = [{ harmonic = 1, ratio = 1e-5, phase = "30 deg" }]\n', "")
    folder = make_records(tmp_path, NO_ANGLE, ripple, PRIORS)
    result = calibrate(folder, method="two-stage")
    drift = qx(result).second_unknown["spindle.drift"]
    assert (drift.estimated, drift.unit) == (True, "1/s")
    assert drift.value == pytest.approx(1e-6, abs=4 * drift.u + 2e-9)
    assert any("no angle" in warning for warning in result.warnings)
    assert any("K_F and spindle.drift" in warning for warning in qx(result).warnings)


def test_held_terms_may_deviate_within_stated_uncertainty(tmp_path):
    """Stated tilts of 5 arcsec shift K_F by 24 ug, 12 times the u of its prior."""
    truth = ("[truth.Qx]", '[truth.platform]\ntilt = { north = "5 arcsec" }\n[truth.Qx]')
    for u, codes in (("5", set()), ("0.05", {"lack-of-fit", "prior-conflict"})):
        stated = extend_model(f'priors = {{ "platform.tilt" = "0 ± {u} arcsec" }}')
        accelerometer = qx(calibrate_records(tmp_path / u, PRIORS, truth, stated))
        assert bool(codes) == bool({finding.code for finding in accelerometer.findings} & codes)
        assert (accelerometer.state == "good") == (not codes)


def test_inconsistent_runs_are_named(tmp_path):
    # An exact value is not a prior that can be tested.
    wrong = (PRIORS[0], 'bias = "0.00501 g"\nscale_factor = "1.002 g/g"')
    first = qx(calibrate_records(tmp_path / "a", wrong)).findings[0]
    assert first.code == "lack-of-fit"
    assert "are not consistent with the model" in first.text
    assert "slow deviates most" in first.text
    # Without weights the sum of squares has no chi-square distribution.
    unweighted = qx(calibrate_records(tmp_path / "b", wrong, weighted=False))
    assert "lack-of-fit" not in {finding.code for finding in unweighted.findings}


def test_strobes_in_gaps_are_counted(tmp_path):
    folder = make_records(tmp_path)
    frame = pl.read_csv(folder / "fast.csv")
    time = frame["time_s"]
    frame.filter(~time.is_between(5.1, 7.9)).write_csv(folder / "fast.csv")
    result = calibrate(folder, method="two-stage")
    # Qx has its strobes at 0.25 s, Qy at 0.5 s of each revolution.
    assert (
        "Qx: 3 strobes coincided with gaps in the record and were omitted." in qx(result).warnings
    )
    assert result.runs["fast"].parabolas["Qx"].strobes == 17


# --- end to end -----------------------------------------------------------------------------------


@pytest.mark.slow
def test_full_trials_have_stated_uncertainty(tmp_path):
    # With encoder noise: each trial estimates its rotation and strobe times.
    chi2, covered = 0.0, 0
    for trial in range(TRIALS):
        folder = tmp_path / str(trial)
        campaign = write_and_read_campaign(
            folder, replace_parts(SMALL, ("seed = 1", f"seed = {trial}"))
        )
        simulate(campaign, folder)
        problem = JointProblem(campaign, list(observe_runs(campaign)))
        for name, truth in K_II.items():
            result = calibrate_accelerometer(
                problem, campaign.accelerometers[name], TwoStageOptions(), {}, problem.series
            )
            c = result.result.coefficients["K_II"]
            chi2 += ((c.value - truth) / c.u) ** 2
            covered += abs(c.value - truth) < 1.96 * c.u
    n = len(K_II) * TRIALS
    assert 1e-4 < chdtrc(n, chi2) < 1 - 1e-4
    assert covered / n == pytest.approx(0.95, abs=4 * math.sqrt(0.95 * 0.05 / n))


def test_truth_does_not_affect_result(tmp_path):
    folder = make_records(tmp_path)
    with_truth = calibrate(folder, method="two-stage")
    text = SMALL
    for table in ("simulation", "truth.Qx", "truth.Qy", "truth.spindle", "truth.noise"):
        text = remove_table(text, table)
    write_description(folder, text)
    bare = calibrate(folder, method="two-stage")
    assert bare.accelerometers == with_truth.accelerometers


@pytest.mark.parametrize("key", [field.name for field in fields(TwoStageOptions)])
def test_option_text_is_valid_on_command_line(key, tmp_path, monkeypatch):
    """Parsing the text gives the same options."""
    other = {"model": "as-printed", "ripple": "ratio"}
    options = TwoStageOptions(**{key: other.get(key, not getattr(TwoStageOptions(), key))})
    seen = []
    monkeypatch.setattr(
        "counterspin.calibration.calibrate.calibrate",
        lambda _where, *, options, **_: seen.append(options) or 1 / 0,
    )
    main(["calibrate", str(tmp_path), *command_arguments("two-stage", options)])
    assert seen == [options]
    assert command_arguments("two-stage", TwoStageOptions()) == ["--method=two-stage"]
    assert command_arguments("joint", TwoStageOptions()) == []


# --- the scale factor, which strobes do not determine ---------------------------------------------


@pytest.mark.parametrize("with_angle", [True, False])
@pytest.mark.parametrize(
    ("scale", "message"), [("1.002", False), ("1.09", False), ("1.11", True), ("0.89", True)]
)
def test_harmonics_reveal_incredible_scale_factor(tmp_path, scale, message, with_angle):
    """Beyond 0.1 of nominal, whatever the prior; the harmonics determine it to 1e-3.

    Without an angle, they also determine the start angle.
    """
    start = () if with_angle else (NO_ANGLE, ("drift =", 'start_angle = "2 rad"\ndrift ='))
    limits = extend_model('limits = { K_I = "1 g/g" }')
    folder = make_records(tmp_path, limits, ('K_I = "1.002 g/g"', f'K_I = "{scale} g/g"'), *start)
    text = (folder / "campaign.toml").read_text(encoding="utf-8")
    write_description(folder, replace_parts(text, (limits[1], MODEL)))
    accelerometer = qx(calibrate(folder, method="two-stage"))
    of_k_i = [f for f in accelerometer.findings if (f.code, f.subject) == ("incredible", "Qx.K_I")]
    assert len(of_k_i) == message
    for finding in of_k_i:
        (value,) = re.findall(r"K_I = (\S+) g/g", finding.text)
        assert float(value) == pytest.approx(float(scale), abs=1e-3)
        assert finding.contradicts
