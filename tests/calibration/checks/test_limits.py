"""Incredible estimates, and drifts and tilts beyond first order."""

from pathlib import Path

import numpy as np
import pytest
from campaigns import SMALL, replace_parts, write_description
from reading_campaigns import make_tumble, simulate_readings
from reading_descriptions import ACCELEROMETER, format_rest_run, format_site

from counterspin import validation
from counterspin.calibration.calibrate import calibrate
from counterspin.calibration.checks.limits import check_credibility
from counterspin.calibration.result_parts import Coefficient
from counterspin.campaign.description import read_campaign
from counterspin.histories.history import history
from counterspin.simulation.simulate import simulate

SIGMA = 2e-6
TRUTH = {"K_F": 2e-3, "K_I": 1.0005, "delta_O": 3e-5}
SIGN = "the sign of the output, and the senses of the input axis and of the attitudes"


def calibrate_tumble(folder, change, *, turned=0.0, terms=tuple(TRUTH), more="", accelerometer=""):
    """Calibrate a tumble with changed indications or rotated positions, deg."""
    values = simulate_readings(make_tumble(), np.random.default_rng(1), SIGMA, truth=TRUTH)
    step = 360 / len(values)
    runs = "".join(
        format_rest_run(
            f"tumble {i}",
            f"{i * step + turned!r} deg about north",
            f"{float(1.25 * change(value))!r} ± {1.25 * SIGMA!r} mA",
        )
        for i, value in enumerate(values)
    )
    model = f"[model]\nassume = 'all'\nterms = {list(terms)}\n{more}".replace("'", '"')
    head = format_site("1.0 ± 1e-6 m", "9.80665 m/s^2", "0.8 rad") + ACCELEROMETER + accelerometer
    (folder / "campaign.toml").write_text(head + "\n" + model + runs, encoding="utf-8")
    return calibrate(folder)


def only_finding(result):
    (finding,) = [f for f in result.findings if f.code == "incredible"]
    return finding


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda g: -g, SIGN),
        (lambda g: 10.0 * g, "the unit, which may be wrong by a factor of 1e1."),
        (lambda g: 1e-3 * g, "the unit, which may be wrong by a factor of 1e-3."),
        (lambda g: -1e3 * g, f"{SIGN}, and the unit, which may be wrong by a factor of 1e3."),
        (lambda g: 9.80665 * g, "the unit: the values may be in m/s^2 instead of g."),
        (lambda g: g / 9.80665, "the unit: the values may be in m/s^2 instead of g."),
        (lambda g: 0.03 * g, "whether columns or accelerometers are swapped."),
        (
            lambda g: 1.3 * g,
            "the sensitivity, the unit of the sensitivity, and the range of the readout.",
        ),
    ],
)
def test_incredible_scale_factor_contradicts(tmp_path, change, words):
    result = calibrate_tumble(tmp_path, change)
    assert result.state == "contradicted"
    finding = only_finding(result)
    assert finding.subject == "A.K_I"
    assert finding.contradicts
    assert words in finding.text
    assert result.findings[0] == finding


def test_all_possible_causes_of_incredible_value_are_named(tmp_path):
    result = calibrate_tumble(tmp_path, lambda g: 9.9 * g, accelerometer='grade = "consumer"')
    assert (
        "Check the unit: the values may be in m/s^2 instead of g, or the unit, which may be "
        "wrong by a factor of 1e1." in only_finding(result).text
    )


def test_size_is_excess_in_standard_uncertainties(tmp_path):
    result = calibrate_tumble(tmp_path, lambda g: 1.3 * g)
    c = result.accelerometers["A"].coefficients["K_I"]
    assert only_finding(result).size == pytest.approx((c.value - 1.0 - 0.1) / c.u, rel=1e-9)


def test_incredible_bias_and_misalignment(tmp_path):
    offset = calibrate_tumble(tmp_path, lambda g: g + 0.3)
    assert only_finding(offset).subject == "A.K_F"
    assert (
        "K_F = 0.302 g is not credible, because its magnitude exceeds 0.1 g."
        in only_finding(offset).text
    )
    turned = calibrate_tumble(tmp_path, lambda g: g, turned=1.0)
    assert only_finding(turned).subject == "A.delta_O"
    assert "the zero and the sense of the attitude angles" in only_finding(turned).text
    head = calibrate_tumble(tmp_path, lambda g: g, turned=1.0, terms=("K_F", "K_I", "head.zero"))
    assert only_finding(head).subject == "head.zero"
    assert "the zero of the dividing head" in only_finding(head).text
    assert head.state == "contradicted"


def test_incredible_scale_factor_explains_other_findings(tmp_path):
    finding = only_finding(calibrate_tumble(tmp_path, lambda g: 100.0 * g))
    assert finding.subject == "A.K_I"
    assert [f.subject for f in finding.explains] == ["A.K_F"]


def test_campaign_limits_define_credible_values(tmp_path):
    for more in (
        {"more": 'limits = { K_I = "0.5 g/g" }\n'},
        {"accelerometer": 'grade = "consumer"'},
    ):
        assert calibrate_tumble(tmp_path, lambda g: 1.3 * g, **more).state == "good"
    assert calibrate_tumble(tmp_path, lambda g: 1.08 * g).state == "good"
    narrow = calibrate_tumble(tmp_path, lambda g: g, more='limits = { K_F = "1e-3 g" }\n')
    assert only_finding(narrow).subject == "A.K_F"


def make_coefficient(value, u, *, estimated=True, unit="g/g^2"):
    return Coefficient(value=value, u=u, unit=unit, estimated=estimated)


@pytest.mark.parametrize(
    ("value", "u", "estimated", "message"),
    [
        (5e-4, 1e-6, True, True),
        (-5e-4, 1e-6, True, True),
        (1.29e-4, 1e-5, True, False),  # within 3 u of the limit
        (1.31e-4, 1e-5, True, True),
        (5e-4, 1e-6, False, False),  # a prior is not an estimate
        (None, None, False, False),
    ],
)
def test_limit_must_be_exceeded_by_three_standard_uncertainties(
    tmp_path, value, u, estimated, message
):
    campaign = read_campaign(write_description(tmp_path, SMALL))
    credibility = check_credibility(
        campaign.limit_of, "Qx", {"K_II": make_coefficient(value, u, estimated=estimated)}
    )
    assert [finding.subject for finding in credibility] == ["Qx.K_II"] * message


@pytest.mark.parametrize("method", ["joint", "two-stage"])
def test_both_methods_report_incredible_value(tmp_path, method):
    larger = replace_parts(SMALL, ('K_II = "2.7e-5 g/g^2"', 'K_II = "4e-4 g/g^2"'))
    result = calibrate(simulate(read_campaign(write_description(tmp_path, larger))), method=method)
    assert only_finding(result).subject == "Qx.K_II"
    assert "the rates, the radius" in only_finding(result).text


def test_history_excludes_incredible_value(tmp_path):
    known = {"accelerometer": 'serial_number = "A1"\n', "more": "[campaign]\ndate = 2026-01-05\n"}
    (good := tmp_path / "good").mkdir()
    (wrong := tmp_path / "wrong").mkdir()
    results = [
        calibrate_tumble(good, float, **known),
        calibrate_tumble(wrong, lambda g: -g, **known),
    ]
    histories = history(results, term="K_I")
    (instrument,) = histories.instruments
    assert [round(point.value, 4) for point in instrument.points] == [1.0005]
    (left_out,) = histories.left_out
    assert "K_I = -1.0005 g/g is not credible" in left_out.reason


def test_mounting_radius_is_checked_against_stated_value():
    """2.3995 m, stated as 2.4 m ± 1 mm, beside a double turntable of 2.5 m."""
    result = calibrate(Path(validation.__file__).parent / "data" / "fits" / "mixed")
    assert result.platform["centrifuge.radius.out"].value == pytest.approx(2.3995, abs=1e-4)
    assert [finding.code for finding in result.findings] == ["gravity-latitude"]
