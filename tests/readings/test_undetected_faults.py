"""Faults that few readings do not show are stated with what they do; larger ones are found."""

import math
import re

import arm_records
import numpy as np
import polars as pl
import pytest
from campaigns import write_description
from reading_descriptions import format_arm_run, format_rest_run

import triads
from counterspin.calibration.calibrate import calibrate
from counterspin.calibration.pages.verdict import verdict_sentence
from counterspin.inference.joint.alternatives import Alternative
from counterspin.readings.patterns import REVERSED, STEP
from counterspin.readings.undetected_faults import _expected_size

SIGMA = 2e-6
PART = 0.7  #: Of a fault's stated size, which noise does not show.
HEAD = """
schema = 1
site = { gravity = "9.80665 m/s^2", latitude = "45 deg" }
centrifuge = { radius = "1.0 ± 1e-6 m" }

[accelerometers.A]
input_axis = "up"
pendulous_axis = "west"

[model]
"""
TUMBLE = f"""{HEAD}
terms = ["K_F", "K_I", "K_II", "delta_O"]
[model.priors]
"K_PP" = "0 ± 2e-6 g/g^2"
"K_OO" = "0 ± 2e-6 g/g^2"
"head.harmonic" = "0 ± 1e-7 rad"
"""
ARM = f"""{HEAD}
terms = ["K_F", "K_I", "K_II"]
assume = "all"
"""


def calibrate_tumble(folder, fault=lambda values, angles: values, seed=4, u=SIGMA):
    """Calibrate a tumble of 12 positions with a fault of its readings, both in g and rad."""
    rng, angles = np.random.default_rng(seed), np.arange(12) * math.pi / 6.0
    noise = SIGMA * rng.standard_normal(12)
    values = fault(2e-3 + np.cos(angles), angles) + noise
    runs = (
        format_rest_run(f"p{k}", f"{30 * k} deg about north", f"{value:.9f} ± {u} g")
        for k, value in enumerate(values.tolist())
    )
    return calibrate(write_description(folder, "".join([TUMBLE, *runs])).parent)


def change_range(size, where):
    level = float(where.removesuffix(" g"))
    return lambda values, angles: values * (1.0 + 1e-6 * size * (np.abs(values) > level))


def add_step(size, where):
    return lambda values, angles: values + 1e-6 * size * (np.arange(12) >= int(where[1:]))


def change_angle_scale(size, where):
    turn = math.radians(size / 3600.0) / (2.0 * math.pi)
    return lambda values, angles: values + np.cos(angles * (1.0 + turn)) - np.cos(angles)


@pytest.mark.parametrize(
    ("pattern", "fault"),
    [
        (r"a meter gain change of ([\d.]+) ppm above ([\d.]+ g)", change_range),
        (r'a bias step of ([\d.]+) ug starting at "(p\d+)"', add_step),
        (r"a head error that grows by ([\d.]+) arcsec per (revolution)", change_angle_scale),
    ],
)
def test_undetected_fault_has_stated_shift(tmp_path, pattern, fault):
    usual = calibrate_tumble(tmp_path / "usual")
    stated = usual.accelerometers["A"].unseen_faults
    (stated_clause,) = (
        match
        for clause in stated
        if (match := re.search(rf"{pattern} shifts (\w+) by ([\d.e-]+) (\S+) \(([\d.]+) ", clause))
    )
    size, where, symbol, shift, unit, times = stated_clause.groups()
    # At the size that is stated noise decides whether it is seen.
    other = calibrate_tumble(tmp_path / "other", fault(PART * float(size), where))
    assert (other.state, other.findings) == ("good", [])
    before, after = (one.accelerometers["A"].coefficients[symbol] for one in (usual, other))
    factor = 1e-6 if unit.startswith("ug") else math.radians(1 / 3600) if "arc" in unit else 1.0
    # Sizes of a change of gain and of a turn are stated to two digits.
    moved = abs(after.value - before.value) / PART
    assert moved == pytest.approx(float(shift) * factor, rel=0.05)
    assert moved / before.u == pytest.approx(float(times), rel=0.05)
    assert float(times) >= 2.0


def test_result_with_unseen_faults_is_good_with_remark(tmp_path):
    result = calibrate_tumble(tmp_path)
    a = result.accelerometers["A"]
    assert (result.state, result.findings) == ("good", [])
    assert verdict_sentence("A", a).startswith(
        "The result for A passed all checks, but the readings test only part"
    )
    assert "gain" in a.unseen_faults[0]
    (remark,) = (text for text in result.warnings if "would not reveal these faults" in text)
    assert all(clause in remark for clause in a.unseen_faults)


@pytest.mark.parametrize("u", [7.0, 1000.0])
def test_readings_that_determine_nothing_have_no_undetected_faults(tmp_path, u):
    result = calibrate_tumble(tmp_path, u=u)
    assert result.state == "not-determined"
    assert result.accelerometers["A"].unseen_faults == []


def calibrate_on_arm(folder, change, *, sense=1.0, sigma=SIGMA, head=ARM):
    """Calibrate two mountings, each at eight sizes up to 15 g; above 6 g the gain changes.

    sense: Of the stated rates; the true ones are positive.
    """
    rng, runs = np.random.default_rng(3), []
    earth = 2.0 * 7.292115e-5 * math.sin(math.radians(45.0))
    for side, sign in (("inward", 1.0), ("outward", -1.0)):
        for size in range(1, 16, 2):
            rate = math.sqrt(size * 9.80665)
            force = sign * (rate**2 + rate * earth) / 9.80665
            value = 2e-3 + force * (1.0 + change * (size > 6)) + 15e-6 * force**2
            value = f"{value + sigma * float(rng.standard_normal())!r} ± {sigma} g"
            name = f"{side} {size}"
            stated = f"{sense * rate!r} rad/s"
            runs.append(format_arm_run(name, stated, value, side=side, mounting=side))
    return calibrate(write_description(folder, "".join([head, *runs])).parent)


def test_gain_change_between_ranges_is_named(tmp_path):
    """10 ppm above 6 g: K_I takes up most of it, and the rest is ten times the noise."""
    assert calibrate_on_arm(tmp_path / "usual", 0.0).state == "good"
    (finding,) = (
        f for f in calibrate_on_arm(tmp_path / "other", 1e-5).findings if f.code == "lack-of-fit"
    )
    assert "gain that changes above 6 g" in finding.text


CUBIC = ARM.replace('"K_II"]', '"K_II", "K_III"]')


def test_wrong_sense_hidden_by_noise_is_unseen_fault(tmp_path):
    """It changes the Coriolis force only, most of which K_I and K_III take up; 60 ug of noise."""
    right = calibrate_on_arm(tmp_path / "right", 0.0, head=CUBIC, sigma=30.0 * SIGMA)
    wrong = calibrate_on_arm(tmp_path / "wrong", 0.0, head=CUBIC, sigma=30.0 * SIGMA, sense=-1.0)
    a, b = (one.accelerometers["A"] for one in (right, wrong))
    for own, other in ((a, b), (b, a)):
        (clause,) = (text for text in own.unseen_faults if "opposite to the stated sense" in text)
        match = re.search(r"shifts K_I by ([\d.e-]+) g/g \(([\d.]+) ", clause)
        shift, times = map(float, match.groups())
        moved = abs(own.coefficients["K_I"].value - other.coefficients["K_I"].value)
        assert moved == pytest.approx(shift, rel=0.05)
        assert moved / own.coefficients["K_I"].u == pytest.approx(times, rel=0.05)


@pytest.mark.parametrize("value", [-0.3, 0.6])
def test_expected_fault_size_matches_bayes_theorem(value):
    """By quadrature over the product of the prior and the likelihood."""
    typical, u = 0.8, 0.5
    size = np.linspace(-8.0, 8.0, 20_001)
    density = np.exp(-0.5 * (size / typical) ** 2 - 0.5 * ((size - value) / u) ** 2)
    expected = math.sqrt(np.sum(size**2 * density) / np.sum(density))
    step = Alternative(STEP, "A", "p5")
    assert _expected_size(step, typical, value, u) == pytest.approx(expected, rel=1e-9)
    assert _expected_size(step, typical, value, math.inf) == typical
    right, wrong = (math.exp(-0.5 * ((sense - value) / u) ** 2) for sense in (0.0, 1.0))
    sense = _expected_size(Alternative(REVERSED, "A", ""), 1.0, value, u)
    assert sense == pytest.approx(math.sqrt(wrong / (right + wrong)), rel=1e-12)


def test_visible_wrong_sense_is_named(tmp_path):
    """With a tenth of the noise."""
    right = calibrate_on_arm(tmp_path / "right", 0.0, sigma=0.1 * SIGMA, head=CUBIC)
    assert right.state == "good"
    assert not any("sense" in text for text in right.accelerometers["A"].unseen_faults)
    wrong = calibrate_on_arm(tmp_path / "wrong", 0.0, sigma=0.1 * SIGMA, head=CUBIC, sense=-1.0)
    assert wrong.state == "contradicted"
    assert "have the pattern of a rotation opposite to the stated sense" in wrong.findings[0].text


def test_step_of_accelerometer_during_poses_has_stated_shift(tmp_path):
    rng = np.random.default_rng(5)
    values = triads.compute_indications(triads.draw_directions(30, rng))
    values += 3e-4 * rng.standard_normal(values.shape)
    usual = calibrate(
        triads.write_pose_campaign(tmp_path / "usual", values, u=3e-4)
    ).accelerometers["X"]
    clause = r'step of ([\d.]+) ug starting at "reading (\d+)" shifts K_F by ([\d.]+) ug'
    size, first, shift = re.search(clause, usual.unseen_faults[0]).groups()
    values[int(first) - 1 :, 0] += PART * 1e-6 * float(size)
    other = calibrate(
        triads.write_pose_campaign(tmp_path / "other", values, u=3e-4)
    ).accelerometers["X"]
    moved = abs(other.coefficients["K_F"].value - usual.coefficients["K_F"].value) / PART
    assert moved == pytest.approx(1e-6 * float(shift), rel=0.05)


def calibrate_arm_records(folder, head, noise=2e-3):
    """Calibrate five records with the input axis inward and five with it outward."""
    rng, parts = np.random.default_rng(6), [head]
    for side in (1, -1):
        for size in (1, 4, 8, 12, 16):
            rate = math.sqrt(size * arm_records.GRAVITY / arm_records.RADIUS)
            name = f"{'in' if side > 0 else 'out'}{size}"
            record = arm_records.simulate_arm_record(rng, side, rate, noise=noise, encoder=1e-6)
            pl.DataFrame(record).write_csv(folder / f"{name}.csv")
            parts.append(arm_records.format_arm_run(name, side, rate))
    return calibrate(write_description(folder, "".join(parts)).parent)


def test_wrong_hemisphere_with_measured_sense_is_unseen_fault(tmp_path):
    """The angle shows the sense of rotation, but not the sign of the latitude."""
    head = arm_records.DESCRIPTION_HEAD
    latitude = f"{arm_records.LATITUDE} rad"
    results = []
    for name, changed_head in (
        ("right", head),
        ("wrong", head.replace(latitude, f"-{latitude}")),
    ):
        (tmp_path / name).mkdir()
        results.append(calibrate_arm_records(tmp_path / name, changed_head))
    right, wrong = (result.accelerometers["A"] for result in results)
    assert wrong.state == "good"
    for fault_list in (right.unseen_faults, wrong.unseen_faults):
        (clause,) = (text for text in fault_list if "opposite sign" in text)
        assert clause.startswith("a latitude of the opposite sign shifts ")
        symbol, times = re.search(r"shifts (\w+) by .* \(([\d.]+) u", clause).groups()
        a, b = (result.coefficients[symbol] for result in (right, wrong))
        assert abs(a.value - b.value) / a.u == pytest.approx(float(times), rel=0.1)


def test_stated_sense_and_hemisphere_are_one_fault(tmp_path):
    result = calibrate_on_arm(tmp_path, 0.0, head=CUBIC, sigma=30.0 * SIGMA)
    (clause,) = (text for text in result.accelerometers["A"].unseen_faults if "sense" in text)
    assert clause.startswith(
        "a rotation opposite to the stated sense or a latitude of the opposite sign shifts K_I by "
    )
