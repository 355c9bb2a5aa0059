"""Records of an instrument on a table on the arm with a ratio other than -1."""

import math

import numpy as np
import pytest

import counterspin as cs
from counterspin.calibration.model import make_unknowns
from counterspin.errors import CampaignError

TRUTH = {"K_F": 1e-3, "K_I": 1.001, "K_II": 2e-5, "K_III": 1e-6}
RATES = (3.0, 6.0, 9.0)


def describe(ratio, seed=1, *, mixed=False):
    """Return a campaign whose machine errors are drawn from their default priors."""
    draw = np.random.default_rng(seed).standard_normal
    arcsec = math.pi / 648000.0
    waves = draw((2, 2)) * arcsec
    ratios = [-1 if mixed and k == 1 else ratio for k in range(len(RATES))]
    return {
        "site": {"gravity": "9.8066 m/s^2", "latitude": "45.75 deg"},
        "centrifuge": {"radius": "2.5 ± 1e-5 m", "strapped": True},
        "records": {
            "time": {"column": "t", "unit": "s"},
            "angle": {"column": "angle", "unit": "rad"},
        },
        "accelerometers": {
            "A": {
                "input_axis": "east",
                "pendulous_axis": "down",
                "specific_force": {"column": "f", "unit": "g"},
            }
        },
        "noise": {"specific_force": "1e-4 g", "angle": "2e-6 rad"},
        "model": {"terms": [*TRUTH]},
        "simulation": {"sampling_rate": "100 Hz", "seed": seed},
        "truth": {
            "A": dict(
                zip(
                    TRUTH,
                    ("1e-3 g", "1.001 g/g", "2e-5 g/g^2", "1e-6 g/g^3"),
                    strict=True,
                )
            ),
            "table": {
                "lever_arm": f"{draw() * 1e-3} m",
                "axis_tilt": {
                    name: f"{draw() * 10.0 * arcsec} rad" for name in ("outward", "forward")
                },
                "harmonic": {
                    f"{n}": {"cos": f"{cos} rad", "sin": f"{sin} rad"}
                    for n, (cos, sin) in enumerate(waves.tolist(), start=1)
                },
            },
            "platform": {
                "tilt": {
                    name: f"{draw() * size * arcsec} rad"
                    for name, size in (("east", 0.5), ("north", 0.5), ("up", 10.0))
                }
            },
        },
        "runs": [
            {
                "name": f"run{k}",
                "rate": f"{rate} rad/s",
                "table_ratio": run_ratio,
                "record": f"run{k}.csv",
                "revolutions": 10,
            }
            for k, (rate, run_ratio) in enumerate(zip(RATES, ratios, strict=True))
        ],
    }


def calibrate_description(description):
    result = cs.calibrate(cs.simulate(cs.make_campaign(description)))
    return result.accelerometers["A"]


def assert_truth_is_covered(descriptions, limit):
    """Assert that z of all terms is below 4, and the sum of squares for K_II and K_III its limit.

    limit: 99.9 % quantile of chi-square with two degrees of freedom for each campaign.
    """
    squares = []
    for description in descriptions:
        accelerometer = calibrate_description(description)
        assert accelerometer.state != "contradicted"
        for symbol, value in TRUTH.items():
            coefficient = accelerometer.coefficients[symbol]
            assert coefficient.estimated
            z = (coefficient.value - value) / coefficient.u
            assert abs(z) < 4.0
            squares += [z**2] if symbol in ("K_II", "K_III") else []
    assert sum(squares) < limit


@pytest.mark.parametrize("ratio", [-2, "1/2"])
def test_coefficients_agree_with_truth(ratio):
    assert_truth_is_covered([describe(ratio, seed) for seed in range(3)], 22.5)


def test_runs_with_several_ratios_are_fitted_jointly():
    accelerometer = calibrate_description(describe(-2, mixed=True))
    coefficient = accelerometer.coefficients["K_II"]
    assert accelerometer.state == "good"
    assert abs(coefficient.value - TRUTH["K_II"]) < 4.0 * coefficient.u
    assert {"table.lever_arm", "A.table.lever_arm"} & {
        line.source for line in accelerometer.budget["K_F"]
    }


INDEXED_ANGLES = (0, 40, 90, 140, 180, 230, 270, 320)
U_ANGLE = math.radians(0.01)


def describe_indexed(seed, u_text="± 0.01 "):
    """Return a campaign with a table clamped at eight angles, at two rates."""
    description = describe(0, seed)
    errors = np.random.default_rng(100 + seed).standard_normal(2 * len(INDEXED_ANGLES)) * U_ANGLE
    description["truth"]["table"].pop("harmonic")
    description["runs"] = [
        {
            "name": f"run{k}",
            "rate": f"{6 if k % 2 else 9} rad/s",
            "table_ratio": 0,
            "attitude": f"{INDEXED_ANGLES[k // 2]} {u_text}deg about up",
            "record": f"run{k}.csv",
            "revolutions": 4,
            "truth": {"tilt": {"up": f"{error} rad"}},
        }
        for k, error in enumerate(errors.tolist())
    ]
    return description


def test_indexed_table_has_uncertain_angle_per_run():
    assert_truth_is_covered([describe_indexed(1)], 13.8)


def test_stated_uncertainty_of_table_angle_is_prior_of_run():
    stated = make_unknowns(cs.make_campaign(describe_indexed(0)))
    default = make_unknowns(cs.make_campaign(describe_indexed(0, "")))
    for unknowns, u in ((stated, U_ANGLE), (default, 10.0 * math.pi / 648000.0)):
        priors = [u.prior for u in unknowns.unknowns if u.symbol == "platform.tilt.up"]
        assert len(priors) == 2 * len(INDEXED_ANGLES)
        assert priors == [(0.0, pytest.approx(u))] * len(priors)


def remove_key(description, *path):
    *sections, key = path
    table = description
    for section in sections:
        table = table[section]
    del table[key]
    return description


def set_model(key, value):
    description = describe(-2)
    description["model"][key] = value
    return description


def set_attitude(ratio, attitude):
    description = describe(ratio)
    description["runs"][0]["attitude"] = attitude
    return description


def add_response():
    description = describe(3)
    description["accelerometers"]["A"] |= {"natural_frequency": "200 Hz", "damping": "0.7"}
    return description


def set_displacement():
    description = describe(-2)
    accelerometer = description["accelerometers"]["A"]
    del accelerometer["specific_force"]
    accelerometer["displacement"] = {"column": "f", "unit": "m"}
    del description["noise"]
    return description


@pytest.mark.parametrize(
    ("description", "message"),
    [
        (
            remove_key(describe(-2), "centrifuge", "strapped"),
            "write strapped = true in [centrifuge]",
        ),
        (remove_key(describe(0), "records", "angle"), "record the angle of the spindle"),
        (set_displacement(), "record specific_force, because displacement along a rotating axis"),
        (
            set_attitude(-1, "30 ± 0.01 deg about up"),
            "must not have an uncertainty here; state a prior for platform.tilt",
        ),
        (
            set_attitude(0, "90 ± 0.01 deg about east"),
            "must not have an uncertainty here; state a prior for platform.tilt",
        ),
        (describe("2/0"), "must be a number, or a fraction such as 1/2"),
        (add_response(), "is larger than 2; counterspin does not calculate the"),
        (describe(100), "must be between -16 and 16"),
        (set_model("terms", ["K_II", "table.lever_arm"]), "in addition to the requested terms"),
        (
            {**describe(-1), "model": {"priors": {"table.lever_arm": "0 ± 1 mm"}}},
            "affects only runs with a table_ratio other than -1",
        ),
    ],
)
def test_table_ratio_errors_state_requirement(description, message):
    with pytest.raises(CampaignError) as refused:
        cs.make_campaign(description)
    assert message in str(refused.value)
