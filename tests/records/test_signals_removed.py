"""A mean, a line or a parabola that a recorder removed shows in all rows of a file."""

import numpy as np
import pytest

from counterspin.records.signals import SignalSums, detrending_order

ROWS = 20_000


def simulate_displacement(rng, *, noise=0.01, rows=ROWS):
    """Return uneven times and a record of displacement with noise, bias and a start error."""
    t = np.sort(rng.uniform(0.0, 400.0, rows))
    return t, 2.5 * np.cos(1.57 * t) + 0.02 - 1e-3 * t + 0.025 * t**2 + noise * rng.normal(
        size=rows
    )


def remove_polynomial(t, x, count):
    """Subtract the best-fit polynomial with `count` coefficients."""
    powers = np.vander(t / t[-1], count, increasing=True)
    return x - powers @ np.linalg.lstsq(powers, x, rcond=None)[0]


def polynomial_coefficients(t, x, pieces=1, noise=np.inf):
    """Return the polynomial coefficients; by default assume that the mean was removed."""
    sums = SignalSums(1)
    chunks = [(t[rows], x[rows]) for rows in np.array_split(np.arange(len(t)), pieces)]
    for _, values in chunks:
        sums.add([values])
    return sums.coefficients(0, noise, iter(chunks))


@pytest.mark.parametrize("pieces", [1, 7])
def test_coefficients_match_dense_factorisation(pieces):
    t, x = simulate_displacement(np.random.default_rng(1))
    x[5:50] = np.nan
    t[45:70] = np.nan
    good = np.isfinite(x) & np.isfinite(t)
    q, r = np.linalg.qr(np.vander(t[good] / 400.0, 3, increasing=True))
    dense = (q * np.sign(np.diag(r))).T @ x[good]
    # Sums of t^4 and the root of their matrix, whose condition is 1e3, cost three digits.
    np.testing.assert_allclose(polynomial_coefficients(t, x, pieces)[:3], dense, rtol=1e-11)
    # Unless the mean was removed, the times of the rows do not matter.
    with_mean = polynomial_coefficients(t, x, pieces, noise=0.01)
    mean = np.nansum(x) / np.sqrt(np.isfinite(x).sum())
    np.testing.assert_allclose(with_mean[:3], [mean, np.inf, np.inf], rtol=1e-11)
    assert detrending_order([with_mean / 0.01]) == 0


@pytest.mark.parametrize(
    ("count", "decimals"), [(1, 6), (2, 6), (3, 6), (1, 17), (2, 17), (3, 17), (2, 4), (3, 4)]
)
def test_removed_polynomial_is_found_in_three_rounded_records(count, decimals):
    rng = np.random.default_rng(2)
    parts = []
    for _ in range(3):
        t, x = simulate_displacement(rng)
        parts.append(
            polynomial_coefficients(t, np.round(remove_polynomial(t, x, count), decimals)) / 0.01
        )
    assert detrending_order(parts) == count


def test_removed_polynomial_is_found_after_block_averaging():
    rng = np.random.default_rng(3)
    parts = []
    for _ in range(3):
        t = np.arange(ROWS) * 0.02
        x = remove_polynomial(t, 2.5 * np.cos(1.57 * t) + 0.01 * rng.normal(size=ROWS), 3)
        parts.append(
            polynomial_coefficients(*(v.reshape(-1, 4).mean(axis=1) for v in (t, x))) / 0.005
        )
    assert detrending_order(parts) == 3


def remove_line_through_ends(t, x):
    """Subtract the line through the first and the last row."""
    return x - np.interp(t, [t[0], t[-1]], [x[0], x[-1]])


@pytest.mark.parametrize("decimals", [4, 17])
@pytest.mark.parametrize("pieces", [1, 7])
def test_line_through_ends_requires_three_records(decimals, pieces):
    rng = np.random.default_rng(6)
    parts = []
    for _ in range(3):
        t, x = simulate_displacement(rng)
        parts.append(
            polynomial_coefficients(t, np.round(remove_line_through_ends(t, x), decimals), pieces)
            / 0.01
        )
    assert detrending_order(parts) == 2
    assert detrending_order(parts[:1]) == 0


def test_zeroed_start_is_not_detrending():
    """The recorder starts at zero; in one of three records it returns to zero."""
    rng = np.random.default_rng(7)
    parts = []
    for run in range(3):
        t, x = simulate_displacement(rng)
        x -= x[0]
        x[-1] *= float(run != 1)
        parts.append(polynomial_coefficients(t, x) / 0.01)
    assert detrending_order(parts) == 0


def test_rest_at_start_and_end_is_not_detrending():
    """All rows at rest are rounded to zero."""
    rng = np.random.default_rng(8)
    parts = []
    for _ in range(3):
        t, x = simulate_displacement(rng)
        x[:100] = x[-100:] = 0.0
        parts.append(polynomial_coefficients(t, x) / 0.01)
    assert detrending_order(parts) == 0


def test_noise_is_not_detrended():
    # 3000 campaigns of three records: by chance 0.003 of them would be blamed.
    rng = np.random.default_rng(4)
    assert not any(detrending_order(parts) for parts in rng.normal(size=(3000, 3, 4)))
    assert not any(detrending_order([part]) for part in rng.normal(size=(3000, 4)))


def test_removed_mean_is_not_reported_as_higher_order():
    rng = np.random.default_rng(5)
    for _ in range(1000):
        parts = rng.normal(size=(3, 4))
        parts[:, 0] = 1e-9
        assert detrending_order(parts) == 1


def test_noise_free_record_is_not_detrended():
    assert detrending_order([np.array([np.nan, np.inf, 0.0, np.inf])]) == 0
    assert detrending_order([]) == 0
