"""The overlapping Allan deviation against published figures, its freedom against dense traces."""

import numpy as np
import pytest
from scipy.stats import chi2

from counterspin.inference.noise.components import Sampling
from counterspin.inference.noise.spectrum import allan_deviation, allan_moments, allan_values

WHITE, FLICKER, WALK = (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0)


def numbers(count):
    """NIST SP 1065, section 12.4: the generator of the set of 1000 values."""
    sequence = [1234567890]
    while len(sequence) < count:
        sequence.append(16807 * sequence[-1] % 2147483647)
    return np.array(sequence) / 2147483647.0


def integral(values, step=1.0):
    return np.concatenate([[0.0], np.cumsum(values) * step])


@pytest.mark.parametrize(("count", "published"), [(1, 91.22945), (2, 85.95287)])
def test_nine_values_match_nist(count, published):
    """W. J. Riley, NIST SP 1065 (2008), table 30."""
    values = [892.0, 809.0, 823.0, 798.0, 671.0, 644.0, 883.0, 903.0, 677.0]
    assert allan_deviation(integral(values), 1.0, count) == pytest.approx(published, rel=1e-7)


@pytest.mark.parametrize(
    ("count", "published"), [(1, 2.922319e-01), (10, 9.159953e-02), (100, 3.241343e-02)]
)
def test_thousand_values_match_nist(count, published):
    """NIST SP 1065, table 31."""
    allan_deviation_result = allan_deviation(integral(numbers(1000)), 1.0, count)
    assert allan_deviation_result == pytest.approx(published, rel=2e-7)


def test_degrees_of_freedom_of_thousand_values_match_nist():
    """NIST SP 1065, table 32: 146.177 at 10, by Greenhall's approximations."""
    assert allan_moments(1000, 1.0, Sampling(1, 1), WHITE, 10)[1] == pytest.approx(
        146.177, rel=1e-3
    )


#: What allantools 2024.6 says of 4096 numbers u less 1/2, and 0.02 of their sum added, at 2 Hz:
#: oadev(y, rate=2.0, data_type="freq", taus=[count / 2.0]), and edf_greenhall(alpha, d=2, m=count,
#: N=4097, overlapping=True, modified=False) for alpha 0 (white), -1 (flicker) and -2 (walk).
ALLANTOOLS = {
    16: (0.06995563927, 360.046, 297.475, 235.632),
    64: (0.04705082606, 93.7795, 73.3086, 57.7929),
    256: (0.04048504244, 21.7836, 16.9699, 13.3026),
    1024: (0.06677026255, 3.99898, 2.99979, 2.23631),
}


@pytest.mark.parametrize("count", ALLANTOOLS)
def test_deviation_and_dof_match_allantools(count):
    """Its freedom is of continuous noise, or of tables of long averages: 0.6 % from 64 on."""
    step, number = 0.5, numbers(4096) - 0.5
    values = number + 0.02 * np.cumsum(number)
    deviation, *freedom = ALLANTOOLS[count]
    assert allan_deviation(integral(values, step), step, count) == pytest.approx(
        deviation, rel=1e-9
    )
    actual_allan_moments = [
        allan_moments(4096, step, Sampling(1, 1), one, count)[1] for one in (WHITE, FLICKER, WALK)
    ]
    np.testing.assert_allclose(actual_allan_moments, freedom, rtol=0.06 if count == 16 else 0.006)


@pytest.mark.parametrize("count", [1, 4, 30])
@pytest.mark.parametrize("size", [WHITE, WALK, (1e-3, 1.0, 0.0, 1e-3)])
def test_moments_match_dense_covariance(size, count):
    """E = tr(A V) and Var = 2 tr(A V A V) of the quadratic form of Gaussian samples."""
    n, step, kind = 150, 0.5, Sampling(1, 0)
    differences = np.diff(np.eye(n + 1), axis=0) / step
    walk = step * np.minimum.outer(np.arange(n) + 1.0, np.arange(n) + 1.0)
    force = size[0] * differences @ differences.T + size[1] / step * np.eye(n) + size[3] * walk
    whole = np.vstack([np.zeros(n), step * np.tril(np.ones((n, n)))])
    second = whole[2 * count :] - 2.0 * whole[count:-count] + whole[: -2 * count]
    inside = second @ force @ second.T / (2.0 * (count * step) ** 2) / len(second)
    expected, variance = np.trace(inside), 2.0 * np.sum(inside**2)
    deviation, dof = allan_moments(n, step, kind, size, count)
    assert deviation**2 == pytest.approx(expected, rel=1e-9)
    assert dof == pytest.approx(2.0 * expected**2 / variance, rel=1e-9)


def test_intervals_match_chi_square():
    velocity = integral(np.random.default_rng(1).standard_normal(300))
    points = allan_values(velocity, 1.0, Sampling(1, 0), WHITE)
    assert [point.tau for point in points][:4] == [1.0, 2.0, 3.0, 4.0]
    assert points[-1].tau <= 100.0
    for point in points:
        power = point.dof * point.deviation**2
        assert power / point.high**2 == pytest.approx(chi2.ppf(0.025, point.dof), rel=1e-9)
        assert power / point.low**2 == pytest.approx(chi2.ppf(0.975, point.dof), rel=1e-9)
        assert point.expected == pytest.approx(point.tau**-0.5, rel=1e-6)


def test_too_few_samples_have_no_allan_deviation():
    assert np.isnan(allan_deviation(np.zeros(4), 1.0, 2))
