"""Calibrating readings: a tumble, an arm, both together; what they say and what they cannot."""

import math
import shutil
from hashlib import sha256

import numpy as np
import pytest
from raising import raises
from reading_campaigns import SITE, TRUTH, make_arm_test, make_tumble, simulate_readings
from reading_descriptions import ACCELEROMETER, format_arm_run, format_rest_run, format_site
from stations import Station

from counterspin.calibration.calibrate import calibrate
from counterspin.calibration.options import TwoStageOptions
from counterspin.calibration.pages.document import print_result
from counterspin.calibration.result import Result
from counterspin.cli import main
from counterspin.errors import CampaignError, CounterspinError
from counterspin.physics.accelerometer import Mounting
from counterspin.readings.means import read_rows

SIGMA = 2e-6
HEAD = format_site("1.0 ± 1e-6 m", "9.80665 m/s^2", "0.8 rad") + ACCELEROMETER


def write_record(path, time, current):
    rows = "".join(f"{a!r},{b!r}\n" for a, b in zip(time.tolist(), current.tolist(), strict=True))
    path.write_text("t,mA\n" + rows.replace("nan", ""), encoding="utf-8")


def tumble_runs(values, u=SIGMA):
    step = 360 / len(values)
    return "".join(
        format_rest_run(
            f"tumble {i}",
            f"{i * step!r} deg about north",
            f"{float(1.25 * value)!r}{format_uncertainty(u)} mA",
        )
        for i, value in enumerate(values)
    )


def arm_runs(test, values, u=SIGMA):
    return "".join(
        format_arm_run(
            f"{side} {i}",
            f"{float(station.rate)!r} rad/s",
            f"{float(1.25 * value)!r}{format_uncertainty(u)} mA",
            side=side,
            mounting=side,
        )
        for i, (station, side, value) in enumerate(zip(test[0], test[1], values, strict=True))
    )


def format_uncertainty(u):
    return f" ± {1.25 * u!r}" if u else ""


def write_and_calibrate(folder, *parts):
    (folder / "campaign.toml").write_text("".join([HEAD, *parts]), encoding="utf-8")
    return calibrate(folder)


def model_section(*terms, more=""):
    return f"[model]\nassume = 'all'\nterms = {list(terms)}\n{more}".replace("'", '"')


LEVEL_TERMS = {"K_F": 2e-3, "K_I": 1.0005, "delta_O": 3e-5}


def test_tumble_is_calibrated_with_textbook_uncertainty(tmp_path):
    values = simulate_readings(make_tumble(), np.random.default_rng(1), SIGMA, truth=LEVEL_TERMS)
    result = write_and_calibrate(tmp_path, model_section(*LEVEL_TERMS), tumble_runs(values))
    a = result.accelerometers["A"]
    assert result.state == "good"
    assert all("would not reveal these faults" in text for text in result.warnings)
    for symbol, truth in LEVEL_TERMS.items():
        c = a.coefficients[symbol]
        assert abs(c.value - truth) < 4.0 * c.u
    expected = SIGMA * np.array([1 / math.sqrt(12), 1 / math.sqrt(6), 1 / math.sqrt(6)])
    np.testing.assert_allclose([c.u for c in a.coefficients.values()], expected, rtol=1e-6)
    bias = a.output["bias"]
    assert (bias.unit, bias.value) == ("mA", pytest.approx(1.25 * a.coefficients["K_F"].value))
    assert a.output["scale_factor"].unit == "mA/g"
    assert len(a.readings) == 12


def test_residuals_of_readings_are_stored_in_result(tmp_path):
    values = simulate_readings(make_tumble(), np.random.default_rng(1), SIGMA, truth=LEVEL_TERMS)
    result = write_and_calibrate(tmp_path, model_section(*LEVEL_TERMS), tumble_runs(values))
    result.write(tmp_path / "result.json")
    found = {s: c.value for s, c in result.accelerometers["A"].coefficients.items()}
    fitted = simulate_readings(make_tumble(), np.random.default_rng(1), 0.0, truth=found)
    readings = Result.read(tmp_path / "result.json").accelerometers["A"].readings
    assert [reading.motion for reading in readings] == ["static"] * 12
    assert readings[1].name == "tumble 1"
    np.testing.assert_allclose([r.value for r in readings], values, rtol=0, atol=1e-15)
    residuals = np.array([r.residual for r in readings])
    np.testing.assert_allclose(values - residuals, fitted, rtol=0, atol=1e-12)
    np.testing.assert_allclose([r.u for r in readings], SIGMA, rtol=1e-6)
    with pytest.raises(CounterspinError, match="no residuals of records"):
        result.residuals("A")


def test_arm_determines_k_ii_and_stretch_is_in_budget(tmp_path):
    test = make_arm_test()
    values = simulate_readings(test, np.random.default_rng(2), SIGMA)
    stretch = '[model.priors]\n"centrifuge.stretch" = "0 ± 5e-9 s^2/m"\n'
    result = write_and_calibrate(
        tmp_path, model_section(*TRUTH, more=stretch), arm_runs(test, values)
    )
    k_ii = result.accelerometers["A"].coefficients["K_II"]
    assert k_ii.estimated
    assert abs(k_ii.value - TRUTH["K_II"]) < 4.0 * k_ii.u
    sources = {line.source for line in result.accelerometers["A"].budget["K_III"]}
    assert "centrifuge.stretch" in sources


def test_tumble_and_arm_together_reduce_uncertainty(tmp_path):
    rng = np.random.default_rng(3)
    test = make_arm_test()
    runs = {
        "tumble": tumble_runs(simulate_readings(make_tumble(), rng, SIGMA, truth={**TRUTH})),
        "arm": arm_runs(test, simulate_readings(test, rng, SIGMA)),
    }
    model_section_result = model_section("K_F", "K_I", "K_II", "K_III", "delta_O")
    both = (
        write_and_calibrate(tmp_path, model_section_result, *runs.values())
        .accelerometers["A"]
        .coefficients
    )
    alone = (
        write_and_calibrate(tmp_path, model_section_result, runs["arm"])
        .accelerometers["A"]
        .coefficients
    )
    for symbol in ("K_F", "K_I", "K_II"):
        assert both[symbol].u < alone[symbol].u
    assert abs(both["K_II"].value - TRUTH["K_II"]) < 4.0 * both["K_II"].u


def test_noise_is_estimated_separately_at_rest_and_on_arm(tmp_path):
    rng = np.random.default_rng(4)
    test = make_arm_test()
    tumbles = tumble_runs(simulate_readings(make_tumble(), rng, SIGMA, truth={**TRUTH}), None)
    arms = arm_runs(test, simulate_readings(test, rng, 20.0 * SIGMA), None)
    model_section_result = model_section("K_F", "K_I", "K_II", "K_III", "delta_O")
    noise = (
        write_and_calibrate(tmp_path, model_section_result, tumbles, arms).accelerometers["A"].noise
    )
    assert all(line.estimated for line in noise.values())
    at_rest, on_the_arm = sorted(line.value for line in noise.values())
    assert 10.0 < on_the_arm / at_rest < 40.0


@pytest.mark.parametrize(
    ("u", "state"),
    # Nine degrees of freedom: Student's 9.1 is as rare as a normal 4.5.
    [(SIGMA, "contradicted"), (None, "reservations")],
    ids=["noise stated", "noise estimated"],
)
def test_prior_conflicting_with_tumble_is_found(tmp_path, u, state):
    """K_F known beforehand, 8 of its u off: nothing else in the readings would tell."""
    values = simulate_readings(make_tumble(), np.random.default_rng(1), SIGMA, truth=LEVEL_TERMS)
    known = '[model.priors]\nK_F = "0.002016 ± 2e-6 g"\n'
    result = write_and_calibrate(
        tmp_path, model_section(*LEVEL_TERMS, more=known), tumble_runs(values, u)
    )
    first = result.findings[0]
    assert (first.code, first.subject) == ("prior-conflict", "A.K_F")
    assert "A.K_F is stated as 2016.0 ± 2.0 ug, but the records and all other priors" in first.text
    # 16 ug over the u of the difference, 2 ug and that of twelve readings.
    exact = 16.0 / math.hypot(2.0, 1e6 * SIGMA / math.sqrt(12.0))
    assert first.size == pytest.approx(exact, abs=1.0 if u else 2.5)
    assert result.state == state


def test_correct_priors_have_no_finding(tmp_path):
    values = simulate_readings(make_tumble(), np.random.default_rng(1), SIGMA, truth=LEVEL_TERMS)
    known = '[model.priors]\nK_F = "0.002002 ± 2e-6 g"\n'
    result = write_and_calibrate(
        tmp_path, model_section(*LEVEL_TERMS, more=known), tumble_runs(values)
    )
    assert result.findings == []


def test_wrong_radius_of_arm_is_found(tmp_path):
    """The scale factor known to 2e-6 tells that the radius is not what was stated."""
    test = make_arm_test(radius=1.0002)
    values = simulate_readings(test, np.random.default_rng(2), SIGMA)
    known = '[model.priors]\nK_I = "1.0005 ± 2e-6 g/g"\n'
    result = write_and_calibrate(
        tmp_path, model_section(*TRUTH, more=known), arm_runs(test, values)
    )
    first = result.findings[0]
    assert (first.code, first.subject) == ("wrong-input", "centrifuge.radius")
    assert "a radius of the centrifuge of 1.0002" in first.text
    assert first.as_well[0] == "A.K_I"
    assert result.state == "contradicted"


def test_k_ii_is_undetermined_at_one_g(tmp_path):
    """Nothing is known of K_PP and K_OO: what is determined in place of K_II is said by name."""
    values = simulate_readings(make_tumble(24), np.random.default_rng(4), SIGMA, truth=TRUTH)
    result = write_and_calibrate(
        tmp_path, model_section("K_F", "K_I", "K_II", "delta_O"), tumble_runs(values)
    )
    a = result.accelerometers["A"]
    assert set(a.coefficients) == {"K_F", "K_I", "K_II", "delta_O"}
    assert not a.coefficients["K_II"].estimated
    assert a.coefficients["K_II"].value is None
    assert a.coefficients["K_F"].u == pytest.approx(1e-4, rel=1e-3)
    determined = {c.determined: c for c in a.confounded}
    assert set(determined) == {"K_F + K_PP", "K_II - K_PP"}
    difference = determined["K_II - K_PP"]
    assert abs(difference.value - TRUTH["K_II"]) < 4.0 * difference.u
    assert difference.u == pytest.approx(0.5773503 * SIGMA, rel=1e-3)
    (finding,) = [f for f in result.findings if f.subject == "A.K_II"]
    assert "can determine K_F, K_II, K_PP and K_OO all at once" in finding.text


def test_u_of_k_ii_at_one_g_includes_priors_of_squares(tmp_path):
    values = simulate_readings(make_tumble(24), np.random.default_rng(4), SIGMA, truth=TRUTH)
    known = "".join(f'{symbol} = "0 ± 3e-6 g/g^2"\n' for symbol in ("K_PP", "K_OO"))
    priors = f'considered = ["K_PP", "K_OO"]\n[model.priors]\n{known}'
    model_section_result = model_section("K_F", "K_I", "K_II", "delta_O", more=priors)
    k_ii = (
        write_and_calibrate(tmp_path, model_section_result, tumble_runs(values))
        .accelerometers["A"]
        .coefficients["K_II"]
    )
    assert k_ii.estimated
    assert k_ii.u == pytest.approx(math.hypot(3e-6, 0.5773503 * SIGMA), rel=1e-3)


def test_ten_terms_at_one_g_have_rank_nine(tmp_path):
    """Rank 9: the null vector is K_F - K_II - K_PP - K_OO, and the output names it."""
    rng = np.random.default_rng(48)
    terms = ["K_F", "K_I", "delta_O", "delta_P", "K_II", "K_PP", "K_OO", "K_IP", "K_IO", "K_PO"]
    runs = ""
    for i in range(48):
        first, second = rng.normal(size=(2, 3))
        first /= np.linalg.norm(first)
        second -= (second @ first) * first
        second /= np.linalg.norm(second)
        station = Station("static", Mounting.from_axes(list(first), list(second)))
        value = float(station.indicated(SITE, TRUTH) + rng.normal(0.0, SIGMA))
        runs += (
            f'[[runs]]\nname = "{i}"\nmotion = "static"\nreading = "{1.25 * value!r} mA"\n'
            f"axes = {{ input = {first.tolist()}, pendulous = {second.tolist()} }}\n"
        )
    result = write_and_calibrate(tmp_path, model_section(*terms), runs)
    a = result.accelerometers["A"]
    undetermined = {symbol for symbol, c in a.coefficients.items() if not c.estimated}
    assert undetermined == {"K_F", "K_II", "K_PP", "K_OO"}
    assert all(a.coefficients[symbol].value is None for symbol in undetermined)
    # Three combinations that the null vector leaves as they are.
    null = {"K_F": 1.0, "K_II": -1.0, "K_PP": -1.0, "K_OO": -1.0}
    assert len(a.confounded) == 3
    assert set.union(*(set(c.terms) for c in a.confounded)) == set(null)
    for c in a.confounded:
        change = sum(w * null[t] for w, t in zip(c.weights, c.terms, strict=True))
        assert abs(change) < 1e-6
    texts = [f.text for f in result.findings if f.code == "not-determined"]
    assert len(texts) == 4
    assert all("can determine K_F, K_II, K_PP and K_OO all at once" in text for text in texts)


@pytest.mark.parametrize("u", [SIGMA, None], ids=["noise stated", "noise to be estimated"])
def test_fewer_readings_than_unknowns_raise(tmp_path, capsys, u):
    values = simulate_readings(make_tumble(3), np.random.default_rng(4), SIGMA, truth=LEVEL_TERMS)
    with raises("not-identifiable", "3 readings of A", "4 coeff"):
        write_and_calibrate(tmp_path, model_section(*LEVEL_TERMS, "K_III"), tumble_runs(values, u))
    assert main(["calibrate", str(tmp_path)]) == 1
    out = " ".join(capsys.readouterr().err.split())
    assert "(K_F, K_I, K_III, delta_O); add positions" in out


ONE_SIDE = tuple(float(size) for size in range(1, 21))


@pytest.mark.parametrize(
    ("other", "determined"),
    [("K_OQ", "K_II + K_OQ"), ("centrifuge.stretch", "K_II + 9.80")],
)
def test_single_mounting_confounds_k_ii_with_similar_term(tmp_path, other, determined):
    """There a |a| is a^2, and a stretch s of the radius makes K_I s a^2, with a in m/s^2."""
    test = [part[:40] for part in make_arm_test(ONE_SIDE)]
    truth = {"K_F": 2e-3, "K_II": 15e-6}
    values = simulate_readings(test, np.random.default_rng(5), SIGMA, truth=truth)
    terms = ("K_F", "K_I", "K_II", other)
    a = write_and_calibrate(tmp_path, model_section(*terms), arm_runs(test, values)).accelerometers[
        "A"
    ]
    assert a.coefficients["K_II"].value is None
    (confounded,) = a.confounded
    assert confounded.terms == ["K_II", other]
    assert confounded.determined.startswith(determined)
    assert abs(confounded.value - 15e-6) < 4.0 * confounded.u
    # Both sides tell them apart.
    both = make_arm_test()
    values = simulate_readings(both, np.random.default_rng(6), SIGMA, truth=truth)
    a = write_and_calibrate(tmp_path, model_section(*terms), arm_runs(both, values)).accelerometers[
        "A"
    ]
    assert a.coefficients["K_II"].estimated


def test_missing_term_has_single_finding(tmp_path):
    test = make_arm_test()
    values = simulate_readings(test, np.random.default_rng(7), SIGMA)
    result = write_and_calibrate(
        tmp_path, model_section("K_F", "K_I", "K_II"), arm_runs(test, values)
    )
    (finding,) = result.findings
    assert finding.code == "lack-of-fit"
    assert "follow K_III, more than the model allows" in finding.text
    assert finding.text.endswith("24 of 24 readings on the arm deviate from the model.")


def test_default_model_of_tumble_includes_misalignment(tmp_path):
    """In a table of its own, whose columns have names of their own; no terms are asked for."""
    truth = {**LEVEL_TERMS, "delta_O": 8e-4}
    values = np.array(
        [simulate_readings(make_tumble(24), np.random.default_rng(9), 1e-5, truth=truth)]
    )
    result = write_and_calibrate(tmp_path, write_table(tmp_path, values))
    a = result.accelerometers["A"]
    assert list(a.coefficients) == ["K_F", "K_I", "delta_O"]
    assert abs(a.coefficients["delta_O"].value - 8e-4) < 4.0 * a.coefficients["delta_O"].u
    assert {f.code for f in result.findings} <= {"left-out"}
    # Two positions, up and down, have no room for it.
    two = tumble_runs(values[0][[0, 12]])
    assert list(write_and_calibrate(tmp_path, two).accelerometers["A"].coefficients) == [
        "K_F",
        "K_I",
    ]


@pytest.mark.parametrize("stated", [True, False], ids=["noise stated", "noise estimated"])
def test_outlying_position_is_named(tmp_path, stated):
    values = simulate_readings(make_tumble(), np.random.default_rng(5), SIGMA, truth=LEVEL_TERMS)
    values[7] += 160e-6
    u = SIGMA if stated else None
    result = write_and_calibrate(tmp_path, model_section(*LEVEL_TERMS), tumble_runs(values, u))
    assert result.state == ("contradicted" if stated else "reservations")
    outlying = [f for f in result.findings if f.code == "outlying-reading"]
    assert outlying[0].subject == "A.tumble 7"


def write_table(folder, values, repeats=""):
    """Write a tumble as a laboratory's table has it, one row for each of the arrays' numbers."""
    step = 360 / values.shape[1]
    rows = [
        f"{i + 1},{i * step:g},{1.25 * value!r}"
        for run in values.tolist()
        for i, value in enumerate(run)
    ]
    (folder / "tumble.csv").write_text("Pos.,Winkel,Strom\n" + "\n".join(rows) + "\n")
    columns = '{ name = "Pos.", attitude = "Winkel", reading = "Strom" }'
    return f'[readings]\nfile = "tumble.csv"\ncolumns = {columns}\n'


@pytest.mark.parametrize("repeats", [1, 2, 4])
def test_outlying_position_of_table_is_named(tmp_path, repeats):
    """160 ug beside a noise of 30 ug that nobody stated, however often each position was read."""
    rng = np.random.default_rng(repeats)
    values = np.array(
        [simulate_readings(make_tumble(24), rng, 3e-5, truth=TRUTH) for _ in range(repeats)]
    )
    values[:, 17] += 160e-6
    terms = ("K_F", "K_I", "K_II", "delta_O", "K_IP")
    result = write_and_calibrate(tmp_path, model_section(*terms), write_table(tmp_path, values))
    outlying = [f for f in result.findings if f.code == "outlying-reading"]
    assert [f.subject for f in outlying] == ["A.18"]
    assert "position" in outlying[0].text
    k_ii = result.accelerometers["A"].coefficients["K_II"]
    assert not k_ii.estimated
    assert k_ii.value is None


def test_scatter_of_positions_above_repeats_is_lack_of_fit(tmp_path):
    """A cubic term that the model lacks: no position stands out, the repeats show it."""
    truth = {**LEVEL_TERMS, "K_III": 1e-5}
    rng = np.random.default_rng(3)
    values = np.array(
        [simulate_readings(make_tumble(24), rng, SIGMA, truth=truth) for _ in range(3)]
    )
    table = write_table(tmp_path, values)
    result = write_and_calibrate(tmp_path, model_section(*LEVEL_TERMS), table)
    (misfit,) = [f for f in result.findings if f.code == "lack-of-fit"]
    assert "deviate more from the model than repeated readings of the same position" in misfit.text
    fitting = write_and_calibrate(tmp_path, model_section(*LEVEL_TERMS, "K_III"), table)
    assert all(f.code != "lack-of-fit" for f in fitting.findings)


def test_excluding_table_row_by_name_raises(tmp_path):
    table = write_table(tmp_path, np.ones((1, 12)))
    (tmp_path / "campaign.toml").write_text(HEAD + table, encoding="utf-8")
    with raises("wrong-usage", "`without`", '"3"', "tumble.csv"):
        calibrate(tmp_path, without=["3"])


CONSIDERED = 'considered = ["delta_O"]\n[model.priors]\ndelta_O = "0 ± 3e-5 rad"\n'


@pytest.mark.parametrize("repeats", [0, 3], ids=["noise stated", "noise by repeats"])
def test_considered_term_within_uncertainty_fits(tmp_path, repeats):
    """It is as large as its u, and fifteen times the noise."""
    rng = np.random.default_rng(3)
    values = [
        simulate_readings(make_tumble(24), rng, SIGMA, truth=LEVEL_TERMS)
        for _ in range(repeats or 1)
    ]
    runs = write_table(tmp_path, np.array(values)) if repeats else tumble_runs(values[0])
    considering = write_and_calibrate(tmp_path, model_section("K_F", "K_I", more=CONSIDERED), runs)
    assert considering.findings == []
    if repeats:
        return
    # Chi-square is that of the fit which estimates it, its prior counted as an observation.
    prior = CONSIDERED.partition("\n")[2]
    estimating = write_and_calibrate(
        tmp_path, model_section(*LEVEL_TERMS, more=prior), runs
    ).accelerometers["A"]
    expected = estimating.residual.chi2 + (estimating.coefficients["delta_O"].value / 3e-5) ** 2
    assert considering.accelerometers["A"].residual.chi2 == pytest.approx(expected, rel=1e-6)


def test_readings_shifted_by_considered_term_are_not_outliers(tmp_path):
    """1.8 of its u, in four readings that leave their noise a single degree of freedom."""
    truth = {**LEVEL_TERMS, "delta_O": 5.4e-5}
    values = simulate_readings(make_tumble(4), np.random.default_rng(3), SIGMA, truth=truth)
    result = write_and_calibrate(
        tmp_path, model_section("K_F", "K_I", more=CONSIDERED), tumble_runs(values, None)
    )
    assert [f.code for f in result.findings] == ["unjudged-readings"]
    assert max(abs(r.z) for r in result.accelerometers["A"].readings) == pytest.approx(1.8, abs=0.1)


@pytest.mark.parametrize(
    ("unit", "part"),
    [("m/s^2", 1.0), ("g", 0.0)],
)
def test_scale_factor_of_readings_in_si_includes_gravity(tmp_path, unit, part):
    """At rest 1 g acts: of a reading in m/s^2 its uncertainty is that of K_I, and in g none."""
    g, u_g = 9.80665, 1e-4
    head = HEAD.partition("[accelerometers")[0].replace(f"{g} m", f"{g} ± {u_g} m")
    plain = '[accelerometers.A]\ninput_axis = "up"\npendulous_axis = "west"\n'
    size = g if unit != "g" else 1.0
    values = (
        simulate_readings(make_tumble(), np.random.default_rng(1), SIGMA, truth=LEVEL_TERMS) * size
    )
    runs = "".join(
        format_rest_run(f"{i}", f"{30 * i} deg about north", f"{value!r} ± {SIGMA * size!r} {unit}")
        for i, value in enumerate(values.tolist())
    )
    (tmp_path / "campaign.toml").write_text(head + plain + model_section(*LEVEL_TERMS) + runs)
    k_i = calibrate(tmp_path).accelerometers["A"].coefficients["K_I"]
    assert k_i.u == pytest.approx(math.hypot(SIGMA / math.sqrt(6.0), part * u_g / g), rel=1e-3)


@pytest.mark.slow
def test_false_outliers_are_rare(tmp_path):
    """At the level of 1 % a campaign, in 60 campaigns no more than 4 (p = 0.003)."""
    rng = np.random.default_rng(6)
    false = 0
    for _ in range(60):
        values = simulate_readings(make_tumble(), rng, SIGMA, truth=LEVEL_TERMS)
        result = write_and_calibrate(
            tmp_path, model_section(*LEVEL_TERMS), tumble_runs(values, None)
        )
        false += any(f.code == "outlying-reading" for f in result.findings)
    assert false <= 4


def test_radius_of_mounting_is_reported_as_radius(tmp_path):
    rng = np.random.default_rng(7)
    test = make_arm_test()
    values = simulate_readings(test, rng, SIGMA, {"centrifuge.radius.inward": 3e-5})
    prior = '[model.priors]\n"centrifuge.radius" = "1.0 ± 1e-4 m"\n'
    terms = ("K_F", "K_I", "K_II", "K_III", "centrifuge.radius")
    tumbled = tumble_runs(simulate_readings(make_tumble(), rng, SIGMA, truth=TRUTH))
    result = write_and_calibrate(
        tmp_path, model_section(*terms, "delta_O", more=prior), tumbled, arm_runs(test, values)
    )
    radius = result.platform["centrifuge.radius.inward"]
    assert abs(radius.value - 1.00003) < 4.0 * radius.u
    assert radius.u < 1e-5


def test_stated_radius_of_mounting_is_used(tmp_path):
    """It is that mounting's own, and the other has the centrifuge's."""
    test = make_arm_test()
    values = simulate_readings(
        test, np.random.default_rng(7), SIGMA, {"centrifuge.radius.inward": 3e-4}
    )
    prior = '[model.priors]\n"centrifuge.radius.inward" = "1.0 ± 1e-3 m"\n'
    tumbled = tumble_runs(
        simulate_readings(make_tumble(), np.random.default_rng(8), SIGMA, truth=TRUTH)
    )
    terms = ("K_F", "K_I", "K_II", "K_III", "delta_O")
    result = write_and_calibrate(
        tmp_path, model_section(*terms, more=prior), tumbled, arm_runs(test, values)
    )
    known = {row.name: row for row in result.rests_on}
    inward = known["centrifuge.radius.inward"]
    assert (inward.kind, inward.u) == ("stated", 1e-3)
    assert abs(inward.found - 3e-4) < 4.0 * inward.u_found < 4e-5
    assert known["centrifuge.radius"].u == 1e-6
    assert result.state == "good"


def test_records_on_arm_are_averaged(tmp_path):
    rng, test = np.random.default_rng(9), make_arm_test()
    values = simulate_readings(test, rng, 0.0)
    runs = arm_runs(test, values)
    t = np.arange(0.0, 10.0, 0.05)
    for i, value in enumerate(values):
        current = 1.25 * (value + rng.normal(0.0, 1e-5, t.size))
        write_record(tmp_path / f"r{i}.csv", t, current)
        given = f'reading = "{float(1.25 * value)!r}{format_uncertainty(SIGMA)} mA"'
        assert given in runs
        runs = runs.replace(given, f'record = "r{i}.csv"', 1)
    column = 'specific_force = { column = "mA", unit = "mA" }\n'
    records = '[records]\ntime = { column = "t", unit = "s" }\n'
    text = HEAD + column + records + model_section(*TRUTH) + runs
    (tmp_path / "campaign.toml").write_text(text, encoding="utf-8")
    result = calibrate(tmp_path)
    for symbol, truth in TRUTH.items():
        c = result.accelerometers["A"].coefficients[symbol]
        assert abs(c.value - truth) < 4.0 * c.u
    assert set(result.provenance.inputs) == {"campaign.toml", *(f"r{i}.csv" for i in range(24))}
    for name, checksum in result.provenance.inputs.items():
        assert checksum == "sha256:" + sha256((tmp_path / name).read_bytes()).hexdigest()

    def change(path, *more):
        read = read_rows(path, *more)
        if path.name == "r3.csv":
            path.write_bytes(path.read_bytes() + b"10.0,1.0\n")
        return read

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("counterspin.readings.mean_records.read_rows", change)
        with raises("file-changed", "r3.csv:"):
            calibrate(tmp_path)
    shutil.copy(tmp_path / "r0.csv", tmp_path / "r9.csv")
    with raises("duplicate-record", "r9.csv", "r0.csv"):
        calibrate(tmp_path)


def test_repairs_of_record_are_counted_and_shown(tmp_path, capsys):
    """One cell of 900, one repeated row, an empty cell, a gap; 6 % outliers in the next record."""
    rng = np.random.default_rng(10)
    values = simulate_readings(make_tumble(), rng, 0.0, truth=LEVEL_TERMS)
    runs = tumble_runs(values)
    for i, value in enumerate(values[:2]):
        t = np.arange(1000) * 0.05
        t[600:] += 3.0
        current = 1.25 * (value + rng.normal(0.0, 1e-5, t.size))
        if i:
            current[::16] = 900.0
        else:
            current[400] = 900.0
            t, current = np.insert(t, 300, t[299]), np.insert(current, 300, current[299])
            current[500] = np.nan
        write_record(tmp_path / f"r{i}.csv", t, current)
        given = f'reading = "{float(1.25 * value)!r}{format_uncertainty(SIGMA)} mA"'
        runs = runs.replace(given, f'record = "r{i}.csv"', 1)
    column = 'specific_force = { column = "mA", unit = "mA" }\n'
    records = '[records]\ntime = { column = "t", unit = "s" }\n'
    text = HEAD + column + records + model_section(*LEVEL_TERMS) + runs
    (tmp_path / "campaign.toml").write_text(text, encoding="utf-8")
    result = calibrate(tmp_path)
    for symbol, truth in LEVEL_TERMS.items():
        c = result.accelerometers["A"].coefficients[symbol]
        assert abs(c.value - truth) < 4.0 * c.u
    first, second, third = result.accelerometers["A"].readings[:3]
    assert first.samples == 998
    assert first.counts == {
        "rows": 1001,
        "repeated": 1,
        "empty": 1,
        "outliers": 1,
        "gaps": 1,
        "block": 1,
    }
    assert "1 repeated row was dropped." in first.notes
    assert (second.counts["outliers"], third.samples, third.counts) == (63, None, {})
    (many,) = [f for f in result.findings if f.code == "many-outliers"]
    assert many.subject == "A.tumble 1"
    assert "63 of 1000 samples were rejected as outliers" in many.text
    print_result(result, details=True)
    page = " ".join(capsys.readouterr().out.split())
    assert "tumble 0: 1 outlier in column 'mA' was rejected." in page
    assert (
        "tumble 0: 1001 rows, 1 repeated row, 1 empty cell, 1 outlier, 1 gap, 1 sample per block."
        in page
    )
    result.write(tmp_path / "result.json")
    assert Result.read(tmp_path / "result.json").accelerometers == result.accelerometers


def test_mounting_name_with_dot_raises(tmp_path):
    test = make_arm_test()
    runs = arm_runs(test, simulate_readings(test, np.random.default_rng(9), 0.0))
    assert 'mounting = "inward"' in runs
    text = (
        HEAD + model_section(*TRUTH) + runs.replace('mounting = "inward"', 'mounting = "in.ward"')
    )
    (tmp_path / "campaign.toml").write_text(text, encoding="utf-8")
    with raises("invalid-name", "mounting:", '"in.ward"'):
        calibrate(tmp_path)


def test_two_stage_method_requires_records(tmp_path, capsys):
    values = simulate_readings(make_tumble(), np.random.default_rng(8), SIGMA, truth=LEVEL_TERMS)
    write_and_calibrate(tmp_path, model_section(*LEVEL_TERMS), tumble_runs(values))
    with pytest.raises(CampaignError, match="this campaign has readings"):
        calibrate(tmp_path, method="two-stage", options=TwoStageOptions())
    assert main(["calibrate", str(tmp_path), "--budget", "--details"]) == 0
    assert "tumble 11" in capsys.readouterr().out


#: Where a body's x and y point in each position; each accelerometer's input and pendulous axis.
SET_BY_HAND = (
    *(("up", "north"), ("down", "north"), ("north", "up"), ("north", "down"), ("east", "north")),
    *(("north", "east"), ("up", "east"), ("down", "west"), ("east", "up")),
)
TRIAD = {"X": ("east", "down"), "Z": ("up", "east")}
DIRECTIONS = {"east": (1, 0, 0), "north": (0, 1, 0), "up": (0, 0, 1)}
OPPOSITE = {"west": "east", "south": "north", "down": "up"}


def direction_vector(name):
    return (
        -direction_vector(OPPOSITE[name]) if name in OPPOSITE else np.array(DIRECTIONS[name], float)
    )


def calibrate_hand_set_positions(folder, repeats, sigma, setting_sd, seed):
    """Calibrate X and Z of one body in positions that are off; return result, dense u and truth.

    The dense covariance is that of plain least squares with what two turns of each position have in
    common; of the readings themselves all is exact.
    """
    rng = np.random.default_rng(seed)
    truth = {"X": (0.002, 1.0005, 3e-4, -2e-4), "Z": (0.003, 1.001, 1e-4, 0.0)}
    tables = [
        'schema = 1\nsite = { gravity = "9.8066 m/s^2", latitude = "45.75 deg" }\n'
        f'[fixture]\nposition = "0 ± {math.degrees(setting_sd)!r} deg"\n[model]\nassume = "all"\n'
        'terms = ["K_F", "K_I", "delta_O", "delta_P"]\n'
    ]
    for name, (axis, pendulous) in TRIAD.items():
        tables.append(
            f'[accelerometers.{name}]\ninput_axis = "{axis}"\npendulous_axis = "{pendulous}"\n'
            'output = { unit = "g" }\n'
        )
    rows, turns, vertical = [], [], direction_vector("up")
    for k, (x, y) in enumerate(SET_BY_HAND):
        body = np.column_stack(
            [
                direction_vector(x),
                direction_vector(y),
                np.cross(direction_vector(x), direction_vector(y)),
            ]
        )
        turn = setting_sd * np.append(rng.standard_normal(2), 0.0)
        size = np.linalg.norm(turn)
        cross = np.cross(np.eye(3), turn / size)
        off = np.eye(3) - math.sin(size) * cross + (1.0 - math.cos(size)) * cross @ cross
        for again in range(repeats):
            read = []
            for name, (axis, pendulous) in TRIAD.items():
                axes = [body @ direction_vector(axis), body @ direction_vector(pendulous)]
                axes.append(np.cross(*axes))
                felt = [vertical @ off @ ax for ax in axes]
                value = float(np.dot(truth[name], [1.0, felt[0], felt[1], -felt[2]]))
                value += sigma * float(rng.standard_normal())
                read.append(f'{name} = "{value!r} ± {sigma!r} g"')
                row = np.zeros(8)
                at = 4 * [*TRIAD].index(name)
                row[at : at + 4] = [
                    1.0,
                    *(vertical @ ax for ax in axes[:2]),
                    -(vertical @ axes[2]),
                ]
                rows.append(row)
                turned = np.zeros(2 * len(SET_BY_HAND))
                turned[2 * k : 2 * k + 2] = [
                    vertical @ np.cross(direction_vector(about), axes[0])
                    for about in ("east", "north")
                ]
                turns.append(turned)
            tables.append(
                f'[[runs]]\nname = "{x} {y} {again}"\nmotion = "static"\n'
                f'attitude = {{ x = "{x}", y = "{y}" }}\nreading = {{ {", ".join(read)} }}\n'
            )
    (folder / "campaign.toml").write_text("".join(tables), encoding="utf-8")
    design, common = np.array(rows), np.array(turns)
    covariance = sigma**2 * np.eye(len(rows)) + setting_sd**2 * common @ common.T
    u = np.sqrt(np.diag(np.linalg.inv(design.T @ np.linalg.solve(covariance, design))))
    return calibrate(folder), u, np.concatenate([truth[name] for name in TRIAD])


def estimates(result):
    coefficients = [
        result.accelerometers[name].coefficients[symbol]
        for name in TRIAD
        for symbol in ("K_F", "K_I", "delta_O", "delta_P")
    ]
    return np.array([c.value for c in coefficients]), np.array([c.u for c in coefficients])


@pytest.mark.parametrize("repeats", [1, 2])
def test_rate_errors_in_u_match_dense_covariance(tmp_path, repeats):
    result, dense, truth = calibrate_hand_set_positions(
        tmp_path, repeats, 1e-5, math.radians(0.02), 2
    )
    values, u = estimates(result)
    np.testing.assert_allclose(u, dense, rtol=3e-3)
    assert np.abs((values - truth) / u).max() < 4.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [8, 16, 23])
def test_fit_of_positions_set_to_half_degree_converges(tmp_path, seed):
    """Of an axis that points up a turn is quadratic: three of 30 such fits went to and fro."""
    result, _, truth = calibrate_hand_set_positions(tmp_path, 3, 2e-4, math.radians(0.5), seed)
    values, u = estimates(result)
    assert result.state == "good"
    assert np.abs((values - truth) / u).max() < 4.0
