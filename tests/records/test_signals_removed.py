"""A mean, a line or a parabola that a recorder removed shows in all rows of a file."""

import numpy as np
import pytest

from counterspin.records.signals import SignalSums, detrending_order

ROWS = 20_000


def wave(rng, *, noise=0.01, rows=ROWS):
    """Return uneven times and a record of displacement with noise, bias and a start error."""
    t = np.sort(rng.uniform(0.0, 400.0, rows))
    return t, 2.5 * np.cos(1.57 * t) + 0.02 - 1e-3 * t + 0.025 * t**2 + noise * rng.normal(
        size=rows
    )


def without(t, x, count):
    """Take off the polynomial of so many coefficients that fits best."""
    powers = np.vander(t / t[-1], count, increasing=True)
    return x - powers @ np.linalg.lstsq(powers, x, rcond=None)[0]


def parts_of(t, x, pieces=1, noise=np.inf):
    """Return the coefficients of rows; by default as if the mean were removed."""
    sums = SignalSums(1)
    chunks = [(t[rows], x[rows]) for rows in np.array_split(np.arange(len(t)), pieces)]
    for _, values in chunks:
        sums.add([values])
    return sums.coefficients(0, noise, iter(chunks))


@pytest.mark.parametrize("pieces", [1, 7])
def test_the_parts_are_those_of_a_dense_factorisation(pieces):
    t, x = wave(np.random.default_rng(1))
    x[5:50] = np.nan
    t[45:70] = np.nan
    good = np.isfinite(x) & np.isfinite(t)
    q, r = np.linalg.qr(np.vander(t[good] / 400.0, 3, increasing=True))
    dense = (q * np.sign(np.diag(r))).T @ x[good]
    # Sums of t^4 and the root of their matrix, whose condition is 1e3, cost three digits.
    np.testing.assert_allclose(parts_of(t, x, pieces)[:3], dense, rtol=1e-11)
    # Unless the mean was removed, the times of the rows do not matter.
    with_mean = parts_of(t, x, pieces, noise=0.01)
    mean = np.nansum(x) / np.sqrt(np.isfinite(x).sum())
    np.testing.assert_allclose(with_mean[:3], [mean, np.inf, np.inf], rtol=1e-11)
    assert detrending_order([with_mean / 0.01]) == 0


@pytest.mark.parametrize(
    ("count", "decimals"), [(1, 6), (2, 6), (3, 6), (1, 17), (2, 17), (3, 17), (2, 4), (3, 4)]
)
def test_what_was_removed_is_found_in_rounded_rows_of_three_records(count, decimals):
    rng = np.random.default_rng(2)
    parts = []
    for _ in range(3):
        t, x = wave(rng)
        parts.append(parts_of(t, np.round(without(t, x, count), decimals)) / 0.01)
    assert detrending_order(parts) == count


def test_the_mean_over_neighbours_keeps_what_was_removed():
    rng = np.random.default_rng(3)
    parts = []
    for _ in range(3):
        t = np.arange(ROWS) * 0.02
        x = without(t, 2.5 * np.cos(1.57 * t) + 0.01 * rng.normal(size=ROWS), 3)
        parts.append(parts_of(*(v.reshape(-1, 4).mean(axis=1) for v in (t, x))) / 0.005)
    assert detrending_order(parts) == 3


def through_ends(t, x):
    """Take off the line through the first row and the last."""
    return x - np.interp(t, [t[0], t[-1]], [x[0], x[-1]])


@pytest.mark.parametrize("decimals", [4, 17])
@pytest.mark.parametrize("pieces", [1, 7])
def test_a_line_through_the_ends_is_found_in_three_records_and_not_in_one(decimals, pieces):
    rng = np.random.default_rng(6)
    parts = []
    for _ in range(3):
        t, x = wave(rng)
        parts.append(parts_of(t, np.round(through_ends(t, x), decimals), pieces) / 0.01)
    assert detrending_order(parts) == 2
    assert detrending_order(parts[:1]) == 0


def test_records_that_begin_at_zero_are_not_blamed():
    """A recorder that is set to zero when it begins, and in one of three comes back to zero."""
    rng = np.random.default_rng(7)
    parts = []
    for run in range(3):
        t, x = wave(rng)
        x -= x[0]
        x[-1] *= float(run != 1)
        parts.append(parts_of(t, x) / 0.01)
    assert detrending_order(parts) == 0


def test_records_that_begin_and_end_at_rest_are_not_blamed():
    """Rounded, all rows of the rest are zero."""
    rng = np.random.default_rng(8)
    parts = []
    for _ in range(3):
        t, x = wave(rng)
        x[:100] = x[-100:] = 0.0
        parts.append(parts_of(t, x) / 0.01)
    assert detrending_order(parts) == 0


def test_noise_alone_is_not_orthogonal_to_anything():
    # 3000 campaigns of three records: by chance 0.003 of them would be blamed.
    rng = np.random.default_rng(4)
    assert not any(detrending_order(parts) for parts in rng.normal(size=(3000, 3, 4)))
    assert not any(detrending_order([part]) for part in rng.normal(size=(3000, 4)))


def test_a_record_from_which_less_was_removed_is_not_blamed_for_more():
    rng = np.random.default_rng(5)
    for _ in range(1000):
        parts = rng.normal(size=(3, 4))
        parts[:, 0] = 1e-9
        assert detrending_order(parts) == 1


def test_a_record_without_noise_says_nothing():
    assert detrending_order([np.array([np.nan, np.inf, 0.0, np.inf])]) == 0
    assert detrending_order([]) == 0
