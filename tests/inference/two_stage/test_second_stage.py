"""The second stage against closed forms, hand calculation, and trials with known truth."""

import math
import os
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from raising import raises
from scipy.special import stdtrit

from counterspin.errors import NotIdentifiableError
from counterspin.inference.joint import series as joint_series
from counterspin.inference.joint.unknowns import RIPPLE
from counterspin.inference.two_stage.first_stage import Strobes, first_stage, strobe_angle
from counterspin.inference.two_stage.model import DRIFT, TwoStageRequest
from counterspin.inference.two_stage.second_stage import StrobedRun
from counterspin.inference.two_stage.second_stage import second_stage as resolved
from counterspin.physics import observation, simulation
from counterspin.physics.accelerometer import QX, QY
from counterspin.physics.motion import Site, Trajectory
from counterspin.physics.spindle import Ripple, Spindle
from counterspin.physics.terms import PLATFORM_TERMS, TERMS

TRIALS = 20_000 if os.environ.get("COUNTERSPIN_FULL") else 200

# The paper's plan and its Table 1; its Earth stands still.
R, G, SIGMA, K_I = 2.5, 9.8, 0.01, 1.001
PHASE = math.radians(30.0)
RATES = np.array([math.pi / 2, math.pi, 2 * math.pi])
STILL = Site(G, 0.8, earth_rate=0.0)
EARTH = Site(G, 0.8)
TRUTH = {"K_F": 0.004, "K_I": K_I, "K_II": 2e-5, "K_III": 4e-6, "K_IP": 6e-6}
#: A drift's column is a difference over 5e-6 rad, of angles of 628 rad, rounded to 1.1e-13 rad.
OF_DRIFT = 3e-8
TURNED = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # 90 deg about east


def record_at_strobes(
    spindle, *, mounting=QX, site=STILL, truth=None, platform=None, attitude=None, n=100
):
    """Return a noise-free run, recorded at its strobes with the full error model."""
    motion = Trajectory(spindle, R, site)
    attitude = observation.LEVEL if attitude is None else attitude
    sense = math.copysign(1.0, spindle.rate)
    phase = strobe_angle(mounting.turned(attitude).input_axis)
    time = spindle.time_at(phase + sense * 2 * math.pi * np.arange(1, n + 1))
    error = np.zeros(n)
    if truth is not None:
        error = simulation.simulate_record(
            motion, mounting, truth, platform or {}, time, attitude=attitude
        ) - observation.reference(motion, mounting, time, attitude=attitude)
    parabola = first_stage(Strobes(time, error, np.ones(n), lost=0), SIGMA)
    return StrobedRun(f"{spindle.rate:.3f}", motion, parabola, attitude)


def plan(rates=RATES, *, drift=0.0, ratio=0.0, phase=PHASE, **more):
    spindles = (Spindle(w, drift, (Ripple(1, ratio * w, phase),) if ratio else ()) for w in rates)
    return [record_at_strobes(spindle, **more) for spindle in spindles]


def second_stage(runs, mounting=QX, *, ignored=("K_III",), priors=None, **options):
    """Solve the second stage with K_I known exactly."""
    request = TwoStageRequest(priors={"K_I": (K_I, 0.0)} | (priors or {}), **options)
    return resolved(runs, mounting, request, ignored=ignored)


def u_of_b2(second_stage_result):
    return np.array([parabola.u_b2 for parabola in second_stage_result.parabolas])


def column(second_stage_result, symbol):
    """Return d(b2)/d(coefficient) of each run, with separate columns for per-run terms."""
    model, blocks = second_stage_result.fit.model, second_stage_result.fit.blocks
    rows = np.vstack([np.hstack([block.factor, block.considered]) for block in blocks])
    terms = [*model.unknowns, *model.considered]
    of_term = [place for place, other in enumerate(terms) if other.symbol == symbol]
    return u_of_b2(second_stage_result) * rows[:, of_term].sum(axis=1)


def design(second_stage_result):
    return np.column_stack(
        [column(second_stage_result, symbol) for symbol in second_stage_result.symbols]
    )


@cache
def ideal_plan():
    return plan(truth=TRUTH)


def add_noise(runs, rng, sigma=SIGMA):
    """The same runs with white noise of SIGMA; `sigma` is what the first stage is told."""
    noisy = []
    for run in runs:
        clean = run.parabola.strobes
        error = clean.error + SIGMA * rng.standard_normal(clean.error.size)
        noisy.append(replace(run, parabola=first_stage(replace(clean, error=error), sigma)))
    return noisy


@pytest.fixture
def remembered_columns(monkeypatch):
    """Cache the columns, because all trials share the rotation."""
    memory = {}

    def columns(trajectory, mounting, symbols, times, *which, **more):
        key = (trajectory, mounting, tuple(symbols), times.size)
        if key not in memory:
            memory[key] = observation.columns(trajectory, mounting, symbols, times, *which, **more)
        return memory[key]

    remembering = SimpleNamespace(**{**vars(observation), "columns": columns})
    monkeypatch.setattr(joint_series, "observation", remembering)


# --- columns ----------------------------------------------------------------------------------


def test_exact_columns_match_closed_forms_at_constant_rate():
    second_stage_result = second_stage(ideal_plan(), nominal_angle=True, ignored=["K_III", "K_OO"])
    assert second_stage_result.symbols == ("K_II", "K_F", DRIFT)
    np.testing.assert_allclose(
        design(second_stage_result)[:, 0], R**2 * RATES**4 / (4 * G), rtol=1e-10
    )
    np.testing.assert_allclose(design(second_stage_result)[:, 1], G / 2, rtol=1e-12)
    np.testing.assert_allclose(
        design(second_stage_result)[:, 2], -K_I * R * RATES / 2, rtol=OF_DRIFT
    )
    np.testing.assert_allclose(
        column(second_stage_result, "K_OO"), R**2 * RATES**4 / (4 * G), rtol=1e-10
    )
    assert (
        np.abs(column(second_stage_result, "K_III")).max() < 1e-9
    )  # rounding of R^3 w^4/g^2 = 250 m/400 s^2


def test_printed_columns_match_eq_26():
    for ripple, power in (("amplitude", 1), ("ratio", 2)):
        second_stage_result = second_stage(ideal_plan(), model="as-printed", ripple=ripple)
        assert second_stage_result.symbols == ("K_II", RIPPLE)
        np.testing.assert_allclose(
            design(second_stage_result)[:, 0], R**2 * RATES**4 / (2 * G), rtol=1e-14
        )
        np.testing.assert_allclose(
            design(second_stage_result)[:, 1], -0.75 * K_I * R * RATES**power, rtol=1e-14
        )


def test_ripple_adds_parabola_of_k_iii():
    ratio = 1e-3
    second_stage_result = second_stage(plan(ratio=ratio), ignored=["K_III"])
    predicted = -0.75 * R**3 * RATES**6 * ratio * math.sin(PHASE) / G**2
    np.testing.assert_allclose(column(second_stage_result, "K_III"), predicted, rtol=5 * ratio)


def test_opposite_sense_reverses_odd_effects_only():
    runs = plan(np.array([2.0, -2.0, 4.0, -4.0]))
    sensitivity = "platform.g_sensitivity.zx"
    second_stage_result = second_stage(runs, nominal_angle=True, ignored=[sensitivity])
    k_ii, k_f, drift = design(second_stage_result).T
    np.testing.assert_allclose(k_ii[::2], k_ii[1::2], rtol=1e-10)
    np.testing.assert_allclose(k_f[::2], k_f[1::2], rtol=1e-12)
    np.testing.assert_allclose(drift[::2], -drift[1::2], rtol=OF_DRIFT)
    effect = column(second_stage_result, sensitivity)
    np.testing.assert_allclose(effect[::2], K_I * R**2 * np.array([8.0, 64.0]) / (4 * G), rtol=1e-8)
    np.testing.assert_allclose(effect[1::2], -effect[::2], rtol=1e-8)


# --- estimates and their uncertainties ----------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "closing"),
    [
        ({}, 5.312e-9),
        ({"fit_bias": False}, 5.230e-9),
        ({"nominal_angle": True}, 8.270e-9),
        ({"model": "as-printed", "weighted": False}, 3.223e-9),
        ({"model": "as-printed"}, 2.814e-9),
    ],
    ids=["K_II and K_F", "K_II", "K_II, C and K_F", "printed", "printed, weighted"],
)
def test_u_of_k_ii_matches_paper_plan(options, closing):
    _, u = second_stage(plan(), **options).estimate("K_II")
    assert u == pytest.approx(closing, rel=1e-4)


def test_exact_model_returns_truth_and_printed_model_half():
    exact = second_stage(ideal_plan())
    assert exact.estimate("K_II")[0] == pytest.approx(2e-5, rel=1e-9)
    assert exact.estimate("K_F")[0] == pytest.approx(0.004, rel=1e-12)
    printed = second_stage(ideal_plan(), model="as-printed", priors={"K_F": (0.004, 0.0)})
    assert printed.estimate("K_II")[0] == pytest.approx(1e-5, rel=1e-8)


def test_unweighted_fit_matches_eq_27_and_34():
    runs = add_noise(ideal_plan(), np.random.default_rng(1))
    runs[1] = replace(runs[1], parabola=first_stage(runs[1].parabola.strobes, 7 * SIGMA))
    b2 = np.array([run.parabola.b2 for run in runs])
    sigma = np.array([run.parabola.u_b2 for run in runs])
    bias = 0.004
    a = np.column_stack([R**2 * RATES**4 / (2 * G), -0.75 * K_I * R * RATES])
    inverse = np.linalg.inv(a.T @ a) @ a.T
    options = {"model": "as-printed", "weighted": False, "priors": {"K_F": (bias, 0.0)}}
    second_stage_result = second_stage(runs, **options)
    expected = inverse @ (b2 - bias * G / 2)
    np.testing.assert_allclose(second_stage_result.fit.solution.estimate, expected, rtol=1e-7)
    covariance = inverse @ np.diag(sigma**2) @ inverse.T
    np.testing.assert_allclose(
        second_stage_result.fit.solution.covariance_noise, covariance, rtol=1e-7
    )


def test_weighted_fit_with_priors_matches_generalised_least_squares():
    runs = add_noise(ideal_plan(), np.random.default_rng(2))
    b2 = np.array([run.parabola.b2 for run in runs])
    sigma = np.array([run.parabola.u_b2 for run in runs])
    priors = {"K_F": (0.004 + 1e-8, 1e-8), "K_II": (2.01e-5, 4e-9)}
    second_stage_result = second_stage(runs, priors=priors)
    rows = np.vstack([design(second_stage_result) / sigma[:, None], np.diag([1 / 4e-9, 1 / 1e-8])])
    right = np.concatenate([b2 / sigma, [2.01e-5 / 4e-9, (0.004 + 1e-8) / 1e-8]])
    scale = np.linalg.norm(rows, axis=0)
    covariance = np.linalg.inv((rows / scale).T @ (rows / scale)) / np.outer(scale, scale)
    np.testing.assert_allclose(
        second_stage_result.fit.solution.estimate, covariance @ rows.T @ right, rtol=1e-8
    )
    np.testing.assert_allclose(second_stage_result.fit.solution.covariance, covariance, rtol=1e-8)
    np.testing.assert_allclose(
        second_stage_result.gain, covariance @ rows.T[:, :3] / sigma, rtol=1e-8
    )
    prior_part = covariance @ np.diag([1 / 4e-9, 1 / 1e-8]) ** 2 @ covariance
    np.testing.assert_allclose(
        second_stage_result.fit.solution.covariance_prior, prior_part, rtol=1e-7
    )


def test_exactly_known_unknown_is_fixed():
    second_stage_result = second_stage(ideal_plan(), priors={"K_II": (3e-5, 0.0)})
    assert second_stage_result.estimate("K_II") == (3e-5, 0.0)
    np.testing.assert_array_equal(second_stage_result.gain[0], 0.0)
    # K_F then takes what of 1e-5 of K_II lies along its column.
    sigma = u_of_b2(second_stage_result)
    along = (design(second_stage_result)[:, 1] / sigma) / np.sum(
        (design(second_stage_result)[:, 1] / sigma) ** 2
    )
    expected = 0.004 - along @ (1e-5 * design(second_stage_result)[:, 0] / sigma)
    assert second_stage_result.estimate("K_F")[0] == pytest.approx(expected, rel=1e-9)


def test_drift_column_of_nominal_angle_estimates_drift():
    drift = 1e-8
    truth = {"K_F": 0.004, "K_I": K_I, "K_II": 2e-5}
    runs = []
    for w in RATES:
        motion = Trajectory(Spindle(w, drift), R, STILL)
        nominal = Trajectory(Spindle(w), R, STILL)
        time = (math.pi / 2 + 2 * math.pi * np.arange(1, 101)) / w
        error = simulation.simulate_record(motion, QX, truth, {}, time)
        error = error - observation.reference(nominal, QX, time)
        parabola = first_stage(Strobes(time, error, np.ones(100), lost=0), SIGMA)
        runs.append(StrobedRun(f"{w}", nominal, parabola))
    second_stage_result = second_stage(runs, nominal_angle=True)
    # The nominal rotation knows nothing of K_II x C, a part 2 C T of K_II's own parabola: at the
    # fastest run 1e-8 beside the drift's 7.9e-8 m/s^2, and a hundredth of sigma(b2).
    value, u = second_stage_result.estimate(DRIFT)
    assert value == pytest.approx(drift, rel=0.05)
    assert abs(value - drift) < 0.01 * u
    k_ii, u = second_stage_result.estimate("K_II")
    assert abs(k_ii - 2e-5) < 0.2 * u
    # Without the column the drift passes for K_II and K_F, with what was just said of it.
    without = second_stage(runs)
    change = without.gain @ (-K_I * R * RATES / 2 * drift)
    np.testing.assert_allclose(
        without.fit.solution.estimate - [2e-5, 0.004],
        change,
        rtol=0.3,
        atol=0.01 * without.fit.solution.u[0],
    )


def test_considered_terms_are_subtracted_and_propagated():
    sensitivity = "platform.g_sensitivity.zx"
    runs = plan(truth=TRUTH, platform={"platform.tilt.north": 3e-6, sensitivity: 2e-9})
    known = {"platform.tilt.north": (3e-6, 5e-7), sensitivity: (2e-9, 1e-9)}
    second_stage_result = second_stage(runs, priors=known)
    # What is left is of second order in the tilt: the turned input axis sees less of the force.
    assert second_stage_result.estimate("K_II")[0] == pytest.approx(2e-5, abs=1e-10)
    tilt = -K_I * G / 2 * second_stage_result.gain[0] * 5e-7  # each run has a tilt of its own
    together = float(second_stage_result.gain[0] @ (K_I * R**2 * RATES**3 / (4 * G))) * 1e-9
    expected = math.hypot(*tilt, together)
    assert math.sqrt(second_stage_result.fit.solution.covariance_considered[0, 0]) == pytest.approx(
        expected, rel=1e-6
    )
    held = [(other.owner, other.symbol) for other in second_stage_result.fit.model.considered]
    assert ("3.142", "platform.tilt.north") in held
    assert ("", sensitivity) in held


def test_shift_of_ignored_term_matches_simulation():
    sensitivity, tilt = "platform.g_sensitivity.zx", "platform.tilt.north"
    second_stage_result = second_stage(ideal_plan(), ignored=[sensitivity, tilt, "K_II"])
    assert {c.symbol for c in second_stage_result.fit.model.considered} == {
        "K_F",
        "K_I",
        sensitivity,
        tilt,
    } - {"K_F"}
    moved = second_stage(plan(truth=TRUTH, platform={sensitivity: 1e-9}))
    change = moved.fit.solution.estimate - second_stage_result.fit.solution.estimate
    np.testing.assert_allclose(second_stage_result.shift(sensitivity) * 1e-9, change, rtol=1e-3)
    # A tilt is another in each run; their effects add as independent ones.
    per_run = np.linalg.norm(second_stage_result.gain * (-K_I * G / 2), axis=1)
    np.testing.assert_allclose(second_stage_result.shift(tilt), per_run, rtol=1e-9)


def test_effective_degrees_of_freedom_follow_welch_satterthwaite():
    runs = add_noise(ideal_plan(), np.random.default_rng(3), sigma=None)
    second_stage_result = second_stage(runs)
    for row, dof in zip(second_stage_result.gain, second_stage_result.dof, strict=True):
        parts = [(g * run.parabola.u_b2) ** 2 for g, run in zip(row, runs, strict=True)]
        assert dof == pytest.approx(sum(parts) ** 2 / sum(p**2 / 97 for p in parts), rel=1e-9)
    assert np.isinf(second_stage(ideal_plan()).dof).all()
    # What is known exactly has no noise, and what is no noise loses no degrees of freedom.
    exact = second_stage(runs, priors={"K_II": (2e-5, 0.0)})
    assert np.isinf(exact.dof[0])
    assert np.isfinite(exact.dof[1])
    unsure = second_stage(runs, priors={"platform.tilt.north": (0.0, 1e-6)})
    index, solution = 1, unsure.fit.solution
    noise = solution.covariance_noise[index, index]
    ratio = (solution.covariance[index, index] / noise) ** 2
    assert unsure.dof[index] == pytest.approx(second_stage_result.dof[index] * ratio, rel=1e-9)


def test_misfit_is_in_standard_uncertainties_of_each_run():
    runs = plan([1.0, 2.0, 3.0, 4.0, 5.0], truth=TRUTH)
    assert np.abs(second_stage(runs).misfit).max() < 1e-3
    off = runs[2].parabola
    off = replace(off, coefficients=off.coefficients + np.array([0, 0, 10 * off.u_b2]))
    runs[2] = replace(runs[2], parabola=off)
    second_stage_result = second_stage(runs)
    assert int(np.argmax(np.abs(second_stage_result.misfit))) == 2
    assert np.sum(second_stage_result.misfit**2) == pytest.approx(
        second_stage_result.fit.solution.chi2, rel=1e-9
    )


# --- what cannot be told apart --------------------------------------------------------------------


def test_fewer_rates_than_unknowns_raise():
    with raises("not-identifiable", "2 unknowns", "K_II, K_F", "2 different", "1"):
        second_stage(plan([2.0, 2.0005]))
    with pytest.raises(NotIdentifiableError, match=r"3 unknowns .*K_II, K_F, spindle.drift"):
        second_stage(plan([2.0, 4.0]), nominal_angle=True)
    with pytest.raises(NotIdentifiableError, match=r"2 unknowns .*K_II, spindle.ripple"):
        second_stage(plan([2.0]), model="as-printed")
    second_stage_result = second_stage(plan([2.0], truth=TRUTH), priors={"K_F": (0.004, 1e-9)})
    assert second_stage_result.estimate("K_II")[0] == pytest.approx(2e-5, rel=1e-6)


def test_two_senses_of_same_rate_separate_only_odd_from_even():
    both = plan([2.0, -2.0])
    with pytest.raises(NotIdentifiableError, match=r"\(K_II, K_F\) .* in either sense"):
        second_stage(both)
    second_stage_result = second_stage(both, nominal_angle=True, fit_bias=False)
    assert second_stage_result.symbols == ("K_II", DRIFT)
    second_stage(both, model="as-printed")
    with pytest.raises(NotIdentifiableError, match="in either sense"):
        second_stage(both, model="as-printed", ripple="ratio")


def test_near_collinear_columns_are_named():
    assert second_stage(plan()).near_collinear == ()
    second_stage_result = second_stage(plan([3.0, 3.1]))
    ((a, b, cosine),) = second_stage_result.near_collinear
    assert (a, b) == ("K_II", "K_F")
    whitened = design(second_stage_result) / u_of_b2(second_stage_result)[:, None]
    x, y = whitened.T
    assert cosine == pytest.approx(x @ y / math.sqrt((x @ x) * (y @ y)), rel=1e-12)
    assert cosine > 0.99


LEANING = "platform.compliance.{}"
EVERYTHING = [*TERMS, *PLATFORM_TERMS]


@pytest.mark.parametrize(
    ("mounting", "attitude", "k_ii", "k_f"),
    [
        # physics.md, section 7: what is one number while the pendulous axis is vertical ...
        (
            QX,
            None,
            {"K_OO": 1, LEANING.format("zy"): K_I},
            {
                "K_PP": 1,
                "delta_O": -1,
                "platform.tilt.north": -K_I,
                LEANING.format("yz"): -K_I,
            },
        ),
        (
            QY,
            None,
            {"K_OO": 1, LEANING.format("zx"): -K_I},
            {
                "K_PP": 1,
                "delta_O": -1,
                "platform.tilt.east": K_I,
                LEANING.format("xz"): K_I,
            },
        ),
        # ... and while the output axis is
        (
            QX,
            TURNED,
            {"K_PP": 1, LEANING.format("yz"): -K_I},
            {
                "K_OO": 1,
                "delta_P": -1,
                "platform.tilt.north": -K_I,
                LEANING.format("zy"): K_I,
            },
        ),
    ],
    ids=["Qx", "Qy", "Qx, output axis vertical"],
)
def test_equivalent_terms_are_found(mounting, attitude, k_ii, k_f):
    runs = plan(mounting=mounting, attitude=attitude, site=EARTH, drift=1e-7, ratio=1e-5)
    second_stage_result = second_stage(runs, mounting, ignored=EVERYTHING)
    assert second_stage_result.alike("K_II", EVERYTHING) == pytest.approx(k_ii, rel=1e-5)
    bias = second_stage_result.alike("K_F", EVERYTHING)
    # The sign of a_I has a mean by the Earth's rate alone, about (2 Omega/w)/pi of its half, and an
    # axis that leans with the arm one of that order.
    for term in ("K_0_asym", "table.axis_tilt.outward", "table.axis_tilt.forward"):
        assert abs(bias.pop(term, 0.0)) < 2.0 * EARTH.earth_rate / (0.5 * math.pi) / math.pi
    assert bias == pytest.approx(k_f, rel=1e-5)


def test_attitudes_separate_equivalent_terms():
    runs = plan(site=EARTH) + plan(site=EARTH, attitude=TURNED)
    second_stage_result = second_stage(runs, ignored=EVERYTHING)
    assert second_stage_result.alike("K_II", EVERYTHING) == {}
    assert list(second_stage_result.alike("K_F", EVERYTHING)) == ["platform.tilt.north"]


# --- trials ---------------------------------------------------------------------------------------


def simulate_trials(
    runs, sigma=SIGMA, count=TRIALS, *, options=None, priors=None, bias_sd=math.inf, seed=0
):
    """Simulate trials; return errors of K_II, u and the coverage of 95 % intervals."""
    rng = np.random.default_rng(seed)
    errors, claims, covered = np.empty(count), np.empty(count), 0
    for k in range(count):
        # A prior is as far off as it says.
        bias = {"K_F": (0.004 + bias_sd * rng.standard_normal(), bias_sd)}
        known = (priors or {}) | (bias if math.isfinite(bias_sd) else {})
        noisy = add_noise(runs, rng, sigma)
        second_stage_result = second_stage(noisy, priors=known, **(options or {}))
        value, claims[k] = second_stage_result.estimate("K_II")
        errors[k] = value - TRUTH["K_II"]
        covered += abs(errors[k]) < stdtrit(second_stage_result.dof[0], 0.975) * claims[k]
    return errors, claims, covered / count


@pytest.mark.slow
@pytest.mark.usefixtures("remembered_columns")
@pytest.mark.parametrize(
    ("drift", "ratio", "sigma", "bias_sd"),
    [
        (0.0, 0.0, SIGMA, math.inf),
        (1e-6, 5e-7, SIGMA, math.inf),
        (1e-6, 1e-5, SIGMA, math.inf),
        (1e-6, 1e-5, None, math.inf),
        (0.0, 0.0, SIGMA, 5e-9),
    ],
    ids=["even", "drift, ripple 5e-7", "drift, ripple 1e-5", "sigma from residuals", "prior"],
)
def test_exact_estimate_is_unbiased_and_has_coverage(drift, ratio, sigma, bias_sd):
    runs = plan(drift=drift, ratio=ratio, truth=TRUTH, site=EARTH)
    errors, claims, coverage = simulate_trials(runs, sigma, bias_sd=bias_sd)
    u = math.sqrt(np.mean(claims**2))
    assert np.std(errors) / u == pytest.approx(1.0, abs=4 / math.sqrt(2 * TRIALS))
    # Ripple makes a parabola of K_III: a tenth of u at 1e-5, which only many trials show.
    left = second_stage(runs, ignored=["K_III"]).shift("K_III")[0] * TRUTH["K_III"]
    assert abs(left) < 0.15 * u
    assert abs(np.mean(errors) - left) < 4 * u / math.sqrt(TRIALS)
    assert coverage == pytest.approx(0.95, abs=4 * math.sqrt(0.95 * 0.05 / TRIALS))


@pytest.mark.slow
@pytest.mark.usefixtures("remembered_columns")
def test_printed_estimate_is_half_of_truth_without_coverage():
    runs = plan(drift=1e-6, ratio=5e-7, truth=TRUTH)
    options = {"model": "as-printed", "weighted": False}
    errors, _, coverage = simulate_trials(runs, options=options, count=200, bias_sd=0.0)
    # Beside the half stands the drift, which the printed column does not know.
    assert np.mean(errors) == pytest.approx(-1e-5, rel=1e-3)
    assert coverage == 0.0


def test_ripple_times_k_iii_biases_k_ii_as_predicted():
    biases = []
    for ratio in (5e-7, 1e-5, 1e-3):
        second_stage_result = second_stage(plan(ratio=ratio, truth=TRUTH))
        curvature = -0.75 * TRUTH["K_III"] * R**3 * RATES**6 * ratio * math.sin(PHASE) / G**2
        predicted = float(second_stage_result.gain[0] @ curvature)
        value, u = second_stage_result.estimate("K_II")
        # Beside it stand second orders of the ripple and rounding of 0.02 m/s^2.
        assert value - 2e-5 == pytest.approx(predicted, rel=0.01, abs=1e-13)
        assert float(second_stage_result.shift("K_III")[0]) * TRUTH["K_III"] == pytest.approx(
            predicted, rel=0.01, abs=1e-13
        )
        biases.append(abs(predicted) / u)
    # Lost in the noise up to 1e-5 of the rate, and many times the noise at 1e-3.
    assert biases[0] < 0.02
    assert biases[1] < 0.3
    assert biases[2] > 5.0


@pytest.mark.slow
@pytest.mark.usefixtures("remembered_columns")
def test_strong_ripple_requires_considered_k_iii_for_coverage():
    runs = plan(ratio=1e-3, truth=TRUTH)
    _, _, ignoring = simulate_trials(runs, count=200)
    assert ignoring < 0.01
    _, _, considering = simulate_trials(runs, count=200, priors={"K_III": (0.0, 4e-6)})
    assert considering > 0.95
