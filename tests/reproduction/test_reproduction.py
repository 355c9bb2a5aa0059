"""``counterspin reproduce``: the values of the paper, from an independently checked simulation."""

import json

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from counterspin.reproduction.comparison import reproduce
from counterspin.reproduction.plan import (
    DRIFT_RATE,
    GRAVITY,
    RADIUS,
    RATES,
    RIPPLE_PHASE,
    RIPPLE_RATIO,
    TABLE_1,
    Reproduction,
    simulate_strobes,
)


@pytest.fixture(scope="module")
def reproduction():
    return reproduce()


@pytest.mark.parametrize(("nominal_reference", "drift"), [(False, 0.0), (True, 1e-6)])
def test_simulation_agrees_with_differential_equation(nominal_reference, drift):
    """Navigation as an independent initial value problem from Eq. 1, 2 and 7."""
    rate, phase = RATES[0], RIPPLE_PHASE
    ripple = RIPPLE_RATIO * rate

    def indicated_acceleration(t):
        nominal = rate * t + phase
        theta = (
            rate * t + drift * rate * t**2 / 2 - RIPPLE_RATIO * (np.cos(nominal) - np.cos(phase))
        )
        omega = rate * (1 + drift * t) + ripple * np.sin(nominal)
        alpha = drift * rate + ripple * rate * np.cos(nominal)
        a = -RADIUS * (omega**2 * np.cos(theta) + alpha * np.sin(theta)) / GRAVITY
        return GRAVITY * (
            TABLE_1["K_F"]
            + TABLE_1["K_I"] * a
            + TABLE_1["K_II"] * a**2
            + TABLE_1["K_III"] * a**3
            - TABLE_1["K_IP"] * a
        )

    time, error = simulate_strobes(rate, drift=drift, uses_nominal_angle=nominal_reference)
    few = 8  # strobes; more strobes take longer without new information
    solution = solve_ivp(
        lambda t, state: [state[1], indicated_acceleration(t)],
        (0.0, time[few - 1]),
        [RADIUS, 0.0],
        method="DOP853",
        t_eval=time[:few],
        rtol=1e-12,
        atol=1e-12,
    )
    # The reference at a strobe is R cos(pi/2) = 0. Displacements reach 24 m by then.
    np.testing.assert_allclose(error[:few], solution.y[0], rtol=0, atol=1e-9)


def test_rows_have_unique_keys_and_reasons(reproduction):
    keys = [row.key for row in reproduction.rows]
    assert len(set(keys)) == len(keys)
    assert all(row.why for row in reproduction.rows)


@pytest.mark.parametrize(
    ("key", "printed", "ours"),
    [
        ("sigma_b2.1", "6.62200e-05", "8.38735e-08"),
        ("sigma_b2.2", "6.58370e-05", "3.35494e-07"),
        ("sigma_b2.3", "6.67250e-05", "1.34198e-06"),
        ("sigma_k_ii.printed_b2", "3.0362e-07", "3.0355e-07"),
        ("sigma_k_ii.standard_gravity", "3.0362e-07", "3.0375e-07"),
        ("sigma_k_ii.quarter", "3.0362e-07", "6.0709e-07"),
        ("sigma_k_ii.plan_printed", "3.036e-07", "3.223e-09"),
        ("sigma_k_ii.plan_printed_weighted", "3.036e-07", "2.814e-09"),
        ("sigma_k_ii.exact", "3.036e-07", "5.312e-09"),
        ("sigma_k_ii.exact_alone", "3.036e-07", "5.230e-09"),
        ("sigma_k_ii.exact_drift", "3.036e-07", "8.270e-09"),
        ("k_ii.as_printed", "2.0000e-05", "1.0000e-05"),
        ("k_ii.exact", "2.0000e-05", "2.0000e-05"),
        ("eq5.ripple_mean", "-1.500", "0.000"),
        ("eq13.k_ii_parabola", "0.5000", "0.2500"),
        ("eq15.ripple_parabola", "-0.750", "0.000"),
        ("eq15.drift_slope", "2.00", "0.00"),
        ("eq15.drift_parabola", "0.00", "-0.50"),
        ("eq15.drift_constant", "4.00", "0.00"),
        ("eq15.radius_constant", "1.00", "-1.00"),
        ("sigma_k_ii.bound", "5.000e-07", "5.312e-09"),
        ("separation.without", "2.0000e-05", "2.0000e-05"),
        ("separation.with", "2.0000e-05", "2.0000e-05"),
        ("separation.printed_without", "2.0000e-05", "1.0000e-05"),
        ("separation.drift_separated", "2.0000e-05", "2.0000e-05"),
    ],
)
def test_row_has_printed_and_reproduced_value(reproduction, key, printed, ours):
    row = reproduction[key]
    assert (row.printed_text, row.ours_text) == (printed, ours)


def test_harmonic_constants_match_closed_forms(reproduction):
    """At the strobes: K_II R^2 w^2/(4 g), -7/9 K_III R^3 w^4/g^2, K_IP R."""
    rate = RATES[-1]
    expected = {
        "eq13.k_ii_constant": TABLE_1["K_II"] * RADIUS**2 * rate**2 / (4 * GRAVITY),
        "eq13.k_iii_constant": -7 / 9 * TABLE_1["K_III"] * RADIUS**3 * rate**4 / GRAVITY**2,
        "eq13.k_ip_constant": TABLE_1["K_IP"] * RADIUS,
    }
    for key, value in expected.items():
        # Table 2's ripple of 5e-7 is in the simulation and not in the closed forms.
        assert reproduction[key].ours == pytest.approx(value, rel=2e-5)
    # Eq. 15 prints none of the three.
    omitted = reproduction["eq15.term_constants"]
    assert omitted.printed == 0.0
    assert omitted.ours == pytest.approx(sum(expected.values()), rel=1e-6)


def test_ripple_shifts_strobes_by_constant(reproduction):
    """-K_I R (w_p/w0)(sin phi + cos phi) at the nominal strobes, no parabola."""
    expected = -RADIUS * RIPPLE_RATIO * (np.sin(RIPPLE_PHASE) + np.cos(RIPPLE_PHASE))
    assert reproduction["eq15.ripple_constant"].ours == pytest.approx(
        TABLE_1["K_I"] * expected, rel=1e-4
    )


def test_remaining_effect_of_ripple_is_product_with_k_iii(reproduction):
    """b2 of K_III is -3/4 K_III R^3 w^6 eps sin(phi)/g^2; at the fastest rate this is the total."""
    rate = RATES[-1]
    relative = (-3 * TABLE_1["K_III"] * RADIUS * rate**2 * RIPPLE_RATIO * np.sin(RIPPLE_PHASE)) / (
        GRAVITY * TABLE_1["K_II"]
    )
    departure = reproduction["separation.without"].ours / TABLE_1["K_II"] - 1
    assert departure == pytest.approx(relative, rel=0.1)


def test_second_column_absorbs_drift(reproduction):
    """-3/4 K_I R w x = -1/2 K_I R w C; K_II under drift grows as w^3 and absorbs a part."""
    taken_up = reproduction["separation.drift_as_ripple"].ours
    assert taken_up == pytest.approx(2 / 3 * DRIFT_RATE, rel=0.03)
    ignored = reproduction["separation.drift_ignored"].ours
    sigma = reproduction["sigma_k_ii.exact_alone"].ours
    assert abs(ignored - TABLE_1["K_II"]) > 0.5 * sigma


def test_json_contains_all_rows(reproduction):
    document = json.loads(reproduction.to_json())
    assert Reproduction.model_validate(document).to_json() == reproduction.to_json()
    rows = {row["key"]: row for section in document["sections"] for row in section["rows"]}
    assert set(rows) == {row.key for row in reproduction.rows}
    exact = rows["sigma_k_ii.exact"]
    assert exact["printed"] == 3.0362e-7
    assert exact["counterspin"] == reproduction["sigma_k_ii.exact"].ours
    assert exact["unit"] == "g/g^2"
    assert document["inputs"]["gravity"] == {"value": 9.8, "unit": "m/s^2"}
