"""A forecast states the uncertainty that the calibration of its records will state."""

import math

import pytest
from campaigns import SMALL, replace_parts, write_description
from reading_descriptions import format_arm_run

from counterspin.calibration.calibrate import calibrate
from counterspin.planning.page import plan_blocks
from counterspin.planning.plan import check
from counterspin.simulation.simulate import simulate

ASSUMED = 'assume = "all"\n'


@pytest.mark.parametrize("assume", [ASSUMED, ""], ids=["all assumed", "nothing assumed"])
def test_u_matches_calibration(assume, tmp_path):
    simulate(write_description(tmp_path, replace_parts(SMALL, (ASSUMED, assume))), tmp_path)
    forecast, result = check(tmp_path), calibrate(tmp_path)
    assert forecast.assumed == result.assumed
    assert bool(result.assumed) == bool(assume)
    compared = 0
    for name, planned in forecast.accelerometers.items():
        for symbol, predicted in planned.coefficients.items():
            c = result.accelerometers[name].coefficients[symbol]
            assert predicted.estimated == c.estimated, symbol
            if not predicted.estimated:
                continue
            compared += 1
            assert predicted.u == pytest.approx(c.u, rel=0.02), symbol
            for part in ("u_noise", "u_stated", "u_unstated"):
                first, second = getattr(predicted, part), getattr(c, part)
                assert first == pytest.approx(second, rel=0.02, abs=1e-3 * c.u), (symbol, part)
            square = math.hypot(predicted.u_noise, predicted.u_stated, predicted.u_unstated)
            assert predicted.u == pytest.approx(square, rel=1e-9)
    # A scale factor without ± is exact if everything is.
    assert compared == (6 if assume else 8)


def sentences(result):
    """Return what a plan's page says in paragraphs."""
    return [block.text for block in plan_blocks(result) if hasattr(block, "text")]


def test_first_lines_name_largest_contribution_and_assumptions(tmp_path):
    honest = check(write_description(tmp_path / "honest", replace_parts(SMALL, (ASSUMED, ""))))
    taken = check(write_description(tmp_path / "taken", SMALL))
    u = [r.accelerometers["Qx"].coefficients["K_II"].u for r in (honest, taken)]
    # One attitude cannot tell K_OO, 2 ug/g^2, from K_II.
    assert u[0] > 10.0 * u[1]
    assert u[0] == pytest.approx(2e-6, rel=0.1)
    _, answer, decides = sentences(honest)[:3]
    assert answer.startswith("u(K_II of Qx) = 2.")
    assert "K_OO (second-order output-axis coefficient) contributes" in decides
    assert "No uncertainty was stated for this term, so the default of 2 ug/g^2" in decides
    assert any("The plan does not fix any effect" in text for text in sentences(honest))
    assert sentences(taken)[2].startswith("u does not include the uncertainty of these terms")
    assert not any("No uncertainty was stated" in text for text in sentences(taken))


READ = """schema = 1
site = { gravity = "9.80665 ± 1e-6 m/s^2", latitude = "0.8 ± 1e-6 rad" }
[centrifuge]
radius = "1.0 ± 1e-6 m"
[accelerometers.A]
input_axis = "up"
pendulous_axis = "west"
MODEL
""" + "".join(
    format_arm_run(
        f"{side} {rate}",
        f"{rate} rad/s",
        f"{sign * rate**2 / 9.80665 + 1e-3!r} ± 2e-6 g",
        side=side,
        mounting=side,
    )
    for side, sign in (("inward", 1.0), ("outward", -1.0))
    for rate in (3.0, -3.0, 7.0, -7.0, 10.0, -10.0, 14.0)
)


@pytest.mark.parametrize("assume", [ASSUMED, ""], ids=["all assumed", "nothing assumed"])
def test_u_of_readings_matches_calibration(assume, tmp_path):
    text = READ.replace("MODEL", f'[model]\nterms = ["K_F", "K_I", "K_II"]\n{assume}')
    forecast, result = check(write_description(tmp_path, text)), calibrate(tmp_path)
    for symbol, predicted in forecast.accelerometers["A"].coefficients.items():
        c = result.accelerometers["A"].coefficients[symbol]
        assert predicted.u == pytest.approx(c.u, rel=1e-3), symbol
    sources = {line.source for line in forecast.accelerometers["A"].budget["K_II"]}
    unstated = {"K_F.heating", "K_IO"}
    assert unstated <= sources if not assume else not unstated & sources
    assert "centrifuge.radius.inward" not in sources  # the stated radius is that of both
