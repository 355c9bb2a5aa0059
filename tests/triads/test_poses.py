"""Poses at unknown attitudes against a dense least squares over all their angles."""

import math
import os
import time

import numpy as np
import pytest
from raising import raises
from scipy import stats
from scipy.optimize import least_squares

import triads
from counterspin.errors import NotIdentifiableError
from counterspin.inference.joint.unknowns import Unknown, Unknowns
from counterspin.readings.fit import solve_readings
from counterspin.readings.joint_data import estimate_with_groups

FULL = bool(os.environ.get("COUNTERSPIN_FULL"))
#: g.
NOISE = 3e-4


def _dense(values, weight):
    """Return the nine parameters and their covariance from a dense fit of all unknowns."""
    n = len(values)
    start = values - values.mean(axis=0)
    along = start / np.linalg.norm(start, axis=1)[:, None]
    azimuth, height = np.arctan2(along[:, 1], along[:, 0]), np.arcsin(along[:, 2])
    # Rotated so that no pose of these stands at a pole.
    first = np.concatenate([np.zeros(3), [1.0, 0.0, 1.0, 0.0, 0.0, 1.0], azimuth, height])

    def left(x):
        rows = np.array([[x[3], 0.0, 0.0], [x[4], x[5], 0.0], [x[6], x[7], x[8]]])
        phi, theta = x[9 : 9 + n], x[9 + n :]
        unit = np.column_stack(
            [np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), np.sin(theta)]
        )
        return (weight * (values - unit @ rows.T - x[:3])).ravel()

    actual_least_squares = least_squares(
        left, first, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    triangle = np.linalg.qr(actual_least_squares.jac, mode="r")
    inverse = np.linalg.inv(triangle)
    covariance = (inverse @ inverse.T)[:9, :9]
    freedom = 3 * n - first.size
    return (
        triads.SIGNS * actual_least_squares.x[:9],
        covariance,
        float(actual_least_squares.fun @ actual_least_squares.fun) / freedom,
    )


def _nominal():
    return np.array([1.0 if symbol == "K_I" else 0.0 for _, symbol in triads.PARAMETERS])


@pytest.mark.parametrize("stated", [True, False])
def test_fit_matches_dense_fit_with_all_angles(stated):
    generator = np.random.default_rng(4)
    along = triads.draw_directions(25, generator)
    values = triads.compute_indications(along) + NOISE * generator.standard_normal((25, 3))
    # Where it is stated, each accelerometer has its own.
    u = NOISE * np.array([1.0, 2.0, 0.5]) if stated else None
    expected, covariance, scale = _dense(values, 1.0 / u if stated else np.ones(3))
    fit = solve_readings([triads.make_poses(values, u)], triads.make_unknowns())
    if not stated:
        covariance = covariance * scale
        (group,) = fit.groups
        assert group.noise == pytest.approx(math.sqrt(scale), rel=1e-6)
        assert group.noise_dof == pytest.approx(16.0, abs=1e-6)
    u_of = np.sqrt(np.diag(covariance))
    estimate = fit.solution.estimate + _nominal()
    assert np.max(np.abs(estimate - expected) / u_of) < 1e-6
    # The derivatives of the dense fit are differences, good to seven digits.
    signs = np.outer(triads.SIGNS, triads.SIGNS)
    np.testing.assert_allclose(
        fit.solution.covariance / np.outer(u_of, u_of),
        signs * covariance / np.outer(u_of, u_of),
        atol=2e-5,
    )


def test_sensor_with_large_errors_needs_no_initial_guess():
    rows = np.array([[1.4, 0.0, 0.0], [0.2, 0.7, 0.0], [-0.15, 0.1, 1.2]])
    bias = np.array([0.9, -0.6, 0.4])
    along = triads.draw_directions(15, np.random.default_rng(2))
    values = triads.compute_indications(along, rows, bias)
    fit = solve_readings([triads.make_poses(values, 1e-4)], triads.make_unknowns())
    estimate = fit.solution.estimate + _nominal()
    np.testing.assert_allclose(estimate, triads.true_parameters(rows, bias), atol=1e-9)


def test_nine_poses_without_noise_determine_nine_parameters():
    along = triads.draw_directions(9, np.random.default_rng(5))
    fit = solve_readings(
        [triads.make_poses(triads.compute_indications(along), 1e-4)], triads.make_unknowns()
    )
    estimate = fit.solution.estimate + _nominal()
    np.testing.assert_allclose(estimate, triads.true_parameters(), atol=1e-9)


def test_fewer_poses_than_unknowns_raise():
    along = np.vstack([np.eye(3), -np.eye(3)])
    with raises("not-identifiable", "6 poses", "9 unknowns", "Y.delta_P", "Z.delta_O, Z.delta_P"):
        solve_readings(
            [triads.make_poses(triads.compute_indications(along))], triads.make_unknowns()
        )
    # Nine could tell biases and scale factors alone, six not even those.
    noisy = triads.compute_indications(triads.draw_directions(9, np.random.default_rng(3)))
    noisy += 1e-4 * np.random.default_rng(4).standard_normal((9, 3))
    for values, fewer in ((noisy, True), (noisy[:6], False)):
        with pytest.raises(NotIdentifiableError) as error:
            solve_readings([triads.make_poses(values)], triads.make_unknowns())
        assert ('terms = ["K_F", "K_I"]' in str(error.value)) is fewer


@pytest.fixture(scope="module")
def model_with_default_priors():
    """Return the model of a triad with 18 second-order terms at default priors."""
    sizes = {"K_II": 1e-3, **dict.fromkeys(("K_PP", "K_OO", "K_IP", "K_IO", "K_PO"), 2e-4)}
    unstated = (
        Unknown(name, symbol, (0.0, size), 0.1, False, True)
        for name in triads.NAMES
        for symbol, size in sizes.items()
    )
    return Unknowns((*triads.make_unknowns().unknowns, *unstated))


def _few(model, generator):
    """Return 13 poses without stated uncertainty; draw the second-order terms."""
    values = triads.compute_indications(triads.draw_directions(13, generator))
    true = np.append(triads.true_parameters() - _nominal(), np.zeros(18))
    probe = triads.make_poses(values)
    columns = probe.linearize(model, true).design[:, 9:]
    drawn = np.array(
        [unknown.prior[1] for unknown in model.unknowns[9:]]
    ) * generator.standard_normal(18)
    off = columns @ drawn + NOISE * generator.standard_normal(13)
    return triads.make_poses(values + probe.at(model, true).projection * off[:, None])


def test_few_poses_with_default_priors_have_coverage(model_with_default_priors):
    # They cannot tell their noise beside 16 combinations of terms. Four standard deviations of how
    # often the nine 50 % intervals of one triad hold.
    generator, trials = np.random.default_rng(5), 300 if FULL else 30
    z, dof = np.empty((trials, 9)), np.empty((trials, 9))
    for trial in range(trials):
        poses = _few(model_with_default_priors, generator)
        estimated, _ = estimate_with_groups(None, model_with_default_priors, [poses])
        solution, dof[trial] = estimated.fit.solution, estimated.dof[:9]
        z[trial] = (solution.estimate[:9] + _nominal() - triads.true_parameters()) / solution.u[:9]

    def hold(part, times=1.0):
        held = np.mean(np.abs(z) < times * stats.t.ppf(0.5 + 0.5 * part, dof), axis=1)
        return (held.mean() - part) / (held.std() / math.sqrt(trials))

    assert abs(hold(0.5)) < 4.0
    assert hold(0.95) > -4.0
    # Enough to see u half or twice as large.
    assert hold(0.5, 0.5) < -4.0
    assert hold(0.5, 2.0) > 4.0


def test_few_poses_match_dense_least_squares(model_with_default_priors):
    model = model_with_default_priors
    poses = _few(model, np.random.default_rng(7))
    estimated, (part,) = estimate_with_groups(None, model, [poses])
    solution = estimated.fit.solution
    design = poses.linearize(model, solution.estimate).design
    shared = design[:, 9:] * [unknown.prior[1] for unknown in model.unknowns[9:]]
    total = part.noise**2 * np.eye(13) + shared @ shared.T
    covariance = np.linalg.inv(design[:, :9].T @ np.linalg.solve(total, design[:, :9]))
    np.testing.assert_allclose(solution.u[:9], np.sqrt(np.diag(covariance)), rtol=1e-6)


def test_second_order_terms_are_estimated_exactly_without_noise():
    squares = np.array([2e-3, -1e-3, 3e-3])
    along = triads.draw_directions(60, np.random.default_rng(8))
    values = triads.compute_indications(along, squares=squares)
    model = triads.make_unknowns([(name, "K_II") for name in triads.NAMES])
    fit = solve_readings([triads.make_poses(values, 1e-4)], model)
    estimate = fit.solution.estimate
    np.testing.assert_allclose(estimate[9:], squares, atol=1e-9)
    np.testing.assert_allclose(estimate[:9] + _nominal(), triads.true_parameters(), atol=1e-9)


def test_outlying_pose_has_smallest_p_value():
    generator = np.random.default_rng(11)
    values = triads.compute_indications(triads.draw_directions(30, generator))
    values += NOISE * generator.standard_normal(values.shape)
    values[7] *= 1.0 + 12.0 * NOISE
    fit = solve_readings([triads.make_poses(values)], triads.make_unknowns())
    p = np.array([single.p for single in fit.groups[0].single_readings])
    assert np.argmin(p) == 7
    assert p[7] < 1e-4 < np.min(np.delete(p, 7))


def test_z_scores_of_parameters_are_normal():
    # Of 40 triads with 9 parameters each; the bound is that of chi-square at 4.5 sigma.
    generator, trials = np.random.default_rng(21), 40
    squares = 0.0
    for _ in range(trials):
        values = triads.compute_indications(triads.draw_directions(24, generator))
        values += NOISE * generator.standard_normal(values.shape)
        fit = solve_readings([triads.make_poses(values, NOISE)], triads.make_unknowns())
        off = fit.solution.estimate + _nominal() - triads.true_parameters()
        squares += float(off @ np.linalg.solve(fit.solution.covariance, off))
    assert squares / (9 * trials) == pytest.approx(1.0, abs=4.5 * math.sqrt(2.0 / (9 * trials)))


#: Triads at each number of poses; in full those of issue and documentation.
TRIADS = 300 if FULL else 30


@pytest.mark.parametrize(
    ("count", "stated"), [(10, True), (12, True), (24, True), (12, False), (24, False)]
)
def test_few_poses_have_coverage_with_and_without_stated_noise(count, stated):
    """z of the nine parameters (Student's t if the noise is estimated) are normally distributed.

    Those of one triad depend on each other, so the bound is from how the triads scatter: 4.5
    standard deviations of the mean square. In full also the rms itself, 0.95 to 1.05.
    """
    generator = np.random.default_rng(100 + count)
    squares = np.empty(TRIADS)
    for trial in range(TRIADS):
        values = triads.compute_indications(triads.draw_directions(count, generator))
        values += NOISE * generator.standard_normal(values.shape)
        group = triads.make_poses(values, NOISE if stated else None)
        estimated, _ = estimate_with_groups(None, triads.make_unknowns(), [group])
        solution = estimated.fit.solution
        z = (solution.estimate + _nominal() - triads.true_parameters()) / solution.u
        if not stated:
            assert estimated.dof == pytest.approx(count - 9.0, abs=1e-6)
            z = stats.norm.ppf(stats.t.cdf(z, estimated.dof))
        squares[trial] = np.mean(z**2)
    off = (squares.mean() - 1.0) / (squares.std(ddof=1) / math.sqrt(TRIADS))
    assert abs(off) < 4.5
    # Enough to see u wrong by half; what is seen at full size is said in docs/trust.md.
    assert 0.5 < math.sqrt(squares.mean()) < 1.5
    if TRIADS == 300:
        assert 0.95 < math.sqrt(squares.mean()) < 1.05


def test_thousand_poses_need_less_than_ten_seconds():
    generator = np.random.default_rng(6)
    values = triads.compute_indications(triads.draw_directions(1000, generator))
    values += NOISE * generator.standard_normal(values.shape)
    begin = time.process_time()
    solve_readings([triads.make_poses(values)], triads.make_unknowns())
    assert time.process_time() - begin < 10.0  # a tenth of it on a quiet machine


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda values: 9.81 * values, "a magnitude of 9.6 to 10 g instead of 1 g"),
        (lambda values: 1e-3 * values, "g instead of 1 g; check the unit and the sensitivity"),
        (
            lambda values: np.column_stack([np.roll(values[:, 0], 1), values[:, 1:]]),
            "check whether the three columns belong together",
        ),
        (np.abs, "deg of their mean; measure poses in all directions"),
    ],
)
def test_divergence_has_reason(change, reason):
    directions = triads.draw_directions(24, np.random.default_rng(3))
    poses = triads.make_poses(change(triads.compute_indications(directions)))
    assert reason in poses.divergence_message(100)
