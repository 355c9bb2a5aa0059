"""Sympy derives the closed forms at constant rate from the definition of each term.

The definition is the double time integral from zero of the term's product along theta = omega t.
Each result is compared with the formula as a reader would write it, with `columns()` and, for
the t^2 coefficient, with `parabola()`.
"""

import functools

import numpy as np
import pytest
import sympy as sp

from counterspin.physics.accelerometer import QX, QY, QZ, Mounting
from counterspin.physics.closed_forms import parabola
from counterspin.physics.motion import Site, Trajectory
from counterspin.physics.observation import columns
from counterspin.physics.spindle import Ripple, Spindle
from counterspin.physics.terms import PLATFORM_TERMS, TERMS

R, g, t = sp.symbols("R g t", positive=True)
w = sp.symbols("omega", real=True, nonzero=True)
tau = sp.symbols("tau", real=True)  # omega t
c, s = sp.cos, sp.sin

RADIUS, GRAVITY = 2.5, 9.8
TIMES = np.linspace(0.0, 13.0, 40)
RATES = pytest.mark.parametrize("rate", [2.3, -1.7])

# Along theta = tau: velocity, and specific force, in east-north-up.
VELOCITY = sp.Matrix([-R * w * s(tau), R * w * c(tau), 0])
FORCE = sp.Matrix([-R * w**2 * c(tau), -R * w**2 * s(tau), g])

AXES = {
    "QX": (QX, [(1, 0, 0), (0, 0, -1), (0, 1, 0)]),
    "QY": (QY, [(0, 1, 0), (0, 0, -1), (-1, 0, 0)]),
}


def expand_in_powers(expression):
    """Return the coefficients of tau^k exp(i n tau) as {(k, n): coefficient}."""
    z = sp.symbols("z")
    wave = {c(tau): (z + 1 / z) / 2, s(tau): (z - 1 / z) / (2 * sp.I)}
    expression = sp.expand_trig(expression)
    polynomial = sp.Poly(sp.expand(expression.subs(wave) * z**5), tau, z)
    return {(k, n - 5): value for (k, n), value in polynomial.terms() if value != 0}


@functools.cache
def integrate_twice(k, n):
    x, y = sp.symbols("x y", real=True)
    once = sp.integrate(x**k * sp.exp(sp.I * n * x), (x, 0, y))
    return sp.expand(sp.integrate(sp.expand(once), (y, 0, tau)))


def integrate_displacement(integrand):
    """Integrate twice over time, from zero value and slope, as a function of tau."""
    terms = expand_in_powers(integrand).items()
    return sp.expand(sum(value * integrate_twice(k, n) for (k, n), value in terms) / w**2)


def product_by_hand(symbol, axes):
    """Return the product of Eq. 7 in m/s^2 per unit coefficient, written out by hand."""
    i, p, o = (sp.Matrix(axis).dot(FORCE) / g for axis in axes)
    return (
        g
        * {
            "K_F": sp.Integer(1),
            "K_I": i,
            "K_II": i**2,
            "K_III": i**3,
            "K_4": i**4,
            "K_5": i**5,
            "K_IP": i * p,
            "K_IO": i * o,
            "K_PO": p * o,
            "K_PP": p**2,
            "K_OO": o**2,
            "delta_O": p,
            "delta_P": -o,
        }[symbol]
    )


def derive_attitude_error(symbol):
    """Integrate d(psi)/dt to the small rotation psi of the platform per unit coefficient."""
    if symbol.startswith("table.axis_tilt."):
        outward = symbol.endswith("outward")
        return sp.Matrix([c(tau), s(tau), 0] if outward else [-s(tau), c(tau), 0])
    if symbol.startswith("table."):
        *_, n, wave = symbol.split(".")
        return sp.Matrix([0, 0, {"cos": sp.cos, "sin": sp.sin}[wave](int(n) * tau)])
    kind, which = symbol.removeprefix("platform.").split(".")
    if kind == "g_sensitivity":
        gained = (VELOCITY - VELOCITY.subs(tau, 0)) / g + sp.Matrix([0, 0, tau / w])
        return sp.eye(3).col("xyz".index(which[0])) * gained["xyz".index(which[1])]
    if kind == "compliance":
        return sp.eye(3).col("xyz".index(which[0])) * FORCE["xyz".index(which[1])] / g
    psi = sp.eye(3).col(("east", "north", "up").index(which))
    if kind == "g2_sensitivity":
        squared = sp.trigsimp(FORCE.dot(FORCE)) / g**2
        return psi * sp.integrate(squared, (tau, 0, tau)) / w
    return psi if kind == "tilt" else psi * tau / w


@functools.cache
def derive_column(symbol, accelerometer):
    axes = AXES[accelerometer][1]
    if symbol in PLATFORM_TERMS:
        sensed = -derive_attitude_error(symbol).cross(FORCE)
        return integrate_displacement(sp.Matrix(axes[0]).dot(sensed))
    return integrate_displacement(product_by_hand(symbol, axes))


KINKED = [symbol for symbol, row in TERMS.items() if row.effect.has_kink]
ROTATING = [symbol for symbol, row in TERMS.items() if row.effect.requires_rotation]
SMOOTH = [s for s in [*TERMS, *PLATFORM_TERMS] if s not in (*KINKED, *ROTATING)]

# The formulas as they are published with the package; metres per unit coefficient.
X, X2 = w * t, 2 * w * t
SQUARE = R**2 * w**4 / g
CLOSED_FORMS = {
    ("K_F", "QX"): g * t**2 / 2,
    ("K_PP", "QX"): g * t**2 / 2,
    ("delta_O", "QX"): -g * t**2 / 2,
    ("platform.tilt.north", "QX"): -g * t**2 / 2,
    ("platform.tilt.east", "QY"): g * t**2 / 2,
    ("K_I", "QX"): R * (c(X) - 1),
    ("K_II", "QX"): SQUARE * (t**2 / 4 + (1 - c(X2)) / (8 * w**2)),
    ("K_III", "QX"): R**3
    * w**4
    / g**2
    * (sp.Rational(3, 4) * c(X) + c(3 * X) / 36 - sp.Rational(7, 9)),
    ("K_IP", "QX"): R * (1 - c(X)),
    ("K_IO", "QX"): SQUARE * (t / (4 * w) - s(X2) / (8 * w**2)),
    ("K_OO", "QX"): SQUARE * (t**2 / 4 - (1 - c(X2)) / (8 * w**2)),
    # The azimuth that leans under the force is K_OO's column.
    ("platform.compliance.zy", "QX"): SQUARE * (t**2 / 4 - (1 - c(X2)) / (8 * w**2)),
    ("platform.compliance.yx", "QX"): R * (1 - c(X)),
    ("platform.g2_sensitivity.north", "QX"): -g * t**3 / 6 * (1 + R**2 * w**4 / g**2),
    ("platform.drift.north", "QX"): -g * t**3 / 6,
    ("platform.drift.east", "QY"): g * t**3 / 6,
}
PARABOLAS = {
    ("K_F", "QX"): g / 2,
    ("K_PP", "QX"): g / 2,
    ("delta_O", "QX"): -g / 2,
    ("platform.tilt.north", "QX"): -g / 2,
    ("platform.tilt.east", "QY"): g / 2,
    ("K_I", "QX"): 0,
    ("K_II", "QX"): SQUARE / 4,
    ("K_III", "QX"): 0,
    ("K_IP", "QX"): 0,
    ("K_IO", "QX"): 0,
    ("K_OO", "QX"): SQUARE / 4,
    ("platform.drift.north", "QX"): 0,
    ("K_4", "QX"): 3 * R**4 * w**8 / (16 * g**3),
    ("platform.compliance.zy", "QX"): SQUARE / 4,
    ("platform.compliance.zx", "QY"): -SQUARE / 4,
    ("platform.compliance.yz", "QX"): -g / 2,
    ("platform.g_sensitivity.zx", "QX"): R**2 * w**3 / (4 * g),
    ("platform.g_sensitivity.zy", "QY"): R**2 * w**3 / (4 * g),
}


def quadratic_coefficient(symbol, accelerometer):
    """Return the coefficient of t^2 without the bounded oscillation around it."""
    coefficient = sp.expand(derive_column(symbol, accelerometer)).coeff(tau, 2) * w**2
    assert not coefficient.has(tau)
    return sp.simplify(coefficient)


def is_zero(expression):
    return sp.expand(sp.expand(expression.rewrite(sp.exp))) == 0


@pytest.mark.parametrize(("symbol", "accelerometer"), CLOSED_FORMS)
def test_closed_form_matches_sympy(symbol, accelerometer):
    formula = CLOSED_FORMS[symbol, accelerometer].subs(t, tau / w)
    assert is_zero(derive_column(symbol, accelerometer) - formula)


@pytest.mark.parametrize(("symbol", "accelerometer"), PARABOLAS)
def test_parabola_formula_matches_sympy(symbol, accelerometer):
    difference = quadratic_coefficient(symbol, accelerometer) - PARABOLAS[symbol, accelerometer]
    assert sp.simplify(difference) == 0


@RATES
@pytest.mark.parametrize("accelerometer", AXES)
@pytest.mark.parametrize("symbol", SMOOTH)
def test_columns_match_sympy(symbol, accelerometer, rate):
    expression = derive_column(symbol, accelerometer).subs({w: rate, R: RADIUS, g: GRAVITY})
    expected = sp.lambdify(tau, expression, "numpy")(rate * TIMES + 0j).real
    trajectory = Trajectory(Spindle(rate), RADIUS, Site(GRAVITY, 0.8, earth_rate=0.0))
    got = columns(trajectory, AXES[accelerometer][0], [symbol], TIMES)[:, 0]
    # Rounding is that of g T^2, from which the smaller columns are left by cancellation.
    np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-15 * GRAVITY * TIMES[-1] ** 2)


@RATES
@pytest.mark.parametrize("accelerometer", AXES)
@pytest.mark.parametrize("symbol", SMOOTH)
def test_parabola_matches_sympy(symbol, accelerometer, rate):
    numbers = {w: rate, R: RADIUS, g: GRAVITY}
    expected = float(quadratic_coefficient(symbol, accelerometer).subs(numbers))
    got = parabola(symbol, AXES[accelerometer][0], rate, RADIUS, GRAVITY)
    assert got == pytest.approx(expected, rel=1e-14, abs=0.0)


def test_odd_second_order_term_has_no_parabola():
    # cos |cos| is cos^2 on one half turn and -cos^2 on the other.
    pieces = [(-sp.pi / 2, sp.pi / 2, 1), (sp.pi / 2, 3 * sp.pi / 2, -1)]
    assert sum(sp.integrate(sign * c(tau) ** 2, (tau, a, b)) for a, b, sign in pieces) == 0
    assert parabola("K_OQ", QX, 2.3, RADIUS, GRAVITY) == 0.0
    assert parabola("K_0_asym", QX, 2.3, RADIUS, GRAVITY) == 0.0
    # One column's velocity over whole turns says the same.
    turns = 2 * np.pi / 2.3 * np.arange(1, 5)
    trajectory = Trajectory(Spindle(2.3), RADIUS, Site(GRAVITY, 0.8, earth_rate=0.0))
    velocity = columns(trajectory, QX, ["K_OQ"], turns, "velocity")
    np.testing.assert_allclose(velocity, 0.0, atol=1e-12)


def test_scale_factor_asymmetry_has_mean_of_rectified_cosine():
    mean = sp.integrate(sp.Abs(c(tau)), (tau, 0, 2 * sp.pi)) / (2 * sp.pi)
    assert mean == 2 / sp.pi
    expected = float(mean) / 4.0 * RADIUS * 2.3**2  # half of K_I_asym |a_I|/2
    assert parabola("K_I_asym", QX, 2.3, RADIUS, GRAVITY) == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize("symbol", ROTATING)
def test_platform_without_rotation_has_no_rotation_term(symbol):
    trajectory = Trajectory(Spindle(2.3), RADIUS, Site(GRAVITY, 0.8))
    assert not columns(trajectory, QX, [symbol], np.linspace(0.0, 9.0, 50)).any()
    assert parabola(symbol, QX, 2.3, RADIUS, GRAVITY) == 0.0


SKEW = [
    Mounting.from_axes([0.6, 0.8, 0.0], "down"),
    Mounting.from_axes([-0.28, 0.96, 0.0], "up"),
]


@RATES
@pytest.mark.parametrize("mounting", SKEW, ids=["pendulum down", "pendulum up"])
@pytest.mark.parametrize("symbol", [*KINKED, *SMOOTH])
def test_parabola_of_horizontal_input_axis_matches_velocity_growth(symbol, mounting, rate):
    """Over whole revolutions the mean acceleration is twice the coefficient of t^2."""
    trajectory = Trajectory(Spindle(rate), RADIUS, Site(GRAVITY, 0.8, earth_rate=0.0))
    turn = 2 * np.pi / abs(rate)
    velocity = columns(trajectory, mounting, [symbol], turn * np.arange(7), "velocity")[:, 0]
    # Uniform drift of the attitude adds a t^2 to the velocity: constant second differences.
    curvature = np.diff(velocity, 2).mean()
    start_slope = velocity[1] - curvature / 2
    got = parabola(symbol, mounting, rate, RADIUS, GRAVITY)
    drifts = ("platform.drift", "platform.g2_sensitivity")
    vertical = symbol.startswith("platform.g_sensitivity") and symbol.endswith("z")
    secular = symbol.startswith(drifts) or vertical
    if secular:
        # Drift about a level axis: t^2 coefficient zero, all of the growth is in the curvature;
        # drift about the vertical leaves a constant, which is no parabola either.
        assert got == 0.0
        return
    assert curvature == pytest.approx(0.0, abs=1e-10)
    assert got == pytest.approx(start_slope / turn / 2, rel=1e-11, abs=1e-12)


@pytest.mark.parametrize("mounting", [QZ, Mounting.from_axes("east", "north")])
def test_parabola_of_inclined_input_axis_raises(mounting):
    with pytest.raises(ValueError, match="horizontal input axis"):
        parabola("K_II", mounting, 2.0, RADIUS, GRAVITY)


def test_parabola_of_unknown_term_raises():
    with pytest.raises(ValueError, match="unknown term 'K_IV'"):
        parabola("K_IV", QX, 2.0, RADIUS, GRAVITY)


# --- ripple ---------------------------------------------------------------------------------


def test_third_order_term_rectifies_first_harmonic_ripple():
    """-(3/4) R^3 omega^6 eps sin(phi)/g^2 t^2, to first order in eps = omega_1/omega."""
    eps, phi = sp.symbols("epsilon phi", real=True)
    theta = tau - eps * (c(tau + phi) - c(phi))
    east = w**2 * sp.diff(R * c(theta), tau, 2)
    first = sp.diff(east**3 / g**2, eps).subs(eps, 0)
    mean = sp.integrate(sp.expand(sp.expand_trig(first)), (tau, 0, 2 * sp.pi)) / (2 * sp.pi)
    coefficient = sp.simplify(mean / 2)
    formula = -sp.Rational(3, 4) * R**3 * w**6 * eps * s(phi) / g**2 / eps
    assert sp.simplify(coefficient - formula) == 0

    rate, ripple, phase = 2.3, 1e-6, 0.7
    turn = 2 * np.pi / rate
    spindle = Spindle(rate, ripples=(Ripple(1, ripple * rate, phase),))
    trajectory = Trajectory(spindle, RADIUS, Site(GRAVITY, 0.8, earth_rate=0.0))
    velocity = columns(trajectory, QX, ["K_III"], np.array([turn]), "velocity")[0, 0]
    numbers = {R: RADIUS, w: rate, g: GRAVITY, phi: phase}
    # What is left is of second order in eps, a few millionths of it.
    expected = float(formula.subs(numbers)) * ripple
    assert velocity / turn / 2 == pytest.approx(expected, rel=1e-5)


def test_bounded_motion_has_no_mean_acceleration():
    """Centripetal -1, tangential +1/2, projection +1/2: the K_I ripple parabola is zero."""
    rate = 2.3
    turns = 2 * np.pi / rate * np.arange(1, 41)
    spindle = Spindle(rate, ripples=(Ripple(1, 1e-3 * rate, 0.7), Ripple(2, 1e-3, -1.0)))
    trajectory = Trajectory(spindle, RADIUS, Site(GRAVITY, 0.8, earth_rate=0.0))
    column = columns(trajectory, QX, ["K_I"], turns)[:, 0]
    printed = 0.75 * RADIUS * rate * 1e-3 * rate * np.sin(0.7) * turns**2
    slope = column[0] / turns[0]
    np.testing.assert_allclose(column, slope * turns, rtol=0, atol=1e-9)
    assert printed[-1] > 10.0
