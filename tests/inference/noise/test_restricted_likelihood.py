"""The scale of the noise where few rows, or none, are left beside the unknowns."""

import math

import numpy as np
import pytest

from counterspin.errors import NotIdentifiableError
from counterspin.inference.noise.restricted_likelihood import RecordData, RestrictedLikelihood


def likelihood(unknowns, width, noise=1e-6):
    """Six samples of specific force, of a polynomial whose coefficients have priors."""
    rng = np.random.default_rng(1)
    design = np.vander(np.linspace(-1.0, 1.0, 6), unknowns)
    values = design @ rng.normal(0.0, 1e-3, unknowns) + rng.normal(0.0, noise, 6)
    data = RecordData(np.arange(6.0), 0, design, values)
    return RestrictedLikelihood.of([data], np.eye(unknowns) / width, np.zeros(unknowns))


@pytest.mark.parametrize("unknowns", [6, 7, 12])
@pytest.mark.parametrize("width", [1.0, 1e3, 1e9])
def test_as_many_unknowns_as_rows_leave_no_noise_to_be_told(unknowns, width):
    with pytest.raises(NotIdentifiableError, match="the unknowns follow all of 6 rows"):
        likelihood(unknowns, width).best_scale(0.0)


@pytest.mark.parametrize("width", [1.0, 1e3, 1e9])
def test_one_row_more_than_unknowns_tells_it(width):
    few = likelihood(5, width)
    scale = few.best_scale(0.0)
    assert few.freedom(scale, 0.0) == pytest.approx(1.0, abs=1e-6)
    assert abs(few.slope(scale, 0.0)) < 1e-6
    # A single degree of freedom: within the central 99.9 % of chi-square.
    assert 3.9e-7 < math.exp(scale) / 1e-12 < 12.2


def test_priors_that_hold_the_unknowns_leave_rows():
    held = likelihood(7, 1e-9, noise=1e-2)
    scale = held.best_scale(0.0)
    assert held.freedom(scale, 0.0) == pytest.approx(6.0, abs=1e-3)
    # Six degrees of freedom: within the central 99.9 % of chi-square.
    assert 0.299 < 6.0 * math.exp(scale) / 1e-4 < 24.11
