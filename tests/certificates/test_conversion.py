"""The uncertainty of g in SI units: the part that cancels in the conversion is removed."""

import math
from dataclasses import replace

import numpy as np
import pytest
from campaigns import SMALL, replace_parts, write_description
from reading_descriptions import ACCELEROMETER, format_arm_run, format_rest_run, format_site
from results import make_coefficient, make_qx_result

from counterspin.calibration.calibrate import calibrate
from counterspin.certificates.conversion import (
    coefficients_in_si,
    covariance,
    output_coefficients_in_si,
)
from counterspin.simulation.simulate import simulate
from counterspin.units import instrument_unit_in_si, to_si

G, U_G = 9.8066, 1e-4
KNOWN = replace_parts(SMALL, ('"9.8066 m/s^2"', f'"{G} ± {U_G} m/s^2"'))


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    folder = tmp_path_factory.mktemp("gravity")
    simulate(write_description(folder, KNOWN, "plan.toml"), folder / "records")
    return folder / "records"


def si_values_at_gravity(records, folder, gravity, method):
    """Return the SI values of the same records for another assumed gravity."""
    for record in records.glob("*.csv"):
        (folder / record.name).write_bytes(record.read_bytes())
    text = replace_parts(SMALL, ('"9.8066 m/s^2"', f'"{gravity!r} m/s^2"'))
    calibration = calibrate(write_description(folder, text).parent, method=method)
    return {
        symbol: to_si(estimate.value, estimate.unit, gravity)
        for symbol, estimate in calibration.accelerometers["Qx"].coefficients.items()
        if estimate.estimated
    }


@pytest.mark.parametrize("method", ["joint", "two-stage"])
def test_si_uncertainty_matches_effect_of_gravity_change(records, tmp_path, method):
    calibration = calibrate(records, method=method)
    qx = calibration.accelerometers["Qx"]
    estimates = coefficients_in_si(calibration, "Qx")
    assert estimates
    step = 30.0 * U_G
    shifted_values = [
        si_values_at_gravity(records, tmp_path, G + sign * step, method) for sign in (1, -1)
    ]
    for symbol, estimate in estimates.items():
        shift = (shifted_values[0][symbol] - shifted_values[1][symbol]) / (2.0 * step) * U_G
        # Nearly all of K_F cancels: compare with the shift before the conversion.
        largest = max(abs(estimate.shift_kept), 1e-3 * estimate.u)
        assert estimate.shift == pytest.approx(shift, abs=1e-3 * largest), symbol
        c = qx.coefficients[symbol]
        in_g = to_si(c.u, c.unit, G)
        u_without_gravity = math.sqrt(max(in_g**2 - estimate.shift_kept**2, 0.0))
        assert estimate.u == pytest.approx(math.hypot(u_without_gravity, shift), rel=1e-6)
    # K_F is an acceleration over g: in SI it does not depend on u(g).
    assert abs(estimates["K_F"].shift) < 1e-6 * abs(estimates["K_F"].shift_kept)
    assert abs(estimates["K_F"].shift_kept) == pytest.approx(0.005 * U_G, rel=1e-3)


READINGS = ACCELEROMETER + "".join(
    (
        format_rest_run("up", "level", "1.2531281 ± 2e-6 mA"),
        format_rest_run("down", "180 deg about north", "-1.2480969 ± 2e-6 mA"),
        format_arm_run("in", "9.9 rad/s", "12.5064 ± 2e-6 mA", pendulous="up"),
        format_arm_run("out", "9.9 rad/s", "-12.4977 ± 2e-6 mA", side="outward", pendulous="up"),
        format_arm_run("fast", "14 rad/s", "25.0109 ± 2e-6 mA", pendulous="up"),
        '[model]\nassume = "all"\nterms = ["K_F", "K_I", "K_II"]\n',
    )
)


def calibrate_readings(folder, gravity):
    text = format_site("1.0 ± 1e-7 m", f"{gravity} m/s^2") + READINGS
    return calibrate(write_description(folder, text).parent)


def test_output_unit_uncertainty_matches_effect_of_gravity_change(tmp_path):
    """Bias in A, scale factor in A/(m/s^2): 1 mA/g is 1e-3/g of it."""
    calibration = calibrate_readings(tmp_path, f"{G} ± {U_G}")
    estimates = output_coefficients_in_si(calibration, "A")
    assert {key: estimate_in_si.unit.dsi_text for key, estimate_in_si in estimates.items()} == {
        "bias": r"\ampere",
        "scale_factor": r"\metre\tothe{-1}\second\tothe{2}\ampere",
    }
    step = 30.0 * U_G
    values_above, values_below = (
        calibrate_readings(tmp_path, f"{G + sign * step!r} ± {U_G}").accelerometers["A"].output
        for sign in (1, -1)
    )
    for key, power in (("bias", 0), ("scale_factor", -1)):
        c, estimate = calibration.accelerometers["A"].output[key], estimates[key]
        assert estimate.value == pytest.approx(1e-3 * c.value * G**power, rel=1e-14)
        high, low = (
            values_above[key].value * (G + step) ** power,
            values_below[key].value * (G - step) ** power,
        )
        shift = 1e-3 * (high - low) / (2.0 * step) * U_G
        largest = max(abs(estimate.shift_kept), 1e-3 * estimate.u)
        assert estimate.shift == pytest.approx(shift, abs=2e-3 * largest), key
        u_without_gravity = math.sqrt(
            max((1e-3 * c.u * G**power) ** 2 - estimate.shift_kept**2, 0.0)
        )
        assert estimate.u == pytest.approx(math.hypot(u_without_gravity, shift), rel=1e-4)


@pytest.mark.parametrize(
    ("unit", "factor", "text", "power"),
    [
        ("mV/g", 1e-3, r"\metre\tothe{-1}\second\tothe{2}\volt", -1),
        ("count", 1.0, r"\one", 0),
        ("pulse/s", 1.0, r"\second\tothe{-1}", 0),
        ("kHz/g", 1e3, r"\metre\tothe{-1}\second", -1),
        ("mg", 1e-3, r"\metre\second\tothe{-2}", 1),
        ("V/mA", 1e3, r"\ampere\tothe{-1}\volt", 0),
    ],
)
def test_output_units_in_si(unit, factor, text, power):
    si_factor, dsi_unit, gravity_power = instrument_unit_in_si(unit)
    assert (si_factor, dsi_unit.dsi_text, gravity_power) == (
        pytest.approx(factor, rel=1e-15),
        text,
        power,
    )


@pytest.mark.parametrize("unit", ["V/Hz^0.5", "mV/K", "furlong"])
def test_rejects_output_units_unknown_to_si(unit):
    with pytest.raises(ValueError, match=r"unit|integer powers"):
        instrument_unit_in_si(unit)


def test_covariance_is_converted(records):
    calibration = calibrate(records)
    qx, estimates = calibration.accelerometers["Qx"], coefficients_in_si(calibration, "Qx")
    symbols = list(estimates)
    matrix = np.array(
        [
            [
                covariance(qx.correlation, estimates, symbol, other_symbol)
                for other_symbol in symbols
            ]
            for symbol in symbols
        ]
    )
    assert np.array_equal(matrix, matrix.T)
    assert np.linalg.eigvalsh(matrix / np.outer(*2 * [np.sqrt(np.diag(matrix))])).min() > 0.0
    assert np.diag(matrix) == pytest.approx(
        [estimate.u**2 for estimate in estimates.values()], rel=1e-12
    )
    # With u(g) = 0 the correlations equal those of the result.
    exact = calibration.model_copy(
        update={"inputs": calibration.inputs.model_copy(update={"u_gravity": 0.0})}
    )
    exact_estimates = coefficients_in_si(exact, "Qx")
    i, j = (qx.correlation.terms.index(symbol) for symbol in ("K_F", "K_II"))
    k_f_k_ii_covariance = covariance(qx.correlation, exact_estimates, "K_F", "K_II")
    assert k_f_k_ii_covariance == qx.correlation.matrix[max(i, j)][min(i, j)] * (
        exact_estimates["K_F"].u * exact_estimates["K_II"].u
    )
    assert all(
        replace(estimate, u=estimate.u_without_g) == estimate
        for estimate in exact_estimates.values()
    )


def test_degrees_of_freedom_without_cancelled_gravity():
    # Half of u^2 of K_F comes from g and cancels: -K_F/g per m/s^2.
    u_gravity = 1e-6 * math.sqrt(0.5) / (0.005 / 9.8)
    line = {
        "source": "site.gravity",
        "kind": "stated",
        "u": u_gravity,
        "unit": "m/s^2",
        "share": 0.5,
    }
    line |= {"sensitivity": -0.005 / 9.8, "contribution": 1e-6 * math.sqrt(0.5)}
    coefficients = {"K_F": make_coefficient(0.005, 1e-6, "g", dof=100.0)}
    calibration = make_qx_result(coefficients=coefficients, budget={"K_F": [line]})
    inputs = calibration.inputs.model_copy(update={"u_gravity": u_gravity})
    estimate = coefficients_in_si(calibration.model_copy(update={"inputs": inputs}), "Qx")["K_F"]
    assert estimate.u == pytest.approx(9.8e-6 * math.sqrt(0.5))
    assert estimate.dof == pytest.approx(25.0)


def test_exact_gravity_leaves_uncertainty_unchanged():
    calibration = make_qx_result()
    for symbol, estimate in coefficients_in_si(calibration, "Qx").items():
        c = calibration.accelerometers["Qx"].coefficients[symbol]
        assert estimate.u == to_si(c.u, c.unit, 9.8)
        assert estimate.dof == c.dof
