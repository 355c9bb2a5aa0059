"""The noise of a campaign from a record of its accelerometers at rest."""

import hashlib
import math
from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest
from campaigns import SMALL, WITHOUT_QY, find_runs, replace_parts, write_description
from raising import raises
from recorded_campaigns import WHITE_NOISE, simulate_measured_campaign, write_static_record
from scipy.stats import f as fisher

import counterspin as cs
from counterspin.calibration.joint_problem import make_noise
from counterspin.calibration.options import TwoStageOptions
from counterspin.calibration.pages.document import full_report_blocks
from counterspin.campaign.description import read_campaign
from counterspin.errors import CampaignError
from counterspin.inference.joint.estimated_noise import noise_level_dof
from counterspin.inference.noise.model import ESTIMATE, Differences, Noise
from counterspin.planning.forecast import forecast

STATED = '[noise]\ndisplacement = "0.01 m"'
FROM = '[noise]\nfrom = "rest.csv"'


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    new_folder = tmp_path_factory.mktemp("rest")
    return write_static_record(
        simulate_measured_campaign(new_folder, tmp_path_factory.mktemp("plan"), SMALL)
    )


def block_texts(result):
    return [block.text for block in full_report_blocks(result) if hasattr(block, "text")]


def describe_noise(folder, **noise):
    """Return the campaign of Qx with another [noise] table."""
    patch = WITHOUT_QY | {"noise": {"displacement": None, **noise}}
    return read_campaign(folder).change(patch)


def test_accelerometers_have_noise_of_record_at_rest(folder):
    estimate = cs.noise(folder / "rest.csv", campaign=folder)
    noise = make_noise(
        read_campaign(folder).change({"noise": {"displacement": None, "from": "rest.csv"}})
    )
    for signal in estimate.signals:
        one = noise[signal.name]
        assert one.white == pytest.approx(signal.components["displacement"].value, rel=1e-12)
        assert one.white == pytest.approx(WHITE_NOISE[signal.column], rel=0.04)
        # The variance of v from n independent samples is 2 v^2/n, slightly increased by a drift.
        assert one.covariance[0][0] == pytest.approx(2 * one.white**4 / 4000, rel=0.1)
        # Noise undetected in the record is left to the campaign.
        assert signal.components["acceleration"].value is None
        assert one.random_walk is ESTIMATE
        assert one.flicker == one.bias_walk == 0.0
    assert noise["Qx"].white != noise["Qy"].white


def test_stated_noise_overrides_record_at_rest(folder):
    (noise,) = make_noise(
        describe_noise(
            folder, **{"from": "rest.csv", "displacement": "2 cm", "acceleration": "1 ug/Hz^0.5"}
        )
    ).values()
    assert noise.white == 0.02
    assert noise.random_walk == pytest.approx(9.8066e-6, rel=1e-12)
    assert noise.covariance == ()


def test_stated_resolution_is_part_of_white_noise(folder):
    campaign = describe_noise(folder, **{"from": "rest.csv", "quantisation": "2 cm"})
    plain = make_noise(describe_noise(folder, **{"from": "rest.csv"}))["Qx"]
    assert make_noise(campaign)["Qx"].sample_variance == pytest.approx(plain.sample_variance)


@pytest.fixture(scope="module")
def both_results(folder):
    """Return the results with the record at rest, and with its value stated."""
    campaign = describe_noise(folder, **{"from": "rest.csv", "acceleration": "0 g/Hz^0.5"})
    white = make_noise(campaign)["Qx"].white
    by_hand = describe_noise(folder, displacement=f"{white!r} m")
    return cs.calibrate(campaign), cs.calibrate(by_hand), make_noise(campaign)["Qx"]


def test_result_matches_stated_noise_with_dof_of_record(
    both_results,
):
    result, by_hand, noise = both_results
    dof = 2.0 * noise.white**4 / noise.covariance[0][0]
    first, second = (r.accelerometers["Qx"].coefficients["K_II"] for r in (result, by_hand))
    assert (first.value, first.u) == pytest.approx((second.value, second.u), rel=1e-9)
    assert second.dof is None
    assert first.dof == pytest.approx(dof, rel=0.01)
    assert 3500 < dof < 4500


def test_lack_of_fit_test_includes_uncertainty_of_noise(both_results):
    result, by_hand, noise = both_results
    dof = 2.0 * noise.white**4 / noise.covariance[0][0]
    first, second = (r.accelerometers["Qx"].residual for r in (result, by_hand))
    assert first.chi2 == pytest.approx(second.chi2, rel=1e-9)
    p = fisher.sf(first.chi2 / first.dof, first.dof, dof)
    assert first.lack_of_fit_p == pytest.approx(p, rel=1e-6)
    assert abs(first.lack_of_fit_p - 0.5) < abs(second.lack_of_fit_p - 0.5)


def test_result_names_record_of_noise(folder, both_results):
    result, _, noise = both_results
    line = result.accelerometers["Qx"].noise["displacement"]
    assert (line.value, line.record, line.estimated) == (noise.white, "rest.csv", False)
    assert line.u == pytest.approx(0.5 * math.sqrt(noise.covariance[0][0]) / noise.white)
    digest = hashlib.sha256((folder / "rest.csv").read_bytes()).hexdigest()
    assert result.provenance.inputs["rest.csv"] == f"sha256:{digest}"
    (shown,) = [text for text in block_texts(result) if text.startswith("Noise: ")]
    assert "(from rest.csv)" in shown


def test_too_small_noise_at_rest_contradicts_result(folder, tmp_path):
    quiet = tmp_path / "quiet.csv"
    frame = pl.read_csv(folder / "rest.csv")
    frame.with_columns(pl.col("east_m") * 0.5).write_csv(quiet)
    result = cs.calibrate(
        describe_noise(folder, **{"from": str(quiet), "acceleration": "0 g/Hz^0.5"})
    )
    assert any(finding.contradicts for finding in result.findings)


def test_two_stage_method_uses_record_at_rest(folder, both_results):
    _, _, noise = both_results
    campaign = describe_noise(folder, **{"from": "rest.csv", "acceleration": "0 g/Hz^0.5"})
    by_hand = describe_noise(folder, displacement=f"{noise.white!r} m")
    (first, second) = (
        cs.calibrate(c, method="two-stage", options=TwoStageOptions()).accelerometers["Qx"]
        for c in (campaign, by_hand)
    )
    k, k_by_hand = first.coefficients["K_II"], second.coefficients["K_II"]
    assert (k.value, k.u) == pytest.approx((k_by_hand.value, k_by_hand.u), rel=1e-9)
    dof = 2.0 * noise.white**4 / noise.covariance[0][0]
    assert k.dof is not None
    assert k.dof >= 0.99 * dof
    assert first.noise["displacement"].record == "rest.csv"


def test_forecast_uses_record_at_rest(folder, both_results):
    _, _, noise = both_results
    of_rest = describe_noise(folder, **{"from": "rest.csv", "acceleration": "0 g/Hz^0.5"})
    by_hand = describe_noise(folder, displacement=f"{noise.white!r} m")
    runs = [run | {"revolutions": 20} for run in find_runs(of_rest, "slow", "middle", "fast")]
    first, second = (
        forecast(c.change({"runs": runs}), sampling_rate=20.0) for c in (of_rest, by_hand)
    )
    assert first.u["Qx.K_II"] == pytest.approx(second.u["Qx.K_II"], rel=1e-12)


@pytest.mark.parametrize(
    ("observable", "unit", "order"), [("velocity", "m/s", 1), ("specific_force", "m/s^2", 0)]
)
def test_velocity_and_force_records_determine_accelerometer_noise(
    observable, unit, order, tmp_path
):
    """N is the root of a density: the standard deviation of a force over sqrt(rate)."""
    text = replace_parts(SMALL, (STATED, FROM)).replace(
        'displacement = { column = "east_m", unit = "m" }',
        f'{observable} = {{ column = "east", unit = "{unit}" }}',
    )
    text = text[: text.index("[accelerometers.Qy]")] + text[text.index("[noise]") :]
    text = text[: text.index("[simulation]")]
    rng = np.random.default_rng(3)
    force = 0.05 + 1e-3 * math.sqrt(20.0) * rng.standard_normal(20_000)
    values = force
    if order:
        values = np.cumsum(force) / 20.0 + 1e-4 * rng.standard_normal(force.size)
    frame = pl.DataFrame({"time_s": np.arange(force.size) / 20.0, "east": values})
    frame.write_csv(tmp_path / "rest.csv")
    (noise,) = make_noise(read_campaign(write_description(tmp_path, text))).values()
    assert noise.random_walk == pytest.approx(1e-3, rel=0.03)
    assert noise.covariance[1][1] == pytest.approx(2 * 1e-12 / 20_000, rel=0.3)
    assert order or noise.white == 0.0


def test_noise_level_dof_matches_dense_traces():
    """Compare with traces of dense matrices."""
    differences = Differences.from_times(np.arange(60.0), 2)
    part = SimpleNamespace(
        accelerometer="Qx", series=SimpleNamespace(differences=differences, jitter_variance=0.0)
    )
    covariance = np.zeros((4, 4))
    covariance[:2, :2] = [[0.04, -0.001], [-0.001, 1e-4]]
    noise = Noise(2.0, 0.3, covariance=tuple(map(tuple, covariance)))

    def dense_covariance(white, walk):
        bands, _ = differences.factor(white, walk)
        lower = sum(
            np.diag(band[: band.size - k], -k) for k, band in enumerate(np.atleast_2d(bands))
        )
        return lower @ lower.T

    inverse = np.linalg.inv(dense_covariance(4.0, 0.09))
    traces = np.array(
        [np.trace(inverse @ dense_covariance(*one)) for one in ((1.0, 0.0), (0.0, 1.0))]
    )
    expected = 2.0 * 58.0**2 / (traces @ covariance[:2, :2] @ traces)
    fit = SimpleNamespace(design_blocks=[part], noise={"Qx": noise})
    assert noise_level_dof(fit, "Qx") == pytest.approx(expected, rel=1e-5)


def test_written_campaign_includes_record_at_rest(folder, tmp_path):
    campaign = describe_noise(folder, **{"from": "rest.csv"})
    campaign.write(tmp_path / "inside")
    assert (tmp_path / "inside" / "rest.csv").read_bytes() == (folder / "rest.csv").read_bytes()
    far = write_static_record(tmp_path) / "rest.csv"
    describe_noise(folder, **{"from": str(far)}).write(tmp_path / "outside")
    again = read_campaign(tmp_path / "outside")
    assert again.rest == tmp_path / "outside" / "rest.csv"
    assert again.rest.read_bytes() == far.read_bytes()


def test_unusable_record_at_rest_is_named_with_key(folder, tmp_path):
    missing = describe_noise(folder, **{"from": "none.csv"})
    with raises("file-not-found", "none.csv", "(noise.from):"):
        cs.calibrate(missing)
    with raises("file-not-found", "noise.from:", "none.csv:"):
        make_noise(missing)
    pl.read_csv(folder / "rest.csv").head(20).write_csv(tmp_path / "short.csv")
    with raises("not-evaluable", "noise.from:", "short.csv", "20 samples"):
        make_noise(describe_noise(folder, **{"from": str(tmp_path / "short.csv")}))
    pl.read_csv(folder / "rest.csv").drop("east_m").write_csv(tmp_path / "other.csv")
    with raises("missing-column", "noise.from:", "other.csv", "east_m"):
        make_noise(describe_noise(folder, **{"from": str(tmp_path / "other.csv")}))


def test_rejects_invalid_record_at_rest(folder):
    with raises("conflicting-keys", "noise.from:"):
        describe_noise(folder, **{"from": "slow.csv"})
    with pytest.raises(CampaignError, match=r"noise\.from: .* does not have a supported file type"):
        describe_noise(folder, **{"from": "rest.doc"})
