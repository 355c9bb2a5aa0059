"""A forecast says both uncertainties: those that the calibration of its records will state."""

import pytest
from campaigns import SMALL, write
from reading_descriptions import on_arm

from counterspin.calibration.calibrate import calibrate
from counterspin.campaign.simulation import simulate
from counterspin.planning.page import plan_blocks
from counterspin.planning.plan import check


def test_the_second_uncertainty_is_the_calibration_s(tmp_path):
    simulate(write(tmp_path, SMALL), tmp_path)
    forecast, found = check(tmp_path), calibrate(tmp_path)
    compared = 0
    for name, planned in forecast.accelerometers.items():
        for symbol, predicted in planned.coefficients.items():
            c = found.accelerometers[name].coefficients[symbol]
            if not predicted.estimated:
                continue
            compared += 1
            assert predicted.u_typical == pytest.approx(c.u_typical, rel=0.02), symbol
            assert predicted.u_typical > predicted.u
    assert compared == 6


def test_no_plan_promises_u_alone(tmp_path):
    result = check(write(tmp_path, SMALL))
    k_ii = result.accelerometers["Qx"].coefficients["K_II"]
    assert k_ii.u_typical > 10.0 * k_ii.u
    answer = next(b.text for b in plan_blocks(result) if getattr(b, "style", "") == "answer")
    assert "(2.1 ug/g^2 with what the model leaves out at typical sizes)" in answer


READ = """schema = 1
site = { gravity = "9.80665 ± 1e-6 m/s^2", latitude = "0.8 ± 1e-6 rad" }
[centrifuge]
radius = "1.0 ± 1e-6 m"
[accelerometers.A]
input_axis = "up"
pendulous_axis = "west"
MODEL
""" + "".join(
    on_arm(
        f"{side} {rate}",
        f"{rate} rad/s",
        f"{sign * rate**2 / 9.80665 + 1e-3!r} ± 2e-6 g",
        side=side,
        mounting=side,
    )
    for side, sign in (("inward", 1.0), ("outward", -1.0))
    for rate in (3.0, -3.0, 7.0, -7.0, 10.0, -10.0, 14.0)
)


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return calibrate(write(tmp_path_factory.mktemp("plain"), READ.replace("MODEL", "")))


def test_readings_have_the_second_uncertainty_too(plain, tmp_path):
    left_out = plain.accelerometers["A"].left_out
    assert {"K_III", "delta_O", "centrifuge.stretch", "fixture.misalignment.inward.up"} <= {
        *left_out
    }
    assert "centrifuge.radius.inward" not in left_out  # the stated radius is that of both
    priors = [
        f'"{symbol}" = "0 ± {omitted.typical!r} {omitted.unit}"'
        for symbol, omitted in left_out.items()
    ]
    model = (
        f'[model]\nassume = "all"\nterms = ["K_F", "K_I", "K_II"]\nconsidered = {list(left_out)!r}\n[model.priors]'
    ).replace("'", '"')
    text = READ.replace("MODEL", "\n".join([model, *priors]))
    full = calibrate(write(tmp_path, text))
    for symbol, c in plain.accelerometers["A"].coefficients.items():
        considered = full.accelerometers["A"].coefficients[symbol]
        assert c.u_typical == pytest.approx(considered.u, rel=1e-3), symbol
        assert c.u_typical > c.u


def test_so_has_their_forecast(plain, tmp_path):
    forecast = check(write(tmp_path, READ.replace("MODEL", "")))
    for symbol, predicted in forecast.accelerometers["A"].coefficients.items():
        c = plain.accelerometers["A"].coefficients[symbol]
        assert predicted.u_typical == pytest.approx(c.u_typical, rel=1e-3), symbol
