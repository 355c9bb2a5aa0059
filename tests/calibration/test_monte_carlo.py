"""Coverage intervals by Monte Carlo against closed forms, and priors with a distribution."""

import json
import math

import numpy as np
import pytest
from scipy import stats

import counterspin as cs
from counterspin.calibration.monte_carlo import (
    _distributions_by_source,
    draw_errors,
    make_interval,
    shortest_interval,
)
from counterspin.calibration.result_parts import Coefficient
from counterspin.campaign.distribution import parse_prior
from counterspin.campaign.quantity import InputDistribution
from counterspin.errors import CampaignError
from counterspin.inference.joint.summary import BudgetLine
from counterspin.inference.mixture_distribution import estimated_part_dof, mixture_dof

TRIALS = 200_000
#: Relative standard deviation of a 2.5 % quantile of TRIALS normal draws.
QUANTILE_SD = math.sqrt(0.025 * 0.975 / TRIALS) / stats.norm.pdf(1.96)


def make_line(source, contribution, kind="stated"):
    return BudgetLine(source, kind, contribution, "g", 1.0, contribution, 0.5)


def make_coefficient(u, dof=None):
    return Coefficient(value=3.0, u=u, dof=dof, unit="g", estimated=True)


def draw_coefficient(lines, shapes=None, dof=None, trials=TRIALS):
    u = math.sqrt(sum(item.contribution**2 for item in lines))
    of = make_coefficient(u, dof)
    errors = draw_errors(lines, of, shapes or {}, trials, np.random.default_rng(1), {})
    return errors, make_interval(errors, of)


@pytest.mark.parametrize(
    ("shape", "half_width"),
    [
        ("rectangular", 0.95 * math.sqrt(3.0)),
        ("triangular", math.sqrt(6.0) * (1.0 - math.sqrt(0.05))),
        ("arcsine", math.sqrt(2.0) * math.sin(0.475 * math.pi)),
    ],
)
def test_interval_of_dominant_bounded_input(shape, half_width):
    """Compare with the distribution function; the GUM interval 1.96 u is not validated."""
    errors, interval = draw_coefficient(
        [make_line("K_PP", 1.0)], {"K_PP": InputDistribution(shape)}
    )
    assert errors.std() == pytest.approx(1.0, abs=0.01)
    assert [interval.low, interval.high] == pytest.approx(
        [3.0 - half_width, 3.0 + half_width], abs=0.02
    )
    assert interval.gum_validated is (abs(half_width - 1.96) < interval.tolerance)


def test_interval_of_rectangular_input_covers_95_percent():
    """200,000 true errors from the same limits; the GUM interval 1.96 u = 1.13 a covers all."""
    _, interval = draw_coefficient(
        [make_line("K_PP", 1.0)], {"K_PP": InputDistribution("rectangular")}
    )
    truths = np.random.default_rng(2).uniform(-math.sqrt(3.0), math.sqrt(3.0), TRIALS)
    covered = np.mean((interval.low - 3.0 <= truths) & (truths <= interval.high - 3.0))
    assert covered == pytest.approx(0.95, abs=5.0 * math.sqrt(0.05 * 0.95 / TRIALS) * math.sqrt(2))
    assert np.abs(truths).max() < 1.96


def test_held_prior_is_drawn_from_stated_distribution():
    errors, _ = draw_coefficient(
        [make_line("K_PP", 1.0, "held")], {"K_PP": InputDistribution("rectangular")}
    )
    assert np.abs(errors).max() <= math.sqrt(3.0)


def test_normal_inputs_validate_gum_interval():
    _, interval = draw_coefficient([make_line("a", 0.6), make_line("noise of A", 0.8, "noise")])
    half_width = stats.norm.ppf(0.975)
    assert interval.u == pytest.approx(1.0, abs=4.0 / math.sqrt(2 * TRIALS))
    assert interval.high - interval.low == pytest.approx(2.0 * half_width, abs=20 * QUANTILE_SD)
    assert interval.gum_validated is True


def test_estimated_noise_is_drawn_from_student_t():
    errors, interval = draw_coefficient([make_line("noise of A", 1.0, "noise")], dof=5.0)
    assert stats.kstest(errors, stats.t(5.0).cdf).pvalue > 1e-3
    assert interval.gum_validated is not False  # the GUM interval is that of Student's t


@pytest.mark.parametrize(("share", "noise_dof"), [(0.1, 3.0), (0.4, 3.0), (0.9, 5.0)])
def test_noise_with_few_degrees_of_freedom_and_known_part(share, noise_dof):
    """u has the effective degrees of freedom; draws use those of the noise alone."""
    dof = mixture_dof(share, noise_dof)
    assert estimated_part_dof(share, dof) == pytest.approx(noise_dof, rel=1e-3)
    lines = [
        make_line("K_PP", math.sqrt(1.0 - share)),
        make_line("noise of A", math.sqrt(share), "noise"),
    ]
    errors, interval = draw_coefficient(lines, dof=dof)
    # The variance of Student's t of 3 degrees of freedom is 3.
    variance = 1.0 - share + share * noise_dof / (noise_dof - 2.0)
    assert errors.std() == pytest.approx(math.sqrt(variance), rel=0.05)
    assert interval.gum_validated is not False


def test_stated_t_distribution_has_heavy_tails():
    errors, interval = draw_coefficient(
        [make_line("K_PP", 1.0)], {"K_PP": InputDistribution("t", 4.0)}
    )
    assert stats.kstest(errors, stats.t(4.0).cdf).pvalue > 1e-3
    assert interval.gum_validated is False


def test_shortest_interval_of_exponential_sample_starts_at_zero():
    """For an exponential distribution the interval is from 0 to ln 20 = 2.996."""
    low, high = shortest_interval(np.random.default_rng(4).exponential(size=TRIALS))
    assert low == pytest.approx(0.0, abs=5e-3)
    assert high == pytest.approx(math.log(20.0), abs=0.05)


@pytest.mark.parametrize(
    ("table", "u", "shape"),
    [
        ("0 ± 2 ug/g^2", 2e-6, "normal"),
        ({"value": "0 ug/g^2", "u": "2 ug/g^2"}, 2e-6, "normal"),
        ({"value": "0 ug/g^2", "u": "2 ug/g^2", "dof": 4}, 2e-6, "t"),
        ({"value": "0 ug/g^2", "U": "4 ug/g^2", "k": 2}, 2e-6, "normal"),
        (
            {"value": "0 ug/g^2", "half_width": "3 ug/g^2", "distribution": "rectangular"},
            3e-6 / math.sqrt(3.0),
            "rectangular",
        ),
        (
            {"value": "0 ug/g^2", "half_width": "3 ug/g^2", "distribution": "arcsine"},
            3e-6 / math.sqrt(2.0),
            "arcsine",
        ),
    ],
)
def test_prior_forms_have_expected_u(table, u, shape):
    prior = parse_prior(table, "g/g^2", gravity=None)
    assert prior.u == pytest.approx(u, rel=1e-12)
    assert prior.distribution.shape == shape
    again = parse_prior(prior.document, "g/g^2", gravity=None)
    assert again.u == pytest.approx(u, rel=1e-12)
    assert again.distribution == prior.distribution


CAMPAIGN = """schema = 1
site = {{ gravity = "9.8 m/s^2", latitude = "45 deg" }}
[accelerometers.A]
input_axis = "up"
pendulous_axis = "west"
[model]
terms = ["K_F", "K_I", "K_II", "delta_O"]
assume = "all"
[model.priors]
{prior}
"""
RUNS = "".join(
    f'[[runs]]\nname = "p{angle}"\nmotion = "static"\nattitude = "{angle} deg about north"\n'
    f'reading = "{math.cos(math.radians(angle)) + 1e-6 * (-1) ** angle:.7f} ± 1e-6 g"\n'
    for angle in range(0, 360, 45)
)
LIMITS = '{ value = "0 g/g^2", half_width = "2e-5 g/g^2", distribution = "rectangular" }'


@pytest.mark.parametrize("key", ["K_PP", "A.K_PP", '"A.K_PP"'])
def test_calibration_draws_from_priors(tmp_path, capsys, key):
    text = CAMPAIGN.format(prior=f"{key} = {LIMITS}") + RUNS
    (tmp_path / "campaign.toml").write_text(text, encoding="utf-8")
    result = cs.calibrate(tmp_path, monte_carlo=100_000)
    k_ii = result.accelerometers["A"].monte_carlo["K_II"]
    assert k_ii.high - k_ii.low == pytest.approx(2 * 0.95 * 2e-5, rel=0.03)
    assert k_ii.gum_validated is False
    assert result.provenance.options[-1] == "--monte-carlo=100000"
    result.write(tmp_path / "r.json")
    kept = json.loads((tmp_path / "r.json").read_text("utf-8"))["accelerometers"]["A"]
    assert kept["monte_carlo"]["K_II"]["trials"] == 100_000


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        ('K_PP = { value = "0 g/g^2" }', "give value with u"),
        ('K_PP = { value = "0 g/g^2", u = "1e-6 g/g^2", k = 2 }', "give value with u"),
        (f"K_PP = {LIMITS.replace('rectangular', 'square')}", "'square' is not one of rectangular"),
        (f"K_PP = {LIMITS.replace('2e-5', '0')}", "half_width must be greater than zero"),
        ('K_PP = { value = "0 g/g^2", u = "1e-6 g/g^2", dof = "4" }', "dof must be a number"),
        ('K_PP = { value = "0 g/g^2", u = "1e-6 g/g^2", dof = 0.01 }', "dof is 0.01"),
        ('K_PP = { value = "0 g/g^2", u = "1e-6 g/g^2", dof = inf }', "dof is inf"),
        ('K_PP = { u = "1e-6 g/g^2" }', "give value with u"),
        (
            "K_PP = { value = '0 g/g^2', half_width = '1e-6 g/g^2', distribution = ['arcsine'] }",
            "is not one of rectangular",
        ),
    ],
)
def test_invalid_prior_table_is_named(tmp_path, prior, message):
    (tmp_path / "campaign.toml").write_text(CAMPAIGN.format(prior=prior) + RUNS, encoding="utf-8")
    with pytest.raises(CampaignError, match=message) as caught:
        cs.calibrate(tmp_path)
    assert "model.priors" in str(caught.value)


@pytest.mark.parametrize("trials", [1, 9_999, 10_000_001])
def test_rejects_invalid_number_of_trials(tmp_path, trials):
    with pytest.raises(CampaignError, match="10000 to 10000000 trials"):
        cs.calibrate(tmp_path, monte_carlo=trials)


def test_run_and_common_terms_are_drawn_by_symbol():
    """Budgets name a tilt with its run, and terms of the accelerometer without its name."""
    lines = [make_line(source, 0.1) for source in ("run1.platform.tilt.east", "K_PP", "Qy.K_PP")]
    limited = InputDistribution("rectangular")
    stated = {"platform.tilt.east": limited, "Qx.K_PP": limited}
    sources = [item.source for item in lines]
    assert list(_distributions_by_source(stated, sources, "Qx", {"run1"})) == [
        "run1.platform.tilt.east",
        "K_PP",
    ]
    assert list(_distributions_by_source(stated, sources, "Qy", {"run1"})) == [
        "run1.platform.tilt.east"
    ]


ARM = """schema = 1
site = {{ gravity = {gravity}, latitude = "45 deg" }}
centrifuge = {{ radius = {radius} }}
[accelerometers.A]
input_axis = "{axis}"
pendulous_axis = "up"
[model]
terms = ["K_F", "K_I"]
assume = "all"
"""


def make_arm_runs():
    """Return readings of a perfect accelerometer at 1 m, inward, in m/s^2."""
    for number, rate in enumerate((3.0, 6.0, 9.0, 12.0)):
        yield (
            f'[[runs]]\nname = "r{number}"\nmotion = "arm"\nrate = "{rate} rad/s"\n'
            f'axes = {{ input = "inward", pendulous = "up" }}\n'
            f'reading = "{rate**2 / 9.8:.9f} ± 1e-9 g"\n'
        )


def limited_quantity(value, half_width, unit, shape="rectangular"):
    return (
        f'{{ value = "{value} {unit}", half_width = "{half_width} {unit}", '
        f'distribution = "{shape}" }}'
    )


@pytest.mark.parametrize(
    ("gravity", "radius", "relative", "width"),
    [
        ('"9.8 m/s^2"', limited_quantity(1.0, 1e-4, "m"), 1e-4, 0.95),
        (limited_quantity(9.8, 9.8e-4, "m/s^2"), '"1 m"', 1e-4, 0.95),
        # The sum of two equal rectangular distributions is triangular with twice the half-width.
        (
            limited_quantity(9.8, 9.8e-4, "m/s^2"),
            limited_quantity(1.0, 1e-4, "m"),
            2e-4,
            1.0 - math.sqrt(0.05),
        ),
        (
            '"9.8 m/s^2"',
            limited_quantity(1.0, 1e-4, "m", "arcsine"),
            1e-4,
            math.sin(0.475 * math.pi),
        ),
    ],
)
def test_site_and_centrifuge_inputs_are_drawn(tmp_path, gravity, radius, relative, width):
    """K_I is proportional to gravity over radius; all other inputs are known to 1e-9."""
    text = ARM.format(gravity=gravity, radius=radius, axis="west") + "".join(make_arm_runs())
    (tmp_path / "campaign.toml").write_text(text, encoding="utf-8")
    result = cs.calibrate(tmp_path, monte_carlo=100_000)
    drawn = result.accelerometers["A"].monte_carlo["K_I"]
    assert drawn.high - drawn.low == pytest.approx(2.0 * relative * width, rel=0.02)
    assert drawn.gum_validated is False or is_near_normal(width)


def is_near_normal(width):
    """Return whether the 95 % interval is within 3 % of a normal one (triangular)."""
    return width == 1.0 - math.sqrt(0.05)


@pytest.mark.parametrize(
    ("radius", "rate", "message"),
    [
        ('{ value = "1 m", half_width = "1 mm" }', '"3 rad/s"', "give value with u"),
        ('{ value = "1 ± 0.1 m", u = "1 mm" }', '"3 rad/s"', "value must not have an uncertainty"),
        ('"1 m"', limited_quantity(3.0, 1e-3, "rad/s"), "random errors of individual readings"),
    ],
)
def test_invalid_input_tables_are_named(tmp_path, radius, rate, message):
    text = ARM.format(gravity='"9.8 m/s^2"', radius=radius, axis="west") + "".join(make_arm_runs())
    text = text.replace('rate = "3.0 rad/s"', f"rate = {rate}")
    (tmp_path / "campaign.toml").write_text(text, encoding="utf-8")
    with pytest.raises(CampaignError, match=message):
        cs.calibrate(tmp_path)


def test_campaign_in_memory_keeps_distribution(tmp_path):
    text = ARM.format(gravity='"9.8 m/s^2"', radius=limited_quantity(1.0, 1e-4, "m"), axis="west")
    (tmp_path / "campaign.toml").write_text(text + "".join(make_arm_runs()), encoding="utf-8")
    campaign = cs.read_campaign(tmp_path)
    shorter = campaign.change({"centrifuge": {"radius": cs.Quantity(0.9, 1e-4, "m")}})
    assert shorter.radius.distribution.shape == "normal"
    again = shorter.change({"centrifuge": {"radius": campaign.radius}})
    assert again.radius == campaign.radius
