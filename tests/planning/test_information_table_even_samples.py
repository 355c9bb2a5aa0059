"""The closed form of what evenly spaced samples tell, against the samples themselves."""

import numpy as np
import pytest

from counterspin.planning.information_table import (
    EvenSamples,
    basis_functions,
    shift_angle_origin,
    sqrt_information,
)

HARMONICS = [3, 4, 11]

#: Rows, angle from row to row, samples to a row.
RECORDS = {
    "many revolutions": (500, 0.1256, 1),
    "few samples to a revolution": (73, 0.45, 1),
    "so few that products of harmonics alias": (200, 1.3, 1),
    "blocks": (2000, 0.05, 5),
    "one revolution": (64, 0.1, 3),
}


def information(rows, angle, held):
    """Return the information of rows with start errors projected out."""
    if held:
        basis = np.linalg.qr(np.vander(angle - angle.mean(), held))[0]
        rows = rows - basis @ (basis.T @ rows)
    return rows.T @ rows


@pytest.mark.parametrize("held", [0, 1, 2])
@pytest.mark.parametrize("harmonics", HARMONICS)
@pytest.mark.parametrize("record", RECORDS.values(), ids=RECORDS)
def test_closed_form_matches_sum_over_samples(record, harmonics, held):
    count, step, block = record
    rng = np.random.default_rng(1)
    weights = rng.standard_normal((4 + 4 * harmonics, 5))
    weights[3] *= 1e-3
    within = (np.arange(block) - 0.5 * (block - 1)) * step / block
    first, spread = within[-1], within.std()
    angle = first + step * np.arange(count)
    mean = 0.5 * (
        basis_functions(angle - spread, harmonics) + basis_functions(angle + spread, harmonics)
    )
    expected = information(mean @ weights, angle, held)
    samples = EvenSamples(*(np.array([float(v)]) for v in (first, step, count, spread)))
    rows = sqrt_information(samples, weights[None], held)[0]
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert rows.shape == (4 + 4 * harmonics - held, 5)
    assert rows.T @ rows / scale == pytest.approx(expected / scale, abs=1e-12)


def test_closed_form_is_smooth_between_sample_counts():
    weights = np.random.default_rng(2).standard_normal((16, 3))
    counts = np.array([300.0, 300.5, 301.0, 301.5, 302.0])
    samples = EvenSamples(np.zeros(5), np.full(5, 0.1), counts, np.zeros(5))
    rows = sqrt_information(samples, np.broadcast_to(weights, (5, 16, 3)), 2)
    size = np.sum(rows**2, axis=(1, 2))
    # Fourth differences of a smooth function vanish as the fourth power of the half step, 0.05 rad.
    assert abs(np.diff(size, 4)[0]) < 1e-4 * abs(np.diff(size)[0])


def test_shifted_basis_spans_same_functions():
    weights = np.random.default_rng(3).standard_normal((2, 16, 4))
    angle, by = np.linspace(0.0, 20.0, 50), np.array([3.7, -0.2])
    for before, after, s in zip(weights, shift_angle_origin(weights, by), by, strict=True):
        assert basis_functions(angle - s, 3) @ after == pytest.approx(
            basis_functions(angle, 3) @ before
        )
