"""The spindle: its model is consistent, and its identification is unbiased and honest."""

import math
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp
from scipy import stats

from counterspin.errors import ConvergenceError, NotIdentifiableError
from counterspin.physics.angle_error import UNRESOLVED_SD
from counterspin.physics.spindle import MAX_HARMONICS, Ripple, Spindle, fit_spindle

DRIFTING = Spindle(
    rate=2.0 * math.pi,
    drift=2e-6,
    ripples=(Ripple(1, 6e-3, 0.5), Ripple(2, 3e-3, -2.0)),
    start_angle=0.7,
)
REVERSED = Spindle(
    rate=-math.pi,
    drift=-3e-6,
    ripples=(Ripple(1, 4e-3, 2.5), Ripple(3, 2e-3, 0.1)),
    start_angle=-1.2,
)
BOTH = pytest.mark.parametrize("spindle", [DRIFTING, REVERSED], ids=["forward", "reversed"])

TIMES = np.linspace(0.0, 20.0, 501)


def record_angle(spindle, noise, seed, times=TIMES):
    rng = np.random.default_rng(seed)
    return spindle.angle(times) + noise * rng.standard_normal(times.size)


@BOTH
def test_effective_rate_is_rms_and_u_covers_scatter(spindle):
    """Closed form over whole revolutions; scatter of 200 fits within 3 standard errors of u."""
    t = np.arange(1000) * (10.0 * 2.0 * math.pi / abs(spindle.rate) / 1000.0)
    drift = spindle.rate**2 * (1.0 + spindle.drift * t[-1] + spindle.drift**2 * np.mean(t**2))
    squares = drift + sum(0.5 * ripple.amplitude**2 for ripple in spindle.ripples)
    exact = math.copysign(math.sqrt(squares), spindle.rate)
    whole = fit_spindle(t, record_angle(spindle, 0.0, 0, t), spindle.rate, harmonics=3)
    assert whole.rate_at(t)[0] == pytest.approx(exact, rel=1e-8)
    rates = [
        fit_spindle(t, record_angle(spindle, 1e-3, seed, t), spindle.rate, harmonics=3).rate_at(t)
        for seed in range(200)
    ]
    z = np.array([(rate - exact) / u for rate, u in rates])
    assert abs(np.mean(z**2) - 1.0) < 3.0 * math.sqrt(2.0 / len(z))
    # Of a mean rate, the slope of a line through white noise.
    line = 1e-3 * math.sqrt(12.0 / t.size) / (t[-1] - t[0])
    assert rates[0][1] == pytest.approx(line, rel=0.15)


@BOTH
def test_angle_acceleration_and_jerk_match_equation_1(spindle):
    t, s = sp.symbols("t s", real=True)
    w0 = sp.Float(spindle.rate, 30)
    rate = w0 * (1 + sp.Float(spindle.drift, 30) * s) + sum(
        sp.Float(r.amplitude, 30) * sp.sin(r.harmonic * w0 * s + sp.Float(r.phase, 30))
        for r in spindle.ripples
    )
    expected = {
        spindle.angle: sp.Float(spindle.start_angle, 30) + sp.integrate(rate, (s, 0, t)),
        spindle.angular_rate: rate.subs(s, t),
        spindle.angular_acceleration: sp.diff(rate, s).subs(s, t),
        spindle.angular_jerk: sp.diff(rate, s, 2).subs(s, t),
    }
    for method, expression in expected.items():
        values = [float(expression.subs(t, time)) for time in (0.0, 0.3, 7.77, 19.9)]
        got = method(np.array([0.0, 0.3, 7.77, 19.9]))
        # One rounding of an angle of 125 rad is 1.4e-14; the cosine's argument carries it.
        np.testing.assert_allclose(got, values, rtol=1e-15, atol=3e-14)


@BOTH
def test_shifted_time_zero_preserves_rotation(spindle):
    delay = -5e-3
    later = spindle.later(delay)
    # The harmonics' frequency changes by the drift over the delay, 1e-8, over 20 turns.
    np.testing.assert_allclose(
        later.angle(TIMES), spindle.angle(TIMES + delay), rtol=0.0, atol=2e-8
    )
    np.testing.assert_allclose(
        later.angular_rate(TIMES), spindle.angular_rate(TIMES + delay), rtol=0.0, atol=2e-8
    )


@pytest.mark.parametrize("rate", [1.7, -1.7])
def test_angle_change_matches_error_functions(rate):
    spindle = Spindle(rate, 2e-5, (Ripple(2, 1e-3, 0.4),), 0.3)
    error = fit_spindle(TIMES, record_angle(spindle, 1e-5, 5), rate).error
    change = 1e-3 * np.random.default_rng(6).standard_normal(error.deviation.size)
    change[1:3] = 0.0  # the harmonics keep their frequency then, and all is exact
    ahead = spindle.add_angle(replace(error, rate=rate), change)
    value, first, second = replace(error, rate=rate).functions(TIMES)
    for name, part in (
        ("angle", value),
        ("angular_rate", first),
        ("angular_acceleration", second),
    ):
        difference = getattr(ahead, name)(TIMES) - getattr(spindle, name)(TIMES)
        np.testing.assert_allclose(difference, part @ change, atol=1e-12 * abs(TIMES[-1] * rate))


@BOTH
@pytest.mark.parametrize("place", [0, 1, 2, 3, 6])
def test_angle_functions_match_central_differences(spindle, place):
    """Use central differences; the first three also change the ripple frequencies."""
    error = replace(
        fit_spindle(TIMES, record_angle(spindle, 1e-5, 5), spindle.rate).error, rate=spindle.rate
    )
    step = np.zeros(error.deviation.size)
    step[place] = 1e-7 if place == 2 else 1e-5
    ahead, behind = (spindle.add_angle(error, s * step) for s in (1.0, -1.0))
    names = ("angle", "angular_rate", "angular_acceleration")
    for name, part in zip(names, spindle.angle_functions(error, TIMES), strict=True):
        difference = (getattr(ahead, name)(TIMES) - getattr(behind, name)(TIMES)) / 2.0
        expected = part[:, place] * step[place]
        np.testing.assert_allclose(difference, expected, atol=1e-6 * np.abs(expected).max() + 1e-12)


def test_angle_without_drift_or_ripple_is_uniform_rotation():
    assert Spindle(2.0, start_angle=1.0).angle(np.array([3.0]))[0] == 7.0
    assert Spindle(2.0).highest_harmonic == 0
    assert REVERSED.highest_harmonic == 3


@BOTH
def test_time_at_inverts_angle(spindle):
    sense = math.copysign(1.0, spindle.rate)
    angles = spindle.start_angle + sense * np.linspace(0.0, 60.0, 41)
    times = spindle.time_at(angles)
    np.testing.assert_allclose(spindle.angle(times), angles, rtol=0, atol=5e-14)
    assert np.all(np.diff(times) > 0.0)
    assert times[0] == pytest.approx(0.0, abs=1e-15)


def test_time_at_raises_for_spindle_that_stops():
    stopping = Spindle(1.0, ripples=(Ripple(1, 5.0, 0.0),))
    with pytest.raises(ConvergenceError, match="rate changes sign"):
        stopping.time_at(np.linspace(0.0, 30.0, 200))


# --- identification ------------------------------------------------------------------------


@BOTH
@pytest.mark.parametrize("wrapped", [False, True])
def test_fit_without_noise_returns_true_spindle(spindle, wrapped):
    angle = spindle.angle(TIMES)
    if wrapped:
        angle = np.angle(np.exp(1j * angle))
    fit = fit_spindle(TIMES, angle, spindle.rate * (1 + 1e-3), harmonics=3)
    assert fit.rms < 1e-13
    assert fit.dof == TIMES.size - 9
    assert fit.spindle.rate == pytest.approx(spindle.rate, rel=1e-13)
    assert fit.spindle.drift == pytest.approx(spindle.drift, abs=1e-13)
    # A wrapped angle tells the start only up to whole revolutions.
    start = fit.spindle.start_angle - spindle.start_angle
    assert math.remainder(start, 2 * math.pi) == pytest.approx(0.0, abs=1e-12)
    by_harmonic = {r.harmonic: r for r in fit.spindle.ripples}
    for true in spindle.ripples:
        pop = by_harmonic.pop(true.harmonic)
        assert pop.amplitude == pytest.approx(true.amplitude, rel=1e-9)
        assert math.remainder(pop.phase - true.phase, 2 * math.pi) == pytest.approx(0, abs=1e-9)
    assert all(absent.amplitude < 1e-12 for absent in by_harmonic.values())


def simulate_z_scores(spindle, trials, noise=1e-4, weights=None):
    """(estimate - truth) / claimed standard uncertainty; rows are trials."""
    scale = noise if weights is None else noise / np.sqrt(weights)
    rows = []
    for trial in range(trials):
        angle = record_angle(spindle, scale, seed=[7, trial])
        fit = fit_spindle(TIMES, angle, spindle.rate, harmonics=3, weights=weights)
        row = [
            (fit.spindle.rate - spindle.rate) / fit.u_rate,
            (fit.spindle.drift - spindle.drift) / fit.u_drift,
        ]
        for true in spindle.ripples:
            ripple = fit.spindle.ripples[true.harmonic - 1]
            u_amplitude, u_phase = fit.u_ripples[true.harmonic - 1]
            turn = math.remainder(ripple.phase - true.phase, 2 * math.pi)
            row += [(ripple.amplitude - true.amplitude) / u_amplitude, turn / u_phase]
        rows.append(row)
    return np.array(rows)


@BOTH
@pytest.mark.parametrize("weighted", [False, True])
def test_fit_is_unbiased_and_u_covers_scatter(spindle, weighted):
    trials = 250
    weights = None if not weighted else np.where(np.arange(TIMES.size) % 3 == 0, 9.0, 1.0)
    z = simulate_z_scores(spindle, trials, weights=weights)
    # Four standard errors of a mean and of a standard deviation from `trials` normal draws;
    # with seven quantities a correct fit misses one in 2000 choices of the seed.
    assert np.all(np.abs(z.mean(axis=0)) < 4.0 / math.sqrt(trials)), z.mean(axis=0)
    assert np.all(np.abs(z.std(axis=0) - 1.0) < 4.0 / math.sqrt(2 * trials)), z.std(axis=0)


def test_weighted_fit_has_smaller_uncertainty():
    weights = np.where(np.arange(TIMES.size) % 3 == 0, 100.0, 1.0)
    noise = 1e-4 / np.sqrt(weights)
    angle = record_angle(DRIFTING, noise, seed=3)
    even = fit_spindle(TIMES, angle, DRIFTING.rate, harmonics=2)
    weighed = fit_spindle(TIMES, angle, DRIFTING.rate, harmonics=2, weights=weights)
    # Information is the sum of weights: (1 + 1 + 100)/3 against 1/mean variance (0.67).
    expected = math.sqrt(np.mean(noise**2) * np.mean(weights) / 1e-8)
    assert even.u_rate / weighed.u_rate == pytest.approx(expected, rel=0.05)
    scaled = fit_spindle(TIMES, angle, DRIFTING.rate, harmonics=2, weights=5.0 * weights)
    assert scaled.spindle.rate == pytest.approx(weighed.spindle.rate, rel=1e-14)
    assert scaled.u_rate == pytest.approx(weighed.u_rate, rel=1e-9)


@BOTH
@pytest.mark.parametrize("samples", [2, 5, 16])
def test_block_means_recover_spindle_of_samples(spindle, samples):
    times = np.arange(512 * samples) * (20.0 / 512 / samples)
    blocks, angles = times.reshape(-1, samples), spindle.angle(times).reshape(-1, samples)
    spread = np.std(blocks, axis=1)
    given = (blocks.mean(axis=1), angles.mean(axis=1), spindle.rate)
    blind = fit_spindle(*given).spindle
    actual_spindle = fit_spindle(*given, spread=spread).spindle
    phases = np.angle(np.exp(1j * spindle.rate * spread[0] * np.arange(1, 4)))
    for ripple, without, with_spread in zip(
        spindle.ripples, blind.ripples, actual_spindle.ripples, strict=True
    ):
        # The two-point rule is exact for two samples; for more it leaves (n w0 s)^4 (1/24 - 3/40).
        left = phases[ripple.harmonic - 1] ** 4 / 24 if samples > 2 else 0.0
        assert with_spread.harmonic == ripple.harmonic
        assert with_spread.amplitude == pytest.approx(ripple.amplitude, rel=left + 1e-9)
        lost = 1.0 - without.amplitude / ripple.amplitude
        assert lost == pytest.approx(phases[ripple.harmonic - 1] ** 2 / 2, rel=0.1)


def test_residuals_are_recorded_minus_modelled_angle():
    weights = np.linspace(1.0, 2.0, TIMES.size)
    angle = record_angle(DRIFTING, 1e-3, seed=5)
    fit = fit_spindle(TIMES, angle, DRIFTING.rate, harmonics=2, weights=weights)
    np.testing.assert_allclose(fit.residuals, angle - fit.spindle.angle(TIMES), atol=2e-13)
    assert fit.rms == pytest.approx(1e-3, rel=4 / math.sqrt(2 * TIMES.size))


def test_fit_does_not_depend_on_start_rate():
    angle = record_angle(REVERSED, 1e-4, seed=11)
    near = fit_spindle(TIMES, angle, REVERSED.rate, harmonics=3)
    for factor in (1 - 1e-3, 1 + 1e-3, 0.97):
        far = fit_spindle(TIMES, angle, factor * REVERSED.rate, harmonics=3)
        assert far.spindle.rate == pytest.approx(near.spindle.rate, abs=1e-3 * near.u_rate)
        assert far.spindle.drift == pytest.approx(near.spindle.drift, abs=1e-3 * near.u_drift)
        assert far.u_rate == pytest.approx(near.u_rate, rel=1e-6)


def test_fit_accepts_large_start_time():
    late = 100.0 + TIMES
    spindle = Spindle(2.0, 1e-5, (Ripple(1, 2e-3, 1.0),), 0.3)
    fit = fit_spindle(late, spindle.angle(late), 2.0, harmonics=1)
    assert fit.spindle.rate == pytest.approx(spindle.rate, rel=1e-10)
    assert fit.spindle.drift == pytest.approx(spindle.drift, abs=1e-12)
    assert fit.spindle.start_angle == pytest.approx(spindle.start_angle, abs=1e-8)
    np.testing.assert_allclose(fit.spindle.angle(late), spindle.angle(late), atol=1e-11)


def test_harmonic_above_absent_harmonic_is_found():
    angle = record_angle(REVERSED, 1e-5, seed=13)
    fit = fit_spindle(TIMES, angle, REVERSED.rate)
    assert [ripple.harmonic for ripple in fit.spindle.ripples] == [1, 3]
    first, third = (ripple.amplitude for ripple in fit.spindle.ripples)
    assert first == pytest.approx(4e-3, rel=1e-2)
    assert third == pytest.approx(2e-3, rel=1e-2)


def test_single_high_harmonic_is_found():
    spindle = Spindle(2.0 * math.pi, ripples=(Ripple(7, 1e-3, 0.4),))
    (ripple,) = fit_spindle(
        TIMES, record_angle(spindle, 1e-5, seed=14), spindle.rate
    ).spindle.ripples
    assert ripple.harmonic == 7
    assert ripple.amplitude == pytest.approx(1e-3, rel=0.05)


def test_unwrapped_angle_may_have_gaps():
    spindle = Spindle(2.0 * math.pi, 1e-6)
    times = TIMES[(TIMES < 10.0) | (TIMES > 14.3)]
    fit = fit_spindle(times, spindle.angle(times), spindle.rate)
    assert fit.spindle.rate == pytest.approx(spindle.rate, rel=1e-10)


def test_false_harmonics_in_noise_are_rare():
    trials = 200
    plain = Spindle(2.0 * math.pi, 1e-6, start_angle=0.2)
    ripples = [
        fit_spindle(TIMES, record_angle(plain, 1e-4, seed=[17, k]), plain.rate).spindle.ripples
        for k in range(trials)
    ]
    # The criterion keeps each of eight harmonics with probability 1/(8 x 501): 2e-3 a trial, so
    # that more than four in 200 would be one case in 10000.
    assert sum(map(bool, ripples)) <= 4


def test_harmonics_are_limited_by_sampling():
    times = np.arange(0.0, 60.0, 0.2)  # five samples a revolution
    spindle = Spindle(2.0 * math.pi, ripples=(Ripple(1, 1e-2, 0.0),))
    fit = fit_spindle(times, record_angle(spindle, 1e-5, 19, times), spindle.rate)
    assert fit.spindle.highest_harmonic == 1
    assert fit.spindle.ripples[0].amplitude == pytest.approx(1e-2, rel=1e-2)
    assert MAX_HARMONICS > 1


@pytest.mark.parametrize("samples", [4.0, 7.0, 8.0, 9.3])
def test_unresolved_harmonics_are_in_angle_error(samples):
    """The waves are drawn from the default prior; chi-square is that of the stated covariance."""
    rng, trials, rate = np.random.default_rng(23), 60, 2.0 * math.pi
    times = np.arange(0.0, 12.0, 1.0 / samples)
    resolved = int(samples / 2.0) - 1
    chi2 = 0.0
    for _ in range(trials):
        waves = UNRESOLVED_SD * rng.standard_normal((4, 2))
        waves[:resolved] *= 20.0  # without a prior
        angle = rate * times + 1e-6 * rng.standard_normal(times.size)
        for n, (cos, sin) in enumerate(waves, 1):
            angle += cos * np.cos(n * rate * times) + sin * np.sin(n * rate * times)
        fit = fit_spindle(times, angle, rate)
        # The functions of the error tell the true angle from the fitted one at any time.
        dense = np.linspace(0.0, 12.0, 400)
        true = rate * dense
        for n, (cos, sin) in enumerate(waves, 1):
            true += cos * np.cos(n * rate * dense) + sin * np.sin(n * rate * dense)
        functions = fit.error.functions(dense)[0]
        coefficients = np.linalg.lstsq(functions, true - fit.spindle.angle(dense))[0]
        chi2 += float(
            np.sum(np.linalg.solve(fit.error.root, coefficients - fit.error.deviation) ** 2)
        )
    low, high = stats.chi2.ppf([1e-4, 1.0 - 1e-4], trials * fit.error.deviation.size)
    assert fit.error.harmonics == (1, 2, 3, 4)
    assert low < chi2 < high


@pytest.mark.parametrize("size", [0, 1, 5])
def test_too_few_samples_raise_with_count(size):
    with pytest.raises(NotIdentifiableError, match=rf"{size} angle samples .* 1 harmonics"):
        fit_spindle(TIMES[:size], DRIFTING.angle(TIMES[:size]), DRIFTING.rate, harmonics=1)


def test_too_few_samples_without_harmonics_raise():
    with pytest.raises(NotIdentifiableError, match=r"3 angle samples .* 0 harmonics"):
        fit_spindle(TIMES[:3], DRIFTING.angle(TIMES[:3]), DRIFTING.rate)


@pytest.mark.parametrize("harmonics", [1, 2])
def test_samples_that_do_not_separate_harmonics_raise(harmonics):
    # Two samples a revolution: every sine is zero, the second cosine a constant.
    times = np.arange(40) * 0.5
    with pytest.raises(NotIdentifiableError, match=r"do not separate .* harmonics"):
        fit_spindle(times, 6.0 * times, 2.0 * math.pi, harmonics=harmonics)


def test_non_convergent_rate_raises():
    # A tenth of a revolution with noise: the harmonics take the place of the rate.
    times = np.linspace(0.0, 0.1, 200)
    with pytest.raises(ConvergenceError, match=r"did not converge near 6\.28"):
        fit_spindle(times, record_angle(DRIFTING, 0.3, 23, times), DRIFTING.rate, harmonics=2)
