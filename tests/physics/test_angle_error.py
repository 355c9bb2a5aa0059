"""How far a fitted spindle may be from the true one: functions, covariance, the motion's change."""

import math
from dataclasses import replace

import numpy as np
import pytest

from counterspin.physics.angle_error import N_UNCERTAIN_HARMONICS, angle_sensitivity
from counterspin.physics.motion import Site, Trajectory
from counterspin.physics.spindle import Ripple, Spindle, fit_spindle

RATE = 3.0
SPINDLE = Spindle(RATE, 2e-4, (Ripple(1, 2e-3, 0.4),), start_angle=0.7)
TIMES = np.linspace(0.5, 30.5, 1501)


def simulate_and_fit(times, true, seed, noise=1e-4, **options):
    rng = np.random.default_rng(seed)
    return fit_spindle(times, true + noise * rng.standard_normal(times.size), RATE, **options)


def deviation_from_truth(fit, times, true):
    """Fit the true coefficients to the true angle; return their deviation and the residual."""
    functions = fit.error.functions(times)[0]
    apart = true - fit.spindle.angle(times)
    solution = np.linalg.lstsq(functions, apart, rcond=None)[0]
    return solution, np.max(np.abs(apart - functions @ solution))


@pytest.mark.parametrize("revolutions", [1.4, 14.0])
def test_angle_error_covariance_covers_true_angle(revolutions):
    """Include little more than one revolution, where drift and first harmonic are similar."""
    duration = revolutions * 2 * math.pi / RATE
    times = np.linspace(0.5, 0.5 + duration, 600)
    # The third harmonic is below what the criterion keeps; the first is above it in long records.
    spindle = replace(SPINDLE, ripples=(Ripple(1, 4e-4, 0.4), Ripple(3, 4e-5, 1.0)))
    true = spindle.angle(times)
    distance, trials = 0.0, 200
    for seed in range(trials):
        fit = simulate_and_fit(times, true, [1, seed])
        deviation, left = deviation_from_truth(fit, times, true)
        assert left < 1e-3 * 1e-4
        z = np.linalg.solve(fit.error.root, deviation - fit.error.deviation)
        distance += z @ z
    unknowns = fit.error.deviation.size
    assert abs(distance - trials * unknowns) < 4 * math.sqrt(2 * trials * unknowns)


def test_unsupported_harmonic_has_prior_uncertainty():
    fit = simulate_and_fit(TIMES, replace(SPINDLE, ripples=()).angle(TIMES), 2)
    assert fit.spindle.ripples == ()
    assert fit.error.harmonics == tuple(range(1, N_UNCERTAIN_HARMONICS + 1))
    # A ripple of the rate in rad/s: n w0 times the angle's, which 1501 samples tell to this.
    for n in fit.error.harmonics:
        expected = n * RATE * 1e-4 * math.sqrt(2 / TIMES.size)
        assert fit.error.u[f"ripple{n}"] == pytest.approx(expected, rel=0.1)
    assert (np.abs(fit.error.standardised) < 4.5).all()
    assert np.abs(fit.error.standardised[3:]).max() > 0.1


def test_uncertainties_match_fit():
    fit = simulate_and_fit(TIMES, SPINDLE.angle(TIMES), 3, harmonics=N_UNCERTAIN_HARMONICS)
    assert fit.error.u["drift"] == pytest.approx(fit.u_drift, rel=1e-9)
    assert np.abs(fit.error.deviation).max() == 0.0
    # The rate at the middle is better known than the rate at t = 0.
    assert fit.error.u["rate"] < 0.5 * fit.u_rate


def test_noise_free_angle_has_negligible_uncertainty():
    fit = fit_spindle(TIMES, 0.25 * RATE * TIMES, 0.25 * RATE, harmonics=0)
    assert max(fit.error.u.values()) < 1e-12
    error = replace(fit.error, root=np.zeros_like(fit.error.root))
    assert not error.standardised.any()


def test_derivatives_and_largest_values_match_differences():
    error = simulate_and_fit(TIMES, SPINDLE.angle(TIMES), 4).error
    step = 1e-4
    ahead, here, behind = (error.functions(TIMES + s)[0] for s in (step, 0.0, -step))
    _, first, second = error.functions(TIMES)
    size = np.abs(here).max(axis=0)
    np.testing.assert_allclose((ahead - behind) / (2 * step) / size, first / size, atol=1e-4)
    np.testing.assert_allclose(
        (ahead - 2 * here + behind) / step**2 / size, second / size, atol=1e-3
    )
    np.testing.assert_allclose(size, error.max_values, rtol=1e-3)


@pytest.mark.parametrize("order", [0, 1, 2])
def test_motion_derivatives_match_central_differences(order):
    """Central differences of exact trajectories, parameter by parameter."""
    fit = simulate_and_fit(TIMES, SPINDLE.angle(TIMES), 5)
    error, spindle = fit.error, fit.spindle
    rotation = (
        spindle.angle(TIMES),
        spindle.angular_rate(TIMES),
        spindle.angular_acceleration(TIMES),
    )
    changes = angle_sensitivity(error.functions(TIMES), *rotation, order)
    site = Site(9.8, 0.8)

    def motion(turned):
        trajectory = Trajectory(turned, 1.0, site)
        return {0: trajectory.acceleration, 1: trajectory.velocity, 2: trajectory.position}[order](
            TIMES
        )[:, :2]

    def rippled(n, quadrature, step):
        # +(step / n w0) cos, or sin, of n w0 t; the model's own ripple vanishes at t = 0.
        phase = math.pi if quadrature == "cos" else math.pi / 2
        start = spindle.start_angle + (step / (n * RATE) if quadrature == "cos" else 0.0)
        more = Ripple(n, step, phase)
        return replace(spindle, ripples=(*spindle.ripples, more), start_angle=start)

    def shift_angle(place, step):
        if place == 0:
            return replace(spindle, start_angle=spindle.start_angle + step)
        n, quadrature = error.harmonics[(place - 3) // 2], ("cos", "sin")[(place - 3) % 2]
        # A negative amplitude is the opposite ripple.
        return rippled(n, quadrature, step)

    step = 1e-5
    for place in (0, *range(3, error.deviation.size)):
        moved = (motion(shift_angle(place, step)) - motion(shift_angle(place, -step))) / (2 * step)
        size = np.abs(moved).max()
        np.testing.assert_allclose(changes[:, place] / size, moved / size, atol=2e-4)
    # Rate and drift: a spindle without ripple, whose harmonics would move too.
    plain = replace(spindle, ripples=())
    rotation = plain.angle(TIMES), plain.angular_rate(TIMES), plain.angular_acceleration(TIMES)
    changes = angle_sensitivity(error.functions(TIMES), *rotation, order)
    middle = error.start + error.span / 2

    def slow(rate, drift):
        # The same angle at the middle, where rate and drift are stated.
        half = (error.span / 2) ** 2 / 3
        lag = -rate * middle + RATE * drift * (middle**2 - half) / 2
        before = plain.rate + rate - plain.rate * drift * middle
        curve = plain.rate * (plain.drift + drift)
        return Spindle(before, curve / before, (), plain.start_angle + lag)

    for place, step in ((1, 1e-6), (2, 1e-8)):
        ahead, behind = (slow(*((s, 0.0) if place == 1 else (0.0, s))) for s in (step, -step))
        moved = (motion(ahead) - motion(behind)) / (2 * step)
        size = np.abs(moved).max()
        np.testing.assert_allclose(changes[:, place] / size, moved / size, atol=1e-3)
