"""The printed equations: implemented as printed, and sympy shows where each departs."""

import numpy as np
import pytest
import sympy as sp

from counterspin.physics import as_printed

t, s, w, R, g, C, wp = sp.symbols("t s omega R g C omega_p", positive=True)
phi = sp.symbols("phi", real=True)
small = sp.symbols("small")  # bookkeeping: marks what is first order in drift and ripple

NUMBERS = {w: 2.3, R: 2.5, g: 9.8, C: 3e-3, wp: 4e-3, phi: 0.7}
SPINDLE = {"rate": 2.3, "drift": 3e-3, "ripple": 4e-3, "phase": 0.7, "radius": 2.5}
TIMES = np.linspace(0.0, 11.0, 57)


def evaluate_numerically(expression):
    return sp.lambdify(t, expression.subs(NUMBERS), "numpy")(TIMES) * np.ones_like(TIMES)


def double_integral(integrand):
    """From zero, with zero start value and start slope."""
    once = sp.integrate(sp.expand(sp.expand_trig(integrand)).subs(t, s), (s, 0, t))
    return sp.simplify(sp.integrate(sp.expand(once).subs(t, s), (s, 0, t)))


def mean_over_turn(expression):
    return sp.simplify(
        sp.integrate(sp.expand_trig(expression), (t, 0, 2 * sp.pi / w)) * w / 2 / sp.pi
    )


def strobe(expression):
    """At omega t = pi/2 + 2 k pi: the sine is one, the cosine zero, t itself stays."""
    at_strobe = {sp.sin(w * t): 1, sp.cos(w * t): 0}
    return sp.simplify(sp.expand_trig(expression).subs(at_strobe))


# The angle of Eq. 2 to first order about omega t, and its derivatives.
angle_error = small * (C * w * t**2 / 2 - wp / w * (sp.cos(w * t + phi) - sp.cos(phi)))
angle = w * t + angle_error


def first_order(expression):
    return sp.diff(expression, small).subs(small, 0).doit()


centripetal = -2 * R * (C * w**2 * t + w * wp * sp.sin(w * t + phi))
tangential = R * (C * w + w * wp * sp.cos(w * t + phi))
projection = w**2 * R * first_order(angle)


def test_exact_east_acceleration_has_three_first_order_parts():
    exact = first_order(
        -R * (sp.diff(angle, t) ** 2 * sp.cos(angle) + sp.diff(angle, t, 2) * sp.sin(angle))
    )
    parts = centripetal * sp.cos(w * t) - tangential * sp.sin(w * t) + projection * sp.sin(w * t)
    assert sp.simplify(exact - parts) == 0


def test_eq5_reverses_tangential_sign_and_lacks_projection():
    printed = as_printed.specific_force_error(TIMES, **SPINDLE)[:, 0]
    exact = centripetal * sp.cos(w * t) - tangential * sp.sin(w * t) + projection * sp.sin(w * t)
    departure = 2 * tangential * sp.sin(w * t) - projection * sp.sin(w * t)
    np.testing.assert_allclose(printed, evaluate_numerically(exact + departure), rtol=0, atol=1e-14)


def test_eq6_lacks_only_projection():
    exact = first_order(
        -R * (sp.diff(angle, t) ** 2 * sp.sin(angle) - sp.diff(angle, t, 2) * sp.cos(angle))
    )
    printed = as_printed.specific_force_error(TIMES, **SPINDLE)[:, 1]
    np.testing.assert_allclose(
        printed, evaluate_numerically(exact + projection * sp.cos(w * t)), rtol=0, atol=1e-14
    )


def test_mean_accelerations_of_ripple_cancel():
    only_ripple = {C: 0}
    unit = R * w * wp * sp.sin(phi)
    means = [
        sp.simplify(mean_over_turn(part.subs(only_ripple)) / unit)
        for part in (
            centripetal * sp.cos(w * t),
            -tangential * sp.sin(w * t),
            projection * sp.sin(w * t),
        )
    ]
    assert means == [-1, sp.Rational(1, 2), sp.Rational(1, 2)]


def test_printed_ripple_coefficient_follows_from_eq5():
    """Half of the mean of Eq. 5 is the -3/4 of Eq. 15; one over the exact parts is zero."""
    eq5 = (centripetal * sp.cos(w * t) + tangential * sp.sin(w * t)).subs(C, 0)
    from_eq5 = mean_over_turn(eq5) / 2
    assert sp.simplify(from_eq5 + sp.Rational(3, 4) * R * w * wp * sp.sin(phi)) == 0
    column = as_printed.second_stage_columns(np.array([2.3]), 2.5, 9.8, 1.0)[0, 1]
    assert column * 4e-3 * np.sin(0.7) == pytest.approx(float(from_eq5.subs(NUMBERS)), rel=1e-14)


def test_eq14_has_quarter_where_eq15_has_three_quarters():
    """Eq. 14 has the correct sign of the tangential part, so Eq. 15 does not follow from it."""
    eq14 = (centripetal * sp.cos(w * t) - tangential * sp.sin(w * t)).subs(C, 0)
    assert sp.simplify(mean_over_turn(eq14) / 2 + R * w * wp * sp.sin(phi) / 4) == 0


def test_double_integral_of_one_half_is_quarter_of_t_squared():
    assert double_integral(sp.Rational(1, 2)) == t**2 / 4


def test_printed_k_ii_integral_departs_in_both_parts():
    exact = double_integral((R * w**2 * sp.cos(w * t) / g) ** 2 * g)
    scale = R**2 * w**4 / g
    assert sp.simplify(exact - scale * (t**2 / 4 + (1 - sp.cos(2 * w * t)) / (8 * w**2))) == 0
    departure = scale * (t**2 / 4 + (1 - sp.cos(2 * w * t)) / 8 * (1 - 1 / w**2))
    printed = as_printed.k_ii_integral(TIMES, 2.3, 2.5, 9.8)
    np.testing.assert_allclose(
        printed, evaluate_numerically(exact + departure), rtol=1e-13, atol=1e-12
    )


def test_printed_k_iii_integral_is_exact_integral_times_rate_squared():
    exact = double_integral((-R * w**2 * sp.cos(w * t) / g) ** 3 * g)
    printed = as_printed.k_iii_integral(TIMES, 2.3, 2.5, 9.8)
    np.testing.assert_allclose(printed, evaluate_numerically(w**2 * exact), rtol=0, atol=1e-11)


def test_printed_k_ip_integral_is_exact():
    exact = double_integral(R * w**2 * sp.cos(w * t))  # a_P = -1
    printed = as_printed.k_ip_integral(TIMES, 2.3, 2.5)
    np.testing.assert_allclose(printed, evaluate_numerically(exact), rtol=0, atol=1e-13)


def test_harmonic_parts_are_constant_at_strobes():
    """The dimension error is harmless there: it changes b0 and nothing else."""
    strobes = (np.pi / 2 + 2 * np.pi * np.arange(1, 101)) / 2.3
    curvature = 2.5**2 * 2.3**4 / (2 * 9.8)
    k_ii = as_printed.k_ii_integral(strobes, 2.3, 2.5, 9.8) - curvature * strobes**2
    k_iii = as_printed.k_iii_integral(strobes, 2.3, 2.5, 9.8)
    # cancellation against curvature * t^2, some 7e5, sets the floor
    assert np.ptp(k_ii) < 1e-9
    assert np.ptp(k_iii) < 1e-9


def test_drift_at_nominal_strobes_is_parabola():
    """Against R cos(omega t) the strobe sees -1/2 R C omega t^2, where Eq. 15 has 2 R C t."""
    exact = first_order(R * sp.cos(angle)).subs(wp, 0)
    assert sp.simplify(strobe(exact) + R * C * w * t**2 / 2) == 0
    parts = centripetal * sp.cos(w * t) - tangential * sp.sin(w * t) + projection * sp.sin(w * t)
    assert sp.simplify(double_integral(parts.subs(wp, 0)) - exact) == 0


def test_eq15_slope_is_slope_of_centripetal_part():
    """At the strobes it gives 2 R C t - 4 R C/omega; Eq. 15 prints the constant with a plus."""
    alone = double_integral((centripetal * sp.cos(w * t)).subs(wp, 0))
    assert sp.simplify(strobe(alone) - 2 * R * C * t + 4 * R * C / w) == 0


def test_eq15_reverses_sign_of_radius_term_of_eq14():
    """K_I (-dr) omega^2 cos(omega t) integrates to -K_I dr at the strobes; Eq. 15 prints plus."""
    radius_error = sp.symbols("Delta_r")
    exact = double_integral(-radius_error * w**2 * sp.cos(w * t))
    assert sp.simplify(strobe(exact) + radius_error) == 0


def printed_strobe_error(times, **changes):
    values = {
        "rate": 2.3, "drift": 0.0, "ripple": 0.0, "phase": 0.0, "radius": 2.5, "gravity": 9.8,
        "bias": 0.0, "scale_factor": 1.0, "second_order": 0.0,
    } | changes  # fmt: skip
    return as_printed.strobe_error(times, **values)


def test_eq15_term_by_term():
    times = np.array([1.0, 2.0, 4.0])
    np.testing.assert_allclose(printed_strobe_error(times, bias=0.004), 0.0196 * times**2)
    np.testing.assert_allclose(
        printed_strobe_error(times, drift=1e-6, scale_factor=1.001),
        1.001 * (5e-6 * times + 1e-5 / 2.3),
    )
    np.testing.assert_allclose(printed_strobe_error(times, radius_error=1e-5), 1e-5)
    np.testing.assert_allclose(
        printed_strobe_error(times, second_order=2e-5),
        2e-5 * 0.5 * 2.5**2 * 2.3**4 / 9.8 * times**2,
    )


def test_eq15_has_constant_of_one_metre_without_ripple():
    """3/8 R0 sin(phi) lacks the factor w_p/w0: it does not vanish with the ripple."""
    times = np.array([1.0, 2.0])
    np.testing.assert_allclose(printed_strobe_error(times, phase=np.pi / 2), 0.9375)


def test_eq19_equals_eq26_plus_bias():
    rates = np.pi * np.array([0.5, 1.0, 2.0])
    columns = as_printed.second_stage_columns(rates, 2.5, 9.8, 1.001)
    for row, rate in zip(columns, rates, strict=True):
        b2 = as_printed.strobe_curvature(
            rate=rate,
            ripple=3e-6,
            phase=0.5,
            radius=2.5,
            gravity=9.8,
            bias=0.004,
            scale_factor=1.001,
            second_order=2e-5,
        )
        expected = row @ [2e-5, 3e-6 * np.sin(0.5)] + 0.0196
        assert b2 == pytest.approx(expected, rel=1e-14)


def test_constant_ripple_ratio_multiplies_column_by_rate():
    rates = np.pi * np.array([0.5, 1.0, 2.0])
    by_amplitude = as_printed.second_stage_columns(rates, 2.5, 9.8, 1.001)
    by_ratio = as_printed.second_stage_columns(rates, 2.5, 9.8, 1.001, ripple="ratio")
    np.testing.assert_array_equal(by_ratio[:, 0], by_amplitude[:, 0])
    np.testing.assert_allclose(by_ratio[:, 1], by_amplitude[:, 1] * rates)


def test_unknown_ripple_model_raises():
    with pytest.raises(ValueError, match="'amplitude' or 'ratio', not 'phase'"):
        as_printed.second_stage_columns(np.ones(3), 2.5, 9.8, 1.0, ripple="phase")
