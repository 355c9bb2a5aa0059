import math
import pickle
from dataclasses import replace

import mpmath
import numpy as np
import pytest
import sympy

from counterspin.inference.noise.components import BIAS_COMPONENTS, COMPONENTS
from counterspin.inference.noise.model import (
    ESTIMATE,
    Differences,
    Noise,
    build_whitener,
    information_loss,
    make_whitener,
    solve_banded_factor,
)

HALF = sympy.Rational(1, 2)


def dense_covariance(times, count, spacing, order, noise):
    """Covariance of the block means, sample by sample, from the walk's own covariance."""
    samples = np.concatenate(
        [t + (np.arange(c) - (c - 1) / 2) * spacing for t, c in zip(times, count, strict=True)]
    )
    average = np.repeat(np.eye(len(times)) / count[:, None], count, axis=1)
    since = samples - samples[0]
    early, late = np.minimum.outer(since, since), np.maximum.outer(since, since)
    walk = {
        2: early**2 * (3 * late - early) / 6,
        1: early,
        0: np.eye(len(samples)) / spacing,
    }[order]
    covariance = noise.random_walk**2 * walk + noise.sample_variance * np.eye(len(samples))
    return average @ covariance @ average.T


def blocks_with_gaps(n, spacing, seed=5):
    rng = np.random.default_rng(seed)
    count = rng.integers(1, 6, n)
    gaps = np.where(rng.random(n) < 0.2, rng.integers(1, 20, n), 0) * spacing
    return np.cumsum((np.r_[0, count[:-1]] + count) / 2 * spacing + gaps), count


def banded_product(bands):
    factor = sum(np.diag(band[: band.size - k], -k) for k, band in enumerate(bands))
    return factor @ factor.T


def test_dense_walk_covariance_matches_integral():
    u, a, b = sympy.symbols("u a b", positive=True)
    integral = sympy.integrate((a - u) * (b - u), (u, 0, a))
    assert sympy.simplify(integral - a**2 * (3 * b - a) / 6) == 0


def second_difference_covariance(lag, block):
    """N^-2 h^-3 times that of a doubly integrated walk: impulse responses, multiplied, integrated.

    A row at t answers an impulse of acceleration at s by (t - s)+, or by its mean over t +- 1/2.
    """
    s = sympy.symbols("s", real=True)

    def row(t, between):
        if not block:
            return t - s if between < t else 0
        if between > t + HALF:
            return 0
        return t - s if between < t - HALF else (t + HALF - s) ** 2 / 2

    def difference(t, between):
        return row(t, between) - 2 * row(t + 1, between) + row(t + 2, between)

    total = 0
    for k in range(-2, 10):
        lo, hi = k * HALF, (k + 1) * HALF
        middle = (lo + hi) / 2
        total += sympy.integrate(difference(0, middle) * difference(lag, middle), (s, lo, hi))
    return total


@pytest.mark.parametrize(
    ("block", "published"), [(False, ("2/3", "1/6", "0")), (True, ("11/20", "13/60", "1/120"))]
)
def test_closed_forms_of_uniform_spacing(block, published):
    exact = [second_difference_covariance(lag, block) for lag in range(3)]
    assert exact == [sympy.Rational(p) for p in published]
    n, h, walk = 12, 0.3, 2.0
    # Means of c samples differ from means over the whole block by 1/c^2.
    count = 10_000 if block else 1
    bands, _ = Differences.from_times(np.arange(n) * h, 2, count).factor(0.0, walk)
    covariance = banded_product(bands) / (walk * h**3)
    for lag, value in enumerate(exact):
        tolerance = 1e-13 + 10 / count**2 * block
        np.testing.assert_allclose(np.diagonal(covariance, lag), float(value), atol=tolerance)


@pytest.mark.parametrize("order", [2, 1, 0])
@pytest.mark.parametrize("noise", [Noise(1, 1e-6), Noise(1, 1), Noise(0.3, 30, 1), Noise(0, 1)])
@pytest.mark.parametrize("shape", ["points", "uneven points", "blocks and gaps"])
def test_whitened_rows_have_unit_covariance(order, noise, shape):
    n, h = 30, 0.1
    times, count = blocks_with_gaps(n, h)
    if shape == "points":
        times, count = np.arange(n) * h, np.ones(n, int)
    if shape == "uneven points":
        count = np.ones(n, int)
    whitener = make_whitener(times, order, noise, count, h)
    covariance = dense_covariance(times, count, h, order, noise)
    rows = whitener.apply(np.eye(n))
    assert rows.shape == (n - order, n)
    # The dense covariance itself, of 1e3 s^3 in all, loses digits of steps of 1e-3 s^3.
    np.testing.assert_allclose(rows @ covariance @ rows.T, np.eye(n - order), atol=2e-9)
    differences = whitener.differences.apply(np.eye(n))
    expected = np.linalg.slogdet(differences @ covariance @ differences.T)[1]
    assert whitener.log_det == pytest.approx(expected, abs=1e-7)


def test_spacing_is_inferred_from_adjoining_blocks():
    times, count = blocks_with_gaps(40, 0.1)
    noise = Noise(1, 3)
    stated = make_whitener(times, 2, noise, count, 0.1)
    inferred = make_whitener(times, 2, noise, count)
    np.testing.assert_allclose(inferred.bands, stated.bands, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("ratio", [0.0, 1e-18, 1e-14, 1e-8, 1.0, 1e6])
def test_factor_has_full_precision_at_any_ratio(ratio):
    """Against a 60-digit Cholesky factorisation; at 1e-14 the one in doubles has 7 digits left."""
    n = 600
    bands, _ = Differences.from_times(np.arange(n, dtype=float), 2).factor(1.0, ratio)
    with mpmath.workdps(60):
        walk = mpmath.mpf(ratio)
        diagonal, one, two = [], [], []
        for i in range(n - 2):
            back2 = 1 / diagonal[i - 2] if i > 1 else mpmath.mpf(0)
            beside = -4 + walk / 6 - (back2 * one[i - 1] if i > 1 else 0)
            back1 = beside / diagonal[i - 1] if i > 0 else mpmath.mpf(0)
            diagonal.append(mpmath.sqrt(6 + 2 * walk / 3 - back1**2 - back2**2))
            one.append(back1)
            two.append(back2)
        # How far the filter is from integrating twice for ever: what low frequencies hang on.
        end = float((diagonal[-1] + one[-1] + two[-1]) / diagonal[-1])
    scale = float(diagonal[-1])
    exact = [np.array(row, dtype=float) for row in (diagonal, one[1:], two[2:])]
    for k in range(3):
        np.testing.assert_allclose(bands[k, : n - 2 - k], exact[k], rtol=0, atol=2e-15 * scale)
    assert 1 + (bands[1, -2] + bands[2, -3]) / bands[0, -1] == pytest.approx(end, abs=3e-15)


def test_white_noise_is_whitened_by_division():
    times, count = blocks_with_gaps(20, 0.1)
    rows = np.random.default_rng(1).normal(size=(20, 3))
    whitener = make_whitener(times, 2, Noise(0.2, quantisation=0.6), count)
    sigma = np.sqrt(0.04 + 0.03)
    expected = rows / sigma * np.sqrt(count)[:, None]
    np.testing.assert_allclose(whitener.apply(rows), expected, rtol=1e-14)
    np.testing.assert_allclose(whitener.apply(rows[:, 0]), expected[:, 0], rtol=1e-14)
    assert whitener.log_det == pytest.approx(np.log(0.07 / count).sum())


@pytest.mark.parametrize("order", [2, 1, 0])
def test_start_errors_are_eliminated_or_estimated(order):
    times, count = blocks_with_gaps(50, 0.1)
    start_errors = times[:, None] ** np.arange(order)
    mixed = make_whitener(times, order, Noise(1, 1), count)
    assert mixed.polynomials == 0
    np.testing.assert_allclose(mixed.apply(start_errors), 0, atol=1e-12)
    white = make_whitener(times, order, Noise(1), count)
    assert white.polynomials == order
    assert white.n_rows == len(times)


def test_information_matches_cramer_rao_bound():
    """Cramer-Rao: X' V^-1 X with the start errors projected out, V dense."""
    times, count = blocks_with_gaps(60, 0.1)
    noise = Noise(0.01, 0.02)
    w, bias = 2.0, 9.8 * times**2 / 2
    design = np.column_stack([bias, (bias / 19.6 + (1 - np.cos(2 * w * times)) / 8 / w**2)])
    rows = make_whitener(times, 2, noise, count, 0.1).apply(design)
    everything = np.column_stack([np.ones(60), times, design])
    information = everything.T @ np.linalg.solve(
        dense_covariance(times, count, 0.1, 2, noise), everything
    )
    bound = np.linalg.inv(information)[2:, 2:]
    np.testing.assert_allclose(np.linalg.inv(rows.T @ rows), bound, rtol=1e-7)


def test_vector_and_matrix_are_whitened_alike():
    times = np.arange(30) * 0.1
    whitener = make_whitener(times, 2, Noise(1, 1))
    rows = np.random.default_rng(2).normal(size=(30, 2))
    np.testing.assert_array_equal(whitener.apply(rows)[:, 1], whitener.apply(rows[:, 1]))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (([0, 1, 1, 2], 2, Noise(1)), "increase"),
        (([0, 1], 2, Noise(1, 1)), "too few"),
        ((np.arange(9), 3, Noise(1)), "order is 3"),
        ((np.arange(9), 2, Noise(0)), "all components are zero"),
        ((np.arange(9), 2, Noise(1, 1), 0), "counts"),
        ((np.arange(9), 2, Noise(1, 1), 5, 0.25), "overlap"),
        ((np.arange(9), 2, Noise(1, 1), 5, 0.0), "spacing"),
    ],
)
def test_invalid_whitener_arguments_raise(arguments, words):
    with pytest.raises(ValueError, match=words):
        make_whitener(*arguments)


@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
def test_negative_noise_raises(value):
    with pytest.raises(ValueError, match="random_walk"):
        Noise(1.0, value)


def test_requested_noise_is_singleton_across_processes():
    noise = Noise(ESTIMATE, 0.2, 0.1, ESTIMATE)
    assert noise.to_estimate == ("white", "flicker")
    assert noise.has_bias_instability
    again = pickle.loads(pickle.dumps(noise))
    assert again.white is ESTIMATE
    assert again.known == Noise(0.0, 0.2, 0.1)
    assert repr(ESTIMATE) == "ESTIMATE"
    with pytest.raises(ValueError, match="quantisation"):
        Noise(1.0, 0.0, ESTIMATE)
    with_variances = noise.with_variances((0.25, 9.0, 0.04, 9.0))
    assert with_variances == Noise(math.sqrt(0.25 - 0.01 / 12), 0.2, 0.1, 0.2)


def test_singular_factor_raises():
    with pytest.raises(ArithmeticError, match="singular"):
        solve_banded_factor(np.zeros((2, 3)), np.ones(3))


@pytest.mark.parametrize("order", [0, 1, 2])
@pytest.mark.parametrize("relative", [1.0, 4.0])
def test_white_noise_varying_by_row_is_whitened(order, relative):
    """Beside a walk: its covariance is that of white acceleration integrated once or twice."""
    t = 0.5 * np.arange(1.0, 9.0)
    added = np.linspace(0.5, 3.0, 8)
    differences = Differences.from_times(t, order, None, 0.5, relative)
    whiten = build_whitener(differences, Noise(1.0, 0.7), 0.0, added)
    early, late = np.minimum.outer(t, t), np.maximum.outer(t, t)
    walk = (np.eye(8) / 0.5, early, early**2 * (3.0 * late - early) / 6.0)[order]
    rows = whiten.apply(np.eye(8))
    covariance = rows @ (relative * np.diag(1.0 + added) + 0.7**2 * walk) @ rows.T
    np.testing.assert_allclose(covariance, np.eye(8 - order), atol=1e-12)


# What information loses to more noise: against whitening anew with a little more of it.
RNG = np.random.default_rng(1)
TIMES = np.cumsum(RNG.uniform(0.05, 0.1, 300))
COLUMNS = np.column_stack([TIMES**2 / 2, np.cos(TIMES), RNG.normal(size=300)])
ADDED = np.linspace(0.0, 0.2, 300)


def information(noise, differences):
    """Start errors are differenced out where there is a walk, be it as small as can be."""
    walking = replace(noise, random_walk=max(noise.random_walk, 1e-12))
    rows = build_whitener(differences, walking, 5.0, ADDED).apply(COLUMNS)
    return rows.T @ rows


@pytest.mark.parametrize("relative", [1.0, 2.5])
@pytest.mark.parametrize("order", [2, 1, 0])
@pytest.mark.parametrize("noise", [Noise(0.3, 0.05), Noise(0.3), Noise(0.3, 0.05, 0.1, 0.02, 0.01)])
def test_information_derivative_matches_differences(order, noise, relative):
    differences = Differences.from_times(TIMES, order, 2, 0.02, relative)
    lost = information_loss(differences, COLUMNS, noise, 5.0, ADDED)
    for part, name in zip(lost, COMPONENTS, strict=True):
        level = getattr(noise, name) ** 2
        if name in BIAS_COMPONENTS and not noise.has_bias_instability:
            assert not part.any()
            continue
        step = 1e-3 * level or 1e-9
        more = information(replace(noise, **{name: math.sqrt(level + step)}), differences)
        less = information(replace(noise, **{name: math.sqrt(max(level - step, 0.0))}), differences)
        slope = (less - more) / (2.0 * step if level else step)
        np.testing.assert_allclose(part, slope, rtol=0, atol=1e-4 * np.abs(part).max())
        assert np.linalg.eigvalsh(part)[0] > -1e-12 * np.abs(part).max()
