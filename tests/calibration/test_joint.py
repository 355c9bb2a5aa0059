"""`calibrate --method joint` on simulated campaign folders, from the files to the JSON."""

import hashlib
import json
import math
import re
import shutil

import numpy as np
import polars as pl
import pytest
from campaigns import PLACE, format_runs, replace_parts
from raising import raises
from scipy.special import stdtrit

from counterspin.calibration.calibrate import calibrate
from counterspin.calibration.options import TwoStageOptions
from counterspin.calibration.result import Result
from counterspin.campaign.description import read_campaign
from counterspin.cli import main
from counterspin.errors import CampaignError, ConvergenceError
from counterspin.simulation.simulate import simulate

BASE = f"""{PLACE}
[accelerometers.Qx]
input_axis = "east"
pendulous_axis = "down"
bias = "0.00503 ± 2e-6 g"
scale_factor = "1.00197 ± 5e-6 g/g"
displacement = {{ column = "east_m", unit = "m" }}
[accelerometers.Qy]
input_axis = "north"
pendulous_axis = "down"
displacement = {{ column = "north_m", unit = "m" }}
[noise]
displacement = "0.01 m"
[model]
assume = "all"
terms = ["K_F", "K_I", "K_II", "K_III"]
{format_runs("run1", "run2", "run3", rates=("90 deg/s", "180 deg/s", "360 deg/s"))}
[simulation]
sampling_rate = "20 Hz"
seed = 7
revolutions = 20
[truth.Qx]
K_F = "0.005031 g"
K_I = "1.001974 g/g"
K_II = "2.7e-5 g/g^2"
K_III = "3.4e-6 g/g^3"
start_offset = "0.02 m"
start_velocity = "-1e-4 m/s"
[truth.Qy]
K_F = "0.0037 g"
K_I = "0.9988 g/g"
K_II = "-3.3e-5 g/g^2"
[truth.spindle]
drift = "1e-6 1/s"
start_angle = "0.4 rad"
ripple = [{{ harmonic = 1, ratio = 5e-7, phase = "30 deg" }}]
[truth.noise]
displacement = "0.01 m"
angle = "1e-6 rad"
"""
TRUTH = {
    "Qx": {"K_F": 0.005031, "K_I": 1.001974, "K_II": 2.7e-5, "K_III": 3.4e-6},
    "Qy": {"K_F": 0.0037, "K_I": 0.9988, "K_II": -3.3e-5, "K_III": 0.0},
}


def remove_lines(text, *patterns):
    for pattern in patterns:
        text, count = re.subn(pattern, "", text, flags=re.MULTILINE)
        assert count, pattern
    return text


def simulate_folder(folder, text):
    """Return a folder with a campaign and its simulated records."""
    folder.mkdir(exist_ok=True)
    (folder / "description.toml").write_text(text, encoding="utf-8")
    simulate(read_campaign(folder / "description.toml"), folder / "records", overwrite=True)
    return folder / "records"


def k_ii_of(result, name="Qx"):
    return result.accelerometers[name].coefficients["K_II"]


def assert_true(result, truth=None, limit=3.5):
    """Assert that the true values are within the intervals and priors are unchanged."""
    for name, values in (truth or TRUTH).items():
        for symbol, value in values.items():
            coefficient = result.accelerometers[name].coefficients[symbol]
            if coefficient.estimated:
                assert abs(coefficient.value - value) < limit * coefficient.u, (name, symbol)


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    return simulate_folder(tmp_path_factory.mktemp("base"), BASE)


@pytest.fixture(scope="module")
def result(campaign):
    return calibrate(campaign)


def test_truth_is_recovered(result):
    assert_true(result)
    for name in ("Qx", "Qy"):
        accelerometer = result.accelerometers[name]
        assert k_ii_of(result, name).estimated
        assert k_ii_of(result, name).u < 1e-6
        assert accelerometer.residual.rms == pytest.approx(0.01, rel=0.05)
        assert accelerometer.residual.lack_of_fit_p > 1e-3
        assert accelerometer.residual.chi2 == pytest.approx(
            accelerometer.residual.dof, abs=4 * math.sqrt(2 * accelerometer.residual.dof)
        )
        assert not accelerometer.noise["displacement"].estimated
        assert k_ii_of(result, name).dof is None
    # Qy has no priors.
    for c in result.accelerometers["Qy"].coefficients.values():
        assert c.u_stated < 1e-9 * c.u
        assert c.u_unstated == 0.0


def test_json_follows_contract(result, campaign, tmp_path):
    result.write(tmp_path / "result.json")
    document = json.loads((tmp_path / "result.json").read_text(encoding="utf-8"))
    assert document["schema"] == 2
    assert document["method"] == "joint"
    assert document["model"] == "exact"
    assert (document["state"], document["findings"]) == ("good", [])
    assert document["accepted_misfit"] is None
    qx = document["accelerometers"]["Qx"]
    assert (qx["state"], qx["findings"]) == ("good", [])
    assert list(qx["coefficients"]) == ["K_F", "K_I", "K_II", "K_III"]
    for c in qx["coefficients"].values():
        uncertainties = {"u", "u_noise", "u_stated", "u_unstated"}
        assert set(c) == {"value", *uncertainties, "dof", "unit", "estimated"}
        assert type(c["estimated"]) is bool
        if c["estimated"]:
            parts = [c["u_noise"], c["u_stated"], c["u_unstated"]]
            assert all(type(part) is float for part in [c["value"], c["u"], *parts])
            assert c["u"] == pytest.approx(math.hypot(*parts), rel=1e-12)
            assert c["dof"] is None
    assert qx["coefficients"]["K_II"]["unit"] == "g/g^2"
    terms, matrix = qx["correlation"]["terms"], np.array(qx["correlation"]["matrix"])
    assert matrix.shape == (len(terms),) * 2
    np.testing.assert_allclose(np.diag(matrix), 1.0, rtol=1e-12)
    assert set(qx["residual"]) == {"rms", "unit", "dof", "chi2", "lack_of_fit_p"}
    assert qx["residual"]["unit"] == "m"
    assert isinstance(qx["confounded"], list)
    assert isinstance(qx["warnings"], list)
    run = document["runs"]["run1"]
    assert run["rate"] == pytest.approx(math.pi / 2, rel=1e-7)
    assert (run["rate_unit"], run["drift_unit"]) == ("rad/s", "1/s")
    assert run["drift"] == pytest.approx(1e-6, abs=1e-7)
    assert (run["samples"], run["rejected"]) == (1601, 0)
    assert isinstance(run["terms"], dict)
    for file, checksum in document["provenance"]["inputs"].items():
        digest = hashlib.sha256((campaign / file).read_bytes()).hexdigest()
        assert checksum == f"sha256:{digest}"
    assert set(document["provenance"]["inputs"]) == {
        "campaign.toml",
        "run1.csv",
        "run2.csv",
        "run3.csv",
    }
    assert Result.read(tmp_path / "result.json") == result


def test_budget_sums_to_u(result):
    for name in ("Qx", "Qy"):
        accelerometer = result.accelerometers[name]
        for symbol, lines in accelerometer.budget.items():
            whole = accelerometer.coefficients[symbol].u ** 2
            squares = math.fsum(line.contribution**2 for line in lines)
            assert squares == pytest.approx(whole, rel=1e-10)
            assert math.fsum(line.share for line in lines) == pytest.approx(1.0, abs=1e-10)
    assert result.accelerometers["Qx"].budget["K_II"][0].source == "noise of Qx"


def test_unstated_noise_is_estimated_and_marked(tmp_path):
    text = remove_lines(BASE, r'^\[noise\]\ndisplacement = "0.01 m"\n')
    calibration = calibrate(simulate_folder(tmp_path, text))
    assert_true(calibration)
    for name in ("Qx", "Qy"):
        accelerometer = calibration.accelerometers[name]
        noise = accelerometer.noise["displacement"]
        assert noise.estimated
        assert noise.value == pytest.approx(0.01, abs=5 * noise.u)
        assert noise.u == pytest.approx(0.01 / math.sqrt(2 * accelerometer.residual.dof), rel=0.05)
        assert accelerometer.residual.chi2 is None
        # An undetected walk would affect K_II more than K_I.
        assert k_ii_of(calibration, name).dof < 0.1 * accelerometer.residual.dof
        assert accelerometer.coefficients["K_III"].dof > 0.5 * accelerometer.residual.dof
        lines = {line.source: line for line in accelerometer.budget["K_II"]}
        unseen = lines[f"undetected noise of {name}"]
        assert unseen.unit == "m/s^2/Hz^0.5"
        assert lines[f"noise of {name}"].contribution ** 2 + unseen.contribution**2 == (
            pytest.approx(k_ii_of(calibration, name).u_noise ** 2, rel=1e-9)
        )
        assert accelerometer.noise["acceleration"].value == 0.0
        assert accelerometer.noise["acceleration"].estimated


def test_noisier_run_has_separate_noise(tmp_path, capsys):
    text = remove_lines(BASE, r'^\[noise\]\ndisplacement = "0.01 m"\n')
    folder = simulate_folder(tmp_path / "loud", text)
    record = folder / "run3.csv"
    rows = pl.read_csv(record, comment_prefix="#")
    shaken = np.random.default_rng(5).normal(0.0, 0.04, rows.height)
    rows.with_columns(pl.col("east_m") + shaken).write_csv(record)
    result = calibrate(read_campaign(folder / "campaign.toml"))
    sizes = result.accelerometers["Qx"].noise["displacement"].runs
    # The rows of a run determine its noise to 1/sqrt(2 x 400/2.31), 5.4 %.
    expected = {"run1": 0.01, "run2": 0.01, "run3": math.hypot(0.01, 0.04)}
    assert sizes == pytest.approx(expected, rel=4 * 0.054)
    assert not result.accelerometers["Qy"].noise["displacement"].runs
    (warning,) = [remark for remark in result.warnings if "weights each run" in remark]
    assert warning.startswith("Qx: the noise in run3 is ")
    assert result.state == "good"
    assert main(["calibrate", str(folder)]) == 0
    assert re.search(r"by run 0\.01\d* in run1", " ".join(capsys.readouterr().out.split()))
    stated = (folder / "campaign.toml").read_text() + '\n[noise]\ndisplacement = "0.01 m"\n'
    (folder / "campaign.toml").write_text(stated)
    (first,) = calibrate(read_campaign(folder / "campaign.toml")).findings
    assert (first.code, first.subject) == ("wrong-noise", "Qx")
    assert re.search(r"is [34]\.\d times the stated noise in run3, and as", first.text)
    assert first.size == pytest.approx(math.hypot(1.0, 4.0), rel=4 * 0.054)
    assert "lack-of-fit" in {below.code for below in first.explains}


def test_both_components_of_mixed_noise_are_estimated(tmp_path):
    text = replace_parts(
        BASE,
        (
            '[noise]\ndisplacement = "0.01 m"',
            '[noise]\ndisplacement = "estimate"\nacceleration = "estimate"',
        ),
        ("[truth.noise]\n", '[truth.noise]\nacceleration = "1e-4 g/Hz^0.5"\n'),
    )
    calibration = calibrate(simulate_folder(tmp_path, text))
    for name, values in TRUTH.items():
        accelerometer = calibration.accelerometers[name]
        assert accelerometer.noise["displacement"].value == pytest.approx(0.01, rel=0.1)
        walk = accelerometer.noise["acceleration"]
        assert walk.unit == "m/s^2/Hz^0.5"
        assert walk.value == pytest.approx(1e-4 * 9.8066, abs=4 * walk.u)
        if accelerometer.coefficients["K_F"].estimated:
            assert accelerometer.coefficients["K_F"].dof < 300
        assert accelerometer.coefficients["K_I"].estimated == (name == "Qy")
        for symbol, value in values.items():
            c = accelerometer.coefficients[symbol]
            if c.estimated:
                assert abs(c.value - value) < c.u * stdtrit(c.dof or 1e9, 1 - 1e-4)


def test_confounded_terms_have_no_value_and_named_combination(tmp_path):
    text = replace_parts(
        remove_lines(BASE, r"^scale_factor.*\n", r"^bias.*\n"),
        ('"K_III"]', '"K_III", "K_IP", "K_PP"]'),
    )
    calibration = calibrate(simulate_folder(tmp_path, text))
    for name in ("Qx", "Qy"):
        accelerometer = calibration.accelerometers[name]
        for symbol in ("K_IP", "K_PP"):
            c = accelerometer.coefficients[symbol]
            assert (c.estimated, c.value, c.u) == (False, None, None)
        pair = next(x for x in accelerometer.confounded if set(x.terms) == {"K_I", "K_IP"})
        assert pair.determined == "K_I - K_IP"
        assert abs(pair.value - TRUTH[name]["K_I"]) < 4 * pair.u
        assert k_ii_of(calibration, name).estimated
    sums = [x for x in calibration.accelerometers["Qx"].confounded if "K_PP" in x.terms]
    assert sums
    assert any(x.determined.startswith("K_F + K_PP") for x in sums)
    assert any("do not determine K_PP" in w for w in calibration.accelerometers["Qx"].warnings)
    assert_true(calibration)


def test_undetermined_coefficient_keeps_prior(tmp_path):
    text = replace_parts(BASE, ("1.00197 ± 5e-6 g/g", "1.00197 ± 1e-7 g/g"))
    c = calibrate(simulate_folder(tmp_path, text)).accelerometers["Qx"].coefficients["K_I"]
    assert (c.estimated, c.value, c.u) == (False, 1.00197, 1e-7)


def test_rotation_is_estimated_without_angle_and_warned(tmp_path):
    text = replace_parts(
        remove_lines(BASE, r"^angle = \{.*\n"),
        ("[truth.spindle]\n", "[truth.spindle]\nrate_error = 1e-4\n"),
        ('ripple = [{ harmonic = 1, ratio = 5e-7, phase = "30 deg" }]\n', ""),
        ('angle = "1e-6 rad"\n', ""),
    )
    calibration = calibrate(simulate_folder(tmp_path, text))
    assert any("no angle" in warning for warning in calibration.warnings)
    assert_true(calibration)
    assert k_ii_of(calibration).estimated
    for name, rate in (("run1", math.pi / 2), ("run2", math.pi), ("run3", 2 * math.pi)):
        run = calibration.runs[name]
        assert abs(run.rate - rate * (1 + 1e-4)) < 4 * run.u_rate
        assert run.u_rate < 5e-5 * rate


# Record faults ------------------------------------------------------------------------------------


@pytest.mark.parametrize("sampling", ["20 Hz", "640 Hz"], ids=["points", "blocks"])
def test_outliers_gaps_and_repeated_rows_are_counted_and_harmless(tmp_path, sampling):
    text = replace_parts(
        BASE, ('"20 Hz"', f'"{sampling}"'), ("revolutions = 20", "revolutions = 12")
    )
    folder = simulate_folder(tmp_path, text)
    rng = np.random.default_rng(3)
    planted, gaps = {}, {}
    for run in ("run1", "run2", "run3"):
        frame = pl.read_csv(folder / f"{run}.csv")
        east = frame["east_m"].to_numpy().copy()
        spikes = rng.random(east.size) < 0.005
        # 10 cm to 5 m: ten standard deviations and more
        east += spikes * np.exp(rng.uniform(math.log(0.1), math.log(5), east.size))
        keep = np.ones(east.size, dtype=bool)
        first = int(rng.integers(east.size // 3, east.size // 2))
        keep[first : first + east.size // 20] = False
        planted[run] = int((spikes & keep).sum())
        gaps[run] = 1
        frame = frame.with_columns(pl.Series("east_m", east)).filter(pl.Series(keep))
        again = frame.height // 4
        frame = pl.concat([frame[: again + 1], frame[again:]])  # one row twice
        frame.write_csv(folder / f"{run}.csv")
    calibration = calibrate(folder)
    assert_true(calibration)
    for run, count in planted.items():
        seen = calibration.runs[run].counts
        assert count <= seen["outliers"] <= count + 1 + 0.001 * seen["rows"]
        assert seen["repeated"] == 1
        assert seen["gaps"] >= 1
        assert calibration.runs[run].rejected == seen["outliers"] + seen["repeated"] + seen["empty"]
    for name in ("Qx", "Qy"):
        assert calibration.accelerometers[name].residual.rms == pytest.approx(0.01, rel=0.1)


# Uncertain inputs ---------------------------------------------------------------------------------

UNCERTAIN = replace_parts(
    BASE,
    ('radius = "2.5 m"', 'radius = "2.5 ± 1e-4 m"'),
    ('gravity = "9.8066 m/s^2"', 'gravity = "9.8066 ± 1e-3 m/s^2"'),
    ('latitude = "45.75 deg"', 'latitude = "45.75 ± 1 deg"'),
    ("[records]\n", '[records]\ntiming_offset = "0 ± 1e-4 s"\n'),
)


@pytest.fixture(scope="module")
def uncertain_inputs(tmp_path_factory):
    folder = simulate_folder(tmp_path_factory.mktemp("uncertain"), UNCERTAIN)
    return folder, calibrate(folder)


@pytest.mark.parametrize(
    ("source", "line", "other", "step"),
    [
        ("centrifuge.radius", 'radius = "2.5 ± 1e-4 m"', 'radius = "2.5001 ± 1e-4 m"', 1e-4),
        ("site.gravity", '"9.8066 ± 1e-3 m/s^2"', '"9.8076 ± 1e-3 m/s^2"', 1e-3),
        ("site.latitude", '"45.75 ± 1 deg"', '"46.75 ± 1 deg"', math.radians(1)),
        ("records.timing_offset", '"0 ± 1e-4 s"', '"1e-4 ± 1e-4 s"', 1e-4),
    ],
)
def test_budget_line_matches_change_of_estimate(
    uncertain_inputs, tmp_path, source, line, other, step
):
    folder, base = uncertain_inputs
    text = replace_parts((folder / "campaign.toml").read_text(encoding="utf-8"), (line, other))
    for record in folder.glob("*.csv"):
        (tmp_path / record.name).symlink_to(record)
    (tmp_path / "campaign.toml").write_text(text, encoding="utf-8")
    moved = calibrate(tmp_path)
    for name in ("Qx", "Qy"):
        for symbol, lines in base.accelerometers[name].budget.items():
            before = base.accelerometers[name].coefficients[symbol]
            after = moved.accelerometers[name].coefficients[symbol]
            derivative = (after.value - before.value) / step
            response = {x.source: x.sensitivity for x in lines}.get(source, 0.0)
            # Below a thousandth of u, rounding and curvature may show.
            assert derivative == pytest.approx(response, rel=0.01, abs=2e-3 * before.u / step), (
                symbol
            )
            assert before.u_stated == pytest.approx(
                math.sqrt(sum(x.contribution**2 for x in lines if x.kind == "stated")),
                rel=1e-6,
                abs=1e-6 * before.u,
            )
    # K_I and the radius are both known to 4e-5; the records add little.
    k_i = base.accelerometers["Qy"].coefficients["K_I"]
    assert 3.5e-5 < k_i.u_stated < 4e-5


# Checks of the result -----------------------------------------------------------------------------


def test_run_with_separate_error_is_named(tmp_path):
    # Without a prior of the bias two runs fit any model; four do not.
    fourth = '[[runs]]\nname = "run4"\nrate = "270 deg/s"\nrecord = "run4.csv"\n'
    text = replace_parts(BASE, ("[simulation]\n", fourth + "[simulation]\n"))
    sound = calibrate(simulate_folder(tmp_path / "sound", text))
    for name in ("Qx", "Qy"):
        assert all(abs(x.z) < 3.5 for x in sound.accelerometers[name].jackknife)
        assert not any("disagrees" in w for w in sound.accelerometers[name].warnings)
    tilted = 'record = "run3.csv"\ntruth = { tilt.north = "6 arcsec" }'
    ill = calibrate(
        simulate_folder(tmp_path / "ill", replace_parts(text, ('record = "run3.csv"', tilted)))
    )
    z = {x.run: abs(x.z) for x in ill.accelerometers["Qx"].jackknife}
    assert max(z, key=z.get) == "run3"
    assert z["run3"] > 4
    findings = [finding for finding in ill.findings if "run3" in finding.subject + finding.text]
    assert findings
    assert ill.state != "good"
    assert not any("disagrees" in w for w in ill.accelerometers["Qy"].warnings)


def test_runs_that_differ_by_held_terms_are_consistent(tmp_path):
    tilts = iter(["0.6", "-0.4", "0.5"])
    text = re.sub(
        r'(record = "run\d.csv")',
        lambda m: f'{m[1]}\ntruth = {{ tilt.north = "{next(tilts)} arcsec" }}',
        replace_parts(
            BASE,
            (
                '"K_III"]',
                '"K_III"]\nhold = ["platform.tilt.north"]\n[model.priors]\n'
                '"platform.tilt.north" = "0 ± 0.5 arcsec"',
            ),
            ('displacement = "0.01 m"', 'displacement = "0.001 m"'),
        ),
    )
    calibration = calibrate(simulate_folder(tmp_path, text))
    accelerometer = calibration.accelerometers["Qx"]
    assert_true(calibration)
    assert k_ii_of(calibration).u_stated > 3 * k_ii_of(calibration).u_noise
    assert abs(k_ii_of(calibration).value - 2.7e-5) > 3 * k_ii_of(calibration).u_noise
    assert all(abs(x.z) < 3 for x in accelerometer.jackknife)
    assert not any("disagrees" in w for w in accelerometer.warnings)
    assert abs(accelerometer.two_stage.z) < 3.5


@pytest.mark.slow
def test_two_stage_result_agrees_within_uncertainty_of_difference(tmp_path):
    z = []
    for seed in range(12):
        text = replace_parts(BASE, ("seed = 7", f"seed = {seed}"), ("0.01 m", "0.003 m"))
        calibration = calibrate(simulate_folder(tmp_path / str(seed), text))
        for name in ("Qx", "Qy"):
            comparison = calibration.accelerometers[name].two_stage
            assert comparison.difference == pytest.approx(
                comparison.value - k_ii_of(calibration, name).value, abs=1e-15
            )
            z.append(comparison.z)
    assert abs(np.sum(np.square(z)) - len(z)) < 4 * math.sqrt(2 * len(z))


def test_two_stage_comparison_is_independent_of_other_accelerometers(tmp_path):
    """Held terms shift both methods and hardly their difference."""
    text = replace_parts(
        BASE,
        (
            'terms = ["K_F", "K_I", "K_II", "K_III"]',
            'terms = ["K_F", "K_I", "K_II", "K_III"]\nconsidered = ["K_OO"]',
        ),
        ('pendulous_axis = "down"', 'pendulous_axis = "down"\nK_OO = "0 ± 1e-6 g/g^2"'),
    )
    other = r"(?s)^\[accelerometers\.Qy\]\n.*?(?=^\[)"
    both = calibrate(simulate_folder(tmp_path / "both", text)).accelerometers["Qx"].two_stage
    folder = simulate_folder(tmp_path / "alone", text)
    description = folder / "campaign.toml"
    alone_text = remove_lines(text, other, r"(?s)^\[truth\.Qy\]\n.*?(?=^\[)")
    description.write_text(alone_text, encoding="utf-8")
    alone = calibrate(folder).accelerometers["Qx"].two_stage
    assert both.u == pytest.approx(alone.u, rel=1e-6)
    assert both.u > 1e-6
    # Both are K_II + K_OO minus the same assumed K_OO.
    assert both.u_difference == pytest.approx(alone.u_difference, rel=1e-6)
    assert both.u_difference < 0.3e-6


# Observables and attitudes ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("key", "unit", "noise"),
    [
        ("velocity", "m/s", 'velocity = "1e-3 m/s"'),
        ("specific_force", "m/s^2", 'specific_force = "1e-3 m/s^2"'),
        ("specific_force", "g", 'specific_force = "1e-4 g"'),
    ],
)
def test_truth_is_recovered_from_other_observables(tmp_path, key, unit, noise):
    text = replace_parts(
        BASE,
        (
            'displacement = { column = "east_m", unit = "m" }',
            f'{key} = {{ column = "east", unit = "{unit}" }}',
        ),
        (
            'displacement = { column = "north_m", unit = "m" }',
            f'{key} = {{ column = "north", unit = "{unit}" }}',
        ),
        ('displacement = "0.01 m"', noise),
    )
    calibration = calibrate(simulate_folder(tmp_path, text))
    assert_true(calibration)
    for name in ("Qx", "Qy"):
        assert k_ii_of(calibration, name).estimated
        assert calibration.accelerometers[name].residual.lack_of_fit_p > 1e-3
        assert calibration.accelerometers[name].two_stage is None


@pytest.mark.parametrize(
    ("table", "terms", "expected"),
    [
        (
            '[truth.centrifuge]\nstretch = "5e-7 s^2/m"\nimbalance.1.cos = "20 um"\n'
            'imbalance.2.sin = "-9 um"\n',
            '"centrifuge.stretch", "centrifuge.imbalance"',
            {
                "centrifuge.stretch": 5e-7,
                "centrifuge.imbalance.1.cos": 2e-5,
                "centrifuge.imbalance.1.sin": 0.0,
                "centrifuge.imbalance.2.cos": 0.0,
                "centrifuge.imbalance.2.sin": -9e-6,
            },
        ),
        (
            '[truth.encoder]\nharmonic.1.sin = "2 arcsec"\nharmonic.2.cos = "-1 arcsec"\n',
            '"encoder.harmonic.1", "encoder.harmonic.2"',
            {
                "encoder.harmonic.1.cos": 0.0,
                "encoder.harmonic.1.sin": 2 * math.radians(1 / 3600),
                "encoder.harmonic.2.cos": -math.radians(1 / 3600),
                "encoder.harmonic.2.sin": 0.0,
            },
        ),
        (
            '[truth.platform]\ng2_sensitivity.north = "0.05 deg/h/g^2"\n',
            '"platform.g2_sensitivity.north"',
            {"platform.g2_sensitivity.north": 0.05 * math.radians(1) / 3600},
        ),
    ],
    ids=["radius", "encoder", "drift"],
)
def test_machine_errors_are_estimated_without_bias_of_coefficients(
    tmp_path, table, terms, expected
):
    text = replace_parts(
        BASE,
        (
            'displacement = { column = "east_m", unit = "m" }',
            'velocity = { column = "e", unit = "m/s" }',
        ),
        (
            'displacement = { column = "north_m", unit = "m" }',
            'velocity = { column = "n", unit = "m/s" }',
        ),
        ('displacement = "0.01 m"', 'velocity = "1e-4 m/s"'),
        ('"K_III"]', f'"K_III", {terms}]'),
        ("[truth.noise]", f"{table}[truth.noise]"),
    )
    calibration = calibrate(simulate_folder(tmp_path, text))
    assert_true(calibration)
    for symbol, value in expected.items():
        c = calibration.platform[symbol]
        assert c.estimated
        assert abs(c.value - value) < 4 * c.u, symbol
        assert value == 0.0 or abs(value) > 10 * c.u, symbol


CONDITIONS = {
    "run1": 'temperature = "19.2 degC"\ntime = "0 min"\n',
    "run2": 'temperature = "22.9 degC"\ntime = "95 min"\n',
    "run3": 'temperature = "20.4 degC"\ntime = "40 min"\n',
}


def add_conditions(*changes):
    """Return the campaign with a temperature and a time of each run."""
    stated = [
        (f'record = "{name}.csv"\n', f'record = "{name}.csv"\n{lines}')
        for name, lines in CONDITIONS.items()
    ]
    return replace_parts(BASE, *stated, *changes)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("symbol", "size", "unit"),
    [
        ("K_F.trend", 2e-8, "g/s"),
        ("K_F.temperature", 3e-5, "g/K"),
        ("K_I.temperature", -1e-3, "g/g/K"),
        ("K_F.temperature.2", 3e-5, "g/K^2"),
        ("K_II.temperature", 2e-6, "g/g^2/K"),
    ],
)
def test_slopes_are_estimated_without_bias_of_coefficients(tmp_path, symbol, size, unit):
    text = add_conditions(
        ('"K_III"]', f'"K_III", "{symbol}"]'),
        ("[truth.Qx]\n", f'[truth.Qx]\n"{symbol}" = "{size!r} {unit}"\n'),
    )
    calibration = calibrate(simulate_folder(tmp_path, text))
    assert_true(calibration)
    for name, value in (("Qx", size), ("Qy", 0.0)):
        c = calibration.accelerometers[name].coefficients[symbol]
        assert c.estimated
        assert c.unit == unit
        assert abs(c.value - value) < 4 * c.u
        assert abs(size) > 10 * c.u
    assert not calibration.platform
    # The slope is in the table of its accelerometer only.
    assert calibration.accelerometers["Qx"].correlation.terms.count(symbol) == 1
    # If neither requested nor stated, it is in u with its typical size.
    unstated = replace_parts(
        text,
        (f', "{symbol}"', ""),
        ('assume = "all"\n', f'typical = {{ {symbol} = "{abs(size)!r} {unit}" }}\n'),
    )
    unsaid = calibrate(simulate_folder(tmp_path / "unstated", unstated))
    assert_true(unsaid)
    assert symbol in {line.source for line in unsaid.accelerometers["Qx"].budget["K_II"]}


def test_both_methods_hold_heating(tmp_path):
    considered = replace_parts(
        BASE,
        (
            '"K_III"]\n',
            '"K_III"]\nhold = ["K_F.heating"]\npriors = { "K_F.heating" = "3e-6 ± 1e-6 g/g^2" }\n',
        ),
        ("[truth.Qx]\n", '[truth.Qx]\n"K_F.heating" = "3e-6 g/g^2"\n'),
        ("[truth.Qy]\n", '[truth.Qy]\n"K_F.heating" = "3e-6 g/g^2"\n'),
    )
    folder = simulate_folder(tmp_path, considered)
    calibration = calibrate(folder)
    assert_true(calibration)
    qx = calibration.accelerometers["Qx"]
    # The t^2 coefficient of K_II is half of the mean squared force: 2 of the heating.
    assert qx.coefficients["K_II"].u_stated == pytest.approx(2e-6, rel=0.01)
    (line,) = (line for line in qx.budget["K_II"] if "heating" in line.source)
    assert (line.source, line.kind) == ("K_F.heating", "held")
    assert line.unit == "g/g^2"
    assert abs(qx.two_stage.z) < 4
    two_stage = calibrate(folder, method="two-stage").accelerometers["Qx"].coefficients["K_II"]
    assert two_stage.u_stated == pytest.approx(2e-6, rel=0.01)
    assert abs(two_stage.value - qx.coefficients["K_II"].value) < 4 * two_stage.u_noise


def test_bias_walk_is_weighted_and_reported(tmp_path, capsys):
    text = replace_parts(
        BASE,
        ("[noise]\n", '[noise]\nflicker = "20 ug"\nbias_walk = "60 ug/h^0.5"\n'),
        ("[truth.noise]\n", '[truth.noise]\nflicker = "20 ug"\nbias_walk = "60 ug/h^0.5"\n'),
    )
    folder = simulate_folder(tmp_path, text)
    calibration = calibrate(folder)
    assert_true(calibration)
    steady = calibrate(
        simulate_folder(
            tmp_path / "steady", replace_parts(text, ('flicker = "20 ug"\nbias_walk', "bias_walk"))
        )
    )
    for name, accelerometer in calibration.accelerometers.items():
        assert accelerometer.two_stage is None
        assert accelerometer.residual.lack_of_fit_p > 1e-3
        flicker, walk = accelerometer.noise["flicker"], accelerometer.noise["bias_walk"]
        assert (flicker.value, flicker.unit) == (pytest.approx(20e-6 * 9.8066), "m/s^2")
        assert walk.value == pytest.approx(1e-6 * 9.8066)
        u = accelerometer.coefficients["K_F"].u
        assert u > 1.5 * steady.accelerometers[name].coefficients["K_F"].u or name == "Qx"
    assert main(["calibrate", str(folder)]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "flicker 20 ug (as given); bias walk 1 ug/s^0.5 (as given)" in shown
    with raises("method-not-applicable"):
        calibrate(folder, method="two-stage")


def test_removed_gravity_is_separate_input(tmp_path):
    """The computer removes 9.8066 m/s^2; the campaign states 9.8066 ± 1e-4."""
    upright = replace_parts(
        BASE,
        ('"north"\npendulous_axis = "down"', '"up"\npendulous_axis = "east"'),
        ('"9.8066 m/s^2"', '"9.80678 m/s^2"\nremoved_gravity = "9.8066 m/s^2"'),
        (
            'displacement = { column = "north_m", unit = "m" }\n',
            'displacement = { column = "north_m", unit = "m" }\nbias = "0.0037 ± 1e-7 g"\n'
            'K_II = "-3.3e-5 ± 1e-9 g/g^2"\nK_III = "0 ± 1e-9 g/g^3"\n',
        ),
    )
    folder = simulate_folder(tmp_path, upright)
    result_by_case = {}
    for removed in (True, False):
        text = replace_parts(upright, ("9.80678 m/s^2", "9.8066 ± 1e-4 m/s^2"))
        if not removed:
            text = replace_parts(text, ('removed_gravity = "9.8066 m/s^2"\n', ""))
        (folder / "campaign.toml").write_text(text, encoding="utf-8")
        result_by_case[removed] = calibrate(folder)
    upright_of = {r: one.accelerometers["Qy"].coefficients for r, one in result_by_case.items()}
    c, wrong = upright_of[True]["K_I"], upright_of[False]["K_I"]
    assert abs(c.value - 0.9988) < 3 * c.u
    assert c.u == pytest.approx(1e-4 / 9.8066, rel=0.1)
    assert wrong.value - 0.9988 == pytest.approx(1.8e-4 / 9.8066, rel=0.05)
    assert abs(wrong.value - 0.9988) > 10 * wrong.u
    (finding,) = (f for f in result_by_case[False].findings if f.code == "removed-gravity")
    assert "removed_gravity in [site]" in finding.text
    assert not any(f.code == "removed-gravity" for f in result_by_case[True].findings)


def test_ripple_hidden_by_encoder_noise_is_in_budget(tmp_path):
    """With the estimated rotation as exact, the error of K_II would exceed 15 u."""
    text = replace_parts(
        BASE,
        (
            'displacement = { column = "east_m", unit = "m" }',
            'specific_force = { column = "east", unit = "m/s^2" }',
        ),
        (
            'displacement = { column = "north_m", unit = "m" }',
            'specific_force = { column = "north", unit = "m/s^2" }',
        ),
        ('displacement = "0.01 m"', 'specific_force = "1e-5 m/s^2"'),
        ('angle = "1e-6 rad"', 'angle = "1e-5 rad"'),
        ("ratio = 5e-7", "ratio = 1e-6"),
    )
    calibration = calibrate(simulate_folder(tmp_path, text))
    assert calibration.runs["run3"].ripples == []
    assert_true(calibration)
    for accelerometer in calibration.accelerometers.values():
        assert set(accelerometer.coefficients) == {"K_F", "K_I", "K_II", "K_III"}
        assert not any("encoder" in symbol for symbol in accelerometer.correlation.terms)
        for symbol, lines in accelerometer.budget.items():
            squares = math.fsum(line.contribution**2 for line in lines)
            assert squares == pytest.approx(accelerometer.coefficients[symbol].u ** 2, rel=1e-10)
        lines = {line.source: line for line in accelerometer.budget["K_II"]}
        ripple = lines["run3.ripple1"]
        assert ripple.kind == "noise"
        assert ripple.unit == "rad/s"
        assert ripple.u == pytest.approx(2 * math.pi * 1e-5 * math.sqrt(2 / 401), rel=0.2)
        assert lines["run3.angle"].unit == "rad"
    assert not any("ripple" in w for w in calibration.accelerometers["Qx"].warnings)
    assert all(not run.terms for run in calibration.runs.values())


def test_three_attitudes_separate_quadratic_terms(tmp_path):
    attitudes = {"p": "level", "o": "90 deg about east", "i": "-90 deg about north"}
    runs = "".join(
        f'[[runs]]\nname = "{name}{rate}"\nrate = "{rate} deg/s"\nrecord = "{name}{rate}.csv"\n'
        f'attitude = "{attitude}"\n'
        for name, attitude in attitudes.items()
        for rate in (90, 180, 360)
    )
    text = re.sub(r"\[\[runs\]\](.|\n)*?(?=\[simulation\])", "", BASE)
    text = re.sub(r"\[accelerometers\.Qy\](.|\n)*?(?=\[noise\])", "", text)
    text = re.sub(r"\[truth\.Qy\](.|\n)*?(?=\[truth\.spindle\])", "", text)
    text = replace_parts(
        text,
        ("[simulation]\n", runs + "[simulation]\n"),
        (
            'terms = ["K_F", "K_I", "K_II", "K_III"]',
            'terms = ["K_F", "K_I", "K_II", "K_OO", "K_PP"]',
        ),
        ('K_III = "3.4e-6 g/g^3"', 'K_OO = "-8e-6 g/g^2"\nK_PP = "1.5e-5 g/g^2"'),
    )
    calibration = calibrate(simulate_folder(tmp_path, text))
    truth = {"Qx": {"K_II": 2.7e-5, "K_OO": -8e-6, "K_PP": 1.5e-5}}
    assert_true(calibration, truth)
    for symbol in truth["Qx"]:
        c = calibration.accelerometers["Qx"].coefficients[symbol]
        assert c.estimated
        assert c.u < 3e-7


def test_many_outliers_are_rejected_with_warning(campaign, result, tmp_path):
    assert not any("outliers" in warning for warning in result.warnings)
    folder = tmp_path / "stepped"
    shutil.copytree(campaign, folder)
    record = pl.read_csv(folder / "run2.csv")
    wild = pl.when(pl.int_range(pl.len()) % 10 == 0).then(5.0).otherwise(0.0)
    record.with_columns(pl.col("east_m") + wild).write_csv(folder / "run2.csv")
    (warning,) = (w for w in calibrate(folder).warnings if "outliers" in w)
    assert warning.startswith("run2: 81 of 1602 samples ")
    assert re.match(r"run2: \d+ of \d+ samples were rejected as outliers. ", warning)


def test_rejects_unknown_method_and_options_of_other_method(campaign):
    with raises("wrong-usage", "'jiont'", "joint", "two-stage"):
        calibrate(campaign, method="jiont")
    # As printed returns half of K_II: a request for it must not be ignored.
    with pytest.raises(CampaignError, match='give `method="two-stage"`'):
        calibrate(campaign, options=TwoStageOptions(model="as-printed"))
    assert main(["calibrate", str(campaign), "--model", "as-printed"]) == 2


def test_clock_jump_by_whole_revolutions_names_run(campaign, tmp_path):
    folder = tmp_path / "jumped"
    shutil.copytree(campaign, folder)
    record = pl.read_csv(folder / "run2.csv")
    # 10 s are five revolutions, so the angle does not reveal the clock error.
    late = pl.when(pl.int_range(pl.len()) >= 300).then(10.0).otherwise(0.0)
    record.with_columns(pl.col("time_s") + late).write_csv(folder / "run2.csv")
    with pytest.raises(ConvergenceError, match=r"run2 \(Q[xy]\).*: outliers were still found"):
        calibrate(folder)
