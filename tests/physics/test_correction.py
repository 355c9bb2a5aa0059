"""The inverse of the error model, alone and coupled, and the uncertainty that it leaves."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from counterspin.errors import ConvergenceError
from counterspin.physics.accelerometer import QX, QY, QZ, Mounting, indicated
from counterspin.physics.correction import (
    CalibratedAccelerometer,
    KnownForce,
    NotInvertibleError,
    correct,
    invert,
    missing_axes,
)
from counterspin.physics.effects import ROTATIONS
from counterspin.physics.terms import TERMS

SETTINGS = settings(deadline=None, derandomize=True, max_examples=80)

#: I, P, O along the three components of the vector.
PLAIN = Mounting(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))

#: Sizes up to which every term together still rises over +-100 g: the slope is at least
#: 0.9 - 600 x 3e-4 (all second-order terms at 100 g) - 3e4 x 1e-5 (third order) - 4e6 x 5e-8
#: (fourth order) - 5e8 x 1e-10 (fifth order) = 0.17. At the jump of K_0_asym it rises too.
SIZES = [0.1, 0.1, 3e-4, 1e-5, 5e-8, 1e-10]


def size(symbol):
    return SIZES[TERMS[symbol].effect.degree]


def coefficients():
    return st.fixed_dictionaries(
        {
            s: st.floats(0.0 if s == "K_0_asym" else -size(s), size(s)).map(
                lambda v, n=row.nominal: n + v
            )
            for s, row in TERMS.items()
        }
    )


levels = st.floats(-100.0, 100.0)


# --- slopes ---------------------------------------------------------------------------------


@pytest.mark.parametrize("symbol", TERMS)
def test_slopes_are_derivatives_of_products(symbol):
    sympy = pytest.importorskip("sympy")
    i, p, o = axes = sympy.symbols("I P O", real=True)
    names = {"I": i, "P": p, "O": o, "|I|": sympy.Abs(i), "sign_I": sympy.sign(i)}
    names |= dict.fromkeys(ROTATIONS, sympy.Integer(0))
    row = TERMS[symbol]
    product = row.effect.weight * math.prod(
        (names[f] for f in row.effect.factors), start=sympy.Integer(1)
    )
    for at in ((1.3, -0.7, 2.1), (-1.9, 0.4, -0.6)):
        for axis, variable in zip("IPO", axes, strict=True):
            exact = float(sympy.diff(product, variable).subs(dict(zip(axes, at, strict=True))))
            assert row.effect.slope(np.array(at)[:, None], axis)[0] == pytest.approx(
                exact, rel=1e-14
            )
    if not row.effect.requires_rotation:
        positive = product.subs({sympy.Abs(i): i, sympy.sign(i): 1})
        assert row.effect.power == sympy.Poly(positive, i).degree()


# --- one accelerometer ----------------------------------------------------------------------


@SETTINGS
@given(coefficients=coefficients(), force=st.tuples(levels, levels, levels))
def test_round_trip_over_100_g_with_all_terms(coefficients, force):
    vector = np.array([force])
    y = indicated(PLAIN, coefficients, vector)
    got = invert(coefficients, y, vector[:, 1], vector[:, 2])
    assert abs(got[0] - force[0]) < 1e-12
    if got[0] == 0.0:  # as from a force that underflows: on which side of the jump, nobody knows
        return
    again = np.array([[got[0], force[1], force[2]]])
    assert abs(indicated(PLAIN, coefficients, again)[0] - y[0]) < 1e-12


def test_round_trip_of_many_samples():
    rng = np.random.default_rng(11)
    force = rng.uniform(-100.0, 100.0, size=(5000, 3))
    force[:4, 0] = 0.0, -0.0, 1e-300, -1e-12
    values = {s: row.nominal + 0.5 * size(s) for s, row in TERMS.items()}
    got = invert(values, indicated(PLAIN, values, force), force[:, 1], force[:, 2])
    np.testing.assert_allclose(got, force[:, 0], rtol=0, atol=1e-12)


def test_perfect_accelerometer_needs_no_correction():
    y = np.array([-3.0, -0.0, 0.0, 1e-9, 70.0])
    np.testing.assert_array_equal(invert({}, y), y)


def test_quadratic_matches_closed_form():
    k_f, k_i, k_ii = 0.005, 1.002, 2.7e-5
    y = np.linspace(-60.0, 60.0, 41)
    c = k_f - y
    exact = -2.0 * c / (k_i + np.sqrt(k_i**2 - 4.0 * k_ii * c))
    got = invert({"K_F": k_f, "K_I": k_i, "K_II": k_ii}, y)
    np.testing.assert_allclose(got, exact, rtol=0, atol=3e-14)


def test_cubic_is_inverted_only_up_to_turning_point():
    """a - k a^3 turns at a = 1/sqrt(3 k), where it is 2/3 of that."""
    k = 1e-5
    turn = 1.0 / math.sqrt(3.0 * k)
    top = 2.0 / 3.0 * turn
    y = np.array([0.0, top * (1.0 - 1e-9), -top * (1.0 - 1e-9)])
    got = invert({"K_III": -k}, y)
    # Near the top top - y = sqrt(3 k) (turn - a)^2, in the third place after the leading one.
    gap = math.sqrt(1e-9 * top / math.sqrt(3.0 * k))
    np.testing.assert_allclose(got, [0.0, turn - gap, gap - turn], rtol=0, atol=1e-4 * gap)
    for row, sign in ((1, 1.0), (2, -1.0)):
        beyond = np.zeros(3)
        beyond[row] = sign * top * (1.0 + 1e-9)
        with pytest.raises(NotInvertibleError, match=rf"sample {row} .* turning point") as error:
            invert({"K_III": -k}, beyond)
        assert error.value.row == row
        assert isinstance(error.value, ConvergenceError)
        assert f"{sign * turn:.6g} g" in str(error.value)


@pytest.mark.parametrize(
    "values",
    [
        {"K_4": -3e-7},
        {"K_4": 3e-7},
        {"K_4": -1e-7, "K_III": 2e-5},
        {"K_4": 2e-6, "K_III": -1e-4, "K_II": 1e-3},
        {"K_4": -1e-6, "K_III": 1e-4, "K_II": -4e-3},
        {"K_4": -1e-9, "K_II": 1e-5},
        {"K_5": -1e-9},
        {"K_5": 4e-9, "K_4": -9e-7, "K_III": 5e-5},
        {"K_5": -1e-8, "K_III": 1e-4, "K_II": -5e-3},
    ],
    ids=str,
)
def test_fourth_and_fifth_order_are_inverted_up_to_turning_point(values):
    """The nearest turn by numpy's eigenvalues; to its very end the model is inverted."""
    down, up = [values.get(s, 0.0) for s in ("K_5", "K_4", "K_III", "K_II")], [1.0, 0.0]
    for sign in (1.0, -1.0):
        roots = np.roots(np.polyder(np.poly1d([*down, *up])))
        real = [abs(z.real) for z in roots if abs(z.imag) < 1e-9 and sign * z.real > 0.0]
        turn = min(real, default=None)
        if turn is None:
            far = np.array([[sign * 400.0, 0.0, 0.0]])
            got = invert(values, indicated(PLAIN, values, far))
            assert got[0] == pytest.approx(sign * 400.0, rel=1e-13)
            continue
        top = float(np.polyval([*down, *up], sign * turn))
        inside = invert(values, np.array([top * (1.0 - 1e-9)]))
        assert 0.99 * turn < sign * inside[0] < turn
        with pytest.raises(NotInvertibleError, match="turning point"):
            invert(values, np.array([top * (1.0 + 1e-9)]))


@pytest.mark.parametrize("asymmetry", [4e-3, -4e-3])
def test_bias_jump_at_zero_is_inverted_on_both_sides(asymmetry):
    values = {"K_F": 1e-3, "K_I": 1.001, "K_0_asym": asymmetry, "K_I_asym": 2e-4}
    force = np.array([-7.0, -0.1, -0.003, 0.003, 0.1, 7.0])
    y = indicated(PLAIN, values, np.column_stack([force, 0.0 * force, 0.0 * force]))
    halves = np.sign(force) * 2e-3 * np.sign(asymmetry)
    expected = 1e-3 + 1.001 * force + halves + 1e-4 * np.abs(force)
    np.testing.assert_allclose(y, expected, rtol=0, atol=1e-15)
    np.testing.assert_allclose(invert(values, y), force, rtol=0, atol=1e-14)


def test_indication_inside_bias_jump_inverts_to_zero():
    got = invert({"K_F": 1e-3, "K_0_asym": 4e-3}, 1e-3 + np.array([-1.9e-3, 0.0, 1.9e-3]))
    np.testing.assert_array_equal(got, 0.0)


def test_branch_through_zero_is_preferred_to_nearer_root():
    """K_III < 0: the cubic comes down again and indicates the same far outside."""
    got = invert({"K_III": -2e-5}, np.array([85.0]))
    roots = np.roots([-2e-5, 0.0, 1.0, -85.0])
    assert got[0] == pytest.approx(min(r.real for r in roots if r.real > 0), rel=1e-12)


def test_non_increasing_model_raises():
    with pytest.raises(NotInvertibleError, match=r"sample 0 .* does not increase .*\(slope -1\)"):
        invert({"K_I": -1.0}, np.array([1.0]))
    # Where K_IP a_P eats up the scale factor.
    with pytest.raises(NotInvertibleError, match="sample 2 "):
        invert({"K_IP": 1e-2}, np.ones(3), np.array([0.0, 0.0, -101.0]))


def test_missing_samples_remain_missing():
    got = invert({"K_II": 1e-5}, np.array([1.0, math.nan, 2.0]), np.array([0.0, 0.0, math.inf]))
    assert np.isfinite(got).tolist() == [True, False, False]
    assert invert({}, np.array([])).shape == (0,)


# --- several accelerometers -----------------------------------------------------------------


def make_instrument(mounting, values, covariance=None, name="Q"):
    covariance = np.zeros((len(values), len(values))) if covariance is None else covariance
    return CalibratedAccelerometer(name, mounting, values, covariance)


MOUNTINGS = st.sampled_from(
    [
        (QX, QY, QZ),
        (
            Mounting.from_axes([1.0, 0.2, 0.1], [0.0, -0.5, 1.0]),
            Mounting.from_axes([0.0, 1.0, -0.3], "east"),
            Mounting.from_axes([0.3, 0.0, 1.0], [1.0, 1.0, -0.3]),
        ),
    ]
)


@pytest.mark.slow
@settings(max_examples=30)
@given(
    mountings=MOUNTINGS,
    values=st.tuples(coefficients(), coefficients(), coefficients()),
    force=st.tuples(*[st.floats(-30.0, 30.0)] * 3),
)
def test_three_accelerometers_are_corrected_jointly(mountings, values, force):
    vector = np.array([force])
    # A tenth of the sizes above: misalignments of 0.01 rad.
    values = [
        {s: row.nominal + 0.1 * (v[s] - row.nominal) for s, row in TERMS.items()} for v in values
    ]
    y = np.stack([indicated(m, v, vector) for m, v in zip(mountings, values, strict=True)], axis=1)
    instruments = [make_instrument(m, v) for m, v in zip(mountings, values, strict=True)]
    got = correct(instruments, y)
    exact = [m.input_axis @ vector[0] for m in mountings]
    np.testing.assert_allclose(got.force[0], exact, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(got.u, 0.0)


def test_two_accelerometers_need_known_vertical_force():
    rng = np.random.default_rng(4)
    force = rng.uniform(-20.0, 20.0, size=(200, 3))
    force[:, 2] = 1.0
    values = {s: row.nominal + 0.1 * size(s) for s, row in TERMS.items()}
    instruments = [make_instrument(QX, values, name="Qx"), make_instrument(QY, values, name="Qy")]
    y = np.stack([indicated(m, values, force) for m in (QX, QY)], axis=1)
    down = KnownForce(np.array([0.0, 0.0, -1.0]), -1.0)
    got = correct(instruments, y, [down])
    np.testing.assert_allclose(got.force, force[:, :2], rtol=0, atol=1e-12)
    missing = missing_axes(instruments, [])
    assert [(one.name, axis) for one, axis, _ in missing] == [("Qx", "P"), ("Qy", "P")]
    assert missing[0][2] == ("K_IP", "K_PO", "K_PP", "delta_O")
    with pytest.raises(ValueError, match="Qx: K_IP, K_PO, K_PP, delta_O require a_P"):
        correct(instruments, y)


def test_overdetermined_forces_raise():
    instrument = make_instrument(QX, {"K_IP": 1e-5})
    down, up = (KnownForce(np.array([0.0, 0.0, s]), s) for s in (-1.0, 1.0))
    with pytest.raises(ValueError, match="overdetermined"):
        correct([instrument], np.ones((1, 1)), [down, up])
    with pytest.raises(ValueError, match="overdetermined"):
        correct([instrument, make_instrument(QX, {})], np.ones((1, 2)))


def test_zero_term_needs_axis_only_if_uncertain():
    assert missing_axes([make_instrument(QX, {"K_PP": 0.0})], []) == []
    uncertain = make_instrument(QX, {"K_PP": 0.0}, np.array([[1e-12]]))
    assert [axis for _, axis, _ in missing_axes([uncertain], [])] == ["P"]


def test_diverging_corrections_raise_with_sample():
    """Each cross-coupling exceeds the scale factor, so the mutual corrections diverge."""
    values = {"delta_O": 1.5}
    pair = [
        make_instrument(Mounting.from_axes("east", "north"), values, name="A"),
        make_instrument(Mounting.from_axes("north", "east"), values, name="B"),
    ]
    with pytest.raises(ConvergenceError, match=r"sample 1 .* mutual corrections"):
        correct(pair, np.array([[0.0, 0.0], [1.0, 1.0]]))


def test_sample_missing_in_one_accelerometer_is_missing():
    pair = [make_instrument(QX, {"K_II": 1e-5}), make_instrument(QY, {"delta_P": 1e-3})]
    got = correct(pair, np.array([[1.0, 2.0], [1.0, math.nan]]))
    assert np.isfinite(got.force).tolist() == [[True, True], [False, False]]
    assert np.isfinite(got.u).tolist() == [[True, True], [False, False]]


# --- uncertainty ----------------------------------------------------------------------------


def test_uncertainty_of_one_accelerometer_matches_quadratic_form():
    """u = sqrt(J C J^T)/|slope|, J = (1, a, a^2): the textbook quadratic form."""
    u = np.array([2e-6, 5e-6, 7e-8])
    correlation = np.array([[1.0, 0.3, -0.9], [0.3, 1.0, -0.2], [-0.9, -0.2, 1.0]])
    covariance = correlation * np.outer(u, u)
    values = {"K_F": 0.005, "K_I": 1.002, "K_II": 2.7e-5}
    a = np.array([-40.0, -1.0, 0.0, 1.0, 40.0])
    y = indicated(PLAIN, values, np.stack([a, 0 * a, 0 * a], axis=1))
    got = correct([make_instrument(PLAIN, values, covariance)], y[:, None])
    for k, level in enumerate(a):
        j = np.array([1.0, level, level**2])
        expected = math.sqrt(j @ covariance @ j) / (1.002 + 2 * 2.7e-5 * level)
        assert got.u[k, 0] == pytest.approx(expected, rel=1e-9)


def test_uncertainty_of_known_force_is_propagated():
    """K_PP a_P^2 with a_P = -1 g +- u: da_I = 2 K_PP u."""
    instrument = make_instrument(PLAIN, {"K_PP": 1e-4, "K_I": 1.0})
    got = correct(
        [instrument], np.ones((1, 1)), [KnownForce(np.array([0.0, 1.0, 0.0]), -1.0, 1e-3)]
    )
    assert got.force[0, 0] == pytest.approx(1.0 - 1e-4, abs=1e-15)
    assert got.u[0, 0] == pytest.approx(2e-7, rel=1e-12)


@pytest.mark.slow
def test_uncertainty_of_coupled_accelerometers_matches_differences():
    """Compute the sensitivity to each error source by central differences of the correction."""
    rng = np.random.default_rng(2026)
    vector, count = np.array([[7.0, -4.0, 1.0]]), len(TERMS)
    # Few causes of many errors: they are related.
    root = rng.normal(size=(3 * count, 3)) * [[0.01 * size(s)] for s in [*TERMS] * 3]
    joint = (root @ root.T).reshape(3, count, 3, count)
    instruments = []
    for k, (name, mounting) in enumerate(zip("xyz", (QX, QY, QZ), strict=True)):
        values = {s: row.nominal + 0.2 * size(s) * rng.normal() for s, row in TERMS.items()}
        instruments.append(CalibratedAccelerometer(name, mounting, values, joint[k, :, k]))
    y = np.stack(
        [
            indicated(instrument.mounting, instrument.coefficients, vector)
            for instrument in instruments
        ],
        1,
    )
    step, errors = 0.1, root.reshape(3, count, 3)
    sensitivities = np.empty((3, 3, 3))  # of an accelerometer, to a cause, along an axis
    for k, new_instrument in enumerate(instruments):
        for cause in range(3):
            shifted = []
            for sign in (step, -step):
                changed = (
                    np.array([*new_instrument.coefficients.values()]) + sign * errors[k, :, cause]
                )
                moved = dict(zip(new_instrument.coefficients, changed, strict=True))
                others = [*instruments]
                others[k] = make_instrument(new_instrument.mounting, moved)
                shifted.append(correct(others, y).force[0])
            sensitivities[k, cause] = (shifted[0] - shifted[1]) / (2.0 * step)
    alone = np.sum(sensitivities**2, axis=(0, 1))
    np.testing.assert_allclose(correct(instruments, y).u[0], np.sqrt(alone), rtol=1e-5)
    between = {(k, m): joint[k, :, m] for k in range(3) for m in range(k + 1, 3)}
    related = np.sum(np.sum(sensitivities, axis=0) ** 2, axis=0)
    assert np.abs(related / alone - 1.0).max() > 0.01
    claimed = correct(instruments, y, (), between).u[0]
    np.testing.assert_allclose(claimed, np.sqrt(related), rtol=1e-5)


def test_uncertainty_matches_scatter_of_trials():
    """Correct with coefficients drawn around the estimates and compare the scatter.

    A standard deviation is known to 1/sqrt(2 trials) of itself.
    """
    trials = 500
    rng = np.random.default_rng(5)
    values = {s: row.nominal + 0.5 * size(s) for s, row in TERMS.items()}
    root = rng.normal(size=(len(values),) * 2) * [[0.005 * size(s)] for s in TERMS]
    force = np.array([[-60.0, 3.0, 1.0], [0.5, -1.0, 0.0], [1.0, -1.0, 2.0], [60.0, 0.0, -5.0]])
    y = indicated(PLAIN, values, force)
    known = [KnownForce(np.eye(3)[k], force[:, k]) for k in (1, 2)]
    claimed = correct([make_instrument(PLAIN, values, root @ root.T)], y[:, None], known).u[:, 0]
    drawn = rng.multivariate_normal(list(values.values()), root @ root.T, size=trials)
    per_sample = dict(zip(values, np.repeat(drawn, len(force), axis=0).T, strict=True))
    samples = (np.tile(column, trials) for column in (y, *force[:, 1:].T))
    reshape = invert(per_sample, *samples).reshape(trials, len(force))
    np.testing.assert_allclose(np.std(reshape, axis=0), claimed, rtol=5.0 / math.sqrt(2.0 * trials))
