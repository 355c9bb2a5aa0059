"""Positions that are set by hand: closed forms, and Monte-Carlo with turns of SciPy's."""

import math
import os
from dataclasses import replace

import numpy as np
import pytest
from reading_campaigns import SITE, make_considered, make_readings, make_tumble, make_unknown
from scipy import stats
from scipy.spatial.transform import Rotation
from stations import Station, combine_stations

from counterspin.inference.joint.unknowns import Unknowns
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.conditions import AT_REFERENCE
from counterspin.readings.fit import solve_readings
from counterspin.readings.known_attitudes import Readings, linearize

SIGMA, SETTING = 1e-5, math.radians(0.3)
#: Where the body's axes x, y, z point, of each of its six faces.
FACES = [
    np.array(rows, dtype=float)
    for rows in (
        [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
        [[0, 0, -1], [0, 1, 0], [1, 0, 0]],
        [[0, 1, 0], [0, 0, 1], [1, 0, 0]],
        [[0, 1, 0], [0, 0, -1], [-1, 0, 0]],
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[0, 1, 0], [1, 0, 0], [0, 0, -1]],
    )
]
#: Input and pendulous axis of each accelerometer in the body.
AXES = {"X": ([1, 0, 0], [0, 0, -1]), "Z": ([0, 0, 1], [1, 0, 0])}
TRUTH = {
    "X": {"K_F": 0.05, "K_I": 0.997, "delta_O": 8e-3, "delta_P": -1.5e-2},
    "Z": {"K_F": -0.02, "K_I": 1.02, "delta_O": -1.1e-2, "delta_P": 9e-3},
}


def make_groups(values, sigma, repeats=1):
    """Return a group of each accelerometer that read every face `repeats` times; None: no u."""
    n = 6 * repeats
    return [
        Readings(
            accelerometer=name,
            motion="static",
            names=tuple(map(str, range(n))),
            site=SITE,
            stations=combine_stations(
                [
                    Station("static", Mounting.from_axes(*(np.array(axes) @ face)))
                    for face in FACES
                    for _ in range(repeats)
                ]
            ),
            mountings=("",) * n,
            head=np.zeros((n, 3)),
            u_head=np.zeros(n),
            value=values[name],
            u=None if sigma is None else np.full(n, sigma),
            conditions=AT_REFERENCE.at(np.zeros(n), 0.0),
            repeats=np.ones(n),
            scatter=np.zeros(n),
            position=tuple(str(k + 1) for k in range(6) for _ in range(repeats)),
        )
        for name, axes in AXES.items()
    ]


def make_model(setting, *, held=False):
    """Return four terms of each accelerometer, and the setting errors, which may be held."""
    own = tuple(
        replace(make_unknown(symbol, owner=name), limit=0.1)
        for name in AXES
        for symbol in TRUTH[name]
    )
    symbols = [f"fixture.position.{k}.{axis}" for k in range(1, 7) for axis in ("east", "north")]
    if held:
        return Unknowns(own, tuple(make_considered(symbol, setting) for symbol in symbols))
    return Unknowns((*own, *(make_unknown(s, (0.0, setting), "") for s in symbols)), ())


def indicate_force(errors):
    """Return what is read on faces that are turned wrongly, rad, shape (6, 2), by turns of up."""
    values = {name: [] for name in AXES}
    for face, (east, north) in zip(FACES, errors, strict=True):
        body = np.linalg.inv(face.T) @ (
            Rotation.from_rotvec([east, north, 0.0]).inv().apply([0.0, 0.0, 1.0])
        )
        for name, (input_axis, pendulous) in AXES.items():
            own, output = TRUTH[name], np.cross(input_axis, pendulous)
            a_i, a_p, a_o = (
                float(axis @ body) for axis in map(np.array, (input_axis, pendulous, output))
            )
            read = own["K_F"] + own["K_I"] * a_i + own["delta_O"] * a_p - own["delta_P"] * a_o
            values[name].append(read)
    return {name: np.array(own) for name, own in values.items()}


def simulate_and_solve(values, sigma, setting, repeats=1, *, held=False):
    """Return the fit, and the accelerometers' coefficients with their true values, (8,) each."""
    model = make_model(setting, held=held)
    fit = solve_readings(make_groups(values, sigma, repeats), model)
    estimates_and_truth = [
        (x + u.nominal, TRUTH[u.owner][u.symbol])
        for x, u in zip(fit.solution.estimate, model.unknowns, strict=True)
        if u.owner
    ]
    return fit, *np.array(estimates_and_truth).T


def test_face_attitudes_are_proper_rotations():
    assert all(np.linalg.det(face) == 1.0 for face in FACES)


def test_exactly_known_errors_return_truth():
    """The derivatives have the signs of turns of the body: here to their second order."""
    errors = 1e-4 * np.random.default_rng(3).standard_normal((6, 2))
    unknowns = make_model(1e-3).unknowns
    known = {
        f"fixture.position.{k + 1}.{axis}": float(errors[k, i])
        for k in range(6)
        for i, axis in enumerate(("east", "north"))
    }
    stated = tuple(
        u if u.owner else make_unknown(u.symbol, (known[u.symbol], 1e-9), "") for u in unknowns
    )
    fit = solve_readings(make_groups(indicate_force(errors), 1e-9), Unknowns(stated, ()))
    for u, x in zip(stated, fit.solution.estimate, strict=True):
        if u.owner:
            assert x + u.nominal == pytest.approx(TRUTH[u.owner][u.symbol], abs=5e-9)


@pytest.mark.parametrize("repeats", [1, 3])
def test_tilt_of_vertical_axis_has_quadratic_mean_and_variance(repeats):
    """1 - (e^2 + n^2)/2 has a mean of 1 - s^2 and a variance of s^4, common to all repeats."""
    zeros = {name: np.zeros(6 * repeats) for name in AXES}
    (group, _), model = make_groups(zeros, SIGMA, repeats), make_model(SETTING)
    part = linearize(group, model, np.zeros(len(model.unknowns)))
    upright, level = slice(0, 2 * repeats), slice(2 * repeats, None)
    np.testing.assert_allclose(
        np.abs(part.target[upright]), 1.0 - SETTING**2, rtol=0, atol=1e-5 * SETTING**2
    )
    np.testing.assert_allclose(part.other_sd[upright], SETTING**2 * math.sqrt(repeats), rtol=1e-5)
    np.testing.assert_allclose(part.target[level], 0.0, atol=1e-12)
    np.testing.assert_allclose(part.other_sd[level], 0.0, atol=1e-12)


@pytest.mark.parametrize("held", [False, True], ids=["weighed", "held"])
@pytest.mark.parametrize("repeats", [1, 4])
def test_u_of_misalignment_is_positioning_error_over_root_two(repeats, held):
    """Two positions show it, each off by itself; repeats lessen the noise's part alone."""
    values = {
        name: np.repeat(read, repeats) for name, read in indicate_force(np.zeros((6, 2))).items()
    }
    fit, *_ = simulate_and_solve(values, SIGMA, SETTING, repeats, held=held)
    for k, u in enumerate(make_model(SETTING).unknowns[:8]):
        if u.symbol.startswith("delta"):
            setting = TRUTH[u.owner]["K_I"] * SETTING
            expected = math.sqrt((SIGMA**2 / repeats + setting**2) / 2.0)
            assert fit.solution.u[k] == pytest.approx(expected, rel=1e-3)


def test_noise_estimate_includes_indistinguishable_positioning_errors():
    """Each face read once, no u stated: of six readings and four unknowns two are left."""
    rng = np.random.default_rng(6)
    sizes, largest = [], []
    for _ in range(20):
        read = indicate_force(rng.normal(0.0, SETTING, (6, 2)))
        values = {name: own + rng.normal(0.0, SIGMA, 6) for name, own in read.items()}
        fit, estimates, truth = simulate_and_solve(values, None, SETTING)
        assert [group.noise_dof for group in fit.groups] == pytest.approx([2.0, 2.0])
        sizes += [group.noise for group in fit.groups]
        z = np.abs(estimates - truth) / fit.solution.u[:8]
        largest.append(float(z.max()))
        assert fit.solution.u[2] > SETTING / math.sqrt(2.0)
    # Of the two that are left, one is between level faces and upright ones.
    assert 0.5 * SETTING < np.sqrt(np.mean(np.square(sizes))) < 1.5 * SETTING
    assert np.median(largest) < stats.t.ppf(0.975, 2.0)


@pytest.mark.slow
def test_small_hand_set_tumbles_have_coverage():
    """Bodies on six faces, each face read twice, of half of them the noise estimated.

    An upright axis is off by the square, 2.7e-5 g in the mean, beside a noise of 1e-5 g, and by the
    setting error times its misalignment.
    """
    rng, trials, repeats, z = (
        np.random.default_rng(20),
        200 if os.environ.get("COUNTERSPIN_FULL") else 30,
        2,
        [],
    )
    for trial in range(trials):
        read = indicate_force(rng.normal(0.0, SETTING, (6, 2)))
        values = {
            name: np.repeat(own, repeats) + rng.normal(0.0, SIGMA, 6 * repeats)
            for name, own in read.items()
        }
        fit, estimates, truth = simulate_and_solve(
            values, None if trial % 2 else SIGMA, SETTING, repeats
        )
        z.append((estimates - truth) / fit.solution.u[:8])
    # Bounds that one of eight coefficients passes by chance in some thousand changes of the seed.
    rms, inside = np.sqrt(np.mean(np.square(z), axis=0)), np.sum(np.abs(z) < 1.96, axis=0)
    low, high = np.sqrt(stats.chi2.ppf([1e-5, 1.0 - 1e-5], trials) / trials)
    assert low < rms.min()
    assert rms.max() < high
    assert inside.min() >= stats.binom.ppf(1e-5, trials, 0.95)
    assert np.abs(np.mean(z, axis=0)).max() < 4.4 / math.sqrt(trials)


def test_residual_moments_match_full_matrix():
    """R = 1 - rows C rows' of a fit with priors: traces of its powers, and draws of noise."""
    rng = np.random.default_rng(3)
    group = replace(make_readings(make_tumble(), np.zeros(12), SIGMA), value=np.ones(12))
    others = (
        make_unknown("K_PP", (0.0, 0.3 * SIGMA)),
        make_unknown("head.zero", (0.0, SIGMA), owner=""),
    )
    own = (make_unknown("K_F"), make_unknown("K_I"))
    fit = solve_readings([group], Unknowns((*own, *others)))
    part, solution = fit.groups[0].linear, fit.solution
    rows = part.design / part.sigma[:, None]
    left = np.eye(12) - rows @ solution.weighted_covariance @ rows.T
    squares = np.linalg.eigvalsh(left) ** 2
    scale, dof = part.noise_moments(solution)
    assert scale * dof == pytest.approx(squares.sum(), rel=1e-9)
    assert 2.0 * scale**2 * dof == pytest.approx(2.0 * np.sum(squares**2), rel=1e-9)
    drawn = np.sum((left @ rng.standard_normal((12, 20_000))) ** 2, axis=0)
    # The distribution itself, at its lower tail: 200 of 20,000 within 4 standard deviations.
    below = np.mean(drawn < scale * stats.chi2.ppf(0.01, dof))
    assert below == pytest.approx(0.01, abs=4.0 * np.sqrt(0.01 / 20_000))
