"""Observation columns: high-precision values, first principles without them, and symmetries.

The values in ``double_integrals.json`` of the validation's data are our own. The script
``tests/reference/make_double_integrals.py`` makes every one in 40-digit arithmetic from the
definitions and without this package; it ends its panels at each kink of a_I*|a_I|.
"""

import importlib.util
import math
import tracemalloc
from dataclasses import replace
from pathlib import Path

import mpmath
import numpy as np
import pytest
from equation_7 import EQUATION_7
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from counterspin.physics import motion, observation
from counterspin.physics.accelerometer import QX, QY, QZ, Mounting
from counterspin.physics.motion import Site, Trajectory
from counterspin.physics.observation import ORDERS, columns, reference
from counterspin.physics.spindle import Ripple, Spindle
from counterspin.physics.terms import PLATFORM_TERMS, TERMS
from counterspin.records.run_file import MAX_REVOLUTIONS
from counterspin.validation.cases import load_document

FOLDER = Path(__file__).parents[1] / "reference"
DOCUMENT = load_document("double_integrals.json")
CASES = {case["label"]: case for case in DOCUMENT["cases"]}
MOUNTINGS = {"QX": QX, "QY": QY, "QZ": QZ}
SYMBOLS = [*TERMS, *PLATFORM_TERMS]
WAVES = [symbol for symbol in SYMBOLS if symbol.startswith("table.")]
SETTINGS = settings(deadline=None, derandomize=True, max_examples=25)

# --- high-precision values ------------------------------------------------------------------


def make_trajectory(case):
    ripples = tuple(Ripple(n, float(a), float(p)) for n, a, p in case.get("ripples", []))
    spindle = Spindle(
        float(case["rate"]),
        float(case.get("drift", 0)),
        ripples,
        float(case.get("start_angle", 0)),
    )
    earth_rate = float(DOCUMENT["earth_rate"]) if case.get("earth_rate") else 0.0
    site = Site(float(DOCUMENT["gravity"]), float(DOCUMENT["latitude"]), earth_rate)
    return Trajectory(spindle, float(DOCUMENT["radius"]), site)


@pytest.mark.parametrize("label", CASES)
def test_angles_match_reference_file(label):
    case = CASES[label]
    got = make_trajectory(case).spindle.angle(np.array(case["times"], dtype=float))
    # Three roundings of 253 rad.
    np.testing.assert_allclose(got, np.array(case["angle"], dtype=float), rtol=0, atol=9e-14)


@pytest.mark.parametrize("observable", ["velocity", "displacement"])
@pytest.mark.parametrize("name", MOUNTINGS)
@pytest.mark.parametrize("label", CASES)
def test_columns_match_reference_file_to_1e_11(label, name, observable):
    case = CASES[label]
    table = case[observable][name]
    times = np.array(case["times"], dtype=float)
    shown = table if case.get("platform") else ()
    own = [symbol for symbol, row in TERMS.items() if not row.effect.requires_rotation]
    symbols = [*own, *(symbol for symbol in PLATFORM_TERMS if symbol in shown)]
    got = columns(make_trajectory(case), MOUNTINGS[name], symbols, times, observable)
    for symbol, column in zip(symbols, got.T, strict=True):
        key = TERMS[symbol].effect.text if symbol in TERMS else symbol
        sign = -1.0 if symbol == "delta_P" else 1.0
        expected = sign * np.array(table[key], dtype=float)
        # An exact zero is left by whole waves of up to R omega^3 g; 1e-12 of those remains. Times
        # of jumps are found to twice the rounding of the last one.
        rounding = 2.0 * np.finfo(float).eps * float(DOCUMENT["gravity"])
        jump = rounding * times ** (2 if observable == "displacement" else 1)
        atol = np.maximum(1e-12, jump) if symbol == "K_0_asym" else 1e-12
        assert np.all(np.abs(column - expected) <= atol + 1e-11 * np.abs(expected)), symbol


def test_columns_do_not_depend_on_other_times_or_order():
    trajectory, symbols = make_trajectory(CASES["drift, two ripples, Earth rate"]), SYMBOLS
    many = columns(trajectory, QX, symbols, np.linspace(0.0, 161.0, 1611))
    few = columns(trajectory, QX, symbols[::-1], np.array([161.0, 5.0, 41.0, 0.0]))[:, ::-1]
    scale = np.maximum(np.abs(many).max(axis=0), 1.0)
    np.testing.assert_allclose(few / scale, many[[1610, 50, 410, 0]] / scale, rtol=0, atol=1e-12)
    np.testing.assert_allclose(few[3], 0.0, atol=1e-15)


@pytest.mark.parametrize("observable", ORDERS)
def test_column_does_not_depend_on_other_terms(observable):
    trajectory = make_trajectory(CASES["drift, two ripples, Earth rate"])
    times, turned = np.linspace(0.0, 31.0, 312), np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1.0]])
    more = {"observable": observable, "attitude": turned, "scale_factor": 1.25}
    together = columns(trajectory, QX, SYMBOLS, times, **more)
    for symbol, column in zip(SYMBOLS, together.T, strict=True):
        alone = columns(trajectory, QX, [symbol], times, **more)
        scale = np.abs(column).max()
        np.testing.assert_allclose(alone[:, 0], column, rtol=0, atol=1e-14 * scale, err_msg=symbol)
    assert columns(trajectory, QX, [], times, **more).shape == (312, 0)


@pytest.fixture(scope="module")
def reference_script():
    spec = importlib.util.spec_from_file_location(
        "make_double_integrals", FOLDER / "make_double_integrals.py"
    )
    module = importlib.util.module_from_spec(spec)
    precision = mpmath.mp.dps
    spec.loader.exec_module(module)
    yield module
    mpmath.mp.dps = precision


def test_script_reproduces_reference_file(reference_script):
    """Recompute the values at the first time of one case."""
    assert [case["label"] for case in reference_script.CASES] == list(CASES)
    stored = CASES["drift and ripple"]
    case = next(c for c in reference_script.CASES if c["label"] == stored["label"])
    single, double = reference_script.integrals({**case, "times": case["times"][:1]})
    arrays = {"velocity": single[0], "displacement": double[0]}
    for observable, values in arrays.items():
        for (name, key), value in zip(reference_script.names(platform=False), values, strict=True):
            assert mpmath.almosteq(
                value, mpmath.mpf(stored[observable][name][key][0]), 1e-21, 1e-29
            )


def test_reference_value_matches_tanh_sinh_quadrature(reference_script):
    """The kinked double integral by mpmath's own tanh-sinh rule between the roots."""
    stored = CASES["drift and ripple"]
    motion = reference_script.Motion(reference_script.CASES[1])
    end = mpmath.mpf(stored["times"][0])
    edges = [mpmath.mpf(0), *sorted(motion.kinks(end)), end]
    g = reference_script.GRAVITY

    def weighted(t):
        east = motion.place(t)[2][0]
        return (end - t) * east * abs(east) / g

    value = mpmath.quad(weighted, edges)
    expected = mpmath.mpf(stored["displacement"]["QX"]["a_I*|a_I|"][0])
    assert mpmath.almosteq(value, expected, 1e-20)


# --- first principles, without linearising anything --------------------------------------------

ATTITUDE = np.array([[0.8, 0.6, 0.0], [-0.48, 0.64, 0.6], [0.36, -0.48, 0.8]])
SPINDLE = Spindle(-2.4, 3e-4, (Ripple(1, 4e-3, 0.8), Ripple(2, 3e-3, -1.0)), start_angle=0.5)
TRAJECTORY = Trajectory(SPINDLE, 2.5, Site(9.80665, 0.8))


def skew(v):
    """Return the matrices of the cross products with vectors (n, 3)."""
    x, y, z = v.T
    zero = np.zeros_like(x)
    return np.moveaxis(np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]), -1, 0)


def rodrigues(v):
    """Return the rotations by vectors (n, 3), exactly."""
    angle = np.linalg.norm(v, axis=1)[:, None, None]
    unit = skew(v / np.where(angle == 0.0, 1.0, angle)[:, 0])
    return np.eye(3) + np.sin(angle) * unit + (1.0 - np.cos(angle)) * unit @ unit


def multiply_stacked(matrices, vectors):
    """Return the product of each matrix with its vector."""
    return np.einsum("nij,nj->ni", matrices, vectors)


MATRICES = ("g_sensitivity", "compliance")


def simulate_errors(mounting, sets, attitude, times):
    """Return errors of displacement and velocity, shape (2, sets, times).

    Attitude, velocity and position are integrated for each set of departures from the nominal
    coefficients. The platform's attitude is a rotation matrix that starts at the tilt, turns at the
    gyro drift plus the sensitivities x the force the platform feels, and is never taken as small;
    nor is the angle by which the frame leans under that force. The accelerometer follows Eq. 7; the
    navigation computer subtracts the harmful acceleration.
    """
    g, number = TRAJECTORY.site.gravity, len(sets)
    coefficients = {
        s: np.array([row.nominal + one.get(s, 0.0) for one in sets]) for s, row in TERMS.items()
    }
    axes = np.transpose(mounting.axes)
    values = {kind: [] for kind in ("tilt", "drift", *MATRICES, "g2_sensitivity")}
    for symbol, row in PLATFORM_TERMS.items():
        values.setdefault(row.effect.kind, []).append([one.get(symbol, 0.0) for one in sets])
    values = {kind: np.transpose(rows) for kind, rows in values.items()}
    sensitivity, compliance = (values[kind].reshape(number, 3, 3) for kind in MATRICES)
    start = attitude @ rodrigues(-values["tilt"])
    along = mounting.turned(attitude).input_axis

    def rates(time, state):
        state = state.reshape(number, 11)
        to_platform = state[:, :9].reshape(number, 3, 3)
        t = np.array([time])
        force = to_platform @ TRAJECTORY.specific_force(t)[0]
        turning = values["drift"] + multiply_stacked(sensitivity, force / g)
        turning += values["g2_sensitivity"] * np.sum(force**2, axis=1, keepdims=True) / g**2
        # The frame leans under the force, and the accelerometers with it; the gyros do not know.
        force = multiply_stacked(rodrigues(-multiply_stacked(compliance, force / g)), force)
        # The table turns the instrument about up, and the gyros with it.
        angle = TRAJECTORY.spindle.angle(t)[0]
        waves = np.array([f(n * angle) for n in (1, 2) for f in (np.cos, np.sin)])
        up = np.outer(values["table"] @ waves, attitude[:, 2])
        force = multiply_stacked(rodrigues(-up), force)
        # The axis of the table leans with the arm, and the instrument with it.
        east, north = np.cos(angle), np.sin(angle)
        outward_and_forward = np.array([[east, north, 0.0], [-north, east, 0.0]]) @ attitude.T
        force = multiply_stacked(rodrigues(-values["table_axis"] @ outward_and_forward), force)
        i, p, o = (force / g @ axes).T
        sensed = g * sum(c * EQUATION_7[s](i, p, o) for s, c in coefficients.items())
        # Navigation acceleration less the true one: gravity and Coriolis cancel in it.
        computed = sensed - along @ TRAJECTORY.harmful_acceleration(t)[0]
        error = computed - along @ TRAJECTORY.acceleration(t)[0]
        turned = (-skew(turning) @ to_platform).reshape(number, 9)
        return np.column_stack([turned, state[:, 10], error]).ravel()

    initial = np.column_stack([start.reshape(number, 9), np.zeros((number, 2))]).ravel()
    solution = solve_ivp(
        rates, (0.0, times[-1]), initial, "DOP853", times, rtol=1e-11, atol=1e-13, max_step=0.1
    )
    return np.moveaxis(solution.y.reshape(number, 11, -1)[:, 9:], 1, 0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mounting", "attitude"),
    [(QX, np.eye(3)), (QY, np.eye(3)), (QX, ATTITUDE)],
    ids=["QX", "QY", "QX tilted"],
)
def test_nonlinear_simulation_differs_from_columns_by_second_order(mounting, attitude):
    times = np.array([2.0, 5.5])
    rng = np.random.default_rng(29)
    unit = dict(zip(SYMBOLS, rng.choice([-1.0, 1.0], len(SYMBOLS)), strict=True))
    linear = {
        order: columns(TRAJECTORY, mounting, SYMBOLS, times, order, attitude=attitude)
        for order in ("displacement", "velocity")
    }
    sizes = (2e-4, 1e-4)
    sets = [{s: size * sign for s, sign in unit.items()} for size in sizes]
    simulated = simulate_errors(mounting, sets, attitude, times)
    left = []
    for place, size in enumerate(sizes):
        weights = np.array([sets[place][s] for s in SYMBOLS])
        remainder = [
            e[place] - linear[order] @ weights
            for e, order in zip(simulated, ("displacement", "velocity"), strict=True)
        ]
        size_of_first_order = (np.abs(linear["displacement"]) @ np.abs(weights)).max()
        assert np.abs(remainder[0]).max() < 20 * size * size_of_first_order
        left.append(np.array(remainder))
    # Halving every coefficient quarters what the columns leave: nothing of first order remains.
    np.testing.assert_allclose(left[0] / left[1], 4.0, rtol=0.02)


@pytest.mark.slow
def test_columns_match_derivatives_of_simulation():
    """Central differences take the second order out: one coefficient at a time."""
    times = np.array([1.0, 2.5])
    step = 1e-4
    sets = [{symbol: s} for s in (step, -step) for symbol in SYMBOLS]
    up, down = np.split(simulate_errors(QX, sets, ATTITUDE, times)[0], 2)
    expected = columns(TRAJECTORY, QX, SYMBOLS, times, attitude=ATTITUDE)
    for symbol, slope, column in zip(SYMBOLS, (up - down) / (2 * step), expected.T, strict=True):
        np.testing.assert_allclose(slope, column, rtol=1e-6, atol=1e-6, err_msg=symbol)


# --- what the columns are of ---------------------------------------------------------------


def test_columns_of_observables_are_successive_derivatives():
    times = np.linspace(1.0, 9.0, 9)
    h = 1e-3
    for higher, lower in (("displacement", "velocity"), ("velocity", "specific_force")):
        stencil = [columns(TRAJECTORY, QX, SYMBOLS, times + k * h, higher) for k in (-2, -1, 1, 2)]
        slope = (stencil[0] - 8 * stencil[1] + 8 * stencil[2] - stencil[3]) / (12 * h)
        expected = columns(TRAJECTORY, QX, SYMBOLS, times, lower)
        scale = np.maximum(np.abs(expected).max(axis=0), 1.0)
        np.testing.assert_allclose(slope / scale, expected / scale, rtol=0, atol=1e-8)
    assert ORDERS == {"displacement": 2, "velocity": 1, "specific_force": 0}


def test_reference_is_motion_along_input_axis():
    times = np.linspace(0.0, 9.0, 10)
    theta = SPINDLE.angle(times)
    np.testing.assert_allclose(reference(TRAJECTORY, QX, times), 2.5 * np.cos(theta), atol=1e-15)
    np.testing.assert_allclose(
        reference(TRAJECTORY, QY, times, "velocity"),
        2.5 * SPINDLE.angular_rate(times) * np.cos(theta),
        atol=1e-14,
    )
    force = TRAJECTORY.specific_force(times)
    np.testing.assert_allclose(
        reference(TRAJECTORY, QX, times, "specific_force", ATTITUDE), force @ ATTITUDE[0]
    )


def test_platform_columns_scale_with_scale_factor():
    times = np.array([1.0, 4.0])
    plain = columns(TRAJECTORY, QX, SYMBOLS, times)
    scaled = columns(TRAJECTORY, QX, SYMBOLS, times, scale_factor=1.25)
    own = len(TERMS)
    np.testing.assert_array_equal(scaled[:, :own], plain[:, :own])
    np.testing.assert_allclose(scaled[:, own:], 1.25 * plain[:, own:], rtol=1e-14, atol=1e-13)


def test_unknown_term_raises():
    with pytest.raises(ValueError, match="unknown term 'K_IV'"):
        columns(TRAJECTORY, QX, ["K_II", "K_IV"], np.array([1.0]))


def test_columns_are_empty_without_terms_or_times():
    assert columns(TRAJECTORY, QX, [], np.array([1.0, 2.0])).shape == (2, 0)
    assert columns(TRAJECTORY, QX, SYMBOLS, np.empty(0)).shape == (0, len(SYMBOLS))


# --- symmetries ------------------------------------------------------------------------------

STILL = Site(9.8, 0.8, earth_rate=0.0)
OWN = list(TERMS)
angles = st.floats(-math.pi, math.pi)
ripples = st.builds(Ripple, st.integers(1, 3), st.floats(1e-4, 1e-2), angles)
spindles = st.builds(
    Spindle,
    st.floats(0.8, 5.0) | st.floats(-5.0, -0.8),
    st.floats(-1e-4, 1e-4),
    st.lists(ripples, max_size=2).map(tuple),
    angles,
)
TIMES = np.array([0.3, 2.9, 7.0])


def rotation_about_up(angle):
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def assert_close(got, expected):
    # Rounding of a double integral over 7 s of up to (6.4 g)^3: 1e-12 of the largest column.
    scale = np.maximum(1.0, np.abs(expected).max(axis=0))
    np.testing.assert_allclose(got / scale, expected / scale, rtol=0, atol=1e-11)


@SETTINGS
@given(spindle=spindles, turn=angles, mounting=st.sampled_from([QX, QY, QZ]))
def test_columns_are_invariant_under_common_rotation(spindle, turn, mounting):
    """Without Earth rate the columns do not depend on azimuth."""
    turned_spindle = Spindle(
        spindle.rate, spindle.drift, spindle.ripples, spindle.start_angle + turn
    )
    plain = columns(Trajectory(spindle, 2.5, STILL), mounting, OWN, TIMES)
    turned = columns(
        Trajectory(turned_spindle, 2.5, STILL), mounting.turned(rotation_about_up(turn)), OWN, TIMES
    )
    assert_close(turned, plain)


@SETTINGS
@given(spindle=spindles)
def test_opposite_sense_changes_sign_of_odd_terms(spindle):
    """Mirrored in the east-up plane: for Qx only the output axis, north, changes sign.

    The mirror image of a rotation vector is reversed where it lies in the plane: what depends on
    a turn about up or east changes sign, about north it does not. So the azimuth
    gyro's sensitivity to east force, seen by Qx, is odd in the spin sense, and K_II is even.
    """
    # The mirrored motion: theta becomes -theta; the phase keeps -(a/(n w0)) cos(n w0 t + phi).
    mirrored = Spindle(
        -spindle.rate,
        spindle.drift,
        tuple(Ripple(r.harmonic, r.amplitude, -r.phase) for r in spindle.ripples),
        -spindle.start_angle,
    )
    forward = columns(Trajectory(spindle, 2.5, STILL), QX, SYMBOLS, TIMES)
    backward = columns(Trajectory(mirrored, 2.5, STILL), QX, SYMBOLS, TIMES)
    odd = {"K_IO", "K_PO", "delta_P"}
    for symbol in PLATFORM_TERMS:
        kind, *_, which = symbol.split(".")[1:]
        if symbol in WAVES:
            # The table turns about up, and its axis leans outward or forward; of a sine and of
            # the forward direction the sense changes the sign too.
            odd |= {symbol} if which in ("cos", "outward") else set()
        elif kind in MATRICES:
            if (which[0] in "xz") != (which[1] == "y"):
                odd.add(symbol)
        elif which != "north":
            odd.add(symbol)
    sign = np.array([-1.0 if symbol in odd else 1.0 for symbol in SYMBOLS])
    assert_close(backward, forward * sign)


@SETTINGS
@given(spindle=spindles)
def test_terms_satisfy_linear_identities(spindle):
    """a_I^2 + a_O^2 is independent of azimuth; with a_P = -1, K_I and K_IP are collinear."""
    trajectory = Trajectory(spindle, 2.5, STILL)
    x = dict(zip(OWN, columns(trajectory, QX, OWN, TIMES).T, strict=True))
    y = dict(zip(OWN, columns(trajectory, QY, OWN, TIMES).T, strict=True))
    assert_close(x["K_II"] + x["K_OO"], y["K_II"] + y["K_OO"])
    assert_close(x["K_OO"], y["K_II"])
    assert_close(x["K_IP"], -x["K_I"])
    assert_close(x["K_PP"], x["K_F"])
    assert_close(x["delta_O"], -x["K_F"])
    assert_close(x["K_PO"], x["delta_P"])
    assert_close(x["delta_P"], -y["K_I"])


@SETTINGS
@given(spindle=spindles, factor=st.floats(0.3, 3.0))
def test_columns_scale_with_power_of_radius(spindle, factor):
    """Without gravity's part: K_I as R, K_II and K_OO as R^2, K_III as R^3."""
    degree = {"K_I": 1, "K_II": 2, "K_IO": 2, "K_OO": 2, "K_OQ": 2, "K_III": 3, "K_F": 0}
    base = columns(Trajectory(spindle, 1.0, STILL), QX, list(degree), TIMES)
    larger = columns(Trajectory(spindle, factor, STILL), QX, list(degree), TIMES)
    assert_close(larger, base * factor ** np.array(list(degree.values())))


def test_kink_inside_first_panel_is_integrated_exactly():
    """East force of this start passes zero 0.01 rad after the start, twice a turn from then on."""
    spindle = Spindle(2.0, start_angle=math.pi / 2 - 0.01)
    end = np.array([0.02])
    got = columns(Trajectory(spindle, 2.5, STILL), QX, ["K_OQ"], end)[0, 0]
    k = 2.5 * 4.0
    # -k|k| cos|cos| / g with cos(theta) = sin(0.01 - 2 t): exactly integrable on either side.
    with mpmath.workdps(30):
        a = mpmath.mpf("0.01")

        def integrand(t):
            east = -k * mpmath.sin(a - 2 * t)
            return (mpmath.mpf("0.02") - t) * east * abs(east) / mpmath.mpf("9.8")

        expected = float(mpmath.quad(integrand, [0, a / 2, mpmath.mpf("0.02")]))
    assert got == pytest.approx(expected, rel=1e-11)


def test_skew_mounting_rotates_product_tensor():
    """A skew mounting rotates the tensor of products: K_II along a skew axis."""
    mounting = Mounting.from_axes([0.6, 0.0, 0.8], [0.0, 1.0, 0.0])
    got = columns(TRAJECTORY, mounting, ["K_I", "K_II"], TIMES)
    x = dict(zip(OWN, columns(TRAJECTORY, QX, OWN, TIMES).T, strict=True))
    # Qx: I east, P down, O north. East and up: a = 0.6 a_I - 0.8 a_P.
    assert_close(got[:, 0], 0.6 * x["K_I"] - 0.8 * x["delta_O"])
    assert_close(got[:, 1], 0.36 * x["K_II"] - 0.96 * x["K_IP"] + 0.64 * x["K_PP"])


@SETTINGS
@given(spindle=spindles, turn=angles)
def test_compliance_equals_second_order_term_in_any_attitude(spindle, turn):
    """Of Qx: the frame that leans by a force turns the input axis towards P and O by that force."""
    trajectory, attitude = Trajectory(spindle, 2.5, STILL), ATTITUDE @ rotation_about_up(turn)
    alike = {"zy": "K_OO", "zx": "K_IO", "yx": "K_IP", "yy": "K_PO"}
    leaning = [f"platform.compliance.{s}" for s in alike]
    table = columns(trajectory, QX, leaning, TIMES, attitude=attitude)
    assert_close(table, columns(trajectory, QX, [*alike.values()], TIMES, attitude=attitude))
    pair = columns(trajectory, QX, ["platform.compliance.yz", "K_PP"], TIMES, attitude=attitude)
    assert_close(pair[:, 0], -pair[:, 1])
    pair = columns(trajectory, QX, ["platform.compliance.zz", "K_PO"], TIMES, attitude=attitude)
    assert_close(pair[:, 0], -pair[:, 1])


@pytest.mark.parametrize("observable", ORDERS)
def test_uncompensated_gravity_is_in_reference(observable):
    of_place = Site(9.8066, 0.7985)
    site = replace(of_place, removed_gravity=9.8066 - 3e-4)
    motion = Trajectory(Spindle(2.4, start_angle=0.3), 2.5, site)
    times = np.linspace(0.0, 12.0, 49)
    mounting = Mounting.from_axes([0.6, 0.0, 0.8], "north")
    usual = reference(replace(motion, site=of_place), mounting, times, observable)
    added = reference(motion, mounting, times, observable) - usual
    order = ORDERS[observable]
    # The parabola of a free fall; from a recorded force nothing is taken away.
    expected = 0.8 * 3e-4 * times**order / max(order, 1) if order else np.zeros(times.size)
    np.testing.assert_allclose(added, expected, rtol=1e-9, atol=1e-14)


def test_columns_of_longest_record_need_less_than_one_gigabyte():
    spindle = Spindle(2.0 * math.pi, 0.0, (Ripple(2, 1e-5, 0.0),))
    times = np.linspace(0.0, MAX_REVOLUTIONS, 100)
    tracemalloc.start()
    try:
        trajectory = Trajectory(spindle, 2.5, Site(9.8, 0.7))
        columns(trajectory, QX, ["K_I", "K_II", "platform.drift.north"], times)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 1e9


# --- integrals that are kept --------------------------------------------------------------------


def test_cached_columns_are_distinguished_by_all_arguments():
    """Vary axes, attitude, observable, terms and the motion of the platform."""
    site = Site(9.8, 0.8)
    level, turned = np.eye(3), np.eye(3)[[1, 2, 0]]
    spindles = [Spindle(2.0), Spindle(2.0, start_angle=0.1), Spindle(2.0, 1e-5)]
    argument_sets = [
        (Trajectory(spindle, radius, site), axes, symbols, observable, attitude)
        for spindle in spindles
        for radius in (2.5, 2.6)
        for axes in (QX, QY)
        for attitude in (level, turned)
        for observable in ("displacement", "velocity")
        for symbols in (["K_II", "K_OO"], ["K_III", "K_II", "platform.drift.east"])
    ]
    times = np.linspace(0.0, 20.0, 60)
    together = [columns(t, a, s, times, o, attitude=c) for t, a, s, o, c in argument_sets]
    for cached_columns, (trajectory, axes, symbols, observable, attitude) in zip(
        together, argument_sets, strict=True
    ):
        kept, turning = observation._short_integrals, motion._cached_spindle_state
        kept.cache_clear(), turning.cache_clear()
        alone = columns(trajectory, axes, symbols, times, observable, attitude=attitude)
        np.testing.assert_array_equal(cached_columns, alone)
    assert len({one.tobytes() for one in together}) == len(together)


def test_long_run_is_not_cached_and_has_same_columns(monkeypatch):
    trajectory = Trajectory(Spindle(3.0, 1e-6), 2.5, Site(9.8, 0.8))
    times = np.linspace(0.0, 40.0, 500)
    short = columns(trajectory, QX, ["K_I", "K_II", "platform.tilt.north"], times)
    monkeypatch.setattr(observation, "_MAX_NODES", 0)
    monkeypatch.setattr(motion, "_CACHE_SIZE", 0)
    observation._long_integrals.cache_clear()
    long = columns(trajectory, QX, ["K_I", "K_II", "platform.tilt.north"], times)
    np.testing.assert_array_equal(long, short)
