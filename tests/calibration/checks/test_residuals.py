"""Undetected noise that dominates an uncertainty, and overstated noise."""

import math
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from campaigns import PLACE, format_runs, replace_parts, write_description
from reading_descriptions import ACCELEROMETER, format_rest_run, format_site
from scipy import stats

import triads
from counterspin.calibration.accelerometer_view import AccelerometerView
from counterspin.calibration.calibrate import calibrate
from counterspin.calibration.checks.residuals import undetected_walk_remarks
from counterspin.inference.diagnostics import SIGNIFICANCE
from counterspin.simulation.simulate import simulate

SIMULATED = f"""{PLACE}
[accelerometers.Qx]
input_axis = "east"
pendulous_axis = "down"
bias = "0.005 ± 2e-6 g"
scale_factor = "1.002 ± 5e-6 g/g"
displacement = {{ column = "east", unit = "m" }}

[noise]
displacement = "0.001 m"

[model]
assume = "all"

{format_runs("slow", "middle", "fast")}
[simulation]
sampling_rate = "16 Hz"
revolutions = 20
seed = 8

[truth.Qx]
K_F = "0.005 g"
K_I = "1.002 g/g"
K_II = "2e-5 g/g^2"
"""


def make_fit_with_walk(share: float, name: str = "Qx") -> AccelerometerView:
    """Return a fit with this share of the variance of K_II from an undetected walk."""
    unknown = SimpleNamespace(owner="Qx", symbol="K_II", is_of_interest=True)
    fit = SimpleNamespace(
        model=SimpleNamespace(unknowns=[unknown]),
        solution=SimpleNamespace(u=np.array([2e-9])),
        undetected_walks={name: (1e-5, np.array([[share * 4e-18]]))},
    )
    return AccelerometerView(SimpleNamespace(campaign=None), SimpleNamespace(fit=fit), None, "Qx")


def test_dominant_undetected_walk_has_remark():
    (remark,) = undetected_walk_remarks([make_fit_with_walk(0.8)])
    assert remark.startswith("Qx: 80 % of the variance of K_II")
    assert "acceleration in [noise]" in remark


def test_small_walk_or_other_accelerometer_has_no_remark():
    assert list(undetected_walk_remarks([make_fit_with_walk(0.3)])) == []
    assert list(undetected_walk_remarks([make_fit_with_walk(0.8, name="Qy")])) == []


# Overstated noise


def overstated_noise_remarks(result):
    return [text for text in result.warnings if "the stated uncertainty of" in text]


def calibrate_tumble(folder, seed, sigma, stated, assume='["all"]'):
    """Calibrate a tumble of 12 positions whose readings scatter by `sigma`, g."""
    rng, text = np.random.default_rng(seed), ACCELEROMETER
    text += f'[model]\nassume = {assume}\nterms = ["K_F", "K_I", "delta_O"]\n'
    for angle in range(0, 360, 30):
        value = 2e-3 + math.cos(math.radians(angle)) + sigma * float(rng.standard_normal())
        value = f"{1.25 * value!r} ± {1.25 * stated!r} mA"
        text += format_rest_run(f"{angle}", f"{angle} deg about north", value)
    head = format_site("1.0 ± 1e-6 m", "9.80665 m/s^2", "0.8 rad")
    return calibrate(write_description(folder, head + text).parent)


@pytest.mark.parametrize("assume", ['["all"]', "[]"], ids=["all assumed", "nothing assumed"])
def test_overstated_uncertainty_of_readings_has_remark(tmp_path, assume):
    result = calibrate_tumble(tmp_path, 3, 2e-6, 2e-5, assume)
    (remark,) = overstated_noise_remarks(result)
    found, times = map(float, re.search(r"by ([\d.]+) ug, ([\d.]+) times", remark).groups())
    # With nine degrees of freedom the rms is within a factor of 2.2, except once in 1,000.
    assert 0.9 < found < 4.4
    assert times == pytest.approx(found / 20.0, rel=0.05)
    assert (result.state, result.findings) == ("good", [])


def test_correct_uncertainty_of_readings_has_no_remark(tmp_path):
    """The level is 1/800; more than one of 20 campaigns is below it once in 3,000."""
    every = [calibrate_tumble(tmp_path / f"{seed}", seed, 2e-6, 2e-6) for seed in range(20)]
    assert sum(bool(overstated_noise_remarks(result)) for result in every) <= 1


def test_documentation_states_false_alarm_rate_and_limit():
    page = " ".join((Path(__file__).parents[3] / "docs" / "diagnosis.md").read_text().split())
    level = SIGNIFICANCE / 4.0
    least = [f"{np.sqrt(stats.chi2.ppf(level, dof) / dof):.2f} times" for dof in (5, 20)]
    assert f"false alarm in {100.0 * level:.3f} % of good campaigns" in page
    assert (
        f"below {least[0]} the stated uncertainty. "
        f"With 20 degrees of freedom, this limit is {least[1]}" in page
    )


def test_overstated_uncertainty_of_poses_has_remark(tmp_path):
    rng = np.random.default_rng(5)
    values = triads.compute_indications(triads.draw_directions(30, rng))
    values += 3e-4 * rng.standard_normal(values.shape)
    (remark,) = overstated_noise_remarks(
        calibrate(triads.write_pose_campaign(tmp_path / "over", values, u=3e-3))
    )
    assert remark.startswith("triad: the poses at unknown attitudes scatter by ")
    assert (
        overstated_noise_remarks(
            calibrate(triads.write_pose_campaign(tmp_path / "right", values, u=3e-4))
        )
        == []
    )


def test_overstated_noise_of_strobes_is_finding(tmp_path):
    """As for records by the joint method; the finding names the observed noise."""
    simulate(write_description(tmp_path, SIMULATED), tmp_path / "made")
    campaign = tmp_path / "made" / "campaign.toml"
    right = calibrate(campaign.parent, method="two-stage")
    assert [f.code for f in right.findings if f.code == "wrong-noise"] == []
    campaign.write_text(replace_parts(campaign.read_text(), ('"0.001 m"', '"0.01 m"')))
    actual_findings = {
        method: calibrate(campaign.parent, method=method).findings
        for method in ("joint", "two-stage")
    }
    for findings in actual_findings.values():
        assert [(f.code, f.subject) for f in findings] == [("wrong-noise", "Qx")]
    joint, strobes = (findings[0].text for findings in actual_findings.values())
    shown = float(re.search(r"Noise of this size, ([\d.]+) m, would fit", joint).group(1))
    assert shown == pytest.approx(1e-3, rel=0.05)
    shown = float(re.search(r"noise: ([\d.]+) m instead of 0\.01 m", strobes).group(1))
    # Some 40 strobes: within a third.
    assert shown == pytest.approx(1e-3, rel=1 / 3)
