"""Readings: closed forms, and Monte-Carlo with machines drawn from their priors."""

import math
import os
from dataclasses import replace

import numpy as np
import pytest
from reading_campaigns import (
    TRUTH,
    make_arm_test,
    make_considered,
    make_model,
    make_readings,
    make_tumble,
    make_unknown,
    simulate_readings,
)
from scipy import stats
from scipy.special import stdtrit
from stations import Station

from counterspin.calibration.calibrate import calibrate
from counterspin.campaign.memory import make_campaign
from counterspin.errors import ConvergenceError, NotIdentifiableError
from counterspin.inference.identifiability import assess
from counterspin.inference.noise.likelihood import RecordData
from counterspin.inference.noise.model import ESTIMATE, Noise
from counterspin.inference.noise.search import estimate_noise
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.terms import TERMS
from counterspin.readings.fit import solve_readings

FULL = 2000 if os.environ.get("COUNTERSPIN_FULL") else None
SIGMA = 2e-6


def test_noise_free_readings_return_truth():
    rng = np.random.default_rng(1)
    tests = [make_tumble(), make_arm_test()]
    groups = [make_readings(test, simulate_readings(test, rng, 0.0), SIGMA) for test in tests]
    fit = solve_readings(groups, make_model())
    nominal = np.array([TERMS[s].nominal for s in TRUTH])
    np.testing.assert_allclose(
        fit.solution.estimate + nominal, list(TRUTH.values()), rtol=1e-9, atol=1e-15
    )


@pytest.mark.parametrize("seed", range(4))
def test_fit_converges_with_insensitive_term(seed):
    """A mean keeps the square of the spindle's tilt only, whose derivative is mostly rounding."""
    tilt = [
        make_unknown(f"centrifuge.axis_tilt.{axis}", (0.0, 5e-5), "") for axis in ("east", "north")
    ]
    tests = [make_tumble(), make_arm_test()]
    rng = np.random.default_rng(seed)
    groups = [make_readings(test, simulate_readings(test, rng, 2e-8), 2e-8) for test in tests]
    fit = solve_readings(groups, make_model(others=tilt))
    assert np.all(fit.solution.u[-2:] <= 5e-5 * (1.0 + 1e-12))
    assert np.all(np.abs(fit.solution.estimate[-2:]) < 2e-4)


@pytest.mark.parametrize("seed", range(3))
def test_fit_converges_with_large_considered_terms(seed):
    """Turns of the fixtures look like each other's; what is considered is 100 times the noise."""
    turns = ("inward.up", "outward.up", "inward.forward")
    first, *other_symbols = (f"fixture.misalignment.{turn}" for turn in turns)
    held = {"K_IP": 9e-7, "K_PO": 2.9e-6, "K_4": 5.5e-10, first: 5e-5}
    beside = {"delta_O": 3.3e-5, "delta_P": 3.3e-5} | dict.fromkeys(other_symbols, 5e-5)
    tilts = {"centrifuge.axis_tilt.north": 5e-5, "centrifuge.axis_tilt.east": 5e-5}

    def owner(symbol):
        return "A" if symbol in TERMS else ""

    model = make_model(
        others=[make_unknown(s, (0.0, u), owner(s)) for s, u in held.items()],
        considered=[make_considered(s, u, owner(s)) for s, u in (beside | tilts).items()],
    )
    rng = np.random.default_rng(seed)
    drawn = {s: rng.normal(0.0, u) for s, u in (held | beside | tilts).items()}
    truth = TRUTH | {s: size for s, size in drawn.items() if s in TERMS}
    machine = {s: size for s, size in drawn.items() if s not in TERMS}
    groups = [
        make_readings(test, simulate_readings(test, rng, 5e-7, machine, truth=truth), 5e-7)
        for test in (make_tumble(), make_arm_test())
    ]
    solution = solve_readings(groups, model).solution
    wanted = [(truth | machine)[u.symbol] - u.nominal for u in model.unknowns]
    assert np.all(np.abs(solution.estimate - wanted) < 3.3 * solution.u)


def test_u_of_tumble_matches_textbook():
    terms = ("K_F", "K_I", "delta_O", "K_II", "K_IP")
    fit = solve_readings([make_readings(make_tumble(), np.zeros(12), SIGMA)], make_model(terms))
    expected = [0.5, 0.408248, 0.408248, 0.816497, 0.816497]
    np.testing.assert_allclose(fit.solution.u / SIGMA, expected, rtol=0, atol=6e-7)


def test_head_error_on_double_turntable_equals_error_at_rest():
    """With the input axis level the mean changes by g times the angle."""
    level = Mounting.from_axes([1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    station = Station("counter-rotating", level, rate=3.0, radius=1.0)
    test = [station] * 4, [""] * 4, np.tile([0.0, 1.0, 0.0], (4, 1))
    truth = {"K_F": 0.0}
    values = simulate_readings(test, np.random.default_rng(5), 0.0, u_head=1e-4, truth=truth)
    errors = np.random.default_rng(5).normal(0.0, 1e-4, 4)
    np.testing.assert_allclose(np.abs(values), np.abs(errors), rtol=1e-6)
    fit = solve_readings([make_readings(test, values, SIGMA, u_head=1e-4)], make_model(("K_F",)))
    np.testing.assert_allclose(fit.groups[0].sigma, math.hypot(SIGMA, 1e-4), rtol=1e-7)


def test_terms_undetermined_at_one_g_are_identified():
    """a_I^2 + a_P^2 + a_O^2 = 1 at rest, in whatever attitude."""
    terms = ("K_F", "K_I", "K_II", "K_PP", "K_OO")
    model = make_model(terms)
    fit = solve_readings([make_readings(make_tumble(24), np.zeros(24), SIGMA)], model)
    assessment = assess(fit.solution, [u.symbol for u in model.unknowns])
    assert not any(assessment.determined[s] for s in ("K_F", "K_II", "K_PP", "K_OO"))
    assert assessment.determined["K_I"]


def test_error_of_one_position_has_largest_standardised_residual():
    rng = np.random.default_rng(3)
    values = simulate_readings(make_tumble(), rng, SIGMA)
    values[5] += 160e-6
    fit = solve_readings(
        [make_readings(make_tumble(), values, SIGMA)], make_model(("K_F", "K_I", "delta_O"))
    )
    sizes = [abs(each.standardized) for each in fit.groups[0].single_readings]
    assert np.argmax(sizes) == 5
    assert sizes[5] > 50.0


def test_noise_matches_likelihood_search_of_records():
    """Of the same rows, repeats and priors: the one is stepped to, the other searched for."""
    rng = np.random.default_rng(31)
    values = [simulate_readings(make_tumble(), rng, SIGMA, u_head=0.0) for _ in range(4)]
    # The head's error is that of a position, which its repeats share.
    mean = np.mean(values, axis=0) + simulate_readings(make_tumble(), rng, 0.0, u_head=5e-7)
    mean -= simulate_readings(make_tumble(), rng, 0.0)
    group = replace(
        make_readings(make_tumble(), mean, None, u_head=5e-7),
        repeats=np.full(12, 4.0),
        scatter=np.sum((np.array(values) - np.mean(values, axis=0)) ** 2, axis=0),
    )
    prior = make_unknown("K_I", (TRUTH["K_I"], 1e-6))
    model = make_model(("K_F", "K_II", "delta_O"), [prior])
    fit = solve_readings([group], model)
    part = fit.groups[0].linear
    assert 0.0 < part.noise_share.min() < 0.95
    time, nothing = np.arange(12.0), np.empty((36, 0))
    added = 4.0 * part.other_sd**2
    rows = RecordData(
        time, 0, part.design, part.target, group.repeats, 1e-9, part.unknowns, added_variance=added
    )
    scatter = np.full(36, math.sqrt(group.scatter.sum() / 36.0))
    repeats = RecordData(np.arange(36.0), 0, nothing, scatter, column_indices=())
    known = np.zeros((1, 4))
    known[0, 3] = 1.0 / prior.prior[1]
    noise = estimate_noise(
        [rows, repeats], Noise(ESTIMATE), known, [prior.prior_mean / prior.prior[1]]
    )
    assert fit.groups[0].noise == pytest.approx(noise.noise.white, rel=1e-5)


def test_repeats_and_residuals_determine_noise():
    """By the mean and scatter of repeats the fit finds what it finds from all of them, one by one.

    The head's random error is shared by the repeats of a setting, and so has no part here.
    """
    rng = np.random.default_rng(11)
    stations, mountings, head = make_tumble()
    model = make_model(("K_F", "K_I", "delta_O"))
    values = [simulate_readings(make_tumble(), rng, SIGMA) for _ in range(5)]
    every = (stations * 5, mountings * 5, np.tile(head, (5, 1)))
    apart = solve_readings([make_readings(every, np.concatenate(values), None)], model)
    together = replace(
        make_readings(make_tumble(), np.mean(values, axis=0), None),
        repeats=np.full(12, 5.0),
        scatter=np.sum((np.array(values) - np.mean(values, axis=0)) ** 2, axis=0),
    )
    fit = solve_readings([together], model)
    np.testing.assert_allclose(fit.solution.estimate, apart.solution.estimate, atol=1e-15)
    np.testing.assert_allclose(fit.solution.u, apart.solution.u, rtol=1e-5)
    assert fit.groups[0].noise_dof == pytest.approx(apart.groups[0].noise_dof, abs=1e-6)
    assert fit.groups[0].noise_dof == pytest.approx(57.0, abs=1e-6)


def test_readings_of_same_position_are_tested_together():
    """The sum of the residuals of a position over its deviation, as the definition has it."""
    rng = np.random.default_rng(12)
    stations, mountings, head = make_tumble()
    every = (stations * 2, mountings * 2, np.tile(head, (2, 1)))
    values = simulate_readings(every, rng, SIGMA)
    model = make_model(("K_F", "K_I", "delta_O"))
    fit = solve_readings([make_readings(every, values, SIGMA)], model)
    assert [p.indices for p in fit.groups[0].positions] == [(i, i + 12) for i in range(12)]
    x = np.array([[1.0, np.cos(a), np.sin(a)] for a in np.arange(24) * np.pi / 6])
    left_over = np.eye(24) - x @ np.linalg.solve(x.T @ x, x.T)
    for p in fit.groups[0].positions:
        v = np.zeros(24)
        v[list(p.indices)] = 1.0
        z = v @ fit.groups[0].residuals / (SIGMA * np.sqrt(v @ left_over @ v))
        assert p.standardized == pytest.approx(z, rel=1e-6)
        assert p.residual == pytest.approx(
            fit.groups[0].residuals[list(p.indices)].mean(), abs=1e-18
        )


def test_studentised_residual_matches_fit_without_reading():
    """Its distance from that prediction, over u of prediction and reading by the others' noise."""
    values = simulate_readings(make_tumble(), np.random.default_rng(13), SIGMA)
    model = make_model(("K_F", "K_I", "delta_O"))
    every = (
        solve_readings([make_readings(make_tumble(), values, None)], model)
        .groups[0]
        .single_readings
    )
    x = np.array([[1.0, np.cos(a), np.sin(a)] for a in np.arange(12) * np.pi / 6])
    for k, reading in enumerate(every):
        others = np.delete(x, k, axis=0)
        solution, (squares,), *_ = np.linalg.lstsq(others, np.delete(values, k), rcond=None)
        variance = squares / 8.0 * (1.0 + x[k] @ np.linalg.solve(others.T @ others, x[k]))
        t = (values[k] - x[k] @ solution) / math.sqrt(variance)
        assert reading.studentized == pytest.approx(t, rel=1e-4)
        assert reading.p == pytest.approx(2.0 * stats.t.sf(abs(t), 8.0), rel=1e-3)


def test_noise_with_head_error_has_dof_of_repeats():
    """A head of ten times the noise: what positions scatter by tells nothing of that."""
    rng, repeats = np.random.default_rng(14), 3
    stations, mountings, head = make_tumble()
    exact = simulate_readings(make_tumble(), rng, 0.0, u_head=10.0 * SIGMA)
    read = exact[:, None] + rng.normal(0.0, SIGMA, (12, repeats))
    group = replace(
        make_readings((stations, mountings, head), read.mean(axis=1), None, u_head=10.0 * SIGMA),
        repeats=np.full(12, float(repeats)),
        scatter=np.sum((read - read.mean(axis=1, keepdims=True)) ** 2, axis=1),
    )
    fit = solve_readings([group], make_model(("K_F", "K_I", "delta_O")))
    # As the definition has it: the trace of (P V)^2 of the restricted likelihood.
    x = np.array([[1.0, np.cos(a), np.sin(a)] for a in np.arange(12) * np.pi / 6])
    of_noise = np.eye(12) * fit.groups[0].noise ** 2 / repeats
    weight = np.linalg.inv(np.diag(fit.groups[0].sigma ** 2))
    left = weight - weight @ x @ np.linalg.solve(x.T @ weight @ x, x.T @ weight)
    exactly = np.trace(left @ of_noise @ left @ of_noise) + 12 * (repeats - 1)
    assert fit.groups[0].noise_dof == pytest.approx(exactly, rel=1e-4)
    assert 24.0 < fit.groups[0].noise_dof < 28.0
    # Four standard deviations of a noise of as many degrees of freedom.
    assert abs(fit.groups[0].noise / SIGMA - 1.0) < 4.0 / math.sqrt(2.0 * fit.groups[0].noise_dof)


def test_fewer_readings_than_unknowns_raise_without_u():
    values = simulate_readings(make_tumble(3), np.random.default_rng(2), SIGMA)
    with pytest.raises(NotIdentifiableError, match="without a stated uncertainty"):
        solve_readings(
            [make_readings(make_tumble(3), values, None)], make_model(("K_F", "K_I", "delta_O"))
        )


# What varies: the readings' noise, the head, and the machine, which is drawn from its priors.

U_STRETCH, U_DROOP, U_RADIUS, U_HEAD, U_ZERO, U_TURN = 5e-9, 2e-8, 2e-6, 5e-6, 2e-5, 5e-5
STRETCH = make_considered("centrifuge.stretch", U_STRETCH)
DROOP = make_considered("centrifuge.droop", U_DROOP)
TILT = [make_considered(f"centrifuge.axis_tilt.{axis}", U_TURN) for axis in ("east", "north")]
#: Slopes with the prior's u of each; temperatures rise and fall by kelvins, minutes pass.
SLOPES = {
    "K_F.temperature": 5e-6,
    "K_I.temperature": 1e-5,
    "K_F.temperature.2": 1e-6,
    "K_I.temperature.3": 1e-6,
    "K_II.temperature": 1e-8,
    "K_F.trend": 2e-9,
}
WARM = {"temperature": 2.0 * np.sin(np.arange(24.0))}


def unknown_radius(side):
    return make_unknown(f"centrifuge.radius.{side}", (0.0, U_RADIUS), "")


def fixture_misalignment(side, kind=make_unknown):
    return [
        kind(f"fixture.misalignment.{side}.{axis}", (0.0, U_TURN), "")
        for axis in ("outward", "forward", "up")
    ]


def machine_term(symbol, u):
    """An estimated term of the machine, the same for all accelerometers."""
    return make_unknown(symbol, (0.0, u), "")


SIDES = ("inward", "outward")
CASES = {
    "tumble": ([make_tumble()], make_model(("K_F", "K_I", "delta_O")), {"u_head": U_HEAD}),
    "tumble, head considered": (
        [make_tumble()],
        make_model(("K_F", "K_I", "K_III"), considered=(make_considered("head.zero", U_ZERO),)),
        {"u_head": U_HEAD},
    ),
    "arm": ([make_arm_test()], make_model(others=tuple(map(unknown_radius, SIDES))), {}),
    "arm, machine considered": (
        [make_arm_test()],
        make_model(
            considered=(
                STRETCH,
                DROOP,
                *TILT,
                *(make_considered(f"centrifuge.radius.{side}", U_RADIUS) for side in SIDES),
                *(
                    make_considered(f"fixture.misalignment.{side}.{axis}", U_TURN)
                    for side in SIDES
                    for axis in ("outward", "forward", "up")
                ),
            )
        ),
        {},
    ),
    "arm, machine estimated": (
        [make_arm_test()],
        make_model(
            others=(
                machine_term("centrifuge.stretch", U_STRETCH),
                machine_term("centrifuge.droop", U_DROOP),
                *(term for side in SIDES for term in fixture_misalignment(side)),
            )
        ),
        {},
    ),
    "arm, stretch estimated": (
        [make_arm_test()],
        make_model(others=(machine_term("centrifuge.stretch", U_STRETCH),)),
        {},
    ),
    "arm, slopes estimated": (
        [make_arm_test()],
        make_model(others=tuple(make_unknown(s, (0.0, u)) for s, u in SLOPES.items())),
        WARM,
    ),
    "arm, slopes considered": (
        [make_arm_test()],
        make_model(considered=tuple(make_considered(s, u, "A") for s, u in SLOPES.items())),
        WARM,
    ),
    "mixed": (
        [make_tumble(), make_arm_test()],
        make_model(
            (*TRUTH, "delta_O"),
            others=(machine_term("head.zero", U_ZERO), *map(unknown_radius, SIDES)),
            considered=(STRETCH, DROOP),
        ),
        {"u_head": U_HEAD},
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("stated", [True, False], ids=["noise stated", "noise estimated"])
@pytest.mark.parametrize("case", CASES)
def test_fit_is_unbiased_and_has_coverage(case, stated):
    tests, model, more = CASES[case]
    everything = [*model.unknowns, *model.considered]
    trials = FULL or 12
    rng = np.random.default_rng(sum(map(ord, case)))
    own = {u.symbol: TRUTH.get(u.symbol, 0.0) for u in model.unknowns if u.symbol in TERMS}
    z, t, square = [], [], 0.0
    for _ in range(trials):
        drawn = {u.symbol: rng.normal(0.0, u.prior[1]) for u in everything if u.symbol not in TERMS}
        machine = {s: size for s, size in drawn.items() if s not in SLOPES}
        truth = own | {s: size for s, size in drawn.items() if s in SLOPES}
        groups = [
            make_readings(
                test,
                simulate_readings(test, rng, SIGMA, machine, truth=truth, **more),
                SIGMA if stated else None,
                **more,
            )
            for test in tests
        ]
        fit = solve_readings(groups, model)
        wanted = np.array([own.get(u.symbol, drawn.get(u.symbol)) for u in model.unknowns])
        nominal = np.array([u.nominal for u in model.unknowns])
        off = fit.solution.estimate + nominal - wanted
        z.append(off / fit.solution.u)
        t.append(stdtrit(satterthwaite_dof(fit), 0.975))
        square += off @ np.linalg.solve(fit.solution.covariance, off)
    z = np.array(z)
    # Four standard errors of a mean, and of a share of 95 %, of so many trials.
    assert np.abs(z.mean(axis=0)).max() < 4.0 * 1.1 / math.sqrt(trials)
    slack = 4.0 * math.sqrt(0.05 * 0.95 / trials)
    share = np.mean(np.abs(z) < (1.96 if stated else np.array(t)), axis=0)
    if stated:
        assert np.abs(share - 0.95).max() < slack
        # Together they are chi-square: one in 10,000 is outside.
        low, high = stats.chi2.ppf([5e-5, 1.0 - 5e-5], z.size)
        assert low < square < high
    else:
        # Welch and Satterthwaite's intervals cover at least that.
        assert share.min() > 0.95 - slack


def satterthwaite_dof(fit):
    """Satterthwaite's degrees of freedom of each unknown, from the definition."""
    total = np.diag(fit.solution.covariance)
    dof = []
    ends = np.cumsum([block.factor.shape[0] for block in fit.fit.blocks])
    for k, direction in enumerate(np.eye(total.size)):
        rows = fit.solution.combine(direction).noise_rows
        parts = [float(part @ part) for part in np.split(rows, ends[:-1])]
        short = sum(
            part**2 / own
            for part, own in zip(parts, (g.noise_dof for g in fit.groups), strict=True)
        )
        dof.append(total[k] ** 2 / short if short > 0.0 else np.inf)
    return dof


def test_non_convergence_names_reading_with_wrong_sign():
    """It drives turns that are known to arcseconds so far that nothing is linear: NaN, before."""
    machine = (
        *(term for side in SIDES for term in fixture_misalignment(side)),
        *map(unknown_radius, SIDES),
    )
    test = make_arm_test()
    values = simulate_readings(test, np.random.default_rng(3), SIGMA)
    values[7] = -values[7]
    with pytest.raises(ConvergenceError, match='"position 7", which deviates most'):
        solve_readings([make_readings(test, values, SIGMA)], make_model(others=machine))


#: Readings of two accelerometers on six faces that were set by hand, g: x axis, y axis, X and Z.
FACES = {
    "x up": ("up", "north", 1.0087727, -0.0591127),
    "x down": ("down", "north", -1.0148023, -0.0618670),
    "y up": ("north", "up", 0.0014354, -0.0661979),
    "y down": ("north", "down", 0.0121092, -0.0872141),
    "z up": ("east", "north", 0.0121059, 0.9203954),
    "z down": ("north", "east", -0.0029772, -1.0673377),
}


def test_fit_of_oscillating_positioning_errors_converges():
    axes = {"X": ("east", "down"), "Z": ("up", "east")}
    description = {
        "schema": 1,
        "site": {"gravity": "9.8066 m/s^2", "latitude": "45.75 deg"},
        "fixture": {"position": "0 ± 0.5 deg"},
        "accelerometers": {
            name: {"grade": "consumer", "input_axis": input_axis, "pendulous_axis": pendulous_axis}
            for name, (input_axis, pendulous_axis) in axes.items()
        },
        "model": {"terms": ["K_F", "K_I", "delta_O", "delta_P"]},
        "runs": [
            {
                "name": name,
                "motion": "static",
                "attitude": {"x": x_direction, "y": y_direction},
                "reading": {"X": f"{x_reading} ± 0.0002 g", "Z": f"{z_reading} ± 0.0002 g"},
            }
            for name, (x_direction, y_direction, x_reading, z_reading) in FACES.items()
        ],
    }
    coefficients = calibrate(make_campaign(description)).accelerometers["X"].coefficients
    # True value of the simulation; u is far larger than the noise.
    assert abs(coefficients["K_I"].value - 1.0120) < 3.0 * coefficients["K_I"].u
